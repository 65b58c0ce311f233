"""Train and compare on plants without tuning, by the commands of docs/newcomer.md.

    python -m benchmarks.plants [PLANT …] [--output runs/plants] [--resume]

The plants are those of ``benchmarks/plants.yaml`` and three random ones. An agent trains by
``linear_fusion_front``. At seven prices the table compares its cost, error + price · tokens, with
the best rule of ``scale_free_sweep``, with the same memory and on the same episodes.
"""

import argparse
import json
import os
import subprocess
import sys
from dataclasses import astuple, dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import yaml
from rich.table import Table

from fusion_gym.arrays import Array
from fusion_gym.core.scale import sustained_tokens
from fusion_gym.entries import Options
from fusion_gym.envs.registration import make_task
from fusion_gym.output import tables
from fusion_gym.output.ending import report_errors
from fusion_gym.training.run import holds_training
from fusion_gym.validation import choice

DRAWN = 3
ENV = "fusion_gym/LinearFusion-v2"


def draw_plant(seed: int) -> Options:
    """Return the options of a random plant of two to four states with at least as many sensors."""
    generator = np.random.default_rng(seed)
    states, sensors = generator.integers([2, 3], [5, 6]).tolist()
    basis = generator.standard_normal((states, states)) + 2.0 * np.eye(states)
    poles = np.diag(generator.uniform(0.9, 1.0, states))
    noise = generator.standard_normal((states, states)) / np.sqrt(states)

    def plain(values: Array) -> Any:
        return np.round(values, 4).tolist()

    return {
        "transition": plain(basis @ poles @ np.linalg.inv(basis)),
        "process_covariance": plain(0.1 * (noise @ noise.T + 0.1 * np.eye(states))),
        "measurement_matrices": plain(generator.standard_normal((sensors, states))),
        "measurement_covariances": plain(10.0 ** generator.uniform(-1.5, 0.5, sensors)),
        "token_rate": round(float(generator.uniform(0.75, 2.5)), 2),
    }


PLANTS: Options = yaml.safe_load(Path(__file__).with_name("plants.yaml").read_text())
PLANTS |= {f"drawn_{seed}": draw_plant(seed) for seed in range(DRAWN)}


@dataclass(frozen=True)
class Row:
    """A plant: processor seconds, tokens relative to the bucket's rate, differences in cost."""

    plant: str
    seconds: float
    lowest: float
    highest: float
    mean: float
    least: float
    most: float

    def cells(self) -> list[str]:
        """Return the cells of the table."""
        shares = (f"{value:.0%}" for value in (self.lowest, self.highest))
        differences = (f"{value:+.1%}" for value in astuple(self)[4:])
        return [self.plant, f"{self.seconds:.0f}", *shares, *differences]


def main() -> None:
    """Run the plants that the command line names, or all, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("plants", nargs="*", metavar="PLANT", help="all by default")
    parser.add_argument("--output", type=Path, default=Path("runs/plants"))
    parser.add_argument("--episodes", type=int, default=300)
    parser.add_argument("--timesteps", type=int, help="instead of the config's timesteps")
    parser.add_argument("--resume", action="store_true", help="continue from the existing results")
    arguments = parser.parse_args()
    heads = "plant", "CPU s", "least sent", "most sent", "mean", "least", "most"
    table = Table(*heads, title="agent's cost over the best rule's; negative: the agent is better")
    with report_errors():
        for name in arguments.plants or PLANTS:
            choice("plant", name, PLANTS)
            table.add_row(*judge(name, arguments).cells())
            tables.console().print(table)


def judge(name: str, arguments: argparse.Namespace) -> Row:
    """Return the row of a plant, from its folder or a run."""
    folder = arguments.output / name
    stored = folder / "seconds.json"
    if not (arguments.resume and stored.exists()):
        stored.write_text(json.dumps(run_commands(PLANTS[name], folder, arguments)))
    points = json.loads((folder / "comparison" / "comparison.json").read_text())["points"]
    policies = json.loads((folder / "comparison" / "evaluation.json").read_text())["policies"]
    sustained = sustained_tokens(make_task(ENV, **PLANTS[name]))
    shares = [policies[point["policy"]]["tokens"]["mean"] / sustained for point in points]
    costs = [
        point["at_price"]["difference"]["mean"] / point["at_price"]["cost"] for point in points
    ]
    seconds = json.loads(stored.read_text())
    return Row(name, seconds, min(shares), max(shares), fmean(costs), min(costs), max(costs))


def run_commands(options: Options, folder: Path, arguments: argparse.Namespace) -> float:
    """Run the commands of the newcomer's page, and return their processor seconds."""
    folder.mkdir(parents=True, exist_ok=True)
    plant, front = folder / "plant.yaml", folder / "front"
    plant.write_text(yaml.safe_dump(options))
    train = ["train", "--config", "linear_fusion_front", "--set", f"system={plant}"]
    train += ["--output", str(front)]
    train += ["--resume"] if arguments.resume and holds_training(front) else []
    train += [] if arguments.timesteps is None else ["--timesteps", str(arguments.timesteps)]
    compare = ["compare", "--config", str(front / "config.yaml"), "--sweep", "scale_free_sweep"]
    compare += ["--policy", f"model:{front / 'best_model.zip'}", "--prices", "7"]
    compare += ["--episodes", str(arguments.episodes), "--output", str(folder / "comparison")]
    before = os.times()
    for words in (train, compare):
        line = [sys.executable, "-m", "fusion_gym.commands", *words]
        environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        ended = subprocess.run(line, env=environment, capture_output=True, text=True)
        if ended.returncode:
            raise RuntimeError(f"{words[0]} ended with {ended.returncode}: {ended.stderr[-1000:]}")
    return sum(os.times()[2:4]) - sum(before[2:4])  # of the children


if __name__ == "__main__":
    main()
