"""A clairvoyant reference: the best schedule of transmissions once all noise is known.

The search is a beam search: of every kept candidate all sets of transmissions are tried, and the
``width`` best candidates of each episode are kept. A candidate is a schedule up to the present
step with what it led to: the system's state, the tokens left and the cost so far.

Candidates that agree in their last few transmissions and in their tokens have all but the same
future. Where not all can be kept, the cheapest of each such group comes before the second of any,
so that the beam does not fill up with near copies of one schedule.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym import validation
from fusion_gym.arrays import Array, take_runs
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.policies.planning import transmission_sets
from fusion_gym.validation import ConfigurationError

_CANDIDATES = 8192  # kept side by side, unless the width of one episode is larger
_REMEMBERED = 3  # transmissions by which candidates are told apart


@dataclass(frozen=True)
class Schedules:
    """Schedules that a search found for E episodes of horizon H.

    ``granted`` (H, sensors, E) bool · ``cost`` (E,), each one's error_weight · weighted squared
    error plus price · tokens, summed over the episode · ``exact`` (E,) bool, whether the search
    dropped no candidate: then no schedule of that episode costs less.
    """

    granted: NDArray[np.bool_]
    cost: Array
    exact: NDArray[np.bool_]


def find_schedules(task: Task, price: float, width: int, episodes: int, seed: int) -> Schedules:
    """For each of the ``episodes`` from ``seed`` on, the best schedule that a beam search finds.

    It looks for the least error_weight · weighted squared error plus ``price`` · tokens, summed
    over the episode, under the task's token bucket and access rule, and keeps ``width``
    candidates. The optimum, the least cost of all schedules, bounds every policy from below. What
    is found is that optimum where the search dropped no candidate (:class:`Schedules`), which
    takes a short horizon. Otherwise it is a schedule that a clairvoyant can achieve: an upper value
    of the optimum and no bound. Neither says what a causal policy could reach: with the noise
    known, transmissions are chosen whose noise happens to cancel the error, so that the error may
    lie below the one that every measurement there is leaves to the best filter.

    Raises:
        ConfigurationError: a negative price, fewer than one candidate or episode, a negative seed,
            a task whose error is not the squared one, or more than 12 sensors that may transmit
            at once.
    """
    validation.number("price", price, at_least=0.0)
    validation.integer("width", width, at_least=1)
    validation.integer("episodes", episodes, at_least=1)
    validation.integer("seed", seed, at_least=0)
    if task.reward.error != "squared":
        raise ConfigurationError(
            f"error = {task.reward.error_kind!r} is not allowed with a hindsight schedule: it must "
            "be 'squared', for the error that the noise makes is what a clairvoyant knows"
        )
    block = max(1, _CANDIDATES // width)
    parts = [
        _Search(task, price, width, min(block, episodes - first), seed + first).run()
        for first in range(0, episodes, block)
    ]
    return Schedules(
        granted=np.concatenate([part.granted for part in parts], axis=-1),
        cost=np.concatenate([part.cost for part in parts]),
        exact=np.concatenate([part.exact for part in parts]),
    )


@dataclass(slots=True)
class _Candidates:
    """C candidates: the number of their ``episode``, ``tokens`` left, ``cost`` so far, and
    ``recent``, the last transmissions and their steps packed into one number; all (C,)."""

    episode: NDArray[np.int64]
    tokens: Array
    cost: Array
    recent: NDArray[np.int64]


@dataclass(slots=True)
class _Choices:
    """What candidates could do: ``parent``, its number, ``pattern``, the number of the set of
    transmissions, and what ``follows``; all (choices,)."""

    parent: NDArray[np.int64]
    pattern: NDArray[np.int64]
    follows: _Candidates


class _Search:
    """The search in some episodes side by side.

    Candidates of all episodes stand in one batch, those of an episode next to each other and by
    rising cost; episodes may have different numbers of them.
    """

    def __init__(self, task: Task, price: float, width: int, episodes: int, seed: int) -> None:
        self._task, self._price, self._width, self._episodes = task, price, width, episodes
        self._patterns = transmission_sets(task, "a hindsight schedule")
        self._weights = task.reward.error_weight * task.reward.state_weights
        self._code_bits = int(task.horizon * len(self._patterns)).bit_length()
        self._memory = (1 << min(_REMEMBERED, 62 // self._code_bits) * self._code_bits) - 1
        batch = EpisodeBatch.seeded(task, episodes, seed)
        self._state: Any = batch.state
        # Noise and access of all steps: nothing that the actions do changes them.
        self._noise, self._admitted = [], []
        silence = np.zeros((task.sensors, episodes), dtype=np.bool_)
        for _ in range(task.horizon):
            self._admitted.append(batch.admitted())
            batch.step(silence)
            self._noise.append(batch.noise().copy())

    def run(self) -> Schedules:
        """Search through the whole episodes."""
        task, episodes = self._task, self._episodes
        candidates = _Candidates(
            episode=np.arange(episodes),
            tokens=task.bucket.start(episodes),
            cost=np.zeros(episodes),
            recent=np.zeros(episodes, dtype=np.int64),
        )
        exact = np.ones(episodes, dtype=np.bool_)
        result: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []
        for step in range(task.horizon):
            choices = self._choices(candidates, step)
            stored = self._best(choices.follows)
            offered = np.bincount(choices.follows.episode, minlength=episodes)
            exact &= offered <= self._width
            parent, pattern = choices.parent[stored], choices.pattern[stored]
            candidates = take_runs(choices.follows, stored)
            result.append((parent, pattern))
            if step + 1 < task.horizon:
                delivered = task.system.deliver(
                    take_runs(self._state, parent), np.ascontiguousarray(self._patterns[pattern].T)
                )
                noise = self._noise[step].take(candidates.episode, axis=-1)
                self._state = task.system.sense(delivered, noise)
        # Each episode's cheapest candidate is its first.
        place = np.searchsorted(candidates.episode, np.arange(episodes))
        cost = candidates.cost[place]
        granted = np.empty((task.horizon, task.sensors, episodes), dtype=np.bool_)
        for step in reversed(range(task.horizon)):
            parent, pattern = result[step]
            granted[step] = self._patterns[pattern[place]].T
            place = parent[place]
        return Schedules(granted, cost, exact)

    def _choices(self, candidates: _Candidates, step: int) -> _Choices:
        """Every set of transmissions that the network would grant to every candidate."""
        task, result = self._task, []
        admitted = self._admitted[step].take(candidates.episode, axis=-1)
        steps = np.full(len(candidates.cost), step, dtype=np.int64)
        for number, pattern in enumerate(self._patterns[:, :, None]):
            granted, spent, tokens, _ = task.bucket.grant(
                candidates.tokens, pattern & admitted, steps
            )
            # What the network would deny is no choice of its own, whatever the queue.
            parent = np.flatnonzero((granted == pattern).all(0))
            if len(parent) == 0:
                continue
            delivered = task.system.deliver(
                take_runs(self._state, parent), granted.take(parent, axis=-1)
            )
            before = take_runs(candidates, parent)
            code = step * len(self._patterns) + number
            recent = (before.recent << self._code_bits | code) & self._memory
            follows = _Candidates(
                episode=before.episode,
                tokens=tokens[parent],
                cost=before.cost + self._error(delivered) + self._price * spent[parent],
                recent=recent if pattern.any() else before.recent,
            )
            result.append(_Choices(parent, np.full(len(parent), number), follows))
        return _join(result)

    def _error(self, delivered: Any) -> Array:
        """The weighted squared error (C,); infinite where it is no number."""
        error = self._task.system.truth(delivered) - self._task.system.fused(delivered)[0]
        weighted = (self._weights * (error * error)).sum(0)
        return np.where(np.isnan(weighted), np.inf, weighted)

    def _best(self, choices: _Candidates) -> NDArray[np.int64]:
        """The choices to keep, by episode and rising cost; ties go to the one listed first."""
        order = np.lexsort((choices.cost, choices.tokens, choices.recent, choices.episode))
        group = np.stack([choices.episode, choices.recent, choices.tokens])[:, order]
        opens = np.ones(len(order), dtype=np.bool_)
        opens[1:] = (group[:, 1:] != group[:, :-1]).any(0)
        behind = np.empty(len(order), dtype=np.bool_)
        behind[order] = ~opens
        order = np.lexsort((choices.cost, behind, choices.episode))
        episode = choices.episode[order]
        rank = np.arange(len(order)) - np.searchsorted(episode, episode)
        mask = order[rank < self._width]
        return mask[np.lexsort((choices.cost[mask], choices.episode[mask]))]


def _join(parts: list[_Choices]) -> _Choices:
    def joined(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(part.follows, name) for part in parts])

    return _Choices(
        parent=np.concatenate([part.parent for part in parts]),
        pattern=np.concatenate([part.pattern for part in parts]),
        follows=_Candidates(*(joined(field.name) for field in dataclasses.fields(_Candidates))),
    )
