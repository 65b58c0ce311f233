"""The joint input-state filter that holds the last measurement, with a bound of its covariance.

Source: unknown_input, equations (8)-(20), in a form whose bound holds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.systems.unknown_input.input_state import InputModel, JointGain
from fusion_gym.validation import ConfigurationError

_SETTLED = 1000  # steps after which gains count as settled
_UNBOUNDED = 1e60  # a bound beyond this is growing without limit; the gains have settled by then


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
    def create(
        cls,
        joint: JointGain,
        model: InputModel,
        rho_bar: ArrayLike,
        young_factor: ArrayLike,
        times: int,
    ) -> BoundTables:
        """Return tables for the times 0 to ``times``.

        Args:
            joint: the gain of state and input.
            model: the model of the input.
            rho_bar: ρ̄ in [0, 1]: one number, or one per sensor.
            young_factor: ε > 0: one number, or one per sensor.
            times: the last time T.

        Raises:
            ConfigurationError: ρ̄ or ε outside these limits, or a bound that grows without limit.
        """
        sensors = joint.sensors
        count = sensors.count
        limit = validation.not_negative("rho_bar", rho_bar, (count,))
        if np.any(limit > 1.0):
            raise validation.refusal("rho_bar", rho_bar, ">= 0 and <= 1")
        epsilon = validation.positive("young_factor", young_factor, (count,))[:, None, None, None]
        plain = (1.0 + epsilon) * sensors.covariance
        square = limit[:, None, None, None] * linalg.identity(sensors.size)
        noise = plain + (1.0 + 1.0 / epsilon) * square
        radius = _radius(joint, model, epsilon[:, 0, 0, 0], noise)
        for sensor in np.flatnonzero(~(radius < 1.0)):
            raise ConfigurationError(
                f"young_factor = {validation.display(young_factor)} is not allowed for sensor "
                f"{sensor}: the spectral radius of sqrt(1 + young_factor) (I - N C) A must be "
                f"below 1, not {radius[sensor]:.4g}; use a smaller factor, another sensor, or "
                "filter='random_walk'"
            )
        start = np.broadcast_to(
            model.initial_covariance, (count, *model.initial_covariance.shape)
        ).copy()
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
    radius: Array = np.abs(np.linalg.eigvals(closed)).max(-1)
    return radius
