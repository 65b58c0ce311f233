"""Baselines at full strength: Optuna searches a rule's parameters for its whole trade-off."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import optuna

from fusion_gym.core.task import Task
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError

from .config import Choices, Family, Range, Tuning

optuna.logging.set_verbosity(optuna.logging.WARNING)


def shared_values(family: Family, trials: int, sensors: int) -> list[dict[str, Any]]:
    """Trials to begin with: all sensors alike, a parameter at a time over its whole range.

    Without them a search with a parameter for every sensor can miss what a sweep of one shared
    value finds. Choices take turns; other parameters are left to the sampler.
    """
    ranges = {
        name: space
        for name, space in family.parameters.items()
        if isinstance(space, Range) and space.per_sensor
    }
    if not ranges:
        return []
    choices = {
        name: space.values
        for name, space in family.parameters.items()
        if isinstance(space, Choices)
    }
    turns = list(itertools.product(*choices.values()))
    count = -(-trials // len(turns))
    found = []
    for place in range(trials):
        values: dict[str, Any] = dict(zip(choices, turns[place % len(turns)], strict=True))
        share = (place // len(turns) + 0.5) / count
        for name, space in ranges.items():
            value = space.low * (space.high / space.low) ** share
            for key in _keys(name, space, sensors):
                values[key] = round(value) if space.whole else value
        found.append(values)
    return found


def _keys(name: str, space: Range, sensors: int) -> list[str]:
    """Names of a parameter's numbers in the study."""
    if not space.per_sensor or sensors == 1:
        return [name]
    return [f"{name}_{place}" for place in range(sensors)]


def suggest(trial: optuna.Trial, family: Family, sensors: int) -> str:
    """The policy's text for a trial."""
    parts = []
    for name, space in family.parameters.items():
        if isinstance(space, Choices):
            value = trial.suggest_categorical(name, list(space.values))
            parts.append(f"{name}={_text(value)}")
            continue
        values = [_number(trial, key, space) for key in _keys(name, space, sensors)]
        parts.append(f"{name}={'/'.join(_text(value) for value in values)}")
    return f"{family.policy}:{','.join(parts)}" if parts else family.policy


def _number(trial: optuna.Trial, name: str, space: Range) -> float:
    if space.whole:
        return trial.suggest_int(name, int(space.low), int(space.high), log=True)
    return trial.suggest_float(name, space.low, space.high, log=True)


def _text(value: Any) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value).lower()


def tune(task: Task, family: Family, tuning: Tuning, seed: int = 0) -> list[str]:
    """The rule's Pareto-optimal policies in rate and error, by rising rate; at most ``kept``.

    Two objectives at once, so that the search looks for the curve and not for one point of it;
    the budget of trials is the same for every rule. A third of it goes to values that all sensors
    share (or to random ones, for rules without a parameter a sensor), the rest to the sampler.

    Raises:
        ConfigurationError: none of the trials was a policy that fits the task.
    """
    first = max(tuning.trials // 3, 4)
    sampler = optuna.samplers.TPESampler(seed=seed, n_startup_trials=first)
    study = optuna.create_study(directions=["minimize", "minimize"], sampler=sampler)
    for values in shared_values(family, min(first, tuning.trials), task.sensors):
        study.enqueue_trial(values)

    def objective(trial: optuna.Trial) -> tuple[float, float]:
        policy = suggest(trial, family, task.sensors)
        trial.set_user_attr("policy", policy)
        results = run_episodes(task, make_policy(policy, task), tuning.episodes, tuning.seed)
        mse = float(results.mse.mean())
        return float(results.rate.mean()), mse if np.isfinite(mse) else 1e300

    study.optimize(objective, n_trials=tuning.trials)
    best = sorted(study.best_trials, key=lambda trial: trial.values[0])
    if not best:
        raise ConfigurationError(f"family = {family.label!r} is not allowed: no trial succeeded")
    places = np.unique(np.linspace(0, len(best) - 1, min(tuning.kept, len(best))).round())
    return list(dict.fromkeys(best[int(place)].user_attrs["policy"] for place in places))
