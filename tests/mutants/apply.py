"""Apply each wrong variant of ``mutants.toml`` to a copy of the tree: its tests must fail.

    python tests/mutants/apply.py [NAME …]

Tests run in forks of this process, which has imported the libraries.
"""

import importlib
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest

TABLE = Path(__file__).with_name("mutants.toml")
ROOT = TABLE.parents[2]
LIBRARIES = "hypothesis jax matplotlib.pyplot pandas pettingzoo pydantic sb3_contrib scipy.stats"
VERDICTS = {0: "SURVIVED", 1: "killed", 4: "NO SUCH TEST", 5: "NO SUCH TEST"}  # of pytest's codes
LIMIT = 300  # seconds of a line of tests


def copied(target: str) -> Path:
    """The tracked files, and new ones that git does not ignore, with the library's bytecode."""
    script = (
        "git ls-files -z --cached --others --exclude-standard"
        f" | tar --null -T - --ignore-failed-read -cf - 2> {os.devnull} | tar -xf - -C {target} && "
        f"{sys.executable} -m compileall -q --invalidation-mode checked-hash {target}/fusion_gym"
    )
    subprocess.run(["bash", "-c", script], cwd=ROOT, check=True)
    return Path(target)


def fork(place: Path, tests: list[str]) -> int:
    """Run tests in a copy of the tree, and return the process, which ends with pytest's code."""
    with warnings.catch_warnings(action="ignore"):  # JAX has started no threads
        if child := os.fork():
            return child
    signal.alarm(LIMIT)
    output = os.open(f"{place}.log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(output, 1)
    os.dup2(output, 2)
    os.chdir(place)
    os.environ |= {"PYTHONPATH": str(place), "PYTHONDONTWRITEBYTECODE": "1"}
    sys.dont_write_bytecode = True
    sys.path.insert(0, str(place))
    try:
        os._exit(pytest.main(["-x", "-q", "-p", "no:cacheprovider", *tests]))
    finally:
        os._exit(3)


def run(jobs: Iterable[tuple[Any, str, str, list[str]]]) -> Iterator[tuple[Any, int, str, float]]:
    """Run jobs (key, file, its changed text, tests); yield key, exit code, output and seconds."""
    for library in LIBRARIES.split():
        importlib.import_module(library)
    left, running = list(jobs)[::-1], {}
    with tempfile.TemporaryDirectory() as folder:
        free = [copied(tempfile.mkdtemp(dir=folder)) for _ in range(2)]
        while left or running:
            if left and free:
                (key, name, text, tests), place = left.pop(), free.pop()
                (place / name).write_text(text, encoding="utf-8")
                running[fork(place, tests)] = key, name, place, time.monotonic()
                continue
            child, status = os.wait()
            key, name, place, begun = running.pop(child)
            (place / name).write_bytes((ROOT / name).read_bytes())
            output = Path(f"{place}.log").read_text(errors="replace")
            free.append(place)
            yield key, os.waitstatus_to_exitcode(status), output, time.monotonic() - begun


def main(names: list[str]) -> int:
    """Print a row for each line of tests; 1 if a mutant lives or does not apply."""
    table = tomllib.loads(TABLE.read_text(encoding="utf-8"))
    if missing := set(names) - table.keys():
        sys.exit(f"error: no mutant {sorted(missing)} in {TABLE}")
    jobs, bad = [], 0
    for name in names or table:
        old, mutant = table[name]["old"], table[name]
        text = (ROOT / mutant["file"]).read_text(encoding="utf-8")
        if text.count(old) != 1:
            sys.exit(f"error: the old text of {name} stands {text.count(old)} times in its file")
        text = text.replace(old, mutant["new"])
        jobs += [((name, t), mutant["file"], text, shlex.split(t)) for t in mutant["tests"]]
    for (name, tests), code, _, seconds in run(jobs):
        verdict = VERDICTS.get(code, "BROKEN")
        bad += verdict != "killed"
        print(f"{name:<38}{verdict:<14}{seconds:5.0f} s  {tests}", flush=True)
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
