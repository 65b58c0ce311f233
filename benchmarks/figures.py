"""Fingerprints of fusion-gym's figures, to show that a change of the code moves none of them.

    python -m benchmarks.figures --output before.json [--only zoo reproduce …] [--workers 2]
    diff before.json after.json

The first line runs the commands of the checkout in the current directory and writes a SHA-256 of
what each piece of work gave: the zoo's agents, the best rules of the stored results, the
documentation's tables, short trainings of every training config, and the quick benchmark of one
setting. The second line prints the pieces that differ.

Finished pieces are in the file at once, and a second run skips them. Only the command lines and
the stored JSON and YAML files are used, so the same script serves both sides of a change. Floating
point is compared bit by bit: both sides belong on one machine with the same packages.
"""

import argparse
import hashlib
import io
import json
import os
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from pathlib import Path
from typing import Any

import torch
import yaml

from fusion_gym.agents.experiments.envelopes import read_envelopes
from fusion_gym.agents.experiments.tables import read_rows
from fusion_gym.agents.output.files import read_json, write

TIMESTEPS = 100_000
VALIDATION = {"every": 60_000, "episodes": 64}  # once on the way, and once at the end
BENCHMARK = "tobit_oscillator"
# Takes a temporary folder and returns what is to be hashed.
Piece = Callable[[Path], bytes]
Content = dict[str, Any]


def command(name: str, *words: str, package: str = "fusion_gym.agents") -> str:
    """Run a command of the current directory on one thread; its standard output.

    Raises:
        RuntimeError: it failed; the message ends with what it said.
    """
    line = [sys.executable, "-m", package, name, *words]
    env = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(line, env=env, capture_output=True, text=True)
    if done.returncode != 0:
        raise RuntimeError(f"{name} ended with {done.returncode}: {done.stderr.strip()[-1000:]}")
    return done.stdout


def evaluate(env: str, options: Content, names: list[str], episodes: int, folder: Path) -> bytes:
    """Summaries and quantiles that ``fusion-gym evaluate`` writes for these policies."""
    words = ["--env", env, "--policies", *names, "--episodes", str(episodes), "--seed", "0"]
    if options:
        words += ["--set", *(f"{key}={value}" for key, value in options.items())]
    command("evaluate", *words, "--json", str(folder / "evaluation.json"))
    report = read_json(folder / "evaluation.json", "json")
    selection = {key: report[key] for key in ("policies", "quantiles")}
    return json.dumps(selection, sort_keys=True).encode()


def reproduce(config: Path, episodes: int, folder: Path) -> bytes:
    """The table that the maintainers' command ``table`` prints."""
    words = ("--config", str(config), "--episodes", str(episodes), "--markdown")
    return command("table", *words, package="fusion_gym.agents.maintenance").encode()


def train(plain: Content, folder: Path) -> bytes:
    """Validations and final weights of a short training with this config."""
    config, output = folder / "config.yaml", folder / "training"
    plain = plain | {"validation": plain.get("validation", {}) | VALIDATION}
    config.write_text(yaml.safe_dump(plain, sort_keys=False))
    words = ("--config", str(config), "--timesteps", str(TIMESTEPS), "--output", str(output))
    command("train", *words)
    with zipfile.ZipFile(output / "final_model.zip") as model:
        weights = torch.load(io.BytesIO(model.read("policy.pth")), "cpu", weights_only=True)
    tensors = (weights[key].contiguous().numpy().tobytes() for key in sorted(weights))
    return b"".join(tensors) + (output / "validation.jsonl").read_bytes()


def benchmark(setting: str, folder: Path) -> bytes:
    """The tables that the quick benchmark of a setting writes, but that of the wall times."""
    words = ["--quick", "--envs", setting, "--workers", "1"]
    command("benchmark", *words, "--results", str(folder), "--work", str(folder / "work"))
    tables = [path for path in sorted(folder.glob(f"{setting}/*.csv")) if path.stem != "runs"]
    return json.dumps({path.name: path.read_text() for path in tables}).encode()


def zoo_pieces(episodes: int) -> Iterator[tuple[str, Piece]]:
    """Every agent of the zoo at its prices, in its environment."""
    for path in sorted(Path("fusion_gym/zoo").glob("*.json")):
        card = read_json(path, "zoo")
        centre = {"information": "centre"} if card["mode"] == "centre" else {}
        low, high = card["training"]["environment"]["options"]["price_range"]
        prices = [min(max(price, low), high) for price in card["test"]["prices"]]
        policies = [f"zoo:{path.stem},price={price!r}" for price in prices]
        work = partial(evaluate, card["env"], card["options"] | centre, policies, episodes)
        yield f"zoo {path.stem}, {episodes} episodes", work


def envelope_pieces(episodes: int) -> Iterator[tuple[str, Piece]]:
    """Every setting's rules that no other rule beats, in the worlds that they were tuned in."""
    for path in sorted(Path("results").glob("*/fronts.csv")):
        stored = read_envelopes(path.parent)
        worlds: dict[str, dict[str, Any]] = {}
        for name in (row["class"] for row in read_rows(path.parent, "fronts")):
            for vertex in stored["classes"][name]["vertices"]:
                key = ", ".join(f"{k}={v}" for k, v in vertex["options"].items()) or "as it is"
                world = worlds.setdefault(key, {"options": vertex["options"], "policies": {}})
                world["policies"][vertex["policy"]] = None
        for key, world in worlds.items():
            options = stored["options"] | world["options"]
            work = partial(evaluate, stored["env"], options, list(world["policies"]), episodes)
            yield f"envelopes {path.parent.name}, {key}, {episodes} episodes", work


def reproduce_pieces(episodes: int) -> Iterator[tuple[str, Piece]]:
    """Every table of the documentation."""
    for path in sorted(Path("configs").glob("*_reproduce.yaml")):
        yield f"reproduce {path.stem}, {episodes} episodes", partial(reproduce, path, episodes)


def training_pieces(episodes: int) -> Iterator[tuple[str, Piece]]:
    """Every config of a training; its episodes are ``VALIDATION``'s."""
    for path in sorted(Path("configs").glob("*.yaml")):
        plain = yaml.safe_load(path.read_text())
        if "training" in plain:
            yield f"trainings {path.stem}", partial(train, plain)


def benchmark_pieces(episodes: int) -> Iterator[tuple[str, Piece]]:
    """The quick benchmark of one setting; its episodes are those of ``--quick``."""
    yield f"benchmark {BENCHMARK}", partial(benchmark, BENCHMARK)


KINDS: dict[str, Callable[[int], Iterator[tuple[str, Piece]]]] = {
    "zoo": zoo_pieces,
    "envelopes": envelope_pieces,
    "reproduce": reproduce_pieces,
    "trainings": training_pieces,
    "benchmark": benchmark_pieces,
}


def fingerprint(work: Piece) -> str:
    """The SHA-256 of what the work gave."""
    with tempfile.TemporaryDirectory() as folder:
        return hashlib.sha256(work(Path(folder))).hexdigest()


def run(output: Path, kinds: list[str], episodes: int, workers: int) -> int:
    """Fill the file with the pieces that it lacks; returns how many of them failed."""
    result = read_json(output, "output") if output.exists() else {}
    pieces = {name: work for kind in kinds for name, work in KINDS[kind](episodes)}
    left = {name: work for name, work in pieces.items() if name not in result}
    print(f"{len(pieces)} pieces, {len(pieces) - len(left)} of them are finished", flush=True)
    failed, pool = 0, ThreadPoolExecutor(workers)
    futures = {pool.submit(fingerprint, work): name for name, work in left.items()}
    try:
        for future in as_completed(futures):
            name, error = futures[future], future.exception()
            if error is None:
                result[name] = future.result()
                write(output, dict(sorted(result.items())))
            failed += error is not None
            print(f"{name}: {error or result[name][:12]}", flush=True)
    finally:
        pool.shutdown(cancel_futures=True)
    return failed


def main() -> None:
    """Entry point; exit status 1 if a piece failed."""
    parser = argparse.ArgumentParser(
        description="Fingerprints of the figures, to show that a change moves none."
    )
    parser.add_argument("--output", type=Path, required=True, help="run what this JSON lacks")
    parser.add_argument("--only", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--episodes", type=int, default=200, help="of evaluations and tables")
    parser.add_argument("--workers", type=int, default=2, help="commands side by side")
    arguments = parser.parse_args()
    sys.exit(run(arguments.output, arguments.only, arguments.episodes, arguments.workers) > 0)


if __name__ == "__main__":
    main()
