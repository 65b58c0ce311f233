"""The batched core: N episodes of one task side by side, with their noise, tokens and rewards."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from numpy.typing import NDArray

from fusion_gym.arrays import Array, merge_runs
from fusion_gym.core.admission import require_finite
from fusion_gym.core.beliefs import Owner, arrived
from fusion_gym.core.memory import Memory
from fusion_gym.core.observation import ObservationLayout
from fusion_gym.core.runs import Outcome, Runs
from fusion_gym.core.system import System
from fusion_gym.core.task import Task

_LONGEST_BLOCK = 256  # steps of noise that are drawn and kept at a time


class EpisodeBatch(Runs):
    """N runs of a :class:`~fusion_gym.core.task.Task`, advanced together.

    Each run draws all its noise from its own generator, in blocks and whatever the actions: a
    seed fixes an episode's noise (common random numbers), and a run does not depend on what
    stands beside it (batch invariance).

    ``remember`` says whose memory is kept, the scheduler's or every sensor's own; ``None`` is
    the scheduler's in a task with memory, and nothing in one without.

    ``reference`` is a system on the same noise whose filter takes in every measurement beside the
    run, whoever decides: after each step ``reference_error`` (n, N) is the truth minus its fused
    estimate x*. It is for rewards in training, and no policy sees it.
    """

    reference_error: Array

    def __init__(
        self,
        task: Task,
        num_envs: int,
        remember: Owner | None = None,
        reference: System[Any] | None = None,
    ) -> None:
        memory = Memory(task, "scheduler" if remember is None else remember)
        super().__init__(task, memory, ObservationLayout(task, memory.owner))
        self.num_envs = num_envs
        self.generators: list[np.random.Generator | None] = [None] * num_envs
        self._episode_starts: list[Any] = [None] * num_envs
        self.state = None
        self.reference = reference
        # Where the scheduler's own memory is that of the reference, it is not kept twice.
        self._shared = (
            reference is not None and memory.keeps_every and reference is task.memory_system
        )
        self._beside: Any = None  # the reference's state, after sensing
        self.tokens = task.bucket.start(num_envs)
        self.queue = task.bucket.start_queue(num_envs)
        self.price = task.reward.price.draw(np.zeros(num_envs))
        self.steps = np.zeros(num_envs, dtype=np.int64)
        self.finished = np.ones(num_envs, dtype=np.bool_)
        self._limit = np.full(num_envs, task.horizon, dtype=np.int64)
        # Row (cursor mod block) of the ring holds the noise of the next sensing; a run's block
        # starts wherever the cursor stood at its reset, so that a row is one contiguous read.
        self._block = min(task.horizon + 1, _LONGEST_BLOCK)
        self._ring = np.zeros((self._block, self.channels, num_envs))
        self._cursor = 0
        self._block_start = np.zeros(num_envs, dtype=np.int64)

    @classmethod
    def seeded(
        cls, task: Task, episodes: int, seed: int, remember: Owner | None = None
    ) -> EpisodeBatch:
        """Episodes side by side, sensed once, with the seeds ``seed``, ``seed + 1``, …"""
        batch = cls(task, episodes, remember)
        batch.seed(np.arange(episodes), [seed + i for i in range(episodes)])
        batch.reset()
        return batch

    def seed(self, runs: NDArray[np.int64], seeds: Sequence[int | None]) -> None:
        """Give these runs new generators; ``None`` keeps a run's generator if it has one."""
        for run, seed in zip(runs.tolist(), seeds, strict=True):
            if seed is not None or self.generators[run] is None:
                self.use_generator(run, seeding.np_random(seed)[0])

    def use_generator(self, run: int, generator: np.random.Generator) -> None:
        """Draw this run's noise from ``generator``, from its present state on (if it is new)."""
        if generator is not self.generators[run]:
            self.generators[run] = generator
            self._episode_starts[run] = None

    def reset(
        self,
        runs: NDArray[np.int64] | None = None,
        *,
        stagger: bool = False,
        groups: int | None = None,
    ) -> None:
        """Begin new episodes in the given runs (all by default) and sense for the first time.

        ``stagger`` spreads the lengths of these first episodes evenly up to the horizon, so that
        later ones do not all end in the same step: each run has its own, or each of ``groups``, for
        a step in which some episode begins costs almost as much as if all did.
        """
        everyone = runs is None
        runs = np.arange(self.num_envs) if runs is None else runs
        system = self.task.system
        noise = np.empty((len(runs), system.start_channels))
        for place, run in enumerate(runs.tolist()):
            self._next_episode(run).standard_normal(out=noise[place])
        if self.task.reward.price.fixed is None:
            drawn = np.array([self._far_uniform(run) for run in runs.tolist()])
            self.price = merge_runs(self.price, self.task.reward.price.draw(drawn), runs)
        self._draw(runs)
        first = np.ascontiguousarray(noise.T)
        fresh = system.start(first)
        row = self.noise() if everyone else self.noise()[:, runs]
        self.memory.begin(first, fresh, row, runs, self.num_envs)
        if self.reference is not None and not self._shared:
            beside = self.reference.sense(self.reference.start(first), row)
            self._beside = beside if everyone else merge_runs(self._beside, beside, runs)
        fresh = system.sense(fresh, row)
        self.state = fresh if everyone else merge_runs(self.state, fresh, runs)
        self.tokens = merge_runs(self.tokens, self.task.bucket.start(len(runs)), runs)
        self.queue = merge_runs(self.queue, self.task.bucket.start_queue(len(runs)), runs)
        self.steps[runs] = 0
        self.finished[runs] = False
        horizon = self.task.horizon
        self._limit[runs] = horizon
        if stagger:
            parts = len(runs) if groups is None else min(groups, len(runs))
            part = (np.arange(len(runs)) * parts) // len(runs)
            self._limit[runs] = horizon - (part * horizon) // parts

    def step(self, requests: NDArray[np.bool_]) -> Outcome:
        """Answer the requests (sensors, N), update, fuse, reward; then move and sense.

        Runs that are ``finished`` are carried along without meaning until they are reset.

        Raises:
            ResetNeeded: before the first reset.
            DivergenceError: an error that is not finite, of a run that goes on.
        """
        if self.state is None:
            raise ResetNeeded("call reset before the first step")
        outcome = self.deliver(requests)
        if not math.isfinite(np.vdot(outcome.error, outcome.error)):
            mean, covariance = self.task.system.fused(self.delivered)
            values = {"covariance": covariance, "mean": mean, "truth": outcome.error}
            require_finite(values, self.finished, self.steps)
        if self.reference is not None:
            self._refer(self.reference)
        self._cursor += 1
        used_up = ~self.finished & (self._cursor - self._block_start >= self._block)
        if used_up.any():
            self._draw(np.flatnonzero(used_up))
        self.sense(self.normals())
        if self.reference is not None and not self._shared:
            self._beside = self.reference.sense(self._beside, self.noise())
        self.finished = outcome.ended.copy()
        return outcome

    def observe(self) -> NDArray[np.float32]:
        """Observations (N, entries) of all runs, a fresh array.

        Raises:
            DivergenceError: an entry that is not a number, of a run that goes on.
        """
        observation = super().observe()
        if not math.isfinite(np.vdot(observation, observation)):
            entry = np.isnan(observation).argmax(1)  # the first one of each run
            values = {f"observation {self.layout.names[k]!r}": observation.T[k] for k in set(entry)}
            require_finite(values, self.finished, self.steps)
        return observation

    def normals(self) -> Array:
        """The normals (channels, N) of the last sensing, a view that later steps overwrite."""
        return self._ring[self._cursor % self._block]

    def noise(self) -> Array:
        """Those of them that the system takes."""
        return self.normals()[: self.task.system.noise_channels]

    def snapshot(self) -> dict[str, Any]:
        """Where all runs are, without the task, for :meth:`restore`; valid until the next step."""
        fixed = ("task", "layout", "memory", "reference")
        moving = {key: value for key, value in vars(self).items() if key not in fixed}
        return moving | {"memory_states": self.memory.states}

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Put the runs where they were at a :meth:`snapshot` of a batch like this one."""
        moving = dict(snapshot)
        self.memory = self.memory.with_states(moving.pop("memory_states"))
        vars(self).update(moving)

    def _refer(self, system: System[Any]) -> None:
        """Let the reference take in every measurement of this step."""
        if self._shared:
            assert self.memory.states is not None
            beside = self.memory.states.every
        else:
            everyone = np.ones((self.task.sensors, self.num_envs), dtype=np.bool_)
            self._beside = beside = arrived(system, self._beside, everyone)
        self.reference_error = system.truth(beside) - system.fused_mean(beside)

    def _lottery(self) -> Array | None:
        return self.normals()[-1] if self.task.access == "random" else None

    def _next_episode(self, run: int) -> np.random.Generator:
        """The run's generator at the start of its next episode.

        Episodes begin 2⁶⁴ draws apart, so that the noise of one does not depend on how long the
        one before it was.
        """
        if self.generators[run] is None:
            self.use_generator(run, seeding.np_random(None)[0])
        generator = self._generator(run)
        bits = generator.bit_generator
        if self._episode_starts[run] is not None:
            bits.state = self._episode_starts[run]
            bits.advance(2**64)  # type: ignore[attr-defined]
        self._episode_starts[run] = bits.state
        return generator

    def _far_uniform(self, run: int) -> float:
        """A uniform number of the episode from beyond all its noise, which it does not shift."""
        generator = self._generator(run)
        bits = generator.bit_generator
        here = bits.state
        bits.advance(2**63)  # type: ignore[attr-defined]
        drawn = generator.random()
        bits.state = here
        return drawn

    def _generator(self, run: int) -> np.random.Generator:
        generator = self.generators[run]
        assert generator is not None, "reset gives every run a generator"
        return generator

    def _draw(self, runs: NDArray[np.int64]) -> None:
        """Draw the next block of noise for these runs, to begin at the cursor."""
        noise = np.empty((len(runs), self._block, self.channels))
        for place, run in enumerate(runs.tolist()):
            self._generator(run).standard_normal(out=noise[place])
        rows = (self._cursor + np.arange(self._block)) % self._block
        self._ring[rows[:, None], :, runs[None, :]] = noise.transpose(1, 0, 2)
        self._block_start[runs] = self._cursor
