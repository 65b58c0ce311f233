"""Write an agent as an ONNX file, compare the file with the agent, and measure its latency."""

import importlib
import math
import timeit
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from fusion_gym import seeds
from fusion_gym.core.knowledge import Knowledge, Signals
from fusion_gym.core.task import Task
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.importing import require
from fusion_gym.policies.base import Policy, Requests
from fusion_gym.policies.calibrated import CalibratedPolicy
from fusion_gym.policies.model import ModelPolicy
from fusion_gym.policies.onnx_card import onnx_card
from fusion_gym.policies.onnx_graph import DecisionGraph, Shapes, save_graph
from fusion_gym.validation import ConfigurationError, refusal

OBSERVATIONS = 10_000
TOLERANCE = 1e-4  # of numbers, relative to 1 + their size; float32 leaves about 1e-6
_CALLS, _WARM = 5000, 200  # measured calls, and calls before them

Values = dict[str, NDArray[Any]]


class Agreement(NamedTuple):
    """The agreement of an ONNX graph with its agent.

    Args:
        observations: number of compared observations.
        episodes: number of their episodes.
        different: number of observations with another decision.
        difference: greatest difference of the other outputs.
        relative: greatest difference over 1 + the size of the output.
    """

    observations: int
    episodes: int
    different: int
    difference: float
    relative: float

    @property
    def holds(self) -> bool:
        """Whether all decisions agree, and all other outputs up to ``TOLERANCE``."""
        return self.different == 0 and self.relative <= TOLERANCE


class Latency(NamedTuple):
    """Seconds of one call with one row on one thread: ``median``, and ``most``, the 99 % point."""

    median: float
    most: float


def session(path: Path) -> Any:
    """Return an onnxruntime session on one thread of the processor."""
    onnxruntime: Any = importlib.import_module("onnxruntime")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def onnx_agreement(
    agent: ModelPolicy,
    graph: DecisionGraph,
    path: Path,
    task: Task,
    observations: int = OBSERVATIONS,
    seed: int = seeds.EXPORT.start,
) -> Agreement:
    """Compare the ONNX file at ``path`` with its agent in whole episodes.

    Decisions are compared with the decisions of Stable-Baselines3, all other outputs with ``graph``
    in torch.

    Args:
        agent: the agent.
        graph: the graph of the file.
        path: the ONNX file.
        task: the task of the episodes.
        observations: least number of observations, one row each.
        seed: seed of the first episode.
    """
    rows = task.horizon * agent.view.rows_per_run
    episodes = math.ceil(observations / rows)
    comparison = _FileComparison(agent, graph, session(path))
    run_episodes(task, comparison, episodes, seed)
    return Agreement(
        rows * episodes, episodes, comparison.different, comparison.difference, comparison.relative
    )


def latency(graph: DecisionGraph, path: Path) -> Latency:
    """Measure the time of one decision of the file at ``path``, over many calls in sequence."""
    run = session(path)
    arguments = {
        name: value.numpy() for name, value in zip(graph.inputs, graph.example(1), strict=True)
    }
    every = timeit.repeat(lambda: run.run(None, arguments), number=1, repeat=_WARM + _CALLS)
    seconds = every[_WARM:]
    return Latency(float(np.median(seconds)), float(np.quantile(seconds, 0.99)))


class _FileComparison:
    """The agent as a policy that also runs the ONNX session on every observation."""

    def __init__(self, agent: ModelPolicy, graph: DecisionGraph, run: Any) -> None:
        self.knowledge: Knowledge = agent.knowledge
        self.memory_owner = agent.memory_owner
        self._agent, self._graph, self._session = agent, graph, run
        self._columns = [agent.view.names.index(name) for name in graph.entries]
        self.different, self.difference, self.relative = 0, 0.0, 0.0

    def reset(self, runs: int, seed: int = 0) -> None:
        """Clear the memory."""
        self._agent.reset(runs, seed)
        start = self._graph.example(runs * self._agent.view.rows_per_run)
        values = dict(zip(self._graph.inputs, (item.numpy() for item in start), strict=True))
        memory: Values = {name: values[name] for name in ("hidden", "cell") if name in values}
        self._memories = [memory, memory]

    def __call__(self, signals: Signals) -> Requests:
        """Return the agent's requests (sensors, N)."""
        request: Values = {"observation": self._agent.rows(signals)[:, self._columns]}
        if "grantable" in self._graph.inputs:
            request["grantable"] = signals["grantable"].T.reshape(len(request["observation"]), -1)
        ours, theirs = self._memories
        written = self._session.run(None, request | ours)
        result = dict(zip(self._graph.outputs, written, strict=True))
        required = self._run_torch(request | theirs)
        self._memories = [_following(result), _following(required)]
        requests = self._agent(signals)
        decided = requests != result["request"].reshape(requests.shape[1], -1).T
        self.different += int(decided.T.reshape(len(request["observation"]), -1).any(1).sum())
        for name in self._graph.outputs:
            if name != "request":
                apart = np.abs(result[name].astype(np.float64) - required[name])
                apart[np.isnan(apart)] = np.inf
                self.difference = max(self.difference, float(apart.max()))
                relative = apart / (1.0 + np.abs(required[name]))
                self.relative = max(self.relative, float(relative.max()))
        return requests

    def _run_torch(self, value: Values) -> Values:
        inputs = [torch.as_tensor(np.ascontiguousarray(value[name])) for name in self._graph.inputs]
        with torch.no_grad():
            result = self._graph(*inputs)
        return {name: item.numpy() for name, item in zip(self._graph.outputs, result, strict=True)}


def _following(outputs: Values) -> Values:
    """Return the memory for the next step."""
    return {
        name.removesuffix("_next"): value
        for name, value in outputs.items()
        if name.endswith("_next")
    }


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
