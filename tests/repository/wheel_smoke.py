"""Build the package and use it as its users do: from a wheel, in an empty folder.

    python tests/repository/wheel_smoke.py

A source distribution is built from what git tracks (or from this folder where there is no git), a
wheel from that alone, and the wheel goes into a fresh virtual environment in a temporary folder.
That environment sees the other packages of the interpreter that runs this script, through a path
file, so that nothing is loaded twice; pip then checks what the wheel says it needs against them
and against constraints.txt. An editable install of the repository stays out of sight, because
Python runs no path files of a folder that is itself named by one.
"""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tempfile
import time
import venv
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
CONSTRAINTS = str(ROOT / "constraints.txt")
# Of the repository alone.
HIDDEN = {".ci", ".github", ".gitignore", ".pre-commit-config.yaml", ".readthedocs.yaml"}
LIBRARY = """
import sys
import gymnasium as gym
import fusion_gym
assert fusion_gym.__file__.startswith(sys.prefix), fusion_gym.__file__
for name in ("agents", "configs", "tests", "benchmarks"):
    try:
        __import__(name)
    except ImportError:
        continue
    raise AssertionError(f"the package installs a top-level name {name}")
env = gym.make("fusion_gym/TobitOscillator-v1")
env.reset(seed=0)
env.step(env.action_space.sample())
assert len(fusion_gym.zoo.names()) > 10
"""
HELP = """
import contextlib, io, sys
from fusion_gym.commands.__main__ import COMMANDS, main
for name in COMMANDS:
    sys.argv = ["fusion-gym", name, "--help"]
    said = io.StringIO()
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(said):
        main()
    assert f" {name} [-h] " in said.getvalue().splitlines()[0], said.getvalue()
"""
WITHOUT_EXTRA = """
import sys
sys.modules["tyro"] = None
sys.argv = ["fusion-gym", "evaluate"]
from fusion_gym.commands.__main__ import main
main()
"""


def call(*words: str | Path, cwd: Path, status: int = 0) -> subprocess.CompletedProcess[str]:
    """Run a program and check its exit status.

    Raises:
        SystemExit: another status; what the program said goes before it.
    """
    began = time.perf_counter()
    plain = {key: text for key, text in os.environ.items() if not key.startswith("PYTHON")}
    done = subprocess.run(list(map(str, words)), cwd=cwd, env=plain, capture_output=True, text=True)
    output = " ".join(map(str, words[:5])).splitlines()[0]
    if done.returncode != status:
        sys.exit(f"{done.stdout}\n{done.stderr}\n{output} ended with {done.returncode}")
    print(f"{time.perf_counter() - began:5.1f} s  {output}", flush=True)
    return done


def copy(folder: Path) -> Path:
    """What belongs to the repository, in a folder of its own, so that no old build gets in."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT, capture_output=True, text=True,
    )  # fmt: skip
    if listed.returncode != 0:
        result = shutil.ignore_patterns(".*", "__pycache__", "*.egg-info", "build", "runs")
        return Path(shutil.copytree(ROOT, folder, ignore=result))
    for name in filter(None, listed.stdout.split("\0")):
        if (ROOT / name).is_file() or (ROOT / name).is_symlink():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, folder / name, follow_symlinks=False)
    return folder


def install(wheel: Path, folder: Path) -> Path:
    """A fresh environment with the wheel; returns its folder of programs."""
    venv.create(folder, with_pip=True)
    programs = folder / ("Scripts" if os.name == "nt" else "bin")
    pip = (programs / "python", "-m", "pip", "--disable-pip-version-check", "--quiet", "install")
    call(*pip, "--no-deps", wheel, cwd=folder)
    place = call(
        programs / "python", "-c", "import sysconfig; print(sysconfig.get_path('purelib'))",
        cwd=folder,
    ).stdout.strip()  # fmt: skip
    (Path(place) / "others.pth").write_text(sysconfig.get_path("purelib") + "\n")
    call(*pip, "--constraint", CONSTRAINTS, "fusion-gym[agents]", cwd=folder)
    return programs


def use(programs: Path, folder: Path) -> None:
    """Everything that a user of the installed package may do, in an empty folder."""
    folder.mkdir()
    python, program = programs / "python", programs / "fusion-gym"
    call(python, "-c", LIBRARY, cwd=folder)
    lacking = call(python, "-c", WITHOUT_EXTRA, cwd=folder, status=1).stderr
    assert (
        lacking.strip() == "error: tyro is missing: install fusion-gym with its extra 'agents'"
    ), lacking
    call(python, "-c", HELP, cwd=folder)
    call(
        program, "evaluate", "--config", "tobit_oscillator_ppo", "--set", "belief_features=true",
        "--episodes", "5", "--policies", "always", "zoo:tobit_oscillator_scheduler",
        "--json", "evaluation.json", cwd=folder,
    )  # fmt: skip
    assert len(json.loads((folder / "evaluation.json").read_text())["policies"]) == 2
    quick = ("--episodes", "2", "--timesteps", "8192")
    call(program, "demo", *quick, "--output", "demo", cwd=folder)
    assert (folder / "demo" / "linear_fusion" / "comparison" / "pareto.png").exists()


def main() -> None:
    """Build, install, use; look for every file, and run tests, in the source distribution.

    Then run what the pages show.
    """
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        source, built = copy(folder / "source"), folder / "built"
        call(sys.executable, "-m", "build", "--outdir", built, source, cwd=folder)
        (wheel,), (archive,) = built.glob("*.whl"), built.glob("*.tar.gz")
        with zipfile.ZipFile(wheel) as packed_wheel:
            (name,) = (item for item in packed_wheel.namelist() if item.endswith("/METADATA"))
            text = packed_wheel.read(name).decode()
        assert "Description-Content-Type: text/markdown" in text
        assert "](https://github.com/" in text
        assert "](docs/" not in text
        programs = install(wheel, folder / "environment")
        use(programs, folder / "empty")
        with tarfile.open(archive) as packed:
            packed.extractall(folder / "unpacked", filter="data")
        (unpacked,) = (folder / "unpacked").iterdir()
        shipped = {path.relative_to(unpacked) for path in unpacked.rglob("*")}
        names = [path.relative_to(source) for path in source.rglob("*") if path.is_file()]
        missing = [path for path in names if path not in shipped and path.parts[0] not in HIDDEN]
        assert not missing, f"the source distribution lacks {missing}"
        tests = (
            "-m",
            "pytest",
            "-q",
            "tests/commands/test_commands.py",
            "-k",
            "configs or algorithm or name",
        )
        call(programs / "python", *tests, cwd=unpacked)
        from wheel_blocks import run_pages  # which takes `copy` from here

        run_pages((), wheel)
    print("the package works from the wheel, and the source distribution is complete")


if __name__ == "__main__":
    main()
