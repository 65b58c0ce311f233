"""The batched core: N episodes of one task with their noise, tokens and rewards."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym import validation
from fusion_gym.arrays import Array, Lazy, merge_runs
from fusion_gym.core.access import check_requests
from fusion_gym.core.control import inputs_of
from fusion_gym.core.estimator import Estimator, Reception
from fusion_gym.core.memory import Memory, Owner
from fusion_gym.core.noise import NoiseSource, PhiloxNoise
from fusion_gym.core.observation import ObservationLayout
from fusion_gym.core.runs import Outcome, Runs, advance, start_of
from fusion_gym.core.task import Task
from fusion_gym.errors import DivergenceError

# Normals in a block, of one run and of all runs (64 MB); a block has at least one step.
_BLOCK_OF_RUN, _BLOCK = 2**11, 2**23
_ONE = np.array(1)  # which NumPy adds to an array in half the time of a Python number
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
        reference: Estimator of every measurement, for rewards in training. After each step
            ``reference_error`` (n, N) is the truth minus its estimate x*.
        noise: Source of the plant's noise, by default the task's, or else
            :class:`~fusion_gym.core.noise.PhiloxNoise`.
    """

    reference_error: Array
    nonfinite: NDArray[np.bool_] | None = None  # diverged runs (N,), begun anew; None raises

    def __init__(
        self,
        task: Task,
        num_envs: int,
        memory_owner: Owner | None = None,
        reference: Estimator[Any] | None = None,
        noise: NoiseSource | None = None,
    ) -> None:
        memory = Memory(task, "scheduler" if memory_owner is None else memory_owner)
        super().__init__(task, memory, ObservationLayout(task, memory.owner))
        self.num_envs = num_envs
        self.source: NoiseSource = noise or task.noise or PhiloxNoise()
        self.network_source: NoiseSource = PhiloxNoise(stream=1)
        self.seeds = np.random.SeedSequence().generate_state(num_envs, np.uint64).tolist()
        self.episodes = np.full(num_envs, -1)
        self.state = None
        self.reference = reference
        # The scheduler's memory replaces an identical reference.
        self._shared = (
            reference is not None and memory.keeps_every and reference is task.memory_estimator
        )
        self._full_state: Any = None  # the reference's state after observing
        self._program = self._make_program()
        # State and rows after the program's last step.
        self._computed: Lazy | None = None
        self._rows: Any = None
        self.price = task.reward.price.draw(np.zeros(num_envs))
        self.steps = np.zeros(num_envs, dtype=np.int64)
        self.finished = np.ones(num_envs, dtype=np.bool_)
        self.limit = np.full(num_envs, task.horizon, dtype=np.int64)
        most = min(_BLOCK_OF_RUN, _BLOCK // num_envs) // max(1, self.channels)
        self._block = np.zeros((min(task.horizon + 1, max(1, most)), self.channels, num_envs))
        self._row = 0  # row of the block with the last sensing's noise

    @property
    def price(self) -> Array:
        """Price of a token (N,)."""
        return self._price

    @price.setter
    def price(self, price: Array) -> None:
        self._price, self._computed = price, None

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
        task, horizon = self.task, self.task.horizon
        self.episodes[runs] += 1
        self.steps[runs] = 0
        self.finished[runs] = False
        self.limit[runs] = horizon
        if stagger:
            parts = len(runs) if groups is None else min(groups, len(runs))
            part = (np.arange(len(runs)) * parts) // len(runs)
            self.limit[runs] = horizon - (part * horizon) // parts
        keys = self._keys(runs)
        if task.reward.price.fixed is None:
            drawn = np.array([self.source.uniform(*key) for key in keys])
            self._price = merge_runs(self.price, task.reward.price.draw(drawn), runs)
        if everyone:
            self._row = 0
        self._draw(runs)
        sources = (
            (self.source, task.plant.start_channels),
            (self.network_source, task.network.start_channels),
        )
        noise = np.concatenate([_starts(source, keys, count) for source, count in sources])
        row = self.normals() if everyone else self.normals()[:, runs]
        if self._program is not None and self.reference is None:
            self._begin(noise, row, None if everyone else runs)
            return
        start, announcement = start_of(task, noise)
        state = advance(task, start, row, self.steps[runs])
        first, measurement = (task.plant.measurement(part.plant) for part in (start, state))
        own = first, announcement, measurement, runs, keys, self.num_envs
        self.memory.begin(*own, start.control)
        if self.reference is not None and not self._shared:
            beside = self.reference.start(first, announcement)
            beside = self.reference.predict(beside, *inputs_of(start.control))
            beside = self.reference.observe(beside, measurement)
            self._full_state = beside if everyone else merge_runs(self._full_state, beside, runs)
        if task.delayed:
            nothing = np.zeros((task.sensors, len(runs)), dtype=np.bool_)
            last = state.estimate, measurement, nothing, state.control
            state = state._replace(history=(last,) * task.network.longest_delay)
        self.state = state if everyone else merge_runs(self.state, state, runs)

    def step(self, requests: NDArray[Any], run: int | None = None) -> Outcome:
        """Grant requests, update, fuse and reward; then move the plant and sense.

        Finished runs continue without meaning until they are reset.

        Args:
            requests: (sensors, N) bool, or with ``access="assignment"`` the channel from 1 of each
                packet, 0 for none; a channel that two ask for goes to the first in the queue.
            run: Run of the outcome, which then has no batch axis; ``None`` returns all.

        Raises:
            RuntimeError: The batch was never reset.
            DivergenceError: The error of an unfinished run is not finite.
        """
        if self._state is None:
            raise RuntimeError("call reset before the first step")
        network = self.task.network
        check_requests(requests, network.slots * network.rule.by_channel)
        if self._program is not None:
            outcome = self._run_program(requests, run)
        else:
            outcome = self.deliver(requests) if run is None else self.deliver(requests).single(run)
        diverged = np.count_nonzero(outcome.diverged) if run is None else outcome.diverged
        broken = None
        if diverged and not np.isfinite(outcome.error).all():
            estimate = self.delivered.estimate
            covariance = self.task.estimator.covariance(estimate)
            mean = self.task.estimator.mean(estimate)
            broken = self._check_finite(
                {"covariance": covariance, "mean": mean, "truth": outcome.error}
            )
        if self.reference is not None:
            self._refer(self.reference)
        if self._program is None:
            self._move()
            self.sense(self.normals())
        if self.reference is not None and not self._shared:
            predicted = self.reference.predict(self._full_state, *inputs_of(self.state.control))
            measurement = self.task.plant.measurement(self.state.plant)
            self._full_state = self.reference.observe(predicted, measurement)
        self.finished = np.array(outcome.ended, ndmin=1)
        if broken is not None:
            self.reset(np.flatnonzero(broken & ~self.finished))
        return outcome

    def _check_finite(self, values: Mapping[str, Array]) -> NDArray[np.bool_] | None:
        """Note and return the runs (N,) with a value (…, N) that is not finite, or raise."""
        if self.nonfinite is None:
            require_finite(values, self.finished, self.steps)
            return None
        finite = [np.isfinite(value).reshape(-1, self.num_envs).all(0) for value in values.values()]
        broken = ~np.all(finite, axis=0)
        self.nonfinite |= broken & ~self.finished
        return broken

    def observe(self, local: bool = False) -> NDArray[np.float32]:
        """Return observations (N, entries); NaN in an unfinished run is a ``DivergenceError``."""
        if self._state is self._computed and self._rows is not None:
            observation: NDArray[np.float32] = self._program.observation(self._rows)
        else:
            observation = super().observe(local)
        if not math.isfinite(np.vdot(observation, observation)):
            entry = np.isnan(observation).argmax(1)  # first NaN of each run
            values = {f"observation {self.layout.names[k]!r}": observation.T[k] for k in set(entry)}
            self._check_finite(values)
            observation = observation if self.nonfinite is None else np.nan_to_num(observation)
        return observation

    def normals(self) -> Array:
        """Return a view of the last sensing's normals (channels, N)."""
        return self._block[self._row]

    def snapshot(self) -> dict[str, Any]:
        """Return the state of all runs for :meth:`restore`, valid until the next step."""
        fixed = ("task", "layout", "memory", "reference", "source", "network_source", "_program")
        moving = {key: value for key, value in vars(self).items() if key not in fixed}
        return moving | {"memory_states": self.memory.whole(self.num_envs)}

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Set all runs to a :meth:`snapshot` of a batch of the same task."""
        moving = dict(snapshot)
        self.memory = self.memory.with_states(moving.pop("memory_states"))
        vars(self).update(moving)

    def _make_program(self) -> Any:
        """Return the step of the backend, ``None`` for NumPy's."""
        if self.task.options.backend == "numpy":
            return None
        from fusion_gym.core.compiled import make_step

        return make_step(self.task, Memory(self.task, self.memory.owner), self.layout)

    def _run_program(self, requests: NDArray[Any], run: int | None) -> Outcome:
        """Make both halves of a step by the backend's program."""
        rows, program = self._packed(), self._program
        self.steps = self.steps + _ONE
        self._move()
        rows = program(rows, requests, self.normals())
        self._set_rows(rows)
        self._delivered = Lazy(lambda: program.delivered(rows))
        outcome: Outcome = program.outcome(rows, run)
        return outcome

    def _begin(self, start: Array, noise: Array, runs: NDArray[np.int64] | None) -> None:
        """Begin episodes in ``runs``, by default in all, by the backend's program."""
        every = slice(None) if runs is None else runs
        rows = self._program.begin(start, noise, self.price[every], self.limit[every])
        if runs is not None:
            begun, rows = rows, self._packed().copy()
            rows[runs] = begun
        self._set_rows(rows)

    def _packed(self) -> Any:
        """Return the program's rows of the present state."""
        if self._state is not self._computed:
            memory = self.memory.whole(self.num_envs)
            self._rows = self._program.pack(self.position(), memory)
        return self._rows

    def _set_rows(self, rows: Any) -> None:
        """Set the program's rows as the present state."""
        self._rows, program = rows, self._program
        moved = Lazy(lambda: program.moved(rows))
        self._computed = self._state = Lazy(lambda: moved.value[0].state)
        if self.memory.parts:
            self.memory = self.memory.with_states(Lazy(lambda: moved.value[1]))
        self.memory.forget()

    def _move(self) -> None:
        """Move to the noise of the next sensing."""
        self._row += 1
        if self._row == len(self._block):
            self._row = 0
            self._draw(np.arange(self.num_envs))

    def _refer(self, estimator: Estimator[Any]) -> None:
        """Update the reference with every measurement of this step."""
        if self._shared:
            beside = self.memory.whole(self.num_envs)["every"]
        else:
            everyone = np.ones((self.task.sensors, self.num_envs), dtype=np.bool_)
            self._full_state = beside = estimator.update(self._full_state, Reception(everyone))
        truth = self.task.plant.truth(self.delivered.plant)
        self.reference_error = truth - estimator.mean(beside)

    def _keys(self, runs: NDArray[np.int64]) -> list[tuple[int, int]]:
        """Return seed and episode number of these runs."""
        seeds = [self.seeds[run] for run in runs.tolist()]
        return list(zip(seeds, self.episodes[runs].tolist(), strict=True))

    def _draw(self, runs: NDArray[np.int64]) -> None:
        """Draw the noise of these runs from this row to the end of the block or episode."""
        rows, channels = len(self._block) - self._row, self.channels
        own = self.task.plant.noise_channels
        lanes = self._block[self._row :].reshape(-1, self.num_envs)
        counts = np.clip(self.limit[runs] + 1 - self.steps[runs], 0, rows)
        parts = zip(self._keys(runs), self.steps[runs].tolist(), counts.tolist(), strict=True)
        for begin in range(0, len(runs), _TOGETHER):
            some = runs[begin : begin + _TOGETHER]
            drawn = np.zeros((len(some), rows, channels))
            for into, (key, first, count) in zip(drawn, parts, strict=False):
                into[:count, :own] = self.source.steps(*key, first, count, own)
                if own < channels:
                    into[:count, own:] = self.network_source.steps(
                        *key, first, count, channels - own
                    )
            beside = some[-1] - some[0] == len(some) - 1
            places = slice(some[0], some[-1] + 1) if beside else some
            lanes[:, places] = drawn.reshape(len(some), -1).T


def draw_episodes(task: Task, seeds: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return the normals (channels, N) of starts and (steps + 1, channels, N) of steps."""
    keys, count, starts, steps = [(seed, 0) for seed in seeds.tolist()], task.horizon + 1, [], []
    parts: tuple[Any, ...] = task.plant, task.network
    for stream, part in enumerate(parts):
        source, channels = PhiloxNoise(stream), part.noise_channels
        starts.append(_starts(source, keys, part.start_channels))
        steps.append(np.stack([source.steps(*key, 0, count, channels) for key in keys], axis=-1))
    return np.concatenate(starts), np.concatenate(steps, axis=1)


def _starts(source: NoiseSource, keys: list[tuple[int, int]], channels: int) -> Array:
    """Return the normals (channels, R) of the starts of episodes with these keys."""
    noise = np.empty((len(keys), channels))
    if channels:
        for place, key in enumerate(keys):
            noise[place] = source.start(*key, channels)
    return np.ascontiguousarray(noise.T)


def require_finite(
    values: Mapping[str, Array], finished: NDArray[np.bool_], steps: NDArray[np.int64]
) -> None:
    """Raise a ``DivergenceError`` if a value (…, N) of an unfinished run is not finite."""
    for name, value in values.items():
        lost = ~np.isfinite(value).reshape(-1, len(steps)).all(0) & ~finished
        if lost.any():
            run = int(lost.argmax())
            raise DivergenceError(f"run {run}, step {steps[run]}: the {name} is not finite")
