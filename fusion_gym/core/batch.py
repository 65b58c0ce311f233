"""The batched core: N episodes of one task with their noise, tokens and rewards."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from fusion_gym import validation
from fusion_gym.arrays import Array, merge_runs
from fusion_gym.core.admission import require_finite
from fusion_gym.core.beliefs import Owner, arrived
from fusion_gym.core.memory import Memory
from fusion_gym.core.noise import NoiseSource, PhiloxNoise
from fusion_gym.core.observation import ObservationLayout
from fusion_gym.core.runs import Lazy, Outcome, Runs, value_of
from fusion_gym.core.system import System
from fusion_gym.core.task import Task
from fusion_gym.errors import refusal

if TYPE_CHECKING:
    from fusion_gym.core.compiled import CompiledStep

# Normals in a block, of one run and of all runs (64 MB); a block has at least one step.
_BLOCK_OF_RUN, _BLOCK = 2**11, 2**23
_TOGETHER = 256  # runs per transposition, which then stays in the cache


class EpisodeBatch(Runs):
    """N runs of a :class:`~fusion_gym.core.task.Task`, advanced together.

    The noise is a function of a run's seed, the episode's number and the step, and independent of
    actions (common random numbers) and of other runs (batch invariance).

    Args:
        task: The task.
        num_envs: Number N of runs.
        memory_owner: Owner of the memory: ``"scheduler"``, or ``"own"`` for every local sensor;
            ``None`` is the scheduler.
        reference: System on the same noise whose filter processes every measurement, for rewards in
            training. After each step ``reference_error`` (n, N) is the truth minus its estimate x*.
        noise: Source of the noise, by default the task's, or else
            :class:`~fusion_gym.core.noise.PhiloxNoise`.
    """

    reference_error: Array

    def __init__(
        self,
        task: Task,
        num_envs: int,
        memory_owner: Owner | None = None,
        reference: System[Any] | None = None,
        noise: NoiseSource | None = None,
    ) -> None:
        memory = Memory(task, "scheduler" if memory_owner is None else memory_owner)
        super().__init__(task, memory, ObservationLayout(task, memory.owner))
        self.num_envs = num_envs
        self.source: NoiseSource = noise or task.noise or PhiloxNoise()
        self.seeds = np.random.SeedSequence().generate_state(num_envs, np.uint64).tolist()
        self.episodes = np.full(num_envs, -1)
        self.state = None
        self.reference = reference
        # The scheduler's memory replaces an identical reference.
        self._shared = (
            reference is not None and memory.keeps_every and reference is task.memory_system
        )
        self._full_state: Any = None  # the reference's state, after sensing
        self._program = self._compiled() if task.backend == "jax" else None
        # State, position and observations (entries, N) after the program's last step.
        self._computed: Lazy | None = None
        self._rows: list[Any] = []
        self._observed: NDArray[np.float32] | None = None
        self.tokens = task.bucket.start(num_envs)
        self.queue = task.bucket.start_queue(num_envs)
        self.price = task.reward.price.draw(np.zeros(num_envs))
        self.steps = np.zeros(num_envs, dtype=np.int64)
        self.finished = np.ones(num_envs, dtype=np.bool_)
        self._limit = np.full(num_envs, task.horizon, dtype=np.int64)
        most = min(_BLOCK_OF_RUN, _BLOCK // num_envs) // max(1, self.channels)
        self._block = np.zeros((min(task.horizon + 1, max(1, most)), self.channels, num_envs))
        self._row = 0  # row of the block with the last sensing's noise

    @classmethod
    def seeded(
        cls, task: Task, episodes: int, seed: int, memory_owner: Owner | None = None
    ) -> EpisodeBatch:
        """Return a batch after its first sensing, with consecutive seeds from ``seed``."""
        batch = cls(task, episodes, memory_owner)
        batch.seed(np.arange(episodes), [seed + i for i in range(episodes)])
        batch.reset()
        return batch

    def seed(self, runs: NDArray[np.int64], seeds: Sequence[int | None]) -> None:
        """Set the seeds of these runs' next episodes; ``None`` leaves a run's seed unchanged."""
        for run, seed in zip(runs.tolist(), seeds, strict=True):
            if seed is not None:
                self.seeds[run] = validation.integer("seed", seed, at_least=0)
                self.episodes[run] = -1

    def reset(
        self,
        runs: NDArray[np.int64] | None = None,
        *,
        stagger: bool = False,
        groups: int | None = None,
    ) -> None:
        """Begin new episodes and sense for the first time.

        Args:
            runs: Numbers of the runs; by default all.
            stagger: Whether the lengths of these episodes spread evenly up to the horizon.
            groups: Number of different lengths with ``stagger``; by default one per run. Few groups
                are faster, because a step with one reset costs almost as much as a step with many.
        """
        runs = np.arange(self.num_envs) if runs is None else runs
        everyone = np.array_equal(runs, np.arange(self.num_envs))
        system, source, horizon = self.task.system, self.source, self.task.horizon
        self.episodes[runs] += 1
        self.steps[runs] = 0
        self.finished[runs] = False
        self._limit[runs] = horizon
        if stagger:
            parts = len(runs) if groups is None else min(groups, len(runs))
            part = (np.arange(len(runs)) * parts) // len(runs)
            self._limit[runs] = horizon - (part * horizon) // parts
        keys = self._keys(runs)
        noise = np.empty((len(runs), system.start_channels))
        for place, key in enumerate(keys):
            noise[place] = source.start(*key, noise.shape[1])
        if self.task.reward.price.fixed is None:
            drawn = np.array([source.uniform(*key) for key in keys])
            self.price = merge_runs(self.price, self.task.reward.price.draw(drawn), runs)
        if everyone:
            self._row = 0
        self._draw(runs)
        first = np.ascontiguousarray(noise.T)
        fresh = system.start(first)
        row = self.noise() if everyone else self.noise()[:, runs]
        self.memory.begin(first, fresh, row, runs, self.num_envs)
        if self.reference is not None and not self._shared:
            beside = self.reference.sense(self.reference.start(first), row)
            self._full_state = beside if everyone else merge_runs(self._full_state, beside, runs)
        fresh = system.sense(fresh, row)
        self.state = fresh if everyone else merge_runs(self.state, fresh, runs)
        self.tokens = merge_runs(self.tokens, self.task.bucket.start(len(runs)), runs)
        self.queue = merge_runs(self.queue, self.task.bucket.start_queue(len(runs)), runs)

    def step(self, requests: NDArray[np.bool_]) -> Outcome:
        """Grant requests, update, fuse and reward; then move the plant and sense.

        Finished runs continue without meaning until they are reset.

        Args:
            requests: (sensors, N) bool.

        Raises:
            ResetNeeded: The batch was never reset.
            DivergenceError: The error of an unfinished run is not finite.
        """
        if self._state is None:
            raise ResetNeeded("call reset before the first step")
        outcome = self.deliver(requests) if self._program is None else self._run_program(requests)
        if not math.isfinite(np.vdot(outcome.error, outcome.error)):
            mean, covariance = self.task.system.fused(self.delivered)
            values = {"covariance": covariance, "mean": mean, "truth": outcome.error}
            require_finite(values, self.finished, self.steps)
        if self.reference is not None:
            self._refer(self.reference)
        if self._program is None:
            self._move()
            self.sense(self.normals())
        if self.reference is not None and not self._shared:
            self._full_state = self.reference.sense(self._full_state, self.noise())
        self.finished = outcome.ended.copy()
        return outcome

    def observe(self) -> NDArray[np.float32]:
        """Return observations (N, entries); NaN in an unfinished run is a ``DivergenceError``."""
        if self._state is self._computed and self._observed is not None:
            observation = np.ascontiguousarray(self._observed.T)
        else:
            observation = super().observe()
        if not math.isfinite(np.vdot(observation, observation)):
            entry = np.isnan(observation).argmax(1)  # first NaN of each run
            values = {f"observation {self.layout.names[k]!r}": observation.T[k] for k in set(entry)}
            require_finite(values, self.finished, self.steps)
        return observation

    def normals(self) -> Array:
        """Return a view of the last sensing's normals (channels, N)."""
        return self._block[self._row]

    def noise(self) -> Array:
        """Return the part (noise_channels, N) of :meth:`normals` that the system takes."""
        return self.normals()[: self.task.system.noise_channels]

    def snapshot(self) -> dict[str, Any]:
        """Return the state of all runs for :meth:`restore`, valid until the next step."""
        fixed = ("task", "layout", "memory", "reference", "source", "_program")
        moving = {key: value for key, value in vars(self).items() if key not in fixed}
        return moving | {"memory_states": self.memory.states}

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Set all runs to a :meth:`snapshot` of a batch of the same task."""
        moving = dict(snapshot)
        self.memory = self.memory.with_states(moving.pop("memory_states"))
        vars(self).update(moving)

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_rows": []}  # whose form only the program knows

    def _compiled(self) -> CompiledStep:
        from fusion_gym.core.compiled import CompiledStep

        if self.memory.states is not None:
            raise refusal("backend", "jax", "'numpy' with memory or the beliefs of local sensors")
        return CompiledStep(self.task, Memory(self.task, self.memory.owner), self.layout)

    def _run_program(self, requests: NDArray[np.bool_]) -> Outcome:
        """Make both halves of a step under JAX."""
        program, before, system = self._program, self._state, self.task.system
        assert program is not None
        if before is not self._computed or not self._rows:
            self._rows = program.pack(self.position())
        self.steps = self.steps + 1
        self._move()
        rows, after = program(self._rows, requests, self.normals())
        outcome, self.tokens, self.queue, self._observed = after
        self._rows = rows
        self._computed = self._state = Lazy(lambda: program.position(rows).state)
        self._delivered = Lazy(lambda: system.deliver(value_of(before), outcome.granted))
        self.memory.sense(self.noise())
        return outcome

    def _move(self) -> None:
        """Move to the noise of the next sensing."""
        self._row += 1
        if self._row == len(self._block):
            self._row = 0
            self._draw(np.arange(self.num_envs))

    def _refer(self, system: System[Any]) -> None:
        """Update the reference with every measurement of this step."""
        if self._shared:
            assert self.memory.states is not None
            beside = self.memory.states.every
        else:
            everyone = np.ones((self.task.sensors, self.num_envs), dtype=np.bool_)
            self._full_state = beside = arrived(system, self._full_state, everyone)
        self.reference_error = system.truth(beside) - system.fused_mean(beside)

    def _lottery(self) -> Array | None:
        return self.normals()[-1] if self.task.access == "random" else None

    def _keys(self, runs: NDArray[np.int64]) -> list[tuple[int, int]]:
        """Return seed and episode number of these runs."""
        seeds = [self.seeds[run] for run in runs.tolist()]
        return list(zip(seeds, self.episodes[runs].tolist(), strict=True))

    def _draw(self, runs: NDArray[np.int64]) -> None:
        """Draw the noise of these runs from this row to the end of the block or episode."""
        rows, channels = len(self._block) - self._row, self.channels
        lanes = self._block[self._row :].reshape(-1, self.num_envs)
        counts = np.clip(self._limit[runs] + 1 - self.steps[runs], 0, rows)
        parts = zip(self._keys(runs), self.steps[runs].tolist(), counts.tolist(), strict=True)
        for begin in range(0, len(runs), _TOGETHER):
            some = runs[begin : begin + _TOGETHER]
            drawn = np.zeros((len(some), rows, channels))
            for into, (key, first, count) in zip(drawn, parts, strict=False):
                into[:count] = self.source.steps(*key, first, count, channels)
            beside = some[-1] - some[0] == len(some) - 1
            places = slice(some[0], some[-1] + 1) if beside else some
            lanes[:, places] = drawn.reshape(len(some), -1).T
