"""Run the commands of docs/newcomer.md on its plants, and write their tables into the page.

    python -m benchmarks.newcomer [--resume]

Each YAML block of the page is a plant, whose name is also the folder of its comparison.
``--resume`` skips finished commands and continues an interrupted training.
"""

import json
import os
import re
import shlex
import shutil
import subprocess
import time
from pathlib import Path

import tyro

from fusion_gym import __version__
from fusion_gym.docstrings import table
from fusion_gym.entries import Plain

PAGE = Path(__file__).parent.parent / "docs" / "newcomer.md"
FENCE = re.compile(r"^```(\w+)\n(.*?)^```", re.DOTALL | re.MULTILINE)


def main(resume: bool = False, folder: Path = Path("runs/newcomer")) -> None:
    """Run missing commands, then write tables and figures.

    Args:
        resume: keep finished commands.
        folder: of the commands.
    """
    if not resume:
        shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    text = PAGE.read_text(encoding="utf-8")
    plants = [block for language, block in FENCE.findall(text) if language == "yaml"]
    names = [re.match(r"# (\w+)\.yaml\n", block)[1] for block in plants]  # type: ignore[index]
    shell = "".join(block for language, block in FENCE.findall(text) if language == "bash")
    lines = [line for line in shell.replace("\\\n", " ").splitlines() if line[:10] == "fusion-gym"]
    for name, plant in zip(names, plants, strict=True):
        (folder / f"{name}.yaml").write_text(plant, encoding="utf-8")
    runs = [run(line, folder) for line in lines]
    for name in names:
        comparison = folder / "runs" / name / "comparison"
        text = replaced(text, name, points_table(comparison / "comparison.json"))
        shutil.copy(comparison / "pareto.png", PAGE.with_name(f"newcomer_{name}.png"))
    seconds = table(("command", "seconds", "of the processor"), runs)
    PAGE.write_text(replaced(text, "seconds", seconds), encoding="utf-8")


def run(line: str, folder: Path) -> tuple[str, str, str]:
    """Return the row of a command: its seconds of the wall and of the processor.

    An earlier run is read.
    """
    words = shlex.split(line)
    stored = folder / f"{'_'.join(re.findall(r'[a-z]+', line))[:120]}.json"
    if not stored.exists():
        print(line, flush=True)
        if words[1] == "train" and (folder / words[-1] / "config.yaml").exists():
            words.append("--resume")  # of a training that was cut off
        environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        began, before = time.monotonic(), os.times()
        ended = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True)
        if ended.returncode:
            raise RuntimeError(f"{line} ended with {ended.returncode}: {ended.stderr[-1000:]}")
        after = os.times()
        processor = after.children_user - before.children_user
        stored.write_text(json.dumps([words[1], time.monotonic() - began, processor]))
    command, seconds, processor = json.loads(stored.read_text())
    return f"`{command}`", f"{seconds:.0f}", f"{processor:.0f}"


def points_table(path: Path) -> str:
    """Return the table of the agent and the best rule at each price."""
    rows = []
    for row in json.loads(path.read_text())["prices"]:
        policies: dict[str, Plain] = row["policies"]
        agent = policies.pop("model:best_model.zip")
        best = min(policies, key=lambda name: policies[name]["mean"])
        cost, difference = policies[best]["mean"], agent["difference"]
        ends = (f"{difference[end] / cost:+.1%}" for end in ("low", "high"))
        change = f"{difference['mean'] / cost:+.1%} [{', '.join(ends)}]"
        cells = f"{row['price']:.3g}", f"{agent['mean']:.4g}", f"`{best}`", f"{cost:.4g}"
        rows.append((*cells, change))
    heads = "price", "agent's cost", "best rule", "its cost", "difference"
    return table(heads, rows) + f"\n\nMeasured in fusion-gym {__version__}."


def replaced(text: str, name: str, content: str) -> str:
    """Return the page with new content between the marks of this name."""
    pattern = re.compile(rf"(<!-- table: {name} -->\n).*?(<!-- end -->)", re.DOTALL)
    return pattern.sub(lambda mark: f"{mark[1]}\n{content}\n\n{mark[2]}", text)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
