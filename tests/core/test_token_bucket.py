"""The token bucket against a scalar loop, its properties, and what it refuses."""

import math
from typing import Any, get_args

import numpy as np
import pytest
from buckets import make_bucket
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion_gym import ConfigurationError, make_task
from fusion_gym.core.knowledge import Signals
from fusion_gym.core.token_bucket import SharingRule, TokenBucket
from fusion_gym.policies.rules import RoundRobin

SHARING: tuple[SharingRule, ...] = get_args(SharingRule)
PAPER = {"rate": 5.0, "capacity": 30.0, "initial": 10.0, "cost": 3.0, "sensors": 3}


def scalar_step(
    tokens: float,
    requests: list[bool],
    costs: list[float],
    rate: float,
    capacity: float,
    sharing: str,
    queue: list[int],
) -> tuple[list[bool], float, float]:
    """(16)-(18), and the rules that serve one sensor after another, in plain Python.

    ``queue`` holds the sensors in its order, and is moved.
    """
    sensors = len(costs)
    granted = [False] * sensors
    if sharing == "equal":
        for m in range(sensors):
            granted[m] = requests[m] and costs[m] <= tokens / sensors
    else:
        left = tokens
        for m in list(queue) if sharing == "turns" else range(sensors):
            if requests[m] and costs[m] <= left:
                granted[m] = True
                left -= costs[m]
            elif requests[m] and sharing == "turns":
                break
    queue.sort(key=granted.__getitem__)
    spent = math.fsum(cost for cost, grant in zip(costs, granted, strict=True) if grant)
    return granted, spent, min(tokens + rate - spent, capacity)


# Eighths: sums, differences and the comparison with a multiple of a cost are then exact.
eighths = st.integers(1, 80).map(lambda number: number / 8)


@st.composite
def buckets(draw: st.DrawFn, sharing: str | None = None, unlimited: bool = False) -> TokenBucket:
    sensors = draw(st.integers(1 if sharing is None else 2, 5))
    costs = draw(st.lists(eighths, min_size=sensors, max_size=sensors))
    capacity = sensors * max(costs) + draw(eighths)
    return make_bucket(
        rate=draw(st.one_of(st.just(0.0), eighths)),
        capacity=capacity,
        initial=draw(st.integers(0, int(8 * capacity))) / 8,
        cost=costs,
        sensors=sensors,
        sharing=draw(st.sampled_from(SHARING if sharing is None else [sharing])),
        unlimited=unlimited,
    )


def random_requests(bucket: TokenBucket, runs: int, steps: int, seed: int) -> Any:
    generator = np.random.default_rng(seed)
    eagerness = generator.random((len(bucket.cost), runs))
    return generator.random((steps, len(bucket.cost), runs)) < eagerness


@given(bucket=buckets(), seed=st.integers(0, 2**31))
@settings(max_examples=150, deadline=None)
def test_random_buckets_agree_with_the_scalar_loop(bucket: TokenBucket, seed: int) -> None:
    requests = random_requests(bucket, 3, 12, seed)
    tokens = bucket.start(3)
    costs = bucket.cost[:, 0].tolist()
    queues = [list(range(len(costs))) for _ in range(3)]
    queue = bucket.start_queue(3)
    for request in requests:
        answer = bucket.grant(tokens, request, queue)
        for run in range(3):
            granted, spent, left = scalar_step(
                tokens[run],
                request[:, run].tolist(),
                costs,
                bucket.rate,
                bucket.capacity,
                bucket.sharing,
                queues[run],
            )
            assert answer.granted[:, run].tolist() == granted
            assert answer.queue[:, run].tolist() == np.argsort(queues[run]).tolist()
            assert (answer.spent[run], answer.tokens[run]) == (spent, left)
        tokens, queue = answer.tokens, answer.queue


@given(bucket=buckets("turns"), seed=st.integers(0, 2**31), steps=st.integers(1, 120))
@settings(max_examples=150, deadline=None)
def test_turns_favour_nobody_who_requests_alike(bucket: TokenBucket, seed: int, steps: int) -> None:
    """In every window two sensors that request alike differ by at most one grant."""
    runs = 16
    requests = random_requests(bucket, runs, steps, seed)
    requests[:, 1] = requests[:, 0]
    tokens, queue, ahead = bucket.start(runs), bucket.start_queue(runs), [np.zeros(runs)]
    for request in requests:
        answer = bucket.grant(tokens, request, queue)
        tokens, queue = answer.tokens, answer.queue
        ahead.append(ahead[-1] + answer.granted[0] - answer.granted[1])
    assert np.ptp(ahead, axis=0).max() <= 1


@given(bucket=buckets(), period=st.integers(1, 4))
@settings(max_examples=300, deadline=None)
def test_the_round_robin_rule_passes_its_turn_when_granted(
    bucket: TokenBucket, period: int
) -> None:
    """Whatever costs, rate and sharing: grants go round in order, so that no window favours one."""
    rule = RoundRobin(period)
    tokens, queue, served = bucket.start(1), bucket.start_queue(1), []
    for step in np.arange(60)[:, None]:
        request = rule(Signals({"queue": queue, "step": step}))
        assert request.sum() == (step[0] % period == 0)
        granted, _, tokens, queue = bucket.grant(tokens, request, queue)
        served += np.flatnonzero(granted).tolist()
    assert served == [number % len(bucket.cost) for number in range(len(served))]


@given(sensors=st.integers(1, 20), seed=st.integers(0, 2**31), sharing=st.sampled_from(SHARING))
@settings(max_examples=200, deadline=None)
def test_a_run_is_answered_alone_as_in_a_batch(sensors: int, seed: int, sharing: str) -> None:
    """Bitwise, whatever the costs, and the queue stays an order of all sensors."""
    generator = np.random.default_rng(seed)
    cost = generator.random(sensors) + 0.1
    bucket = make_bucket(0.3, 25.0, 9.0, cost, sensors, sharing)
    tokens, queue = bucket.start(5), bucket.start_queue(5)
    for request in random_requests(bucket, 5, 8, seed):
        answer = bucket.grant(tokens, request, queue)
        alone = bucket.grant(tokens[3:4], request[:, 3:4], queue[:, 3:4])
        for one, every in zip(alone, answer, strict=True):
            np.testing.assert_array_equal(one[..., 0], every[..., 3])
        assert (np.sort(answer.queue, axis=0) == np.arange(sensors)[:, None]).all()
        tokens, queue = answer.tokens, answer.queue


@pytest.mark.parametrize("sensors", range(2, 7))
def test_round_robin_access_resonates_where_grants_differ(sensors: int) -> None:
    """Of all costs and rates up to 12 eighths, one run each."""
    numbers = np.arange(1, 13)
    cost, rate = (axis.ravel() / 8 for axis in np.meshgrid(numbers, numbers))
    capacity, ones = (3 + 8 * sensors) * cost, np.ones((sensors, 1))
    single = [make_bucket(r, m, 0.0, c, sensors, "fixed")
              for r, m, c in zip(rate, capacity, cost, strict=True)]  # fmt: skip
    bucket = make_bucket(1.0, 100.0, 0.0, 1.0, sensors, "turns")
    every: Any = {"rate": rate, "capacity": capacity, "cost": cost * ones}
    vars(bucket).update(every)
    tokens, grants, rounds = bucket.start(len(rate)), 0.0 * every["cost"], 480
    for step in range(rounds * sensors):
        request = (np.arange(sensors) == step % sensors)[:, None] & (cost > 0.0)
        granted, _, tokens, _ = bucket.grant(tokens, request)
        grants += granted * (step >= rounds * sensors // 2)
    resonates = [own.resonates for own in single]
    np.testing.assert_array_equal(resonates, np.ptp(grants, axis=0) > 3)


@given(
    costs=st.lists(eighths, min_size=2, max_size=5),
    rate=eighths,
    sharing=st.sampled_from(SHARING),
)
def test_no_turn_is_lost_in_the_end_unless_cheaper_sensors_are_favoured(
    costs: list[float], rate: float, sharing: str
) -> None:
    sensors = len(costs)
    bucket = make_bucket(rate, sensors * max(costs), 0.0, costs, sensors, sharing)
    tokens, grants, rounds = bucket.start(1), np.zeros(sensors), 4 * sensors + 4
    for step in range(rounds * sensors):
        request = (np.arange(sensors) == step % sensors)[:, None]
        granted, _, tokens, _ = bucket.grant(tokens, request)
        grants += granted[:, 0] * (step >= rounds * sensors // 2)
    if min(costs) < max(costs):
        assert bucket.favours_cheaper or (grants == rounds // 2).all()
    assert not (bucket.favours_cheaper and rate >= max(costs))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"token_capacity": 8.0, "initial_tokens": 1.0, "sharing": "turns"}, "below 9, the cost"),
        ({"access": "round_robin", "token_rate": 1.0}, "favour some of the 3 sensors"),
        ({"access": "round_robin", "token_rate": 1.0, "token_cost": [1, 3, 3]}, "dearer sensors"),
        ({"access": "random", "token_rate": 1.0, "token_cost": [1, 3, 3]}, "dearer sensors"),
    ],
)
def test_a_bucket_that_favours_sensors_is_warned_of(options: dict[str, Any], message: str) -> None:
    with pytest.warns(UserWarning, match=message):
        make_task("fusion_gym/TobitOscillator-v1", **options)


@given(
    cost=st.floats(0.01, 100.0),
    sensors=st.integers(1, 9),
    rate=st.floats(0.0, 50.0),
    seed=st.integers(0, 2**31),
)
@settings(max_examples=100, deadline=None)
def test_limits_hold_for_any_numbers_up_to_rounding(
    cost: float, sensors: int, rate: float, seed: int
) -> None:
    capacity = 1.5 * sensors * cost
    bucket = make_bucket(rate, capacity, capacity, cost, sensors)
    tokens = bucket.start(2)
    for requests in random_requests(bucket, 2, 20, seed):
        answer = bucket.grant(tokens, requests)
        assert np.all(answer.spent <= tokens * (1 + 1e-14))
        assert np.all(answer.tokens >= -1e-14 * capacity)
        assert np.all(answer.tokens <= capacity)
        tokens = answer.tokens


@given(bucket=buckets(unlimited=True), seed=st.integers(0, 2**31))
@settings(max_examples=50, deadline=None)
def test_unlimited_grants_everything_and_counts_it(bucket: TokenBucket, seed: int) -> None:
    requests = random_requests(bucket, 4, 1, seed)[0]
    tokens = bucket.start(4)
    answer = bucket.grant(tokens, requests)
    assert np.array_equal(answer.granted, requests)
    assert np.array_equal(answer.spent, requests.T.astype(float) @ bucket.cost[:, 0])
    assert answer.tokens.tolist() == [bucket.capacity] * 4
    answer.granted[:] = False  # the caller's requests are not shared
    assert np.array_equal(requests, random_requests(bucket, 4, 1, seed)[0])


def test_an_unlimited_bucket_needs_no_capacity_for_a_transmission() -> None:
    bucket = make_bucket(0.0, 1.0, 1.0, 3.0, 3, unlimited=True)
    answer = bucket.grant(bucket.start(1), np.ones((3, 1), dtype=np.bool_))
    assert answer.granted.all()


@pytest.mark.parametrize(
    ("change", "field", "value"),
    [
        ({"capacity": 8.0}, "token_capacity", "8"),
        ({"capacity": 2.0, "initial": 1.0, "sharing": "fixed"}, "token_capacity", "2"),
        ({"cost": (1.0, 1.0, 11.0)}, "token_capacity", "30"),
        ({"capacity": 0.0}, "token_capacity", "0.0"),
        ({"cost": -3.0}, "token_cost", "-3.0"),
        ({"cost": 0.0}, "token_cost", "0.0"),
        ({"cost": (1.0, 2.0)}, "token_cost", r"\(1.0, 2.0\)"),
        ({"rate": -1.0}, "token_rate", "-1.0"),
        ({"initial": 31.0}, "initial_tokens", "31.0"),
        ({"initial": -0.5}, "initial_tokens", "-0.5"),
        ({"sharing": "even"}, "sharing", "even"),
    ],
)
def test_bad_input_is_refused_by_name_and_value(
    change: dict[str, Any], field: str, value: str
) -> None:
    with pytest.raises(ConfigurationError, match=rf"^{field} = '?{value}'? is not allowed: "):
        make_bucket(**(PAPER | change))


def test_the_least_capacity_is_accepted() -> None:
    assert make_bucket(**(PAPER | {"capacity": 9.0, "initial": 9.0})).capacity == 9.0
    fixed = make_bucket(**(PAPER | {"capacity": 3.0, "initial": 0.0, "sharing": "fixed"}))
    assert fixed.capacity == 3.0


@pytest.mark.parametrize("sharing", SHARING)
def test_tokens_that_add_up_pay_for_a_transmission(sharing: str) -> None:
    """Ten times 0.1 is a little less than 1 in floating point, and still enough."""
    bucket = make_bucket(rate=0.1, capacity=2.0, initial=0.0, cost=1.0, sensors=1, sharing=sharing)
    tokens = bucket.start(1)
    for _ in range(10):
        granted, spent, tokens, _ = bucket.grant(tokens, np.zeros((1, 1), dtype=np.bool_))
        assert not granted.any()
        assert spent[0] == 0.0
    granted, spent, tokens, _ = bucket.grant(tokens, np.ones((1, 1), dtype=np.bool_))
    assert granted.all()
    assert tokens[0] >= 0.0
