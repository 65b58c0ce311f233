"""Write, check and time an agent as an ONNX file."""

from pathlib import Path
from typing import NamedTuple

from fusion_gym.core.task import Task
from fusion_gym.evaluation.onnx_check import Agreement, Latency, latency, onnx_agreement
from fusion_gym.importing import require
from fusion_gym.policies.base import Policy
from fusion_gym.policies.calibrated import CalibratedPolicy
from fusion_gym.policies.model import ModelPolicy
from fusion_gym.policies.onnx_card import onnx_card
from fusion_gym.policies.onnx_graph import DecisionGraph, Shapes, save_graph
from fusion_gym.validation import ConfigurationError, refusal


class Exported(NamedTuple):
    """A written ONNX file.

    Args:
        size: bytes.
        inputs: shapes of the inputs by name.
        outputs: shapes of the outputs by name.
        agreement: comparison with the agent.
        latency: time of a decision.
    """

    size: int
    inputs: Shapes
    outputs: Shapes
    agreement: Agreement
    latency: Latency


def export_onnx(
    agent: Policy, task: Task, path: str | Path, environment: str, model: str = ""
) -> Exported:
    """Write an agent as an ONNX file, and check it.

    The graph is :class:`~fusion_gym.policies.onnx_graph.DecisionGraph`; the metadata are
    :func:`~fusion_gym.policies.onnx_card.onnx_card`. A file that decides otherwise than the agent
    is removed.

    Args:
        agent: a saved agent that ``make_policy`` made for this task.
        task: the task.
        path: the file to write.
        environment: id of the environment of the task, for the metadata.
        model: name of the agent, for the metadata.

    Raises:
        ConfigurationError: no saved agent, a policy that cannot be written or that draws its
            actions, missing packages, or decisions that differ in at least 10,000 observations.
        OSError: the file cannot be written.
    """
    require("onnx", "onnx", "onnx", "onnxruntime")
    if isinstance(agent, CalibratedPolicy):
        agent = agent.single_agent()
    if not isinstance(agent, ModelPolicy):
        raise refusal("agent", agent, "a saved agent, zoo:NAME or model:PATH")
    if agent.normalization is not None:
        raise refusal("normalize", agent.normalization, "None: the file takes no statistics")
    path, graph = Path(path), DecisionGraph(agent)
    save_graph(graph, path, onnx_card(agent, graph, environment, model))
    result = onnx_agreement(agent, graph, path, task)
    if not result.holds:
        path.unlink()
        raise ConfigurationError(
            f"file and agent decide differently on {result.different:,} of "
            f"{result.observations:,} observations, and numbers differ by up to "
            f"{result.difference:.3g}"
        )
    taken = latency(graph, path)
    return Exported(path.stat().st_size, graph.inputs, graph.outputs, result, taken)
