"""Every trigger against its rule, written again for one run and one step in plain numbers."""

import itertools
import math
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray
from rules import make_rule

from fusion_gym import ConfigurationError, make_task
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.knowledge import covers
from fusion_gym.policies.registry import make_policy, parse_value, policy_names

ENV_ID = "fusion_gym/TobitOscillator-v1"
SENSORS = 3


def make_vector(num_envs: int, **options: Any) -> Any:
    return gymnasium.make_vec(
        ENV_ID,
        num_envs,
        vectorization_mode="vector_entry_point",
        autoreset_mode="SameStep",
        **options,
    ).unwrapped


def norm(vector: Any) -> float:
    return math.sqrt(sum(float(entry) ** 2 for entry in vector))


class ScalarDynamicEvent:
    """The dynamic event trigger of one sensor in one run, equations (11) to (15)."""

    def __init__(self, sigma: float, decay: float, divisor: float, initial: float) -> None:
        self.sigma, self.decay, self.divisor, self.initial = sigma, decay, divisor, initial

    def restart(self, known: list[float]) -> None:
        self.eta, self.sent = self.initial, known

    def request(self, measurement: list[float]) -> bool:
        size = norm([a - b for a, b in zip(self.sent, measurement, strict=True)])
        answer = size >= self.eta / self.divisor + self.sigma
        if answer:
            self.sent, size = measurement, 0.0
        self.eta = max(self.decay * self.eta + self.sigma - size, 0.0)
        return answer


@pytest.mark.parametrize(
    ("text", "sigma", "decay", "divisor", "initial"),
    [
        ("", (0.1, 0.2, 0.3), (0.1, 0.2, 0.1), (5.0,) * 3, (1.5,) * 3),
        ("scale=4", (0.4, 0.8, 1.2), (0.1, 0.2, 0.1), (5.0,) * 3, (6.0,) * 3),
        ("threshold=0.6,decay=0.9/0.5/0.05,divisor=2/1.5/0.5,initial=0/3/3", (0.6,) * 3,
         (0.9, 0.5, 0.05), (2.0, 1.5, 0.5), (0.0, 3.0, 3.0)),
    ],
    ids=["paper", "scaled", "own"],
)  # fmt: skip
def test_dynamic_event(text: str, sigma: Any, decay: Any, divisor: Any, initial: Any) -> None:
    """Runs restart at different times; what was requested counts, not what was granted."""
    runs = 5
    env = make_vector(runs, horizon=17, token_rate=2.0)
    policy = make_policy(f"dynamic_event:{text}" if text else "dynamic_event", env.task)
    env.reset(seed=3)
    policy.reset(runs)
    scalars = {
        (s, run): ScalarDynamicEvent(sigma[s], decay[s], divisor[s], initial[s])
        for s in range(SENSORS)
        for run in range(runs)
    }
    fresh = np.ones(runs, dtype=bool)
    total = clipped = lost = 0
    for step in range(80):
        signals = env.batch.signals()
        for (s, run), scalar in scalars.items():
            if fresh[run]:
                scalar.restart(signals["held"][s, :, run].tolist())
        expected = np.array(
            [
                [scalars[s, run].request(signals["measurement"][s, :, run].tolist())
                 for run in range(runs)]
                for s in range(SENSORS)
            ]
        )  # fmt: skip
        requests = policy(signals)
        np.testing.assert_array_equal(requests, expected)
        *_, fresh, info = env.step(requests.T.astype(np.int8))
        total += requests.sum()
        clipped += sum(scalar.eta == 0.0 for scalar in scalars.values())
        lost += info["denied"].sum()
        if step in (4, 9):  # from here on episodes end at three different times
            mask = np.arange(runs) == step // 4
            env.reset(options={"reset_mask": mask})
            fresh = fresh | mask
    assert 0 < total < requests.size * 80
    assert clipped > 0
    assert lost > 0


def limited(score: list[float], requests: list[bool], age: list[float], at_most: int) -> list[bool]:
    """The highest scores; the longer silent of equals, then the first."""
    order = sorted(range(SENSORS), key=lambda s: (-score[s], -age[s], s))
    best = [s for s in order if requests[s]][:at_most]
    return [s in best for s in range(SENSORS)]


Rule = Callable[[dict[str, Any]], list[bool]]


def moved_by(*threshold: float) -> Rule:
    return lambda g: [
        norm(g["measurement"][s] - g["held"][s]) >= threshold[s] for s in range(SENSORS)
    ]


def surprise(g: dict[str, Any], whitened: bool) -> list[float]:
    difference = g["measurement"] - g["expected_measurement"]
    return [
        norm(difference[s] / g["innovation_deviation"][s] if whitened else difference[s])
        for s in range(SENSORS)
    ]


def surprised_by(*threshold: float, whitened: bool = False, at_most: int = SENSORS) -> Rule:
    def rule(g: dict[str, Any]) -> list[bool]:
        size = surprise(g, whitened)
        return limited(
            size, [a >= b for a, b in zip(size, threshold, strict=True)], g["age"], at_most
        )

    return rule


def uncertain_by(threshold: float, at_most: int) -> Rule:
    return lambda g: limited(
        list(g["variance_reduction"]),
        [g["silent_variance"] >= threshold] * SENSORS,
        g["age"],
        at_most,
    )


def gaining(threshold: float, at_most: int) -> Rule:
    def rule(g: dict[str, Any]) -> list[bool]:
        gain = [
            g["variance_reduction"][s] / g["silent_variance"] / g["token_cost"][s]
            for s in range(SENSORS)
        ]
        return limited(gain, [value >= threshold for value in gain], g["age"], at_most)

    return rule


RULES: list[tuple[str, Rule]] = [
    ("always", lambda g: [True] * SENSORS),
    ("never", lambda g: [False] * SENSORS),
    ("send_on_delta", moved_by(1.0, 1.0, 1.0)),
    ("send_on_delta:threshold=0.5/1.5/3", moved_by(0.5, 1.5, 3.0)),
    ("innovation_threshold", surprised_by(1.0, 1.0, 1.0)),
    ("innovation_threshold:threshold=0.4/0.9/1.4", surprised_by(0.4, 0.9, 1.4)),
    (
        "innovation_threshold:threshold=1.2,whitened=true",
        surprised_by(1.2, 1.2, 1.2, whitened=True),
    ),
    (
        "innovation_threshold:threshold=0.8,whitened=true,at_most=1",
        surprised_by(0.8, 0.8, 0.8, whitened=True, at_most=1),
    ),
    ("innovation_threshold:threshold=0.7,at_most=2", surprised_by(0.7, 0.7, 0.7, at_most=2)),
    ("variance_threshold", uncertain_by(0.1, 1)),
    ("variance_threshold:threshold=0.05,at_most=2", uncertain_by(0.05, 2)),
    ("variance_threshold:threshold=0.15,at_most=none", uncertain_by(0.15, 3)),
    ("information_gain", gaining(0.05, 1)),
    ("information_gain:threshold=0.08,at_most=none", gaining(0.08, 3)),
    ("information_gain:threshold=0.02,at_most=2", gaining(0.02, 2)),
    ("periodic", lambda g: [(g["step"] - phase) % 4 == 0 for phase in (0, 1, 2)]),
    ("periodic:period=6", lambda g: [(g["step"] - phase) % 6 == 0 for phase in (0, 2, 4)]),
    ("periodic:period=5,staggered=false", lambda g: [g["step"] % 5 == 0] * SENSORS),
    ("round_robin", lambda g: [place == 0 for place in g["queue"]]),
    ("round_robin:period=2", lambda g: [place == g["step"] % 2 * 9 for place in g["queue"]]),
]  # fmt: skip


LOOKED_AT = ("measurement", "held", "expected_measurement", "innovation_deviation")
LOOKED_AT += ("age", "variance_reduction", "silent_variance", "step", "queue")


@pytest.mark.parametrize(("spec", "rule"), RULES, ids=[spec for spec, _ in RULES])
def test_triggers_against_their_rules(spec: str, rule: Rule) -> None:
    runs, count = 4, 0
    for kind in ("paper", "tobit"):
        env = make_vector(
            runs,
            horizon=26,
            filter=kind,
            token_cost=(2.0, 2.5, 3.0),
            measurement_variance=((0.5,), (0.4,), (0.3,)),
        )
        policy = make_policy(spec, env.task)
        env.reset(seed=8)
        policy.reset(runs)
        for step in range(55):
            if step == 10:
                env.reset(options={"reset_mask": np.arange(runs) < 2})
            signals = env.batch.signals()
            requests = policy(signals)
            assert requests.dtype == np.bool_
            assert requests.shape == (SENSORS, runs)
            for run in range(runs):
                arguments = {name: signals[name][..., run] for name in LOOKED_AT}
                arguments["token_cost"] = signals["token_cost"][:, 0]
                assert requests[:, run].tolist() == rule(arguments)
            count += int(requests.sum())
            env.step(requests.T.astype(np.int8))
    if spec not in ("always", "never"):
        assert 0 < count < 2 * 55 * SENSORS * runs


def test_equal_scores_go_to_the_sensor_that_was_silent_longer() -> None:
    policy = make_rule("innovation_threshold:threshold=1,at_most=2")
    signals: Any = {
        "tokens": np.ones(2),
        "token_cost": np.ones((4, 1)),
        "innovation": np.array([[[2.0, 2.0]], [[2.0, 2.0]], [[2.0, 3.0]], [[0.5, 0.5]]]),
        "age": np.array([[1.0, 1.0], [5.0, 1.0], [3.0, 1.0], [9.0, 9.0]]),
    }
    assert policy(signals).T.tolist() == [[False, True, True, False], [True, False, True, False]]


def test_random_rate_and_stream() -> None:
    batch = EpisodeBatch(make_task(ENV_ID), 500)
    batch.reset()
    signals = batch.signals()
    rates = np.array([0.05, 0.5, 0.9])
    policy = make_rule("random:rate=0.05/0.5/0.9")

    def draw(seed: int) -> NDArray[np.bool_]:
        policy.reset(500, seed)
        return np.array([policy(signals) for _ in range(100)])

    first = draw(4)
    deviation = np.sqrt(rates * (1 - rates) / 50_000)
    assert (np.abs(first.mean((0, 2)) - rates) < 4.5 * deviation).all()
    np.testing.assert_array_equal(draw(4), first)
    assert not np.array_equal(draw(5), first)
    for left_value, other in itertools.combinations(range(SENSORS), 2):
        correlation = np.corrcoef(first[:, left_value].ravel(), first[:, other].ravel())[0, 1]
        assert abs(correlation) < 0.02
    for rate, expected in ((0, False), (1, True)):
        assert (make_rule(f"random:rate={rate}")(signals) == expected).all()


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("3", 3),
        ("-1e-3", -0.001),
        (" False", False),
        ("none", None),
        ("0.1/0.2/0.3", (0.1, 0.2, 0.3)),
        ("runs/agent", "runs/agent"),
        ("-inf", -math.inf),
    ],
)
def test_values_from_text(text: str, value: Any) -> None:
    parsed = parse_value(text)
    assert parsed == value
    assert type(parsed) is type(value)


def test_parameters_come_from_the_text_then_the_scenario_then_the_trigger() -> None:
    task = make_task(ENV_ID, trigger_threshold=(0.7, 0.8, 0.9), trigger_divisor=3.0)
    policy: Any = make_policy("dynamic_event:decay=0.4,divisor=1/2/3", task)
    assert policy.threshold == (0.7, 0.8, 0.9)
    assert policy.divisor == (1, 2, 3)
    assert policy.decay == 0.4
    assert policy.scale == 1.0
    plain: Any = make_rule("dynamic_event")
    assert (plain.threshold, plain.divisor) == (0.2, 5.0)


@pytest.mark.parametrize("name", policy_names("rule"))
def test_what_the_centre_cannot_know_is_refused(name: str) -> None:
    """And a signal that it may know, but that this system does not have."""
    centre, received = covers("centre", make_rule(name).knowledge), ""
    try:
        make_policy(name, make_task(ENV_ID, information="centre"))
    except ConfigurationError as error:
        received = str(error)
    allowed = "unknown signal" if centre else "signal"
    assert received.startswith(f"policy '{name}': {allowed} '") or (centre and not received)
    assert centre == ("information='centre'" not in received)
