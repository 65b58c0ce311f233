"""Any policy by its text: an analytic trigger, or ``model:PATH`` for a saved agent."""

from __future__ import annotations

from fusion_gym.envs import Task
from fusion_gym.evaluation.lookahead import Lookahead
from fusion_gym.triggers import Policy, make_trigger, parse_settings
from fusion_gym.validation import ConfigurationError, keys


def make_policy(spec: str, task: Task) -> Policy:
    """The policy that ``NAME``, ``NAME:key=value,…`` or ``model:PATH`` names.

    A model takes ``deterministic=false``, and ``price=P`` where the task shows a price.

    The signals that it looks at are checked against the task's information mode.

    Raises:
        ConfigurationError: an unknown policy or parameter, a value that is not allowed, a model
            that cannot be read or was trained for another observation layout, or a policy that
            looks at signals which the task withholds.
    """
    name, _, text = spec.partition(":")
    if name == "model":
        from fusion_gym.evaluation.model_policy import load_model_policy

        path, *settings = text.split(",")
        if path.startswith("path="):
            path = path.removeprefix("path=")
        options = parse_settings("parameter of policy 'model'", settings)
        keys("parameter of policy 'model'", options, ["deterministic", "price"])
        return load_model_policy(path, task, **options)
    if name == "lookahead":
        options = parse_settings("parameter of policy 'lookahead'", text.split(",") if text else [])
        keys("parameter of policy 'lookahead'", options, ["price", "steps"])
        return Lookahead(task, **options)
    policy = make_trigger(spec, task.policy_defaults)
    _try_out(spec, policy, task)
    return policy


def _try_out(spec: str, policy: Policy, task: Task) -> None:
    """One call on one run, so that a misfit is told before anything long begins."""
    from fusion_gym.envs import EpisodeBatch

    batch = EpisodeBatch(task, 1)
    batch.reset()
    policy.reset(1)
    try:
        policy(batch.signals())
    except (LookupError, ValueError) as error:
        raise ConfigurationError(f"policy {spec!r}: {error.args[0]}") from None
    policy.reset(1)
