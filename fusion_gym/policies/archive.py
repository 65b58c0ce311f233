"""The archive of a Stable-Baselines3 model as data: plain JSON, weights and the card of the agent.

The loader of Stable-Baselines3 unpickles the entries ``:serialized:`` of the archive's ``data``,
which runs code of the file. This module leaves such entries as text. Of the ``.pth`` files it reads
only the weights of the policy, by torch's loader of plain weights.

The card is the entry ``fusion_gym_model`` of ``data``, so Stable-Baselines3 saves and loads it with
the model. It describes the observation; networks and spaces are in the readable entries of
Stable-Baselines3, which also a model without a card has.
"""

from __future__ import annotations

import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
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
from torch import nn

from fusion_gym import validation
from fusion_gym.core.reward import Price
from fusion_gym.core.task import Task
from fusion_gym.entries import Arguments, Plain
from fusion_gym.envs.views import make_view
from fusion_gym.validation import ConfigurationError, display

LARGEST = 256 * 2**20  # bytes of a part, and of all weights
MOST = 1_000  # tensors
# Errors of zipfile on a damaged archive; RuntimeError where a part is encrypted.
DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    OSError,
    EOFError,
    RuntimeError,
    UnicodeError,
    struct.error,
)


class NeedsTrust(ConfigurationError):
    """A file that plain JSON and weights cannot restore; only its own code could load it."""


def read_plain(file: Path, name: str = "data") -> Plain:
    """Return a JSON object of the archive, with pickled entries as text."""
    content = read_part(file, name)
    try:
        data = json.loads(content)
    except (ValueError, RecursionError):
        raise _none(f"its {name} is not JSON") from None
    if not isinstance(data, dict):
        raise _none(f"its {name} is not a JSON object")
    return data


def read_weights(file: Path) -> dict[str, torch.Tensor]:
    """Return the policy's weights by name, finite float32."""
    part = read_part(file, "policy.pth")
    try:
        with zipfile.ZipFile(io.BytesIO(part)) as packed:
            stored = all(item.compress_type == zipfile.ZIP_STORED for item in packed.infolist())
        data = torch.load(io.BytesIO(part), "cpu", weights_only=True) if stored else None
    except Exception:  # a crafted file may raise any error
        raise NeedsTrust("its policy.pth holds more than plain weights") from None
    if not stored:
        raise NeedsTrust("its weights are compressed")
    if not isinstance(data, dict) or len(data) > MOST or not all(map(_is_plain, data.values())):
        raise NeedsTrust("its policy.pth is not a table of float32 weights")
    size = 4 * sum(weight.numel() for weight in data.values())
    if size > LARGEST:
        raise NeedsTrust(f"its weights have {size} bytes, more than {LARGEST}")
    if not all(bool(torch.isfinite(weight).all()) for weight in data.values()):
        raise _none("its weights are not finite")
    # Copies, because the tensors of a file may share memory.
    return {str(name): weight.clone() for name, weight in data.items()}


def read_part(file: Path, name: str) -> bytes:
    """Return a part of the archive, up to its declared size."""
    try:
        with zipfile.ZipFile(file) as archive:
            about = archive.getinfo(name)
            if about.file_size > LARGEST:
                raise NeedsTrust(f"its {name} has {about.file_size} bytes, more than {LARGEST}")
            if about.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise NeedsTrust(f"its {name} has an unusual compression")
            with archive.open(about) as part:
                return part.read(about.file_size)
    except KeyError:
        raise _none(f"it has no {name}") from None
    except DAMAGE as error:
        raise _none(" ".join(str(error).split())[:100]) from None


def _is_plain(weight: Any) -> bool:
    if type(weight) is not torch.Tensor:
        return False
    kind = (weight.layout, weight.dtype, weight.device.type)
    return kind == (torch.strided, torch.float32, "cpu")


def _none(reason: str) -> ConfigurationError:
    return ConfigurationError(f"it is not a Stable-Baselines3 model ({reason})")


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
_ACTIVATIONS: dict[str, type[nn.Module]] = {
    str(kind): kind for kind in (nn.ELU, nn.GELU, nn.LeakyReLU, nn.ReLU, nn.SiLU, nn.Tanh)
}
# The allowed policy_kwargs: those of the networks, and those without influence on a decision. A
# features_extractor_class, for example, is code.
_NETWORKS = {
    "activation_fn", "enable_critic_lstm", "lstm_hidden_size", "n_lstm_layers", "net_arch",
    "shared_lstm",
}  # fmt: skip
_HARMLESS = {
    "log_std_init", "normalize_images", "optimizer_class", "optimizer_kwargs", "ortho_init",
    "share_features_extractor",
}  # fmt: skip
# Entries of earlier cards, which the entries of Stable-Baselines3 repeat.
_REPEATED = {"actions", "activation", "network"}


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
    arguments: Arguments  # of the policy's class
    shape: tuple[int]  # of an observation
    actions: str  # the action space, as Gymnasium writes it

    @classmethod
    def read(cls, data: Mapping[str, Any]) -> Blueprint:
        """Return the blueprint of the readable entries of Stable-Baselines3."""
        card_entry = _entry(data)
        if "format" in card_entry:
            validation.integer("format", card_entry["format"], at_least=FORMAT, at_most=FORMAT)
            known = {"format", "algorithm", "reward_scale"} | ModelView.__dataclass_fields__.keys()
            validation.keys("entry of the card", card_entry, known | _REPEATED)
        algorithm = algorithm_of(data)
        module = _table(data, "policy_class").get("__module__")
        if algorithm not in POLICIES or POLICIES[algorithm].__module__ != module:
            raise NeedsTrust(f"its policy belongs to none of {', '.join(POLICIES)}")
        match _table(data, "observation_space"):
            case {":type:": "<class 'gymnasium.spaces.box.Box'>", "_shape": [int(size)]}:
                return cls(
                    algorithm, _arguments(_table(data, "policy_kwargs")), (size,), _actions(data)
                )
        raise NeedsTrust("its observation is not a vector")


def model_card(algorithm: str, task: Task, local: bool) -> Plain:
    """Return the card of a model that observes the task, or a sensor's local view of it."""
    entries = {
        "format": FORMAT,
        "algorithm": algorithm,
        "observation_names": list(make_view(task, local).names),
        "local": local,
        "price_range": task.reward.price.span,
    }
    if task.nominal_error is not None:
        entries["nominal_error"] = task.nominal_error.tolist()
        entries["reward_scale"] = task.settings["reward_scale"]
    return entries


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
    for name, kind in ALGORITHMS.items():
        if any(policy.__module__ == module for policy in kind.policy_aliases.values()):
            return "ppo" if name == "a2c" and "clip_range" in data else name
    return None


def _arguments(settings: Plain) -> Arguments:
    """Return the arguments of the policy's class in its readable policy_kwargs."""
    strange = sorted(settings.keys() - _NETWORKS - _HARMLESS - {":type:", ":serialized:"})
    if strange:
        raise NeedsTrust(f"its policy has other settings, {strange}")
    result = {name: settings[name] for name in sorted(_NETWORKS & settings.keys())}
    for name in ("lstm_hidden_size", "n_lstm_layers", "net_arch"):
        if isinstance(result.get(name), str):  # Stable-Baselines3 writes NumPy's numbers as text
            text = re.sub(r"np\.int\d+\((\d+)\)", r"\1", result[name]).replace("'", '"')
            with suppress(ValueError, RecursionError):
                result[name] = json.loads(text)
    layers = sum(1 for _ in validation.nested("policy_kwargs", result))
    if layers > MOST or result.get("n_lstm_layers", 1) not in range(MOST):
        raise NeedsTrust(f"its networks have more than {MOST} layers")
    if "activation_fn" in result:
        value = str(result["activation_fn"])
        if value not in _ACTIVATIONS:
            raise NeedsTrust(f"its activation is {value!r}")
        result["activation_fn"] = _ACTIVATIONS[value]
    return result


def _actions(data: Mapping[str, Any]) -> str:
    """Return the action space, as Gymnasium writes it."""
    space = _table(data, "action_space")
    kind = re.sub(r".*\.(\w+)'>$", r"\1", str(space.get(":type:")))
    start = f", start={space['start']}" if str(space.get("start", 0)).strip("[0 \n]") else ""
    number = " ".join(str(space.get("n", space.get("nvec"))).split())
    return f"{kind}({number}{start})"


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
