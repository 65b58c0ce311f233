"""A reference policy that improves a base policy by simulations of its first decisions."""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array, take_runs
from fusion_gym.core.knowledge import Signals
from fusion_gym.core.memory import Memory, Owner
from fusion_gym.core.network import NetworkState
from fusion_gym.core.observation import ObservationLayout
from fusion_gym.core.runs import Branch, Position, State, rank_requests
from fusion_gym.core.task import Task
from fusion_gym.policies.base import Policy, Requests, check_price, guard, owner_of
from fusion_gym.policies.registry import make_policy
from fusion_gym.policies.rules import beliefs_of, check_owner, knows


class Imagination:
    """A maker of simulated runs, whose hidden parts are drawn from the beliefs.

    Args:
        task: the task.
        memory: the scheduler's memory.
        layout: layout of the observation.

    Raises:
        ConfigurationError: a plant that cannot be drawn.
    """

    def __init__(self, task: Task, memory: Memory, layout: ObservationLayout) -> None:
        self._task, self._memory, self._layout = task, memory, layout
        if task.network.acknowledgement < 1.0:
            why = "simulations do not have what the sensors suppose"
            value = task.settings.get("acknowledgements")
            raise validation.refusal("acknowledgements", value, f"'perfect', because {why}", "here")
        self._of_plant = task.plant.draw_channels
        if self._of_plant is None:
            raise validation.ConfigurationError(
                f"{type(task.plant).__name__} is not allowed here: it must offer 'draw', which "
                "draws the truth and future noise from their distributions"
            )
        self._first = self._of_plant + task.network.draw_channels
        self._each = task.plant.noise_channels + task.network.noise_channels

    def channels(self, steps: int) -> int:
        """Return the number of standard normals that :meth:`begin` takes for ``steps`` steps."""
        return self._first + steps * self._each

    def begin(
        self, signals: Signals, runs: NDArray[np.int64], normals: Array
    ) -> tuple[Branch, Array]:
        """Return simulated runs and the noise of their steps (steps, channels of a step, R).

        Args:
            signals: signals of N runs.
            runs: numbers of R of these runs, with repetitions (R,).
            normals: standard normals (channels, R).
        """
        task, beliefs = self._task, beliefs_of(signals, own=False)
        first, rest = normals[: self._first], normals[self._first :]
        mean, covariance = (take_runs(part[0], runs) for part in beliefs.best)

        states = {name: take_runs(own, runs) for name, own in beliefs.memory_states.items()}
        steps, estimate = signals["step"][runs], take_runs(signals["estimate"], runs)
        own, rest_of_first = first[: self._of_plant], first[self._of_plant :]
        plant = task.plant.draw(estimate.measurement, mean, covariance, own, steps + 1.0)
        tokens = signals["energy" if task.network.bucket.per_sensor else "tokens"][..., runs]
        known = NetworkState(tokens, signals["queue"][:, runs], signals["admitted"][:, runs])
        if task.network.channel is not None and task.network.channel.states > 1:
            known.channel = signals["channel_state"][..., runs].reshape(-1, len(runs))
        if task.network.bucket.rate_range is not None:
            known.token_rate = signals["token_rate"][runs]
        network = rank_requests(task, task.network.draw(known, rest_of_first), estimate)
        control = signals["control"][:, runs] if task.controller else None
        age, none = signals["age"], np.zeros(len(runs))  # which no decision uses
        state = State(plant, estimate, network, age[:, runs], none, control=control)
        limit = np.full_like(steps, task.horizon)
        position = Position(state, signals["price"][runs], steps, limit)
        branch = Branch(task, self._memory.with_states(states), self._layout, position)
        return branch, rest.reshape(-1, self._each, len(runs))


_STREAM = 0x726F6C6C6F7574  # makes simulations independent of the noise of the same seed
_SAMPLES, _STEPS = 1000, 200  # at most
_LANES = 16384  # simulations in one batch, unless one run needs more


class Rollout:
    r"""Request by the best first decision of simulations that continue with the policy `base`.

    At every step the first decisions are silence, each single sensor, and the base's requests.
    After each of them the base continues for ``steps`` steps, in ``samples`` simulations. The
    simulations start from the beliefs (:meth:`~fusion_gym.core.plant.Plant.draw`) and draw
    their own noise, the same for every decision; they use neither the truth nor the coming noise
    and losses. The rule takes the decision of the least mean cost among the decisions that beat the
    base's decision by ``doubt`` standard errors of the difference. With ``doubt=0`` it takes the
    least cost; random differences then make it transmit too often. A simulation does not end with
    the episode.

    The cost is error_weight · ‖x* - x̂‖² + ``price`` for each token, with the reward's weights and
    x* the best estimate at that step. If x* is the conditional mean, the cost is the expected
    squared error minus a part that no decision changes. Where the error of a closed loop
    does not rank policies as its cost does, it is the simulated cost of state and input instead.

    With infinite ``samples`` and ``steps`` and a true model, its cost is at most the base's cost.
    One step takes samples · (steps + 1) · (sensors + 1) steps of the base.

    Args:
        task: the task; a text cannot set it.
        base: policy that is improved; it takes the whole text after ``base=``.
        samples: M >= 1, simulations of each decision.
        steps: h >= 1, steps of the base after a decision.
        price: p >= 0 of a token; None for the task's own.
        doubt: standard errors by which a decision must beat the base's.
        trust: whether a base ``model:PATH`` may run code of its file; a text cannot set it.

    Raises:
        ConfigurationError: a number that is not allowed; a base that cannot be made, that has
            variables, or that uses each sensor's own beliefs; a task whose policies do not see the
            sensors, or whose system cannot draw its hidden parts.

    Equation:
        $$
        a=\arg\min_{a}\ \frac{1}{M}\sum_{m=1}^{M}\sum_{k=0}^{h}\left(\lVert x^\star_m(t+k)-\hat
        x_m(t+k)\rVert_W^2+p\,C_m(t+k)\right)
        $$

        The first decision a is silence, one sensor, or the base's requests; after it the base
        continues. m counts the ``samples`` M, h is ``steps``, C are the tokens spent, p is
        ``price``, W the weights of the reward's error term. A decision other than the base's must
        be better by ``doubt`` standard errors of the difference.

    Assumes: a model that is true, since the simulations use it.

    Source: D. P. Bertsekas, J. N. Tsitsiklis and C. Wu, "Rollout algorithms for combinatorial
    optimization", Journal of Heuristics 3, 1997.

    Example: ``rollout:samples=8,price=0.03,base=value_of_information:price=0.006,at_most=1`` in
    ``fusion_gym/TobitOscillator-v1 filter=tobit random_start=True token_rate=2 memory=True``.
    """

    stateless: ClassVar[bool] = False  # it draws
    memory_owner: ClassVar[Owner] = "scheduler"
    rest: ClassVar[str] = "base"

    def __init__(
        self,
        task: Task,
        base: str,
        samples: int = 16,
        steps: int = 8,
        price: float | None = None,
        doubt: float = 1.0,
        trust: bool = False,
    ) -> None:
        self.samples = validation.integer("samples", samples, at_least=1, at_most=_SAMPLES)
        self.steps = validation.integer("steps", steps, at_least=1, at_most=_STEPS)
        check_price("price", price)
        self.price = price
        self.doubt = validation.number("doubt", doubt, at_least=0.0)
        check_owner(task, own=False)
        if not isinstance(base, str):
            raise validation.refusal("base", base, "the text that names a policy")
        self.base: Policy = make_policy(base, task, trust=trust)
        if not getattr(self.base, "stateless", False):
            why = "because simulated episodes call it"
            allowed = f"a policy that reads only signals of the present step, {why}"
            raise validation.refusal("base", base, allowed)
        if owner_of(self.base) == "own":
            allowed = "a scheduler's policy, because simulations begin with its belief"
            raise validation.refusal("base", base, allowed)
        task.refuse_delay("simulations begin without the packets under way", "with this policy")
        memory = Memory(task, "scheduler")
        self._task, self.knowledge = task, knows(task, own=False)
        self._decision = guard(self.base, task)
        self._weights = task.reward.error_weight * task.reward.state_weights
        self._imagination = Imagination(task, memory, ObservationLayout(task))
        self.reset(0)

    def reset(self, runs: int, seed: int = 0) -> None:
        """Restart the random streams; run i simulates with the stream of ``seed + i``."""
        self.base.reset(runs, seed)
        self._generators = [
            np.random.default_rng([item, _STREAM]) for item in range(seed, seed + runs)
        ]

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        runs = len(signals["tokens"])
        if len(self._generators) != runs:
            self.reset(runs)
        choices, own = self._choices(np.asarray(self._decision(signals)))
        size = max(1, _LANES // (len(choices) * self.samples))
        best = np.empty(runs, dtype=np.int64)
        for first in range(0, runs, size):
            block = np.arange(first, min(first + size, runs))
            cost = self._cost(signals, block, choices[..., block])
            best[block] = self._least(cost, own[block])
        return np.ascontiguousarray(choices[best, :, np.arange(runs)].T)

    def _choices(self, own: Requests) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
        """Return first decisions (choices, sensors, N) and the number of the base's (N,)."""
        if own.dtype != np.bool_:
            allowed = "a policy that assigns no channels"
            raise validation.refusal("base", type(self.base).__name__, allowed)
        sensors, runs = own.shape
        single = np.eye(sensors + 1, sensors, k=-1, dtype=np.bool_)  # silence first
        choices = np.repeat(single[..., None], runs, axis=-1)
        several = own.sum(0) > 1
        if several.any():
            choices = np.concatenate((choices, own[None]))
        return choices, np.where(several, sensors + 1, own.any(0) * (1 + own.argmax(0)))

    def _least(self, cost: Array, own: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the decision (R,), from costs (choices, R, samples) and the base's (R,)."""
        gain = cost[own, np.arange(len(own))] - cost
        error = gain.std(-1) / np.sqrt(self.samples)
        mean = gain.mean(-1)
        worth: Array = np.where(mean > self.doubt * error, mean, 0.0)
        result = worth.argmax(0)
        return np.where(worth.max(0) > 0.0, result, own)

    def _cost(self, signals: Signals, runs: NDArray[np.int64], choices: NDArray[np.bool_]) -> Array:
        """Return costs (choices, R, samples) of first decisions (choices, sensors, R)."""
        count, samples = len(choices), self.samples
        drawn = self._imagination.channels(self.steps)
        normals = np.stack(
            [self._generators[run].standard_normal((drawn, samples)) for run in runs.tolist()], 1
        ).reshape(drawn, -1)
        lanes = np.tile(np.arange(len(runs) * samples), count)
        imagined, noise = self._imagination.begin(signals, runs.repeat(samples), normals)
        branch = imagined.branch(lanes)
        requests = np.moveaxis(choices, 0, 1).repeat(samples, axis=-1).reshape(len(choices[0]), -1)
        price = branch.price if self.price is None else self.price
        cost = np.zeros(len(lanes))
        for step in range(self.steps + 1):
            best = branch.beliefs().best.mean[0]
            outcome = branch.deliver(requests)
            missed = best - self._task.estimator.mean(branch.delivered.estimate)
            error = linalg.weighted_square(missed, self._weights)
            if not self._task.equivalent_error:
                error = -outcome.reward_error
            cost += error + price * outcome.cost
            if step < self.steps:
                branch.sense(noise[step].take(lanes, axis=-1))
                requests = np.asarray(self._decision(branch.signals()))
        return cost.reshape(count, len(runs), samples)
