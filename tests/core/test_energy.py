"""Sensors with buckets of their own, such as batteries, and random harvests."""

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from buckets import make_bucket
from hypothesis import given, settings
from hypothesis import strategies as st

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.knowledge import SignalError, Signals
from fusion_gym.core.scale import sustained_rate, sustained_tokens
from fusion_gym.evaluation import record_episode, run_episodes
from fusion_gym.policies.base import Rule, guard
from fusion_gym.validation import ConfigurationError

TRACKING = "fusion_gym/CorrelatedTracking-v1"
OWN: dict[str, Any] = {
    "budget": "sensor", "tokens": "limited", "token_rate": (0.2, 0.5, 0.9), "token_capacity": 5.0,
    "initial_tokens": (0.0, 1.0, 2.0), "token_cost": (1.0, 2.0, 1.5),
}  # fmt: skip
BERNOULLI = OWN | {"harvest": "bernoulli"}


def test_a_user_makes_sensors_with_batteries() -> None:
    with warnings.catch_warnings(action="error"):
        env = gym.make(
            TRACKING, tokens="limited", budget="sensor", harvest="bernoulli", token_rate=0.3,
            token_capacity=5, initial_tokens=1, token_cost=1,
        )  # fmt: skip
        observation, _ = env.reset(seed=0)
    assert observation[-3:].tolist() == pytest.approx([0.2] * 3)
    *_, info = env.step([1, 1, 0])
    assert info["granted"].tolist() == [True, True, False]
    assert info["cost"] == 2.0


@pytest.mark.parametrize("policy", ["always", "priced_threshold:token_exponent=1", "round_robin"])
@pytest.mark.parametrize("options", [OWN, BERNOULLI], ids=["constant", "bernoulli"])
def test_rules_spend_what_their_sensors_harvest(options: Any, policy: str) -> None:
    task = fusion_gym.make_task(TRACKING, memory=True, horizon=100, **options)
    results = run_episodes(task, fusion_gym.make_policy(policy, task), 20)
    assert 0.0 < results.tokens.mean() <= 1.6 + 3.0 / 100 + 0.1
    film = record_episode(task, fusion_gym.make_policy(policy, task), 0)
    assert film.tokens.min() >= 0.0
    assert film.tokens.max() <= 15.0


def test_an_agent_of_one_sensor_observes_its_own_energy() -> None:
    env = fusion_gym.parallel_env(TRACKING, **OWN)
    rows, _ = env.reset(seed=0)
    place = env.view.names.index("energy")
    assert [float(row[place]) for row in rows.values()] == pytest.approx([0.0, 0.2, 0.4])


class Level(Rule):
    knowledge = "own"

    def __init__(self, name: str) -> None:
        self.name = name

    def __call__(self, signals: Signals) -> Any:
        return np.broadcast_to(signals[self.name] >= 1.0, signals["energy"].shape)


def test_a_rule_of_single_sensors_reads_only_their_own_energy() -> None:
    for options, allowed in ((OWN, False), (OWN | {"tokens": "unlimited"}, True), ({}, True)):
        task = fusion_gym.make_task(TRACKING, **options)
        signals = EpisodeBatch.seeded(task, 2, 0).signals()
        assert guard(Level("energy"), task)(signals).shape == (3, 2)
        if allowed:
            assert guard(Level("tokens"), task)(signals).all()
            continue
        assert guard(Level("energy"), task)(signals)[:, 0].tolist() == [False, True, True]
        with pytest.raises(SignalError, match="'tokens' belongs to the class 'centre'"):
            guard(Level("tokens"), task)(signals)


def test_rollouts_begin_with_the_energy_of_each_sensor(monkeypatch: pytest.MonkeyPatch) -> None:
    task = fusion_gym.make_task(TRACKING, memory=True, horizon=8, **BERNOULLI)
    policy: Any = fusion_gym.make_policy("rollout:samples=3,steps=2,base=always", task)
    begin, levels = policy._imagination.begin, []

    def watched(signals: Any, runs: Any, normals: Any) -> Any:
        branch, noise = begin(signals, runs, normals)
        levels.append((branch.state.network.tokens, signals["energy"][:, runs]))
        assert branch.state.network.draws.harvest.shape == signals["energy"][:, runs].shape
        return branch, noise

    monkeypatch.setattr(policy._imagination, "begin", watched)
    run_episodes(task, policy, 2)
    assert len(levels) == 8
    assert all((one == two).all() for one, two in levels)


costs = st.lists(st.integers(1, 24).map(lambda n: n / 8), min_size=1, max_size=5)


@given(cost=costs, seed=st.integers(0, 2**31), drawn=st.booleans())
@settings(max_examples=100, deadline=None)
def test_each_bucket_closes_its_own_balance(cost: list[float], seed: int, drawn: bool) -> None:
    """Against scalar arithmetic, exact in eighths."""
    rng, sensors = np.random.default_rng(seed), len(cost)
    rate = rng.integers(0, 9, sensors) / 8
    capacity = np.array(cost) + rng.integers(0, 17, sensors) / 8
    harvest = "bernoulli" if drawn else "constant"
    bucket = make_bucket(
        rate, capacity, 0.5 * capacity, cost, sensors, budget="sensor", harvest=harvest
    )
    tokens = bucket.start(4)
    for _ in range(12):
        requests = rng.random((sensors, 4)) < 0.6
        gained = rng.random((sensors, 4)) < 0.5 if drawn else None
        answer = bucket.grant(tokens, requests, None, gained)
        for m in range(sensors):
            for run in range(4):
                granted = bool(requests[m, run]) and cost[m] <= tokens[m, run]
                gain = rate[m] if gained is None else float(gained[m, run])
                left = tokens[m, run] - granted * cost[m] + gain
                assert answer.granted[m, run] == granted
                assert answer.tokens[m, run] == min(left, capacity[m])
        assert (answer.tokens >= 0.0).all()
        np.testing.assert_array_equal(answer.spent, (answer.granted.T * cost).sum(1))
        tokens = answer.tokens


def test_harvests_are_independent_and_have_their_probability() -> None:
    options = BERNOULLI | {"token_capacity": 200.0, "initial_tokens": 0.0}
    task, runs, steps = fusion_gym.make_task(TRACKING, **options), 400, 100
    batch = EpisodeBatch.seeded(task, runs, 0)
    nobody = np.zeros((3, runs), dtype=np.bool_)
    gains, level = [], np.zeros((3, runs))
    for _ in range(steps):
        batch.step(nobody)
        gains.append(batch.signals()["energy"] - level)
        level = batch.signals()["energy"]
    gained = np.array(gains)
    assert set(gained.ravel()) == {0.0, 1.0}
    rate = np.array(OWN["token_rate"])
    error = np.sqrt(rate * (1.0 - rate) / (runs * steps))
    assert (np.abs(gained.mean((0, 2)) - rate) < 4.0 * error).all()
    lines = gained.swapaxes(0, 1).reshape(3, -1)
    following = np.concatenate((lines[:, :-runs], lines[:, runs:]))  # one step later
    limit = 4.0 / np.sqrt(runs * steps)
    assert (np.abs(np.corrcoef(lines) - np.eye(3)) < limit).all()
    assert (np.abs(np.corrcoef(following)[:3, 3:]) < 1.1 * limit).all()


def test_the_harvest_leaves_plant_and_measurements_as_they_are() -> None:
    batches = [
        EpisodeBatch.seeded(fusion_gym.make_task(TRACKING, **options), 5, 3)
        for options in ({}, OWN, BERNOULLI, BERNOULLI | {"channel": "independent"})
    ]
    for _ in range(4):
        measured = [batch.task.plant.measurement(batch.state.plant) for batch in batches]
        assert all((one == measured[0]).all() for one in measured[1:])
        for batch in batches:
            batch.step(np.ones((3, 5), dtype=np.bool_))


@pytest.mark.parametrize("env_id", ["fusion_gym/RemoteEstimation-v1", "fusion_gym/LinearFusion-v2"])
def test_one_sensor_with_a_bucket_of_its_own_is_the_shared_bucket(env_id: str) -> None:
    """Bitwise, with its scales."""
    more: Any = {"measurement_matrices": [[1, 0]]} if "Linear" in env_id else {}
    common = {"tokens": "limited", "token_rate": 0.7, "token_capacity": 5.0, "initial_tokens": 1.3}
    tasks = [
        fusion_gym.make_task(env_id, budget=budget, token_cost=1.9, **common | more)
        for budget in ("shared", "sensor")
    ]
    assert sustained_rate(tasks[0].network) == sustained_rate(tasks[1].network)
    assert sustained_tokens(tasks[0]) == sustained_tokens(tasks[1])
    one, two = (EpisodeBatch.seeded(task, 20, 0) for task in tasks)
    rng = np.random.default_rng(0)
    for _ in range(30):
        request = rng.random((1, 20)) < 0.6
        for first, second in zip(one.step(request), two.step(request), strict=True):
            np.testing.assert_array_equal(first, second)
        np.testing.assert_array_equal(one.signals()["tokens"], two.signals()["tokens"])
        np.testing.assert_array_equal(one.observe()[:, :-1], two.observe())  # without the queue


def test_each_sensor_sustains_its_own_rate() -> None:
    task = fusion_gym.make_task(TRACKING, **OWN)
    assert sustained_rate(task.network) == pytest.approx((0.2 + 0.25 + 0.6) / 3)
    assert sustained_tokens(task) == pytest.approx(0.2 + 0.5 + 0.9)
    single = fusion_gym.make_task(TRACKING, access="single", **OWN)
    assert sustained_rate(single.network) == pytest.approx((0.2 + 0.25 + 1 / 3) / 3)
    batch = EpisodeBatch.seeded(task, 1, 0)
    spent = [batch.step(np.ones((3, 1), dtype=np.bool_)).cost[0] for _ in range(200)]
    assert np.mean(spent) == pytest.approx(1.6, abs=3.0 / 200 + 0.03)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"token_rate": (1, 2)}, r"token_rate = \(1, 2\) .*shape \(3,\)"),
        ({"token_rate": (0.1, -1, 0.1)}, "token_rate = -1.0 .*>= 0"),
        ({"harvest": "bernoulli", "token_rate": (0.1, 1.5, 0.1)}, "token_rate = 1.5 .*<= 1"),
        ({"harvest": "bernoulli", "budget": "shared", "token_rate": 0.5}, "harvest = 'bernoulli' "
         "is not allowed with budget='shared'"),
        ({"budget": "shared", "token_rate": (1, 2, 3)}, r"token_rate = \(1, 2, 3\) .*number"),
        ({"budget": "shared", "token_capacity": (9, 9, 9)}, r"token_capacity = \(9, 9, 9\)"),
        ({"budget": "shared", "initial_tokens": (1, 1, 1)}, r"initial_tokens = \(1, 1, 1\)"),
        ({"sharing": "fixed"}, "sharing = 'fixed' is not allowed with budget='sensor'"),
        ({"token_capacity": (1, 1, 9)}, r"token_capacity = \(1, 1, 9\) .*at least"),
        ({"initial_tokens": (1, 31, 1)}, r"initial_tokens = \(1, 31, 1\) .*<= 30"),
        ({"budget": "own"}, "budget = 'own' .*'shared', 'sensor'"),
        ({"harvest": "poisson"}, "harvest = 'poisson' .*'constant', 'bernoulli'"),
    ],
)  # fmt: skip
def test_bad_numbers_are_refused_by_name_and_value(options: Any, message: str) -> None:
    plain: Any = {"budget": "sensor", "tokens": "limited", "token_cost": 2.0}
    with pytest.raises(ConfigurationError, match=f"^{message}"):
        fusion_gym.make_task(TRACKING, **plain | options)


def test_the_exact_optimum_refuses_limited_buckets_of_sensors() -> None:
    for sensors in (1, 2):
        options: Any = {"budget": "sensor", "sensors": sensors}
        task = fusion_gym.make_task("fusion_gym/RemoteEstimation-v1", tokens="limited", **options)
        with pytest.raises(ConfigurationError, match="budget = 'sensor' is not allowed"):
            fusion_gym.make_policy("optimal", task)
        assert fusion_gym.make_policy("whittle", task)
        free = fusion_gym.make_task("fusion_gym/RemoteEstimation-v1", tokens="unlimited", **options)
        assert fusion_gym.make_policy("optimal", free)


@pytest.mark.slow
@pytest.mark.parametrize("options", [OWN, BERNOULLI], ids=["constant", "bernoulli"])
def test_compiled_code_keeps_the_same_energy(options: Any) -> None:
    pytest.importorskip("llvmlite")
    tasks = [fusion_gym.make_task(TRACKING, backend=b, **options) for b in ("numpy", "compiled")]
    one, two = (EpisodeBatch.seeded(task, 4, 0) for task in tasks)
    for request in np.random.default_rng(1).random((12, 3, 4)) < 0.7:
        outcomes = one.step(request), two.step(request)
        np.testing.assert_array_equal(outcomes[0].granted, outcomes[1].granted)
        np.testing.assert_allclose(outcomes[0].cost, outcomes[1].cost)
        np.testing.assert_allclose(one.observe(), two.observe(), rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(one.signals()["energy"], two.signals()["energy"])
