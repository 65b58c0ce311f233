"""Joint filters of a state and an unknown input: gain, covariance, input model, three filters.

The estimated quantity is z(k) = [x(k); d(k - 1)], of length s = n + q: an input becomes observable
only after it has acted, so its estimate comes one sampling instant late.

Source: unknown_input (Y. Sun, M. Fu, J. Mao and G. Wei, "Recursive filtering of multi-rate
cyber-physical systems with unknown inputs under adaptive event-triggered mechanisms", 2023); S.
Gillijns and B. De Moor, "Unbiased minimum-variance input and state estimation for linear
discrete-time systems", Automatica 43, 2007.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.namespace import namespace, update_at
from fusion_gym.systems.unknown_input.plant import InputSensors, UnknownInputPlant

_ALL = slice(None)
_SETTLED = 1000  # steps after which gains count as settled
_UNBOUNDED = 1e60  # a bound beyond this is growing without limit; the gains have settled by then


@dataclass(frozen=True)
class JointGain:
    """The unbiased gain of the smallest variance for [x(k); d(k - 1)], for every input.

    The gain 𝒢 = [N; L] (l, s, m, N) hides the input: 𝒢 C ℬ = [ℬ; I], which is (13) and (14). All
    such gains are [ℬ; I] (C ℬ)⁺ + Z Uᵀ with free Z, and the smallest covariance has Z = (T - [ℬ; I]
    (C ℬ)⁺ Ω) U (Uᵀ Ω U)⁻¹ with T = [Φ Cᵀ; 0], Φ the covariance of x(k) given the past without its
    input, and Ω = C Φ Cᵀ + R. This equals L = ((Cℬ)ᵀ Ω⁻¹ Cℬ)⁻¹ (Cℬ)ᵀ Ω⁻¹ and N = ℬ L + Φ Cᵀ U (Uᵀ Ω
    U)⁻¹ Uᵀ, without an inverse of a nearly singular matrix. With as many inputs as measurements U
    is empty and the gain is unique.

    ``onto`` is [ℬ; I] (C ℬ)⁺ (l, s, m, 1).

    Source: unknown_input, equations (8)-(14), (19), with (20) replaced by the minimiser.
    """

    sensors: InputSensors
    onto: Array

    @classmethod
    def create(cls, plant: UnknownInputPlant, sensors: InputSensors) -> JointGain:
        """Return the gain of a plant and its sensors."""
        lifted = np.concatenate((plant.input_matrix, linalg.identity(plant.inputs)))
        return cls(sensors, linalg.matmul(lifted[None], sensors.inverse))

    def gain(self, covariance: Array, noise: Array) -> Array:
        """Return 𝒢 (l, s, m, N) from Φ (l, n, n, N) and R (l, m, m, N)."""
        sensors = self.sensors
        u = sensors.complement
        free = u.shape[-2]
        if not free:
            return np.broadcast_to(self.onto, (*self.onto.shape[:-1], covariance.shape[-1])).copy()
        cross = linalg.matmul(covariance, linalg.transpose(sensors.measurement_matrix))
        innovation = linalg.matmul(sensors.measurement_matrix, cross) + noise
        through = linalg.matmul(innovation, u)
        weight = linalg.matmul(linalg.transpose(u), through)
        target = -linalg.matmul(self.onto, through)
        states = slice(cross.shape[1])
        target = update_at(np.add, target, (..., states, _ALL, _ALL), linalg.matmul(cross, u))
        if free == 1:  # rounding may make it negative
            choice = target / weight
        else:
            weight = linalg.symmetrise(weight)
            choice = linalg.transpose(linalg.solve(weight, linalg.transpose(target)))
        return self.onto + linalg.matmul(choice, linalg.transpose(u))

    def covariance(self, gain: Array, covariance: Array, noise: Array) -> Array:
        """Return the covariance M Φ Mᵀ + 𝒢 R 𝒢ᵀ (l, s, s, N) of any such gain, M = [I; 0] - 𝒢 C."""
        unit = np.eye(gain.shape[1], covariance.shape[1])[..., None]
        moved = unit - linalg.matmul(gain, self.sensors.measurement_matrix)
        return linalg.congruence(moved, covariance) + linalg.congruence(gain, noise)


@dataclass(frozen=True)
class InputModel:
    """A filter's model of the input without a delivery: d(k) = r d(k - 1) + η(k).

    It implies z(k + 1) = F z(k) + [ℬ η + w; η] with F = [[𝒜, r ℬ], [0, r I]]. ``memory`` r = 1 is a
    random walk; with r < 1 the input's variance stays bounded. The actual input follows no such
    model.

    Shapes: ``state_rows`` [𝒜, r ℬ] (n, s, 1), ``memory`` (q, 1), ``change`` covariance of [ℬ η + w;
    η] (s, s, 1), ``initial_mean`` (s, 1), ``initial_covariance`` (s, s, 1).
    """

    state_rows: Array
    memory: Array
    change: Array
    plant: UnknownInputPlant
    initial_mean: Array
    initial_covariance: Array

    @classmethod
    def create(cls, plant: UnknownInputPlant, options: Any) -> InputModel:
        """Return the model of a plant's input.

        Args:
            plant: the plant.
            options: ``input_memory`` r in [0, 1], ``input_change``, the deviation of η > 0, and
                ``input_deviation`` > 0 of an input without a measurement: one number, or one per
                input.

        Raises:
            ConfigurationError: a number outside these limits.
        """
        n, q = plant.size, plant.inputs
        retention = validation.not_negative("input_memory", options.input_memory, (q,))
        if np.any(retention > 1.0):
            raise validation.refusal("input_memory", options.input_memory, ">= 0 and <= 1")
        steps = validation.positive("input_change", options.input_change, (q,))
        first = validation.positive("input_deviation", options.input_deviation, (q,))
        b = plant.input_matrix[..., 0]
        spread = np.concatenate((b, np.eye(q))) * steps
        noise = spread @ spread.T
        noise[:n, :n] += plant.process_covariance[..., 0]
        start = np.zeros((n + q, n + q))
        start[:n, :n] = plant.initial_covariance[..., 0]
        start[n:, n:] = np.diag(first**2)
        return cls(
            state_rows=np.concatenate((plant.transition[..., 0], b * retention), axis=1)[..., None],
            memory=retention[:, None],
            change=noise[..., None],
            plant=plant,
            initial_mean=np.concatenate((plant.initial_mean, np.zeros((q, 1)))),
            initial_covariance=start[..., None],
        )

    @property
    def size(self) -> int:
        """Number of states n."""
        return self.plant.size

    def predict(self, mean: Array) -> Array:
        """Return F ẑ (..., s, N) from (..., s, N)."""
        n = self.size
        parts = linalg.matvec(self.state_rows, mean), self.memory * mean[..., n:, :]
        return namespace(mean).concatenate(parts, axis=-2)

    def predict_covariance(self, covariance: Array) -> Array:
        """Return F P Fᵀ plus the covariance of [ℬ η + w; η], (..., s, s, N)."""
        n, change = self.size, self.change
        rows = linalg.matmul(self.state_rows, covariance)
        upper = linalg.matmul(rows, linalg.transpose(self.state_rows))
        cross = rows[..., n:, :] * self.memory
        lower = covariance[..., n:, n:, :] * self.memory
        lower *= self.memory[:, None]
        upper, cross = linalg.symmetrise(upper + change[:n, :n]), cross + change[:n, n:]
        blocks = upper, cross, linalg.transpose(cross), lower + change[n:, n:]
        xp = namespace(covariance)
        halves = xp.concatenate(blocks[:2], axis=-2), xp.concatenate(blocks[2:], axis=-2)
        return xp.concatenate(halves, axis=-3)

    def without_input(self, covariance: Array) -> Array:
        """Return Φ = 𝒜 Ξ_x 𝒜ᵀ + 𝒲 (..., n, n, N) from the joint covariance (..., s, s, N)."""
        n, plant = self.size, self.plant
        moved = linalg.congruence(plant.transition, covariance[..., :n, :n, :])
        return moved + plant.process_covariance


@dataclass(frozen=True)
class ExactInputStateFilter:
    r"""Exact unbiased filter of state and input, of minimum variance.

    An update assumes nothing about the input that has just acted: its estimate uses this
    measurement only. If every measurement arrives, the covariance is therefore the actual one for
    every input. Without a delivery the node predicts with the :class:`InputModel`; from then on its
    covariance depends on the model's validity.

    Equation:
        $$
        \Phi=\mathcal A\,P_x\mathcal A^{\mathsf T}+\mathcal W,\qquad \Omega=C\Phi C^{\mathsf T}+V
        $$

        $$
        L=\left((C\mathcal B)^{\mathsf T}\Omega^{-1}C\mathcal B\right)^{-1}(C\mathcal B)^{\mathsf
        T}\Omega^{-1},\qquad N=\mathcal B L+\Phi C^{\mathsf T}U(U^{\mathsf T}\Omega
        U)^{-1}U^{\mathsf T}
        $$

        $$
        z=\begin{bmatrix}x\\ d\end{bmatrix},\quad G=\begin{bmatrix}N\\ L\end{bmatrix},\qquad \hat
        z^{+}=\hat z+G(y-C\hat x),\qquad P^{+}=M\Phi M^{\mathsf T}+G V G^{\mathsf T}
        $$

        U is a basis of the kernel of (C ℬ)ᵀ and M = [I; 0] − G C, with 𝒜, ℬ, 𝒲 over one sampling
        instant. The gain hides the input, N C ℬ = ℬ and L C ℬ = I, so any prediction of the input
        in x̂ gives the same estimate. When nothing arrives the node predicts with the input's
        model, d′ = m d + η.

    Assumes: rank C ℬ = number of inputs; nothing of the input while everything arrives, and its
    model where nothing does.

    Source: S. Gillijns and B. De Moor, "Unbiased minimum-variance input and state estimation for
    linear discrete-time systems", Automatica 43, 2007; unknown_input, equations (8)-(16) with
    every measurement sent.
    """

    model: InputModel
    joint: JointGain

    @np.errstate(all="ignore")
    def growth(self, horizon: int) -> Array:
        """Return the factor (l,) of a variance's growth where the input hides a growing direction.

        It is the largest over deliveries in each step and in every 2nd, 4th, 16th and 64th. For a
        state that is known at the start the unit is its largest variance of the first s steps.
        """
        periods, noise = np.array([1, 2, 4, 16, 64]), self.joint.sensors.covariance
        start = self.model.initial_covariance
        covariance = np.broadcast_to(start, (len(noise), *start.shape[:2], len(periods)))
        largest = unit = linalg.diagonal(covariance)
        for time in range(1, horizon + 1):
            predicted = self.model.predict_covariance(covariance)
            updated = self.update(covariance, noise)[1]
            covariance = np.where(time % periods == 0, updated, predicted)
            largest = np.fmax(largest, linalg.diagonal(covariance))
            if time <= len(start):
                unit = np.where(linalg.diagonal(start) > 0.0, unit, largest)
        return np.asarray((largest / np.where(unit > 0.0, unit, np.inf)).max((1, 2)))

    def update(self, posterior: Array, noise: Array) -> tuple[Array, Array]:
        """Return gain (l, s, m, N) and covariance (l, s, s, N).

        The gain hides the input: the updated estimate is the same for any prediction of the input
        in x̂.

        Args:
            posterior: the covariance one instant earlier (l, s, s, N).
            noise: covariance of the measurements (l, m, m, 1).
        """
        before = self.model.without_input(posterior)
        gain = self.joint.gain(before, noise)
        return gain, self.joint.covariance(gain, before, noise)


@dataclass(frozen=True)
class RandomWalkInputFilter:
    r"""Kalman filter of z = [x(k); d(k - 1)] under a model of the input, :class:`InputModel`.

    Unlike the unbiased filters it uses its earlier estimate of the input, and it is optimal if the
    input follows the model. The actual input does not, so its covariance is no bound; its accuracy
    depends on the model's numbers.

    Equation:
        $$
        z=\begin{bmatrix}x(k)\\ d(k-1)\end{bmatrix},\qquad \hat z\leftarrow F\hat z,\quad
        P\leftarrow F P F^{\mathsf T}+Q,\qquad F=\begin{bmatrix}\mathcal A&\mathcal
        B\,m\\ 0&m\end{bmatrix}
        $$

        $$
        K=P C_z^{\mathsf T}(C_zPC_z^{\mathsf T}+V)^{-1},\qquad \hat z^{+}=\hat z+K(y-C_z\hat
        z),\qquad P^{+}=P-K C_zP
        $$

        The input follows d(k) = m d(k − 1) + η with m ``input_memory`` and η of deviation
        ``input_change``; Q is the covariance of [ℬ η + w; η], C_z = (C, 0). When nothing arrives
        the prediction stays, or with ``hold_variance`` the held value is taken as a measurement of
        so much more variance.

    Assumes: an input that follows its model, and transmissions that are not chosen by the
    noise.

    Source: B. Friedland, "Treatment of bias in recursive filtering", IEEE Trans. Automatic
    Control 14, 1969, for the augmented state.
    """

    model: InputModel
    sensors: InputSensors

    def update(self, prior: Array, noise: Array) -> tuple[Array, Array]:
        """Return gain (l, s, m, N) and covariance (l, s, s, N).

        Args:
            prior: (l, s, s, N).
            noise: covariance of the measurement (l, m, m, N or 1).
        """
        n = self.model.size
        matrix = self.sensors.measurement_matrix
        cross = linalg.matmul(prior[:, :, :n], linalg.transpose(matrix))
        innovation = linalg.matmul(matrix, cross[:, :n]) + noise
        gain = linalg.transpose(linalg.solve(innovation, linalg.transpose(cross)))
        covariance = prior - linalg.matmul(gain, linalg.transpose(cross))
        return gain, linalg.symmetrise(covariance)


@dataclass(frozen=True)
class BoundTables:
    r"""The paper's filter, corrected: its gain minimises a bound that all runs share.

    The tables cover every node at the times 0 to T. They depend neither on the data nor on the
    deliveries: without a delivery the node uses the last measurement as the present one, and |σ|²
    <= ρ̄ bounds the resulting error. With ε the factor of Young's inequality, Φ = (1 + ε)(𝒜 Ξ 𝒜ᵀ +
    𝒲) and R = (1 + ε) V + (1 + 1/ε) ρ̄ I.

    ``gain`` 𝒢 (l, s, m, T + 1), ``covariance`` (l, s, s, T + 1), the bound after the update, and
    ``delivered`` (l, s, s, T + 1), the bound after a delivery in this step, without a held
    difference. At time 0 there is no update. ``radius`` (l,) is the spectral radius of √(1 + ε) (I
    - N C) 𝒜 at the last time: below 1 the bound stays finite.

    The bound holds under a trigger that sends whenever |σ|² > ρ̄ and whose requests are granted.
    For other policies, and after a denial, it does not hold.

    Equation:
        $$
        \Phi=(1+\epsilon)(\mathcal A\,\Xi_x\mathcal A^{\mathsf T}+\mathcal W),\qquad
        R=(1+\epsilon)V+(1+1/\epsilon)\,\bar\rho\,I,\qquad \Omega=C\Phi C^{\mathsf T}+R
        $$

        $$
        L=\left((C\mathcal B)^{\mathsf T}\Omega^{-1}C\mathcal B\right)^{-1}(C\mathcal B)^{\mathsf
        T}\Omega^{-1},\qquad N=\mathcal B L+\Phi C^{\mathsf T}U(U^{\mathsf T}\Omega
        U)^{-1}U^{\mathsf T}
        $$

        $$
        \hat x^{+}=\hat x+N(\bar y-C\hat x),\qquad \hat d=L(\bar y-C\hat x),\qquad \Xi_x=(I-N
        C)\Phi(I-N C)^{\mathsf T}+N R N^{\mathsf T},\qquad \Xi_d=L\,\Omega L^{\mathsf T}
        $$

        x̂ is predicted without the input, U a basis of the kernel of (C ℬ)ᵀ, with 𝒜, ℬ, 𝒲 over one
        sampling instant. ȳ is the last delivered measurement, ε is ``young_factor``, ρ̄
        ``rho_bar``.

    Assumes: |σ|² <= ρ̄ wherever nothing was sent, and rank C ℬ = number of inputs; nothing of
    the input.

    Source: unknown_input, equations (17)-(20); the factor (1 - 2δ) there, which makes the noise
    negative when nothing is sent, is left out, and the missing factor of process noise and σ put
    in.
    """

    gain: Array
    covariance: Array
    delivered: Array
    radius: Array

    @classmethod
    def create(cls, joint: JointGain, model: InputModel, options: Any, times: int) -> BoundTables:
        """Return tables for the times 0 to ``times``.

        Args:
            joint: the gain of state and input.
            model: the model of the input.
            options: ``rho_bar`` ρ̄ in [0, 1], ``young_factor`` ε > 0: one number, or one per
                sensor.
            times: the last time T.

        Raises:
            ConfigurationError: ρ̄ or ε outside these limits, or a bound that grows without limit.
        """
        sensors = joint.sensors
        count = sensors.count
        limit = validation.not_negative("rho_bar", options.rho_bar, (count,))
        if np.any(limit > 1.0):
            raise validation.refusal("rho_bar", options.rho_bar, ">= 0 and <= 1")
        young_factor = validation.positive("young_factor", options.young_factor, (count,))
        epsilon = young_factor[:, None, None, None]
        plain = (1.0 + epsilon) * sensors.covariance
        square = limit[:, None, None, None] * linalg.identity(sensors.size)
        noise = plain + (1.0 + 1.0 / epsilon) * square
        radius = _radius(joint, model, epsilon[:, 0, 0, 0], noise)
        for sensor in np.flatnonzero(~(radius < 1.0)):
            raise validation.ConfigurationError(
                f"young_factor = {validation.display(young_factor)} is not allowed for sensor "
                f"{sensor}: the spectral radius of sqrt(1 + young_factor) (I - N C) A must be "
                f"below 1, not {radius[sensor]:.4g}; use a smaller factor, another sensor, or "
                "filter='random_walk'"
            )
        initial = model.initial_covariance
        start = np.broadcast_to(initial, (count, *initial.shape)).copy()
        gains = [np.zeros((*joint.onto.shape[:3], 1))]
        covariances, delivered = [start], [start]
        for _ in range(times):
            before = (1.0 + epsilon) * model.without_input(covariances[-1])
            gain = joint.gain(before, noise)
            gains.append(gain)
            covariances.append(joint.covariance(gain, before, noise))
            delivered.append(joint.covariance(gain, before, plain))
        return cls(
            gain=np.concatenate(gains, axis=-1),
            covariance=np.concatenate(covariances, axis=-1),
            delivered=np.concatenate(delivered, axis=-1),
            radius=radius,
        )


def _radius(joint: JointGain, model: InputModel, epsilon: Array, noise: Array) -> Array:
    """Spectral radius of √(1 + ε) (I - N C) 𝒜 (l,) once the gains have settled."""
    growth = (1.0 + epsilon)[:, None, None, None]
    covariance, gain = model.initial_covariance[None], joint.onto
    for _ in range(_SETTLED):
        before = growth * model.without_input(covariance)
        gain = joint.gain(before, noise)
        covariance = joint.covariance(gain, before, noise)
        if not np.all(np.abs(covariance) < _UNBOUNDED):
            break
    seen = linalg.matmul(gain[:, : model.size], joint.sensors.measurement_matrix)
    rest = linalg.identity(model.size) - seen
    closed = linalg.matmul(rest, model.plant.transition)[..., 0] * np.sqrt(growth[..., 0])
    return np.abs(np.linalg.eigvals(closed)).max(-1)
