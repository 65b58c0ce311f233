"""Put one calibrated agent of each class of the benchmark into the model zoo, with its card.

    python -m agents.zoo --work runs/benchmark

The policy is an agent that is calibrated with the searched rule. Its training seed has the
least cost on the tuning episodes, so the test figures are unbiased. The command first runs the
benchmark's unfinished work. It removes policies of other names.
"""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from agents.benchmark.evidence import CALIBRATED, Evidence, gather
from agents.benchmark.jobs import Runner
from agents.benchmark.settings import Suite, knowledge_of, load_suite
from agents.workers import Pool
from fusion_gym import seeds, zoo
from fusion_gym.commands.command_line import OUTPUT_FOLDER, Long, whole
from fusion_gym.entries import Plain
from fusion_gym.output.files import read_json, replacing, write
from fusion_gym.output.progress import writing


@dataclass(frozen=True)
class Zoo(Long):
    """Put one calibrated agent of each class of the benchmark into the model zoo, with its card."""

    program = "python -m agents.zoo"

    settings: tuple[str, ...] = ()
    """Tasks by name; all by default."""
    work: Annotated[Path, OUTPUT_FOLDER] = Path("runs/benchmark")
    """Folder of the benchmark's finished pieces and agents."""
    zoo: Annotated[Path, OUTPUT_FOLDER] = Path(zoo.__file__).parent
    """Folder of the model zoo."""
    workers: Annotated[int, whole(1, 512)] = 2
    """Number of parallel processes."""

    def run(self) -> None:
        """Write the agents, and remove the others."""
        suite, work = load_suite(settings=self.settings), (self.work / "full").absolute()
        classes = {
            f"{item.setting.name}_{item.name}": item
            for item in gather(suite, Runner(work, Pool(self.workers)))
        }
        models = {
            name: item.training(*item.best).policy.read_bytes() for name, item in classes.items()
        }
        writing((f"{len(models)} agents with their cards", self.zoo))
        for name, item in classes.items():
            write(self.zoo / f"{name}.json", agent_card(suite, item, models[name]))
            with replacing(self.zoo / f"{name}.zip") as partial:
                partial.write_bytes(models[name])
            print(f"zoo:{name}")
        for name in remove_others(self.zoo, models):
            print(f"zoo:{name} is removed")


def agent_card(suite: Suite, item: Evidence, model: bytes) -> Plain:
    """Return the content of an agent's JSON."""
    kind, seed = item.best
    experiment = item.training(kind, seed).job.experiment
    options = dict(experiment.environment.options)
    for name in ("cost_weight", "price_range"):
        options.pop(name)
    return {
        "sha256": hashlib.sha256(model).hexdigest(),
        "env": item.setting.environment,
        "options": options,
        "class": item.name,
        "knows": knowledge_of(item.setting, item.name),
        "training": experiment.model_dump(mode="json", exclude={"output"}),
        "command": f"python -m agents.zoo --settings {item.setting.name}, training seed {seed}",
        "test": {
            "episodes": suite.episodes,
            "seed": seeds.TEST.start,
            "prices": list(item.prices),
            "points": [
                {
                    "cost": float(outcome.cost.mean()),
                    "error": float(outcome.error.mean()),
                    "tokens": float(outcome.tokens.mean()),
                    "mse": outcome.mse,
                    "rate": outcome.rate,
                }
                for outcome in item.tests[CALIBRATED[kind]][seed]
            ],
        },
    }


def remove_others(folder: Path, names: Iterable[str]) -> list[str]:
    """Remove the agents of other names, each with its card, and return their names."""
    removed = []
    for model in sorted(folder.glob("*.zip")):
        file = model.with_suffix(".json")
        if model.stem not in names and file.exists() and "sha256" in read_json(file, "zoo"):
            model.unlink()
            file.unlink()
            removed.append(model.stem)
    return removed
