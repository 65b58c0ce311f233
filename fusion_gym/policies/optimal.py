"""The policy that attains the solved optimum of a remote-estimation task."""

import dataclasses

import numpy as np

from fusion_gym.core.knowledge import Knowledge, Signals
from fusion_gym.core.reward import Price
from fusion_gym.core.task import Task
from fusion_gym.policies.base import Requests, Stateless
from fusion_gym.solvers.task import solve_task


class OptimalPolicy(Stateless):
    r"""Request by the optimum of the task.

    The exact optimum of an episode depends on the remaining steps, the stationary optimum does not
    (:func:`solve_task`). ``optimum`` is the solution with its cost.

    Args:
        task: the task; a text cannot set it.
        criterion: ``finite``, the optimum of an episode, or ``average``, the stationary one.
        price: p >= 0 of a token; None for the task's own.

    Raises:
        ConfigurationError: a task that is not solved here, or a negative price.

    Equation:
        $$
        V_t(e)=\min\left\{w\,e^2+\mathrm{E}\,V_{t+1}(a
        e+\nu),\ \ p+\mathrm{E}\,V_{t+1}(\nu)\right\}
        $$

        This is one source with a perfect channel, in the literature's order of events: e is the
        error without a transmission, a the source's coefficient, ν its noise, w the weight of the
        error, p the price of a transmission. The second choice is the request; it is best exactly
        where |e| is at least a threshold. The solver also has the channel's state, its losses, the
        tokens and a second source.

    Assumes: remote estimation of one or two sources, whose model is true.

    Source: J. Chakravorty and A. Mahajan, "Remote estimation over a packet-drop channel with
    Markovian state", IEEE Trans. Automatic Control 65, 2020, for one source
    (:mod:`fusion_gym.solvers`).

    Example: ``optimal`` in ``fusion_gym/RemoteEstimation-v1``.
    """

    def __init__(self, task: Task, criterion: str = "finite", price: float | None = None) -> None:
        if price is not None:
            reward = dataclasses.replace(task.reward, price=Price.create(price))
            task = dataclasses.replace(task, reward=reward)
        self.optimum = solve_task(task, criterion)

    @property
    def knowledge(self) -> Knowledge:
        """The class of a sensor with thresholds, and of a scheduler with a table of two sources."""
        return "own" if self.optimum.threshold is not None else "scheduler"

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        optimum = self.optimum
        error = np.abs(signals["innovation"][:, 0])
        level = optimum.tokens.index(signals["tokens"])
        if optimum.threshold is not None:
            threshold = optimum.threshold
            step = np.minimum(signals["step"], len(threshold) - 1)
            sensor = np.arange(len(error))[:, None]
            return error >= threshold[step, sensor, signals["channel_state"], level]
        assert optimum.choice is not None
        assert optimum.grids is not None
        step = np.minimum(signals["step"], len(optimum.choice) - 1)
        first, two = (
            np.minimum(np.rint(e / grid.points[1]), len(grid.points) - 1).astype(np.int64)
            for e, grid in zip(error, optimum.grids, strict=True)
        )
        choice = optimum.choice[step, first, two, level]
        return (choice >> np.arange(2)[:, None] & 1).astype(np.bool_)
