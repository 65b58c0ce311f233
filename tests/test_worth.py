"""What knowledge is worth: errors at a grid of rates, and which classes stand beside each other."""

import numpy as np
import pytest
from test_verdict import made_up

from agents.benchmark import verdict
from agents.benchmark.classes import Class, classes_of, trained_classes
from agents.benchmark.config import load_suite
from agents.benchmark.verdict import ClassTests, at_rates, middles, worths
from fusion_gym.core.system import covers

NOISE = np.random.default_rng(0).uniform(0.5, 1.5, 300)


def line(height: float, end: float = 1.0) -> dict[str, object]:
    """Rules on the line from 2 · height at rate 0 to height at rate 1, as far as ``end``."""
    return {
        "never": made_up(0.0, 2 * height * NOISE),
        "last": made_up(end, (2 - end) * height * NOISE),
    }


def build_parts(of: Class, height: float, agents: list[list[float]], factor: float) -> ClassTests:
    """Agents at some rates, each ``factor`` times as good as the rules there."""
    fronts = [
        [made_up(rate, factor * height * (2 - rate) * NOISE) for rate in rates] for rates in agents
    ]
    return ClassTests(of, line(height), fronts, ())  # type: ignore[arg-type]


def test_rules_and_agents_at_a_grid_of_rates() -> None:
    """The agents' errors are mixed of neighbouring prices; beyond their front there is nothing."""
    result = at_rates(
        build_parts(Class("sensors"), 1.0, [[0.08, 0.3], [0.06, 0.25]], 0.9), always=1.0
    )
    assert [row["rate"] for row in result] == pytest.approx(verdict.SHARES)
    for row in result:
        assert row["rules"]["mean"] == pytest.approx((2 - row["rate"]) * NOISE.mean())
        assert row["rules"]["low"] < row["rules"]["mean"] < row["rules"]["high"]
    assert ["agents" in row for row in result] == [False, True, True, False]
    for row in result[1:3]:
        assert row["agents"]["mean"] == pytest.approx(0.9 * row["rules"]["mean"])
        assert row["agents"]["low"] < row["agents"]["mean"] < row["agents"]["high"]
        for value in row["difference"].values():  # the noise is the same for both
            assert value == pytest.approx(-0.1)


def test_the_spread_of_tuning_widens_the_difference() -> None:
    """Two searches that ended 10 % above and below their mean."""
    searches = tuple(((0.0, 2 * share), (1.0, share)) for share in (0.9, 1.1))
    plain = build_parts(Class("sensors"), 1.0, [[0.01, 0.9]], 0.9)
    result = at_rates(ClassTests(plain.of, plain.rules, plain.agents, searches), always=1.0)[2]
    assert result["difference"]["mean"] == pytest.approx(-0.1)
    assert result["difference"]["low"] == pytest.approx(0.9 / 1.1 - 1)
    assert result["difference"]["high"] == pytest.approx(0.9 / 0.9 - 1)


def test_more_knowledge_is_worth_what_it_takes_off_the_error() -> None:
    rates = [[0.01, 0.2, 0.9]]
    classes = {
        item.of.name: item
        for item in (
            build_parts(Class("sensors"), 1.0, rates, 0.8),
            build_parts(Class("sensors", memory=True), 0.5, rates, 0.9),
        )
    }
    (row,) = worths(classes, always=1.0)
    assert (row["kind"], row["knows"], row["less"]) == ("memory", "sensors_memory", "sensors")
    assert row["rules"]["mean"] == pytest.approx(-0.5)
    assert row["agents"]["mean"] == pytest.approx(0.5 * 0.9 / 0.8 - 1)


def test_a_front_that_is_too_short_says_nothing() -> None:
    """Half of the grid must be reached by both."""
    grid = middles(1.0)
    for last, present in ((grid[4], True), (grid[3], False)):
        less = build_parts(Class("sensors"), 1.0, [[0.01, float(last)]], 0.9)
        more = build_parts(Class("sensors", memory=True), 0.5, [[0.01, 0.9]], 0.9)
        (row,) = worths({"sensors": less, "sensors_memory": more}, always=1.0)
        assert ("agents" in row) == present
        assert "rules" in row


def test_only_one_thing_differs_between_two_classes() -> None:
    """In all settings whoever knows more covers the other, and each kind stands where it may."""
    suite = load_suite("benchmark")
    kinds = set()
    for setting in suite.settings:
        every = {c.name: c for c in classes_of(setting)}
        for kind, more, less in verdict.pairs(trained_classes(suite, setting)):
            kinds.add(kind)
            know, other = every[more], every[less]
            assert covers(know.knows, other.knows)
            if kind in ("memory", "deciding together"):
                assert not covers(other.knows, know.knows)
            differ = [
                field for field in ("mode", "memory", "broadcast", "packet")
                if getattr(know, field) != getattr(other, field)
            ]  # fmt: skip
            expected = {
                "memory": ["memory"],
                "hearing": ["broadcast"],
                "packets that hold the estimate": ["packet"],
                "deciding together": ["mode", "broadcast"],
                "seeing measurements": ["mode"],
            }
            assert differ == expected[kind]
    assert kinds == {
        "memory", "hearing", "packets that hold the estimate", "deciding together",
        "seeing measurements",
    }  # fmt: skip
