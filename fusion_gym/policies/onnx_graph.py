"""A saved agent as an ONNX graph, for sensors and schedulers without this library."""

import importlib
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from sb3_contrib import MaskablePPO, RecurrentPPO
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.dqn.policies import DQNPolicy

from fusion_gym.policies.card import POLICIES
from fusion_gym.policies.model import ModelPolicy
from fusion_gym.validation import ConfigurationError, refusal

OPSET = 17  # of ONNX 1.12, 2022: sufficient for these networks, and known to older runtimes
Shapes = dict[str, tuple[str | int, ...]]  # by name; "batch" is the number of rows
_CLOSED = -1e8  # MaskablePPO's logit of a masked choice


class DecisionGraph(torch.nn.Module):
    """The graph from rows of an observation to requests.

    ``inputs`` and ``outputs`` are the names in their order, each with its shape. B is the number of
    rows: one per run, or with a local view one per sensor and run. k sensors decide in a row:

    - ``observation`` (B, entries) float32, clipped by the graph to the bounds of the layout;
      ``entries`` are the names, without the price if the agent has a fixed price, which is a
      constant of the graph.
    - ``grantable`` (B, k) bool, the sensors that the network would grant; only for MaskablePPO.
    - ``hidden`` and ``cell`` (layers, B, size) float32, zero at the start of an episode; only for
      RecurrentPPO. Their next values are the outputs ``hidden_next`` and ``cell_next``.
    - ``request`` (B, k) int8, the decision: 1 requests to transmit.
    - ``probability`` (B, k) float32 of a request during learning, and the ``logits`` of the
      distribution. DQN has the ``values`` of the choices instead.

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
        action = agent.view.action
        if not action.bits and not isinstance(action.space, spaces.Discrete):
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
        self._pairs = agent.pairs
        self._values = isinstance(policy, DQNPolicy)
        self._price = agent.price
        self._place = agent.view.names.index("price") if agent.price is not None else None
        stored = [place for place in range(len(agent.view.names)) if place != self._place]
        self.entries = tuple(agent.view.names[place] for place in stored)
        self.low: torch.Tensor
        self.high: torch.Tensor
        self.register_buffer("low", torch.as_tensor(agent.view.space.low[stored]))
        self.register_buffer("high", torch.as_tensor(agent.view.space.high[stored]))
        self.choices = _choices(agent)
        self._table: torch.Tensor | None
        table = None if self.choices is None else torch.as_tensor(self.choices, dtype=torch.float32)
        self.register_buffer("_table", table)
        sensors = agent.task.sensors if agent.view.rows_per_run == 1 else 1
        self.inputs, self.outputs = self._named(sensors, policy)

    def _named(self, sensors: int, policy: Any) -> tuple[Shapes, Shapes]:
        """Return names and shapes of the inputs and outputs."""
        inputs: Shapes = {"observation": ("batch", len(self.entries))}
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
        logits, memory = self._logits(rows, more)
        probability = self._probability(logits, more[0] if self._masked else None)
        if self._table is None:
            marginal = probability
            request = (probability > 0.5).to(torch.int8)
        else:
            marginal = probability @ self._table
            request = self._taken(probability)
        return request, marginal, logits, *memory

    def _logits(
        self, rows: torch.Tensor, more: tuple[torch.Tensor, ...]
    ) -> tuple[torch.Tensor, tuple[torch.Tensor, ...]]:
        policy: Any = self._policy
        memory: tuple[torch.Tensor, ...] = ()
        extractor = policy.pi_features_extractor
        features: torch.Tensor = BasePolicy.extract_features(policy, rows, extractor)
        if self._recurrent:
            latent, memory = policy.lstm_actor(features.unsqueeze(0), (more[0], more[1]))
            features = latent.squeeze(0)
        return policy.action_net(policy.mlp_extractor.forward_actor(features)), memory

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


def _choices(agent: ModelPolicy) -> np.ndarray[Any, Any] | None:
    """Return the requests (choices, k) int8 of each discrete action; None for bits."""
    action = agent.view.action
    if not isinstance(action.space, spaces.Discrete):
        return None
    return (np.eye(2, 1, -1) if agent.view.local else action.table).astype(np.int8)


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
