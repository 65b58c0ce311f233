"""The recursion (17)-(20) of unknown_input as printed, and its readings."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from fusion_gym.arrays import Array
from fusion_gym.entries import Options, Plain
from fusion_gym.systems.unknown_input.system import DrivenPlant

# I - C ℬ L in (20) is a projection, its singular values are 0 or at least 1: what lies between is
# rounding, and half a 1 tells one from the other.
EXACT_CUTOFF = 0.5
UNKNOWN_INPUT_READINGS: dict[str, Options] = {
    "(20), rounding set to zero": {},
    "(20), rounding inverted by the pseudo-inverse": {"cutoff": 0.0},
    "(20), rounding above 1e-8 inverted": {"cutoff": 1e-8},
    "every step sampled, a = 1": {"options": {"sampling_period": 1}},
    "0.001 as standard deviations": {
        "options": {
            "process_covariance": ((1e-6, 0.0), (0.0, 1e-6)), "measurement_covariance": 1e-6,
        }
    },
    "everything transmitted": {"policy": "always"},
}  # fmt: skip


class Model(NamedTuple):
    """𝒜, ℬ, 𝒲 of the lifted plant and C, V of one node, ε, ρ̄, x(0) and Ξ(0); no batch axis."""

    transition: Array
    inputs: Array
    process: Array
    matrix: Array
    noise: Array
    factor: float
    rho_bar: float
    mean: Array
    covariance: Array


def models(plant: DrivenPlant, factor: float, rho_bar: float) -> list[Model]:
    """Return the model of every node."""
    dynamics, sensors = plant.dynamics, plant.sensors
    lifted = (dynamics.transition, dynamics.input_matrix, dynamics.process_covariance)
    start = (dynamics.initial_mean[:, 0], dynamics.initial_covariance[..., 0])
    measured = zip(sensors.measurement_matrix[..., 0], sensors.covariance[..., 0], strict=True)
    a, b, w = (matrix[..., 0] for matrix in lifted)
    return [Model(a, b, w, c, v, factor, rho_bar, *start) for c, v in measured]


def gains(model: Model, bound: Array, silent: NDArray[np.bool_], cutoff: float) -> dict[str, Array]:
    """Return L, N, Ξ_x of (17)-(20) from the last Ξ_x (E, n, n); δ is ``silent``.

    ``best`` is the gain that minimises the same bound (18) among all that satisfy (14).
    """
    a, b, c, v = model.transition, model.inputs, model.matrix, model.noise
    eye_n, eye_m, cb = np.eye(len(a)), np.eye(len(c)), c @ b
    moved = a @ bound @ a.T
    phi = (1.0 + model.factor) * moved + model.process
    sent = np.where(silent, -1.0, 1.0)[:, None, None]  # 1 - 2 δ
    noise = sent * v + (1.0 + 1.0 / model.factor) * model.rho_bar * eye_m
    omega = c @ phi @ c.T + noise  # and Θ, for ξ = ε
    weighed = cb.T @ np.linalg.inv(omega)
    onto_input = np.linalg.solve(weighed @ cb, weighed)
    hidden = eye_m - cb @ onto_input
    k = (phi @ c.T @ np.linalg.inv(omega) - b @ onto_input) @ _pseudo_inverse(hidden, cutoff)
    gain = b @ onto_input + k @ hidden
    free = np.linalg.svd(cb)[0][:, cb.shape[1] :]  # a basis of what (14) leaves free
    best = b @ onto_input
    inverse = np.linalg.inv(free.T @ omega @ free)
    best = best + (phi @ c.T - best @ omega) @ free @ inverse @ free.T

    def spread(n: Array) -> Array:
        retention = eye_n - n @ c
        return retention @ phi @ retention.swapaxes(1, 2) + n @ noise @ n.swapaxes(1, 2)

    return {
        "input": onto_input, "gain": gain, "best": best, "state_bound": spread(gain),
        "best_bound": spread(best),
    }  # fmt: skip


def _pseudo_inverse(matrix: Array, cutoff: float) -> Array:
    left, values, right = np.linalg.svd(matrix)
    mask = values > cutoff
    inverted = np.where(mask, 1.0 / np.where(mask, values, 1.0), 0.0)
    return (right.swapaxes(1, 2) * inverted[:, None]) @ left.swapaxes(1, 2)


def run(model: Model, held: Array, granted: NDArray[np.bool_], cutoff: float) -> dict[str, Array]:
    """Run a node's filter (8) on held measurements (H, m, E); times first, episodes second.

    ``estimate`` (H, s, E), ``trace`` (H, E) of Ξ_x, ``least`` (H, E) the smallest eigenvalue of
    Ξ_x, ``hidden`` (H, E) the largest entry of ℬ - N C ℬ (14), and ``excess`` (H, E) the ratio of
    the trace of (18) to the trace under the best gain.
    """
    episodes = held.shape[-1]
    mean = np.broadcast_to(model.mean, (episodes, len(model.mean)))
    bound = np.broadcast_to(model.covariance, (episodes, *model.covariance.shape))
    names = ("estimate", "trace", "least", "hidden", "excess")
    rows = []
    b, c = model.inputs, model.matrix
    for measurement, sent in zip(held, granted, strict=True):
        result = gains(model, bound, ~sent, cutoff)
        moved = mean @ model.transition.T
        apart = (measurement.T - moved @ c.T)[..., None]
        mean = moved + (result["gain"] @ apart)[..., 0]
        bound = result["state_bound"]
        least = np.linalg.eigvalsh(0.5 * (bound + bound.swapaxes(1, 2)))[:, 0]
        trace, best = (np.trace(result[name], axis1=1, axis2=2) for name in _TRACES)
        estimate = np.concatenate((mean, (result["input"] @ apart)[..., 0]), axis=1)
        hidden = np.abs(b - result["gain"] @ c @ b).max((1, 2))
        rows.append((estimate.T, trace, least, hidden, trace / best - 1.0))
    return dict(zip(names, map(np.array, zip(*rows, strict=True)), strict=True))


_TRACES = ("state_bound", "best_bound")


def decoupling(paper: DrivenPlant, every_step: DrivenPlant) -> Plain:
    """Return rank and columns of C ℬ with ℬ as (3) prints it, for a = 2, and error bounds.

    ``conditions`` are the condition numbers of the C_i and of B, ``floor`` the result of
    :func:`_floor`.
    """
    single = every_step.dynamics
    a, b = single.transition[..., 0], single.input_matrix[..., 0]
    lifted = block_diag(np.hstack((a @ b, b)), np.hstack((b, 0.0 * b)))
    each = paper.sensors.measurement_matrix[..., 0]
    observed = np.hstack((each[0], 0.0 * each[0])) @ lifted
    return {
        "rank": int(np.linalg.matrix_rank(observed)), "columns": int(observed.shape[1]),
        "conditions": [float(np.linalg.cond(m)) for m in (*each, b)],
        "floor": _floor(paper),
    }  # fmt: skip


def _floor(plant: DrivenPlant) -> list[list[float]]:
    """Return mean squared errors (l, 2) of C⁻¹ y, the only estimate that (14) allows."""
    result = []
    for a, b, w, c, v, *_ in models(plant, 1.0, 0.0):
        spread = np.linalg.inv(c) @ v @ np.linalg.inv(c).T
        into = np.linalg.inv(b)
        inputs = into @ (spread + a @ spread @ a.T + w) @ into.T
        result.append([float(np.trace(spread)), float(np.trace(inputs))])
    return result
