"""A model-based reference: weigh what every possible transmission would be worth in a few steps."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.core.system import Signals
from fusion_gym.core.task import Task
from fusion_gym.policies.base import Requests
from fusion_gym.validation import ConfigurationError


class Lookahead:
    """Takes the transmissions with the least expected error over the next steps and price.

    A coordinator that knows all new measurements has the best estimate x̂* by delivering them all.
    Whatever it lets through, x̂, the fused error's second moment is the unavoidable part plus
    |x̂* - x̂|², so a set of transmissions is worth what it takes off the weighted sum of that
    distance over ``steps`` times, with no noise and no further transmission in between. It asks
    for the set with the least of that sum plus ``price`` for each token spent.

    It uses the task's model through the system itself (``deliver``, and ``sense`` with zero
    noise), so it works for every system; exact for linear systems, plausible for others. It looks
    at no true state: only the fused estimates of the states it makes up are read. This is neither
    an optimum nor a bound, but a policy that knows the model.

    Raises:
        ConfigurationError: fewer than one step, a negative price, or information other than
            "sensors".
    """

    def __init__(self, task: Task, price: float = 0.01, steps: int = 4) -> None:
        self.steps = validation.integer("steps", steps, at_least=1)
        self.price = validation.number("price", price, at_least=0.0)
        if task.information != "sensors":
            raise ConfigurationError(
                f"information = {task.information!r} is not allowed with policy 'lookahead': it "
                "must be 'sensors', for it weighs the new measurements"
            )
        self._task = task
        single = task.access == "single"
        patterns = np.array(list(product((False, True), repeat=task.sensors)))
        self._patterns = patterns[patterns.sum(1) <= 1] if single else patterns

    def reset(self, num_envs: int, seed: int = 0) -> None:
        """Nothing to forget."""

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        state: Any = signals["state"]
        tokens, step, admitted = signals["tokens"], signals["step"], signals["admitted"]
        runs = len(tokens)
        best = self._expect(state, np.ones((self._task.sensors, runs), dtype=np.bool_))
        cost = np.full((len(self._patterns), runs), np.inf)
        for place, pattern in enumerate(self._patterns):
            wanted = np.broadcast_to(pattern[:, None], (self._task.sensors, runs)) & admitted
            granted, spent, _ = self._task.bucket.grant(tokens, wanted, step)
            distance = self._expect(state, granted) - best
            weights = self._task.reward.state_weights
            cost[place] = (weights * (distance * distance).sum(0)).sum(0) + self.price * spent
            # What the network would deny is no choice of its own.
            cost[place, (granted != pattern[:, None]).any(0)] = np.inf
        return np.ascontiguousarray(self._patterns[cost.argmin(0)].T)

    def _expect(self, state: Any, granted: NDArray[np.bool_]) -> Array:
        """Fused means (steps, n, N) after these grants, then without noise or transmissions."""
        system = self._task.system
        silence = np.zeros_like(granted)
        still = np.zeros((system.noise_channels, granted.shape[1]))
        delivered = system.deliver(state, granted)
        means = [system.fused(delivered)[0]]
        for _ in range(self.steps - 1):
            delivered = system.deliver(system.sense(delivered, still), silence)
            means.append(system.fused(delivered)[0])
        return np.stack(means)
