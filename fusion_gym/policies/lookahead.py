"""A reference policy that compares the effects of all transmissions over the next steps."""

import warnings
from typing import ClassVar

import numpy as np

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.knowledge import Signals
from fusion_gym.core.memory import Owner
from fusion_gym.core.task import Task
from fusion_gym.policies.base import Requests, Stateless
from fusion_gym.policies.belief_rule import check_owner, knows
from fusion_gym.policies.planning import PlanningModel, transmission_sets
from fusion_gym.validation import ConfigurationError

_MOST_TOGETHER = 8  # largest number of sensors for the comparison of all sets
_MOST_GREEDY = 40  # largest number of sensors for the greedy search


class Lookahead(Stateless):
    r"""Request the set of sensors with the least expected error and price over the next steps.

    The best estimate x* uses all new measurements, and with memory all earlier ones. The second
    moment of the fused error is a part that no decision changes plus ‖x* - x̂‖². The cost of a set
    is the sum of this distance over ``steps`` steps plus ``price`` for each token. The sum has the
    weights of the reward and supposes no noise and no further transmission. Where packets may be
    lost it is the mean over the possible deliveries of the set.

    Up to 8 sensors, every set is compared. From 9 to 40 sensors the search is ``greedy``, with a
    warning: it adds the transmission that lowers the cost most until none lowers it. It weighs
    each transmission by its probability of arrival as if the earlier ones had arrived.

    The policy predicts with the task's own system (:class:`PlanningModel`): exactly for linear
    systems, approximately for others. It is neither an optimum nor a bound.

    Args:
        task: the task, whose model it uses; a text cannot set it.
        price: p >= 0 of a token, in the reward's units.
        steps: h >= 1, steps over which the distance is summed.

    Raises:
        ConfigurationError: fewer than one step, a negative price, information other than
            "sensors", or more than 40 sensors, unless only one transmits at a time.

    Equation:
        $$
        S=\arg\min_{S}\ \mathrm{E}\sum_{k=0}^{h-1}\lVert x^\star(t+k)-\hat
        x_S(t+k)\rVert_W^2+p\sum_{s\in S}c_s
        $$

        x* and x̂_S are the best estimate and the centre's estimate after the packets of S, both
        predicted without noise and transmissions for h (``steps``) steps. The expectation is over
        the deliveries. W are the weights of the reward's error term, p is ``price``, c the tokens
        of a transmission. S runs over all sets that the network would grant.

    Assumes: x* is the conditional mean given all measurements, a model that is true, and no
    further transmission within the steps.

    Source: no single paper; receding-horizon control of the decisions, with the value of
    :mod:`fusion_gym.core.beliefs`.

    Example: ``lookahead:price=0.03`` in ``fusion_gym/TobitOscillator-v1 filter=tobit
    random_start=True token_rate=2 memory=True``.
    """

    memory_owner: ClassVar[Owner] = "scheduler"

    def __init__(self, task: Task, price: float = 0.01, steps: int = 4) -> None:
        self.steps = validation.integer("steps", steps, at_least=1, at_most=validation.MOST_STEPS)
        self.price = validation.number("price", price, at_least=0.0)
        check_owner(task, own=False)
        self._task, self.knowledge = task, knows(task, own=False)
        self.greedy = task.sensors > _MOST_TOGETHER and task.network.access != "single"
        if self.greedy and task.sensors > _MOST_GREEDY:
            raise ConfigurationError(
                f"sensors = {task.sensors} is not allowed with policy 'lookahead': it must be at "
                f"most {_MOST_GREEDY}, because a step may cost the cube of their number; "
                "'value_of_information' evaluates single sensors"
            )
        if self.greedy:
            warnings.warn(
                f"policy 'lookahead' adds one transmission after another for {task.sensors} "
                f"sensors: it compares all sets of at most {_MOST_TOGETHER} sensors",
                stacklevel=2,
            )
            return
        self._sets = transmission_sets(task)
        # The sets with each sensor, and the same sets without it.
        number = self._sets @ (1 << np.arange(task.sensors))
        order = np.argsort(number)
        self._sent = [np.flatnonzero(selected) for selected in self._sets.T]
        self._without = [
            order[np.searchsorted(number, number[sent] - (1 << sensor), sorter=order)]
            for sensor, sent in enumerate(self._sent)
        ]

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        model = PlanningModel(self._task, signals)
        best = model.best_means(self.steps)
        return self._greedy_set(model, best) if self.greedy else self._best_set(model, best)

    def _best_set(self, model: PlanningModel, best: Array) -> Requests:
        everyone = np.ones((self._task.sensors, model.runs), dtype=np.bool_)
        grants = [model.grant(selected & everyone) for selected in self._sets[:, :, None]]
        cost = self._expected_error(model, best)
        cost = cost + self.price * np.stack([g.spent for g in grants])
        for place, selected in enumerate(self._sets[:, :, None]):
            # A set that the network would deny is no choice.
            cost[place, (grants[place].granted != selected).any(0)] = np.inf
        return np.ascontiguousarray(self._sets[cost.argmin(0)].T)

    def _greedy_set(self, model: PlanningModel, best: Array) -> Requests:
        sensors, lanes = self._task.sensors, np.arange(model.runs)
        arrival = np.ones((sensors, model.runs)) if model.arrival is None else model.arrival
        selected = np.zeros((sensors, model.runs), dtype=np.bool_)
        spent, error = np.zeros(model.runs), self._error(model, selected, best)
        for _ in range(sensors):
            saved = np.full(selected.shape, -np.inf)
            after, paid = np.empty(selected.shape), np.empty(selected.shape)
            for sensor in range(sensors):
                added = selected.copy()
                added[sensor] = True
                granted, paid[sensor], *_ = model.grant(added)
                after[sensor] = self._error(model, added, best)
                gain = arrival[sensor] * (error - after[sensor])
                gain -= self.price * (paid[sensor] - spent)
                possible = ~selected[sensor] & (granted == added).all(0)
                saved[sensor] = np.where(possible, gain, -np.inf)
            place = saved.argmax(0)
            worth = saved[place, lanes] > 0.0
            if not worth.any():
                break
            selected[place[worth], lanes[worth]] = True
            error = np.where(worth, after[place, lanes], error)
            spent = np.where(worth, paid[place, lanes], spent)
        return selected

    def _expected_error(self, model: PlanningModel, best: Array) -> Array:
        """Return the weighted squared distance (sets, N) to the best estimate over the steps.

        It is the mean over the deliveries of each set; packets are lost independently.

        Args:
            model: the model of this step.
            best: best estimates (steps, n, N).
        """
        everyone = np.ones((self._task.sensors, model.runs), np.bool_)
        error = np.empty((len(self._sets), model.runs))
        for place, selected in enumerate(self._sets[:, :, None]):
            error[place] = self._error(model, selected & everyone, best)
        if model.arrival is not None:
            for sensor, arrives in enumerate(model.arrival):
                sent, lost = self._sent[sensor], self._without[sensor]
                error[sent] = arrives * error[sent] + (1.0 - arrives) * error[lost]
        return error

    def _error(self, model: PlanningModel, arriving: Requests, best: Array) -> Array:
        """Return the distance (N,) if these packets (sensors, N) arrive."""
        reward = self._task.reward
        distance = model.fused_means(arriving, self.steps) - best
        weights = reward.error_weight * reward.state_weights
        return linalg.total(weights * linalg.total(distance * distance, 0))
