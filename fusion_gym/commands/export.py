"""Export a saved agent as an ONNX file, for sensors and schedulers without this library.

    fusion-gym export zoo:tobit_oscillator_scheduler,price=0.2 --onnx scheduler.onnx

The file contains the graph from the observation to the request, and a description of the
observation. The command compares it with the agent on 10,000 observations of whole episodes, and
removes it if they differ.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from fusion_gym import zoo
from fusion_gym.commands.command_line import Command, EnvironmentOptions, OutputFile
from fusion_gym.entries import Options
from fusion_gym.envs.registration import make_task
from fusion_gym.errors import forbidden
from fusion_gym.importing import require
from fusion_gym.output.files import replacing
from fusion_gym.policies.registry import make_policy, parse_settings
from fusion_gym.validation import ConfigurationError, refusal

_KINDS = ("zoo", "model")


@dataclass(frozen=True)
class Export(EnvironmentOptions, Command):
    """Export a saved agent as an ONNX file, by default for the environment of its training."""

    model: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")]
    """An agent: zoo:NAME, model:PATH or the path of a .zip, with ,price=PRICE for one price."""
    onnx: Annotated[Path, OutputFile(".onnx")]
    """The file to write."""
    trust: bool = False
    """Run code of files: objects named as module:name, and code in the file of model:PATH."""

    def run(self) -> None:
        """Write the file, check it and print its description."""
        for line in export(self):
            print(line)

    def interrupted(self) -> str:
        """Return the message after an interrupt, which leaves no file."""
        return f"interrupted: no new file in {self.onnx}"


def export(command: Export) -> list[str]:
    """Write the file and return its description in lines; a wrong graph leaves no file."""
    kind, _, rest = spec(command.model).partition(":")
    env_id, options = _environment(command, kind, rest.partition(",")[0])
    require("onnx", "onnx", "onnx", "onnxruntime")
    # Imported here, because torch takes seconds to load.
    from fusion_gym.evaluation.onnx_export import export_onnx

    task = make_task(env_id, **options)
    agent = make_policy(f"{kind}:{rest}", task)
    try:
        with replacing(command.onnx) as unfinished:
            model = export_onnx(agent, task, unfinished, env_id, command.model)
    except ConfigurationError as error:
        raise ConfigurationError(f"model = {command.model!r} is not exported: {error}") from None
    text = ", ".join(f"{name} {_shape(shape)}" for name, shape in model.inputs.items())
    answers = ", ".join(f"{name} {_shape(shape)}" for name, shape in model.outputs.items())
    result = model.agreement
    return [
        f"{command.model} is in {command.onnx}: {model.size:,} bytes",
        f"from {text}",
        f"to {answers}",
        f"against the agent on {result.observations:,} observations of {result.episodes:,} "
        f"episodes of {env_id}: all decisions agree, numbers differ by at most "
        f"{result.difference:.2g}",
        f"one decision on one thread here: {1e6 * model.latency.median:.1f} µs in the median, 99 % "
        f"below {1e6 * model.latency.most:.1f} µs",
    ]


def spec(text: str) -> str:
    """Return the agent as a policy's text, with ``model:`` before a bare path."""
    kind, colon, _ = text.partition(":")
    if colon and kind in _KINDS:
        return text
    if text.partition(",")[0].endswith(".zip"):
        return f"model:{text}"
    raise refusal("model", text, "zoo:NAME, model:PATH or the path of a .zip")


def _environment(command: Export, kind: str, name: str) -> tuple[str, Options]:
    """Return id and options of the command line, or of the agent's training by default."""
    if command.env is None and command.config is None:
        if kind == "zoo":
            trained = zoo.card(name)["training"]["environment"]
            own = parse_settings("option", [word for words in command.options for word in words])
            return trained["id"], trained["options"] | own
        config_file = Path(name).parent / "config.yaml"
        if not config_file.is_file():
            where = f"with model = {command.model!r}, whose folder has no config.yaml"
            raise forbidden("env", None, "give --env ID or --config FILE", where)
        command = replace(command, config=str(config_file))
    return command.environment()


def _shape(shape: tuple[str | int, ...]) -> str:
    return f"({', '.join(map(str, shape))})"
