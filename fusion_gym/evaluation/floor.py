"""What the error is where everything is always taken in."""

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
    """The MSE of a centre that gets every measurement, by filter, with its 95 % interval.

    The environment's tokens and access are opened; ``filters`` are values of its option
    ``filter``, by default the setting's own. The best of them is what no rule is likely to
    undercut with these filters. It is no bound: these filters may be approximations, and with
    one, less may be more.

    Raises:
        ConfigurationError: a value that is not allowed.
    """
    return {
        name: mean_interval(run_episodes(task, make_policy("always", task), episodes, seed).mse)
        for name, task in _tasks(env_id, options, filters).items()
    }


def _tasks(env_id: str, options: Mapping[str, Any], filters: Sequence[str] = ()) -> dict[str, Task]:
    """The environment with tokens and access opened, by filter.

    Raises:
        ConfigurationError: a value that is not allowed.
    """
    open_wide = {**options, "tokens": "unlimited", "access": "any"}
    if not filters:
        return {"own": make_task(env_id, **open_wide)}
    make_task(env_id, **open_wide)  # what is wrong without a filter is not for its sake
    tasks = {}
    for name in filters:
        try:
            tasks[name] = make_task(env_id, **open_wide | {"filter": name})
        except ConfigurationError as error:
            raise ConfigurationError(f"filters = {name!r} is not allowed: {error}") from None
    return tasks
