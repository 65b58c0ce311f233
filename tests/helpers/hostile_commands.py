"""Tries that every command must refuse: its options, each with what cannot be meant.

They are made from the commands' fields, so a new option is tried without a change here.
"""

import dataclasses
import typing
from collections.abc import Iterator
from typing import Any, NamedTuple

from hostile_folder import BROKEN, ENV

from agents.benchmark.command import Benchmark
from agents.papers.reproduce import Reproduce
from agents.zoo.zoo import Zoo
from fusion_gym.commands import __main__ as fusion_gym_commands
from fusion_gym.commands.command_line import OUTPUT_FOLDER, Command, OutputFile

RESEARCH: dict[str, type[Command]] = {
    "benchmark": Benchmark,
    "papers": Reproduce,
    "zoo": Zoo,
}
EVERY = (*fusion_gym_commands.COMMANDS, *RESEARCH)


def load(name: str) -> type[Command]:
    """Return the class of a command of fusion-gym, or of the research made with it."""
    kind: type[Command] = RESEARCH.get(name) or fusion_gym_commands.load(name)
    return kind


LONG = "n" * 300
JSON = [name for name in BROKEN if name not in ("date", "tag")]  # which a JSON reader knows not

# What a command needs beside the option that is tried. None of these tries may get so far.
BASES: dict[str, dict[str, list[str]]] = {
    "evaluate": {
        "env": [ENV], "set": ["horizon=4"], "policies": ["always"], "episodes": ["2"],
        "json": ["made.json"],
    },
    "compare": {
        "config": ["training.yaml"], "policies": ["always"], "output": ["made"],
        "episodes": ["2"],
    },
    "calibrate": {
        "env": [ENV], "policy": ["zoo:tobit_oscillator_scheduler"], "output": ["made.zip"],
        "set": [
            "filter=tobit", "random_start=true", "token_rate=2", "memory=true",
            "cost_weight=random", "price_range=[0.01513,2.353]",
        ],
    },
    "fit": {"log": ["log.csv"], "output": ["made.yaml"], "channels": ["a"], "share": ["0.5"]},
    "field": {"log": ["log.csv"], "output": ["made"], "channels": ["a"], "share": ["0.5"]},
    "list": {"kinds": ["rules"]},
    "info": {"name": ["whittle"]},
    "papers": {
        "papers": ["markov_jump"], "output": ["made"], "work": ["made_too"],
        "episodes": ["2"],
    },
    "watch": {"env": [ENV], "set": ["horizon=4"], "policy": ["always"], "save": ["made.gif"]},
    "export": {"model": ["zoo:remote_estimation_scheduler"], "onnx": ["made.onnx"]},
    "zoo": {"work": ["made"], "zoo": ["made_too"], "workers": ["1"]},
    "demo": {"output": ["made"], "episodes": ["2"], "timesteps": ["32"]},
    "train": {"config": ["training.yaml"], "output": ["made"]},
    "search": {
        "env": [ENV], "set": ["horizon=4"], "output": ["made"], "class": ["scheduler"],
        "prices": ["2"], "generations": ["1"],
    },
    "benchmark": {
        "results": ["made"], "work": ["made_too"], "workers": ["1"], "policy": ["always"],
        "class": ["scheduler"], "settings": ["remote_estimation"],
    },
}  # fmt: skip

WORDS = ["nothing_of_that_name", "fusion_gym/Nothing-v0"]
POLICIES = [
    "nothing", "nothing:a=1", "always:a=1", "random:rate=x", "random:rate=nan", "random:rate=2",
    "random:rate", "random:rate=.5,rate=.5", "periodic:period=0", "periodic:period=1e9999",
    "model:", "model:absent.zip", "model:text", "model:folder", "model:latin", "zoo:", "zoo:nobody",
    "zoo:remote_estimation_scheduler,price=-1", "innovation_threshold:threshold={[]:1}",
    "innovation_threshold:threshold=" + "(" * 300, "whittle:price=-1", ":", "=",
    "rollout:steps=0,base=never", "rollout:steps=1000000000,base=never", "os:abort",
    "rollout:samples=1000000000,base=never", "periodic:period=" + "9" * 30,
    "periodic_optimum:period=1000000000,packets=500000000", "always\0", "nothing\x1b[0m",
]  # fmt: skip
SETTINGS = [
    "horizon", "=", "=3", "horizn=3", "horizon=0", "horizon=-1", "horizon=nan", "horizon=x",
    "horizon=2.5", "horizon=None", "horizon={[]:1}", "horizon=" + "(" * 300, "cost_weight=nan",
    "token_rate=-1", "information=nobody", "access=1", "render_mode=human",
    "self=1", "env=3", "system=code.yaml", "system=itself.yaml", "horizon=1\n", "error=os:nothing",
    "error=os.path:join",
]  # fmt: skip
WHOLE = ["-1", "0", "nan", "1.5", "many", "9" * 30]
REAL = ["-1", "0", "2", "nan", "inf", "much"]
# No device is among these, for a command that is wrong would replace it.
FOLDERS = ["text", "text/below", "locked/below", LONG, "loop/below", "/proc/self/made", "pipe"]
FILES = ["folder", "text/made.json", "locked/made.json", f"{LONG}.json", "loop",
         "/proc/self/made.json"]  # fmt: skip
UNREADABLE = ["absent.yaml", "absent", "folder", "locked/file.yaml", "text/below.yaml", LONG,
              "loop.yaml"]  # fmt: skip
# Words without a name before them.
POSITIONAL = {("papers", "papers"), ("export", "model"), ("list", "kinds"), ("info", "name"),
              ("fit", "log"), ("field", "log")}  # fmt: skip
# Numbers among the hostile ones that an option may have after all.
ALLOWED = {("seed", "0"), ("seeds", "0"), ("seed", "9" * 30)}
ALLOWED |= {("error_code", number) for number in ("-1", "0", "2")}


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
    kind: type[Command] = load(name)
    hints = typing.get_type_hints(kind, include_extras=True)
    result = {field.name: hints[field.name] for field in dataclasses.fields(kind)}
    for field, option in (("options", "set"), ("of", "class")):
        if field in result:
            result[option] = result.pop(field)
    return result


def hostile(option: str, kind: Any, present: list[str] | None = None) -> list[str]:
    """Values that an option of this type cannot have; ``present`` is one that it has."""
    marks = getattr(kind, "__metadata__", ())
    text = str(kind)
    results = [f"bad_results/{name}" for name in JSON]
    if OUTPUT_FOLDER in marks:
        values = [*FOLDERS, *(results if present == ["results"] else [])]
    elif any(isinstance(mark, OutputFile) for mark in marks):
        values = FILES
    elif option in ("policies", "policy", "against"):
        values = POLICIES
    elif option == "set":
        values = SETTINGS
    elif option == "config":
        values = [*UNREADABLE, *(f"{name}.yaml" for name in BROKEN)]
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
    return ["", "\udcff", *(value for value in values if (option, value) not in ALLOWED)]


def tries() -> Iterator[Try]:
    """Every option of every command with every value that it cannot have."""
    for command, base in BASES.items():
        for option, kind in options(command).items():
            for value in hostile(option, kind, base.get(option)):
                yield Try(command, option, value, line(command, base | {option: [value]}))
        yield Try(command, "nothing", "nothing", [*line(command, base), "--nothing", "3"])
        yield Try(command, "", "stray", [*line(command, base), "stray"])
    evaluate = BASES["evaluate"]
    for name in JSON:
        words = line("evaluate", evaluate | {"json": [f"{name}.json"]})
        yield Try("evaluate", "json", f"{name}.json", [*words, "--resume"])
    yield Try("evaluate", "resume", "json", [*line("evaluate", evaluate)[:-2], "--resume"])
    yield Try("evaluate", "reference", "never", [*line("evaluate", evaluate), "--reference=never"])
    for name in ("search", "train"):
        yield Try(name, "resume", "made", [*line(name, BASES[name]), "--resume"])


def line(command: str, arguments: dict[str, list[str]]) -> list[str]:
    """The words behind the command."""
    first: list[str] = []
    joined: list[str] = []
    last: list[str] = []
    for option, words in arguments.items():
        name = f"--{option.replace('_', '-')}"
        if (command, option) in POSITIONAL:
            if words[0].startswith("-"):
                last = ["--", *words]
            else:
                first = words
        else:
            joined += [f"{name}={words[0]}"] if words[0].startswith("-") else [name, *words]
    return [*first, *joined, *last]
