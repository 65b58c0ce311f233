"""The equations of round_robin_tobit as they are printed, and other readings of its parameters."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import fusion_gym
from fusion_gym import gaussian
from fusion_gym.arrays import Array
from fusion_gym.core.task import Task
from fusion_gym.systems.tobit.centre import FeedbackCentre
from fusion_gym.systems.tobit.filters import Expectation
from fusion_gym.systems.tobit.tobit_filter import TobitKalmanFilter

from .runs import OSCILLATOR, censored


@dataclass(frozen=True)
class PrintedTobitFilter(TobitKalmanFilter):
    """The Tobit Kalman filter with one of the paper's equations as it stands there.

    ``printed``: ``"theta"`` divides by R instead of √R in the ϑ below (11); ``"sign"`` adds
    √R λ(ϑʳ, ϑˡ) in (23) instead of subtracting it; ``"argument"`` adds √R λ(ϑʳ - ϑˡ) there, with
    the λ of one argument of Theorem 4; ``"variance"`` takes (13) at its word, as the variance of
    the censored value.
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
            return self._scaled(usual.latent, deviation * deviation)
        if self.printed == "sign":
            return usual._replace(value=usual.value - 2.0 * inside * deviation * usual.hazard)
        width = (self.sensors.upper - self.sensors.threshold) / deviation
        shift = usual.hazard - gaussian.hazard(width)
        return usual._replace(value=usual.value - inside * deviation * shift)

    def _scaled(self, latent: Array, scale: Array) -> Expectation:
        low, high = (self.sensors.threshold - latent) / scale, (self.sensors.upper - latent) / scale
        moments = gaussian.interval_moments(low, high)
        below, above = gaussian.upper_tail(-low), gaussian.upper_tail(high)
        inside = moments.probability
        centre = latent + self.sensors.deviation * moments.mean
        value = below * self.sensors.threshold + above * self.sensors.upper + inside * centre
        within = np.clip(moments.variance, 1e-12, 1.0)
        noise = inside * self.sensors.variance * within
        return Expectation(latent, value, noise, inside, moments.mean, within)


READINGS: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "corrected equations": ("", {}),
    "ϑ below (11) over R, as printed": ("theta", {}),
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
    """The oscillator in a reading of :data:`READINGS`."""
    printed, changed = READINGS[reading]
    task = fusion_gym.make_task(OSCILLATOR, **(dict(changed) | options))
    if not printed:
        return task
    system = censored(task)
    centre = system.centre
    assert isinstance(centre, FeedbackCentre)
    filter_ = PrintedTobitFilter(centre.sensors, printed)
    return replace(task, system=replace(system, centre=replace(centre, filter=filter_)))
