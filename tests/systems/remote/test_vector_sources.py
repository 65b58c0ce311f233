"""Vector sources of remote estimation, against separate Kalman filters."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError

Array = NDArray[Any]
ENV = "fusion_gym/RemoteEstimation-v1"
CART: dict[str, Any] = {
    "transition": [[1.0, 0.1], [0.0, 1.0]],
    "process_covariance": [[0.01, 0.0], [0.0, 0.1]],
    "measurement_matrix": [[1.0, 0.0]],
    "measurement_covariance": 0.25,
}
ROOM: dict[str, Any] = {
    "transition": [[0.9]],
    "process_covariance": [[1.0]],
    "measurement_matrix": [[1.0], [0.5]],
    "measurement_covariance": [[0.2, 0.1], [0.1, 0.4]],
}
SPIN: dict[str, Any] = {
    "transition": [[0.9, 0.4, 0.0], [-0.4, 0.9, 0.0], [0.0, 0.1, 0.8]],
    "process_covariance": np.diag([0.3, 0.2, 0.1]).tolist(),
    "measurement_matrix": [1.0, 0.0, 1.0],
    "measurement_covariance": 1.0,
}
THREE = [CART, ROOM, SPIN]


def make(**options: Any) -> Task:
    """Three sources of different sizes, unless the options say otherwise."""
    return fusion_gym.make_task(ENV, **{"sources": THREE, "horizon": 30} | options)


class Filter:
    """A Kalman filter of one source in one run, and the centre's copy of it."""

    def __init__(self, source: dict[str, Any]) -> None:
        self.a = np.array(source["transition"])
        self.w = np.array(source["process_covariance"])
        self.c = np.atleast_2d(source["measurement_matrix"])
        self.r = np.atleast_2d(source["measurement_covariance"])
        size = len(self.a)
        self.covariance = np.eye(size)
        for _ in range(3000):
            self.covariance = self.corrected(self.a @ self.covariance @ self.a.T + self.w)
        self.node, self.centre = np.zeros(size), np.zeros(size)
        self.spread = self.covariance

    def corrected(self, prior: Array) -> Array:
        """The covariance after a measurement."""
        gain = prior @ self.c.T @ np.linalg.inv(self.c @ prior @ self.c.T + self.r)
        return np.asarray(prior - gain @ self.c @ prior)

    def step(self, measurement: Array, arrived: bool) -> None:
        """Predict, measure, and receive or not."""
        prior = self.a @ self.covariance @ self.a.T + self.w
        gain = prior @ self.c.T @ np.linalg.inv(self.c @ prior @ self.c.T + self.r)
        self.node = self.a @ self.node
        self.node = self.node + gain @ (measurement - self.c @ self.node)
        self.centre, self.spread = self.a @ self.centre, self.a @ self.spread @ self.a.T + self.w
        if arrived:
            self.centre, self.spread = self.node, self.covariance


def test_estimates_and_covariances_are_those_of_separate_kalman_filters() -> None:
    """By age, with losses, for sources of different sizes."""
    task = make(channel="independent", drop_probability=0.3)
    batch, filters = EpisodeBatch.seeded(task, 1, 4), [Filter(source) for source in THREE]
    ends = np.cumsum([len(item.a) for item in filters])
    rng = np.random.default_rng(0)
    for _ in range(30):
        measured = batch.state.plant.measurement[..., 0]
        arrived = batch.step(rng.random((3, 1)) < 0.5).arrived[:, 0]
        estimate = batch.delivered.estimate
        mean, covariance = task.estimator.mean(estimate), task.estimator.covariance(estimate)
        expected = np.zeros(covariance.shape[:2])
        for item, end, seen, fresh in zip(filters, ends, measured, arrived, strict=True):
            item.step(seen[: len(item.r)], bool(fresh))
            own = slice(end - len(item.a), end)
            expected[own, own] = item.spread
            np.testing.assert_allclose(mean[own, 0], item.centre, atol=1e-11)
        np.testing.assert_allclose(covariance[..., 0], expected, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("options", [{}, {"sources": (4, 3)}])
def test_the_error_is_the_trace(options: dict[str, Any]) -> None:
    """Of each state, if the requests depend on no measurement."""
    task = make(channel="gilbert_elliott", **options)
    results = run_episodes(task, make_policy("random:rate=0.4", task), 3000)
    batch, policy = EpisodeBatch.seeded(task, 3000, 9), make_policy("random:rate=0.4", task)
    policy.reset(3000, 1)
    traces = 0.0
    for _ in range(30):
        batch.step(policy(batch.signals()))
        traces += np.einsum("iir->r", task.estimator.covariance(batch.delivered.estimate)) / 30
    spread = (results.mse.std() ** 2 + np.std(traces) ** 2) ** 0.5 / 3000**0.5
    assert results.mse.mean() == pytest.approx(np.mean(traces), abs=4.0 * spread)
    assert results.nees.mean() == pytest.approx(1.0, abs=0.03)


def test_a_scalar_source_with_an_exact_sensor_is_todays() -> None:
    """To the noise of the sensor: the same errors, ages and signals."""
    source = {"transition": [[0.9]], "process_covariance": [[4.0]]} | {
        "measurement_matrix": [[1.0]],
        "measurement_covariance": 1e-12,
    }
    tasks = [make(sources=[source]), make(sources=None, coefficient=0.9, noise_deviation=2.0)]
    results = [run_episodes(task, make_policy("random:rate=0.3", task), 4000) for task in tasks]
    means = [item.mse.mean() for item in results]
    assert means[0] == pytest.approx(means[1], rel=0.03)
    for _ in range(5):
        batches = [EpisodeBatch.seeded(task, 3, 0) for task in tasks]
        for requests in np.random.default_rng(1).random((10, 1, 3)) < 0.3:
            first, second = (batch.step(requests) for batch in batches)
            np.testing.assert_array_equal(first.granted, second.granted)
            signals = [batch.signals() for batch in batches]
            for name in ("age", "variance_reduction", "silent_variance"):
                np.testing.assert_allclose(*(part[name] for part in signals), atol=1e-6)


def test_vector_sources_run_in_compiled_code() -> None:
    pytest.importorskip("llvmlite")
    batches = [EpisodeBatch.seeded(make(backend=kind), 3, 0) for kind in ("numpy", "compiled")]
    for requests in np.random.default_rng(1).random((8, 3, 3)) < 0.4:
        first, second = (batch.step(requests) for batch in batches)
        np.testing.assert_allclose(first.error, second.error, atol=1e-12)
        np.testing.assert_allclose(*(batch.observe() for batch in batches), atol=1e-6)


def test_a_true_plant_may_depart_from_the_model() -> None:
    wrong = make(true_process_noise=2.0, true_measurement_noise=(0.5, 2.0), true_transition=0.95)
    results = run_episodes(wrong, make_policy("always", wrong), 300)
    assert results.nees.mean() > 1.3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sources": 3}, r"sources = 3 .* a list of mappings"),
        ({"sources": []}, r"sources = \[\]"),
        ({"sources": (0, 1)}, r"sources = 0 .* >= 1"),
        ({"sources": [CART | {"gain": 1}]}, r"sources\[0\] .* keys"),
        ({"sources": [ROOM, CART | {"transition": [[1.0, 0.1]]}]}, r"sources\[1\]\['transition'\]"),
        ({"sources": [CART | {"measurement_matrix": [1.0]}]}, r"\['measurement_matrix'\]"),
        ({"sources": [CART | {"measurement_covariance": 0.0}]}, r"\['measurement_covariance'\]"),
        ({"sources": [CART | {"process_covariance": -np.eye(2)}]}, r"\['process_covariance'\]"),
        (
            {"sources": [CART | {"measurement_matrix": [[0.0, 1.0]]}]},
            r"sources\[0\] .* measure every growing state",
        ),
        ({"coefficient": 0.9}, r"coefficient = 0.9 .* scalar sources"),
        ({"filter": "truncated", "trigger": "send_on_delta"}, r"filter = 'truncated' .* scalar"),
        ({"packet": "estimate", "memory": True}, "packet = 'estimate'"),
        ({"state_weights": (1.0, 2.0)}, "state_weights"),
        ({"true_threshold_shift": 0.1}, "true_threshold_shift"),
    ],
)
def test_what_is_no_source_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        make(**options)


@pytest.mark.parametrize("policy", ["optimal", "whittle"])
def test_solvers_of_scalar_sources_refuse_vectors(policy: str) -> None:
    with pytest.raises(ConfigurationError, match=r"VectorSources|vector sources"):
        make_policy(policy, make())
