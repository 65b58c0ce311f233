"""Short runs of the commands that write folders, and what their results say."""

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import torch
from training_configs import small_config

ENV = "fusion_gym/TobitOscillator-v1"


def arguments(command: str, folder: Path, seed: int = 0, steps: int = 256) -> list[str]:
    """Return the words of a short run into the folder; the seed makes another run."""
    if command == "evaluate":
        options = ["--env", ENV, "--set", "horizon=5", "--policies", "always", "never"]
        return [*options, "--episodes", "3", "--seed", str(seed), "--json", f"{folder}/result.json"]
    if command in ("search", "calibrate"):
        options = ["token_rate=2", "memory=true", "random_start=true", "filter=tobit"]
        words = ["--env", ENV, "--set", *options, f"horizon={20 + seed}", "--prices", "2"]
        if command == "search":
            return [*words, "--generations", str(1 + steps // 256), "--output", f"{folder}/search"]
        priced = ["--set", "cost_weight=random", "price_range=[0.01513,2.353]"]
        agent = [*priced, "--policy", "zoo:tobit_oscillator_scheduler", "--episodes", "2"]
        return [*words, *agent, "--output", f"{folder}/calibrated.zip"]
    training = {"timesteps": steps, "num_envs": 8, "seed": seed}
    every = {"every": min(1024, steps // 2), "episodes": 2}
    words = ["--config", str(small_config(folder, training=training, validation=every))]
    return words


def meaning(folder: Path) -> dict[str, Any]:
    """Return what the results of a run say, without what says where and how fast it was."""
    contents = {
        str(path.relative_to(folder)): _content(path, str(folder))
        for path in sorted(folder.rglob("*"))
        if path.name not in ("metadata.json", "runs.csv")  # with seconds
    }
    return {name: content for name, content in contents.items() if content is not None}


def _content(path: Path, folder: str) -> Any:
    match path.name, path.suffix:
        case "best_model.zip" | "final_model.zip", _:
            with zipfile.ZipFile(path) as archive:
                weights = torch.load(io.BytesIO(archive.read("policy.pth")))
            return {name: weight.tolist() for name, weight in weights.items()}
        case "calibrated.zip", _:
            with zipfile.ZipFile(path) as archive:
                return archive.read("calibration.json").decode()
        case _, ".csv":
            return path.read_text()
        case _, ".json" | ".jsonl":
            lines = path.read_text().splitlines() if path.suffix == ".jsonl" else [path.read_text()]
            records = [json.loads(line) for line in lines]
            for record in records:
                for key in ("seconds", "steps_per_second"):
                    record.pop(key, None)
            return json.dumps(records).replace(folder, "")
    return None
