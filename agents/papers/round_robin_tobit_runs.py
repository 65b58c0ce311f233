"""Runs of the biased oscillator and the biased target, and the measures of their errors."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import fusion_gym
from agents.papers.numbers import Number
from agents.papers.walk import record, walk_in_parts
from fusion_gym import gaussian
from fusion_gym.arrays import Array
from fusion_gym.core.task import Task
from fusion_gym.entries import Plain
from fusion_gym.policies.base import Policy
from fusion_gym.systems.tobit.centres import FederatedCentre
from fusion_gym.systems.tobit.filters import Expectation, TobitKalmanFilter, censored_moments
from fusion_gym.systems.tobit.system import CensoredEstimator

OSCILLATOR = "fusion_gym/BiasedOscillator-v2"
TRACKING = "fusion_gym/BiasedTracking-v1"
STATES = 3  # x1, x2, b
PAPER_RUNS = 1000
_RESAMPLES = 500
CLEAR = 4.0  # standard errors: of 200 comparisons without a difference none is likely to reach it
FREE = {"censoring_threshold": -np.inf, "censoring_upper": np.inf}


def censored(task: Task) -> CensoredEstimator:
    """Return the task's estimator with its type."""
    assert isinstance(task.estimator, CensoredEstimator)
    return task.estimator


def squares(task: Task, policy: Policy | str, episodes: int, seed: int) -> Array:
    """Return squared errors (episodes, H, states) of the fused estimate."""
    values = np.empty((episodes, task.horizon, STATES))
    for step, runs, batch, requests in walk_in_parts(task, policy, episodes, seed):
        values[runs, step] = batch.step(requests).squared_error.T
    return values


def node_squares(task: Task, policy: Policy | str, episodes: int, seed: int) -> tuple[Array, Array]:
    """Return squared errors, fused and (episodes, H, sensors, states) of the nodes."""
    fused = np.empty((episodes, task.horizon, STATES))
    local = np.empty((episodes, task.horizon, task.sensors, STATES))
    for step, runs, batch, requests in walk_in_parts(task, policy, episodes, seed):
        fused[runs, step] = batch.step(requests).squared_error.T
        truth = task.plant.truth(batch.delivered.plant)
        error = truth - task.estimator.local_means(batch.delivered.estimate)
        local[runs, step] = (error**2).transpose(2, 0, 1)
    return fused, local


def resampled(episodes: int) -> Array:
    """Return weights (resamples, episodes) with sum 1 of bootstrap samples of the episodes."""
    shares = np.full(episodes, 1.0 / episodes)
    return np.random.default_rng(0).multinomial(episodes, shares, size=_RESAMPLES) / episodes


def armse(squared: Array) -> dict[str, list[float]]:
    """Return the paper's ARMSE per state: mean over time of the root of the mean over runs.

    ``mean``, ``low`` and ``high`` of the 95 % bootstrap interval over episodes, and ``spread``, the
    standard deviation over as many runs as the paper's.
    """
    drawn = _drawn(squared)
    spread = drawn.std(0) * np.sqrt(len(squared) / PAPER_RUNS)
    return _with_ends(np.sqrt(squared.mean(0)), drawn) | {"spread": spread.tolist()}


def increase(before: Array, after: Array) -> dict[str, list[float]]:
    """Return the increase of :func:`armse` per state between two filters on the same seeds.

    ``mean``, ``low`` and ``high`` of the 95 % bootstrap interval of the paired difference.
    """
    rise = np.sqrt(after.mean(0)) - np.sqrt(before.mean(0))
    return _with_ends(rise, _drawn(after) - _drawn(before))


def _with_ends(curve: Array, drawn: Array) -> dict[str, list[float]]:
    low, high = np.quantile(drawn, [0.025, 0.975], axis=0)
    return {"mean": curve.mean(0).tolist(), "low": low.tolist(), "high": high.tolist()}


def medians(squared: Array) -> tuple[float, Array]:
    """Return median over runs of a run's RMSE of x1, and (resamples,) of bootstrap samples."""
    roots = np.sqrt(squared[..., 0].mean(1))
    order = np.argsort(roots)
    reached = np.cumsum(resampled(len(roots))[:, order], axis=1) >= 0.5
    return float(np.median(roots)), roots[order][np.argmax(reached, axis=1)]


def _drawn(squared: Array) -> Array:
    """ARMSE (resamples, states) of bootstrap samples, the same episodes for every filter."""
    episodes, horizon, states = squared.shape
    means = resampled(episodes) @ squared.reshape(episodes, -1)
    return np.asarray(np.sqrt(means.reshape(-1, horizon, states)).mean(1))


def armse_number(
    what: str, lists: Plain, state: int, printed: float | None = None, unit: str = ""
) -> Number:
    """Return one entry of :func:`armse` with the printed one."""
    mean, low, high, spread = (lists[key][state] for key in ("mean", "low", "high", "spread"))
    return Number(what, mean, low, high, printed, spread, unit)


def error_curve(squared: Array) -> Array:
    """Return RMSE over time (3, H, states): the root mean, and its 95 % interval."""
    mean = squared.mean(0)
    half = 1.96 * squared.std(0, ddof=1) / np.sqrt(len(squared))
    return np.sqrt(np.stack([mean, np.maximum(mean - half, 0.0), mean + half]))


def paired_increase(ours: Array, others: Array) -> Array:
    """Return the paired difference of squared errors (2, H, states): mean, standard error."""
    difference = ours - others
    return np.stack([difference.mean(0), difference.std(0, ddof=1) / np.sqrt(len(difference))])


def floor(env: str, **options: Any) -> list[float]:
    """Return the ARMSE of the Kalman filter on the same packets without censoring, a lower bound.

    The system without censoring is linear and Gaussian, so its covariances are the least possible,
    and a clipped packet carries no more information than the whole one. They follow from the
    matrices.
    """
    task = fusion_gym.make_task(env, filter="kalman", **(FREE | options))
    policy = "always" if task.options.access == "any" else "round_robin"
    covariances = record(task, policy, 1, 0, lambda s: task.estimator.covariance(s.estimate))
    return np.sqrt(np.diagonal(covariances[..., 0], axis1=1, axis2=2)).mean(0).tolist()


def always_below(difference: Array) -> tuple[float, str]:
    """Return whether one curve lies below another at every step, and at how many points.

    ``difference`` (2, H, …) is the mean of the paired differences of squared errors with its
    standard error. It holds if all points are clearly lower, and fails if one is clearly higher.
    """
    mean, error = difference
    lower = (mean < -CLEAR * error) & (error > 0)
    higher = (mean > CLEAR * error) & (error > 0)
    return 0.0 if higher.any() else 1.0 if lower.all() else np.nan, (
        f"clearly lower at {lower.sum()} of {mean.size} points, clearly higher at {higher.sum()}, "
        f"lower by the mean at {(mean < 0).sum()}"
    )


@dataclass(frozen=True)
class PrintedTobitFilter(TobitKalmanFilter):
    """The Tobit Kalman filter with one of the paper's equations as printed.

    ``printed``: ``"theta"`` divides by R instead of √R in the ϑ below (11); ``"sign"`` adds √R
    λ(ϑʳ, ϑˡ) in (23) instead of subtracting it; ``"argument"`` adds √R λ(ϑʳ - ϑˡ) there, with the λ
    of one argument of Theorem 4; ``"variance"`` uses (13) as the variance of the censored value.
    """

    printed: str = "sign"

    def expect(self, mean: Array) -> Expectation:
        """See :class:`fusion_gym.systems.tobit.filters.NodeFilter`."""
        usual = super().expect(mean)
        deviation = self.sensors.deviation
        if self.printed == "variance":
            total = np.maximum(usual.noise_variance / deviation**2, 1e-12)
            return usual._replace(truncated_variance=total)
        inside = usual.uncensored_probability
        if self.printed == "theta":
            scaled = censored_moments(self.sensors, usual.latent, deviation**2)
            shift = scaled.uncensored_probability * (deviation - deviation**2) * scaled.hazard
            return scaled._replace(value=scaled.value + shift)
        if self.printed == "sign":
            return usual._replace(value=usual.value - 2.0 * inside * deviation * usual.hazard)
        width = (self.sensors.upper - self.sensors.threshold) / deviation
        shift = usual.hazard - gaussian.hazard(width)
        return usual._replace(value=usual.value - inside * deviation * shift)


ROUND_ROBIN_READINGS: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "corrected equations": ("", {}), "ϑ below (11) over R, as printed": ("theta", {}),
    "plus λ in (23), as printed": ("sign", {}),
    "plus λ of one argument in (23), as printed": ("argument", {}),
    "(13) as the variance of the censored value": ("variance", {}),
    "Ξ = 0.25 a standard deviation": ("", {"bias_noise_covariance": [[0.0625]]}),
    "R = 0.6 a standard deviation": ("", {"measurement_variance": 0.36}),
    "both standard deviations": (
        "", {"bias_noise_covariance": [[0.0625]], "measurement_variance": 0.36},
    ),
    "no round robin: both sensors at every step": ("", {"access": "any"}),
    "assumed-density filter instead": ("", {"filter": "adf"}),
}  # fmt: skip


def reading_task(reading: str, **options: Any) -> Task:
    """Return the oscillator in a reading of :data:`ROUND_ROBIN_READINGS`."""
    printed, changed = ROUND_ROBIN_READINGS[reading]
    task = fusion_gym.make_task(OSCILLATOR, **(dict(changed) | options))
    if not printed:
        return task
    estimator = censored(task)
    centre = estimator.centre
    assert isinstance(centre, FederatedCentre)
    filter_ = PrintedTobitFilter(centre.sensors, printed)
    centre = replace(centre, filter=filter_)
    return replace(task, estimator=replace(estimator, centre=centre))
