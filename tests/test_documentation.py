"""What the README and the pages show must run, and their tables must name what exists."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import fusion_gym
from agents import report
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.envs.registration import ENVIRONMENTS
from fusion_gym.policies.registry import TRIGGERS

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
PAGES = [path.read_text() for path in sorted((ROOT / "docs").glob("*.md"))]
BLOCKS = re.findall(r"^```(\w*)\n(.*?)^```", README + "".join(PAGES), re.DOTALL | re.MULTILINE)
EXAMPLES = [text for language, text in BLOCKS if language == "python"]


@pytest.mark.parametrize("code", EXAMPLES, ids=range(len(EXAMPLES)))
def test_python_examples_run(code: str) -> None:
    exec(compile(code, "example", "exec"), {})


def test_the_evaluation_command_runs(tmp_path: Path) -> None:
    block = next(text for language, text in BLOCKS if not language and "evaluate" in text)
    words = shlex.split(block.replace("\\\n", " "))
    assert words[0] == "python"
    words[words.index("--json") + 1] = str(tmp_path / "evaluation.json")
    subprocess.run([sys.executable, *words[1:]], cwd=ROOT, check=True, capture_output=True)
    assert (tmp_path / "evaluation.json").exists()


def test_files_and_configs_that_the_readme_names_exist() -> None:
    linked = re.findall(r"\]\(([\w/.]+)\)", README)
    configs = re.findall(r"(?:--config|--sweep) (\S+)", README)
    assert linked
    assert configs
    for name in (*linked, *configs):
        assert (ROOT / name).exists(), name


def test_every_policy_is_in_the_readme() -> None:
    missing = [name for name in TRIGGERS if f"`{name}`" not in README]
    assert not missing


def test_the_committed_report_says_what_the_results_say() -> None:
    found = report.read(ROOT / "results")
    written = (ROOT / "results" / "README.md").read_text()
    assert written == report.text_of(found, "python -m agents.benchmark")
    assert report.headline_count(found) in " ".join(README.split())
    missing = [line for line in report.headline_table(found) if line not in README]
    assert missing == []


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_every_option_and_observation_is_on_the_page(env_id: str) -> None:
    row = re.search(rf"\[`{env_id}`\]\((docs/\w+\.md)\)", README)
    assert row is not None
    page = (ROOT / row[1]).read_text()
    task = fusion_gym.make_task(env_id)
    assert not [name for name in task.settings if f"`{name}`" not in page]
    names = EpisodeBatch(task, 1).layout.names
    assert not [name for name in names if f"`{name.split('[')[0]}" not in page]
