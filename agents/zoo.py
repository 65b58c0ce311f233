"""Put the benchmark's best agents into the model zoo, with their cards.

    python -m agents.zoo [--results results] [--work runs/benchmark/full]

For each setting and mode the training seed with the best validation return goes into
``fusion_gym/zoo``; validation has seeds of its own, so the test numbers stay honest.
"""

from __future__ import annotations

import hashlib
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from fusion_gym import zoo
from fusion_gym.validation import ConfigurationError

from .command_line import Command, spelled, start
from .input.options import InputFolder, OutputFolder
from .output.files import replacing, write
from .suite.reports import Agent, read

LARGEST = 300_000  # bytes of a model


@dataclass(frozen=True)
class Zoo(Command):
    """Put the benchmark's best agents into the model zoo, with their cards."""

    results: Annotated[Path, InputFolder()] = Path("results")
    """Folder of the benchmark's JSON."""
    work: Annotated[Path, InputFolder()] = Path("runs/benchmark/full")
    """Folder of its models."""
    zoo: Annotated[Path, OutputFolder()] = Path(zoo.__file__).parent
    """Folder of the model zoo."""

    def run(self) -> None:
        """Copy the best training seed of each setting and mode."""
        found = best_agents(self.results)
        if not found:
            raise ConfigurationError(
                f"results = {str(self.results)!r} is not allowed: it holds no agents"
            )
        models = {name: model_of(report, self.work) for name, report in found.items()}
        for name, report in found.items():
            add(name, report, models[name], self.zoo)
            print(f"zoo:{name}")


def best_agents(results: Path) -> dict[str, dict[str, Any]]:
    """The report of the best training seed, by ``SETTING_MODE``."""
    found: dict[str, dict[str, Any]] = {}
    for path in sorted(results.glob("*/agent_*.json")):
        report = read(Agent, path, "results")
        name = f"{report['setting']}_{report['mode']}"
        value = report["best_validation"]["return"]
        if name not in found or value > found[name]["best_validation"]["return"]:
            found[name] = report
    return found


def model_of(report: dict[str, Any], work: Path) -> Path:
    """The model that a report speaks of.

    Raises:
        ConfigurationError: there is no such model, or it is too large.
    """
    seed = f"{report['mode']}_{report['training_seed']}"
    model = work / report["setting"] / seed / "best_model.zip"
    if not model.exists():
        raise ConfigurationError(f"work = {str(work)!r} is not allowed: {model} is missing")
    if model.stat().st_size > LARGEST:
        raise ConfigurationError(
            f"{model} has {model.stat().st_size} bytes: it must have at most {LARGEST}"
        )
    return model


def add(name: str, report: dict[str, Any], model: Path, folder: Path) -> None:
    """Write a model's card, then copy it: a model that is there has a card."""
    training = report["training"] | {"output": f"runs/{name}"}
    card = {
        "sha256": hashlib.sha256(model.read_bytes()).hexdigest(),
        "env": report["env"],
        "options": report["options"],
        "mode": report["mode"],
        "training": training,
        "command": f"{spelled('benchmark')} --envs {report['setting']} --modes "
        f"{report['mode']}, training seed {report['training_seed']}",
        "test": {
            "episodes": report["episodes"],
            "seed": report["seed"],
            "prices": report["prices"],
            "points": report["points"],
        },
    }
    write(folder / f"{name}.json", card)
    with replacing(folder / f"{name}.zip") as partial:
        shutil.copyfile(model, partial)


def main() -> None:
    """Entry point; exit status 130 after an interrupt."""
    start(Zoo)


if __name__ == "__main__":
    main()
