"""The policy that attains the solved optimum of a remote-estimation task."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np

from fusion_gym.core.reward import Price
from fusion_gym.core.system import Knowledge, Signals
from fusion_gym.core.task import Task
from fusion_gym.policies.base import Requests
from fusion_gym.solvers.task import solve_task


class OptimalPolicy:
    """Requests as the solved optimum of a task does; it looks at errors, channels and tokens.

    ``criterion`` as in :func:`solve_task`: the exact optimum of an episode knows the steps that
    are left, the stationary one does not. ``price`` of a token stands for the task's own.
    ``optimum`` holds the cost that it attains.

    Assumes: remote estimation of one source or two, whose model is true.

    Source: J. Chakravorty and A. Mahajan, "Remote estimation over a packet-drop channel with
    Markovian state", IEEE Trans. Automatic Control 65, 2020, for one source
    (:mod:`fusion_gym.solvers`).

    Raises:
        ConfigurationError: a task that is not solved here, or a negative price.
    """

    stateless: ClassVar[bool] = True

    def __init__(self, task: Task, criterion: str = "finite", price: float | None = None) -> None:
        if price is not None:
            reward = dataclasses.replace(task.reward, price=Price.create(price))
            task = dataclasses.replace(task, reward=reward)
        self.optimum = solve_task(task, criterion)
        # Thresholds are each source's own; a table looks at both errors.
        separate = self.optimum.threshold is not None
        self.knowledge: Knowledge = "own" if separate else "coordinator"

    def reset(self, runs: int, seed: int = 0) -> None:
        """Nothing to forget."""

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        optimum = self.optimum
        error = np.abs(signals["innovation"][:, 0])
        level = optimum.tokens.index(signals["tokens"])
        if optimum.threshold is not None:
            threshold = optimum.threshold
            step = np.minimum(signals["step"], len(threshold) - 1)
            sensor = np.arange(len(error))[:, None]
            request: Requests = error >= threshold[step, sensor, signals["channel_state"], level]
            return request
        assert optimum.choice is not None
        assert optimum.grids is not None
        step = np.minimum(signals["step"], len(optimum.choice) - 1)
        one, two = (
            np.minimum(np.rint(e / grid.points[1]), len(grid.points) - 1).astype(np.int64)
            for e, grid in zip(error, optimum.grids, strict=True)
        )
        chosen = optimum.choice[step, one, two, level]
        return (chosen >> np.arange(2)[:, None] & 1).astype(np.bool_)
