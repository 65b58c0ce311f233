"""Put the benchmark's best agents into the model zoo, with their cards.

    python -m agents.zoo [--envs NAME …] [--classes NAME …]

For each setting and chosen class the training seed with the best validation return goes into
``fusion_gym/zoo``; validation has seeds of its own, so the test numbers stay honest. Agents that
are there and are not chosen are removed. A model is kept as Stable-Baselines3 saved it, without
what its optimiser remembers of gradients.
"""

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from agents.benchmark.classes import HEARD, KNOWS
from agents.benchmark.config import Mode
from agents.benchmark.tables import group_by, read_rows
from agents.zoo.small_model import small_model
from fusion_gym import zoo
from fusion_gym.commands.command_line import Long
from fusion_gym.commands.options import InputFolder, OutputFolder
from fusion_gym.output.files import read_json, replacing, write
from fusion_gym.output.progress import writing
from fusion_gym.validation import ConfigurationError, choice

LARGEST = 300_000  # bytes of a model
MOST = 4_000_000  # bytes of all of them


@dataclass(frozen=True)
class Zoo(Long):
    """Put the benchmark's best agents into the model zoo, with their cards."""

    program = "python -m agents.zoo"

    envs: tuple[str, ...] = ()
    """Settings by name; none stands for all."""
    classes: tuple[str, ...] = ()
    """Classes by name, as sensors_memory; none stands for five of each setting at most."""
    results: Annotated[Path, InputFolder()] = Path("results")
    """Folder of the benchmark's tables."""
    work: Annotated[Path, InputFolder()] = Path("runs/benchmark/full")
    """Folder of its models."""
    zoo: Annotated[Path, OutputFolder()] = Path(zoo.__file__).parent
    """Folder of the model zoo."""

    def run(self) -> None:
        """Copy the best training seed of each setting and class, and remove the other agents."""
        result = best_agents(self.results)
        if not result:
            raise ConfigurationError(
                f"results = {str(self.results)!r} is not allowed: it holds no agents"
            )
        every = select(result, self.envs, self.classes)
        models = {name: model_of(report, self.work) for name, report in every.items()}
        size = sum(map(len, models.values()))
        if size > MOST:
            raise ConfigurationError(
                f"{len(models)} agents have {size:,} bytes: all together must have at most "
                f"{MOST:,}; name fewer --envs or --classes"
            )
        writing((f"{len(every)} agents with their cards", self.zoo))
        for name, report in every.items():
            add(name, report, models[name], self.zoo)
            print(f"zoo:{name}")
        for name in remove_others(self.zoo, every):
            print(f"zoo:{name} is removed")


def best_agents(results: Path) -> dict[tuple[str, str], dict[str, Any]]:
    """Return the best training seed by setting and class, with what it did at its prices."""
    result: dict[tuple[str, str], dict[str, Any]] = {}
    for path in sorted(results.glob("*/runs.csv")):
        policies = group_by(read_rows(path.parent, "policies"), "run")
        agents = [run for run in read_rows(path.parent, "runs") if "class" in run]
        for name, seeds in group_by(agents, "class").items():
            best = max(seeds, key=lambda run: float(run["best_validation"]["return"]))
            best |= {"setting": path.parent.name, "class": name}
            result[path.parent.name, name] = best | {"policies": policies.get(best["run"], [])}
    return result


def select(
    content: Mapping[tuple[str, str], dict[str, Any]], envs: Iterable[str], classes: Iterable[str]
) -> dict[str, dict[str, Any]]:
    """The agents of these settings and classes, as ``SETTING_CLASS``.

    Raises:
        ConfigurationError: a setting or class without agents; names the option and what there is.
    """
    settings = list(dict.fromkeys(setting for setting, _ in content))
    known = list(dict.fromkeys(name for _, name in content))
    for name in envs:
        choice("envs", name, settings)
    for name in classes:
        choice("classes", name, known)
    required = {}
    for setting in envs or settings:
        there = [name for item, name in content if item == setting]
        for name in classes or typical(there):
            if name in there:
                required[f"{setting}_{name}"] = content[setting, name]
    return required


def typical(classes: Iterable[str]) -> list[str]:
    """The centre, the schedulers of one measurement, and sensors that hear least and most.

    Those by themselves with memory, and those that hear the least without, where there is none.
    """
    there = set(classes)
    received = [item for item in HEARD if {f"local_{item}", f"local_{item}_memory"} & there]
    required = ["centre", "sensors", "sensors_memory"]
    if received:
        least = f"local_{received[0]}"
        required.append(f"{least}_memory" if f"{least}_memory" in there else least)
    required.append("local_packets_memory")
    return [name for name in dict.fromkeys(required) if name in there]


def model_of(report: dict[str, Any], work: Path) -> bytes:
    """The model that a report speaks of, without its optimiser's memory.

    Raises:
        ConfigurationError: there is no such model, or it is too large.
    """
    seed = f"{report['class']}_{report['training_seed']}"
    path = work / report["setting"] / seed / "best_model.zip"
    if not path.exists():
        raise ConfigurationError(f"work = {str(work)!r} is not allowed: {path} is missing")
    model = small_model(path)
    if len(model) > LARGEST:
        raise ConfigurationError(
            f"{path} has {len(model):,} bytes: it must have at most {LARGEST:,}"
        )
    return model


def add(name: str, report: dict[str, Any], model: bytes, folder: Path) -> None:
    """Write a model's card, then the model: a model that is there has a card."""
    training = report["inputs"]["training"]
    environment = report["inputs"]["environment"]
    options = environment["options"] | report["class_options"]
    mode: Mode = report["class"].split("_")[0]
    points = [dict(policy) for policy in report["policies"]]
    prices = [point.pop("price") for point in points]
    for point in points:
        point.pop("name")
    card = {
        "sha256": hashlib.sha256(model).hexdigest(),
        "env": environment["id"],
        "options": options,
        "class": report["class"],
        "mode": mode,
        "knows": KNOWS[mode, bool(options.get("memory", False))],
        "training": training | {"output": f"runs/{name}"},
        "command": f"python -m agents.benchmark --envs {report['setting']} --classes "
        f"{report['class']}, training seed {report['training_seed']}",
        "test": {
            "episodes": report["episodes"],
            "seed": report["inputs"]["seed"],
            "prices": prices,
            "points": points,
        },
    }
    write(folder / f"{name}.json", card)
    with replacing(folder / f"{name}.zip") as partial:
        partial.write_bytes(model)


def remove_others(folder: Path, names: Iterable[str]) -> list[str]:
    """Remove the agents, each a model beside its card, that are not kept; returns their names."""
    removed = []
    for model in sorted(folder.glob("*.zip")):
        card = model.with_suffix(".json")
        if model.stem not in names and card.exists() and "sha256" in read_json(card, "zoo"):
            model.unlink()
            card.unlink()
            removed.append(model.stem)
    return removed
