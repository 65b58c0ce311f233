r"""Export a saved agent as an ONNX file, for sensors and schedulers without this library.

    fusion-gym export --onnx scheduler.onnx \
        zoo:tobit_oscillator_scheduler,price=0.2,calibrated=false

The file contains the graph from the observation to the request, and a description of the
observation. The command compares it with the agent on 10,000 observations of whole episodes, and
removes it if they differ. It prints the transmission rate in these episodes, and warns of sensors
that never transmit. ``calibrated=false`` exports the agent alone, because a file has no rule.
"""

from collections.abc import Mapping
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
        """Write the file, check it and print its description; a wrong graph leaves no file."""
        kind, _, rest = spec(self.model).partition(":")
        env_id, options = self._trained(kind, rest.partition(",")[0])
        require("onnx", "onnx", "onnx", "onnxruntime")
        # Imported here, because torch takes seconds to load.
        from fusion_gym.evaluation.onnx_export import export_onnx

        task = make_task(env_id, **options)
        agent = make_policy(f"{kind}:{rest}", task)
        try:
            with replacing(self.onnx) as unfinished:
                model = export_onnx(agent, task, unfinished, env_id, self.model)
        except ConfigurationError as error:
            raise ConfigurationError(f"model = {self.model!r} is not exported: {error}") from None
        result = model.agreement
        print(
            f"{self.model} is in {self.onnx}: {model.size:,} bytes\n"
            f"from {_ports(model.inputs)}\nto {_ports(model.outputs)}\n"
            f"against the agent on {result.observations:,} observations of {result.episodes:,} "
            f"episodes of {env_id}: all decisions agree, numbers differ by at most "
            f"{result.difference:.2g}\n"
            f"transmissions per sensor and step there: {result.rates.mean():.3g} "
            f"(sensors: {', '.join(f'{rate:.3g}' for rate in result.rates)})\n"
            f"one decision on one thread here: {1e6 * model.latency.median:.1f} µs in the median, "
            f"99 % below {1e6 * model.latency.most:.1f} µs"
        )

    def interrupted(self) -> str:
        """Return the message after an interrupt, which leaves no file."""
        return f"interrupted: no new file in {self.onnx}"

    def _trained(self, kind: str, name: str) -> tuple[str, Options]:
        """Return id and options of the command line, or of the agent's training by default."""
        if self.env is not None or self.config is not None:
            return self.environment()
        if kind == "zoo":
            trained = zoo.card(name)["training"]["environment"]
            own = parse_settings("option", [word for words in self.options for word in words])
            return trained["id"], trained["options"] | own
        file = Path(name).parent / "config.yaml"
        if not file.is_file():
            where = f"with model = {self.model!r}, whose folder has no config.yaml"
            raise forbidden("env", None, "give --env ID or --config FILE", where)
        return replace(self, config=str(file)).environment()


def spec(text: str) -> str:
    """Return the agent as a policy's text, with ``model:`` before a bare path."""
    kind, colon, _ = text.partition(":")
    if colon and kind in _KINDS:
        return text
    if text.partition(",")[0].endswith(".zip"):
        return f"model:{text}"
    raise refusal("model", text, "zoo:NAME, model:PATH or the path of a .zip")


def _ports(shapes: Mapping[str, tuple[str | int, ...]]) -> str:
    return ", ".join(f"{name} ({', '.join(map(str, shape))})" for name, shape in shapes.items())
