"""The card of a saved agent: its description in plain JSON.

The card is the entry ``fusion_gym_model`` of the archive's ``data``, so Stable-Baselines3 saves and
loads it with the model. For a model without a card, or with an earlier and shorter card, the
readable entries of Stable-Baselines3 replace it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import sb3_contrib
import stable_baselines3
import torch
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.dqn.policies import DQNPolicy

from fusion_gym import validation
from fusion_gym.core.action import space_text
from fusion_gym.core.reward import Price
from fusion_gym.core.task import Task
from fusion_gym.entries import Plain
from fusion_gym.envs.views import make_view
from fusion_gym.policies.archive import NeedsTrust
from fusion_gym.policies.network import NetworkShape
from fusion_gym.validation import ConfigurationError, display

ENTRY = "fusion_gym_model"
FORMAT = 1
# Every algorithm of both libraries by its name in configs and saved models: MaskablePPO is
# "maskable_ppo".
ALGORITHMS: dict[str, type[BaseAlgorithm]] = {
    re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower(): kind
    for library in (stable_baselines3, sb3_contrib)
    for name, kind in vars(library).items()
    if isinstance(kind, type) and issubclass(kind, BaseAlgorithm)
}
# The policies that are rebuilt from their weights, by algorithm.
POLICIES: dict[str, type[BasePolicy]] = {
    name: policy
    for name, kind in ALGORITHMS.items()
    for policy in kind.policy_aliases.values()
    if policy
    in (ActorCriticPolicy, DQNPolicy, MaskableActorCriticPolicy, RecurrentActorCriticPolicy)
}
ACTIVATIONS: dict[str, type[torch.nn.Module]] = {
    "elu": torch.nn.ELU,
    "gelu": torch.nn.GELU,
    "leaky_relu": torch.nn.LeakyReLU,
    "relu": torch.nn.ReLU,
    "silu": torch.nn.SiLU,
    "tanh": torch.nn.Tanh,
}
# The allowed policy_kwargs: an activation, entries that the weights' shapes imply, and entries
# without influence on a decision. A features_extractor_class, for example, is code.
_HARMLESS = {
    "activation_fn", "enable_critic_lstm", "log_std_init", "lstm_hidden_size", "n_lstm_layers",
    "net_arch", "normalize_images", "optimizer_class", "optimizer_kwargs", "ortho_init",
    "share_features_extractor", "shared_lstm",
}  # fmt: skip


@dataclass(frozen=True)
class ModelView:
    """The observation that a model was trained on.

    Args:
        observation_names: names of the entries; None if the file has none.
        local: whether every sensor runs the model on its local view.
        price_range: range of the price of a token; None for a fixed price.
        nominal_error: scale of the entries of beliefs (n,); None for none.
    """

    observation_names: tuple[str, ...] | None = None
    local: bool = False
    price_range: tuple[float, float] | None = None
    nominal_error: tuple[float, ...] | None = None

    @classmethod
    def read(cls, data: Mapping[str, Any]) -> ModelView:
        """Return the view of an archive's card; without a card, the whole view of a scheduler."""
        card_entry = _entry(data)
        names, span = card_entry.get("observation_names"), card_entry.get("price_range")
        error = card_entry.get("nominal_error")
        listed = isinstance(names, list) and all(isinstance(name, str) for name in names)
        if names is not None and not listed:
            raise ConfigurationError("observation_names is not allowed: it must be a list of words")
        return cls(
            None if names is None else tuple(names),
            validation.boolean("local", card_entry.get("local", False)),
            None if span is None else Price.create("random", span).span,
            None if error is None else _errors(error),
        )

    def on(self, task: Task) -> Task:
        """Return the task with the price and the scale of the model's training."""
        span = task.reward.price.span
        if None not in (self.price_range, span) and self.price_range != span:
            allowed = f"{display(self.price_range)}, which the agent observes, or left out"
            raise validation.refusal("price_range", span, allowed)
        if self.price_range is not None and span is None:
            task = task.with_options(cost_weight="random", price_range=self.price_range)
        error, own = self.nominal_error, task.nominal_error
        if own is None or not task.belief_features or self.observation_names is None:
            return task
        if error is None or len(error) != len(own):
            allowed = f"{len(own)} numbers, because they scale its beliefs; train it again"
            raise validation.refusal("nominal_error", error, allowed)
        return replace(task, nominal_error=np.array(error))


@dataclass(frozen=True)
class Blueprint:
    """The description from which a policy is built, with its weights and the task's spaces."""

    algorithm: str
    activation: str
    actions: str  # the action space, as Gymnasium writes it
    network: Mapping[str, Any] | None = None  # as :meth:`NetworkShape.plain` returns it

    @classmethod
    def read(cls, data: Mapping[str, Any]) -> Blueprint:
        """Return the blueprint of the card, or of the readable entries of Stable-Baselines3."""
        card_entry = _entry(data)
        if "format" not in card_entry:
            return _inferred(data)
        validation.integer("format", card_entry["format"], at_least=FORMAT, at_most=FORMAT)
        own = ModelView.__dataclass_fields__.keys() | cls.__dataclass_fields__.keys()
        validation.keys("entry of the card", card_entry, {"format", "reward_scale"} | own)
        if not isinstance(card_entry.get("network"), dict):
            raise ConfigurationError("network is not allowed: it must be a table of sizes")
        return cls(
            validation.choice("algorithm", card_entry.get("algorithm"), POLICIES),
            validation.choice("activation", card_entry.get("activation"), ACTIVATIONS),
            str(card_entry.get("actions")),
            card_entry["network"],
        )


def model_card(algorithm: str, model: BaseAlgorithm, task: Task, local: bool) -> Plain:
    """Return a model's card, shorter and without a format if weights cannot rebuild its policy."""
    view = make_view(task, local)
    entries = {
        "algorithm": algorithm,
        "observation_names": list(view.names),
        "local": local,
        "price_range": task.reward.price.span,
    }
    if task.nominal_error is not None:
        entries["nominal_error"] = task.nominal_error.tolist()
        entries["reward_scale"] = task.settings["reward_scale"]
    policy: Any = model.policy
    if type(policy) is not POLICIES.get(algorithm) or set(model.policy_kwargs) - _HARMLESS:
        return entries
    names = [name for name, kind in ACTIVATIONS.items() if kind is policy.activation_fn]
    if not names:
        return entries
    network = NetworkShape.of_weights(policy.state_dict())
    plain = {
        "activation": names[0],
        "actions": space_text(model.action_space),
        "network": network.plain(),
    }
    return {"format": FORMAT} | entries | plain


def algorithm_name(model: BaseAlgorithm) -> str:
    """Return the algorithm of a model, one of :data:`ALGORITHMS` or the base of its class."""
    names = {kind: name for name, kind in ALGORITHMS.items()}
    return next(names[kind] for kind in type(model).__mro__ if kind in names)


def algorithm_of(data: Mapping[str, Any]) -> str | None:
    """Return the algorithm of the card, or of the policy class in the archive's plain entries."""
    card_entry = _entry(data).get("algorithm")
    if isinstance(card_entry, str):
        return card_entry
    module = _table(data, "policy_class").get("__module__")
    entry = next((n for n, policy in POLICIES.items() if policy.__module__ == module), None)
    return "ppo" if entry == "a2c" and "clip_range" in data else entry


def _inferred(data: Mapping[str, Any]) -> Blueprint:
    """Return the blueprint of a model without a card, or with an earlier card."""
    algorithm, settings = algorithm_of(data), _table(data, "policy_kwargs")
    module = _table(data, "policy_class").get("__module__")
    if algorithm not in POLICIES or POLICIES[algorithm].__module__ != module:
        raise NeedsTrust(f"its policy belongs to none of {', '.join(POLICIES)}")
    if "gymnasium.spaces.box.Box" not in str(_table(data, "observation_space").get(":type:")):
        raise NeedsTrust("its observation is not a vector")
    strange = sorted(set(settings) - _HARMLESS - {":type:", ":serialized:"})
    if strange:
        raise NeedsTrust(f"its policy has other settings, {strange}")
    usual = ACTIVATIONS["relu" if algorithm == "dqn" else "tanh"]  # the policies' default
    value = settings.get("activation_fn", str(usual))
    names = [n for n, kind in ACTIVATIONS.items() if str(kind) == value]
    if not names:
        raise NeedsTrust(f"its activation is {value!r}")
    space = _table(data, "action_space")
    kind = re.sub(r".*\.(\w+)'>$", r"\1", str(space.get(":type:")))
    start = f", start={space['start']}" if str(space.get("start", 0)).strip("[0 \n]") else ""
    number = " ".join(str(space.get("n", space.get("nvec"))).split())
    return Blueprint(algorithm, names[0], f"{kind}({number}{start})")


def _entry(data: Mapping[str, Any]) -> Plain:
    """Return the card in an archive's data, empty if there is none."""
    return _table(data, ENTRY) if ENTRY in data else {}


def _table(data: Mapping[str, Any], key: str) -> Plain:
    result = data.get(key)
    if not isinstance(result, dict):
        raise ConfigurationError(f"it is not a Stable-Baselines3 model (its {key} is not a table)")
    return result


def _errors(value: Any) -> tuple[float, ...]:
    return tuple(validation.not_negative("nominal_error", value, np.shape(value)).tolist())
