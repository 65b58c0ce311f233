"""Apply each patch of this folder to a copy of the tree: its tests must fail (``make mutants``).

    python tests/mutants/apply.py [NAME …]

A patch begins with one or more lines ``# tests: ARGUMENTS OF PYTEST``, each of which must fail.
"""

import os
import shlex
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

FOLDER = Path(__file__).parent
ROOT = FOLDER.parents[1]
RED, COLLECTED_NOTHING = 1, 5  # pytest's exit codes


def copied(target: Path) -> None:
    """The tracked files, and new ones that git does not ignore."""
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(listed, cwd=ROOT, capture_output=True, check=True).stdout.split(b"\0")
    there = b"\0".join(name for name in names if name and (ROOT / os.fsdecode(name)).exists())
    pack = ["tar", "-C", str(ROOT), "--null", "-T", "-", "-cf", "-"]
    packed = subprocess.run(pack, input=there, capture_output=True, check=True).stdout
    subprocess.run(["tar", "-C", str(target), "-xf", "-"], input=packed, check=True)


def run(patch: Path) -> list[tuple[str, str, float]]:
    """For each line of tests: what it names, "killed" or what is wrong, and seconds."""
    text = patch.read_text(encoding="utf-8")
    lines = [line[9:] for line in text.splitlines() if line.startswith("# tests: ")]
    with tempfile.TemporaryDirectory() as place:
        copied(Path(place))
        applied = subprocess.run(["git", "apply", str(patch)], cwd=place, capture_output=True)
        if applied.returncode or not lines:
            return [("", applied.stderr.decode().strip() or "no line of tests", 0.0)]
        return [(line, *verdict(line, Path(place))) for line in lines]


def verdict(line: str, place: Path) -> tuple[str, float]:
    """What the tests of a line say of the mutant in a folder."""
    begun = time.monotonic()
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
    changed = {"PYTHONPATH": str(place), "OMP_NUM_THREADS": "1"}
    ended = subprocess.run(
        [*command, *shlex.split(line)], cwd=place, env=os.environ | changed, capture_output=True
    )
    text = {0: "SURVIVED", RED: "killed", COLLECTED_NOTHING: "NO SUCH TEST"}
    return text.get(ended.returncode, "BROKEN"), time.monotonic() - begun


def main(names: list[str]) -> int:
    """Print a row for each line of tests; 1 if a mutant lives or does not apply."""
    patches = [p for p in sorted(FOLDER.glob("*.patch")) if not names or p.stem in names]
    missing = set(names) - {patch.stem for patch in patches}
    if missing:
        sys.exit(f"error: no patch {sorted(missing)} in {FOLDER}")
    bad = 0
    with ThreadPoolExecutor(2) as pool:
        for patch, rows in zip(patches, pool.map(run, patches), strict=True):
            for line, text, seconds in rows:
                bad += text != "killed"
                print(f"{patch.stem:<38}{text:<14}{seconds:5.0f} s  {line}", flush=True)
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
