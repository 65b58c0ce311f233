"""What a packet holds, who receives what: the estimates against Kalman's, and what is refused."""

from typing import Any

import filterpy.kalman
import numpy as np
import pytest
from numpy.typing import NDArray

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.memory import Owner
from fusion_gym.core.task import Task
from fusion_gym.validation import ConfigurationError

TOBIT = "fusion_gym/TobitOscillator-v1"
CORRELATED = "fusion_gym/CorrelatedTracking-v1"
JUMP = "fusion_gym/MarkovJumpTracking-v1"
INPUT = "fusion_gym/UnknownInput-v1"
REMOTE = "fusion_gym/RemoteEstimation-v1"
LINEAR = {"filter": "kalman", "censoring_threshold": -np.inf, "tokens": "unlimited"}
LINEAR |= {"memory": True, "token_rate": 2.0}
RUNS, STEPS = 3, 20
Array = NDArray[Any]


class Kalman:
    """FilterPy's filter of every run, with the numbers of a task's plant and sensors."""

    def __init__(self, batch: EpisodeBatch) -> None:
        plant: Any = batch.task.plant
        model, self.sensors, estimate = plant.dynamics, plant.sensors, batch.state.estimate
        self.filters = []
        for run in range(batch.num_envs):
            item = filterpy.kalman.KalmanFilter(dim_x=model.size, dim_z=self.sensors.size)
            item.F, item.Q = np.array(model.transition)[..., 0], model.process_covariance[..., 0]
            item.x = np.array(estimate.prior_mean)[:, run]
            item.P = np.array(estimate.prior_covariance)[..., run]
            self.filters.append(item)

    def update(self, measurement: Array, taken: Array) -> tuple[Array, Array]:
        """Posterior means (n, N) and covariances (n, n, N) with what was ``taken`` (sensors, N)."""
        for run, item in enumerate(self.filters):
            for sensor in np.flatnonzero(taken[:, run]):
                noise = np.diag(np.ravel(self.sensors.variance[sensor]))
                matrix = np.array(self.sensors.measurement_matrix[sensor])[..., 0]
                item.update(measurement[sensor, :, run], R=noise, H=matrix)
        means = np.stack([item.x for item in self.filters], -1)
        return means, np.stack([item.P for item in self.filters], -1)

    def predict(self) -> None:
        """One step on."""
        for item in self.filters:
            item.predict()


def linear(owner: Owner = "scheduler", **options: Any) -> EpisodeBatch:
    """Runs of an oscillator whose sensors censor nothing."""
    task = fusion_gym.make_task(TOBIT, **LINEAR | options)
    return EpisodeBatch.seeded(task, RUNS, 5, owner)


def requests_at(batch: EpisodeBatch, rate: float = 0.15) -> Array:
    """Random requests (steps, sensors, N)."""
    return np.random.default_rng(1).random((STEPS, batch.task.sensors, RUNS)) < rate


def test_what_is_remembered_is_kalmans_estimate_from_every_measurement() -> None:
    batch = linear()
    kalman, everything = Kalman(batch), np.ones((3, RUNS), dtype=np.bool_)
    for requests in requests_at(batch):
        mean, covariance = kalman.update(batch.signals()["measurement"], everything)
        best = batch.beliefs().best
        np.testing.assert_allclose(best.mean[0], mean, rtol=1e-9)
        np.testing.assert_allclose(best.covariance[0], covariance, rtol=1e-9)
        assert (batch.signals()["belief_difference"] != 0.0).any()
        batch.step(requests)
        kalman.predict()


def test_a_sensor_that_receives_packets_has_kalmans_estimate_of_all_it_received() -> None:
    batch = linear("own", broadcast="packets")
    kalmans = [Kalman(batch) for _ in range(3)]
    for requests in requests_at(batch):
        best, measurement = batch.beliefs().best, batch.signals()["measurement"]
        for sensor, kalman in enumerate(kalmans):
            itself = np.arange(3)[:, None] == np.full(RUNS, sensor)
            mean, covariance = kalman.update(measurement, itself)
            np.testing.assert_allclose(best.mean[sensor], mean, rtol=1e-9)
            np.testing.assert_allclose(best.covariance[sensor], covariance, rtol=1e-9)
            kalman.update(measurement, requests & ~itself)
            kalman.predict()
        batch.step(requests)


def test_with_the_estimate_nothing_is_lost_by_silence() -> None:
    batch = linear(packet="estimate")
    kalman, everything, met = Kalman(batch), np.ones((3, RUNS), dtype=np.bool_), 0
    for requests in requests_at(batch):
        mean, covariance = kalman.update(batch.signals()["measurement"], everything)
        received = batch.step(requests).granted.any(0)
        result = batch.delivered.estimate
        np.testing.assert_allclose(result.mean[:, received], mean[:, received], rtol=1e-9)
        np.testing.assert_allclose(
            result.covariance[..., received], covariance[..., received], rtol=1e-9
        )
        kalman.predict()
        met += int(received.sum())
    assert met > RUNS


def test_a_single_sensor_cannot_send_the_schedulers_estimate() -> None:
    options = {"memory": True, "packet": "estimate"}
    message = "packet = 'estimate' .*local view.* 'measurement'"
    for make in (
        lambda: fusion_gym.make_sb3_vec_env(CORRELATED, 2, local=True, **options),
        lambda: fusion_gym.parallel_env(CORRELATED, **options),
        lambda: fusion_gym.make_policy(
            "value_of_information:own=true", fusion_gym.make_task(CORRELATED, **options)
        ),
    ):
        with pytest.raises(ConfigurationError, match=message):
            make()
    with pytest.raises(ConfigurationError, match=r"packet = 'estimate' .*local sensors"):
        EpisodeBatch.seeded(fusion_gym.make_task(CORRELATED, **options), 1, 0, "own")


@pytest.mark.parametrize(
    ("env_id", "broadcast"),
    [(TOBIT, "estimate"), (CORRELATED, "none"), (JUMP, "none"), (INPUT, "none"), (REMOTE, "none")],
)
def test_nodes_receive_by_default_what_the_papers_let_them_receive(
    env_id: str, broadcast: str
) -> None:
    task: Task = fusion_gym.make_task(env_id)
    assert task.broadcast == broadcast
    assert (task.options.memory, task.options.packet, task.memory_estimator) == (
        False,
        "measurement",
        None,
    )
    assert not EpisodeBatch(task, 1).memory.states
