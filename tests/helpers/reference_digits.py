"""Kalman and Tobit Kalman filters in arithmetic of 50 digits, as textbooks write them.

All that has arrived is taken at once: S = H P Hᵀ + N, x̂ + P Hᵀ S⁻¹ (y - ŷ), P - P Hᵀ S⁻¹ H P.
Arrays of mpmath numbers, one run, no batch axis.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from mpmath import mp, mpf
from numpy.typing import NDArray
from structured_systems import request

from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.systems.tobit.system import CensoredPlant

DIGITS = 50
Exact = NDArray[np.object_]


def exact(values: Any) -> Exact:
    """The numbers as they are, each a float64."""
    array = np.asarray(values, dtype=np.float64)
    result = np.empty(array.shape, dtype=object)
    result.ravel()[:] = [mpf(float(value)) for value in array.ravel()]
    return result


def solve(matrix: Exact, right: Exact) -> Exact:
    """Gaussian elimination with pivots."""
    a, b = matrix.copy(), right.copy()
    size = len(a)
    for k in range(size):
        pivot = k + int(np.argmax([abs(value) for value in a[k:, k]]))
        a[[k, pivot]], b[[k, pivot]] = a[[pivot, k]], b[[pivot, k]]
        for row in range(k + 1, size):
            factor = a[row, k] / a[k, k]
            a[row] = a[row] - factor * a[k]
            b[row] = b[row] - factor * b[k]
    for k in reversed(range(size)):
        b[k] = (b[k] - a[k, k + 1 :] @ b[k + 1 :]) / a[k, k]
    return b


class ExactFilter:
    """A filter of one run: ``mean`` (n,) and ``covariance`` (n, n), which start at time 0.

    ``rows`` (sensors, m, n) and ``noise`` (sensors·m, sensors·m) are the sensors'; of the Tobit
    Kalman filter ``limits``, low and high (sensors, m), are where they are censored. By the
    ``weight`` (sensors,) of a stochastic trigger silence is what was expected, with R + 1/Z.
    """

    def __init__(
        self, transition: Any, process: Any, mean: Any, start: Any, rows: Any, noise: Any,
        limits: tuple[Any, Any] | None = None, weight: Any = None,
    ) -> None:  # fmt: skip
        mp.dps = DIGITS
        self.transition, self.process = exact(transition), exact(process)
        self.mean, self.covariance = exact(mean), exact(start)
        self.rows, self.noise, self.limits = exact(rows), exact(noise), limits
        self.weight = None if weight is None else exact(weight)

    def step(self, measurement: Any, granted: Any) -> None:
        """Predict, then take the granted (sensors,) of the measurements (sensors, m)."""
        a = self.transition
        self.mean = a @ self.mean
        self.covariance = a @ self.covariance @ a.T + self.process
        self.take(measurement, granted)

    def take(self, measurement: Any, granted: Any) -> None:
        """Take the granted (sensors,) of the measurements (sensors, m)."""
        sensors, channels, _ = self.rows.shape
        arrived = np.repeat(granted, channels)
        taken = np.flatnonzero(arrived | (self.weight is not None))
        if not taken.size:
            return
        rows = self.rows.reshape(sensors * channels, -1)[taken]
        noise = self.noise[np.ix_(taken, taken)].copy()
        expected = rows @ self.mean
        if self.limits is not None:
            for place, channel in enumerate(taken.tolist()):
                low, high = (float(np.ravel(limit)[channel]) for limit in self.limits)
                q, mean, ratio = tobit(expected[place], noise[place, place], low, high)
                rows[place] = rows[place] * q
                expected[place], noise[place, place] = mean, noise[place, place] * ratio
        value = np.where(arrived[taken], exact(np.ravel(measurement)[taken]), expected)
        if self.weight is not None:
            places = np.flatnonzero(~arrived)
            noise[places, places] += 1 / np.repeat(self.weight, channels)[places]
        cross = rows @ self.covariance
        gain = solve(cross @ rows.T + noise, cross).T
        self.mean = self.mean + gain @ (value - expected)
        covariance = self.covariance - gain @ cross
        self.covariance = (covariance + covariance.T) / 2


def tobit(latent: Any, variance: Any, low: float, high: float) -> tuple[Any, Any, Any]:
    """q, ŷ and v of z ~ N(latent, variance) seen as clip(z, low, high).

    q is the probability of an uncensored value, v the variance of z given that, over its variance.
    """
    root = mp.sqrt(variance)
    a, b = (mpf(low) - latent) / root, (mpf(high) - latent) / root
    below, above = (mp.erfc(x / mp.sqrt(2)) / 2 for x in (-a, b))
    q = mpf(1) - below - above
    if abs(a) > 1 and q < mpf(1) / 4:  # the difference of two tails
        side = (a, b) if a > 0 else (-b, -a)
        q = (mp.erfc(side[0] / mp.sqrt(2)) - mp.erfc(side[1] / mp.sqrt(2))) / 2
    at_low, at_high = (mp.npdf(x) if mp.isfinite(x) else mpf(0) for x in (a, b))
    hazard = (at_low - at_high) / q
    edges = sum(
        sign * x * density
        for sign, x, density in ((1, a, at_low), (-1, b, at_high))
        if mp.isfinite(x)
    )
    ratio = 1 + edges / q - hazard * hazard
    value = q * (latent + root * hazard)
    value += sum(
        share * mpf(limit) for share, limit in ((below, low), (above, high)) if abs(limit) < 1e300
    )
    return q, value, ratio


def after_silence(horizon: int, step: int, sensors: int, runs: int) -> NDArray[np.bool_]:
    """Requests (sensors, N) of runs that are silent at first, the longer the later; then of one
    sensor, then of all."""
    first = (horizon - 3) * np.arange(1, runs + 1) // runs
    alone = np.arange(sensors)[:, None] == np.arange(runs) % sensors
    return np.asarray((step > first) | ((step == first) & alone))


def largest_errors(
    task: Task, steps: int, runs: int, *, censored: bool, silent: bool = False
) -> tuple[float, float]:
    """Of variances, over each state's own, and of means, in deviations, on the same deliveries.

    ``censored`` says whether the task's filter is the Tobit Kalman filter, ``silent`` whether
    deliveries come after silence. Variances that float64 does not hold in full, below 1e-290, are
    left out.
    """
    random, batch = np.random.default_rng(0), EpisodeBatch.seeded(task, runs, seed=0)
    assert isinstance(task.plant, CensoredPlant)
    plant, sensors = task.plant.dynamics, task.plant.sensors
    filters = [
        ExactFilter(
            *(value[..., 0] for value in (plant.transition, plant.process_covariance)),
            plant.initial_mean[:, 0],
            plant.initial_covariance[..., 0],
            sensors.measurement_matrix[..., 0],
            sensors.noise_covariance[..., 0],
            limits=(sensors.threshold, sensors.upper) if censored else None,
            weight=task.settings.get("stochastic_weight"),
        )
        for _ in range(runs)
    ]
    if "joint_measurement_covariance" in task.settings:  # of LinearFusion: its start is known
        for run, one in enumerate(filters):
            one.take(batch.state.estimate.held[..., run], np.ones(task.sensors, dtype=np.bool_))
    variance_error = mean_error = mpf(0)
    for step in range(min(steps, task.horizon)):
        measurement = batch.state.plant.measurement
        requests = request(random, step, task.sensors, runs)
        if silent:
            requests = after_silence(task.horizon, step, task.sensors, runs)
        outcome = batch.step(requests)
        estimate = batch.delivered.estimate
        mean, covariance = exact(estimate.mean), exact(estimate.covariance)
        for run, one in enumerate(filters):
            one.step(measurement[..., run], outcome.granted[:, run])
            variance = np.diagonal(one.covariance)
            held = variance > mpf(10) ** -290
            variance = variance[held]
            difference = np.abs(np.diagonal(covariance[..., run])[held] - variance)
            variance_error = max([variance_error, *(difference / variance)])
            deviation = np.array([mp.sqrt(value) for value in variance], dtype=object)
            mean_error = max([mean_error, *(np.abs(mean[:, run] - one.mean)[held] / deviation)])
    return float(variance_error), float(mean_error)
