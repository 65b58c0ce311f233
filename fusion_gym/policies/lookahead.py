"""A model-based reference: weigh what every possible transmission would be worth in a few steps."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from fusion_gym import validation
from fusion_gym.core.knowledge import Knowledge
from fusion_gym.core.system import Signals
from fusion_gym.core.task import Task
from fusion_gym.policies.base import Requests
from fusion_gym.policies.planning import Model, transmission_sets
from fusion_gym.validation import ConfigurationError


class Lookahead:
    """Takes the transmissions with the least expected error over the next steps and price.

    A coordinator that knows all new measurements has the best estimate x̂* by delivering them all.
    Whatever it lets through, x̂, the fused error's second moment is the unavoidable part plus
    |x̂* - x̂|², so a set of transmissions is worth what it takes off the weighted sum of that
    distance over ``steps`` times, with no noise and no further transmission in between. It asks
    for the set with the least of that sum plus ``price`` for each token spent.

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

    def reset(self, runs: int, seed: int = 0) -> None:
        """Nothing to forget."""

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        model = Model(self._task, signals)
        everyone = np.ones((self._task.sensors, model.runs), dtype=np.bool_)
        best = model.fused_means(everyone, self.steps)
        cost = np.full((len(self._sets), model.runs), np.inf)
        for place, chosen in enumerate(self._sets[:, :, None]):
            granted, spent, _ = model.grant(chosen & everyone)
            distance = model.fused_means(granted, self.steps) - best
            weights = self._task.reward.state_weights
            cost[place] = (weights * (distance * distance).sum(0)).sum(0) + self.price * spent
            # What the network would deny is no choice of its own.
            cost[place, (granted != chosen).any(0)] = np.inf
        return np.ascontiguousarray(self._sets[cost.argmin(0)].T)
