"""Linear control of a linear plant: the options of the loop, the gain and its quadratic cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.control import Controller
from fusion_gym.declaration import OptionGroup, plain_options
from fusion_gym.errors import forbidden, refusal
from fusion_gym.systems.linear_plant import LinearPlant

_LARGEST_GROWTH = 1e24  # of the second moment over an episode


@dataclass(frozen=True)
class ControlOptions(OptionGroup):
    """The options of a loop that a linear controller closes."""

    input_matrix: ArrayLike | None = None
    """B (n, inputs) of x(t+1) = A x(t) + B u(t) + w(t), which closes the loop: the input u = −L x̂
    acts from each delivery to the next sensing, and every node knows it."""
    control_weights: Sequence[ArrayLike] | None = None
    """Pair (Q, R) of the cost xᵀQx + uᵀRu per step: Q (n, n) positive semi-definite, R (inputs,
    inputs) positive definite. By default identities."""
    gain: ArrayLike | Literal["lqr"] = "lqr"
    """Gain L (inputs, n) of the controller. ``"lqr"`` is the linear quadratic regulator of
    ``control_weights``; M = Lᵀ(R + BᵀPB)L, with P of its Riccati equation, then weighs estimation
    errors unless ``state_weights`` do."""
    terminal_weight: ArrayLike | None = None
    """Weight (n, n) of a quadratic cost of the state at the end of an episode, by default none. It
    needs ``clock=True``, because an agent values the steps beyond a truncated episode."""


@dataclass(frozen=True)
class LinearController(Controller):
    r"""The controller u = -L x̂ with a quadratic cost.

    Shapes: ``gain`` L (k, n, 1), ``state_cost`` Q (n, n, 1), ``input_cost`` R (k, k, 1),
    ``terminal`` (n, n, 1).

    Equation:
        $$
        P=Q+A^{\mathsf T}PA-A^{\mathsf T}PB\,L,\qquad
        L=(R+B^{\mathsf T}PB)^{-1}B^{\mathsf T}PA,\qquad M=L^{\mathsf T}(R+B^{\mathsf T}PB)L
        $$

    Source: A. Molin and S. Hirche, "On the optimality of certainty equivalence for event-triggered
    control systems", IEEE Trans. Automatic Control 58, 2013.
    """

    gain: Array
    state_cost: Array
    input_cost: Array
    terminal: Array | None = None
    error_weights: Array | None = None
    traceable = True

    def act(self, mean: Array) -> Array:
        """Return -L x̂."""
        return -linalg.matvec(self.gain, mean)

    def cost(self, state: Any, control: Array) -> Array:
        """Return xᵀQx + uᵀRu."""
        quadratic = linalg.quadratic
        return quadratic(state.truth, self.state_cost) + quadratic(control, self.input_cost)

    def terminal_cost(self, state: Any) -> Array | None:
        """Return the quadratic cost of the last state."""
        return None if self.terminal is None else linalg.quadratic(state.truth, self.terminal)


def close_loop(options: Any, plant: LinearPlant) -> tuple[LinearController | None, LinearPlant]:
    """Return the controller of ``ControlOptions``, and the plant with its input.

    Args:
        options: The options of the environment.
        plant: The plant without an input.

    Raises:
        ConfigurationError: An option is not allowed, or the closed loop grows too much.
    """
    if options.input_matrix is not None:
        plant.refuse_schedule("with input_matrix")
    controller, matrix = linear_controller(options, plant.transition[..., 0])
    if controller is None:
        return None, plant
    feedback = linalg.matmul(matrix, controller.gain)
    return controller, replace(plant, input_matrix=matrix, feedback=feedback)


def linear_controller(options: Any, transition: Array) -> tuple[LinearController | None, Array]:
    """Return the controller of ``ControlOptions``, and B (n, k, 1)."""
    size, matrix = len(transition), options.input_matrix
    if matrix is None:
        for name in ("control_weights", "gain", "terminal_weight"):
            value = getattr(options, name)
            if plain_options(value) != getattr(ControlOptions, name):
                raise forbidden(name, value, "it needs input_matrix")
        return None, np.zeros((size, 0, 1))
    matrix = validation.array("input_matrix", matrix, (size, None))
    inputs, pair = matrix.shape[1], options.control_weights
    pair = (np.eye(size), np.eye(inputs)) if pair is None else pair
    state, control = validation.entries("control_weights", pair, "a matrix", "weight", 2)
    state = validation.covariance("control_weights[0]", state, size)
    control = validation.covariance("control_weights[1]", control, inputs, definite=True)
    terminal = options.terminal_weight
    if terminal is not None:
        terminal = validation.covariance("terminal_weight", terminal, size)[..., None]
    weights = None
    if isinstance(options.gain, str):
        validation.choice("gain", options.gain, ("lqr",))
        try:
            cost = scipy.linalg.solve_discrete_are(transition, matrix, state, control)
        except (np.linalg.LinAlgError, ValueError):
            reason = "it must reach every state that does not decay, and the weight must see it"
            raise forbidden("input_matrix", matrix, reason, "with gain='lqr'") from None
        both: Array = control + matrix.T @ cost @ matrix
        gain: Array = np.asarray(np.linalg.solve(both, matrix.T @ cost @ transition), np.float64)
        weights = linalg.congruence(gain.T[..., None], both[..., None])[..., 0]
    else:
        gain = validation.array("gain", options.gain, (inputs, size))
    radius = float(np.abs(np.linalg.eigvals(transition - matrix @ gain)).max())
    if 2.0 * options.horizon * np.log10(max(radius, 1.0)) > np.log10(_LARGEST_GROWTH):
        allowed = f"one whose closed loop grows less (its spectral radius is {radius:.4g})"
        raise refusal("gain", gain, allowed, f"with horizon={options.horizon}")
    parts = gain[..., None], state[..., None], control[..., None]
    return LinearController(*parts, terminal, weights), matrix[..., None]
