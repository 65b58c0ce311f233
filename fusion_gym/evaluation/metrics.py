"""Metrics of episodes with bootstrap intervals over episodes, and comparisons of policies."""

import warnings
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import numpy as np

from fusion_gym.arrays import Array
from fusion_gym.core.scale import lower_hull
from fusion_gym.docstrings import table
from fusion_gym.entries import Plain
from fusion_gym.errors import ConfigurationError, DivergenceError
from fusion_gym.evaluation.episodes import EpisodeResults

LEVEL = 0.95
RESAMPLES = 2000
_HEAVY = 0.2  # share of the largest samples from which on a mean has a heavy tail


class Interval(NamedTuple):
    """A mean with the ends of its confidence interval.

    Args:
        mean: mean of the samples.
        low: lower end.
        high: upper end.

    Example:
        >>> from fusion_gym.evaluation import Interval
        >>> Interval(mean=0.5, low=0.4, high=0.6).high
        0.6
    """

    mean: float
    low: float
    high: float


def mean_interval(samples: Array, seed: int = 0) -> Interval:
    """Return the mean of samples with its 95 % percentile bootstrap interval.

    A single sample, or equal samples, give the interval [mean, mean]. NaN, the value of a lost
    episode, is left out with a warning. Another warning says that the largest 1 % of the samples
    have more than a fifth of their sum: the tail is heavy, and the interval may lie far below the
    expectation.

    Args:
        samples: one value per episode (E,).
        seed: seed of the resampling.

    Returns:
        The mean and the ends of the interval, from 2,000 resamples.

    Example:
        >>> import numpy as np
        >>> from fusion_gym.evaluation import mean_interval
        >>> mean_interval(np.arange(10.0))
        Interval(mean=4.5, low=2.7, high=6.3)
    """
    lost = np.isnan(samples)
    if lost.all():
        raise DivergenceError(f"all {len(samples)} episodes diverged: there is no mean")
    if lost.any():
        text = f"{lost.sum()} of {len(samples)} episodes diverged: the mean is that of the others"
        warnings.warn(text, stacklevel=2)
        samples = samples[~lost]
    mean = float(np.mean(samples))
    if len(samples) < 2 or float(np.ptp(samples)) == 0.0:
        return Interval(mean, mean, mean)
    sizes = np.sort(np.abs(samples))
    share = sizes[len(sizes) - len(sizes) // 100 :].sum() / sizes.sum()
    if share > _HEAVY:
        warnings.warn(
            f"the largest 1 % of the samples have over {_HEAVY:.0%} of their sum: the mean has a "
            "heavy tail, and its interval may miss the expectation",
            stacklevel=2,
        )
    from scipy import stats  # takes a third of a second

    low, high = stats.bootstrap(
        (samples,),
        np.mean,
        n_resamples=RESAMPLES,
        batch=200,
        confidence_level=LEVEL,
        method="percentile",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return Interval(mean, float(low), float(high))


class Metric(NamedTuple):
    """A metric of an evaluation: a row of the table of metrics.

    Args:
        meaning: its meaning, in a few words.
        better: values that are better.
        axis: axis of one value each; without one the summary is a mean with its 95 % interval.
        column: header of its column in printed tables; empty for none.
        form: format of its mean in printed tables.
        interval: whether printed tables show the half width of its interval.
        samples: function from results to samples (E,) or (E, axis); the field of
            :class:`EpisodeResults` with the name of the metric by default.
        loop: whether only a closed loop has it.
    """

    meaning: str
    better: Literal["lower", "higher", "1", ""] = ""
    axis: Literal["", "sensor", "state", "input"] = ""
    column: str = ""
    form: str = ".3f"
    interval: bool = False
    samples: Callable[[EpisodeResults], Array] | None = None
    loop: bool = False

    def summary(self, name: str, results: EpisodeResults) -> Any:
        """Return the metric's interval, or its means along its axis."""
        result = self.samples(results) if self.samples else getattr(results, name)
        if not self.axis:
            return mean_interval(result)._asdict()
        with warnings.catch_warnings():  # a sensor whose packets never arrive has no peak age
            warnings.filterwarnings("ignore", "Mean of empty slice", RuntimeWarning)
            return np.nanmean(result, 0).tolist()


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
        "trace of the estimated covariance, per step", column="trace P", form=".4g"
    ),
    "nees": Metric("normalised squared error over the rank of the covariance", "1", column="NEES"),
    "rate": Metric("transmissions per step", "lower", "sensor", "rate"),
    "requests": Metric("requests per step", axis="sensor", column="requests"),
    "tokens": Metric("tokens spent per step", "lower", column="tokens"),
    "age": Metric("age of information", "lower", "sensor"),
    "peak_age": Metric("age of information just before an arrival", "lower", "sensor"),
    "age_95": Metric("95 % quantile of the age of information", "lower", "sensor"),
    "incorrect_age": Metric(
        "age of incorrect information: steps since the weighted squared error was last at most 1",
        "lower",
    ),
    "denied": Metric("requests denied per step", "lower", column="denied"),
    "return": Metric(
        "sum of the rewards of an episode", "higher", column="return", form=".4g", interval=True,
        samples=lambda results: results.returns,
    ),
    "control_cost": Metric(
        "cost of state and input, per step",
        "lower", column="control", form=".4g", interval=True, loop=True,
    ),
    "control": Metric("squared input per step", axis="input", loop=True),
}  # fmt: skip


def summarise(results: EpisodeResults) -> Plain:
    """Return every metric of one policy, as in the JSON of an evaluation.

    Args:
        results: results of the policy.

    Returns:
        By metric a table ``{"mean", "low", "high"}``, or a list with one number per sensor, state
        or input.

    Example:
        >>> from fusion_gym import make_policy, make_task
        >>> from fusion_gym.evaluation import run_episodes, summarise
        >>> task = make_task("fusion_gym/TobitOscillator-v1", horizon=20)
        >>> results = run_episodes(task, make_policy("periodic:period=8", task), 8, seed=0)
        >>> summarise(results)["rate"]
        [0.15, 0.15, 0.1]
    """
    return {
        name: metric.summary(name, results)
        for name, metric in METRICS.items()
        if not metric.loop or getattr(results, name) is not None
    }


def metric_table(_: str) -> str:
    """Return the metrics as a Markdown table."""
    rows = (
        (f"`{name}`", metric.meaning, metric.axis or "mean, low, high", metric.better)
        for name, metric in METRICS.items()
    )
    return table(("metric", "meaning", "one entry per", "better"), rows)


def robust_summary(results: EpisodeResults) -> dict[str, float]:
    """Return quantiles of the episodes' MSE, which a few divergent episodes hardly change.

    A step counts as diverged if the squared error of a state exceeds 100 times its open-loop mean,
    or is not finite.

    Args:
        results: results of the policy.

    Returns:
        The quantiles ``q05``, ``q25``, ``median``, ``q75`` and ``q95``, the share ``diverged`` of
        diverged steps, and the share ``lost`` of lost episodes, whose MSE counts as infinite.

    Example:
        >>> from fusion_gym import make_policy, make_task
        >>> from fusion_gym.evaluation import robust_summary, run_episodes
        >>> task = make_task("fusion_gym/TobitOscillator-v1", horizon=20)
        >>> robust_summary(run_episodes(task, make_policy("always", task), 4, seed=0))["diverged"]
        0.0
    """
    names = {"q05": 0.05, "q25": 0.25, "median": 0.5, "q75": 0.75, "q95": 0.95}
    mse = np.where(np.isnan(results.mse), np.inf, results.mse)
    quantiles = {name: float(np.quantile(mse, level)) for name, level in names.items()}
    diverged = float(np.nan_to_num(results.diverged, nan=1.0).mean())
    return quantiles | {"diverged": diverged, "lost": float(np.isnan(results.mse).mean())}


def paired_difference(results: EpisodeResults, reference: EpisodeResults) -> Interval:
    """Return the mean difference of the MSE to a reference, with its 95 % interval.

    Args:
        results: results of the policy.
        reference: results of the reference, on the same seeds.

    Returns:
        The interval of ``results.mse - reference.mse``; negative: the policy is better.

    Raises:
        ConfigurationError: the numbers of episodes differ.

    Example:
        >>> from fusion_gym import make_policy, make_task
        >>> from fusion_gym.evaluation import paired_difference, run_episodes
        >>> task = make_task("fusion_gym/TobitOscillator-v1", horizon=20)
        >>> always = run_episodes(task, make_policy("always", task), 8, seed=0)
        >>> never = run_episodes(task, make_policy("never", task), 8, seed=0)
        >>> round(paired_difference(always, never).mean, 3)
        -0.07
    """
    check_pair(results, reference)
    return mean_interval(results.mse - reference.mse)


def check_pair(results: EpisodeResults, reference: EpisodeResults) -> None:
    """Check that two policies have the same number of episodes."""
    if results.episodes != reference.episodes:
        raise ConfigurationError(
            f"episodes = {results.episodes} and {reference.episodes} cannot be paired: both "
            "policies must run on the same seeds"
        )


class EnvelopePoint(NamedTuple):
    """A policy on the envelope, with its means over episodes.

    Args:
        name: name of the policy.
        rate: transmissions per sensor and step.
        mse: squared error per step, summed over states, in squared units of the states.

    Example:
        >>> from fusion_gym.evaluation import EnvelopePoint
        >>> EnvelopePoint("always", 0.55, 0.106).rate
        0.55
    """

    name: str
    rate: float
    mse: float


def lower_envelope(results: Mapping[str, EpisodeResults]) -> list[EnvelopePoint]:
    """Return the lower convex hull of the policies' points (rate, MSE), without lost episodes.

    A random choice between two policies for each episode reaches every point of the line between
    them. No policy and no mixture of policies lies below the hull.

    Args:
        results: results of each policy by name.

    Returns:
        The points of the hull, by rising rate and strictly falling error.

    Raises:
        ConfigurationError: no policies.

    Example:
        >>> from fusion_gym import make_policy, make_task
        >>> from fusion_gym.evaluation import lower_envelope, run_episodes
        >>> task = make_task("fusion_gym/TobitOscillator-v1", horizon=20)
        >>> names = ["never", "periodic:period=4", "always"]
        >>> results = {n: run_episodes(task, make_policy(n, task), 8, seed=0) for n in names}
        >>> [(point.name, round(point.rate, 2)) for point in lower_envelope(results)]
        [('never', 0.0), ('periodic:period=4', 0.25), ('always', 0.55)]
    """
    if not results:
        raise ConfigurationError("policies = {} is not allowed: an envelope needs at least one")
    points = [
        EnvelopePoint(name, float(np.nanmean(result.rate)), float(np.nanmean(result.mse)))
        for name, result in sorted(results.items())
    ]
    rates, errors = np.array([(point.rate, point.mse) for point in points]).T
    return [points[place] for place in lower_hull(rates, errors)]


def envelope_error(results: Mapping[str, EpisodeResults], rate: float) -> Array:
    """Return the MSE of each episode on the policies' lower envelope at a rate.

    The two neighbours on the envelope are mixed to the rate. To its right the last one counts. A
    policy whose rate lies between distant neighbours may lie below the line.

    Args:
        results: results of each policy by name, on the same episodes.
        rate: transmissions per sensor and step.

    Returns:
        The errors (E,). ``results.mse - envelope_error(…)`` are paired differences.

    Raises:
        ConfigurationError: no policies, or a rate below the rates of all.

    Example:
        >>> from fusion_gym import make_policy, make_task
        >>> from fusion_gym.evaluation import envelope_error, mean_interval, run_episodes
        >>> task = make_task("fusion_gym/TobitOscillator-v1", horizon=20)
        >>> names = ["never", "always", "periodic:period=8"]
        >>> results = {n: run_episodes(task, make_policy(n, task), 8, seed=0) for n in names}
        >>> mine = results.pop("periodic:period=8")
        >>> error = envelope_error(results, float(mine.rate.mean()))
        >>> round(mean_interval(mine.mse - error).mean, 3)
        -0.011
    """
    hull = lower_envelope(results)
    if rate < hull[0].rate:
        raise ConfigurationError(
            f"rate = {rate:.4f} is below every policy's (the smallest is {hull[0].rate:.4f}): "
            "add 'never'"
        )
    left = max((p for p in hull if p.rate <= rate), key=lambda p: p.rate)
    right = min((p for p in hull if p.rate > rate), key=lambda p: p.rate, default=left)
    share = (rate - left.rate) / (right.rate - left.rate or 1.0)
    return np.asarray((1.0 - share) * results[left.name].mse + share * results[right.name].mse)
