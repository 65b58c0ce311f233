"""From episodes to the numbers of a report."""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np

from fusion_gym.arrays import Array
from fusion_gym.docstrings import table
from fusion_gym.evaluation.episodes import EpisodeResults
from fusion_gym.evaluation.intervals import Interval, mean_interval
from fusion_gym.validation import ConfigurationError


class Metric(NamedTuple):
    """A row of the table: its meaning, which values are ``better``, and its ``samples``.

    Samples are by default the field of :class:`EpisodeResults` of its name. Of samples (E,) a
    summary has the mean with its 95 % bootstrap interval over episodes, of an array with a column
    for each ``axis`` the means. ``column`` heads it in printed tables, where ``form`` writes the
    mean, and ``interval`` adds the half width.
    """

    meaning: str
    better: Literal["lower", "higher", "1", ""] = ""
    axis: Literal["", "sensor", "state"] = ""
    column: str = ""
    form: str = ".3f"
    interval: bool = False
    samples: Callable[[EpisodeResults], Array] | None = None

    def summary(self, name: str, results: EpisodeResults) -> Any:
        """Return what a summary has of it: an interval, or a list along its axis."""
        result = self.samples(results) if self.samples else getattr(results, name)
        return result.mean(0).tolist() if self.axis else mean_interval(result)._asdict()


METRICS = {
    "mse": Metric(
        "squared error of the fused estimate, summed over states, per step",
        "lower", column="MSE", form=".4g", interval=True,
    ),
    "armse": Metric(
        "root of the mean squared error over episodes, averaged over time",
        "lower", "state", samples=lambda results: np.sqrt(results.squared_error),
    ),
    "bound_trace": Metric(
        "trace of the claimed covariance, per step", column="trace P", form=".4g"
    ),
    "nees": Metric("normalised squared error, divided by the states", "1", column="NEES"),
    "rate": Metric("transmissions per step", "lower", "sensor", "rate"),
    "requests": Metric("requests per step", axis="sensor", column="requests"),
    "tokens": Metric("tokens spent per step", "lower", column="tokens"),
    "denied": Metric("requests refused per step", "lower", column="denied"),
    "return": Metric(
        "sum of the rewards of an episode", "higher", column="return", form=".4g", interval=True,
        samples=lambda results: results.returns,
    ),
}  # fmt: skip


def summarise(results: EpisodeResults) -> dict[str, Any]:
    """Return every metric of ``METRICS`` for one policy, as the evaluation's JSON holds it.

    ``{"mean", "low", "high"}``, or a list with one number a sensor or a state.
    """
    return {name: metric.summary(name, results) for name, metric in METRICS.items()}


def metric_table(_: str) -> str:
    """Return the metrics as a Markdown table."""
    rows = (
        (f"`{name}`", metric.meaning, metric.axis or "mean, low, high", metric.better)
        for name, metric in METRICS.items()
    )
    return table(("metric", "meaning", "a number for each", "better"), rows)


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
