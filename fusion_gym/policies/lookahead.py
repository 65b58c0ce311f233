"""A model-based reference: weigh what every possible transmission would be worth in a few steps."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.core.system import Knowledge, Signals
from fusion_gym.core.task import Task
from fusion_gym.policies.base import Requests
from fusion_gym.policies.planning import Model, transmission_sets
from fusion_gym.validation import ConfigurationError


class Lookahead:
    """Takes the transmissions with the least expected error over the next steps and price.

    A coordinator that knows all new measurements has the best estimate x̂* by delivering them all.
    Whatever it lets through, x̂, the fused error's second moment is the unavoidable part plus
    |x̂* - x̂|², so a set of transmissions is worth what it takes off the sum of that distance,
    weighted as in the reward, over ``steps`` times, with no noise and no further transmission in
    between. It asks for the set with the least of that sum plus ``price`` for each token spent.
    Where packets may be lost it takes the mean over what may arrive of the set: it knows the
    channel's probabilities and not what the channel is about to do.

    It uses the task's model through the system itself (:class:`Model`), so it works for every
    system; exact for linear systems, plausible for others. Every set of sensors is weighed, at
    most 2^12. This is neither an optimum nor a bound, but a policy that knows the model.

    Raises:
        ConfigurationError: fewer than one step, a negative price, information other than
            "sensors", or more than 12 sensors that may transmit at once.
    """

    knowledge: ClassVar[Knowledge] = "coordinator"

    def __init__(self, task: Task, price: float = 0.01, steps: int = 4) -> None:
        self.steps = validation.integer("steps", steps, at_least=1)
        self.price = validation.number("price", price, at_least=0.0)
        if task.information != "sensors":
            raise ConfigurationError(
                f"information = {task.information!r} is not allowed with policy 'lookahead': it "
                "must be 'sensors', for it weighs the new measurements"
            )
        self._task = task
        self._sets = transmission_sets(task, "policy 'lookahead'")
        # The sets with each sensor, and the same sets without it.
        number = self._sets @ (1 << np.arange(task.sensors))
        order = np.argsort(number)
        self._sent = [np.flatnonzero(chosen) for chosen in self._sets.T]
        self._without = [
            order[np.searchsorted(number, number[sent] - (1 << sensor), sorter=order)]
            for sensor, sent in enumerate(self._sent)
        ]

    def reset(self, runs: int, seed: int = 0) -> None:
        """Nothing to forget."""

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        model = Model(self._task, signals)
        everyone = np.ones((self._task.sensors, model.runs), dtype=np.bool_)
        grants = [model.grant(chosen & everyone) for chosen in self._sets[:, :, None]]
        cost = self._expected_error(model) + self.price * np.stack([g.spent for g in grants])
        for place, chosen in enumerate(self._sets[:, :, None]):
            # What the network would deny is no choice of its own.
            cost[place, (grants[place].granted != chosen).any(0)] = np.inf
        return np.ascontiguousarray(self._sets[cost.argmin(0)].T)

    def _expected_error(self, model: Model) -> Array:
        """Weighted squared distance (sets, N) to the best estimate, summed over the steps.

        The mean over what the channel lets arrive of each set: packets are lost independently.
        """
        reward, everyone = self._task.reward, np.ones((self._task.sensors, model.runs), np.bool_)
        best = model.fused_means(everyone, self.steps)
        weights = reward.error_weight * reward.state_weights
        error = np.empty((len(self._sets), model.runs))
        for place, chosen in enumerate(self._sets[:, :, None]):
            distance = model.fused_means(chosen & everyone, self.steps) - best
            error[place] = (weights * (distance * distance).sum(0)).sum(0)
        if model.arrival is not None:
            for sensor, arrives in enumerate(model.arrival):
                sent, lost = self._sent[sensor], self._without[sensor]
                error[sent] = arrives * error[sent] + (1.0 - arrives) * error[lost]
        return error
