"""Reports of devices: change and intervals, against an independent loop."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.policies.base import LocalRule
from fusion_gym.recordings import FittedPlant
from fusion_gym.validation import ConfigurationError

LINEAR = "fusion_gym/LinearFusion-v2"
TWO = {"measurement_matrices": [[1, 0], [[0, 1], [1, 1]]], "tokens": "unlimited"}


@dataclass
class Device:
    """One sensor as its data sheet describes it."""

    change: float
    percent: bool
    least: int
    most: int | None
    reported: Any
    since: int = 0

    def reports(self, value: Any) -> bool:
        self.since += 1
        due = self.most is not None and self.since >= self.most
        for new, old in zip(value, self.reported, strict=True):
            step = self.change / 100.0 * abs(old) if self.percent else self.change
            due = due or (new != old and abs(new - old) >= step * (1.0 - 1e-6))
        if not due or self.since < self.least:
            return False
        self.reported, self.since = value, 0
        return True


@settings(max_examples=40, deadline=None)
@given(
    changes=st.tuples(*[st.floats(0.0, 60.0)] * 2),
    percent=st.booleans(),
    least=st.integers(1, 5),
    more=st.none() | st.integers(0, 9),
    seed=st.integers(0, 99),
)
def test_reports_are_those_of_a_device(
    changes: tuple[float, float], percent: bool, least: int, more: int | None, seed: int
) -> None:
    task = fusion_gym.make_task(LINEAR, **TWO)
    changes = changes if percent else (changes[0] / 20.0, changes[1] / 20.0)
    most = None if more is None else least + more
    settings = {"percent": percent, "min_interval": least, "max_interval": most}
    text = ",".join(f"{name}={str(value).lower()}" for name, value in settings.items())
    listed = "/".join(map(repr, changes))
    rule = fusion_gym.make_policy(f"report_on_change:reportable_change={listed},{text}", task)
    batch = EpisodeBatch.seeded(task, 3, seed)
    held = batch.state.estimate.held
    devices = [
        [Device(changes[s], percent, least, most, held[s, :, n]) for n in range(3)]
        for s in range(2)
    ]
    for _ in range(40):
        value = batch.state.estimate.measurement
        expected = [[devices[s][n].reports(value[s, :, n]) for n in range(3)] for s in range(2)]
        requests = rule(batch.signals())
        np.testing.assert_array_equal(requests, expected)
        batch.step(requests)


@pytest.mark.parametrize("level", [0, 203, 10_000_007])
@pytest.mark.parametrize(
    ("rule", "units"),
    [
        ("report_on_change:reportable_change=0.1", 1),
        ("send_on_delta:threshold=0.3", 3),
        ("report_on_change:reportable_change=0", 0),
        ("report_on_change:reportable_change=50,percent=true", None),
    ],
)
def test_readings_in_steps_are_reported_as_by_a_device_that_compares_integers(
    rule: str, units: int | None, level: int, tmp_path: Path
) -> None:
    """A log in steps of 0.1, with long runs of equal readings; rates by a loop over integers."""
    draw, steps = np.random.default_rng(0), 2000
    change = draw.integers(-2, 3, steps) * (draw.random(steps) < 0.5)
    rain = (draw.random(steps) < 0.2) * draw.integers(1, 9, steps)
    values = rain if units is None else np.abs(np.cumsum(change)) + level
    index = pd.date_range("2026-01-01", periods=steps, freq="15min", name="time")
    pd.DataFrame({"a": [f"{value / 10:.1f}" for value in values]}, index).to_csv(tmp_path / "log")
    one = np.eye(1)
    plant = FittedPlant(("a",), 0.9 * one, one, np.array([1e-12]), 1)
    free = {"log": str(tmp_path / "log"), "tokens": "unlimited", "horizon": 900}
    task = fusion_gym.make_task("fusion_gym/RecordedFusion-v1", **free | plant.options)
    batch, policy = EpisodeBatch.seeded(task, 1, 0), fusion_gym.make_policy(rule, task)
    held, *rest = values[1000:1901]
    for value in rest:
        least = held / 2 if units is None else units
        due = value != held and abs(value - held) >= least
        requests = policy(batch.signals())
        assert requests.item() == due
        held = value if due else held
        batch.step(requests)


RULES = ("adaptive_innovation", "adaptive_threshold", "dynamic_event", "innovation_threshold")
RULES += ("report_on_change", "send_on_delta", "stochastic_event")


@pytest.mark.parametrize("name", RULES)
def test_local_rules_keep_their_intervals(name: str) -> None:
    matrices = [[1, 0], [0, 1], [1, 1]]
    task = fusion_gym.make_task(LINEAR, measurement_matrices=matrices, tokens="unlimited")
    rule = fusion_gym.make_policy(f"{name}:min_interval=3,max_interval=4", task)
    assert isinstance(rule, LocalRule)
    batch = EpisodeBatch.seeded(task, 50, 0)
    rule.reset(50)
    gaps = []
    for _ in range(100):
        age = batch.state.estimate.age
        requests = rule(batch.signals())
        gaps += age[requests].tolist()
        assert (age <= 4).all()
        batch.step(requests)
    assert set(gaps) == {3.0, 4.0}


def test_intervals_that_exclude_each_other_are_refused() -> None:
    task = fusion_gym.make_task(LINEAR)
    with pytest.raises(ConfigurationError, match=r"max_interval = 2 .* >= 3"):
        fusion_gym.make_policy("send_on_delta:min_interval=3,max_interval=2", task)
