"""The unknown-input environment: against a plain loop, its options, its errors, its invariances."""

from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray
from parts import Parts
from reference_markov_jump import root
from scipy.linalg import null_space
from scipy.special import ndtr

from fusion_gym.envs.registration import make_task
from fusion_gym.fusion.several import covariance_intersection_many
from fusion_gym.systems.unknown_input.environment import EXAMPLES, two_carts

build = partial(make_task, "fusion_gym/UnknownInput-v1")

Array = NDArray[np.float64]
CARTS = EXAMPLES["two_carts"]


# --- a plain loop, one run at a time -------------------------------------------------------------


def reference(
    kind: str, start: Array, noise: Array, requests: NDArray[np.bool_], hold: float | None = None
) -> tuple[Array, Array, Array, Array, Array]:
    """Truth (T, 5), node means (T, 3, 5), node covariances, fused covariance, held."""
    a1, b1, w1 = two_carts()
    a, b, w = a1 @ a1, a1 @ b1 + b1, a1 @ w1 @ a1.T + w1
    cs = np.array(CARTS["measurement_matrices"])
    vs = [np.diag(v) for v in CARTS["measurement_covariance"]]
    factor = root(w)
    x = np.sqrt(0.1) * start[:4]
    held = [cs[i] @ x + np.sqrt(vs[i]) @ start[4 + 2 * i : 6 + 2 * i] for i in range(3)]
    phase = 2 * np.pi * ndtr(start[10:])
    f = np.block([[a, 0.9 * b], [np.zeros((1, 4)), 0.9 * np.eye(1)]])
    lift = np.concatenate((b, np.eye(1)))
    q = 0.09 * lift @ lift.T
    q[:4, :4] += w
    mean = np.zeros((3, 5))
    cov = np.tile(np.diag([0.1, 0.1, 0.1, 0.1, 0.49]), (3, 1, 1))
    rho, e, rows = 0.09, 0.2, []
    for k in range(len(noise)):
        d = np.array([0.8, 0.6]) @ np.sin(2 * np.pi * k / np.array([60.0, 25.0]) + phase)
        x = a @ x + b[:, 0] * d + factor @ noise[k, :4]
        for i in range(3):
            c, v = cs[i], vs[i]
            y = c @ x + np.sqrt(v) @ noise[k, 4 + 2 * i : 6 + 2 * i]
            if requests[k, i]:
                held[i] = y
            ahead, prior = f @ mean[i], f @ cov[i] @ f.T + q
            if kind == "random_walk":
                if not requests[k, i] and hold is None:
                    mean[i], cov[i] = ahead, prior
                    continue
                h = np.concatenate((c, np.zeros((2, 1))), axis=1)
                extra = 0.0 if requests[k, i] else hold
                gain = prior @ h.T @ np.linalg.inv(h @ prior @ h.T + v + extra * np.eye(2))
                mean[i] = ahead + gain @ (held[i] - h @ ahead)
                cov[i] = (np.eye(5) - gain @ h) @ prior
                continue
            paper = kind == "paper"
            if not requests[k, i] and not paper:
                mean[i], cov[i] = ahead, prior
                continue
            grow = 1 + e if paper else 1.0
            phi = grow * (a @ cov[i][:4, :4] @ a.T + w)
            r = grow * v + (1 + 1 / e) * rho * np.eye(2) * paper
            omega, observed = c @ phi @ c.T + r, c @ b
            inverse = np.linalg.inv(omega)
            left = np.linalg.inv(observed.T @ inverse @ observed) @ observed.T @ inverse
            u = null_space(observed.T)
            n = b @ left
            n = n + (phi @ c.T - n @ omega) @ u @ np.linalg.inv(u.T @ omega @ u) @ u.T
            surprise = held[i] - c @ a @ mean[i][:4]
            mean[i] = np.concatenate((a @ mean[i][:4] + n @ surprise, left @ surprise))
            retention = np.concatenate((np.eye(4) - n @ c, -left @ c))
            both = np.concatenate((n, left))
            cov[i] = retention @ phi @ retention.T + both @ r @ both.T
        rows.append((np.append(x, d), mean.copy(), cov.copy(), np.array(held)))
    truth, means, covariances, stored_values = zip(*rows, strict=True)
    return (*(np.array(row) for row in (truth, means, covariances, stored_values)),)  # type: ignore[return-value]


@pytest.mark.parametrize(
    ("kind", "hold"),
    [("random_walk", None), ("random_walk", 0.05), ("predict", None), ("paper", None)],
)
def test_library_and_plain_loop_walk_the_same_trajectories(kind: str, hold: float | None) -> None:
    system = Parts.of(build(filter=kind, hold_variance=hold, fusion="exact_ci"))
    runs, steps = 3, 100
    draw = np.random.default_rng(8)
    start = draw.standard_normal((system.plant.start_channels, runs))
    noise = draw.standard_normal((steps, system.plant.noise_channels, runs))
    requests = draw.random((steps, 3, runs)) < 0.4
    state = system.start(start)
    result = []
    for step in range(steps):
        state = system.sense(state, noise[step])
        state = system.deliver(state, requests[step])
        mean, fused = system.fused(state)
        held = state.estimate.held
        result.append(
            (system.truth(state), system.estimator.local_means(state.estimate), held, mean, fused)
        )
    truths, means, helds, fused_means, fused_covariances = (
        np.array(row) for row in zip(*result, strict=True)
    )
    for run in range(runs):
        truth, mean, covariance, held = reference(
            kind, start[:, run], noise[..., run], requests[..., run], hold
        )
        np.testing.assert_allclose(truths[..., run], truth, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(means[..., run], mean, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(helds[..., run], held, rtol=1e-8, atol=1e-8)
        # The centre: covariance intersection of what the loop has, state and input apart.
        columns = np.ascontiguousarray(np.moveaxis(covariance, 0, -1))
        others = np.ascontiguousarray(np.moveaxis(mean, 0, -1))
        joined = covariance_intersection_many(others[:, :4], columns[:, :4, :4])
        x, p = joined.mean, joined.covariance
        np.testing.assert_allclose(fused_covariances[:, :4, :4, run].transpose(1, 2, 0), p, 1e-4)
        np.testing.assert_allclose(fused_means[:, :4, run].T, x, rtol=1e-2, atol=1e-2)
        least = columns[:, 4, 4].min(0)
        np.testing.assert_allclose(fused_covariances[:, 4, 4, run], least, rtol=1e-6)
