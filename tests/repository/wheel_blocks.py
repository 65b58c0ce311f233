"""Run the commands of README and docs, with the wheel and the extras they name.

    python tests/repository/wheel_blocks.py [PAGE …] [--wheel FILE]

The blocks of a page run in its order, in an empty folder. What would take longer than minutes, or
needs what is not here, stands in ``LISTED`` with the reason; such a command is run with less where
its own options allow, and else its options are read and checked.
"""

import argparse
import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import yaml
from page_blocks import Block, blocks_of, stray_commands
from wheel_environments import Absent, Environment, Wheel, build
from wheel_smoke import copy

ROOT = Path(__file__).parents[2]
LIMIT = 150.0  # seconds for a block; what takes longer belongs into the list
PATIENCE = 600.0  # seconds until it is ended


@dataclass(frozen=True)
class Listed:
    """A command that does not run as printed, by how it begins: why, and what it runs with.

    Without ``instead`` its options are read and checked, and nothing runs.
    """

    begins: str
    reason: str
    instead: str = ""


LISTED = (
    Listed("make ", "works in a clone: its targets are looked for in the Makefile"),
    Listed("python -m agents.", "works in a clone"),
    Listed("pip install ", "downloads: its extras are looked for in the wheel"),
    Listed("fusion-gym train --config tobit_oscillator_front", "minutes"),
    Listed("fusion-gym train ", "minutes", "--timesteps 1024"),
    Listed("fusion-gym compare --config tobit_oscillator_front", "needs a training of minutes"),
    Listed("fusion-gym compare ", "minutes", "--episodes 4"),
    Listed("fusion-gym evaluate --env fusion_gym/RemoteEstimation-v1", "minutes", "--episodes 4"),
    Listed("fusion-gym watch ", "half a minute, for a film of all of an episode", "--steps 10"),
    Listed("fusion-gym calibrate ", "needs a training of minutes"),
    Listed("fusion-gym search ", "minutes", "--generations 1"),
    Listed("fusion-gym field ", "minutes"),
    Listed("tensorboard ", "serves until it is interrupted"),
)
READ = """
import contextlib, io, json, os, sys
from fusion_gym.commands.__main__ import load
from fusion_gym.commands.command_line import read_command
from fusion_gym.commands.command_line import check_options
from fusion_gym.training.config import config_path
from fusion_gym.validation import read_text
for place, folder, (program, name, *words) in json.loads(sys.stdin.read()):
    os.chdir(folder)
    sys.argv, said = [program, *words], io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            given = read_command(load(name))
            check_options(given)
            if getattr(given, "config", None) is not None:
                read_text("config", config_path(given.config))
    except (Exception, SystemExit) as error:
        print(f"{place}: {error} {said.getvalue()}")
"""


_PPO = """
import fusion_gym
from stable_baselines3 import PPO
ENV = "fusion_gym/LinearFusion-v2"
model = PPO("MlpPolicy", fusion_gym.make_sb3_vec_env(ENV, 2), n_steps=8, batch_size=16).learn(16)
model.save("agent.zip")
task = fusion_gym.make_task(ENV, horizon=5)
agent = fusion_gym.make_policy("model:agent.zip", task)
fusion_gym.evaluation.run_episodes(task, agent, 2)
"""
_COMMANDS = """
import contextlib, sys
from fusion_gym.commands.__main__ import main
for line in ("list", "info innovation_threshold", "info tanks", "fit tanks --output plant.yaml",
             "evaluate --env fusion_gym/LinearFusion-v2 --policies always --episodes 2"):
    sys.argv = ["fusion-gym", *line.split()]
    with contextlib.suppress(SystemExit):
        main()
"""
# What an extra is for, in an environment with that extra alone.
USES = {
    "": "import fusion_gym as f; t = f.make_task('fusion_gym/LinearFusion-v2', horizon=5); "
    "f.evaluation.run_episodes(t, f.make_policy('always', t), 2)",
    "marl": "import fusion_gym as f; f.parallel_env('fusion_gym/LinearFusion-v2').reset(seed=0)",
    "sb3": _PPO,
    "onnx": f"{_PPO}from fusion_gym.evaluation.onnx_export import export_onnx\n"
    "export_onnx(agent, task, 'agent.onnx', ENV)",
    "logs": _COMMANDS,
    "render": "import gymnasium, fusion_gym; e = gymnasium.make('fusion_gym/LinearFusion-v2', "
    "render_mode='rgb_array'); e.reset(seed=0); e.render()",
    "jax": "import fusion_gym.jax; fusion_gym.jax.make('fusion_gym/LinearFusion-v2')",
    "compiled": "import gymnasium, fusion_gym; gymnasium.make('fusion_gym/LinearFusion-v2', "
    "backend='compiled').reset()",
    "dask": "from distributed import Client",
    "agents": "import fusion_gym, cmaes, tensorboard; fusion_gym.train, fusion_gym.parallel_env",
}


@dataclass
class Pages:
    """What was run of the pages, and what was not."""

    wheel: Wheel
    makefile: str
    failed: list[str] = field(default_factory=list)
    left: list[str] = field(default_factory=list)
    used: set[Listed] = field(default_factory=set)
    unread: list[tuple[str, str, list[str]]] = field(default_factory=list)

    def run(self, page: Path, text: str, folder: Path) -> None:
        """The blocks of a page, in a folder that is made for them."""
        folder.mkdir(parents=True)
        blocks = blocks_of(page, text)
        stray = stray_commands(page, text)
        self.failed += [f"{item}: a command outside of a shell block" for item in stray]
        for place, block in enumerate(blocks):
            began = time.monotonic()
            output = self._run(block, blocks[place + 1 :], folder)
            taken = time.monotonic() - began
            if output is None and taken > LIMIT:
                output = f"takes {taken:.0f} s: it belongs into LISTED of {Path(__file__).name}"
            if output is not None:
                self.failed.append(f"{block.place}: {output}")
            print(f"{taken:5.1f} s  {block.place}{'  failed' if output else ''}", flush=True)

    def use(self, extra: str, folder: Path) -> None:
        """What an extra is for."""
        environment = self.wheel.environment(frozenset(filter(None, [extra])))
        (place := folder / f"use_{extra}").mkdir()
        words = [str(environment.programs / "python"), "-c", USES[extra]]
        if (output := _wrong(words, environment, place)) is not None:
            self.failed.append(f"the extra {extra!r}: {output}")

    def _run(self, block: Block, later: Sequence[Block], folder: Path) -> str | None:
        """What is wrong with a block; ``None`` if nothing is."""
        if block.file is not None:
            (folder / block.file).write_text(block.text)
        if block.language == "yaml":
            return _wrong_yaml(block, later)
        if block.language == "python":
            return None  # `make docs` runs it
        try:
            unknown = block.needs - set(self.wheel.extras)
            if unknown:
                raise Absent(", ".join(unknown))
            environment = self.wheel.environment(block.needs)
        except Absent as absent:
            self.left.append(f"{block.place} (needs {absent})")
            return None
        return self._wrong_shell(block, environment, folder)

    def _wrong_shell(self, block: Block, environment: Environment, folder: Path) -> str | None:
        lines = []
        for line, words in block.commands():
            listed = next((item for item in LISTED if line.startswith(item.begins)), None)
            if listed is None:
                lines.append(line)
            elif listed.instead:
                self.used.add(listed)
                lines.append(f"{shlex.join(words)} {listed.instead}")
            else:
                self.used.add(listed)
                text = self._wrong_words(words, environment)
                if text is not None:
                    return text
                if words[0] == "fusion-gym":
                    self.unread.append((block.place, str(folder), words))
        script = "\n".join(["set -euo pipefail", *lines])
        return _wrong(["bash", "-c", script], environment, folder) if lines else None

    def read(self) -> None:
        """Read and check the options of the commands that were not run, all at once."""
        environment = self.wheel.environment(frozenset({"agents"}))
        words = [str(environment.programs / "python"), "-c", READ]
        wrong = _run(words, _variables(environment), self.wheel.folder, self.unread)
        self.failed += [wrong.stderr] if wrong.returncode else wrong.stdout.splitlines()

    def _wrong_words(self, words: list[str], environment: Environment) -> str | None:
        """What is wrong with a command that is not run, but for its options."""
        if words[0] == "make":
            there = re.search(rf"^{words[1]}:", self.makefile, re.MULTILINE)
            return None if there else f"the Makefile has no target {words[1]}"
        if words[0] == "pip":
            text = {part for word in words for part in re.findall(r"\[(.*?)\]", word)}
            extras = {name for part in text for name in part.split(",")}
            return None if extras <= set(self.wheel.extras) else f"no extras {extras}"
        if words[0] == "python" and words[2] != "pytest":
            path = ROOT.joinpath(*words[2].split("."))
            there = path.is_dir() or path.with_suffix(".py").exists()
            return None if there else f"no module {words[2]}"
        there = (environment.programs / words[0]).exists()
        return None if there else f"no program {words[0]}"


def _wrong(words: list[str], environment: Environment, folder: Path) -> str | None:
    """What a program said, if it did not end well."""
    try:
        done = _run(words, _variables(environment), folder)
    except subprocess.TimeoutExpired:
        return f"has not ended after {PATIENCE:.0f} s"
    return None if done.returncode == 0 else f"{done.stdout[-1000:]}\n{done.stderr[-3000:]}"


def _wrong_yaml(block: Block, later: Sequence[Block]) -> str | None:
    """A file of the page has a name, which a later block uses."""
    yaml.safe_load(block.text)
    if block.file is None:
        return "the first line does not name the file, as # plant.yaml does"
    if not any(block.file in item.text for item in later):
        return f"no later block uses {block.file}"
    return None


def _variables(environment: Environment) -> dict[str, str]:
    """Of a program in an environment."""
    plain = {key: text for key, text in os.environ.items() if not key.startswith("PYTHON")}
    path = f"{environment.programs}{os.pathsep}{os.environ['PATH']}"
    # No window, and one thread, as the reference machine has them.
    return plain | {"PATH": path, "OMP_NUM_THREADS": "1", "SDL_VIDEODRIVER": "dummy"}


def _run(
    words: list[str], variables: dict[str, str], folder: Path, handed: object = None
) -> subprocess.CompletedProcess[str]:
    """Run a program."""
    return subprocess.run(
        words, cwd=folder, env=variables, input=json.dumps(handed), capture_output=True, text=True,
        timeout=PATIENCE,
    )  # fmt: skip


def run_pages(pages: Sequence[Path], wheel: Path | None) -> None:
    """Run the blocks of pages (none: of all) with a wheel, which is built where none is given.

    Raises:
        SystemExit: a block does not run, or an entry of the list is of no use.
    """
    selection = pages or [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        file = wheel or build(copy(folder / "source"), folder / "built")
        run = Pages(Wheel(file, folder), (ROOT / "Makefile").read_text())
        for extra in run.wheel.extras if not pages else []:
            if extra not in ("docs", "test"):
                run.use(extra, folder)

        def run_page(number: int, page: Path) -> None:
            own = page.resolve().is_relative_to(ROOT)
            label = page.resolve().relative_to(ROOT) if own else page
            run.run(label, page.read_text(), folder / f"page_{number}" / label.stem)

        with ThreadPoolExecutor(2) as pool:
            list(pool.map(run_page, range(len(selection)), selection))
        run.read()
    for text in run.left:
        print(f"left to make integrations: {text}")
    useless = [item.begins for item in LISTED if item not in run.used] if not pages else []
    wrong = [*run.failed, *(f"LISTED: no page shows {begins!r}" for begins in useless)]
    if wrong:
        sys.exit("\n".join(wrong))


def main() -> None:
    """Entry point; exit status 1 if something is wrong."""
    parser = argparse.ArgumentParser(description="Run the blocks of README and docs as printed.")
    parser.add_argument("pages", nargs="*", type=Path, help="all by default")
    parser.add_argument("--wheel", type=Path, help="one that was built")
    arguments = parser.parse_args()
    run_pages(arguments.pages, arguments.wheel)


if __name__ == "__main__":
    main()
