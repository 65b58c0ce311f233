"""The benchmark of what a step costs: its exponents, what it writes, what the page says of it."""

import json
import sys
from pathlib import Path

import pytest

from benchmarks import many_sensors_step
from benchmarks.many_sensors_step import LINEAR, PARTS, REMOTE, Cost, exponents

ROOT = Path(__file__).parent.parent


def test_exponents_are_those_of_powers() -> None:
    costs = [
        Cost(LINEAR, count, size, part, 3.0 * count**1.5 * size**2)
        for count in (3, 25, 50, 200)
        for size in (2, 5, 20)
        for part in PARTS
    ]
    costs += [Cost(REMOTE, n, n, part, 0.1 * n**1.75) for n in (3, 25, 200) for part in PARTS]
    costs[0] = costs[0]._replace(microseconds=1e9)  # a floor below counts for nothing
    result = exponents(costs)
    for part in PARTS:
        assert result[LINEAR][part] == pytest.approx({"sensors": 1.5, "states": 2.0})
        assert result[REMOTE][part] == pytest.approx({"sensors": 1.75})


def test_a_run_writes_figures_and_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(many_sensors_step, "TURNS", 1)
    words = "--sensors 3 25 50 --states 5 10 --seconds 0.001 --output"
    monkeypatch.setattr(sys, "argv", ["program", *words.split(), str(tmp_path)])
    many_sensors_step.main()
    report = json.loads((tmp_path / "step.json").read_text())
    assert len(report["costs"]) == 3 * (2 + 1) * len(PARTS)
    assert all(0.0 < cost["microseconds"] < 1e6 for cost in report["costs"])
    assert set(report["exponents"]) == {LINEAR, REMOTE}
    text = capsys.readouterr().out
    assert "exponent, states" in text
    for name in ("step.png", "step.svg"):
        assert (tmp_path / name).stat().st_size > 10_000


def test_the_page_says_what_was_measured() -> None:
    report = json.loads((ROOT / "results" / "many_sensors" / "step.json").read_text())
    page = (ROOT / "docs" / "speed.md").read_text()
    for env, along in ((LINEAR, "sensors"), (LINEAR, "states"), (REMOTE, "sensors")):
        cells = [f"{report['exponents'][env][part][along]:.2f}" for part in PARTS]
        assert f"| {env} | {along} | | {' | '.join(cells)} |" in page
    for cost in report["costs"]:
        if (cost["sensors"], cost["part"]) == (200, "step") and cost["states"] != 5:
            row = f"| {cost['env']} | 200 | {cost['states']} | {cost['microseconds']:,.0f} |"
            assert row in page
    result = [parts["sensors"] for env in report["exponents"].values() for parts in env.values()]
    assert max(result) <= 2.0  # nothing that is measured grows faster than the square
