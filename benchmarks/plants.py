"""Train and judge on plants that nobody tuned: the lines of docs/newcomer.md on each of them.

    python -m benchmarks.plants [PLANT …] [--output runs/plants] [--resume]

The plants are those of ``benchmarks/plants.yaml``. An agent trains by ``linear_fusion_front``. At
seven prices it is compared with the rules of ``scale_free_sweep``, which have the same memory. The
table has the differences to their lower envelope at 10 to 40 % of the rate of ``always``.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from statistics import fmean, median
from typing import Any

import yaml
from rich.table import Table

from fusion_gym.agents.output import tables
from fusion_gym.agents.output.ending import report_errors
from fusion_gym.agents.training.run import holds_training
from fusion_gym.validation import choice

PLANTS: dict[str, Any] = yaml.safe_load(Path(__file__).with_name("plants.yaml").read_text())
LOW, HIGH = 0.1, 0.4  # of the rate of `always`: where fronts are judged


def main() -> None:
    """Run the plants that the command line names, or all, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("plants", nargs="*", metavar="PLANT", help="all by default")
    parser.add_argument("--output", type=Path, default=Path("runs/plants"))
    parser.add_argument("--episodes", type=int, default=300)
    parser.add_argument("--timesteps", type=int, help="in the place of the config's")
    parser.add_argument("--resume", action="store_true", help="keep what is finished")
    arguments = parser.parse_args()
    table = Table(
        "plant", "seconds", "rates", "points", "median", "least", "most", title="agent over rules"
    )
    with report_errors():
        for name in arguments.plants or PLANTS:
            choice("plant", name, PLANTS)
            table.add_row(name, *judged(name, arguments))
            tables.console().print(table)


def judged(name: str, arguments: argparse.Namespace) -> list[str]:
    """Return the row of a plant: seconds, shares of the rate of ``always``, and differences."""
    folder = arguments.output / name
    stored = folder / "comparison" / "comparison.json"
    if not (arguments.resume and stored.exists()):
        seconds = compare(PLANTS[name], folder, arguments)
        content = json.loads(stored.read_text()) | {"seconds": seconds}
        stored.write_text(json.dumps(content))
    content = json.loads(stored.read_text())
    evaluation = json.loads(stored.with_name("evaluation.json").read_text())
    always = fmean(evaluation["policies"]["always"]["rate"])
    shares = [point["rate"] / always for point in content["points"]]
    values = [
        100.0 * point["difference"]["mean"] / point["envelope"]
        for share, point in zip(shares, content["points"], strict=True)
        if LOW <= share <= HIGH
    ]
    middle = [median(values), min(values), max(values)] if values else []
    shown = [f"{value:+.1f} %" for value in middle] or ["–"] * 3
    rates = f"{100.0 * min(shares):.0f} to {100.0 * max(shares):.0f} %"
    return [f"{content['seconds']:.0f}", rates, str(len(values)), *shown]


def compare(options: dict[str, Any], folder: Path, arguments: argparse.Namespace) -> float:
    """Run the commands of the newcomer's page; the seconds that they took.

    Raises:
        RuntimeError: a command failed; the message ends with what it said.
    """
    folder.mkdir(parents=True, exist_ok=True)
    plant, front = folder / "plant.yaml", folder / "front"
    plant.write_text(yaml.safe_dump(options))
    train = ["train", "--config", "linear_fusion_front", "--set", f"system={plant}"]
    train += ["--output", str(front)]
    train += ["--resume"] if arguments.resume and holds_training(front) else []
    train += [] if arguments.timesteps is None else ["--timesteps", str(arguments.timesteps)]
    beside = ["compare", "--config", str(front / "config.yaml"), "--sweep", "scale_free_sweep"]
    beside += ["--policy", f"model:{front / 'best_model.zip'}", "--prices", "7"]
    beside += ["--episodes", str(arguments.episodes), "--output", str(folder / "comparison")]
    begun = time.monotonic()
    for words in (train, beside):
        line = [sys.executable, "-m", "fusion_gym.agents", *words]
        done = subprocess.run(line, env=os.environ, capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"{words[0]} ended with {done.returncode}: {done.stderr[-1000:]}")
    return time.monotonic() - begun


if __name__ == "__main__":
    main()
