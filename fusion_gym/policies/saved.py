"""Saved agents: the file as data, the policy, and its calibration with a rule.

A file is the archive of a Stable-Baselines3 model. The loader of Stable-Baselines3 unpickles the
entries ``:serialized:`` of the archive's ``data``, which runs code of the file. This module leaves
such entries as text. Of the ``.pth`` files it reads only the weights of the policy, by torch's
loader of plain weights. The policy is rebuilt from its weights and the readable entries. With
``trust`` the loader of Stable-Baselines3 loads the file and runs code that it contains.

The card is the entry ``fusion_gym_model`` of ``data``, so Stable-Baselines3 saves and loads it with
the model. It describes the observation; networks and spaces are in the readable entries of
Stable-Baselines3, which also a model without a card has.

``fusion-gym calibrate`` writes a file of agents that are calibrated with a rule at each price of a
token, an archive of ``calibration.json`` and the agents.
"""

from __future__ import annotations

import copy
import io
import json
import pickle
import re
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import sb3_contrib
import stable_baselines3
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib import MaskablePPO, RecurrentPPO
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from sb3_contrib.tqc.policies import TQCPolicy
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.common.vec_env.stacked_observations import StackedObservations
from stable_baselines3.dqn.policies import DQNPolicy
from stable_baselines3.sac.policies import SACPolicy
from stable_baselines3.td3.policies import TD3Policy
from torch import nn

from fusion_gym import validation, zoo
from fusion_gym.arrays import Array
from fusion_gym.core.action import ACTIONS, SCORES, Threshold, space_text
from fusion_gym.core.knowledge import Knowledge, Signals, least_covering
from fusion_gym.core.observation import ObservationLayout
from fusion_gym.core.reward import Price
from fusion_gym.core.task import Task
from fusion_gym.entries import Arguments, Plain
from fusion_gym.envs.views import Rows, View, append_ratios, make_view, space_with_ratios
from fusion_gym.errors import forbidden
from fusion_gym.policies.base import Policy, Requests, Stateless
from fusion_gym.policies.registry import make_policy
from fusion_gym.policies.rules import PricedThreshold, beliefs_of
from fusion_gym.validation import ConfigurationError, display, refusal

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
    in (
        ActorCriticPolicy, DQNPolicy, MaskableActorCriticPolicy, RecurrentActorCriticPolicy,
        SACPolicy, TD3Policy, TQCPolicy,
    )
}  # fmt: skip
_ACTIVATIONS: dict[str, type[nn.Module]] = {
    str(kind): kind for kind in (nn.ELU, nn.GELU, nn.LeakyReLU, nn.ReLU, nn.SiLU, nn.Tanh)
}
# The allowed policy_kwargs: those of the networks, and those without influence on a decision. A
# features_extractor_class, for example, is code.
_NETWORKS = {
    "activation_fn", "enable_critic_lstm", "lstm_hidden_size", "n_critics", "n_lstm_layers",
    "n_quantiles", "net_arch", "shared_lstm",
}  # fmt: skip
_HARMLESS = {
    "log_std_init", "normalize_images", "optimizer_class", "optimizer_kwargs", "ortho_init",
    "share_features_extractor", "use_sde",
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
        rule: text of a priced_threshold, whose log ratios are the last entries; None for none.
        rate_range: range of the token rate; None for one rate.
    """

    observation_names: tuple[str, ...] | None = None
    local: bool = False
    price_range: tuple[float, float] | None = None
    nominal_error: tuple[float, ...] | None = None
    rule: str | None = None
    rate_range: tuple[float, ...] | None = None

    @classmethod
    def read(cls, data: Mapping[str, Any]) -> ModelView:
        """Return the view of an archive's card; without a card, the whole view of a scheduler."""
        card_entry = _entry(data)
        names, span = card_entry.get("observation_names"), card_entry.get("price_range")
        error, rule = card_entry.get("nominal_error"), card_entry.get("rule")
        listed = isinstance(names, list) and all(isinstance(name, str) for name in names)
        if names is not None and not listed:
            raise ConfigurationError("observation_names is not allowed: it must be a list of words")
        if not isinstance(rule, str | None):
            raise refusal("rule", rule, "a text")
        rates = card_entry.get("rate_range")
        return cls(
            None if names is None else tuple(names),
            validation.boolean("local", card_entry.get("local", False)),
            None if span is None else Price.create("random", span).span,
            None if error is None else _numbers("nominal_error", error),
            rule,
            None if rates is None else _numbers("rate_range", rates),
        )

    def on(self, task: Task) -> Task:
        """Return the task with the price and the scale of the model's training."""
        span, rates = task.reward.price.span, task.network.bucket.rate_range
        if None not in (self.rate_range, rates) and self.rate_range != rates:
            allowed = f"{display(self.rate_range)}, which the agent observes"
            raise refusal("token_rate", rates, allowed)
        if None not in (self.price_range, span) and self.price_range != span:
            allowed = f"{display(self.price_range)}, which the agent observes, or left out"
            raise refusal("price_range", span, allowed)
        if self.price_range is not None and span is None:
            task = task.with_options(cost_weight="random", price_range=self.price_range)
        error, own = self.nominal_error, task.nominal_error
        if own is None or not task.belief_features or self.observation_names is None:
            return task
        if error is None or len(error) != len(own):
            allowed = f"{len(own)} numbers, because they scale its beliefs; train it again"
            raise refusal("nominal_error", error, allowed)
        return replace(task, nominal_error=np.array(error))


def read_declaration(data: Mapping[str, Any]) -> tuple[str, Arguments, tuple[int], str]:
    """Return algorithm, arguments of the policy's class, shape of an observation, and actions."""
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
            arguments = _arguments(_table(data, "policy_kwargs"))
            return algorithm, arguments, (size,), _actions(data)
    raise NeedsTrust("its observation is not a vector")


def tag_model(
    model: BaseAlgorithm, task: Task, local: bool = False, rule: str | None = None
) -> None:
    """Write the card of the task, or of a sensor's local view of it, into a model before a save.

    With a ``rule`` its log ratios follow the observation.
    """
    entries = {
        "format": FORMAT,
        "algorithm": algorithm_name(model),
        "observation_names": list(make_view(task, local).names),
        "local": local,
        "price_range": task.reward.price.span,
    }
    if task.network.bucket.rate_range is not None:
        entries["rate_range"] = task.network.bucket.rate_range
    if task.nominal_error is not None:
        entries["nominal_error"] = task.nominal_error.tolist()
        entries["reward_scale"] = task.settings["reward_scale"]
    if rule is not None:
        entries["rule"] = rule
    setattr(model, ENTRY, entries)


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
    if kind == "Box":
        ends = ({*re.findall(r"[-.\de]+", str(space.get(end)))} for end in ("low", "high"))
        low, high = (" ".join(sorted(end)) + "0" * (len(end) == 1) for end in ends)
        return f"Box({low}, {high}, {tuple(space.get('_shape') or ())}, {space.get('dtype')})"
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


def _numbers(name: str, value: Any) -> tuple[float, ...]:
    return tuple(validation.not_negative(name, value, np.shape(value)).tolist())


class ModelPolicy:
    """A Stable-Baselines3 model as a policy, which uses only the task's observation.

    A local model decides for every sensor on the view of that sensor. The entries of beliefs have
    the scale of the training.

    Args:
        model: the model.
        task: the task.
        deterministic: take the likeliest action instead of a draw.
        price: price of a token, for a model that was trained for a range of prices; it replaces the
            task's own price.
        trained: the view of the training; the whole view of a scheduler by default.

    Raises:
        ConfigurationError: a price for a model without a range, or a price outside its range.
    """

    def __init__(
        self,
        model: BaseAlgorithm,
        task: Task,
        deterministic: bool = True,
        price: float | None = None,
        trained: ModelView | None = None,
    ) -> None:
        trained = ModelView() if trained is None else trained
        self.model = model
        self.deterministic = deterministic
        self._visible = task.reward.price.span is not None
        self.task = trained.on(task)
        self.view = make_view(self.task, trained.local)
        same = np.array_equal(self.task.nominal_error, task.nominal_error)  # type: ignore[arg-type]
        owner = self.view.owner or "scheduler"
        self._layout = None if same else ObservationLayout(self.task, owner)
        self._memory: Any = None  # of a recurrent policy
        self._stack: Any = None  # of an agent of several frames
        self.rule_text = trained.rule
        self.rule = None if trained.rule is None else calibration_rule(trained.rule, self.task)
        size = space_with_ratios(self.view, self.rule is not None).shape[0]
        self.frames = (model.observation_space.shape or (0,))[0] // size
        self.normalization: VecNormalize | None = None  # of the training
        self.offset = 0.0  # of the logarithms of thresholds
        stateful = isinstance(model, RecurrentPPO) or self.frames > 1
        self.stateless = deterministic and not stateful
        self.knowledge: Knowledge = self.view.knowledge
        self.memory_owner = self.view.owner
        if self.rule is not None:
            self.memory_owner = self.rule.memory_owner or self.memory_owner
            self.knowledge = least_covering((self.knowledge, self.rule.knowledge))
        if isinstance(self.view.action, Threshold):  # the sensors' scores take part
            self.knowledge = least_covering((self.knowledge, self.view.action.score.knowledge))
        if stateful and self.knowledge != "centre":
            self.knowledge = least_covering((self.knowledge, "own_memory"))
        span = self.task.reward.price.span
        self.price: float | None = None
        if price is None and span is not None and not self._visible:
            fixed = task.reward.price.fixed
            assert fixed is not None  # a drawn price is always shown
            price = min(max(fixed, span[0]), span[1])
        if price is not None:
            if span is None:
                reason = "the model has no price_range, only a single price"
                raise forbidden("price", price, reason)
            price_setting = Price.create(price, span)
            self.price = float(price_setting.encode(price_setting.draw(np.zeros(1)))[0])
            if self.rule is not None:
                self.rule.price = price

    def reset(self, runs: int, seed: int = 0) -> None:
        """Clear the memory and the frames, and draw from the stream of ``seed``."""
        self._memory = self._stack = None
        if not self.deterministic:
            self.model.set_random_seed(seed)

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        return self.view.action.requests(self._act(signals), len(signals["start"]), lambda: signals)

    def _act(self, signals: Signals) -> NDArray[Any]:
        """Return the actions of the rows."""
        masks = {}
        if isinstance(self.model, MaskablePPO):
            masks["action_masks"] = self.view.action.masks(signals["grantable"])
        rows, start = self.rows(signals), signals["start"].repeat(self.view.rows_per_run)
        if self.frames > 1:  # the present one comes last
            if self._stack is None:
                self._stack = np.zeros((len(rows), self.frames * rows.shape[1]), np.float32)
            self._stack[start] = 0.0
            rows = self._stack = np.concatenate((self._stack[:, rows.shape[1] :], rows), axis=1)
        action, self._memory = self.model.predict(
            rows,
            state=self._memory,
            episode_start=start,
            deterministic=self.deterministic,
            **masks,
        )
        if isinstance(self.view.action, Threshold):
            action = np.clip(action + self.offset, *self.view.action.score.bounds)
        return action

    def rows(self, signals: Signals) -> Rows:
        """Return the observation of the model (N·rows_per_run, entries), float32."""
        observation = signals["observation"]
        if self._layout is not None:
            beliefs = beliefs_of(signals, own=self.view.owner == "own")
            observation = self._layout.replace_beliefs(observation, beliefs)
        if self.price is not None:
            own = observation[:, :-1] if self._visible else observation  # the price comes last
            column = np.full((len(own), 1), self.price, dtype=np.float32)
            observation = np.concatenate((own, column), axis=1)
        rows: Any = self.view.rows(observation)
        if self.normalization is not None:
            rows = self.normalization.normalize_obs(rows)
        return rows if self.rule is None else append_ratios(rows, self.rule.log_ratio(signals).T)

    def refuse_frames(self) -> None:
        """Refuse an agent of several frames."""
        if self.frames > 1:
            raise refusal("frames", self.frames, "1, an agent without VecFrameStack", "here")

    def check_logits(self) -> None:
        """Refuse an agent without one logit for each sensor."""
        action, model = self.view.action, self.model
        self.refuse_frames()
        if isinstance(action, Threshold):
            return
        if isinstance(model, RecurrentPPO) or not hasattr(model.policy, "action_net"):
            allowed = "an agent with one logit for each sensor (ppo, a2c, trpo, maskable_ppo)"
            raise refusal("policy", type(model).__name__, allowed)
        if action.places(0) is None:
            allowed = "MultiBinary, MultiDiscrete, or access='single'"
            raise refusal("action", str(action.space), allowed)

    def logits(self, signals: Signals) -> Array:
        """Return the logit (sensors, N) of each sensor's request over its silence.

        With thresholds it is the logarithm of score over threshold.
        """
        action = self.view.action
        if isinstance(action, Threshold):
            return action.log_ratio(self._act(signals).T.astype(np.float64), signals)
        policy: Any = self.model.policy
        rows = torch.as_tensor(self.rows(signals))
        with torch.no_grad():
            latent = policy.mlp_extractor.forward_actor(policy.extract_features(rows))
            outputs: Array = policy.action_net(latent).numpy().astype(np.float64)
        result = self.view.action.scores(outputs)
        assert result is not None  # or check_logits refuses
        masked = isinstance(self.model, MaskablePPO)
        return np.where(signals["grantable"], result, -np.inf) if masked else result

    def with_threshold(self, threshold: float) -> ModelPolicy:
        """Return the agent whose logits are lower by a threshold, in its last layer."""
        result = copy.deepcopy(self)
        if isinstance(self.view.action, Threshold):
            result.offset += threshold
            return result
        policy: Any = result.model.policy
        with torch.no_grad():
            bias = policy.action_net.bias
            bias[self.view.action.places(len(bias))] -= threshold
        return result


def load_model_policy(
    path: str,
    task: Task,
    deterministic: bool = True,
    price: float | None = None,
    normalize: str | None = None,
    *,
    trust: bool = False,
) -> ModelPolicy:
    """Return the agent saved at ``path``, checked against the task.

    Args:
        path: the file, with or without ``.zip``.
        task: the task.
        deterministic: take the likeliest action instead of a draw.
        price: price of a token, for an agent that was trained for a range of prices.
        normalize: file of ``VecNormalize.save``, for an agent that was trained under VecNormalize;
            a pickle, which needs ``trust``.
        trust: use the loader of Stable-Baselines3, which runs code of the file.

    Raises:
        ConfigurationError: no such file, no Stable-Baselines3 model, a model that its weights
            cannot rebuild (without ``trust``), or another observation layout or action space.
    """
    validation.boolean("deterministic", deterministic)
    file = model_file(path)
    try:
        data = read_plain(file)
        observed = ModelView.read(data)
        # On-policy algorithms keep an observation before normalization under VecNormalize alone.
        normalized = "gae_lambda" in data and data.get("_last_original_obs") is not None
        if normalize is None and normalized:
            raise refusal("normalize", None, "the file of its VecNormalize statistics")
        load = _unpickled if trust else _rebuilt
        model, action = load(file, data, observed.on(task), observed)
    except NeedsTrust as error:
        raise ConfigurationError(
            f"model {path!r} is more than a card and weights: {error}; --trust, or "
            "make_policy(…, trust=True), loads it with Stable-Baselines3, which runs any code in it"
        ) from None
    except ConfigurationError as error:
        raise ConfigurationError(f"model {path!r} is not allowed: {error}") from None
    task = task.with_options(**action)
    policy = ModelPolicy(model, task, deterministic, price, observed)
    if normalize is not None:
        policy.normalization = _statistics(normalize, policy.view, trust)
    return policy


def _statistics(path: str, view: View, trust: bool) -> VecNormalize | None:
    """Return the statistics of VecNormalize, by code of the file; ``None`` of rewards alone."""
    if not trust:
        raise refusal("normalize", path, "given with --trust: it is a pickle")
    try:
        statistics = pickle.loads(Path(path).read_bytes())
    except Exception as error:  # a pickle raises errors of any class
        raise refusal("normalize", path, f"a readable file ({error})") from None
    content = vars(statistics) if isinstance(statistics, VecNormalize) else {}
    if content.get("norm_obs") is False:
        return None
    moments = [np.asarray(getattr(content.get("obs_rms"), name, "")) for name in ("mean", "var")]
    if any(m.shape != view.space.shape or not np.isfinite(m).all() for m in moments):
        raise refusal("normalize", path, f"statistics of shape {view.space.shape}")
    return statistics


def model_file(path: str) -> Path:
    """Return the file of an agent, with or without ``.zip`` in its path."""
    file = next((p for p in (Path(path), Path(f"{path}.zip")) if p.is_file()), None)
    if file is None:
        raise ConfigurationError(f"model {path!r} is not allowed: there is no such file")
    return file


def load_controller(path: str, observations: spaces.Box, actions: spaces.Space[Any]) -> Any:
    """Return the agent of an environment, from its weights alone, for these spaces.

    Args:
        path: the file, with or without ``.zip``.
        observations: space of the environment's observations.
        actions: space of its actions.

    Raises:
        ConfigurationError: no such file, or an agent of other spaces or another algorithm.
    """
    file = model_file(path)
    try:
        data = read_plain(file)
        algorithm, arguments, shape, _ = read_declaration(data)
        if shape != observations.shape:
            raise refusal("shape", shape, f"{observations.shape}, as the observation has")
        if "gae_lambda" in data and data.get("_last_original_obs") is not None:
            raise refusal("normalize", True, "an agent without VecNormalize")
        return _model(algorithm, arguments, read_weights(file), observations, actions)
    except ConfigurationError as error:
        other = "a function that calls the loaded model does as well"
        raise ConfigurationError(f"model {path!r} is not allowed: {error}; {other}") from None


def _rebuilt(
    file: Path, data: Mapping[str, Any], task: Task, observed: ModelView
) -> tuple[BaseAlgorithm, Arguments]:
    """Return the model from its readable entries and its weights, and its actions' options."""
    algorithm, arguments, shape, actions = read_declaration(data)
    weights = read_weights(file)
    action, view = _fitted(task, observed, shape, actions)
    single = space_with_ratios(view, observed.rule is not None)
    frames = shape[0] // single.shape[0]
    space: Any = StackedObservations(1, frames, single).stacked_observation_space
    model = _model(algorithm, arguments, weights, space, view.action.space)
    if algorithm == "dqn":  # its random decisions need the exploration rate
        rate = data.get("exploration_rate", 0.0)
        rate = validation.number("exploration_rate", rate, at_least=0.0, at_most=1.0)
        model.exploration_rate = rate
    return model, action


def _model(
    algorithm: str,
    arguments: Arguments,
    weights: dict[str, torch.Tensor],
    observations: spaces.Box,
    actions: spaces.Space[Any],
) -> Any:
    """Return a model without environment, buffers and optimiser, so it cannot learn."""
    kind: Any = ALGORITHMS[algorithm]
    base = POLICIES[algorithm]
    model = kind(base, env=None, device="cpu", _init_setup_model=False)
    model.observation_space, model.action_space = observations, actions
    # On the meta device the declared networks take no memory before the weights fit them.
    meta = torch.device("meta")
    try:
        with meta:
            model.policy = type("Declared", (base,), {"device": meta})(
                observations,
                actions,
                lr_schedule=lambda _: 0.0,
                optimizer_class=lambda *_, **__: None,
                **arguments,
            )
        model.policy.load_state_dict(weights, strict=True, assign=True)
    except Exception:  # a crafted file may declare anything
        raise NeedsTrust(f"its weights do not fit {algorithm}") from None
    model.policy.__class__ = base
    return model


def _unpickled(
    file: Path, data: Mapping[str, Any], task: Task, observed: ModelView
) -> tuple[BaseAlgorithm, Arguments]:
    """Return the model from the loader of Stable-Baselines3, which runs code of the file."""
    problems, known = [], algorithm_of(data)
    likely = ["dqn"] if "exploration_schedule" in data else ["ppo", "a2c"]  # of an own policy
    for name in [known] if known in ALGORITHMS else likely:
        try:
            model = ALGORITHMS[name].load(file, device="cpu")
        except Exception as error:  # the file's code may raise any error
            problems.append(f"{name}: {error}")
            continue
        shape = model.observation_space.shape or ()
        return model, _fitted(task, observed, shape, space_text(model.action_space))[0]
    raise ConfigurationError(f"it cannot be loaded as {'; '.join(problems)}")


def _fitted(
    task: Task, observed: ModelView, shape: tuple[int, ...], actions: str
) -> tuple[Arguments, View]:
    """Return the options of the model's actions, and the view of the task with them."""
    view, names = make_view(task, observed.local), observed.observation_names
    trained = "it was trained for another observation layout: it expects"
    if names is not None and names != tuple(view.names):
        missing = [name for name in names if name not in view.names]
        extra = [name for name in view.names if name not in names]
        raise ConfigurationError(
            f"{trained} {len(names)} entries, the task (information={task.options.information!r}) "
            f"has {len(view.names)}; missing are {missing[:4] or 'none'}, unknown to the model "
            f"{extra[:4] or 'none'}" + ("" if missing or extra else " (the order differs)")
        )
    size = space_with_ratios(view, observed.rule is not None).shape[0]
    if len(shape) != 1 or shape[0] % size or (names is not None and shape[0] > size):
        raise ConfigurationError(
            f"{trained} shape {shape}, the task (information={task.options.information!r}) has "
            f"{view.space.shape}"
        )
    own = {"action": task.options.action}
    allowed: dict[str, tuple[Arguments, View]] = {space_text(view.action.space): (own, view)}
    kinds = {"threshold"} if task.options.access == "single" else {*ACTIONS}
    for kind, score in () if observed.local else product(sorted(kinds), SCORES):
        settings = {"action": kind, "score": score}
        if kind != "threshold":
            settings["score"] = task.options.score
        elif not {*SCORES[score].names}.isdisjoint(task.hidden_signals):
            continue  # which the task's information withholds
        with suppress(ConfigurationError):  # the kind "discrete" of many sensors
            other = make_view(task.with_options(**settings))
            allowed.setdefault(space_text(other.action.space), (settings, other))
    if actions not in allowed:
        raise ConfigurationError(
            f"it has the action space {actions!r}: the task has {task.sensors} sensors, so it must "
            f"be {' or '.join(allowed)}"
        )
    return allowed[actions]


CALIBRATION = "calibration.json"  # the part of the archive that marks a calibrated policy

Mixing = tuple[NDArray[np.int64], Array, Array]  # agent, μ and c of each run (N,)


class CalibrationPoint(NamedTuple):
    """The calibration at a price: the agent's number, the mixture μ and the threshold c."""

    price: float
    agent: int
    mixture: float
    threshold: float


def calibration_rule(text: str, task: Task) -> PricedThreshold:
    """Return the rule of a text, which may name no other policy, because that may run code."""
    if text.partition(":")[0] != "priced_threshold":
        raise refusal("rule", text, "a priced_threshold")
    rule: Any = make_policy(text, task)
    return rule


@dataclass(eq=False)
class CalibratedPolicy(Stateless):
    r"""Request where a mixture of an agent's logit and a rule's log ratio reaches a threshold.

    Args:
        task: the task.
        agents: agents with one logit for each sensor.
        slopes: slope b > 0 of each agent's logit on z.
        rule: the rule, whose log ratio is z.
        points: calibrations in the order of their prices; between two prices μ and c are linear in
            the logarithm of the price, and the nearest price has the agent.
        price: price of a token; None for the price in the reward.

    Raises:
        ConfigurationError: an agent without one logit for each sensor, or agents and a rule with
            beliefs of different owners.

    Equation:
        $$
        \delta_i(t)=1\iff(1-\mu)\,\frac{\text{logit}_i}{b}+\mu\,z_i\ge c
        $$

        μ = 1 and c = 0 is the rule, μ = 0 and c = 0 the agent's likeliest action.
    """

    task: Task
    agents: Sequence[ModelPolicy]
    slopes: Sequence[float]
    rule: PricedThreshold
    points: Sequence[CalibrationPoint]
    price: float | None = None

    def __post_init__(self) -> None:
        for agent in self.agents:
            agent.check_logits()
        owners = {*(agent.memory_owner for agent in self.agents), self.rule.memory_owner} - {None}
        if any(agent.view.rows_per_run == 1 for agent in self.agents):
            owners.add("scheduler")
        if len(owners) > 1:
            raise ConfigurationError(
                f"rule = {self.rule!r} is not allowed with these agents: all must use the beliefs "
                f"of one owner, not of {sorted(map(str, owners))}"
            )
        self.memory_owner = self.agents[0].memory_owner or self.rule.memory_owner
        classes = [agent.knowledge for agent in self.agents]
        self.knowledge = least_covering([*classes, self.rule.knowledge])

    def single_agent(self) -> ModelPolicy:
        """Return the agent at the policy's price, with the threshold in its last layer.

        Raises:
            ConfigurationError: no price of several, or a price at which the rule takes part.
        """
        if self.price is None and len(self.points) > 1:
            raise refusal("price", None, "a number: model:PATH,price=…")
        price = self.points[0].price if self.price is None else self.price
        (number,), (mixture,), (threshold,) = self.at(np.array([price]))
        if mixture > 0.0:
            why = (
                f"0 at the price {price:g}: the rule reads signals that a file does not have; "
                "calibrated=false gives the agent alone"
            )
            raise refusal("mixture", float(mixture), why)
        return self.agents[number].with_threshold(float(threshold) * self.slopes[number])

    def nearest_agent(self) -> ModelPolicy:
        """Return the agent of the price that is nearest to the policy's, without calibration.

        Raises:
            ConfigurationError: no price, and more than one agent.
        """
        if self.price is None and len(self.agents) > 1:
            raise refusal("price", None, "a number: the file has several agents")
        return self.agents[self.at(np.array([self.price or 1.0]))[0][0]]

    def at(self, price: Array) -> Mixing:
        """Return agent, μ and c (N,) at prices (N,)."""
        prices, agents, mixtures, thresholds = np.array(self.points).T
        place, places = np.log(np.clip(price, prices[0], prices[-1])), np.log(prices)
        nearest = np.abs(place - places[:, None]).argmin(0)
        mixture, threshold = (np.interp(place, places, part) for part in (mixtures, thresholds))
        return agents.astype(np.int64)[nearest], mixture, threshold

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        price = signals["price"]
        price = price if self.price is None else np.full(price.shape, self.price)
        agent, mixture, threshold = self.at(np.asarray(price))
        score = np.zeros((self.task.sensors, len(price)))
        if (mixture > 0.0).any():  # a share of 0 takes no part, where a score may be infinite
            score += mixture * np.where(mixture > 0.0, self.rule.log_ratio(signals), 0.0)
        if (mixture < 1.0).any():
            logits = np.stack([item.logits(signals) for item in self.agents])
            logits /= np.array(self.slopes)[:, None, None]
            own = np.take_along_axis(logits, agent[None, None], 0)[0]
            score += (1.0 - mixture) * np.where(mixture < 1.0, own, 0.0)
        requests = self.task.action.choose(score, threshold)  # the rule names any sensors
        return requests | ((score >= threshold) & (mixture == 1.0))


def save_calibrated(
    rule: str,
    slopes: Sequence[float],
    points: Sequence[CalibrationPoint],
    files: Sequence[Path],
    output: Path,
) -> None:
    """Write a calibration with the text of its rule and its agents' files, without times."""
    content = {"rule": rule, "slopes": slopes, "points": [point._asdict() for point in points]}
    parts = {f"agent_{number}.zip": file.read_bytes() for number, file in enumerate(files)}
    parts[CALIBRATION] = json.dumps(content, indent=1).encode()
    with zipfile.ZipFile(output, "w") as archive:
        for name, part in parts.items():
            archive.writestr(zipfile.ZipInfo(name), part, zipfile.ZIP_DEFLATED)


def read_calibration(file: Path) -> tuple[str, list[float], list[CalibrationPoint]]:
    """Return rule, slopes and points of a file's calibration.

    Raises:
        ConfigurationError: the file has no calibration, or a value is not allowed.
    """
    content = read_plain(file, CALIBRATION)
    validation.keys(f"entry of {CALIBRATION}", content, ("rule", "slopes", "points"))
    rule, slopes, rows = (content.get(name) for name in ("rule", "slopes", "points"))
    if not isinstance(rule, str):
        raise refusal("rule", rule, "a text")
    slopes = [
        validation.number("slopes", b, above=0.0)
        for b in validation.entries("slopes", slopes, "a slope", "agent")
    ]
    points: list[CalibrationPoint] = []
    for row in validation.entries("points", rows, "a calibration", "price"):
        if not isinstance(row, dict) or row.keys() != {*CalibrationPoint._fields}:
            raise refusal("points", row, f"an object with {', '.join(CalibrationPoint._fields)}")
        least = points[-1].price if points else 0.0
        points.append(
            CalibrationPoint(
                validation.number("price", row["price"], above=least),
                validation.integer("agent", row["agent"], at_least=0, at_most=len(slopes) - 1),
                validation.number("mixture", row["mixture"], at_least=0.0, at_most=1.0),
                validation.number("threshold", row["threshold"]),
            )
        )
    return rule, slopes, points


def agent_files(path: Path, folder: Path) -> list[Path]:
    """Return the files of a policy's agents: its own, or the calibrated agents in a folder."""
    try:
        read_part(path, CALIBRATION)
    except ConfigurationError:
        return [path]
    _, slopes, _ = read_calibration(path)
    place = Path(tempfile.mkdtemp(dir=folder))
    files = [place / f"agent_{agent}.zip" for agent in range(len(slopes))]
    for file in files:
        file.write_bytes(read_part(path, file.name))
    return files


def load_calibrated(path: Path, task: Task, price: float | None, trust: bool) -> CalibratedPolicy:
    """Return the calibrated policy of a file, whose agents are read by :func:`load_model_policy`.

    Raises:
        ConfigurationError: a part is missing, or a value is not allowed.
    """
    text, slopes, points = read_calibration(path)
    rule = calibration_rule(text, task)
    rule.price = rule.price if price is None else price
    with tempfile.TemporaryDirectory() as folder:
        files = map(str, agent_files(path, Path(folder)))
        agents = [load_model_policy(file, task, True, price, trust=trust) for file in files]
    return CalibratedPolicy(task, agents, slopes, rule, points, price)


def saved_agent(
    task: Task,
    path: str,
    deterministic: bool = True,
    price: float | None = None,
    calibrated: bool = True,
    normalize: str | None = None,
    *,
    trust: bool = False,
) -> Policy:
    """Request by a Stable-Baselines3 agent, or by calibrated agents, from a file.

    Args:
        task: the task; a text cannot set it.
        path: the file, with or without ``.zip``.
        deterministic: take the likeliest action instead of a draw.
        price: price of a token, for an agent that was trained for a range of prices.
        calibrated: use the calibration of the file, if it has one, or the agent alone.
        normalize: file of the statistics of an agent that was trained under VecNormalize.
        trust: whether the file may run code; a text cannot set it.

    Raises:
        ConfigurationError: as :func:`load_model_policy`.
    """
    file = model_file(path)
    try:
        read_part(file, CALIBRATION)
    except ConfigurationError:
        return load_model_policy(path, task, deterministic, price, normalize, trust=trust)
    if calibrated and not deterministic:
        raise refusal("deterministic", deterministic, "true for calibrated agents")
    try:
        policy = load_calibrated(file, task, price, trust)
    except ConfigurationError as error:
        raise ConfigurationError(f"model {path!r} is not allowed: {error}") from None
    if calibrated:
        return policy
    agent = policy.nearest_agent()
    agent.deterministic = deterministic
    return agent


def zoo_agent(
    task: Task,
    name: str,
    deterministic: bool = True,
    price: float | None = None,
    calibrated: bool = True,
) -> Policy:
    """Request by an agent of the model zoo (:mod:`fusion_gym.zoo`).

    Args:
        task: the task; a text cannot set it.
        name: name of the agent.
        deterministic: take the likeliest action instead of a draw.
        price: price of a token, for an agent that was trained for a range of prices.
        calibrated: use the calibration, or the agent alone.

    Raises:
        ConfigurationError: no agent of that name, a file that differs from its card, or an agent
            that does not fit the task.
    """
    return saved_agent(task, zoo.model_path(name), deterministic, price, calibrated)
