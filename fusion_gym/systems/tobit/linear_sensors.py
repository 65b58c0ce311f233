"""The sensors of a linear system of your own, from plain lists: each has its own size."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.systems.tobit.sensors import CensoredSensors

_JOINT = "joint_measurement_covariance"


def linear_sensors(
    states: int, matrices: Any, covariances: Any, joint: Any, threshold: Any, upper: Any
) -> CensoredSensors:
    """Return sensors with the channels of the largest; the last channels of the others are absent.

    A sensor whose own covariance R is not diagonal reports F⁻¹ y with F Fᵀ = R.

    Args:
        states: number of states n.
        matrices: C of each sensor, (channels, n) or one row (n,).
        covariances: R of each sensor, for independent sensors.
        joint: covariance of all channels of all sensors, or None.
        threshold: lower limits: one number, one per sensor, or a list for each sensor.
        upper: upper limits, in the same form.

    Raises:
        ConfigurationError: a value that is not allowed, or censoring of correlated sensors.
    """
    rows = _matrices(matrices, states)
    sizes = [len(row) for row in rows]
    shape = (len(sizes), max(sizes))
    low = _limits("censoring_threshold", threshold, sizes, -np.inf)
    high = _limits("censoring_upper", upper, sizes, np.inf)
    present = np.arange(shape[1]) < np.array(sizes)[:, None]
    whole = None
    if joint is None:
        own = _covariances(covariances, sizes)
    else:
        whole = validation.covariance(_JOINT, joint, sum(sizes), definite=True)
        ends = np.cumsum(sizes)
        own = [whole[end - n : end, end - n : end] for n, end in zip(sizes, ends, strict=True)]
    limited = [bool(np.isfinite(ends).any()) for ends in np.concatenate([low, high], axis=1)]
    matrix, variance, factors = np.zeros((*shape, states)), np.ones(shape), []
    for place, (size, covariance) in enumerate(zip(sizes, own, strict=True)):
        factor: Array = np.eye(size)
        variances = np.diagonal(covariance)
        if np.count_nonzero(covariance - np.diag(variances)):
            if limited[place]:
                name = f"measurement_covariances[{place}]" if whole is None else _JOINT
                allowed = f"diagonal for the censored sensor {place}"
                raise validation.refusal(name, covariance, allowed)
            factor, variances = linalg.cholesky(covariance[..., None])[..., 0], np.ones(size)
        matrix[place, :size] = np.linalg.solve(factor, rows[place])
        variance[place, :size] = variances
        factors.append(factor)
    sensors = CensoredSensors.create(matrix, variance, low, states, high, present)
    if whole is None or not np.count_nonzero(whole - block_diag(*own)):
        return sensors
    if any(limited):
        allowed = "without correlations between sensors, because some are censored"
        raise validation.refusal(_JOINT, joint, allowed)
    scale = block_diag(*factors) * np.sqrt(variance[present])
    factor, places = np.eye(present.size), np.flatnonzero(present)
    factor[np.ix_(places, places)] = np.linalg.solve(scale, np.linalg.cholesky(whole))
    return replace(sensors, noise_correlation=factor[..., None])


def _matrices(value: Any, states: int) -> list[Array]:
    result = []
    for place, item in enumerate(_each("measurement_matrices", value, "a matrix")):
        name = f"measurement_matrices[{place}]"
        row = _dimensions(item) == 1
        matrix = validation.array(name, item, (states,) if row else (None, states))
        result.append(matrix[None] if row else matrix)
    return result


def _covariances(values: Any, sizes: Sequence[int]) -> list[Array]:
    name, count = "measurement_covariances", len(sizes)
    single = _dimensions(values) == 0
    each = [values] * count if single else _each(name, values, "a covariance or a variance", count)
    result = []
    for place, (size, value) in enumerate(zip(sizes, each, strict=True)):
        full = name if single else f"{name}[{place}]"
        if _dimensions(value) == 0:
            value = validation.number(full, value, above=0.0) * np.eye(size)
        result.append(validation.covariance(full, value, size, definite=True))
    return result


def _limits(name: str, values: Any, sizes: Sequence[int], none: float) -> Array:
    """Return limits (sensors, m); absent channels have the limit ``none``."""
    item = _dimensions(values) == 0
    each = [values] * len(sizes) if item else _each(name, values, "a number or a list", len(sizes))
    result = np.full((len(sizes), max(sizes)), none)
    for place, (size, value) in enumerate(zip(sizes, each, strict=True)):
        full = name if item else f"{name}[{place}]"
        result[place, :size] = validation.spread(full, value, (size,), infinity=int(np.sign(none)))
    return result


def _each(name: str, value: Any, kind: str, count: int | None = None) -> list[Any]:
    """Return the entry of each sensor."""
    listed = isinstance(value, (list, tuple)) or (isinstance(value, np.ndarray) and value.ndim > 0)
    if not listed or not len(value) or (count is not None and len(value) != count):
        many = "each sensor" if count is None else f"each of the {count} sensors"
        raise validation.refusal(name, value, f"a list with {kind} for {many}")
    return list(value)


def _dimensions(value: Any) -> int:
    """Return the depth of a nested value, by its first entries."""
    if isinstance(value, np.ndarray):
        return value.ndim
    depth = 0
    while isinstance(value, (list, tuple)):
        depth, value = depth + 1, value[0] if value else 0.0
    return depth + (value.ndim if isinstance(value, np.ndarray) else 0)
