"""The quick benchmark's verdicts beside those of the full one."""

import io
import json
from pathlib import Path

from rich.console import Console

from fusion_gym.agents.suite.agreement import agreement_table


def verdict(folder: Path, **middles: tuple[float, float, float] | None) -> Path:
    classes = {
        name: {}
        if middle is None
        else {"middle": dict(zip(("low", "mean", "high"), middle, strict=True))}
        for name, middle in middles.items()
    }
    (folder / "plant").mkdir(parents=True)
    (folder / "plant" / "verdict.json").write_text(json.dumps({"classes": classes}))
    return folder


def test_verdicts_agree_where_their_intervals_meet(tmp_path: Path) -> None:
    quick = verdict(tmp_path / "quick", sensors=(-0.1, -0.05, 0.0), centre=(0.1, 0.2, 0.3))
    full = verdict(
        tmp_path / "full", sensors=(0.0, 0.01, 0.02), centre=(-0.3, -0.2, -0.1), local=(0, 0, 0)
    )
    table = agreement_table(quick, full, ["plant", "another"])
    assert table is not None
    text = io.StringIO()
    Console(file=text, width=150).print(table)
    output = text.getvalue()
    assert "1 of 2 verdicts agree" in output
    assert [line.split()[-1] for line in output.splitlines() if "%]" in line] == ["yes", "no"]
    assert "local" not in output


def test_nothing_is_compared_where_nothing_is_there(tmp_path: Path) -> None:
    quick = verdict(tmp_path / "quick", sensors=(-0.1, -0.05, 0.0), centre=None)
    full = verdict(tmp_path / "full", centre=(0.1, 0.2, 0.3))
    assert agreement_table(quick, full, ["plant"]) is None
