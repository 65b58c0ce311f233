"""Create models of a config's algorithm, with their initial policy."""

from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Discrete, MultiBinary
from stable_baselines3.common.base_class import BaseAlgorithm

from fusion_gym import seeds
from fusion_gym.arrays import Array
from fusion_gym.core.estimator import Estimator
from fusion_gym.core.task import Task
from fusion_gym.entries import Arguments
from fusion_gym.envs.privileged import PrivilegedVecEnv, reference_estimator
from fusion_gym.envs.sb3 import FusionSB3VecEnv
from fusion_gym.envs.views import SensorView
from fusion_gym.errors import forbidden
from fusion_gym.evaluation.cross_term import cross_terms, usual_policies, worst
from fusion_gym.output.progress import remark
from fusion_gym.policies.model import tag_model
from fusion_gym.policies.registry import make_policy
from fusion_gym.training.algorithms import TABLE
from fusion_gym.training.config import EnvironmentConfig, Experiment
from fusion_gym.validation import ConfigurationError, refusal

# Constants of the warning of a cross term:
_EPISODES = 150  # of each of two policies: a second or two in the slowest environment
_LEVEL = 0.99  # of the intervals together: one false warning in a hundred settings


def make_env(experiment: Experiment, task: Task) -> FusionSB3VecEnv:
    """Return the training environment."""
    name, local = experiment.algorithm.name, experiment.environment.local
    many = not local and task.action != "discrete" and task.network.access != "single"
    if TABLE[name].discrete_only and many:
        reason = "set the environment's option action: discrete"
        raise forbidden("action", task.action, reason, f"with algorithm {name!r}")
    training, where = experiment.training, experiment.environment
    runs: Arguments = {
        "num_envs": training.num_envs,
        "stagger": True,
        "local": local,
        "price_exponent": training.price_exponent,
    }
    reference = None
    if training.error != "squared":
        reference = _reference(task, where, training.error_filter)
    elif training.error_filter is not None:
        raise refusal("error_filter", training.error_filter, "none with error: squared")
    if reference is None and not TABLE[name].privileged:
        return FusionSB3VecEnv(task, **runs)
    return PrivilegedVecEnv(task, error=training.error, reference=reference, **runs)


def _reference(task: Task, where: EnvironmentConfig, error_filter: str | None) -> Estimator[Any]:
    """Return the estimator that processes every measurement, if possible the task's memory."""
    if task.memory_estimator is not None and error_filter in (
        None,
        where.options.get("memory_filter"),
    ):
        return task.memory_estimator
    try:
        return reference_estimator(where.id, where.options, error_filter)
    except ConfigurationError as error:
        if error_filter is None:
            raise
        raise forbidden("error_filter", error_filter, str(error)) from None


def make_model(experiment: Experiment, env: FusionSB3VecEnv) -> BaseAlgorithm:
    """Return a new model of the config's algorithm."""
    settings = experiment.algorithm
    row = TABLE[settings.name]
    try:
        model = row.model(
            row.policy, env, seed=experiment.training.seed, device="cpu", **settings.arguments()
        )
    except (AssertionError, ValueError) as error:  # checks of Stable-Baselines3
        reason = " ".join(str(error).split())
        raise forbidden("algorithm", settings.name, reason, "with these settings") from None
    rate = getattr(settings, "initial_rate", None)
    if rate is not None:
        _begin_at(model, env, rate)
    tag_model(model, env.task, local=experiment.environment.local)
    return model


def initial_logits(env: FusionSB3VecEnv, rate: float) -> Array:
    """Return logits of the choices with which every sensor requests at ``rate``.

    Args:
        env: the training environment.
        rate: share of the steps with a request of a sensor.

    Returns:
        Logits (sensors,) for ``MultiBinary``, or one per number of ``Discrete``.
    """
    odds, space, sensors = np.log(rate / (1.0 - rate)), env.action_space, env.task.sensors
    if isinstance(space, MultiBinary):
        return np.full(sensors, odds)
    assert isinstance(space, Discrete)
    if isinstance(env.view, SensorView):
        return np.array([0.0, odds])
    if env.task.network.access == "single":
        if sensors * rate >= 1.0:
            allowed = f"< 1/{sensors}, because one of {sensors} sensors transmits in a step"
            raise refusal("initial_rate", rate, allowed)
        return np.log([1.0 - sensors * rate, *[rate] * sensors])
    bits = np.arange(2**sensors)[:, None] >> np.arange(sensors) & 1
    return np.asarray(bits.sum(1) * odds)


def _begin_at(model: BaseAlgorithm, env: FusionSB3VecEnv, rate: float) -> None:
    """Shift the last layer's offsets so that the untrained policy requests at this rate."""
    logits = initial_logits(env, rate)
    head = model.policy.action_net
    assert isinstance(head, torch.nn.Linear)
    if head.out_features == 2 * logits.size:  # two choices a sensor, as MaskablePPO has them
        logits = np.stack((np.zeros_like(logits), logits), axis=1).ravel()
    with torch.no_grad():
        head.bias.add_(torch.as_tensor(logits, dtype=head.bias.dtype))


def warn_of_cross_term(experiment: Experiment, env: FusionSB3VecEnv) -> None:
    """Print the largest cross term of two usual policies if its interval excludes zero."""
    task, reference = env.task, env.batch.reference
    assert reference is not None  # present in the environment of such a training
    rate = getattr(experiment.algorithm, "initial_rate", None) or 0.5
    policies = {name: make_policy(name, task) for name in usual_policies(task, rate)}
    seed = seeds.CROSS_TERM.start
    name, terms = worst(cross_terms(task, reference, policies, _EPISODES, seed, _LEVEL))
    if not terms.compatible:
        remark(
            f"warning: training.error = 'mismatch' leaves out a cross term of {terms.text} of the "
            f"error under {name} ({_EPISODES} episodes); error: excess has none"
        )
