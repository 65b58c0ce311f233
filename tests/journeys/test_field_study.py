"""From a log to the settings of its devices: a study by one command, read and continued."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from command_runs import refusal, succeed

from fusion_gym.commands import field
from fusion_gym.commands.field import AGENT
from fusion_gym.recordings import Recording, field_study
from fusion_gym.recordings.field_study import METHODS


def test_a_study_ends_in_the_settings_of_devices(
    small_studies: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(field, "_WINDOWS", 50)  # of 20 steps
    monkeypatch.setattr(field_study, "_CLOSE", 0.5)
    folder, tanks = tmp_path / "field", Recording.read("tanks")
    replace(tanks, values=tanks.values[:2000]).write(tmp_path / "log.csv")
    words = [str(tmp_path / "log.csv"), "--exact", "--output", str(folder), "--workers", "1"]
    words += ["--timesteps", "300"]
    printed = succeed("field", words).out
    settings = yaml.safe_load((folder / "devices.yaml").read_text())
    assert list(settings) == ["inflow", "middle", "outflow"]
    assert all(row["min_interval"] == 60.0 for row in settings.values())
    assert all(row["max_interval"] == 12_000.0 for row in settings.values())
    assert all(0.1 < row["reportable_change"] < 30.0 for row in settings.values())
    report = (folder / "report.md").read_text()
    for text in (*METHODS, AGENT, "packets per day", "`devices.yaml`", "![Error over packets]"):
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
    before = json.loads((folder / "held_values.json").read_text())
    again = succeed("field", [*words, "--resume"]).out
    assert again == printed
    assert json.loads((folder / "held_values.json").read_text()) == before
