"""The journeys of a user: they run as they stand, and the pages show them so."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest
from page_blocks import blocks_of
from paths import ROOT

import fusion_gym

JOURNEYS = {p.stem: p.read_text() for p in (ROOT / "tests/journeys/scripts").glob("*.py")}
SLOW = pytest.mark.slow
FEW = {
    "1e-3, n_steps=32, batch_size=512": "2e-3, n_steps=8, batch_size=256",
    "300_000": "81_920",
    "episodes=100": "episodes=30",
    "episodes=400": "episodes=100",
}
PAGES = {
    "ten_lines": "README.md",
    "step": "docs/start.md",
    "evaluate": "docs/start.md",
    "train": "docs/start.md",
    "pareto_front": "docs/training.md",
    "own_plant": "docs/your_system.md",
    "read_result": "docs/benchmark.md",
}
LIBRARIES = {"fusion_gym", "gymnasium", "numpy", "stable_baselines3"}


@pytest.mark.parametrize(
    ("name", "few"), [*((name, True) for name in PAGES), pytest.param("train", False, marks=SLOW)]
)
def test_it_runs_in_an_empty_folder(name: str, few: bool, tmp_path: Path) -> None:
    """With fewer steps and episodes; the slow one trains as the page does."""
    script, text = tmp_path / "script.py", JOURNEYS[name]
    for many, less in FEW.items() if few else ():
        text = text.replace(many, less)
    script.write_text(text)
    done = subprocess.run(
        [sys.executable, "-W", "error::UserWarning", script.name],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert any(letter.isdigit() for letter in done.stdout)
    assert "nan" not in done.stdout
    if name == "train":  # the agent, in the last line, beats every rule above it
        returns = [float(line.partition("[")[0].split()[-1]) for line in done.stdout.splitlines()]
        assert returns[-1] > max(returns[:-1])


def test_each_page_shows_its_journey() -> None:
    assert JOURNEYS.keys() == PAGES.keys()
    for name, page in PAGES.items():
        blocks = blocks_of(Path(page), (ROOT / page).read_text())
        assert JOURNEYS[name] in [block.text for block in blocks], (name, page)


@pytest.mark.parametrize("name", PAGES)
def test_it_is_short_and_uses_public_names_alone(name: str) -> None:
    assert len(JOURNEYS[name].splitlines()) <= 25
    for node in ast.walk(ast.parse(JOURNEYS[name])):
        if isinstance(node, ast.Import):
            assert {alias.name for alias in node.names} <= LIBRARIES
        elif isinstance(node, ast.ImportFrom):
            assert node.module in LIBRARIES - {"fusion_gym"}
        elif isinstance(node, ast.Attribute):
            match node.value:
                case ast.Name("fusion_gym"):
                    assert node.attr in fusion_gym.__all__
                case ast.Attribute(ast.Name("fusion_gym"), "evaluation"):
                    assert node.attr in fusion_gym.evaluation.__all__
