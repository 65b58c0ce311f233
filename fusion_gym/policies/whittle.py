"""Whittle's index of remote estimation: the value of a transmission of each single source."""

import numpy as np
from numpy.typing import NDArray

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.core.knowledge import Knowledge, Signals
from fusion_gym.core.task import Task
from fusion_gym.policies.base import Requests, Stateless, check_at_most, strongest
from fusion_gym.solvers.task import source_problems
from fusion_gym.solvers.whittle import index_table


class WhittleIndex(Stateless):
    r"""Request the sources whose Whittle index reaches the price of a transmission.

    The index of a source with error e and channel state s is the price λ at which transmission and
    silence cost its single optimum the same. If the thresholds grow with the price, the index is
    the inverse of λ ↦ k(s; λ); the thresholds are solved at 32 prices and interpolated. For one
    source and a fixed price the rule is the stationary optimum. For several sources that share a
    network it is Whittle's heuristic, which is asymptotically optimal in similar problems but not
    in general.

    At a price of zero it requests the sources of the highest index.

    Args:
        task: the task; a text cannot set it.
        price: p >= 0 of a token; None for the task's own.
        at_most: most sources requested in a step; None: one with ``access="single"``, else all.

    Raises:
        ConfigurationError: another system than remote estimation, an unstable source, or
            thresholds that do not grow with the price.

    Equation:
        $$
        \lambda_i(e)=\inf\{\lambda:\ k_i(\lambda)\ge|e|\},\qquad \delta_i(t)=1\Rightarrow
        \lambda_i(e_i)/c_i\ge p
        $$

        kᵢ(λ) is the optimal threshold of the single source i at the price λ of a transmission, for
        the channel's last state; p is ``price``, c the tokens of a transmission. With ``at_most``,
        the sources of the highest index per token.

    Assumes: independent sources with |a| <= 1, whose model is true.

    Source: P. Whittle, "Restless bandits: activity allocation in a changing world", Journal of
    Applied Probability 25A, 1988.

    Example: ``whittle:price=5`` in ``fusion_gym/RemoteEstimation-v1 sensors=2 cost_weight=5.0``.
    """

    def __init__(self, task: Task, price: float | None = None, at_most: int | None = None) -> None:
        check_at_most("at_most", at_most)
        problems = source_problems(task)
        self._at_most = 1 if at_most is None and task.network.access == "single" else at_most
        fixed = task.reward.price.fixed if price is None else price
        self._price = validation.number("price", fixed, at_least=0.0)
        self._cost = task.network.bucket.cost
        self._tables = [index_table(number, problem) for number, problem in enumerate(problems)]

    @property
    def knowledge(self) -> Knowledge:
        """The class of a sensor, or with ``at_most``, which compares sources, of a scheduler."""
        return "own" if self._at_most is None else "scheduler"

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        index = self.index(signals["innovation"][:, 0], signals["channel_state"]) / self._cost
        return strongest(index, index >= self._price, self._at_most, signals["age"])

    def index(self, error: Array, channel: NDArray[np.int64]) -> Array:
        """Return the price of a transmission (sensors, N) at which each source is indifferent.

        Args:
            error: errors of the sources (sensors, N).
            channel: channel states (sensors, N).
        """
        result = np.empty(error.shape)
        for source, (prices, thresholds) in enumerate(self._tables):
            size = np.abs(error[source])
            for state, reached in enumerate(thresholds.T):
                here = channel[source] == state
                inside = np.interp(size[here], reached, prices)
                # Outside the table the index grows as the square of the error, which is exact
                # for small errors.
                scale = np.clip(size[here], None, reached[0]) / reached[0]
                beyond = np.maximum(size[here] / reached[-1], 1.0)
                result[source, here] = inside * scale**2 * beyond**2
        return result
