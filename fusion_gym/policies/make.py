"""Any policy by its text: an analytic trigger, a reference, or a saved agent."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from fusion_gym import zoo
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.reward import Price
from fusion_gym.core.task import Task
from fusion_gym.policies.base import Policy
from fusion_gym.policies.lookahead import Lookahead
from fusion_gym.policies.optimal import OptimalPolicy
from fusion_gym.policies.periodic_optimum import PeriodicOptimum
from fusion_gym.policies.registry import make_trigger, parse_settings
from fusion_gym.policies.whittle import WhittleIndex
from fusion_gym.validation import ConfigurationError, keys


def make_policy(spec: str, task: Task) -> Policy:
    """The policy that ``NAME``, ``NAME:key=value,…``, ``model:PATH`` or ``zoo:NAME`` names.

    A model takes ``deterministic=false``, and ``price=P`` if it was trained to see the price. The
    references ``lookahead``, ``periodic_optimum``, ``optimal`` and ``whittle`` know the model.

    The signals that it looks at are checked against the task's information mode.

    Raises:
        ConfigurationError: an unknown policy or parameter, a value that is not allowed, a model
            that cannot be read or was trained for another observation layout, or a policy that
            looks at signals which the task withholds.
    """
    name, _, text = spec.partition(":")
    entries = text.split(",") if text else []
    if name in ("model", "zoo"):
        from fusion_gym.policies.model import load_model_policy

        chosen, *settings = text.split(",")
        options = parse_settings(f"parameter of policy {name!r}", settings)
        keys(f"parameter of policy {name!r}", options, ["deterministic", "price"])
        path = zoo.model_path(chosen) if name == "zoo" else chosen.removeprefix("path=")
        return load_model_policy(path, task, **options)
    if name in REFERENCES:
        make, known = REFERENCES[name]
        options = parse_settings(f"parameter of policy {name!r}", entries)
        keys(f"parameter of policy {name!r}", options, known)
        return make(task, **options)
    policy = make_trigger(spec, task.policy_defaults)
    _try_out(spec, policy, task)
    return policy


def _optimum(task: Task, criterion: str = "finite", price: float | None = None) -> Policy:
    """The solved optimum, at the task's own price of a token or at another."""
    if price is not None:
        reward = dataclasses.replace(task.reward, price=Price.create(price))
        task = dataclasses.replace(task, reward=reward)
    return OptimalPolicy(task, criterion)


# Policies that need the task's model, each with the parameters that it takes.
REFERENCES: dict[str, tuple[Callable[..., Policy], tuple[str, ...]]] = {
    "lookahead": (Lookahead, ("price", "steps")),
    "optimal": (_optimum, ("criterion", "price")),
    "periodic_optimum": (PeriodicOptimum, ("average", "cache", "packets", "period")),
    "whittle": (WhittleIndex, ("at_most", "price")),
}


def _try_out(spec: str, policy: Policy, task: Task) -> None:
    """One call on one run, so that a misfit is told before anything long begins."""
    batch = EpisodeBatch(task, 1)
    batch.reset()
    policy.reset(1)
    try:
        policy(batch.signals())
    except (LookupError, ValueError) as error:
        raise ConfigurationError(f"policy {spec!r}: {error.args[0]}") from None
    policy.reset(1)
