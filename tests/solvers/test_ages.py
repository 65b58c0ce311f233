"""Schedules by age: the Whittle index, the optimum of two sources, maximum age first."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scalar_ages import by_age

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.optimal import AgeIndex, AgeOptimum
from fusion_gym.policies.registry import make_policy
from fusion_gym.solvers import AgeSource, SourceProblem, age_index, age_sources, solve_ages
from fusion_gym.validation import ConfigurationError

Array = NDArray[Any]
TWO: dict[str, Any] = {"channel": "gilbert_elliott", "error": "trace", "cost_weight": 0.0}


def make(count: int, **options: Any) -> Task:
    """Drawn sources that share one slot."""
    chosen: dict[str, Any] = {"sources": (count, 0), "access": "slots"}
    return fusion_gym.make_task("fusion_gym/RemoteEstimation-v1", **chosen | TWO | options)


@pytest.mark.parametrize("drop", [0.0, 0.3, 0.6])
def test_the_index_of_an_age_is_that_of_kadota(drop: float) -> None:
    """s a (a - 1)/2 + a for costs that are ages: I. Kadota, A. Sinha, E. Uysal-Biyikoglu, R. Singh
    and E. Modiano, IEEE/ACM Trans. Networking 26, 2018."""
    index = age_index(np.arange(61.0), np.array([drop]), np.ones((1, 1)))[:15, 0]
    age = np.arange(1, 16)
    np.testing.assert_allclose(index, (1.0 - drop) * age * (age - 1) / 2 + age, rtol=1e-4)


def moves(source: AgeSource) -> list[tuple[Array, Array]]:
    """The law of the next (age, state), and the cost, of silence and of a transmission."""
    t, d, longest = source.transition, source.drop, len(source.costs) - 1
    older, new = np.eye(longest + 1, k=1), np.zeros((longest + 1, longest + 1))
    older[longest, longest], new[:, 1] = 1.0, 1.0
    late, loss = np.einsum("kx,sy->ksxy", older, t), t @ d
    fresh = np.einsum("kx,sy,y->ksxy", older, t, d) + np.einsum("kx,sy,y->ksxy", new, t, 1.0 - d)
    stay = np.repeat(source.costs[:, None], len(d), axis=1)
    return [(late, stay), (fresh, source.price + loss * stay + (1.0 - loss) * source.costs[0])]


def test_at_the_index_both_decisions_cost_the_same() -> None:
    """By value iteration of a separate program, for a Gilbert-Elliott channel."""
    drop, move = np.array([0.7, 0.2]), np.array([[0.7, 0.3], [0.1, 0.9]])
    costs = 0.5 + np.cumsum(1.1 ** (2.0 * np.arange(21)))
    index = age_index(costs, drop, move)
    assert (np.diff(index, axis=0) > 0.0).all()
    assert (index[:, 1] > index[:, 0]).all()
    for age, state in ((2, 0), (4, 1), (9, 0)):
        source, value = AgeSource(costs, index[age - 1, state], drop, move, 1.21), np.zeros((21, 2))
        for _ in range(4000):
            both = [cost + np.einsum("ksxy,xy->ks", law, value) for law, cost in moves(source)]
            new = np.minimum(*both)
            value = 0.5 * value + 0.5 * (new - new[1, 0])
        silent, sent = (each[age, state] for each in both)
        assert silent == pytest.approx(sent, rel=1e-5)


def least_cost(sources: tuple[AgeSource, ...]) -> float:
    """The optimum of two sources on one channel, by value iteration."""
    first, second = map(moves, sources)
    value = np.zeros(2 * first[0][1].shape)
    for _ in range(600):
        options = []
        for i, j in ((0, 0), (1, 0), (0, 1)):
            (p, c), (q, e) = first[i], second[j]
            ahead = np.einsum("ksxy,xyuv,mnuv->ksmn", p, value, q)
            options.append(ahead + c[:, :, None, None] + e)
        change = np.minimum.reduce(options) - value
        value = value + 0.7 * (change - change[1, 0, 1, 0])
        if np.ptp(change[1:, :, 1:]) < 1e-9:
            break
    return float(change[1:, :, 1:].mean())


def test_the_optimum_of_two_sources_is_that_of_a_separate_program() -> None:
    task = make(2)
    policy = AgeOptimum(task, longest=12)
    assert policy.solution.lower <= policy.solution.upper
    assert policy.solution.cost == pytest.approx(least_cost(age_sources(task, 12)), rel=1e-6)


def test_more_ages_bring_the_bounds_of_the_optimum_together() -> None:
    """Each pair contains all pairs of more ages."""
    solutions = [AgeOptimum(make(2), longest=longest).solution for longest in (5, 10, 20, 40)]
    lower, upper = [item.lower for item in solutions], [item.upper for item in solutions]
    assert lower == sorted(lower)
    assert upper == sorted(upper, reverse=True)
    assert lower[3] == pytest.approx(upper[3], rel=1e-6)
    assert upper[0] > 1.05 * lower[0]


@pytest.mark.parametrize("drop", [0.0, 0.3])
@pytest.mark.parametrize("coefficient", [0.9, 1.0, 1.2])
def test_the_bounds_of_one_source_hold_for_all_ages(coefficient: float, drop: float) -> None:
    """Few ages bound the optimum of many."""
    problem = SourceProblem.create(coefficient=coefficient, price=4.0, drop=drop)
    few, many = (solve_ages((by_age(problem, longest),), 1) for longest in (4, 40))
    assert few.lower <= many.cost * (1.0 + 1e-7)
    assert few.upper >= many.cost * (1.0 - 1e-7)
    assert many.upper == pytest.approx(many.lower, rel=1e-6)


@pytest.mark.slow
def test_rules_by_age_cost_at_least_the_optimum() -> None:
    """On the same noise; the optimum's cost is the solver's, but for the start at age 0."""
    task = make(2, horizon=400)
    names = ("age_optimum", "age_index", "information_gain:threshold=0", "maximum_age")
    returns = [-run_episodes(task, make_policy(name, task), 200).returns / 400 for name in names]
    optimum = AgeOptimum(task).solution.cost
    deviation = returns[0].std() / 200**0.5
    assert returns[0].mean() == pytest.approx(optimum, abs=4.0 * deviation + 0.005 * optimum)
    for other in returns[1:]:
        gain = other - returns[0]
        assert gain.mean() > -2.0 * gain.std() / 200**0.5
    assert (returns[3] - returns[0]).mean() > 4.0 * returns[3].std() / 200**0.5


def test_the_index_asks_only_where_the_price_is_worth_it() -> None:
    task = make(3, cost_weight=40.0)
    free, priced = (AgeIndex(task, price=price) for price in (0.0, 40.0))
    rates = [run_episodes(task, policy, 20).rate.mean() for policy in (free, priced)]
    assert rates[0] == pytest.approx(1.0 / 3.0)
    assert 0.05 < rates[1] < 0.8 * rates[0]


def test_the_oldest_sensor_is_first() -> None:
    task = make(3, channel="perfect", drop_probability=None)
    policy, batch = make_policy("maximum_age", task), EpisodeBatch.seeded(task, 5, 0)
    batch.step(np.random.default_rng(0).random((3, 5)) < 0.5)
    for _ in range(6):
        age, requests = batch.signals()["age"], policy(batch.signals())
        assert (requests.sum(0) == 1).all()
        assert (age[requests.argmax(0), np.arange(5)] == age.max(0)).all()
        batch.step(requests)
    late = make_policy("maximum_age:least=10,at_most=none", task)
    assert run_episodes(task, late, 3).rate.mean() == pytest.approx(0.1, abs=0.01)


@pytest.mark.parametrize("access", [{"slots": 1}, {"access": "assignment", "channels": 1}])
def test_the_index_passes_over_sensors_without_energy(access: dict[str, Any]) -> None:
    """No slot is lost to a sensor whose battery is empty."""
    battery = {"tokens": "limited", "budget": "sensor", "harvest": "bernoulli"}
    numbers = {"token_rate": 0.2, "token_capacity": 4.0, "initial_tokens": 1.0}
    task = make(4, **battery | numbers | access)
    batch, policy, empty = EpisodeBatch.seeded(task, 50, 0), AgeIndex(task), 0
    for _ in range(40):
        able = batch.grantable()
        granted = batch.step(policy(batch.signals())).granted
        np.testing.assert_array_equal(granted.any(0), able.any(0))
        empty += int((~able).sum())
    assert empty


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("age_index", {"sources": None}, "vector sources"),
        ("age_optimum", {"sources": None}, "vector sources"),
        ("age_optimum", {"tokens": "limited"}, "tokens = 'limited'"),
        ("age_optimum", {"access": "assignment"}, "access = 'assignment'"),
        ("age_optimum:longest=40", {"sources": (3, 0)}, "300000"),
        ("age_index:longest=1", {}, "longest = 1"),
        ("age_index:price=-1", {}, "price = -1"),
        (
            "age_index",
            {"channel": "independent", "drop_probability": 0.97},
            r"sources\[0\] .* infinite",
        ),
    ],
)
def test_what_has_no_schedule_by_age_is_refused(
    name: str, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigurationError, match=message):
        make_policy(name, make(2, **options))


@pytest.mark.parametrize("myopic", [False, True])
def test_the_highest_index_of_a_pair_is_assigned_first(myopic: bool) -> None:
    """To its channel, and then the highest of the sensors and channels that are left."""
    task = make(4, access="assignment", channels=2)
    policy, batch = AgeIndex(task, myopic=myopic), EpisodeBatch.seeded(task, 6, 0)
    for _ in range(12):
        signals = batch.signals()
        requests, age, states = policy(signals), signals["age"], signals["channel_state"]
        for run in range(6):
            pairs = {
                (i, c): policy.tables[2 * i + c][min(int(age[i, run]), 40) - 1, states[i, c, run]]
                for i in range(4)
                for c in range(2)
            }
            expected = np.zeros(4, dtype=int)
            while pairs:
                sensor, channel = max(pairs, key=pairs.__getitem__)
                expected[sensor] = channel + 1
                pairs = {p: v for p, v in pairs.items() if sensor != p[0] and channel != p[1]}
            np.testing.assert_array_equal(requests[:, run], expected)
        np.testing.assert_array_equal(batch.step(requests).granted, requests > 0)


def test_an_index_by_channel_beats_rules_without_channels() -> None:
    task = make(6, access="assignment", channels=2)
    names = ("age_index", "age_index:myopic=true", "information_gain:threshold=0,at_most=2")
    returns = [run_episodes(task, make_policy(name, task), 200).returns for name in names]
    for better, worse in pairwise(returns):
        gain = better - worse
        assert gain.mean() > 3.0 * gain.std() / 200**0.5


def test_the_index_is_compared_with_the_price_of_each_sensors_packet() -> None:
    """As in tasks in which all packets cost one token, at the price of that sensor's."""
    costs, price = (1.0, 2.5, 4.0), 0.8
    tasks = [make(3, access="any", tokens="unlimited", token_cost=cost) for cost in (costs, 1.0)]
    batch = EpisodeBatch.seeded(tasks[0], 30, 0)
    for step in range(6):
        signals = batch.signals()
        requests = make_policy(f"age_index:price={price}", tasks[0])(signals)
        for sensor, cost in enumerate(costs):
            other = make_policy(f"age_index:price={price * cost}", tasks[1])
            np.testing.assert_array_equal(requests[sensor], other(signals)[sensor])
        batch.step(np.arange(3)[:, None] == (step + np.arange(30)) % 3)
    assert 0.0 < requests.mean() < 1.0


def test_the_optimum_of_one_request_is_that_of_one_slot() -> None:
    two = make(2, access="any", tokens="unlimited", cost_weight=0.01)
    limited, free = (AgeOptimum(two, at_most=most, longest=12) for most in (1, None))
    one = AgeOptimum(make(2, cost_weight=0.01), longest=12)
    np.testing.assert_array_equal(limited.solution.choice, one.solution.choice)
    assert free.solution.cost < limited.solution.cost
