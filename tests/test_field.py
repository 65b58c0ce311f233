"""fusion-gym field: from a log to the settings of devices."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from fusion_gym.commands import field
from fusion_gym.commands.field import AGENT, Field
from fusion_gym.evaluation import field_study
from fusion_gym.evaluation.field_study import (
    METHODS,
    PRACTICE,
    FieldStudy,
    MethodPoint,
    compare_with_practice,
    point_of,
)
from fusion_gym.systems.tobit.recorded import WindowNoise
from tests.command_runs import refusal, succeed

STUDY = FieldStudy({}, rate=0.05, shape=(1.0, 1.0), horizon=50, source="normal")


def point(factor: float, error: float, spread: float = 0.0, windows: int = 40) -> MethodPoint:
    """A point at a multiple of the target rate, with errors that vary between windows."""
    draw = np.random.default_rng(0).normal(size=windows)
    draw = spread * (draw - draw.mean())
    rates = [[0.05 * factor] * 2] * windows
    return MethodPoint([1.0], error, (error * (1.0 + draw)).tolist(), rates, [1.0, 1.0])


def test_methods_are_compared_at_equal_packets_and_at_equal_error() -> None:
    """Errors that are powers of the rate: closed forms."""
    factors = (0.5, 0.7, 1.0, 1.4, 2.0)
    points = {
        PRACTICE: [point(f, 0.4 / f) for f in factors],
        "silence used": [point(1.3 * f, 0.1 / (1.3 * f)) for f in factors],
        "centralised": [point(f, 0.3 / f, 0.2) for f in factors],
    }
    results = {result.name: result for result in compare_with_practice(STUDY, points)}
    assert results["silence used"].relative.mean == pytest.approx(-0.75, abs=1e-9)
    assert results["silence used"].relative.high == pytest.approx(-0.75, abs=1e-9)
    assert results["silence used"].packets == pytest.approx(0.25, abs=1e-6)
    assert results["centralised"].relative.low < -0.25 < results["centralised"].relative.high
    assert results[PRACTICE].packets == pytest.approx(1.0)
    assert results[PRACTICE].ratio == pytest.approx(1.0)


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_the_interval_is_that_of_blocks_of_five_windows(level: float) -> None:
    """Errors that cancel within a block have none; errors of whole blocks have that of 16."""
    turns = np.tile([2.0, -1.0, -1.0, 1.0, -1.0], 16)
    blocks = np.repeat(np.resize([1.0, -1.0], 16), 5)
    errors = (1.0 + 0.1 * (level * blocks + (1.0 - level) * turns)).tolist()
    rates = [[0.05, 0.05]] * 80
    points = {
        PRACTICE: [MethodPoint([1.0], 1.0, [1.0] * 80, rates, [1.0, 1.0])],
        "centralised": [MethodPoint([1.0], 1.0, errors, rates, [1.0, 1.0])],
    }
    points = {name: own * 2 for name, own in points.items()}
    relative = compare_with_practice(STUDY, points)[1].relative
    expected = level * 1.96 * 0.1 / np.sqrt(16)
    assert relative.mean == pytest.approx(0.0, abs=1e-12)
    assert relative.high - relative.mean == pytest.approx(expected, rel=0.1, abs=1e-12)
    assert relative.mean - relative.low == pytest.approx(expected, rel=0.1, abs=1e-12)


def test_errors_are_means_of_the_steps_with_readings() -> None:
    """Half the readings of the second sensor are absent, and their errors count as zero."""
    known = np.zeros((8, 2))
    known[::2, 1] = np.nan
    rows = np.hstack([np.zeros((8, 2)), known])
    noise = WindowNoise(np.zeros((2, 7)), rows, np.array([0, 4]), 2)
    study: Any = SimpleNamespace(
        task=lambda *names: SimpleNamespace(noise=noise),
        shape=(1.0, 1.0), options={"state_weights": [0.5, 0.125, 0.0]},
    )  # fmt: skip
    squared = np.array([[1.0, 2.0, 7.0], [3.0, 6.0, 7.0]])  # of two windows
    cost = squared @ study.options["state_weights"]
    real: Any = SimpleNamespace(squared_error=squared, error_cost=cost, rate=np.zeros((2, 2)))
    result = point_of(study, [1.0], SimpleNamespace(error_cost=np.ones(3)), real)  # type: ignore[arg-type]
    assert result.deviations == pytest.approx(np.sqrt([2.0, 4.0 / 0.5]))
    assert np.mean(result.errors) == pytest.approx(0.5 * 2.0 + 0.125 * 4.0 / 0.5)
    assert result.errors[1] == pytest.approx(3.0 * result.errors[0])


def test_a_study_ends_in_the_settings_of_devices(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = {"_TRIALS": 2, "_EPISODES": 4, "_CLOSE": 0.5, "FACTORS": (0.5, 1.0, 2.0), "RESAMPLES": 20}
    for name, value in few.items():
        monkeypatch.setattr(field_study, name, value)
    monkeypatch.setattr(field, "_WINDOWS", 150)  # of 20 steps
    folder = tmp_path / "field"
    words = ["tanks", "--exact", "--output", str(folder), "--timesteps", "2000", "--workers", "1"]
    printed = succeed("field", words).out
    settings = yaml.safe_load((folder / "devices.yaml").read_text())
    assert list(settings) == ["inflow", "middle", "outflow"]
    assert all(row["min_interval"] == 60.0 for row in settings.values())
    assert all(row["max_interval"] == 12_000.0 for row in settings.values())
    assert all(0.1 < row["reportable_change"] < 30.0 for row in settings.values())
    report = (folder / "report.md").read_text()
    for text in (*METHODS, AGENT, "packets a day", "`devices.yaml`", "![Error over packets]"):
        assert text in report
    assert printed.strip() in report
    assert "<table>" in (folder / "report.html").read_text()
    assert {path.name for path in folder.glob("*.png")} == {"card.png", "curves.png"}
    code = report.split("```python\n")[1].split("```")[0]
    monkeypatch.chdir(folder)
    exec(code, {})
    assert "already holds a study" in refusal("field", words)
    assert "target_rate = 0.1 differs" in refusal("field", [*words, "--target-rate=.1", "--resume"])
    (folder / "silence_used.json").unlink()
    before = json.loads((folder / "practice.json").read_text())
    again = succeed("field", [*words, "--resume"]).out
    assert again == printed
    assert json.loads((folder / "practice.json").read_text()) == before


def test_a_channel_with_noise_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    draw = np.random.default_rng(0)
    lines = ["time,a"]
    level = 0.0
    for step in range(3000):
        level = 0.95 * level + draw.normal()
        lines.append(f"{60 * step + 1_700_000_000},{level + 2.0 * draw.normal():.3f}")
    (tmp_path / "log.csv").write_text("\n".join(lines))
    output = tmp_path / "field"
    error = refusal("field", [str(tmp_path / "log.csv"), "--output", str(output)])
    assert "give --exact if they are" in error
    assert not output.exists()


def test_an_interrupt_says_how_to_continue() -> None:
    command = Field("log.csv")
    assert command.again().endswith("--resume")
