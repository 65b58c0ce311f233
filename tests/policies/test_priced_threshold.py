"""The priced threshold: the rules that it contains, its numbers, and who knows its scores."""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.knowledge import Signals
from fusion_gym.core.task import Task
from fusion_gym.policies.registry import make_policy
from fusion_gym.policies.rules import PricedThreshold, ValueOfInformation
from fusion_gym.validation import ConfigurationError

Array = NDArray[Any]
PRICE = 0.05


@functools.cache
def task_of(**options: Any) -> Task:
    options = {"filter": "tobit", "token_rate": 2.0, "cost_weight": PRICE} | options
    return fusion_gym.make_task("fusion_gym/TobitOscillator-v1", random_start=True, **options)


def later(task: Task, owner: Any = "scheduler", runs: int = 200) -> EpisodeBatch:
    """Runs after a few steps with few deliveries."""
    batch, draw = EpisodeBatch.seeded(task, runs, 0, owner), np.random.default_rng(0)
    for _ in range(6):
        batch.step(draw.random((task.sensors, runs)) < 0.1)
    return batch


def share(requests: Array) -> None:
    """Neither none nor all."""
    assert 0.0 < requests.mean() < 1.0


@pytest.mark.parametrize("own", [False, True])
def test_it_contains_the_value_of_information(own: bool) -> None:
    """With the tokens of a packet over what a squared error counts, the price is that rule's."""
    task = task_of(memory=True, token_cost=(1.0, 2.0, 4.0))
    worth = tuple((task.network.bucket.cost[:, 0] / task.error_scale).tolist())
    signals = later(task, "own" if own else "scheduler").signals()
    for threshold, exponent, price, other in (
        (worth, 1.0, None, {"price": PRICE}),
        (worth, 1.0, 0.02, {"price": 0.02}),
        (0.03, 0.0, None, {"threshold": 0.03}),
    ):
        rule = PricedThreshold(
            task, own=own, threshold=threshold, price_exponent=exponent, price=price
        )
        requests = rule(signals)
        share(requests)
        expected = ValueOfInformation(task, own=own, **other)(signals)
        np.testing.assert_array_equal(requests, expected)


def scores(rule: PricedThreshold, batch: EpisodeBatch) -> tuple[Array, Array]:
    """v and l of a run's signals, and zero for what is negative."""
    signals = batch.signals()
    if rule.score == "value":
        beliefs: Any = signals["own_beliefs" if rule.own else "beliefs"]
        value, loss = beliefs.value, beliefs.loss
    elif rule.score == "variance":
        value, loss = signals["variance_reduction"], signals["silent_variance"]
    else:
        white = signals["innovation"] / signals["innovation_deviation"]
        value, loss = (white**2).sum(1), (signals["innovation"] ** 2).sum(1)
    return np.maximum(value, 0.0), np.broadcast_to(loss, value.shape)


@pytest.mark.parametrize(
    "settings",
    [
        "threshold=0.01/0.05/0.02,price_exponent=0.5/1/-0.5,reference_price=0.1,mixture=0.3,"
        "token_exponent=-0.7,age_exponent=0.4,margin=2",
        "own=true,threshold=0.02,price_exponent=0.5,mixture=1,age_exponent=-0.4",
        "score=innovation,threshold=1/2/3,price_exponent=0,mixture=0.5",
        "score=variance,threshold=0.02,price_exponent=0,mixture=0.5",
    ],
)
def test_each_number_is_that_of_the_equation(settings: str) -> None:
    """One run after another, in plain numbers."""
    task = task_of(memory=True)
    rule: Any = make_policy(f"priced_threshold:{settings}", task)
    batch = later(task, "own" if rule.own else "scheduler")
    signals, (value, loss) = batch.signals(), scores(rule, batch)
    requests = rule(signals)
    share(requests)
    theta, beta = rule.column("threshold", 3)[:, 0], rule.column("price_exponent", 3)[:, 0]
    for run in range(batch.num_envs):
        tokens = (float(signals["tokens"][run]) + 1.0) / (task.network.bucket.capacity + 1.0)
        ratios = []
        for sensor in range(3):
            age = (float(signals["age"][sensor, run]) + 1.0) / 6.0
            least = theta[sensor] * (PRICE / rule.reference_price) ** beta[sensor]
            least *= tokens**rule.token_exponent * age**rule.age_exponent
            v, other = float(value[sensor, run]), float(loss[sensor, run])
            ratios.append(v ** (1.0 - rule.mixture) * other**rule.mixture / least if v > 0 else 0.0)
        order = sorted(range(3), key=lambda sensor: -ratios[sensor])
        expected = [ratios[sensor] >= rule.margin ** order.index(sensor) for sensor in range(3)]
        expected = [e and ratio > 0.0 for e, ratio in zip(expected, ratios, strict=True)]
        assert requests[:, run].tolist() == expected


def test_a_margin_holds_back_further_sensors() -> None:
    """A wide one leaves the sensor of the highest ratio; ties go to the longest silent."""
    task = task_of(memory=True)
    signals = later(task).signals()
    counts = [
        PricedThreshold(task, threshold=0.05, margin=margin)(signals).sum(0)
        for margin in (1.0, 2.0, 1e9)
    ]
    assert counts[0].max() == 3
    assert (counts[1] <= counts[0]).all()
    assert counts[1].sum() < counts[0].sum()
    np.testing.assert_array_equal(counts[2], np.minimum(counts[0], 1))

    tied = SimpleNamespace(value=np.ones((3, 2)), loss=np.ones((3, 2)))
    ages = {"age": np.array([[1.0, 4.0], [3.0, 4.0], [3.0, 2.0]]), "beliefs": tied}
    single = {"tokens": np.ones(2), "price": np.ones(2)} | ages
    requests = PricedThreshold(task, threshold=0.5, margin=3.0)(Signals(single))
    np.testing.assert_array_equal(requests.T, [[False, True, False], [True, False, False]])


def test_the_price_is_the_runs_own_where_it_is_drawn() -> None:
    task = task_of(memory=True, cost_weight="random", price_range=(0.005, 0.5))
    batch = later(task)
    value, price = batch.beliefs().value, batch.signals()["price"]
    assert np.ptp(price) > 0.1
    requests = PricedThreshold(task, threshold=0.3)(batch.signals())
    share(requests)
    np.testing.assert_array_equal(requests, value >= 0.3 * price)
    fixed = PricedThreshold(task, threshold=0.3, price=0.05)(batch.signals())
    np.testing.assert_array_equal(fixed, value >= 0.3 * 0.05)


@pytest.mark.parametrize(
    ("settings", "parts"),
    [
        ("score=worth", "score = 'worth'.*'value', 'innovation', 'variance'"),
        ("threshold=-1", "threshold = -1"),
        ("threshold=1/2", r"threshold = \(1, 2\)"),
        ("price_exponent=1/2", r"price_exponent = \(1, 2\)"),
        ("price_exponent=high", "price_exponent = 'high'"),
        ("price=-1", "price = -1"),
        ("reference_price=0", "reference_price = 0"),
        ("mixture=1.1", "mixture = 1.1"),
        ("mixture=-0.1", "mixture = -0.1"),
        ("token_exponent=inf", "token_exponent = inf"),
        ("age_exponent=none", "age_exponent = None"),
        ("margin=0.9", "margin = 0.9"),
        ("margin=2,own=true", "margin = 2.*own=True"),
        ("own=true,score=variance", "own = True.*variance"),
        ("own=3", "own = 3"),
    ],
)
def test_what_it_refuses(settings: str, parts: str) -> None:
    with pytest.raises(ConfigurationError, match=parts):
        make_policy(f"priced_threshold:{settings}", task_of())


def test_who_knows_its_scores() -> None:
    """Beliefs by the task's memory; a margin compares sensors; the variance is the centre's."""
    centre = task_of(information="centre")
    for settings, memory, knowledge in (
        ("score=value", False, "scheduler"),
        ("score=value", True, "scheduler_memory"),
        ("own=true", False, "own"),
        ("own=true", True, "own_memory"),
        ("score=innovation", True, "own"),
        ("score=innovation,margin=2", True, "scheduler"),
        ("score=variance,margin=2", True, "centre"),
    ):
        policy: Any = make_policy(f"priced_threshold:{settings}", task_of(memory=memory))
        assert policy.knowledge == knowledge
        assert (policy.memory_owner is None) == ("score=value" not in settings and not policy.own)
    make_policy("priced_threshold:score=variance", centre)
    for score in ("value", "innovation"):
        with pytest.raises(ConfigurationError, match="information = 'centre'"):
            make_policy(f"priced_threshold:score={score}", centre)
