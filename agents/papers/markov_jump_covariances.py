"""The paper's cross-covariances (46)-(50) with its own filters (14)-(22), as printed.

The environment has the exact joint covariance instead; the comparison shows the conditions of the
printed recursion.
"""

from itertools import islice, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array


def covariances(estimator: Any, sent: NDArray[np.bool_], swapped: bool) -> Array:
    """Return Σ(k) (H + 1, l n, l n) at k = 0..H; ``sent`` (H, l) are the transmissions at k = 1..H.

    Its entries are the sums (45) and (51) over the modes. ``swapped`` uses the third term of (46)
    as printed, with the indices i and j of the first; otherwise it is the transposed second term of
    the pair (j, i), which its derivation implies.
    """
    joint, states = np.array(_joint(estimator, sent, swapped)), estimator.model.plant.size
    times, count, _, size, _ = joint.shape
    modes = size // states
    blocks = joint.reshape(times, count, count, modes, states, modes, states).sum((3, 5))
    return blocks.transpose(0, 1, 3, 2, 4).reshape(times, count * states, count * states)


def fused_traces(joint: Array, states: int) -> Array:
    """Return the traces (H + 1,) of (57), (eᵀ Σ⁻¹ e)⁻¹, by pseudo-inverses of Σ (H + 1, l n, l n).

    Source: markov_jump, Algorithm 1, with (45)-(51) and (57).
    """
    symmetric = 0.5 * (joint + np.swapaxes(joint, 1, 2))
    every = np.tile(np.eye(states), (joint.shape[-1] // states, 1))
    fused = np.linalg.pinv(every.T @ np.linalg.pinv(symmetric, hermitian=True) @ every)
    return np.asarray(np.trace(fused, axis1=1, axis2=2))


def iterated_gap(estimator: Any, node: int, horizon: int) -> float:
    """Return a node's largest relative difference in covariance from an iterated synchronisation.

    The filter works at the sampling times only, with the state equation iterated from one to the
    next and the best predictor for noises that are correlated at the same time.
    """
    filters, model, sensors = estimator.filters, estimator.model, estimator.model.sensors
    row, unfaded, noise = model.faded[node], model.unfaded[node], model.plant.noise_covariance
    coupling, period = sensors.noise_coupling[node, :, 0], int(sensors.period[node, 0])
    steps = list(islice(model.steps(), horizon + 1))
    powers = [np.linalg.matrix_power(model.transition, n) for n in range(period, -1, -1)]
    prior, gaps = steps[0].moment - np.outer(steps[0].mean, steps[0].mean), []
    for time in range(0, horizon + 1 - period, period):
        fading = sensors.fading_variance[node] * (unfaded @ steps[time].moment @ unfaded)
        own = coupling @ noise @ coupling + sensors.variance[node, 0] + fading
        scale = (time > 0) / np.sqrt(row @ prior @ row + own)
        gain, entry = scale * (prior @ row), scale * (steps[time].input @ noise @ coupling)
        exact = filters.covariance[node, node, ..., filters.at(np.array([time]))[0]]
        gaps.append(np.abs(prior - np.outer(gain, gain) - exact).max() / np.abs(exact).max())
        stride = powers[0] @ gain + powers[1] @ entry
        prior = powers[0] @ prior @ powers[0].T - np.outer(stride, stride)
        for power, step in zip(powers[1:], steps[time : time + period], strict=True):
            driven = step.input @ noise @ step.input.T + step.additional
            prior += power @ driven @ power.T
    return float(max(gaps))


def _joint(estimator: Any, sent: NDArray[np.bool_], swapped: bool) -> list[Array]:
    """Return P_ij (l, l, a, a) of the copies at k = 0..H."""
    filters, model = estimator.filters, estimator.model
    moved, faded = model.transition, model.faded
    shared = model.sensors.noise_coupling[..., 0] @ model.plant.noise_covariance  # S_wv
    noise = shared @ model.sensors.noise_coupling[..., 0].T  # R_ij, i != j
    count, size = len(faded), model.size
    steps = [step for _, step in zip(range(len(sent) + 1), model.steps(), strict=False)]
    start = steps[0].moment - np.outer(steps[0].mean, steps[0].mean)
    everyone = np.vstack((np.ones((1, count), bool), sent))
    filtered = np.tile(start, (count, count, 1, 1))
    crossed = np.zeros((count, count, size, len(model.plant.noise_covariance)))  # P_ςi wj
    noises = np.tile(model.plant.noise_covariance, (count, count, 1, 1))
    result = [filtered]
    for time, (before, _) in enumerate(pairwise(steps), start=1):
        entry = before.input
        place = int(filters.at(np.array([time]))[0])
        gain, own = filters.gain[..., place], filters.noise_gain[..., place]
        exact = filters.covariance[..., place]
        old = crossed, filtered, noises
        filtered, crossed, noises = np.empty_like(filtered), np.zeros_like(crossed), noises.copy()
        for i in range(count):
            for j in range(count):
                cross, second, white = (from_sample[i, j] for from_sample in old)
                third = cross.T if swapped and i != j else old[0][j, i].T
                ahead = (
                    moved @ second @ moved.T + moved @ cross @ entry.T + entry @ third @ moved.T
                    + entry @ white @ entry.T + before.additional
                )  # fmt: skip
                a, b = float(everyone[time, i]), float(everyone[time, j])
                if i == j:  # Theorem 2, with (12)-(22) where the node was sent
                    filtered[i, i] = exact[i, i] if a else ahead
                    observed = _prior(estimator, place, i) @ faded[i]
                    crossed[i, i] = -a * np.outer(observed, own[i])
                    variance = filters.innovation_covariance[i, i, place]
                    noises[i, i] = model.plant.noise_covariance - a * variance * np.outer(
                        own[i], own[i]
                    )
                    continue
                keep_i = np.eye(size) - a * np.outer(gain[i], faded[i])
                keep_j = np.eye(size) - b * np.outer(gain[j], faded[j])
                filtered[i, j] = keep_i @ ahead @ keep_j.T
                filtered[i, j] += a * b * noise[i, j] * np.outer(gain[i], gain[j])
                crossed[i, j] = (
                    -b * np.outer(keep_i @ ahead @ faded[j], own[j])
                    - a * np.outer(gain[i], shared[i])
                    + a * b * noise[i, j] * np.outer(gain[i], own[j])
                )
                noises[i, j] = (
                    model.plant.noise_covariance
                    - b * np.outer(shared[j], own[j])
                    - a * np.outer(own[i], shared[i])
                    + a * b * (faded[i] @ ahead @ faded[j] + noise[i, j]) * np.outer(own[i], own[j])
                )
        result.append(filtered)
    return result


def _prior(estimator: Any, place: int, node: int) -> Array:
    """Return P_i(k|k-1) from (19): P(k|k) = (I - K c) P(k|k-1), equal without a sample."""
    filters, model = estimator.filters, estimator.model
    keep = np.eye(model.size) - np.outer(filters.gain[node, :, place], model.faded[node])
    return np.asarray(np.linalg.solve(keep, filters.covariance[node, node, ..., place]))
