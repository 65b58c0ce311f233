"""Kill a command at random moments, go on with it, and compare with an undisturbed run.

    python tests/kills.py {train,tune,benchmark} [--kills 15] [--seed 0]

Every attempt is a fork of this process, which has imported everything: kills fall into the
command's own work. The end must be that of the undisturbed run, bit by bit.
"""

import argparse
import json
import os
import random
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import optuna
import yaml
from small_suite import small_suite
from stable_baselines3 import PPO
from training_configs import small_config

from fusion_gym.agents.__main__ import load
from fusion_gym.agents.experiments import verdict

Outcome = dict[str, Any]


def weights(path: Path) -> list[Any]:
    return [value.tolist() for value in PPO.load(path, device="cpu").policy.state_dict().values()]


def train(folder: Path) -> tuple[list[str], Callable[[], Outcome]]:
    training = {"timesteps": 16_384, "num_envs": 8}
    config = small_config(folder, training=training, validation={"every": 1024, "episodes": 4})
    run = folder / "run"

    def outcome() -> Outcome:
        summary = json.loads((run / "summary.json").read_text())
        return {
            "best": weights(run / "best_model.zip"),
            "final": weights(run / "final_model.zip"),
            "records": (run / "validation.jsonl").read_text(),
            **{key: summary[key] for key in ("best_validation", "finished", "inputs")},
        }

    return ["--config", str(config)], outcome


def tune(folder: Path) -> tuple[list[str], Callable[[], Outcome]]:
    training = {"timesteps": 4096, "num_envs": 8}
    config = small_config(folder, training=training, validation={"every": 1024, "episodes": 4})
    output = folder / "study"

    def outcome() -> Outcome:
        study = optuna.load_study(study_name="tune", storage=f"sqlite:///{output / 'study.db'}")
        ended = [trial for trial in study.trials if trial.state.name in ("COMPLETE", "PRUNED")]
        return {
            "trials": [(t.state.name, t.params, t.value, t.intermediate_values) for t in ended],
            "best": yaml.safe_load((output / "best.yaml").read_text())["algorithm"],
        }

    return ["--config", str(config), "--trials", "8", "--output", str(output)], outcome


def benchmark(folder: Path) -> tuple[list[str], Callable[[], Outcome]]:
    results, work = folder / "results", folder / "work"

    def outcome() -> Outcome:
        tables = (path for path in results.rglob("*.csv") if path.stem != "runs")  # with seconds
        result: Outcome = {path.name: path.read_text() for path in tables}
        return result | {"pieces": sorted(path.parent.name for path in work.rglob("output.pkl"))}

    config = small_suite(folder, timesteps=4096)
    arguments = ["--config", str(config), "--results", str(results), "--work", str(work)]
    return [*arguments, "--workers", "1", "--parts", "agents"], outcome


def attempt(command: str, arguments: list[str], log: Path, seconds: float | None) -> str:
    """Run the command in a fork; "killed" after so many seconds, or how it ended."""
    child = os.fork()
    if child == 0:
        try:
            with log.open("w") as file:
                os.dup2(file.fileno(), 1)
                os.dup2(file.fileno(), 2)
            sys.argv = [f"agents/{command}.py", *arguments]
            load(command).main()
            os._exit(0)
        except SystemExit as end:
            print(end, flush=True)
            os._exit(1)
        except BaseException:
            traceback.print_exc()
            os._exit(2)
    deadline = time.perf_counter() + (float("inf") if seconds is None else seconds)
    ended, status = 0, 0
    while ended == 0:
        ended, status = os.waitpid(child, os.WNOHANG)
        if time.perf_counter() > deadline:
            os.kill(child, signal.SIGKILL)
            deadline = float("inf")
        time.sleep(0.005)
    status = os.waitstatus_to_exitcode(status)
    if status not in (0, -signal.SIGKILL):
        raise SystemExit(f"{command} ended with {status}:\n{log.read_text()}")
    return "killed" if status else "finished"


def begun(command: str, folder: Path) -> bool:
    """Whether the command needs --resume to go on."""
    if command == "train":
        return (folder / "run" / "config.yaml").exists()
    return command == "benchmark"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("command", choices=("train", "tune", "benchmark"))
    parser.add_argument("--kills", type=int, default=15)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    make = {"train": train, "tune": tune, "benchmark": benchmark}[args.command]
    load(args.command)
    moments = random.Random(args.seed)
    verdict.RESAMPLES = 20
    with tempfile.TemporaryDirectory() as place:
        root = Path(place)
        log = root / "log"
        (root / "whole").mkdir()
        arguments, outcome = make(root / "whole")
        began = time.perf_counter()
        attempt(args.command, arguments, log, None)
        lasts = time.perf_counter() - began
        expected, kills, rounds = outcome(), 0, 0
        while kills < args.kills or rounds == 0:
            rounds += 1
            folder = root / f"round_{rounds}"
            folder.mkdir()
            arguments, outcome = make(folder)
            ended = "killed"
            while ended == "killed":
                again = ["--resume"] if begun(args.command, folder) else []
                last = kills >= args.kills
                seconds = None if last else moments.uniform(0.0, 0.6 * lasts)
                ended = attempt(args.command, [*arguments, *again], log, seconds)
                kills += ended == "killed"
            assert outcome() == expected, f"round {rounds}: not what the undisturbed run wrote"
            left = list(folder.rglob("*.part*"))
            assert not left, left
    print(f"{args.command}: {kills} kills in {rounds} rounds of {lasts:.1f} s, nothing lost")


if __name__ == "__main__":
    main()
