"""Saved agents as policies, by their file or by their name in the model zoo."""

from fusion_gym import zoo
from fusion_gym.core.task import Task
from fusion_gym.errors import ConfigurationError, refusal
from fusion_gym.policies.base import Policy


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
        ConfigurationError: as :func:`fusion_gym.policies.loading.load_model_policy`.
    """
    from fusion_gym.policies.archive import read_part
    from fusion_gym.policies.calibrated import CALIBRATION, load_calibrated
    from fusion_gym.policies.loading import load_model_policy, model_file

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
