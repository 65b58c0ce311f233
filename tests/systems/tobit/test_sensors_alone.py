"""Sensors without feedback: an independent filter of each one's own deliveries."""

from typing import Any

import numpy as np
import pytest

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.envs.views import make_view

LINEAR, RECORDED = "fusion_gym/LinearFusion-v2", "fusion_gym/RecordedFusion-v1"
MIXED = {
    "transition": [[0.9, 0.2], [-0.1, 0.8]],
    "process_covariance": [[0.4, 0.1], [0.1, 0.3]],
    "initial_mean": [2.0, -1.0],
    "initial_covariance": [[0.0, 0.0], [0.0, 0.5]],
    "measurement_matrices": [[1, 0], [[0, 1], [1, 1]], [1, -1]],
    "measurement_covariances": [0.2, [[0.3, 0.0], [0.0, 0.2]], 0.1],
}
CORRELATED = {"joint_measurement_covariance": [[1.0, 0.5], [0.5, 1.0]]}


@pytest.mark.parametrize(
    ("env_id", "options"),
    [(LINEAR, {}), (LINEAR, MIXED), (LINEAR, CORRELATED), (RECORDED, {})],
    ids=["default", "mixed", "correlated", "recorded"],
)
def test_an_innovation_is_that_of_a_filter_of_the_own_deliveries(
    env_id: str, options: dict[str, Any]
) -> None:
    """Steps from one update to the next; the centre is that of ``filter="joint"``, bitwise."""
    task, joint = (
        fusion_gym.make_task(env_id, filter=kind, tokens="unlimited", **options)
        for kind in ("local", "joint")
    )
    draw, plant = np.random.default_rng(0), task.plant
    batch, other = EpisodeBatch.seeded(task, 4, 0), EpisodeBatch.seeded(joint, 4, 0)
    assert batch.task.broadcast == "none"
    dynamics, sensors = plant.dynamics, plant.sensors  # type: ignore[attr-defined]
    A, W = dynamics.transition[..., 0], dynamics.process_covariance[..., 0]
    C, R = sensors.measurement_matrix[..., 0], sensors.variance[..., 0]
    mean: Any = np.array([[dynamics.initial_mean[:, 0]] * 4] * len(C))
    covariance: Any = np.array([[dynamics.initial_covariance[..., 0]] * 4] * len(C))
    reading, sent = batch.state.estimate.held, np.ones((len(C), 4), dtype=np.bool_)
    if env_id == RECORDED:  # whose level was the same a step before
        noise: Any = task.noise
        sent = np.isfinite(noise.start_rows[:4, 2 * len(A) : -1]).T
        assert not sent.all()
    for _ in range(25):
        for i, run in np.ndindex(len(C), 4):
            P = covariance[i, run]
            S = C[i] @ P @ C[i].T + np.diag(R[i])
            K = P @ C[i].T @ np.linalg.inv(S) * sent[i, run]
            mean[i, run] += K @ np.nan_to_num(reading[i, :, run] - C[i] @ mean[i, run])
            covariance[i, run] = P - K @ S @ K.T
            mean[i, run] = A @ mean[i, run]
            covariance[i, run] = A @ covariance[i, run] @ A.T + W
        signals = batch.signals()
        state = batch.state.estimate
        reading = state.measurement
        if state.available is not None:
            reading = np.where(state.available[:, None], reading, np.nan)
        expected = np.einsum("imn,irn->imr", C, mean)
        spread = np.einsum("imn,irnk,imk->imr", C, covariance, C) + R[..., None]
        np.testing.assert_allclose(signals["innovation_deviation"], spread**0.5, rtol=1e-9)
        known = np.isfinite(reading)
        np.testing.assert_allclose(
            signals["innovation"][known],
            (reading - expected)[known],
            atol=1e-9 * spread.max() ** 0.5,
        )
        requests = (draw.random((task.sensors, 4)) < 0.3) & known[:, 0]
        sent = requests
        batch.step(requests)
        other.step(requests)
        fused, same = batch.delivered.estimate, other.delivered.estimate
        assert np.array_equal(fused.mean, same.mean)
        assert np.array_equal(fused.covariance, same.covariance)


def test_a_sensor_observes_what_it_computes_alone() -> None:
    task = fusion_gym.make_task(LINEAR, filter="local", budget="sensor")
    assert make_view(task, local=True).names == (
        "whitened_innovation[0]", "held_difference[0]", "age", "energy", "sensor[0]", "sensor[1]",
    )  # fmt: skip
