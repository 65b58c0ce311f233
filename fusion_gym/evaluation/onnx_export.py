"""Write a saved agent as an ONNX file, for sensors and schedulers without this library.

The file has the agent's graph and, as metadata, its observation with names, scale and version, and
its actions. Every value of the metadata is text; lists and tables are JSON, in which "inf" and
"-inf" are infinite numbers. The file is compared with the agent, and its latency is measured.
"""

import hashlib
import importlib
import json
import math
import timeit
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib import MaskablePPO, RecurrentPPO
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.dqn.policies import DQNPolicy
from stable_baselines3.td3.policies import TD3Policy

from fusion_gym import seeds
from fusion_gym.arrays import Array
from fusion_gym.core.action import Threshold, space_text
from fusion_gym.core.knowledge import MEANING, Block, Knowledge, Signals, numbered
from fusion_gym.core.observation import ObservationLayout
from fusion_gym.core.task import Task
from fusion_gym.declaration import plain_options
from fusion_gym.entries import Plain
from fusion_gym.envs.views import LARGEST_RATIO, SensorView, space_with_ratios
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.importing import require
from fusion_gym.policies.base import Policy, Requests
from fusion_gym.policies.saved import POLICIES, CalibratedPolicy, ModelPolicy, algorithm_name
from fusion_gym.validation import ConfigurationError, refusal
from fusion_gym.version import __version__

OPSET = 17  # of ONNX 1.12, 2022: sufficient for these networks, and known to older runtimes
Shapes = dict[str, tuple[str | int, ...]]  # by name; "batch" is the number of rows
_CLOSED = -1e8  # MaskablePPO's logit of a masked choice


class DecisionGraph(torch.nn.Module):
    """The graph from rows of an observation to requests.

    ``inputs`` and ``outputs`` are the names in their order, each with its shape. B is the number of
    rows: one per run, or with a local view one per sensor and run. k sensors decide in a row:

    - ``observation`` (B, entries) float32, clipped by the graph to the bounds of the layout;
      ``entries`` are the names, without the price if the agent has a fixed price, which is a
      constant of the graph. The log ratios of the agent's rule come last.
    - ``grantable`` (B, k) bool, the sensors that the network would grant; only for MaskablePPO.
    - ``hidden`` and ``cell`` (layers, B, size) float32, zero at the start of an episode; only for
      RecurrentPPO. Their next values are the outputs ``hidden_next`` and ``cell_next``.
    - ``request`` (B, k) int8, the decision: 1 requests to transmit.
    - ``probability`` (B, k) float32 of a request during learning, and the ``logits`` of the
      distribution. DQN has the ``values`` of the choices instead.
    - ``threshold`` (B, k) float32 in the place of all these, of an agent that sets thresholds: the
      sensor requests if its score, named in the metadata, reaches it; 0 always, infinity never.

    Args:
        agent: the agent.

    Raises:
        ConfigurationError: an agent that draws its actions, or whose policy is not supported.
    """

    def __init__(self, agent: ModelPolicy) -> None:
        super().__init__()
        policy: Any = agent.model.policy
        if not agent.deterministic:
            allowed = "True; the graph also returns the probability of every request"
            raise refusal("deterministic", False, allowed, "here")
        agent.refuse_frames()
        action = agent.view.action
        if not action.bits and isinstance(action.space, spaces.MultiDiscrete):
            allowed = "another kind, because the graph requests without channels"
            raise refusal("action", agent.task.options.action, allowed, "here")
        if not isinstance(policy, tuple(POLICIES.values())):
            raise ConfigurationError(
                f"policy {type(policy).__name__} is not allowed here: it must be a policy of "
                f"{', '.join(POLICIES)}"
            )
        self._policy: Any = agent.model.policy
        self._policy.eval()
        self._masked = isinstance(agent.model, MaskablePPO)
        self._recurrent = isinstance(agent.model, RecurrentPPO)
        # Each bit of an action has two outputs of the network, silence and a request.
        self._pairs = self._masked or isinstance(action.space, spaces.MultiDiscrete)
        self._values = isinstance(policy, DQNPolicy)
        self._thresholds = action if isinstance(action, Threshold) else None
        self._offset = agent.offset
        if self._recurrent and self._thresholds is not None:
            raise refusal("action", "threshold", "another kind with RecurrentPPO", "here")
        self._price = agent.price
        self._place = agent.view.names.index("price") if agent.price is not None else None
        space, own = space_with_ratios(agent.view, agent.rule is not None), len(agent.view.names)
        ratios = (f"log_ratio[{place}]" for place in range(space.shape[0] - own))
        self.names = *agent.view.names, *ratios
        stored = [place for place in range(len(self.names)) if place != self._place]
        self.entries = tuple(self.names[place] for place in stored)
        self.low: torch.Tensor
        self.high: torch.Tensor
        self.register_buffer("low", torch.as_tensor(space.low[stored]))
        self.register_buffer("high", torch.as_tensor(space.high[stored]))
        self.choices: np.ndarray[Any, Any] | None = None  # requests (choices, k) of each action
        if isinstance(action.space, spaces.Discrete):
            table = np.eye(2, 1, -1) if agent.view.local else action.table
            self.choices = table.astype(np.int8)
        self._table: torch.Tensor | None
        known = None if self.choices is None else torch.as_tensor(self.choices, dtype=torch.float32)
        self.register_buffer("_table", known)
        sensors = agent.task.sensors if agent.view.rows_per_run == 1 else 1
        self.inputs, self.outputs = self._named(sensors, policy)

    def _named(self, sensors: int, policy: Any) -> tuple[Shapes, Shapes]:
        """Return names and shapes of the inputs and outputs."""
        inputs: Shapes = {"observation": ("batch", len(self.entries))}
        if self._thresholds is not None:
            return inputs, {"threshold": ("batch", sensors)}
        outputs: Shapes = {"request": ("batch", sensors)}
        if self._masked:
            inputs["grantable"] = ("batch", sensors)
        if self._values:
            outputs["values"] = ("batch", policy.action_space.n)
        else:
            outputs["probability"] = ("batch", sensors)
            outputs["logits"] = ("batch", policy.action_net.out_features)
        if self._recurrent:
            memory = (policy.lstm_actor.num_layers, "batch", policy.lstm_actor.hidden_size)
            inputs |= {"hidden": memory, "cell": memory}
            outputs |= {"hidden_next": memory, "cell_next": memory}
        return inputs, outputs

    def forward(self, observation: torch.Tensor, *more: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return the outputs in their order, from the inputs in their order."""
        rows = torch.minimum(torch.maximum(observation, self.low), self.high)
        if self._price is not None:
            price = torch.full_like(rows[:, :1], self._price)
            rows = torch.cat((rows[:, : self._place], price, rows[:, self._place :]), dim=1)
        if self._values:
            values = self._policy.q_net(rows)
            return self._taken(values), values
        if self._thresholds is not None:
            return (self._threshold(rows, self._thresholds),)
        policy, memory = self._policy, ()
        features = BasePolicy.extract_features(policy, rows, policy.pi_features_extractor)
        if self._recurrent:
            latent, memory = policy.lstm_actor(features.unsqueeze(0), (more[0], more[1]))
            features = latent.squeeze(0)
        logits = policy.action_net(policy.mlp_extractor.forward_actor(features))
        probability = self._probability(logits, more[0] if self._masked else None)
        if self._table is None:
            marginal = probability
            request = (probability > 0.5).to(torch.int8)
        else:
            marginal = probability @ self._table
            request = self._taken(probability)
        return request, marginal, logits, *memory

    def _threshold(self, rows: torch.Tensor, action: Threshold) -> torch.Tensor:
        """Return the thresholds (B, k) in the unit of the score."""
        policy, (low, high) = self._policy, action.score.bounds
        if hasattr(policy, "actor"):
            actor = policy.actor
            features = actor.extract_features(rows, actor.features_extractor)
            own = actor.mu(features if isinstance(policy, TD3Policy) else actor.latent_pi(features))
            own = own if isinstance(policy, TD3Policy) else torch.tanh(own)
            own = low + 0.5 * (high - low) * (own + 1.0)
        else:
            features = BasePolicy.extract_features(policy, rows, policy.pi_features_extractor)
            own = policy.action_net(policy.mlp_extractor.forward_actor(features))
        own = torch.clamp(torch.clamp(own, low, high) + self._offset, low, high)
        always = torch.where(own <= low, torch.zeros_like(own), torch.exp(own))
        return torch.where(own >= high, torch.full_like(own, math.inf), always)

    def _probability(self, logits: torch.Tensor, open_: torch.Tensor | None) -> torch.Tensor:
        """Return the probability of each request (B, k), or with a table of each choice."""
        if self._table is not None:
            if open_ is not None:
                closed = (1.0 - open_.to(logits.dtype)) @ self._table.T > 0.0
                logits = torch.where(closed, torch.full_like(logits, _CLOSED), logits)
            return torch.softmax(logits, dim=1)
        if not self._pairs:
            return torch.sigmoid(logits)
        pairs = logits.reshape(-1, self._policy.action_net.out_features // 2, 2)
        if open_ is not None:
            both = torch.stack((torch.ones_like(open_), open_), dim=2)
            pairs = torch.where(both, pairs, torch.full_like(pairs, _CLOSED))
        return torch.softmax(pairs, dim=2)[..., 1]

    def _taken(self, worth: torch.Tensor) -> torch.Tensor:
        """Return the requests (B, k) of the best choice, the first among equals."""
        assert self._table is not None
        return self._table[worth.argmax(dim=1)].to(torch.int8)

    def example(self, rows: int) -> tuple[torch.Tensor, ...]:
        """Return inputs of so many rows, at the start of an episode."""
        result = []
        for name, shape in self.inputs.items():
            sizes = [rows if size == "batch" else int(size) for size in shape]
            kind = torch.bool if name == "grantable" else torch.float32
            result.append((torch.ones if name == "grantable" else torch.zeros)(sizes, dtype=kind))
        return tuple(result)


def save_graph(graph: DecisionGraph, path: Path, received: Mapping[str, str]) -> None:
    """Write the graph as an ONNX file, with ``received`` as its metadata."""
    onnx: Any = importlib.import_module("onnx")
    shapes = {**graph.inputs, **graph.outputs}
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of torch's older exporter, which needs no onnxscript
        torch.onnx.export(
            graph,
            graph.example(2),
            str(path),
            input_names=list(graph.inputs),
            output_names=list(graph.outputs),
            dynamic_axes={name: {shape.index("batch"): "batch"} for name, shape in shapes.items()},
            opset_version=OPSET,
            dynamo=False,
        )
    written = onnx.load(str(path))
    written.graph.name = "fusion_gym"
    onnx.helper.set_model_props(written, dict(received))
    onnx.checker.check_model(written)
    onnx.save(written, str(path))


FORMAT = "1"
_MEANINGS = {
    "observation": "rows of the environment's observation, which the graph clips to their bounds",
    "grantable": "sensors that the network would grant; the others do not request",
    "hidden": "memory; zero at the start of an episode, then hidden_next",
    "cell": "memory; zero at the start of an episode, then cell_next",
    "request": "the decision: 1 requests to transmit",
    "probability": "probability of a request if actions are drawn, as in training",
    "logits": "logits of the distribution of actions",
    "values": "learned value of each action",
    "threshold": "threshold of the score: a sensor requests if its score reaches it",
    "hidden_next": "memory for the next step",
    "cell_next": "memory for the next step",
}
_TYPES = {"grantable": "bool", "request": "int8"}


def onnx_card(
    agent: ModelPolicy, graph: DecisionGraph, environment: str, model: str
) -> dict[str, str]:
    """Return the metadata of an agent's graph; ``model`` is the user's name of the agent."""
    task, local = agent.task, isinstance(agent.view, SensorView)
    layout = ObservationLayout(task, "own" if local else "scheduler")
    names = list(graph.entries)
    visible = {name.partition("[")[0] for name in names}
    blocks = [_block(block, local) for block in layout.blocks if block.name in visible]
    if local and task.options.own_number:
        number = Block("sensor", "number of the sensor", np.array, (numbered(task.sensors),))
        blocks.append(_block(number, local))
    if agent.rule is not None:
        meaning = f"logarithm of score over threshold of {agent.rule_text}"
        labels = (numbered(len(graph.names) - len(agent.view.names)),)
        ratio = Block("log_ratio", meaning, np.array, labels, limit=LARGEST_RATIO)
        blocks.append(_block(ratio, local))
    price = task.reward.price.span
    low, high = price or (1.0, 1.0)
    digest = hashlib.sha256("\n".join(names).encode()).hexdigest()
    values = {
        "inputs": _ports(graph.inputs),
        "outputs": _ports(graph.outputs),
        "observation_names": names,
        "observation_low": graph.low.tolist(),
        "observation_high": graph.high.tolist(),
        "observation_blocks": blocks,
        "action": {
            "space": space_text(agent.view.action.space),
            "sensors": task.sensors,
            "access": task.options.access,
            "choices": None if graph.choices is None else graph.choices.tolist(),
            "score": _score(agent),
        },
        "options": task.settings,
        "price_range": price if agent.price is None else None,
        "fixed_price": None if agent.price is None else low * (high / low) ** agent.price,
    }
    words = {
        "format": FORMAT,
        "fusion_gym_version": __version__,
        "model": model,
        "algorithm": algorithm_name(agent.model),
        "environment": environment,
        "decides": "each sensor locally" if local else "a scheduler of all sensors",
        "knows": MEANING[agent.knowledge],
        "observation_version": f"{environment}:{digest[:16]}",  # hash of names and order
    }
    return words | {key: json.dumps(_finite(plain_options(value))) for key, value in values.items()}


def _score(agent: ModelPolicy) -> Plain | None:
    """Return the score of thresholds with its meaning and its unit's factor; ``None`` of others."""
    action = agent.view.action
    if not isinstance(action, Threshold):
        return None
    name, meaning = agent.task.options.score, action.score.meaning
    return {"name": name, "meaning": meaning, "error_weight": action.scale}


def _ports(shapes: Shapes) -> Plain:
    rows = ((n, list(shape), _TYPES.get(n, "float32")) for n, shape in shapes.items())
    return {n: {"shape": shape, "type": kind, "meaning": _MEANINGS[n]} for n, shape, kind in rows}


def _block(block: Block, local: bool) -> Plain:
    """Return a block of entries with the ``labels`` of its axes and its bounds."""
    return {
        "name": block.name,
        "meaning": block.meaning,
        "labels": [list(axis) for axis in block.labels],
        "own_row": local and block.node == "own",
        "bounds": list(block.bounds),
        "constants": {key: np.asarray(value).tolist() for key, value in block.constants.items()},
    }


def _finite(value: Any) -> Any:
    """Return the value with infinite numbers and nan as words."""
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_finite(entry) for entry in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


OBSERVATIONS = 10_000
TOLERANCE = 1e-4  # of numbers, relative to 1 + their size; float32 leaves about 1e-6
_CALLS, _WARM = 5000, 200  # measured calls, and calls before them

Values = dict[str, NDArray[Any]]


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


def latency(graph: DecisionGraph, path: Path) -> Latency:
    """Measure the time of one decision of the file at ``path``, over many calls in sequence."""
    run = session(path)
    arguments = {
        name: value.numpy() for name, value in zip(graph.inputs, graph.example(1), strict=True)
    }
    every = timeit.repeat(lambda: run.run(None, arguments), number=1, repeat=_WARM + _CALLS)
    seconds = every[_WARM:]
    return Latency(float(np.median(seconds)), float(np.quantile(seconds, 0.99)))


class Agreement:
    """The agent as a policy that compares an ONNX file with the agent on every observation.

    Decisions are compared with the decisions of Stable-Baselines3, all other outputs with ``graph``
    in torch.

    Args:
        agent: the agent.
        graph: the graph of the file.
        path: the ONNX file.

    Attributes:
        observations: number of compared observations.
        episodes: number of their episodes.
        different: number of observations with another decision.
        difference: greatest difference of the other outputs.
        relative: greatest difference over 1 + the size of the output.
        rates: transmissions per step of each sensor (sensors,), means over the episodes.
    """

    rates: Array

    def __init__(self, agent: ModelPolicy, graph: DecisionGraph, path: Path) -> None:
        self.knowledge: Knowledge = agent.knowledge
        self.memory_owner = agent.memory_owner
        self._agent, self._graph, self._session = agent, graph, session(path)
        self._columns = [graph.names.index(name) for name in graph.entries]
        self.observations, self.episodes, self.different = 0, 0, 0
        self.difference, self.relative = 0.0, 0.0

    @property
    def holds(self) -> bool:
        """Whether all decisions agree, and all other outputs up to ``TOLERANCE``."""
        return self.different == 0 and self.relative <= TOLERANCE

    def reset(self, runs: int, seed: int = 0) -> None:
        """Clear the memory."""
        self.episodes += runs
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
        self.observations += len(request["observation"])
        decided = requests != self._decided(result, signals)
        self.different += int(decided.T.reshape(len(request["observation"]), -1).any(1).sum())
        for name in self._graph.outputs:
            if name != "request":
                result[name], required[name] = (
                    np.nan_to_num(item[name], posinf=1e9) for item in (result, required)
                )
                apart = np.abs(result[name].astype(np.float64) - required[name])
                apart[np.isnan(apart)] = np.inf
                self.difference = max(self.difference, float(apart.max()))
                relative = apart / (1.0 + np.abs(required[name]))
                self.relative = max(self.relative, float(relative.max()))
        return requests

    def _decided(self, result: Values, signals: Signals) -> Requests:
        """Return the requests (sensors, N) of the file's outputs."""
        action = self._agent.view.action
        if isinstance(action, Threshold):
            with np.errstate(divide="ignore"):
                bounded = np.clip(np.log(result["threshold"]), *action.score.bounds)
            return action.requests(bounded, len(bounded), lambda: signals)
        requests: Requests = result["request"].reshape(len(signals["start"]), -1).T == 1
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


def onnx_agreement(
    agent: ModelPolicy,
    graph: DecisionGraph,
    path: Path,
    task: Task,
    observations: int = OBSERVATIONS,
) -> Agreement:
    """Compare the ONNX file at ``path`` with its agent in whole episodes.

    Args:
        agent: the agent.
        graph: the graph of the file.
        path: the ONNX file.
        task: the task of the episodes.
        observations: least number of observations, one row each.
    """
    result = Agreement(agent, graph, path)
    episodes = math.ceil(observations / (task.horizon * agent.view.rows_per_run))
    rate = run_episodes(task, result, episodes, seeds.EXPORT.start).rate
    result.rates = np.nanmean(rate, axis=0)
    return result


def warn_of_silent_sensors(rates: Array) -> None:
    """Warn of sensors that never transmit; ``rates`` are the sensors' transmissions per step."""
    silent = np.flatnonzero(rates == 0.0).tolist()
    if silent:
        sensors = "no sensor" if len(silent) == len(rates) else f"of the sensors {silent} none"
        warnings.warn(
            f"{sensors} ever transmits under the exported agent: train it at a lower price of a "
            "token (cost_weight), or calibrate it by fusion-gym calibrate",
            stacklevel=2,
        )


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

    The graph is :class:`DecisionGraph`; the metadata are :func:`onnx_card`. A file that decides
    otherwise than the agent is removed. A sensor that never transmits is warned of.

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
    warn_of_silent_sensors(result.rates)
    taken = latency(graph, path)
    return Exported(path.stat().st_size, graph.inputs, graph.outputs, result, taken)
