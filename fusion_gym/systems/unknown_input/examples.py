"""The numbers of the unknown-input environment's two examples: two carts, and the paper's own.

Source: unknown_input (Y. Sun, M. Fu, J. Mao and G. Wei, "Recursive filtering of multi-rate
cyber-physical systems with unknown inputs under adaptive event-triggered mechanisms", 2023),
Section 4.
"""

from typing import Any

import numpy as np
from scipy.linalg import expm

from fusion_gym.arrays import Array


def two_carts(step: float = 0.25) -> tuple[Array, Array, Array]:
    """Two carts of 1 kg in a row: transition, input matrix and process covariance of one step.

    States: position and velocity of cart 1 and of cart 2, in m and m/s. A spring of 1 N/m with a
    damper of 0.6 N s/m ties cart 1 to a wall and another such pair ties the carts together. The
    unknown input is a force on cart 1, in N; white forces of the spectral density 0.02 N² s shake
    both carts. ``step`` is in seconds, the discretisation exact.
    """
    stiffness, damping, density = 1.0, 0.6, 0.02
    drift = np.array(
        [
            [0.0, 1.0, 0.0, 0.0],
            [-2 * stiffness, -2 * damping, stiffness, damping],
            [0.0, 0.0, 0.0, 1.0],
            [stiffness, damping, -stiffness, -damping],
        ]
    )
    force = np.array([[0.0], [1.0], [0.0], [0.0]])
    noise = density * np.diag([0.0, 1.0, 0.0, 1.0])
    moved = expm(np.block([[drift, force], [np.zeros((1, 5))]]) * step)
    # Van Loan's integral of exp(F t) G exp(F t)ᵀ
    pair = expm(np.block([[-drift, noise], [np.zeros((4, 4)), drift.T]]) * step)
    process = pair[4:, 4:].T @ pair[:4, 4:]
    return moved[:4, :4], moved[:4, 4:], (process + process.T) / 2


def _examples() -> dict[str, dict[str, Any]]:
    transition, inputs, process = two_carts()
    carts = {
        "transition": transition.tolist(),
        "input_matrix": inputs.tolist(),
        "process_covariance": process.tolist(),
        "initial_mean": (0.0, 0.0, 0.0, 0.0),
        "initial_covariance": np.diag([0.1, 0.1, 0.1, 0.1]).tolist(),
        # Cart 1; the velocity of cart 1 with the position of cart 2; the damper with cart 2
        "measurement_matrices": (
            ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0)),
            ((0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0)),
            ((0.0, 1.0, 0.0, -1.0), (0.0, 0.0, 1.0, 0.0)),
        ),
        "measurement_covariance": ((0.0009, 0.0064), (0.0036, 0.0036), (0.0064, 0.0009)),
        "filter": "random_walk",
        "young_factor": 0.2,
        "input_memory": 0.9,
        "input_change": 0.3,
        "input_deviation": 0.7,
        "rho_bar": 0.09,
        "rho_initial": 0.04,
        "adaptation": 0.04,
        "signals": {
            "sinusoids": (((0.8, 0.6),), ((60.0, 25.0),), "random"),
            "steps": (0.7, 20.0, "random"),
            "random_walk": (0.7, 10.0, "random"),
        },
    }
    paper = {
        "transition": ((0.26, 0.3), (0.2, 0.1)),
        "input_matrix": ((1.10, 1.12), (1.15, 1.13)),
        "process_covariance": ((0.001, 0.0), (0.0, 0.001)),
        "initial_mean": (0.17, 0.17),
        "initial_covariance": ((0.01, 0.0), (0.0, 0.01)),
        "initial_half_width": 0.01,
        "measurement_matrices": (((1.12, 1.13), (1.10, 1.12)), ((1.31, 1.13), (1.31, 1.21))),
        "measurement_covariance": 0.001,
        "filter": "paper",
        "young_factor": 1.0,
        "input_memory": 1.0,
        "input_change": 0.02,
        "input_deviation": 0.1,
        "rho_bar": 0.05,
        "rho_initial": 0.01,
        "adaptation": 0.01,
        "signals": {
            "sinusoids": (0.1, ((50.0,), (35.0,)), ((0.0,), (1.0,))),
            "steps": (0.1, 20.0, "random"),
            "random_walk": (0.1, 10.0, "random"),
        },
    }
    return {"two_carts": carts, "paper": paper}


EXAMPLES = _examples()
