"""Unknown inputs of a plant: sinusoids, steps, a random walk, an array.

An input d(k) acts from sampling instant k to k + 1. Every episode draws its signal from the
episode's noise, so that no policy knows it in advance.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.namespace import namespace, ndtr, take


@dataclass(frozen=True)
class InputSignal(ABC):
    """q inputs over time, for N runs at once (batch axis last).

    ``start`` turns standard normals (start_channels, N) into a memory (rows, N), ``value`` reads
    the input (q, N) at the runs' times (N,) from it, and ``advance`` moves the memory by one
    sampling instant with standard normals (noise_channels, N). ``size`` is q.
    """

    size: int

    @property
    def start_channels(self) -> int:
        """Standard normals that :meth:`start` consumes."""
        return 0

    @property
    def noise_channels(self) -> int:
        """Standard normals that :meth:`advance` consumes."""
        return 0

    @abstractmethod
    def start(self, noise: Array) -> Array:
        """Return the memory (rows, N) of new episodes."""

    @abstractmethod
    def value(self, memory: Array, time: Array) -> Array:
        """Return the input (q, N) from the instant ``time`` (N,) to the next."""

    def advance(self, memory: Array, noise: Array) -> Array:
        """Return the memory one instant later."""
        return memory

    def mean(self, horizon: int) -> Array:
        """Return the expectation (horizon, q) of d(0), ..., d(horizon - 1) over episodes."""
        return np.zeros((horizon, self.size))

    def covariance(self, horizon: int) -> Array:
        """Return Cov(d(k), d(k + lag)) for lag = 0..horizon - 1, (horizon, q, q), for every k."""
        return np.zeros((horizon, self.size, self.size))


@dataclass(frozen=True)
class Sinusoids(InputSignal):
    """d_j(k) = Σ_i a_ji sin(2π k / p_ji + φ_ji), with random or fixed phases.

    ``amplitude`` a, in the input's unit, and ``period`` p, in sampling instants, are (q, terms, 1);
    ``phase`` φ, in radians, is (q, terms, 1), or ``None`` for a draw in each episode.
    """

    amplitude: Array
    period: Array
    phase: Array | None

    @classmethod
    def create(
        cls, size: int, amplitude: ArrayLike, period: ArrayLike, phase: ArrayLike | str = "random"
    ) -> Sinusoids:
        """Return the signal of numbers for all, (terms,) for one input, or (size, terms).

        Args:
            size: number of inputs q.
            amplitude: a, in the input's unit.
            period: p > 0, in sampling instants.
            phase: φ in radians, or "random".

        Raises:
            ConfigurationError: a wrong shape, a period <= 0, or another text.
        """
        random = isinstance(phase, str)
        if random and phase != "random":
            raise validation.refusal("input_phase", phase, "'random' or radians")
        for name, value in {"amplitude": amplitude, "period": period, "phase": phase}.items():
            if size > 1 and np.ndim(value) == 1:
                allowed = f"one number, or ({size}, terms) numbers"
                raise validation.refusal(f"input_{name}", value, allowed, f"with {size} inputs")
        shape = (size, _terms(amplitude, period, 0.0 if random else phase))
        return cls(
            size,
            amplitude=validation.spread("input_amplitude", amplitude, shape)[..., None],
            period=validation.positive("input_period", period, shape)[..., None],
            phase=None if random else validation.spread("input_phase", phase, shape)[..., None],
        )

    @property
    def start_channels(self) -> int:
        """One for each random phase."""
        return self.amplitude.size if self.phase is None else 0

    def start(self, noise: Array) -> Array:
        """Return the phases (q·terms, N), in radians."""
        if self.phase is None:
            return 2.0 * np.pi * ndtr(noise)
        return np.broadcast_to(self.phase.reshape(-1, 1), (self.phase.size, noise.shape[-1])).copy()

    def value(self, memory: Array, time: Array) -> Array:
        """Return the input (q, N) at the runs' times (N,)."""
        angle = memory.reshape(*self.amplitude.shape[:2], -1) + (2.0 * np.pi / self.period) * time
        return linalg.total(self.amplitude * namespace(angle).sin(angle), 1)

    def mean(self, horizon: int) -> Array:
        """Return zero (horizon, q) for random phases, else the signal itself."""
        if self.phase is None:
            return super().mean(horizon)
        memory = np.broadcast_to(self.phase.reshape(-1, 1), (self.phase.size, horizon))
        return self.value(memory, np.arange(horizon, dtype=np.float64)).T

    def covariance(self, horizon: int) -> Array:
        """Return Σ a²/2 cos(2π lag / p) (horizon, q, q) for random phases, else zero."""
        result = super().covariance(horizon)
        if self.phase is None:
            angle = 2.0 * np.pi / self.period * np.arange(horizon)
            own = (0.5 * self.amplitude**2 * np.cos(angle)).sum(1)
            result[:, np.arange(self.size), np.arange(self.size)] = own.T
        return result


def _terms(*values: ArrayLike) -> int:
    """Return the number of sinusoids, the longest last axis."""
    shapes = (validation.array_shape(value) for value in values)
    return max((shape[-1] if shape else 1 for shape in shapes if shape is not None), default=1)


@dataclass(frozen=True)
class _Stationary(InputSignal):
    """The common part of signals whose memory is their value, with a stationary distribution.

    ``amplitude`` (q, 1) is the standard deviation in the input's unit, the mean is zero; ``period``
    (q, 1) is in sampling instants, at least 1.
    """

    amplitude: Array
    period: Array

    @classmethod
    def create(cls, size: int, amplitude: ArrayLike, period: ArrayLike) -> Self:
        """Return the signal of one number for all inputs, or (size,).

        Args:
            size: number of inputs q.
            amplitude: standard deviation > 0, in the input's unit.
            period: >= 1, in sampling instants.

        Raises:
            ConfigurationError: a wrong shape, or a number outside these limits.
        """
        scale = validation.positive("input_amplitude", amplitude, (size,))
        instants = validation.positive("input_period", period, (size,))
        if np.any(instants < 1.0):
            allowed = ">= 1 everywhere, because an input is constant between two sampling instants"
            raise validation.refusal("input_period", instants, allowed)
        return cls(size, scale[:, None], instants[:, None])

    @property
    def start_channels(self) -> int:
        """One for each first value."""
        return self.size

    def start(self, noise: Array) -> Array:
        """Draw values (q, N) from the stationary distribution."""
        return self.amplitude * noise

    def value(self, memory: Array, time: Array) -> Array:
        """Return the values (q, N)."""
        return memory

    def _geometric(self, ratio: Array, horizon: int) -> Array:
        """Return a² ratio^lag (horizon, q, q) on the diagonal."""
        own = self.amplitude**2 * ratio ** np.arange(horizon)
        result: Array = own.T[:, :, None] * np.eye(self.size)
        return result


@dataclass(frozen=True)
class Steps(_Stationary):
    """Levels that jump to a new one with the probability 1/``period``."""

    @property
    def noise_channels(self) -> int:
        """Two for each input: the jump and the new level."""
        return 2 * self.size

    def advance(self, memory: Array, noise: Array) -> Array:
        """Return the levels (q, N) one instant later."""
        jump = ndtr(noise[: self.size]) * self.period < 1.0
        level = self.amplitude * noise[self.size :]
        return namespace(noise).where(jump, level, memory)

    def covariance(self, horizon: int) -> Array:
        """Return (horizon, q, q): a² (1 - 1/period)^lag on the diagonal."""
        return self._geometric(1.0 - 1.0 / self.period, horizon)


@dataclass(frozen=True)
class MeanRevertingWalk(_Stationary):
    """d(k + 1) = r d(k) + a √(1 - r²) η with r = exp(-1/period).

    Its variance stays at a², ``period`` is the correlation time.
    """

    @property
    def noise_channels(self) -> int:
        """One for each input."""
        return self.size

    def advance(self, memory: Array, noise: Array) -> Array:
        """Return the values (q, N) one instant later."""
        retention = np.exp(-1.0 / self.period)
        return retention * memory + self.amplitude * np.sqrt(1.0 - retention * retention) * noise

    def covariance(self, horizon: int) -> Array:
        """Return (horizon, q, q): a² exp(-lag/period) on the diagonal."""
        return self._geometric(np.exp(-1.0 / self.period), horizon)


@dataclass(frozen=True)
class ArrayInput(InputSignal):
    """The same inputs in every episode: ``values`` (rows, q, 1), one row per sampling instant.

    After the last row the input is constant.
    """

    values: Array

    @classmethod
    def create(cls, size: int, values: ArrayLike, horizon: int) -> ArrayInput:
        """Return the signal of an array.

        Args:
            size: number of inputs q.
            values: d(0), ..., d(horizon), (horizon + 1, size).
            horizon: steps of an episode.

        Raises:
            ConfigurationError: another shape, or an entry that is not finite.
        """
        rows = validation.array("input_signal", values, (horizon + 1, size))
        return cls(size, rows[..., None])

    def start(self, noise: Array) -> Array:
        """Return an empty memory (0, N)."""
        return np.empty((0, noise.shape[-1]))

    def value(self, memory: Array, time: Array) -> Array:
        """Return the rows (q, N) of the runs' times (N,)."""
        rows = namespace(time).minimum(time.astype(np.intp), len(self.values) - 1)
        return take(self.values[..., 0].T, rows)

    def mean(self, horizon: int) -> Array:
        """Return the rows (horizon, q)."""
        return self.values[np.minimum(np.arange(horizon), len(self.values) - 1), :, 0]
