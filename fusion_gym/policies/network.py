"""The networks of a policy, inferred from the shapes of its weights."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from fusion_gym.entries import Arguments, Plain
from fusion_gym.policies.archive import NeedsTrust

Shapes = Mapping[str, tuple[int, ...]]
_HEADS = {"pi": "mlp_extractor.policy_net", "vf": "mlp_extractor.value_net"}
_VALUES = "q_net.q_net"


@dataclass(frozen=True)
class _Memory:
    """The LSTM of a recurrent policy; its critic has its own LSTM, the actor's, or none."""

    size: int
    layers: int
    critic: Literal["own", "shared", "none"]


@dataclass(frozen=True)
class NetworkShape:
    """Sizes of the hidden layers: of policy and value ("pi", "vf"), or of the values ("q")."""

    hidden: Mapping[str, tuple[int, ...]]
    entries: int  # of an observation
    memory: _Memory | None = None

    @classmethod
    def of_weights(cls, weights: Mapping[str, Any]) -> NetworkShape:
        """Return the networks that have these weights, after a check of all sizes."""
        shapes = {name: tuple(weight.shape) for name, weight in weights.items()}
        if f"{_VALUES}.0.weight" in shapes:
            *hidden, last = _chain(shapes, _VALUES)
            entries = (hidden or [last])[0][1]
            return cls({"q": tuple(outputs for outputs, _ in hidden)}, entries)
        chains = {head: _chain(shapes, prefix) for head, prefix in _HEADS.items()}
        memory = None
        if "lstm_actor.weight_ih_l0" in shapes:
            memory, entries = _memory(shapes)
        else:
            entries = (chains["pi"] or [_pair(shapes, "action_net.weight")])[0][1]
        into = memory.size if memory else entries
        if any(chain and chain[0][1] != into for chain in chains.values()):
            raise NeedsTrust("the shapes of its weights disagree")
        hidden_sizes = {head: tuple(o for o, _ in chain) for head, chain in chains.items()}
        return cls(hidden_sizes, entries, memory)

    def fits(self, algorithm: str) -> bool:
        """Return whether policies of this algorithm have such networks."""
        values, has_memory = "q" in self.hidden, self.memory is not None
        return (values, has_memory) == (algorithm == "dqn", algorithm == "recurrent_ppo")

    def plain(self) -> Plain:
        """Return the sizes as JSON."""
        entries: Plain = {head: list(sizes) for head, sizes in self.hidden.items()}
        return entries | ({"memory": vars(self.memory).copy()} if self.memory else {})

    def arguments(self) -> Arguments:
        """Return the arguments of Stable-Baselines3's policy class."""
        if "q" in self.hidden:
            return {"net_arch": list(self.hidden["q"])}
        sizes = {head: list(sizes) for head, sizes in self.hidden.items()}
        result: Arguments = {"net_arch": sizes, "ortho_init": False}
        if self.memory:
            result |= {
                "lstm_hidden_size": self.memory.size,
                "n_lstm_layers": self.memory.layers,
                "shared_lstm": self.memory.critic == "shared",
                "enable_critic_lstm": self.memory.critic == "own",
            }
        return result


def _memory(shapes: Shapes) -> tuple[_Memory, int]:
    """Return the LSTM and the number of its inputs."""
    size = _pair(shapes, "lstm_actor.weight_hh_l0")[1]
    layers = 0
    while f"lstm_actor.weight_ih_l{layers}" in shapes:
        layers += 1
    entries = _pair(shapes, "lstm_actor.weight_ih_l0")[1]
    for layer in range(layers):
        required = {"ih": (4 * size, size if layer else entries), "hh": (4 * size, size)}
        if any(_pair(shapes, f"lstm_actor.weight_{k}_l{layer}") != w for k, w in required.items()):
            raise NeedsTrust("the shapes of its weights disagree")
    critic: Literal["own", "shared", "none"] = "shared"
    if "lstm_critic.weight_ih_l0" in shapes:
        critic = "own"
    elif "critic.weight" in shapes:
        critic = "none"
    return _Memory(size, layers, critic), entries


def _chain(shapes: Shapes, prefix: str) -> list[tuple[int, int]]:
    """Return (outputs, inputs) of the linear layers, which activations separate."""
    result: list[tuple[int, int]] = []
    while f"{prefix}.{2 * len(result)}.weight" in shapes:
        result.append(_pair(shapes, f"{prefix}.{2 * len(result)}.weight"))
        if len(result) > 1 and result[-1][1] != result[-2][0]:
            raise NeedsTrust("the shapes of its weights disagree")
    return result


def _pair(shapes: Shapes, name: str) -> tuple[int, int]:
    shape = shapes.get(name, ())
    if len(shape) != 2 or not all(shape):
        raise NeedsTrust(f"its weights {name!r} are missing or not a matrix")
    return shape[0], shape[1]
