"""The metadata of an ONNX file: its observation with names, scale and version, and its actions.

Every value is text; lists and tables are JSON, in which "inf" and "-inf" are infinite numbers.
"""

import hashlib
import json
import math
from typing import Any

import numpy as np

from fusion_gym.core.action import space_text
from fusion_gym.core.knowledge import MEANING, Block, numbered
from fusion_gym.core.observation import ObservationLayout
from fusion_gym.declaration import plain_options
from fusion_gym.entries import Plain
from fusion_gym.envs.views import SensorView
from fusion_gym.policies.card import algorithm_name
from fusion_gym.policies.model import ModelPolicy
from fusion_gym.policies.onnx_graph import DecisionGraph, Shapes
from fusion_gym.version import __version__

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
    price = task.reward.price.span
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
        },
        "options": task.settings,
        "price_range": price if agent.price is None else None,
        "fixed_price": _fixed_price(agent),
    }
    words = {
        "format": FORMAT,
        "fusion_gym_version": __version__,
        "model": model,
        "algorithm": algorithm_name(agent.model),
        "environment": environment,
        "decides": "each sensor locally" if local else "a scheduler of all sensors",
        "knows": MEANING[agent.knowledge],
        "observation_version": layout_version(environment, names),
    }
    return words | {key: json.dumps(_finite(plain_options(value))) for key, value in values.items()}


def layout_version(environment: str, names: list[str]) -> str:
    """Return the id of the environment and a hash of the entries' names and order."""
    digest = hashlib.sha256("\n".join(names).encode()).hexdigest()
    return f"{environment}:{digest[:16]}"


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


def _fixed_price(agent: ModelPolicy) -> float | None:
    """Return the fixed price of a token of the agent, if it has one."""
    span = agent.task.reward.price.span
    if agent.price is None or span is None:
        return None
    low, high = span
    return float(low * (high / low) ** agent.price)


def _finite(value: Any) -> Any:
    """Return the value with infinite numbers and nan as words."""
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_finite(entry) for entry in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
