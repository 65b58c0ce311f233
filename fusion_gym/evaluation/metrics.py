"""From episodes to the numbers of a report."""

from __future__ import annotations

from typing import Any

import numpy as np

from fusion_gym.evaluation.episodes import EpisodeResults
from fusion_gym.evaluation.intervals import Interval, mean_interval
from fusion_gym.validation import ConfigurationError


def summarise(results: EpisodeResults) -> dict[str, Any]:
    """The metrics of one policy, as the evaluation's JSON holds them.

    ``mse``, ``bound_trace``, ``nees``, ``tokens``, ``denied`` and ``return`` are
    ``{"mean", "low", "high"}`` with a 95 % bootstrap interval over episodes; ``rate`` and
    ``requests`` have one number a sensor; ``armse`` has one a state, the mean over time of the
    root of the mean over episodes of the squared error.
    """
    return {
        "mse": mean_interval(results.mse)._asdict(),
        "armse": np.sqrt(results.squared_error).mean(0).tolist(),
        "bound_trace": mean_interval(results.bound_trace)._asdict(),
        "nees": mean_interval(results.nees)._asdict(),
        "rate": results.rate.mean(0).tolist(),
        "requests": results.requests.mean(0).tolist(),
        "tokens": mean_interval(results.tokens)._asdict(),
        "denied": mean_interval(results.denied)._asdict(),
        "return": mean_interval(results.returns)._asdict(),
    }


def robust_summary(results: EpisodeResults) -> dict[str, float]:
    """What a few divergent episodes cannot spoil: quantiles of the episodes' MSE.

    ``q05``, ``q25``, ``median``, ``q75``, ``q95`` and ``diverged``, the share of steps in which
    some state's squared error was above 100 times its open-loop mean, or not finite.
    """
    names = {"q05": 0.05, "q25": 0.25, "median": 0.5, "q75": 0.75, "q95": 0.95}
    quantiles = {name: float(np.quantile(results.mse, level)) for name, level in names.items()}
    return quantiles | {"diverged": float(results.diverged.mean())}


def paired_difference(results: EpisodeResults, reference: EpisodeResults) -> Interval:
    """Mean difference of the MSE to a reference over the same seeds, with its 95 % interval.

    Raises:
        ConfigurationError: the two have different numbers of episodes.
    """
    if results.episodes != reference.episodes:
        raise ConfigurationError(
            f"episodes = {results.episodes} and {reference.episodes} cannot be paired: both "
            "policies must run on the same seeds"
        )
    return mean_interval(results.mse - reference.mse)
