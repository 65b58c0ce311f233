"""An agent as an ONNX file, written, checked and timed."""

from pathlib import Path
from typing import NamedTuple

from fusion_gym.core.task import Task
from fusion_gym.evaluation.onnx_check import Agreement, Latency, latency, onnx_agreement
from fusion_gym.importing import require
from fusion_gym.policies.base import Policy
from fusion_gym.policies.model import ModelPolicy
from fusion_gym.policies.onnx_card import onnx_card
from fusion_gym.policies.onnx_graph import DecisionGraph, Shapes, save_graph
from fusion_gym.validation import ConfigurationError, refusal


class Exported(NamedTuple):
    """What was written: ``size`` in bytes, names and shapes of what goes in and comes out, how it
    agrees with the agent, and what a decision takes."""

    size: int
    inputs: Shapes
    outputs: Shapes
    agreement: Agreement
    latency: Latency


def export_onnx(
    agent: Policy, task: Task, path: str | Path, environment: str, model: str = ""
) -> Exported:
    """Write an agent that ``make_policy`` made for this task as an ONNX file, and check it.

    ``environment`` is the id that the task was made of, ``model`` how the agent is called; both
    stand in the file. Its graph is :class:`~fusion_gym.policies.onnx_graph.DecisionGraph`, its
    metadata :func:`~fusion_gym.policies.onnx_card.onnx_card`.

    Raises:
        ConfigurationError: no saved agent, one whose policy cannot be written or that decides by
            chance, ONNX is not installed, or a file that decides otherwise than the agent on some
            of at least 10,000 observations, which is removed.
        OSError: the file cannot be written.
    """
    require("onnx", "onnx", "onnx", "onnxruntime")
    if not isinstance(agent, ModelPolicy):
        raise refusal("agent", agent, "a saved agent, zoo:NAME or model:PATH")
    path, graph = Path(path), DecisionGraph(agent)
    save_graph(graph, path, onnx_card(agent, graph, environment, model))
    result = onnx_agreement(agent, graph, path, task)
    if not result.holds:
        path.unlink()
        raise ConfigurationError(
            f"{result.different:,} of {result.observations:,} observations are decided otherwise "
            f"than by the agent, and numbers differ by up to {result.difference:.3g}"
        )
    taken = latency(graph, path)
    return Exported(path.stat().st_size, graph.inputs, graph.outputs, result, taken)
