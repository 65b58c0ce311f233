"""Tries that every command must refuse: its options, each with what cannot be meant.

They are made from the commands' fields, so a new option is tried without a change here.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import io
import os
import re
import resource
import shutil
import signal
import sys
import traceback
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from agents import __main__ as everything
from agents.command_line import Command
from agents.input.options import OutputFile, OutputFolder

ROOT = Path(__file__).parent.parent
ENV = "fusion_gym/RemoteEstimation-v0"
LONG = "n" * 300
SETTING = "remote_estimation"
NOBODY = 65534

TRAINING = {
    "environment": {"id": ENV, "options": {"horizon": 4}},
    "algorithm": {"name": "ppo", "n_steps": 8, "batch_size": 16, "network": {"hidden": [4]}},
    "training": {"timesteps": 32, "num_envs": 2},
    "validation": {"every": 32, "episodes": 2},
    "output": "made",
}
SWEEP = {
    "points": ["never", "always"],
    "curves": [{"label": "a", "policy": "periodic:period={value}", "values": [2, 3]}],
}
ROWS = {"environment": ENV, "rows": [{"label": "a", "policy": "always"}]}
SUITE = {
    "episodes": 2,
    "training_seeds": 1,
    "timesteps": 32,
    "num_envs": 2,
    "prices": 2,
    "modes": ["sensors"],
    "tuning": {"trials": 2, "episodes": 2, "kept": 2},
    "algorithm": TRAINING["algorithm"],
    "families": [],
    "settings": [
        {
            "name": "one",
            "title": "one",
            "environment": TRAINING["environment"],
            "price_range": [0.1, 1.0],
        }
    ],
}

# What a command needs beside the option that is tried. None of these tries may get so far.
BASES: dict[str, dict[str, list[str]]] = {
    "evaluate": {
        "env": [ENV], "set": ["horizon=4"], "policies": ["always"], "episodes": ["2"],
        "json": ["made.json"],
    },
    "compare": {
        "config": ["training.yaml"], "sweep": ["sweep.yaml"], "policy": ["always"],
        "output": ["made"], "episodes": ["2"],
    },
    "report": {"results": ["results"]},
    "reproduce": {"config": ["rows.yaml"], "episodes": ["2"]},
    "zoo": {"results": ["results"], "work": ["work"], "zoo": ["made"]},
    "demo": {"output": ["made"], "episodes": ["2"], "timesteps": ["32"], "sweep": ["sweep.yaml"]},
    "solved": {
        "config": ["training.yaml"], "output": ["made"], "episodes": ["2"], "seeds": ["0"],
    },
    "train": {"config": ["training.yaml"], "output": ["made"]},
    "tune": {"config": ["training.yaml"], "output": ["made"], "trials": ["1"]},
    "benchmark": {
        "config": ["suite.yaml"], "results": ["made"], "work": ["made_too"], "workers": ["1"],
    },
}  # fmt: skip

# Files that are no config and no result, by name.
BROKEN: dict[str, bytes] = {
    "empty": b"",
    "text": b"this is no structure: at: all\n\t- x",
    "latin": "Größe: 1".encode("latin-1"),
    "binary": bytes(range(256)),
    "list": b"[1, 2]",
    "number": b"3",
    "null": b"null",
    "half": b'{"policies": {"always": ',
    "date": b"output: 2020-13-45",
    "deep": b"[" * 1050,
    "tag": b"!!python/object:os.system x",
    "stamp": b"output: !!timestamp x",
    "digits": b"output: " + b"9" * 5000,
    "other": b'{"something": {"else": 1}}',
}
NAMES = {".yaml": BROKEN, ".json": {k: v for k, v in BROKEN.items() if k not in ("date", "tag")}}

WORDS = ["nothing_of_that_name", "fusion_gym/Nothing-v0"]
POLICIES = [
    "nothing", "nothing:a=1", "always:a=1", "random:rate=x", "random:rate=nan", "random:rate=2",
    "random:rate", "random:rate=.5,rate=.5", "periodic:period=0", "periodic:period=1e9999",
    "model:", "model:absent.zip", "model:text", "model:folder", "model:latin", "zoo:", "zoo:nobody",
    "zoo:remote_estimation_sensors,price=-1", "innovation_threshold:threshold={[]:1}",
    "innovation_threshold:threshold=" + "(" * 300, "whittle:price=-1", ":", "=",
    "lookahead:steps=0",
]  # fmt: skip
SETTINGS = [
    "horizon", "=", "=3", "horizn=3", "horizon=0", "horizon=-1", "horizon=nan", "horizon=x",
    "horizon=2.5", "horizon=None", "horizon={[]:1}", "horizon=" + "(" * 300, "cost_weight=nan",
    "token_rate=-1", "information=nobody", "access=1", "render_mode=human",
]  # fmt: skip
WHOLE = ["-1", "0", "nan", "1.5", "many", "9" * 30]
REAL = ["-1", "0", "2", "nan", "inf", "much"]
FOLDERS = ["text", "text/below", "locked/below", LONG, "loop/below", "/proc/self/made", "pipe"]
FILES = ["folder", "text/made.json", "locked/made.json", f"{LONG}.json", "loop",
         "/proc/self/made.json"]  # fmt: skip
UNREADABLE = ["absent.yaml", "absent", "folder", "locked/file.yaml", "text/below.yaml", LONG,
              "loop.yaml"]  # fmt: skip
# No device is among these: an older version, run as root, replaced /dev/full by a plain file.
# Numbers among the hostile ones that an option may have after all.
ALLOWED = {("seed", "0"), ("seeds", "0"), ("seed", "9" * 30)}


class Try(NamedTuple):
    """A command line, and what its refusal must name."""

    command: str
    option: str
    value: str
    words: list[str]

    def __str__(self) -> str:
        return f"{self.command} --{self.option} {self.value[:40]}"


def options(name: str) -> dict[str, Any]:
    """A command's options and their types, with what is annotated."""
    kind: type[Command] = getattr(importlib.import_module(f"agents.{name}"), name.capitalize())
    hints = typing.get_type_hints(kind, include_extras=True)
    found = {field.name: hints[field.name] for field in dataclasses.fields(kind)}
    if "options" in found:
        found["set"] = found.pop("options")
    return found


def hostile(option: str, kind: Any, present: list[str] | None = None) -> list[str]:
    """Values that an option of this type cannot have; ``present`` is one that it has."""
    marks = {type(mark) for mark in getattr(kind, "__metadata__", ())}
    text = str(kind)
    results = [f"bad_results/{name}" for name in NAMES[".json"]]
    if OutputFolder in marks:
        values = [*FOLDERS, *(results if present == ["results"] else [])]
    elif OutputFile in marks:
        values = FILES
    elif option in ("policies", "policy"):
        values = POLICIES
    elif option == "set":
        values = SETTINGS
    elif option in ("config", "sweep"):
        values = [*UNREADABLE, *(f"{name}.yaml" for name in NAMES[".yaml"])]
    elif "Path" in text:
        values = [*UNREADABLE, *results]
    elif "bool" in text:
        return []
    elif "int" in text:
        values = WHOLE
    elif "float" in text:
        values = REAL
    else:
        values = WORDS
    return ["", *(value for value in values if (option, value) not in ALLOWED)]


def tries() -> Iterator[Try]:
    """Every option of every command with every value that it cannot have."""
    for command, base in BASES.items():
        for option, kind in options(command).items():
            for value in hostile(option, kind, base.get(option)):
                yield Try(command, option, value, line(command, base | {option: [value]}))
        yield Try(command, "nothing", "nothing", [*line(command, base), "--nothing", "3"])
        yield Try(command, "", "stray", [*line(command, base), "stray"])
    evaluate = BASES["evaluate"]
    for name in NAMES[".json"]:
        words = line("evaluate", evaluate | {"json": [f"{name}.json"]})
        yield Try("evaluate", "json", f"{name}.json", [*words, "--resume"])
    yield Try("evaluate", "resume", "json", [*line("evaluate", evaluate)[:-2], "--resume"])
    yield Try("evaluate", "reference", "never", [*line("evaluate", evaluate), "--reference=never"])
    yield Try("train", "resume", "made", [*line("train", BASES["train"]), "--resume"])


def line(command: str, given: dict[str, list[str]]) -> list[str]:
    """The words behind the command."""
    joined = []
    for option, words in given.items():
        name = f"--{option.replace('_', '-')}"
        joined += [f"{name}={words[0]}"] if words[0].startswith("-") else [name, *words]
    return joined


def scratch(folder: Path) -> None:
    """A folder with what the tries need, where everybody may write."""
    for name, content in (
        ("training", TRAINING), ("sweep", SWEEP), ("rows", ROWS), ("suite", SUITE)
    ):  # fmt: skip
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(content))
    for name, raw in BROKEN.items():
        for suffix in ("", ".yaml", ".json"):
            (folder / f"{name}{suffix}").write_bytes(raw)
        broken = folder / "bad_results" / name / SETTING
        broken.mkdir(parents=True)
        shutil.copy(ROOT / "results" / SETTING / "baselines.json", broken)
        (broken / "verdict.json").write_bytes(raw)
        (broken / "agent_sensors_0.json").write_bytes(raw)
    made = folder / "results" / SETTING
    made.mkdir(parents=True)
    for name in ("verdict", "baselines", "agent_sensors_0"):
        shutil.copy(ROOT / "results" / SETTING / f"{name}.json", made)
    model = folder / "work" / SETTING / "sensors_0"
    model.mkdir(parents=True)
    (model / "best_model.zip").write_bytes(b"a model")
    (folder / "folder").mkdir()
    (folder / "folder" / "file").write_text("kept")
    (folder / "locked").mkdir()
    (folder / "locked" / "file.yaml").write_text("kept: 1")
    for name in ("loop", "loop.yaml"):
        (folder / name).symlink_to(name)
    os.mkfifo(folder / "pipe")
    for path in (folder, *folder.rglob("*")):
        if not path.is_symlink():
            path.chmod(0o777 if path.is_dir() else 0o666)
    (folder / "locked").chmod(0)


class Hung(BaseException):
    """A try took too long."""


class Ended(NamedTuple):
    """How a command ended."""

    status: int
    out: str
    err: str
    trace: str


def call(command: str, words: list[str], seconds: float = 20.0, limit: int | None = None) -> Ended:
    """A command in this process, in the present folder; ``limit`` bytes are the longest file."""

    def late(*_: object) -> None:
        raise Hung

    out, err, trace, status = io.StringIO(), io.StringIO(), "", 0
    longest = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = sys.argv, signal.signal(signal.SIGALRM, late)
    sys.argv = ["fusion-gym", command, *words]
    signal.setitimer(signal.ITIMER_REAL, seconds)
    if limit is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, longest[1]))
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            everything.main()
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 1
        if isinstance(end.code, str):
            err.write(end.code + "\n")
        status = 0 if end.code is None else status
    except BaseException:
        status, trace = 1, traceback.format_exc()
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        resource.setrlimit(resource.RLIMIT_FSIZE, longest)
        sys.argv = before[0]
        signal.signal(signal.SIGALRM, before[1])
    return Ended(status, out.getvalue(), err.getvalue(), trace)


def contents(folder: Path) -> dict[str, bytes | None]:
    """All that is in a folder."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }


@contextlib.contextmanager
def without_rights(wanted: bool) -> Iterator[None]:
    """As somebody who may not enter a locked folder, even if the tests run as root."""
    if not wanted or os.geteuid() != 0:
        yield
        return
    os.seteuid(NOBODY)
    try:
        yield
    finally:
        os.seteuid(0)


def flaw(tried: Try, folder: Path) -> str | None:
    """What is wrong with how the command refuses; ``None`` if nothing is."""
    before = contents(folder)
    with without_rights("locked" in tried.value):
        ended = call(tried.command, tried.words)
    if ended.trace:
        return f"traceback: {ended.trace.strip().splitlines()[-1]}"
    if ended.status == 0:
        return "accepted"
    lines = ended.err.splitlines()
    if len(lines) != 1 or not lines[0].startswith("error: "):
        return f"not one line: {ended.err[:300]!r}"
    shown = lines[0].replace("\\\\", "\\")
    spelled = {tried.option, tried.option.replace("_", "-")}
    spec = tried.option in ("policies", "policy", "set")
    part = re.split("[:=,]", tried.value)[0] if spec else tried.value
    if part[:200] not in shown:
        return f"does not name the value: {lines[0][:300]}"
    if not any(name in shown for name in spelled | SAID.get(tried.option, set())):
        return f"does not name the option: {lines[0][:300]}"
    if contents(folder) != before:
        return f"left {sorted(contents(folder).keys() ^ before.keys())}"
    return None


# Other words that name an option: those of the one thing that stands in its list.
SAID = {
    "policies": {"policy", "model", "zoo"},
    "policy": {"policy", "model", "zoo"},
    "set": {"option", "horizon", "cost_weight", "token_rate", "information", "access"},
    "env": {"environment"},
    "seeds": {"seed"},
}
