"""A few steps of a task before it is handed out: what float64 cannot hold shows at once."""

import numpy as np

from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.validation import ConfigurationError

_STEPS = 8


def rehearse(task: Task) -> None:
    """Three runs: one in which nobody requests, one with all requests, one with every other one.

    Raises:
        ConfigurationError: an observation, estimate or reward that is not finite.
    """
    batch = EpisodeBatch.seeded(task, 3, seed=0)
    sensors = np.arange(task.sensors)
    finite = bool(np.isfinite(batch.observe()).all())
    step = 0
    while finite and step < min(_STEPS, task.horizon):
        requests = np.stack([sensors < 0, sensors >= 0, (sensors + step) % 2 == 0], axis=-1)
        outcome = batch.step(requests)
        observation = (outcome.reward, outcome.squared_error, batch.observe())
        finite = all(bool(np.isfinite(entry).all()) for entry in observation)
        step += 1
    if not finite:
        raise ConfigurationError(
            f"these numbers together are not allowed: after {step} steps what is observed or "
            "rewarded is not finite, for they lie too far apart or make a covariance singular"
        )
