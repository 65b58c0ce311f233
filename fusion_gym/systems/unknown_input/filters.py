"""The two filters of a state with an unknown input that predict without a delivery."""

from dataclasses import dataclass

import numpy as np

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.systems.unknown_input.input_state import InputModel, JointGain
from fusion_gym.systems.unknown_input.sensors import InputSensors


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
