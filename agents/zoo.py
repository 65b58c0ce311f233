"""Put the benchmark's best agents into the model zoo, with their cards.

    python -m agents.zoo [--results results] [--work runs/benchmark/full]

For each setting and mode the training seed with the best validation return goes into
``fusion_gym/zoo``; validation has seeds of its own, so the test numbers stay honest.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from pathlib import Path
from typing import Any

from fusion_gym.validation import ConfigurationError

ZOO = Path(__file__).parent.parent / "fusion_gym" / "zoo"
LARGEST = 300_000  # bytes of a model


def best_agents(results: Path) -> dict[str, dict[str, Any]]:
    """The report of the best training seed, by ``SETTING_MODE``."""
    found: dict[str, dict[str, Any]] = {}
    for path in sorted(results.glob("*/agent_*.json")):
        report = json.loads(path.read_text())
        name = f"{report['setting']}_{report['mode']}"
        value = report["best_validation"]["return"]
        if name not in found or value > found[name]["best_validation"]["return"]:
            found[name] = report
    return found


def add(name: str, report: dict[str, Any], work: Path, zoo: Path) -> None:
    """Copy a model and write its card.

    Raises:
        ConfigurationError: there is no such model, or it is too large.
    """
    folder = work / report["setting"] / f"{report['mode']}_{report['training_seed']}"
    model = folder / "best_model.zip"
    if not model.exists():
        raise ConfigurationError(f"work = {str(work)!r} is not allowed: {model} is missing")
    if model.stat().st_size > LARGEST:
        raise ConfigurationError(
            f"{model} has {model.stat().st_size} bytes: it must have at most {LARGEST}"
        )
    zoo.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(model, zoo / f"{name}.zip")
    training = report["training"] | {"output": f"runs/{name}"}
    card = {
        "env": report["env"],
        "options": report["options"],
        "mode": report["mode"],
        "training": training,
        "command": f"python -m agents.benchmark --envs {report['setting']} --modes "
        f"{report['mode']}, training seed {report['training_seed']}",
        "test": {
            "episodes": report["episodes"],
            "seed": report["seed"],
            "prices": report["prices"],
            "points": report["points"],
        },
    }
    (zoo / f"{name}.json").write_text(json.dumps(card, indent=1) + "\n")


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        prog="python -m agents.zoo",
        description="Put the benchmark's best agents into the model zoo.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--results", type=Path, default=Path("results"))
    parser.add_argument("--work", type=Path, default=Path("runs/benchmark/full"))
    parser.add_argument("--zoo", type=Path, default=ZOO)
    given = parser.parse_args()
    try:
        found = best_agents(given.results)
        if not found:
            raise ConfigurationError(
                f"results = {str(given.results)!r} is not allowed: it holds no agents"
            )
        for name, report in found.items():
            add(name, report, given.work, given.zoo)
            print(f"zoo:{name}")
    except ConfigurationError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
