"""Kill a command at random moments, go on with it, and compare with an undisturbed run.

    python tests/helpers/kills.py {train,search,calibrate} [--kills 15] [--seed 0]

Every attempt is a fork of this process, which has imported everything: kills fall into the
command's own work. The end must be that of the undisturbed run, bit by bit.
"""

import argparse
import os
import random
import signal
import sys
import tempfile
import time
import traceback
from pathlib import Path

from small_runs import arguments, meaning

from fusion_gym.commands.__main__ import load

SIZES = {"train": 16_384, "search": 1_024, "calibrate": 0}  # steps of a training

# The first file of each command that resumes.
FIRST = {"train": "run/config.yaml", "search": "search/generations.json", "calibrate": ""}


def attempt(command: str, words: list[str], log: Path, seconds: float | None) -> str:
    """Run the command in a fork; "killed" after so many seconds, or how it ended."""
    child = os.fork()
    if child == 0:
        try:
            with log.open("w") as file:
                os.dup2(file.fileno(), 1)
                os.dup2(file.fileno(), 2)
            sys.argv = [f"agents/{command}.py", *words]
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
    return (folder / FIRST[command]).is_file()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("command", choices=SIZES)
    parser.add_argument("--kills", type=int, default=15)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    steps = SIZES[args.command]
    load(args.command)
    moments = random.Random(args.seed)
    with tempfile.TemporaryDirectory() as place:
        root = Path(place)
        log = root / "log"
        (root / "whole").mkdir()
        words = arguments(args.command, root / "whole", 0, steps)
        began = time.perf_counter()
        attempt(args.command, words, log, None)
        lasts = time.perf_counter() - began
        expected, kills, rounds = meaning(root / "whole"), 0, 0
        while kills < args.kills or rounds == 0:
            rounds += 1
            folder = root / f"round_{rounds}"
            folder.mkdir()
            words = arguments(args.command, folder, 0, steps)
            ended = "killed"
            while ended == "killed":
                again = ["--resume"] if begun(args.command, folder) else []
                last = kills >= args.kills
                seconds = None if last else moments.uniform(0.0, 0.6 * lasts)
                ended = attempt(args.command, [*words, *again], log, seconds)
                kills += ended == "killed"
            assert meaning(folder) == expected, f"round {rounds}: another outcome"
            left = list(folder.rglob("*.part*"))
            assert not left, left
    print(f"{args.command}: {kills} kills in {rounds} rounds of {lasts:.1f} s, nothing lost")


if __name__ == "__main__":
    main()
