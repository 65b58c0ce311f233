"""Loading a saved agent: a model file is data.

The policy is rebuilt from its card, or from the readable part of what Stable-Baselines3 writes, and
from its weights; nothing in the file is unpickled. ``trust`` loads it with Stable-Baselines3's own
loader instead, which runs whatever code the file holds.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from stable_baselines3.common.base_class import BaseAlgorithm

from fusion_gym import validation
from fusion_gym.core.task import ACTION_KINDS, Task
from fusion_gym.envs.views import View, make_view
from fusion_gym.policies.archive import NeedsTrust, read_plain, read_weights
from fusion_gym.policies.card import (
    ACTIVATIONS,
    ALGORITHMS,
    POLICIES,
    Blueprint,
    ModelView,
    algorithm_of,
)
from fusion_gym.policies.model import ModelPolicy
from fusion_gym.policies.network import NetworkShape
from fusion_gym.validation import ConfigurationError


def load_model_policy(
    path: str,
    task: Task,
    deterministic: bool = True,
    price: float | None = None,
    *,
    trust: bool = False,
) -> ModelPolicy:
    """The agent saved at ``path`` (with or without ``.zip``), checked against the task.

    With ``trust`` Stable-Baselines3's own loader loads it, which runs code that the file holds.

    Raises:
        ConfigurationError: no such file, no Stable-Baselines3 model, one that its weights alone do
            not rebuild (without ``trust``), or one of another observation layout or action space.
    """
    validation.boolean("deterministic", deterministic)
    file = next((p for p in (Path(path), Path(f"{path}.zip")) if p.is_file()), None)
    if file is None:
        raise ConfigurationError(f"model {path!r} is not allowed: there is no such file")
    try:
        data = read_plain(file)
        observed = ModelView.read(data)
        load = _unpickled if trust else _rebuilt
        model, action = load(file, data, observed.on(task), observed)
    except NeedsTrust as error:
        raise ConfigurationError(
            f"model {path!r} is more than a card and weights: {error}; --trust, or "
            "make_policy(…, trust=True), loads it with Stable-Baselines3, which runs any code in it"
        ) from None
    except ConfigurationError as error:
        raise ConfigurationError(f"model {path!r} is not allowed: {error}") from None
    task = dataclasses.replace(task, action=action)
    return ModelPolicy(model, task, deterministic, price, observed)


def _rebuilt(
    file: Path, data: Mapping[str, Any], task: Task, observed: ModelView
) -> tuple[BaseAlgorithm, str]:
    """The model from its card and its weights, and its kind of action."""
    blueprint, weights = Blueprint.read(data), read_weights(file)
    network = NetworkShape.of({name: tuple(weight.shape) for name, weight in weights.items()})
    if blueprint.network not in (None, network.plain()):
        raise ConfigurationError(
            f"its card's network is not that of its weights, {network.plain()}"
        )
    if not network.fits(blueprint.algorithm):
        raise NeedsTrust(f"its weights are not those of {blueprint.algorithm}")
    action, view = _fitted(task, observed, (network.entries,), blueprint.actions)
    model = _empty(blueprint.algorithm, view)
    model.policy = _policy(blueprint, network, view)
    try:
        model.policy.load_state_dict(weights, strict=True)
    except RuntimeError:
        raise NeedsTrust(f"its weights are not those of {blueprint.algorithm}") from None
    if blueprint.algorithm == "dqn":  # which decides by chance with a coin of its own
        rate = data.get("exploration_rate", 0.0)
        model.exploration_rate = validation.number(  # type: ignore[attr-defined]
            "exploration_rate", rate, at_least=0.0, at_most=1.0
        )
    return model, action


def _empty(algorithm: str, view: View) -> BaseAlgorithm:
    """An algorithm that has neither environment, buffers nor optimiser, and cannot learn."""
    kind: Any = ALGORITHMS[algorithm]
    model: BaseAlgorithm = kind(
        POLICIES[algorithm], env=None, device="cpu", _init_setup_model=False
    )
    model.observation_space, model.action_space = view.space, view.actions
    return model


def _policy(blueprint: Blueprint, network: NetworkShape, view: View) -> Any:
    """The policy with weights that do not matter yet; torch's stream of random numbers stays."""
    kind: Any = POLICIES[blueprint.algorithm]
    with torch.random.fork_rng(devices=[]):
        return kind(
            view.space,
            view.actions,
            lr_schedule=lambda _: 0.0,
            activation_fn=ACTIVATIONS[blueprint.activation],
            optimizer_class=lambda *_, **__: None,
            **network.arguments(),
        )


def _unpickled(
    file: Path, data: Mapping[str, Any], task: Task, observed: ModelView
) -> tuple[BaseAlgorithm, str]:
    """The model as Stable-Baselines3 loads it: this runs code that the file holds."""
    problems = []
    for name in _candidates(data):
        try:
            model = ALGORITHMS[name].load(file, device="cpu")
        except Exception as error:  # whatever the file's own code raises
            problems.append(f"{name}: {error}")
            continue
        shape = model.observation_space.shape or ()
        return model, _fitted(task, observed, shape, str(model.action_space))[0]
    raise ConfigurationError(f"it cannot be loaded as {'; '.join(problems)}")


def _candidates(data: Mapping[str, Any]) -> list[str]:
    """The algorithms that may have saved the file, of all that both libraries have."""
    received, described = algorithm_of(data), data.get("policy_class")
    if received in ALGORITHMS:
        return [received]
    module = described.get("__module__") if isinstance(described, dict) else None
    result = [
        name
        for name, kind in ALGORITHMS.items()
        if any(policy.__module__ == module for policy in kind.policy_aliases.values())
    ]
    return result or (["dqn"] if "exploration_schedule" in data else ["ppo", "a2c"])


def _fitted(
    task: Task, observed: ModelView, shape: tuple[int, ...], actions: str
) -> tuple[str, View]:
    """The kind of action that the model has, and the view of the task with it.

    Raises:
        ConfigurationError: the model sees other entries, or decides on other actions.
    """
    view, names = make_view(task, observed.local), observed.observation_names
    trained = "it was trained for another observation layout: it expects"
    if names is not None and names != tuple(view.names):
        missing = [name for name in names if name not in view.names]
        extra = [name for name in view.names if name not in names]
        raise ConfigurationError(
            f"{trained} {len(names)} entries, the task (information={task.information!r}) has "
            f"{len(view.names)}; missing are {missing[:4] or 'none'}, unknown to the model "
            f"{extra[:4] or 'none'}" + ("" if missing or extra else " (the order differs)")
        )
    if shape != view.space.shape:
        raise ConfigurationError(
            f"{trained} shape {shape}, the task (information={task.information!r}) has "
            f"{view.space.shape}"
        )
    allowed = {str(view.actions): (task.action, view)}
    if not observed.local and task.access != "single":
        for kind in set(ACTION_KINDS) - {task.action}:
            other = make_view(dataclasses.replace(task, action=kind))
            allowed[str(other.actions)] = (kind, other)
    if actions not in allowed:
        raise ConfigurationError(
            f"it has the action space {actions!r}: the task has {task.sensors} sensors, so it must "
            f"be {' or '.join(allowed)}"
        )
    return allowed[actions]
