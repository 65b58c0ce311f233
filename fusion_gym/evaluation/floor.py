"""The error of a centre that receives every measurement."""

from collections.abc import Mapping, Sequence
from typing import Any

from fusion_gym.core.task import Task
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.evaluation.intervals import Interval, mean_interval
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError


def everything_delivered(
    env_id: str,
    options: Mapping[str, Any],
    filters: Sequence[str] = (),
    episodes: int = 1000,
    seed: int = 0,
) -> dict[str, Interval]:
    """Return the MSE of a centre that receives every measurement, by filter, with its interval.

    Tokens and access are unlimited. The least of these errors is no bound: a filter may be an
    approximation, for which fewer measurements can be better.

    Args:
        env_id: id of the environment.
        options: options of the environment.
        filters: values of the option ``filter``; the filter of ``options`` by default.
        episodes: episodes of each filter.
        seed: seed of the first episode.

    Raises:
        ConfigurationError: a value that is not allowed.
    """
    return {
        name: mean_interval(run_episodes(task, make_policy("always", task), episodes, seed).mse)
        for name, task in _tasks(env_id, options, filters).items()
    }


def _tasks(env_id: str, options: Mapping[str, Any], filters: Sequence[str] = ()) -> dict[str, Task]:
    """Return the tasks with unlimited tokens and access, by filter."""
    open_wide = {**options, "tokens": "unlimited", "access": "any"}
    if not filters:
        return {"own": make_task(env_id, **open_wide)}
    make_task(env_id, **open_wide)  # reports an error that no filter causes
    tasks = {}
    for name in filters:
        try:
            tasks[name] = make_task(env_id, **open_wide | {"filter": name})
        except ConfigurationError as error:
            raise ConfigurationError(f"filters = {name!r} is not allowed: {error}") from None
    return tasks
