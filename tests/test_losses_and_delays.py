"""Losses and delays of the network, against one pass over all arrivals and a Kalman filter."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.channel import Channel
from fusion_gym.core.estimator import Reception
from fusion_gym.core.network import Network
from fusion_gym.core.task import Task
from fusion_gym.envs.registration import ENVIRONMENTS
from fusion_gym.errors import ConfigurationError
from fusion_gym.evaluation import run_episodes

Array = NDArray[Any]
Options = dict[str, Any]
RUNS, STEPS = 5, 14
DELAY = (0.5, 0.2, 0.3)
FREE: dict[str, Any] = {"tokens": "unlimited", "access": "any"}
UNCENSORED = {"filter": "kalman", "censoring_threshold": -np.inf}
# A third filter of practice holds values.
SETTINGS: list[tuple[str, dict[str, Any]]] = [
    ("LinearFusion-v2", {}),
    ("LinearFusion-v2", {"filter": "hold"}),
    ("TobitOscillator-v1", {"filter": "tobit"}),
    ("TobitOscillator-v1", UNCENSORED | {"memory": True}),
    ("CorrelatedTracking-v1", {}),
    ("CorrelatedTracking-v1", {"memory": True, "fusion": "ci"}),
]


def make_task(env_id: str, options: dict[str, Any], drop: float, delay: tuple[float, ...]) -> Task:
    """A task whose network loses and delays."""
    task = fusion_gym.make_task(f"fusion_gym/{env_id}", **options | FREE)
    channel = Channel.independent(drop, task.sensors)
    network = dataclasses.replace(task.network, channel=channel, delay=delay)
    return dataclasses.replace(task, network=network)


def requests(task: Task) -> Array:
    """Random requests (steps, sensors, runs)."""
    return np.random.default_rng(2).random((STEPS, task.sensors, RUNS)) < 0.6


class Log:
    """The measurements of a batch, and the step at which each packet arrives, or never."""

    def __init__(self, task: Task) -> None:
        self.task, self.batch = task, EpisodeBatch.seeded(task, RUNS, 3)
        start = np.empty((RUNS, task.plant.start_channels))
        for run, row in enumerate(start):
            row[:] = self.batch.source.start(3 + run, 0, len(row))
        self.first = task.plant.start(start.T.copy())
        self.measured: list[Array] = []
        self.arrival: list[Array] = []

    def step(self, request: Array) -> None:
        """Move on."""
        state, now = self.batch.state, len(self.measured)
        self.measured.append(self.task.plant.measurement(state.plant))
        lost, delay = state.network.lost, state.network.delay
        granted = self.batch.step(request).granted
        assert lost is not None
        sent = granted & ~lost
        self.arrival.append(np.where(sent, now + (0 if delay is None else delay), np.inf))

    def filtered(self) -> Any:
        """The estimate of one pass over everything that has arrived by now."""
        state, announcement = self.first
        estimator, now = self.task.estimator, len(self.measured) - 1
        estimate = estimator.start(self.task.plant.measurement(state), announcement)
        for measurement, arrival in zip(self.measured, self.arrival, strict=True):
            estimate = estimator.observe(estimator.predict(estimate), measurement)
            estimate = estimator.update(estimate, Reception(arrival <= now))
        return estimate


@pytest.mark.parametrize("delay", [(1.0,), DELAY])
@pytest.mark.parametrize(("env_id", "options"), SETTINGS)
def test_estimates_are_those_of_all_arrivals(
    env_id: str, options: dict[str, Any], delay: tuple[float, ...]
) -> None:
    """At every step: means, covariances, held values and ages."""
    log = Log(make_task(env_id, options, 0.3, delay))
    late = 0
    for request in requests(log.task):
        log.step(request)
        actual, expected = log.batch.delivered.estimate, log.filtered()
        for name in ("held", "age"):
            np.testing.assert_array_equal(getattr(actual, name), getattr(expected, name))
        for part in (log.task.estimator.mean, log.task.estimator.covariance):
            np.testing.assert_allclose(part(actual), part(expected), rtol=1e-12, atol=1e-12)
        late += int((np.array(log.arrival) == np.arange(len(log.arrival))[:, None, None] + 1).sum())
    assert (late > 0) == (len(delay) > 1)


def test_late_packets_are_those_of_a_separate_kalman_filter() -> None:
    """Which has all arrivals, one after another."""
    log = Log(make_task("LinearFusion-v2", {}, 0.2, DELAY))
    plant: Any = log.task.plant
    transition, process = (
        plant.dynamics.transition[..., 0],
        plant.dynamics.process_covariance[..., 0],
    )
    rows, variance = plant.sensors.measurement_matrix[:, 0, :, 0], plant.sensors.variance[:, 0, 0]
    for request in requests(log.task):
        log.step(request)
        now = len(log.measured) - 1
        first = plant.measurement(log.first[0])
        for run in range(RUNS):
            mean, covariance = np.zeros(2), np.eye(2)
            every = [(first, np.zeros((2, RUNS))), *zip(log.measured, log.arrival, strict=True)]
            for step, (measurement, arrival) in enumerate(every):
                if step:
                    mean = transition @ mean
                    covariance = transition @ covariance @ transition.T + process
                for sensor in np.flatnonzero(arrival[:, run] <= now):
                    row = rows[sensor]
                    gain = covariance @ row / (row @ covariance @ row + variance[sensor])
                    mean = mean + gain * (measurement[sensor, 0, run] - row @ mean)
                    covariance = covariance - np.outer(gain, row @ covariance)
            estimate = log.batch.delivered.estimate
            np.testing.assert_allclose(estimate.mean[:, run], mean, atol=1e-12)
            np.testing.assert_allclose(estimate.covariance[..., run], covariance, atol=1e-12)


def test_a_lossy_network_leaves_the_plant_as_it_is() -> None:
    """The noise of losses and delays is the network's own; a third of the packets is lost."""
    lossy = EpisodeBatch.seeded(make_task("LinearFusion-v2", {}, 0.3, DELAY), 400, 0)
    plain = EpisodeBatch.seeded(make_task("LinearFusion-v2", {}, 0.0, (1.0,)), 400, 0)
    lost, delays = [], []
    for _ in range(20):
        np.testing.assert_array_equal(lossy.state.plant.truth, plain.state.plant.truth)
        network = lossy.state.network
        assert network.lost is not None
        lost.append(network.lost)
        delays.append(network.delay)
        for batch in (lossy, plain):
            batch.step(np.ones((2, 400), dtype=np.bool_))
    together = np.corrcoef(lossy.normals()) - np.eye(lossy.channels)
    assert np.abs(together).max() < 5 / 400**0.5
    assert np.mean(lost) == pytest.approx(0.3, abs=4 * (0.21 / 16_000) ** 0.5)
    shares = np.bincount(np.ravel(delays), minlength=3) / np.size(delays)
    np.testing.assert_allclose(shares, DELAY, atol=4 * (0.25 / 16_000) ** 0.5)


def test_a_branch_takes_its_packets_under_way_along() -> None:
    """A branch on the batch's own noise goes where the batch goes."""
    task = make_task("CorrelatedTracking-v1", {"memory": True}, 0.2, DELAY)
    batch = EpisodeBatch.seeded(task, RUNS, 1)
    request = requests(task)
    for early in request[:4]:
        batch.step(early)
    branch = batch.branch()
    for later in request[4:8]:
        batch.step(later)
        branch.step(later, batch.normals())
        for part, other in zip(branch.beliefs().best, batch.beliefs().best, strict=True):
            np.testing.assert_array_equal(part, other)
        np.testing.assert_array_equal(branch.observe(), batch.observe())


def test_a_network_refuses_what_it_does_not_model() -> None:
    task = make_task("LinearFusion-v2", {}, 0.2, DELAY)
    with pytest.raises(ConfigurationError, match=r"delay = .* sum to 1"):
        Network(task.network.bucket, delay=(0.5, 0.2))
    with pytest.raises(ConfigurationError, match=r"channel = .* each of the 2 sensors"):
        Network(task.network.bucket, channel=Channel.independent(0.1, 3))
    with pytest.raises(ConfigurationError, match="access = 'each'"):
        Network(task.network.bucket, access="each")
    with pytest.raises(ConfigurationError, match=r"delay = .*memory of local sensors"):
        EpisodeBatch(dataclasses.replace(task, memory=True), 2, "own")
    with pytest.raises(ConfigurationError, match="delay"):
        dataclasses.replace(task, backend="jax")
    with pytest.raises(ConfigurationError, match=r"delay = .*packet"):
        dataclasses.replace(task, packet="estimate")


def test_an_episode_begins_without_packets_of_the_last_one() -> None:
    """A run that begins anew beside others is the run that begins alone."""
    task = make_task("TobitOscillator-v1", UNCENSORED, 0.2, DELAY)
    batch, alone = EpisodeBatch.seeded(task, RUNS, 1), EpisodeBatch.seeded(task, 1, 50)
    request = requests(task)
    for early in request[:5]:
        batch.step(early)
    batch.seed(np.array([2]), [50])
    batch.reset(np.array([2]))
    for later in request[5:]:
        outcome, expected = batch.step(later), alone.step(later[:, 2:3])
        np.testing.assert_array_equal(outcome.error[:, 2:3], expected.error)
        np.testing.assert_array_equal(batch.observe()[2:3], alone.observe())


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
@pytest.mark.parametrize(
    ("options", "drop"),
    [
        ({}, 0.0),
        ({"channel": "independent", "drop_probability": 0.3}, 0.3),
        ({"channel": "gilbert_elliott"}, 0.25 * 0.7 + 0.75 * 0.2),
        ({"channel": "independent", "true_drop_probability": 0.6}, 0.6),
        ({"channel": "independent", "true_drop_probability": (0.2, 0.6)}, 0.4),
    ],
)
def test_every_environment_loses_its_packets(env_id: str, options: Options, drop: float) -> None:
    task = fusion_gym.make_task(env_id, **options | FREE, horizon=40)
    batch = EpisodeBatch.seeded(task, 200, 3)
    sent, arrived = 0, 0
    for _ in range(40):
        outcome = batch.step(np.ones((task.sensors, 200), dtype=np.bool_))
        assert not (outcome.arrived & ~outcome.granted).any()
        sent, arrived = sent + outcome.granted.sum(), arrived + outcome.arrived.sum()
    assert arrived / sent == pytest.approx(1.0 - drop, abs=0.035)
    model = {"perfect": 1.0, "independent": 0.8}.get(task.settings["channel"])
    if "drop_probability" not in options and model is not None:
        assert (batch.signals()["arrival_probability"] == model).all()


@pytest.mark.parametrize(("true", "spread"), [(0.4, 0.0), ((0.2, 0.6), 0.4 / np.sqrt(12.0))])
def test_each_episode_draws_its_probability_of_a_loss(true: Any, spread: float) -> None:
    lossy = {"channel": "independent", "true_drop_probability": true}
    task = fusion_gym.make_task("fusion_gym/TobitOscillator-v1", **lossy | FREE)
    batch, arrived = EpisodeBatch.seeded(task, 400, 3), np.zeros(400)
    for _ in range(100):
        arrived += batch.step(np.ones((3, 400), dtype=np.bool_)).arrived.mean(0)
    lost = 1.0 - arrived / 100.0
    assert lost.mean() == pytest.approx(0.4, abs=0.03)
    chance = 0.4 * 0.6 / 300.0
    assert lost.std() == pytest.approx(np.sqrt(spread**2 + chance), rel=0.15)


@pytest.mark.parametrize("drop", [0.1, 0.3, 0.5])
@pytest.mark.parametrize(
    ("name", "options"), [("LinearFusion-v2", {}), ("TobitOscillator-v1", UNCENSORED)]
)
def test_filters_are_consistent_under_losses(name: str, options: Options, drop: float) -> None:
    lossy = {"channel": "independent", "drop_probability": drop}
    task = fusion_gym.make_task(f"fusion_gym/{name}", **options | lossy | FREE)
    results = run_episodes(task, fusion_gym.make_policy("always", task), 500)
    assert 0.95 < results.nees.mean() < 1.05
    if name == "LinearFusion-v2" and drop == 0.3:
        assert results.mse.mean() == pytest.approx(0.205, rel=0.03)


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"drop_probability": 0.2}, "drop_probability"),
        ({"channel": "independent", "drop_probability": 1.2}, "drop_probability"),
        ({"channel": "independent", "channel_transition": np.eye(2)}, "channel_transition"),
        ({"channel": "gilbert_elliott", "true_drop_probability": 0.2}, "true_drop_probability"),
        ({"channel": "independent", "true_drop_probability": (0.4, 0.2)}, "true_drop_probability"),
        ({"channel": "noisy"}, "channel"),
    ],
)
def test_what_a_channel_lacks_is_refused(options: Options, field: str) -> None:
    with pytest.raises(ConfigurationError, match=rf"^{field} = "):
        fusion_gym.make_task("fusion_gym/LinearFusion-v2", **options)


def test_a_schedule_of_covariances_refuses_losses() -> None:
    task = fusion_gym.make_task("fusion_gym/CorrelatedTracking-v1", channel="independent")
    with pytest.raises(ConfigurationError, match="channel = 'independent' is not"):
        fusion_gym.make_policy("periodic_optimum", task)


def test_losses_under_jax_are_those_of_numpy() -> None:
    lossy = FREE | {"channel": "independent", "true_drop_probability": (0.2, 0.6), "horizon": 20}
    batches = [
        EpisodeBatch.seeded(
            fusion_gym.make_task("fusion_gym/LinearFusion-v2", backend=backend, **lossy), 4, 3
        )
        for backend in ("numpy", "jax")
    ]
    for _ in range(20):
        numpy, compiled = (batch.step(np.ones((2, 4), dtype=np.bool_)).arrived for batch in batches)
        np.testing.assert_array_equal(numpy, compiled)
