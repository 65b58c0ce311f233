"""Losses and delays of the network, against one pass over all arrivals and a Kalman filter."""

from typing import Any

import gymnasium
import linear_case
import numpy as np
import pytest
from numpy.typing import NDArray

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.estimator import Reception
from fusion_gym.core.runs import Outcome
from fusion_gym.core.task import Task
from fusion_gym.envs.registration import ENVIRONMENTS
from fusion_gym.errors import ConfigurationError
from fusion_gym.evaluation import run_episodes

Array = NDArray[Any]
Options = dict[str, Any]
RUNS, STEPS = 5, 14
DELAY = (0, 2)
FREE: dict[str, Any] = {"tokens": "unlimited", "access": "any"}
UNCENSORED = {"filter": "kalman", "censoring_threshold": -np.inf}
# Every environment whose packets carry measurements; a third filter holds values.
SETTINGS: list[tuple[str, dict[str, Any]]] = [
    ("LinearFusion-v2", {}),
    ("LinearFusion-v2", {"filter": "hold"}),
    ("TobitOscillator-v1", {}),
    ("TobitOscillator-v1", {"filter": "tobit"}),
    ("TobitOscillator-v1", {"filter": "tobit", "fusion": "ci", "memory": True}),
    ("TobitOscillator-v1", UNCENSORED | {"memory": True}),
    ("BiasedOscillator-v2", {"memory": True}),
    ("BiasedTracking-v1", {}),
    ("CorrelatedTracking-v1", {}),
    ("CorrelatedTracking-v1", {"memory": True, "fusion": "ci"}),
    ("UnknownInput-v1", {}),
    ("UnknownInput-v1", {"filter": "predict", "memory": True}),
    ("UnknownInput-v1", {"filter": "paper"}),
    ("MarkovJumpTracking-v1", {}),
    ("MarkovJumpTracking-v1", {"filter": "imm"}),
    ("MarkovJumpTracking-v1", {"filter": "centralised"}),
    ("RecordedFusion-v1", {}),
    ("RecordedFusion-v1", {"filter": "hold"}),
    ("RecordedFusion-v1", {"filter": "joint"}),
    ("RemoteEstimation-v1", {"sensors": 3, "memory": True}),
    ("Linear-v0", {}),
]


@pytest.fixture(autouse=True)
def nonlinear_system(monkeypatch: pytest.MonkeyPatch) -> None:
    """An environment on the base of a system of one's own."""
    monkeypatch.setitem(ENVIRONMENTS, "fusion_gym/Linear-v0", linear_case.build)


def make_task(env_id: str, options: dict[str, Any], drop: float, delay: Any) -> Task:
    """A task whose network loses and delays."""
    lossy = {"channel": "independent", "drop_probability": drop, "delay": delay}
    return fusion_gym.make_task(f"fusion_gym/{env_id}", **options | FREE | lossy)


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

    def step(self, request: Array) -> Outcome:
        """Move on."""
        state, now = self.batch.state, len(self.measured)
        self.measured.append(self.task.plant.measurement(state.plant))
        lost, delay = state.network.draws.lost, state.network.draws.delay
        outcome = self.batch.step(request)
        sent = outcome.granted if lost is None else outcome.granted & ~lost
        self.arrival.append(np.where(sent, now + (0 if delay is None else delay), np.inf))
        return outcome

    def filtered(self) -> Any:
        """The estimate of one pass over everything that has arrived by now."""
        state, announcement = self.first
        estimator, now = self.task.estimator, len(self.measured) - 1
        estimate = estimator.start(self.task.plant.measurement(state), announcement)
        for measurement, arrival in zip(self.measured, self.arrival, strict=True):
            estimate = estimator.observe(estimator.predict(estimate), measurement)
            estimate = estimator.update(estimate, Reception(arrival <= now))
        return estimate


def test_the_option_delays_packets() -> None:
    env = gymnasium.make("fusion_gym/LinearFusion-v2", delay=(0, 2), tokens="unlimited")
    env.reset(seed=0)
    infos = [env.step(np.full(2, step == 0))[-1] for step in range(10)]
    assert np.sum([info["granted"] for info in infos], 0).tolist() == [1, 1]
    assert np.sum([info["arrived"] for info in infos], 0).tolist() == [1, 1]


@pytest.mark.parametrize("delay", [0, 3, DELAY])
@pytest.mark.parametrize(("env_id", "options"), SETTINGS)
def test_estimates_are_those_of_all_arrivals(
    env_id: str, options: dict[str, Any], delay: Any
) -> None:
    """At every step: means, covariances, held values and ages."""
    log = Log(make_task(env_id, options, 0.3, delay))
    late = 0
    for request in requests(log.task):
        log.step(request)
        actual, expected = log.batch.delivered.estimate, log.filtered()
        for name in ("held", "age"):
            np.testing.assert_array_equal(*(getattr(one, name) for one in (actual, expected)))
        for part in (log.task.estimator.mean, log.task.estimator.covariance):
            np.testing.assert_allclose(part(actual), part(expected), rtol=1e-12, atol=1e-12)
        late += int(((log.arrival[-1] > len(log.arrival) - 1) & np.isfinite(log.arrival[-1])).sum())
    assert (late > 0) == (delay != 0)


@pytest.mark.parametrize("delay", [DELAY, ((0, 0), (1, 3))])
def test_late_packets_are_those_of_a_separate_kalman_filter(delay: Any) -> None:
    """Which has all arrivals, one after another."""
    log = Log(make_task("LinearFusion-v2", {}, 0.2, delay))
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


def test_each_sensor_has_a_delay_of_its_own() -> None:
    """A source's estimate is its last arrived value, aged by the sensor's own delay."""
    delays, coefficient = (0, 1, 3), np.array([[0.9], [0.95], [1.0]])
    rows = [(delay, delay) for delay in delays]
    options = {"sensors": 3, "coefficient": coefficient[:, 0].tolist()}
    batch = EpisodeBatch.seeded(make_task("RemoteEstimation-v1", options, 0.0, rows), RUNS, 0)
    truth, sent = [], np.random.default_rng(1).random((STEPS, 3, RUNS)) < 0.5
    for now, request in enumerate(sent):
        truth.append(batch.task.plant.truth(batch.state.plant))
        batch.step(request)
        mean = batch.task.estimator.mean(batch.delivered.estimate)
        for sensor, run in np.ndindex(3, RUNS):
            there = np.flatnonzero(sent[: max(now + 1 - delays[sensor], 0), sensor, run])
            last = int(there[-1]) if len(there) else None
            if last is not None:
                expected = coefficient[sensor, 0] ** (now - last) * truth[last][sensor, run]
                np.testing.assert_allclose(mean[sensor, run], expected, rtol=1e-12, atol=1e-12)


def test_each_sensor_has_a_chain_of_its_own() -> None:
    """The shares of losses follow from each chain, and so does what a policy expects."""
    drop, stay = np.array([[1.0, 0.0], [0.8, 0.1], [0.5, 0.5]]), np.array([0.5, 0.9, 0.7])
    transition = [[[s, 1.0 - s], [0.2, 0.8]] for s in stay]
    lossy = {"channel": "gilbert_elliott", "drop_probability": drop, "horizon": 200}
    options = lossy | {"channel_transition": transition, "tokens": "unlimited", "access": "any"}
    task = fusion_gym.make_task("fusion_gym/CorrelatedTracking-v1", **options)
    batch, arrived, expected = EpisodeBatch.seeded(task, 100, 3), [], []
    for _ in range(200):
        expected.append(batch.signals()["arrival_probability"].mean(1))
        arrived.append(batch.step(np.ones((3, 100), dtype=np.bool_)).arrived.mean(1))
    bad = 0.2 / (0.2 + 1.0 - stay)
    share = 1.0 - (bad * drop[:, 0] + (1.0 - bad) * drop[:, 1])
    np.testing.assert_allclose(np.mean(arrived, 0), share, atol=0.02)
    np.testing.assert_allclose(np.mean(expected, 0).ravel(), share, atol=0.02)


@pytest.mark.parametrize("env_id", ["CorrelatedTracking-v1", "TobitOscillator-v1"])
def test_a_rule_that_needs_an_order_alone_runs_under_a_delay(env_id: str) -> None:
    """Its first requests are those without the delay."""
    first = []
    for delay in (0, 2):
        task = make_task(env_id, {}, 0.3, delay)
        batch = EpisodeBatch.seeded(task, RUNS, 0)
        rule = fusion_gym.make_policy("variance_threshold:threshold=0,at_most=2", task)
        first.append(rule(batch.signals()))
    np.testing.assert_array_equal(*first)
    assert (first[0].sum(0) == 2).all()
    assert (first[0].sum(1) < RUNS).any()
    with pytest.raises(ConfigurationError, match="variance_reduction"):
        fusion_gym.make_policy("information_gain", task)


def test_a_source_is_solved_on_its_own_chain() -> None:
    """Two sources with two chains are two tasks of one source."""
    chains = [((0.9, 0.1), [[0.7, 0.3], [0.1, 0.9]]), ((0.6, 0.0), [[0.2, 0.8], [0.4, 0.6]])]

    def problems(*chosen: Any) -> Any:
        drop, transition = zip(*chosen, strict=True)
        own: Options = {"channel": "gilbert_elliott", "sensors": len(chosen), "action": "discrete"}
        own |= {"drop_probability": drop, "channel_transition": transition, "cost_weight": 0.5}
        task = fusion_gym.make_task("fusion_gym/RemoteEstimation-v1", **own | FREE)
        return fusion_gym.solvers.source_problems(task)

    together = problems(*chains)
    for chain, problem in zip(chains, together, strict=True):
        (alone,) = problems(chain)
        for name in ("drop", "transition", "initial"):
            np.testing.assert_array_equal(getattr(alone, name), getattr(problem, name))


def test_a_lossy_network_leaves_the_plant_as_it_is() -> None:
    """The noise of losses and delays is the network's own; a third of the packets is lost."""
    lossy = EpisodeBatch.seeded(make_task("LinearFusion-v2", {}, 0.3, DELAY), 400, 0)
    plain = EpisodeBatch.seeded(make_task("LinearFusion-v2", {}, 0.0, 0), 400, 0)
    lost, delays = [], []
    for _ in range(20):
        np.testing.assert_array_equal(lossy.state.plant.truth, plain.state.plant.truth)
        network = lossy.state.network
        assert network.draws.lost is not None
        lost.append(network.draws.lost)
        delays.append(network.draws.delay)
        for batch in (lossy, plain):
            batch.step(np.ones((2, 400), dtype=np.bool_))
    together = np.corrcoef(lossy.normals()) - np.eye(lossy.channels)
    assert np.abs(together).max() < 5 / 400**0.5
    assert np.mean(lost) == pytest.approx(0.3, abs=4 * (0.21 / 16_000) ** 0.5)
    shares = np.bincount(np.ravel(delays), minlength=3) / np.size(delays)
    np.testing.assert_allclose(shares, 1.0 / 3.0, atol=4 * (0.25 / 16_000) ** 0.5)


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
        (
            {"channel": "gilbert_elliott", "drop_probability": 0.5},
            "drop_probability",
        ),
        ({"delay": ((1, 0), (0, 0))}, "delay"),
        ({"delay": (2, 2)}, "delay"),
        (
            {"channel": "gilbert_elliott", "channel_transition": np.ones((3, 2, 2)) / 2},
            "channel_transition",
        ),
        ({"channel": "independent", "true_drop_probability": (0.4, 0.2)}, "true_drop_probability"),
        ({"channel": "noisy"}, "channel"),
        (
            {"channel": "independent", "filter": "truncated", "trigger": "send_on_delta"}
            | {"trigger_threshold": 1.0},
            "channel",
        ),
    ],
)
def test_what_a_channel_lacks_is_refused(options: Options, field: str) -> None:
    with pytest.raises(ConfigurationError, match=rf"^{field} = "):
        fusion_gym.make_task("fusion_gym/LinearFusion-v2", **options)


def test_a_schedule_of_covariances_refuses_losses() -> None:
    task = fusion_gym.make_task("fusion_gym/CorrelatedTracking-v1", channel="independent")
    with pytest.raises(ConfigurationError, match="channel = 'independent' is not"):
        fusion_gym.make_policy("periodic_optimum", task)


def test_losses_in_compiled_code_are_those_of_numpy() -> None:
    lossy = FREE | {"channel": "independent", "true_drop_probability": (0.2, 0.6), "horizon": 20}
    batches = [
        EpisodeBatch.seeded(
            fusion_gym.make_task("fusion_gym/LinearFusion-v2", backend=backend, **lossy), 4, 3
        )
        for backend in ("numpy", "compiled")
    ]
    for _ in range(20):
        numpy, compiled = (batch.step(np.ones((2, 4), dtype=np.bool_)).arrived for batch in batches)
        np.testing.assert_array_equal(numpy, compiled)


@pytest.mark.parametrize("delay", [0, 1, 3, DELAY, (1, 4)])
def test_outcomes_show_what_arrives_before_the_next_decision(delay: Any) -> None:
    log = Log(make_task("CorrelatedTracking-v1", {}, 0.2, delay))
    for now, request in enumerate(requests(log.task)):
        arrived = log.step(request).arrived
        at_once = log.arrival[-1] == now
        late = np.array([packet == now + 1 for packet in log.arrival]).any(0)
        np.testing.assert_array_equal(arrived, at_once | late)


@pytest.mark.parametrize("delay", [1, 4])
@pytest.mark.parametrize("env_id", ["LinearFusion-v2", "CorrelatedTracking-v1"])
def test_age_is_that_of_information(env_id: str, delay: int) -> None:
    """Without losses it grows to the delay and stays there."""
    batch = EpisodeBatch.seeded(make_task(env_id, {}, 0.0, delay), RUNS, 0)
    for step in range(10):
        assert (batch.signals()["age"] == min(step + 1, delay)).all()
        batch.step(np.ones((batch.task.sensors, RUNS), dtype=np.bool_))
        assert (batch.delivered.estimate.age == min(step + 1, delay)).all()


def test_a_source_is_predicted_from_its_value_when_the_packet_was_sent() -> None:
    task = make_task("RemoteEstimation-v1", {"sensors": 2, "coefficient": (0.9, 1.0)}, 0.0, 3)
    batch, truth = EpisodeBatch.seeded(task, RUNS, 0), []
    for step in range(10):
        truth.append(task.plant.truth(batch.state.plant))
        batch.step(np.ones((2, RUNS), dtype=np.bool_))
        expected = truth[step - 3] * np.array([[0.9**3], [1.0]]) if step >= 3 else 0.0
        np.testing.assert_allclose(batch.delivered.estimate.mean, expected, atol=1e-12)


@pytest.mark.parametrize("env_id", ["LinearFusion-v2", "CorrelatedTracking-v1"])
def test_delays_are_the_same_through_every_interface(env_id: str) -> None:
    """Bitwise, over two episodes of each run."""
    name, horizon = f"fusion_gym/{env_id}", 7
    options: Options = {"delay": (0, 2), "horizon": horizon, "tokens": "unlimited"}
    mode = gymnasium.vector.AutoresetMode.SAME_STEP
    vector: Any = gymnasium.make_vec(
        name, 3, vectorization_mode="vector_entry_point", autoreset_mode=mode, **options
    )
    single = [gymnasium.make(name, **options) for _ in range(3)]
    sb3 = fusion_gym.make_sb3_vec_env(name, 3, seed=5, **options)
    local: Any = fusion_gym.make_sb3_vec_env(name, 3, seed=5, local=True, **options)
    seen = vector.reset(seed=5)[0]
    np.testing.assert_array_equal(sb3.reset(), seen)
    np.testing.assert_array_equal(local.reset(), local.view.rows(seen))
    for run, env in enumerate(single):
        np.testing.assert_array_equal(env.reset(seed=5 + run)[0], seen[run])
    sensors = vector.single_action_space.n
    late = 0
    for step, action in enumerate(np.random.default_rng(0).random((12, 3, sensors)) < 0.6, 1):
        action = action.astype(np.int8)
        seen, reward, *_, info = vector.step(action)
        rows, rewards, *_ = sb3.step(action)
        np.testing.assert_array_equal(rows, seen)
        np.testing.assert_array_equal(local.step(action.ravel())[0], local.view.rows(seen))
        info = info.get("final_info", info)  # all runs end together
        for run, env in enumerate(single):
            own, value, _, over, own_info = env.step(action[run])
            assert over == (step == horizon)
            assert value == reward[run]
            assert np.float32(value) == rewards[run]
            np.testing.assert_array_equal(own_info["arrived"], info["arrived"][run])
            late += int((own_info["arrived"] & ~own_info["granted"]).sum())
            own = env.reset()[0] if over else own
            np.testing.assert_array_equal(own, seen[run])
    assert late


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("LinearFusion-v2", {"delay": -1}),
        ("LinearFusion-v2", {"delay": 1.5}),
        ("LinearFusion-v2", {"delay": 101}),
        ("LinearFusion-v2", {"delay": (2, 2)}),
        ("LinearFusion-v2", {"delay": (0, 1, 2)}),
        ("LinearFusion-v2", {"delay": np.array(2)}),
        ("LinearFusion-v2", {"packet": "estimate", "memory": True}),
        ("LinearFusion-v2", {"belief_features": True}),
        (
            "LinearFusion-v2",
            {"filter": "truncated", "trigger": "report_on_change", "trigger_threshold": 0.8},
        ),
    ],
)
def test_a_delay_is_refused_where_it_has_no_model(name: str, options: Options) -> None:
    with pytest.raises(ConfigurationError, match=r"^delay = .* allowed"):
        fusion_gym.make_task(f"fusion_gym/{name}", **{"delay": 1} | options)


def test_sensors_with_memory_refuse_a_delay() -> None:
    options: Options = {"delay": 1, "memory": True}
    with pytest.raises(ConfigurationError, match=r"^delay = 1 .*memory of local sensors"):
        fusion_gym.parallel_env("fusion_gym/LinearFusion-v2", **options)


OF_ONE_STEP = [
    "value_of_information", "kullback_leibler", "estimate_difference", "priced_threshold",
    "priced_threshold:score=variance", "information_gain",
    "centre_variance", "optimal", "whittle", "periodic_optimum", "rollout:base=always",
]  # fmt: skip


@pytest.mark.parametrize("delay", [2, DELAY])
@pytest.mark.parametrize("policy", OF_ONE_STEP)
def test_a_value_of_one_step_is_refused_with_a_delay(policy: str, delay: Any) -> None:
    remote = policy in ("optimal", "whittle")
    env_id, options = "RemoteEstimation-v1" if remote else "MarkovJumpTracking-v1", FREE
    options = options if remote else options | {"filter": "centralised"}
    prompt, late = (
        fusion_gym.make_task(f"fusion_gym/{env_id}", delay=d, **options) for d in (0, delay)
    )
    fusion_gym.make_policy(policy, prompt)
    with pytest.raises(ConfigurationError, match=f"policy '{policy}': .*delay"):
        fusion_gym.make_policy(policy, late)


@pytest.mark.parametrize(
    "policy",
    [
        "estimate_difference:at_most=none,threshold=0.1",
        "priced_threshold:score=innovation,threshold=0.1",
        "send_on_delta:threshold=0.1",
        "innovation_threshold:threshold=0.1",
    ],
)
def test_rules_without_such_a_value_send_with_a_delay(policy: str) -> None:
    task = make_task("LinearFusion-v2", {"memory": True}, 0.0, 1)
    assert [name for name in EpisodeBatch(task, 1).layout.names if "value" in name] == []
    assert run_episodes(task, fusion_gym.make_policy(policy, task), 4).rate.mean() > 0.2


def test_a_delay_scales_the_reward_and_leaves_the_range_of_prices() -> None:
    def settings(delay: int, **options: Any) -> Options:
        return fusion_gym.make_task("fusion_gym/LinearFusion-v2", delay=delay, **options).settings

    scales = [settings(delay, reward_scale="auto")["reward_scale"] for delay in (4, 0)]
    assert scales[0] < 0.9 * scales[1]
    prices: Options = {"cost_weight": "random", "price_range": "auto", "reward_scale": 1.0}
    assert settings(4, **prices)["price_range"] == settings(0, **prices)["price_range"]


@pytest.mark.parametrize(("coefficient", "drop"), [(0.9, 0.4), (1.2, 0.6), (1.3, 0.8)])
def test_expected_covariances_follow_the_closed_form_over_ages(
    coefficient: float, drop: float
) -> None:
    """Σ_k q^k (1 - q) V_k over geometric ages; without bound beyond the critical probability 1/a².

    B. Sinopoli, L. Schenato, M. Franceschetti, K. Poolla, M. I. Jordan and S. S. Sastry, "Kalman
    filtering with intermittent observations", IEEE Trans. Automatic Control 49, 2004.
    """
    lossy = {"channel": "independent", "drop_probability": drop, "horizon": 12}
    source = {"coefficient": coefficient, "initial_deviation": 0.0}
    task = fusion_gym.make_task("fusion_gym/RemoteEstimation-v1", **source | lossy | FREE)
    batch, everyone = EpisodeBatch.seeded(task, 60_000, 0), np.ones((1, 60_000), dtype=np.bool_)
    growth = coefficient**2 * drop
    for step in range(1, 13):
        errors = batch.step(everyone).squared_error[0]
        covariance = task.estimator.covariance(batch.delivered.estimate)[0, 0]
        variances = np.cumsum(coefficient ** (2.0 * np.arange(step)))  # V_k after k losses
        ages = drop ** np.arange(1, step + 1) * np.append(np.full(step - 1, 1.0 - drop), 1.0)
        expected = ages @ variances
        assert expected == pytest.approx(drop * (1.0 - growth**step) / (1.0 - growth))
        assert covariance.mean() == pytest.approx(expected, rel=0.03)
        assert errors.mean() == pytest.approx(expected, rel=0.08)
    assert (expected > 20.0) == (growth > 1.0)


def test_filtered_covariances_grow_beyond_the_critical_probability() -> None:
    """The expected covariance of a scalar Kalman filter is at least that of its lower bound."""
    plant = {"transition": [[1.3]], "process_covariance": [[1.0]], "measurement_matrices": [[1.0]]}
    for drop in (0.3, 0.7):
        lossy = {"channel": "independent", "drop_probability": drop, "horizon": 25}
        task = fusion_gym.make_task("fusion_gym/LinearFusion-v2", **plant | lossy | FREE)
        batch, everyone = EpisodeBatch.seeded(task, 20_000, 0), np.ones((1, 20_000), dtype=np.bool_)
        bound, means = 0.0, []
        for _ in range(25):
            batch.step(everyone)
            bound = drop * (1.69 * bound + 1.0)
            means.append(task.estimator.covariance(batch.delivered.estimate)[0, 0].mean())
            assert means[-1] > 0.9 * bound
        assert (means[-1] > 2.0 * means[9]) == (drop > 1.0 / 1.69)
