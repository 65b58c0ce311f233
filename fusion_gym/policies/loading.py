"""Load a saved agent; a model file is data.

The policy is rebuilt from its weights and the readable entries of Stable-Baselines3. Nothing in the
file is unpickled. With ``trust`` the loader of Stable-Baselines3 loads the file and runs code that
it contains.
"""

import pickle
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from fusion_gym import validation
from fusion_gym.core.action import ACTIONS, space_text
from fusion_gym.core.task import Task
from fusion_gym.envs.views import View, make_view
from fusion_gym.policies import card
from fusion_gym.policies.archive import NeedsTrust, read_plain, read_weights
from fusion_gym.policies.model import ModelPolicy
from fusion_gym.validation import ConfigurationError


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
        observed = card.ModelView.read(data)
        # On-policy algorithms keep an observation before normalization under VecNormalize alone.
        normalized = "gae_lambda" in data and data.get("_last_original_obs") is not None
        if normalize is None and normalized:
            raise validation.refusal("normalize", None, "the file of its VecNormalize statistics")
        load = _unpickled if trust else _rebuilt
        model, action = load(file, data, observed.on(task), observed)
    except NeedsTrust as error:
        raise ConfigurationError(
            f"model {path!r} is more than a card and weights: {error}; --trust, or "
            "make_policy(…, trust=True), loads it with Stable-Baselines3, which runs any code in it"
        ) from None
    except ConfigurationError as error:
        raise ConfigurationError(f"model {path!r} is not allowed: {error}") from None
    task = task.with_options(action=action)
    policy = ModelPolicy(model, task, deterministic, price, observed)
    if normalize is not None:
        policy.normalization = _statistics(normalize, policy.view, trust)
    return policy


def _statistics(path: str, view: View, trust: bool) -> VecNormalize | None:
    """Return the statistics of VecNormalize, by code of the file; ``None`` of rewards alone."""
    if not trust:
        raise validation.refusal("normalize", path, "given with --trust: it is a pickle")
    try:
        statistics = pickle.loads(Path(path).read_bytes())
    except Exception as error:  # a pickle raises errors of any class
        raise validation.refusal("normalize", path, f"a readable file ({error})") from None
    content = vars(statistics) if isinstance(statistics, VecNormalize) else {}
    if content.get("norm_obs") is False:
        return None
    moments = [np.asarray(getattr(content.get("obs_rms"), name, "")) for name in ("mean", "var")]
    if any(m.shape != view.space.shape or not np.isfinite(m).all() for m in moments):
        raise validation.refusal("normalize", path, f"statistics of shape {view.space.shape}")
    return statistics


def model_file(path: str) -> Path:
    """Return the file of an agent, with or without ``.zip`` in its path."""
    file = next((p for p in (Path(path), Path(f"{path}.zip")) if p.is_file()), None)
    if file is None:
        raise ConfigurationError(f"model {path!r} is not allowed: there is no such file")
    return file


def _rebuilt(
    file: Path, data: Mapping[str, Any], task: Task, observed: card.ModelView
) -> tuple[BaseAlgorithm, str]:
    """Return the model from its readable entries and its weights, and its kind of action."""
    blueprint, weights = card.Blueprint.read(data), read_weights(file)
    action, view = _fitted(task, observed, blueprint.shape, blueprint.actions)
    # Without environment, buffers and optimiser, so it cannot learn.
    kind: Any = card.ALGORITHMS[blueprint.algorithm]
    base = card.POLICIES[blueprint.algorithm]
    model = kind(base, env=None, device="cpu", _init_setup_model=False)
    model.observation_space, model.action_space = view.space, view.action.space
    # On the meta device the declared networks take no memory before the weights fit them.
    meta = torch.device("meta")
    try:
        with meta:
            model.policy = type("Declared", (base,), {"device": meta})(
                view.space,
                view.action.space,
                lr_schedule=lambda _: 0.0,
                optimizer_class=lambda *_, **__: None,
                **blueprint.arguments,
            )
        model.policy.load_state_dict(weights, strict=True, assign=True)
    except Exception:  # a crafted file may declare anything
        raise NeedsTrust(f"its weights do not fit {blueprint.algorithm}") from None
    model.policy.__class__ = base
    if blueprint.algorithm == "dqn":  # its random decisions need the exploration rate
        rate = data.get("exploration_rate", 0.0)
        rate = validation.number("exploration_rate", rate, at_least=0.0, at_most=1.0)
        model.exploration_rate = rate
    return model, action


def _unpickled(
    file: Path, data: Mapping[str, Any], task: Task, observed: card.ModelView
) -> tuple[BaseAlgorithm, str]:
    """Return the model from the loader of Stable-Baselines3, which runs code of the file."""
    problems, known = [], card.algorithm_of(data)
    likely = ["dqn"] if "exploration_schedule" in data else ["ppo", "a2c"]  # of an own policy
    for name in [known] if known in card.ALGORITHMS else likely:
        try:
            model = card.ALGORITHMS[name].load(file, device="cpu")
        except Exception as error:  # the file's code may raise any error
            problems.append(f"{name}: {error}")
            continue
        shape = model.observation_space.shape or ()
        return model, _fitted(task, observed, shape, space_text(model.action_space))[0]
    raise ConfigurationError(f"it cannot be loaded as {'; '.join(problems)}")


def _fitted(
    task: Task, observed: card.ModelView, shape: tuple[int, ...], actions: str
) -> tuple[str, View]:
    """Return the model's kind of action, and the view of the task with it."""
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
    if shape != view.space.shape:
        raise ConfigurationError(
            f"{trained} shape {shape}, the task (information={task.options.information!r}) has "
            f"{view.space.shape}"
        )
    allowed: dict[str, tuple[str, View]] = {
        space_text(view.action.space): (task.options.action, view)
    }
    if not observed.local and task.options.access != "single":
        for kind in ACTIONS:
            with suppress(ConfigurationError):  # the kind "discrete" of many sensors
                other = make_view(task.with_options(action=kind))
                allowed[space_text(other.action.space)] = (kind, other)
    if actions not in allowed:
        raise ConfigurationError(
            f"it has the action space {actions!r}: the task has {task.sensors} sensors, so it must "
            f"be {' or '.join(allowed)}"
        )
    return allowed[actions]
