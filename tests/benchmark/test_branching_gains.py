"""The table of branching's gains: files, fresh episodes, and nothing computed twice."""

from pathlib import Path

import pandas as pd
import pytest

from agents import branching
from fusion_gym import zoo


@pytest.mark.slow
def test_a_class_has_a_row_for_each_price_and_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(branching, "EPISODES", 20)
    monkeypatch.setattr(branching, "CALIBRATION", (2, 8))
    name = "remote_estimation_scheduler"
    command = branching.Branching(work=tmp_path, workers=1, names=(name,), share=1e-4)
    command.run()
    rows = pd.read_csv(tmp_path / "branching.csv")
    prices = zoo.card(name)["test"]["prices"]
    assert rows.groupby("policy").price.apply(list).to_dict() == {
        policy: pytest.approx(prices, rel=1e-3) for policy in ("branching", "zoo")
    }
    assert rows.gain.abs().max() < 20.0
    file = tmp_path / f"{name}_0" / "policy.zip"
    before = file.stat().st_mtime_ns
    command.run()
    assert file.stat().st_mtime_ns == before
    assert name in capsys.readouterr().out
