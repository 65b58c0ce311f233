"""A linear plant, its linear sensors, and its unknown input: sinusoids, steps, a walk, an array.

An input d(k) acts from sampling instant k to k + 1. Every episode draws its signal from the
episode's noise, so that no policy knows it in advance.

Source: unknown_input (Y. Sun, M. Fu, J. Mao and G. Wei, "Recursive filtering of multi-rate
cyber-physical systems with unknown inputs under adaptive event-triggered mechanisms", 2023).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.plant import true_motion
from fusion_gym.errors import forbidden, refusal
from fusion_gym.namespace import namespace, ndtr, take
from fusion_gym.systems.linear_plant import LinearDynamics, Sensors, covariance_factor, initial_law

_LONGEST_PERIOD = 1000  # small steps between two instants
SHAPE = ("input_amplitude", "input_period", "input_phase")  # of a signal by its name
_RANK = 1e-8  # singular values below this share of what they could be count as zero


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
        if self.phase is not None:
            return super().covariance(horizon)
        angle = 2.0 * np.pi / self.period * np.arange(horizon)
        return _independent((0.5 * self.amplitude**2 * np.cos(angle)).sum(1))


def _independent(own: Array) -> Array:
    """Return covariances (horizon, q, q) of independent inputs from each one's (q, horizon)."""
    return own.T[:, :, None] * np.eye(len(own))


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
        return _independent(self.amplitude**2 * ratio ** np.arange(horizon))


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


def make_signal(options: Any, inputs: int, horizon: int) -> InputSignal:
    """Return the signal of an environment's options.

    Args:
        options: ``input_signal``, a name or an array, and the options ``SHAPE`` of a name.
        inputs: number of inputs q.
        horizon: steps of an episode.

    Raises:
        ConfigurationError: a value that is not allowed, or does not belong to this signal.
    """
    kind = options.input_signal
    shape = {name: getattr(options, name) for name in SHAPE}
    if not isinstance(kind, str):
        for name, value in shape.items():
            if value is not None:
                raise refusal(name, value, "None", "with an array as input_signal")
        return ArrayInput.create(inputs, kind, horizon)
    amplitude, period, phase = shape.values()
    if kind == "sinusoids":
        return Sinusoids.create(inputs, amplitude, period, phase)
    if not (isinstance(phase, str) and phase == "random"):
        reason = "phases belong to 'sinusoids'"
        raise forbidden("input_phase", phase, reason, f"with input_signal={kind!r}")
    if kind == "steps":
        return Steps.create(inputs, amplitude, period)
    return MeanRevertingWalk.create(inputs, amplitude, period)


@dataclass(frozen=True)
class UnknownInputPlant(LinearDynamics):
    """x(k + 1) = 𝒜 x(k) + ℬ d(k) + w(k), w ~ N(0, 𝒲), from one sampling instant to the next.

    Between two instants the plant makes ``sampling_period`` a small steps x' = A x + B d + ω, ω ~
    N(0, W), with a constant input d. So 𝒜 = Aᵃ, ℬ = Σ Aʲ B and 𝒲 = Σ Aʲ W Aʲᵀ over j = 0..a - 1.
    One draw per instant is exact, because no filter and no sensor uses the small steps.

    In addition to the shapes of the base, with 𝒜 and 𝒲: ``input_matrix`` ℬ (n, q, 1), and
    ``initial_half_width`` (n, 1) of a uniform x(0) about the mean, which filters assume to be
    normal.

    Source: unknown_input, equations (1), (3) and (4), lifted with a constant input.
    """

    input_matrix: Array
    initial_half_width: Array | None = None

    @classmethod
    def create(cls, options: Any) -> UnknownInputPlant:
        """Return the plant of an environment's options.

        Args:
            options: matrices of a small step without a batch axis: ``transition`` A (n, n),
                ``input_matrix`` B (n, q), q <= n, ``process_covariance`` W (n, n),
                ``sampling_period`` a from 1 to 1000, ``initial_mean`` (n,), ``initial_covariance``
                (n, n), ``initial_half_width`` (n,) or None.

        Raises:
            ConfigurationError: a wrong shape, an entry that is not finite, a number outside these
                limits, or a covariance that is not positive semi-definite.
        """
        small = validation.square("transition", options.transition)
        n, half = len(small), options.initial_half_width
        inputs = validation.array("input_matrix", options.input_matrix, (n, None))
        process = validation.covariance("process_covariance", options.process_covariance, n)
        law = initial_law(options.initial_mean, options.initial_covariance, n)
        if half is not None:
            half = validation.not_negative("initial_half_width", half, (n,))[:, None]
        steps = validation.integer(
            "sampling_period", options.sampling_period, at_least=1, at_most=_LONGEST_PERIOD
        )
        lifted, lifted_inputs, lifted_process = np.eye(n), np.zeros_like(inputs), np.zeros((n, n))
        for _ in range(steps):
            lifted_inputs += lifted @ inputs
            lifted_process += lifted @ process @ lifted.T
            lifted = small @ lifted
        lifted_process = (lifted_process + lifted_process.T) / 2
        return cls(
            transition=lifted[..., None],
            input_matrix=lifted_inputs[..., None],
            process_covariance=lifted_process[..., None],
            process_factor=covariance_factor(lifted_process)[..., None],
            **law,
            initial_half_width=half,
        )

    @property
    def inputs(self) -> int:
        """Number of inputs q."""
        return self.input_matrix.shape[1]

    def start(self, noise: Array) -> Array:
        """Draw x(0) (n, N) from standard normals (n, N)."""
        if self.initial_half_width is None:
            return self.initial_mean + linalg.matvec(self.initial_factor, noise)
        return self.initial_mean + self.initial_half_width * (2.0 * ndtr(noise) - 1.0)

    def advance(
        self, state: Array, inputs: Array, noise: Array, departure: Array | None = None
    ) -> Array:
        """Return x(k + 1) (n, N).

        Args:
            state: x(k) (n, N).
            inputs: d(k) (q, N).
            noise: standard normals (r, N).
            departure: (4, N), or None; with it the plant moves by I + c (𝒜 - I).
        """
        moved = true_motion(departure, state, linalg.matvec(self.transition, state))
        moved += linalg.matvec(self.input_matrix, inputs)
        if self.noise_channels:
            moved += linalg.matvec(self.process_factor, noise)
        return moved

    def open_loop(self, signal: InputSignal, horizon: int) -> Array:
        """Return the mean squared error (n + q,) over k = 1..horizon of predictions with input 0.

        The last q entries are the input's mean square. The closed form uses the signal's first two
        moments.
        """
        return self.second_moments(signal, horizon, np.zeros(self.size)).mean(0)

    def magnitude(self, signal: InputSignal, horizon: int) -> Array:
        """Return the root mean square (n + q,) of state and input over k = 1..horizon."""
        return np.sqrt(self.second_moments(signal, horizon, self.initial_mean[:, 0]).mean(0))

    def second_moments(self, signal: InputSignal, horizon: int, offset: Array) -> Array:
        """Return mean squares (horizon, n + q) of state and input at k = 1..horizon.

        The state's mean starts at ``offset`` (n,). The error's random part has the covariance C' =
        𝒜 C 𝒜ᵀ + 𝒜 X ℬᵀ + (𝒜 X ℬᵀ)ᵀ + ℬ R(0) ℬᵀ + 𝒲 with X the covariance of the error and the
        coming input, X(k + 1) = X(k) + 𝒜ᵏ ℬ R(k + 1).
        """
        a, b = self.transition[..., 0], self.input_matrix[..., 0]
        means, lags = signal.mean(horizon), signal.covariance(horizon + 1)
        if self.initial_half_width is None:
            spread = self.initial_covariance[..., 0].copy()
        else:
            spread = np.diag(self.initial_half_width[:, 0] ** 2 / 3.0)
        mean, cross, reach = offset, np.zeros((self.size, self.inputs)), b
        result = []
        for k in range(horizon):
            crossed = a @ cross @ b.T
            spread = a @ spread @ a.T + crossed + crossed.T + b @ lags[0] @ b.T
            spread = spread + self.process_covariance[..., 0]
            mean = a @ mean + b @ means[k]
            cross = cross + reach @ lags[k + 1]
            reach = a @ reach
            inputs = np.diagonal(lags[0]) + means[k] ** 2
            own = np.maximum(np.diagonal(spread), 0.0)  # it may cancel
            result.append(np.concatenate((own + mean**2, inputs)))
        return np.array(result)


@dataclass(frozen=True)
class InputSensors(Sensors):
    """y_i(k) = C_i x(k) + ν_i(k), ν_i ~ N(0, V_i), with an input that every sensor can observe.

    Shapes: ``measurement_matrix`` C (l, m, n, 1), ``covariance`` V (l, m, m, 1), ``factor``
    (l, m, m, 1) with factor factorᵀ = V. From the plant: ``inverse`` (C ℬ)⁺ (l, q, m, 1) and
    ``complement`` U (l, m, m - q, 1), an orthonormal basis of the kernel of (C ℬ)ᵀ.

    Source: unknown_input, equation (2).
    """

    measurement_matrix: Array
    covariance: Array
    factor: Array
    inverse: Array
    complement: Array

    @classmethod
    def create(cls, options: Any, plant: UnknownInputPlant) -> InputSensors:
        """Return the sensors of an environment's options.

        Args:
            options: arrays without a batch axis: ``measurement_matrices`` C (l, m, n) and
                ``measurement_covariance`` V: one number, one per sensor, variances (l, m), or
                matrices (l, m, m).
            plant: the plant.

        Raises:
            ConfigurationError: a wrong shape, a V_i that is not positive definite, or a sensor that
                cannot observe the input: rank(C_i ℬ) below the number of inputs.
        """
        shape = None, None, plant.size
        c = validation.array("measurement_matrices", options.measurement_matrices, shape)
        noise = _noise_covariances(options.measurement_covariance, *c.shape[:2])
        parts = [_observable_input(sensor, matrix, plant) for sensor, matrix in enumerate(c)]
        inverses, complements = zip(*parts, strict=True)
        return cls(
            measurement_matrix=c[..., None],
            covariance=noise[..., None],
            factor=np.asarray(np.linalg.cholesky(noise), dtype=np.float64)[..., None],
            inverse=np.array(inverses)[..., None],
            complement=np.array(complements)[..., None],
        )

    def measure(self, state: Array, noise: Array) -> Array:
        """Return measurements (l, m, N) of the state (n, N) with standard normals (l·m, N)."""
        result = linalg.matvec(self.measurement_matrix, state)
        result += linalg.matvec(self.factor, noise.reshape(self.count, self.size, -1))
        return result

    def expect(self, mean: Array) -> Array:
        """Return C x̂ (l, m, N) of means (l, s, N) or (s, N) that begin with the n states."""
        matrix = self.measurement_matrix
        return linalg.matvec(matrix, mean[..., : matrix.shape[2], :])


def _noise_covariances(value: ArrayLike, sensors: int, size: int) -> Array:
    """Return V as (l, m, m)."""
    if validation.array_shape(value) == (sensors, size, size):
        names = (f"measurement_covariance[{sensor}]" for sensor in range(sensors))
        pairs = zip(names, np.asarray(value), strict=True)
        return np.array([validation.covariance(*pair, size, definite=True) for pair in pairs])
    value = validation.by_row(value, (sensors, size))
    variances = validation.positive("measurement_covariance", value, (sensors, size))
    return variances[..., None] * np.eye(size)


def _observable_input(sensor: int, matrix: Array, plant: UnknownInputPlant) -> tuple[Array, Array]:
    """Return (C ℬ)⁺ and the kernel of (C ℬ)ᵀ, or refuse a C ℬ of deficient rank."""
    inputs = plant.input_matrix[..., 0]
    q, observed = plant.inputs, matrix @ inputs
    left, values, right = np.linalg.svd(observed)
    possible = np.linalg.norm(matrix, 2) * np.linalg.norm(inputs, 2)
    rank = int(np.sum(values > _RANK * possible))
    if rank < q:
        raise validation.ConfigurationError(
            f"measurement_matrices[{sensor}] = {validation.display(matrix)} is not allowed: the "
            f"sensor must measure every input, but rank(C B) is {rank} for {q} "
            f"input{'s' if q > 1 else ''} (B is the input matrix over one sampling interval)"
        )
    return right.T @ np.diag(1.0 / values) @ left[:, :q].T, left[:, q:]
