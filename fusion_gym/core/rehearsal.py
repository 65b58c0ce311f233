"""A short simulation of a task that detects numbers beyond float64."""

from dataclasses import replace

import numpy as np

from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.errors import ConfigurationError, DivergenceError

_STEPS = 8


def rehearse(task: Task) -> None:
    """Check that runs without, with all and with alternating requests remain finite."""
    sensors = np.arange(task.sensors)
    try:
        batch = EpisodeBatch.seeded(replace(task, backend="numpy"), 3, seed=0)
        for step in range(min(_STEPS, task.horizon)):
            batch.observe()
            requests = np.stack([sensors < 0, sensors >= 0, (sensors + step) % 2 == 0], axis=-1)
            batch.step(requests)
        batch.observe()
    except DivergenceError as error:
        raise ConfigurationError(
            f"these numbers together are not allowed: {error}; they lie too far apart or make a "
            "covariance singular"
        ) from None
