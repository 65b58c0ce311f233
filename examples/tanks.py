"""Twenty saturating level sensors on one bucket: rules side by side under one budget of packets.

    python examples/tanks.py [EPISODES]

Two pumps fill four tanks, and five probes hang above one another in each. A probe covers 4 cm of
the 20 cm and saturates beyond: it says "below me", a level, or "above me". So nearly all of the
twenty have nothing new to tell at most times, and which ones do moves with the levels. All share
0.35 packets per step. The options are in ``tanks.yaml``, for
``gym.make("fusion_gym/LinearFusion-v2", system="tanks.yaml")``; :func:`options` works them out.

Where the parameters come from:

- Plant: K. H. Johansson, "The quadruple-tank process: a multivariable laboratory process with an
  adjustable zero", IEEE Trans. Control Systems Technology 8(3), 2000: cross-sections of tanks and
  outlets, pump gains, valves and levels at the operating point P+, height of the tanks 20 cm, and
  the linear model there. Discretised exactly for 10 s, in which the pumps' voltages stay.
- Our choice: the probes and their deviation of 1 mm (the paper measures the two lower tanks, with
  one sensor each); pump voltages that nobody reports, white with a deviation of 1 V (the
  operating point has 3.15 V), from which the levels move by about 1 cm, and besides 0.1 mm of
  each level a step; the start in the steady spread of the levels; the budget, and 100 steps.

States are levels less those of the operating point, in cm.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import expm, solve_discrete_lyapunov

import fusion_gym
from fusion_gym.evaluation import mean_interval, run_episodes

FILE = Path(__file__).with_name("tanks.yaml")
TANK = np.array([28.0, 32.0, 28.0, 32.0])  # A, cm²
OUTLET = np.array([0.071, 0.057, 0.071, 0.057])  # a, cm²
LEVEL = np.array([12.6, 13.0, 4.8, 4.9])  # h, cm, at P+
PUMP, VALVE = np.array([3.14, 3.29]), np.array([0.43, 0.34])  # k, cm³/(V s), and γ
GRAVITY, STEP = 981.0, 10.0  # cm/s², s
VOLTS, SPILL = 1.0, 0.01  # deviations: V of a pump, cm a step of a level
PROBES, SPAN = 5, 4.0  # of each tank; cm
RULES = {
    "every sensor always": "always",
    "by the clock": "periodic:period=60",
    "where variance falls most": "information_gain:threshold=0.01",
    "moved since it was last sent": "send_on_delta:threshold=1",
    "the greatest surprise": "innovation_threshold:threshold=1,whitened=true,at_most=1",
    "what it is worth": "value_of_information:threshold=0.5,at_most=1",
}


def time_constants() -> np.ndarray[Any, np.dtype[np.float64]]:
    """T = A/a √(2h/g) of the four tanks, in seconds; the paper prints 63, 91, 39 and 56."""
    return TANK / OUTLET * np.sqrt(2.0 * LEVEL / GRAVITY)


def options() -> dict[str, Any]:
    """The plant, the sensors and where they saturate, from the paper's parameters."""
    rate = 1.0 / time_constants()
    drift = np.diag(-rate)
    drift[0, 2], drift[1, 3] = TANK[2] / TANK[0] * rate[2], TANK[3] / TANK[1] * rate[3]
    first, second = PUMP
    inflow = np.zeros((4, 2))
    inflow[0, 0], inflow[3, 0] = VALVE[0] * first / TANK[0], (1 - VALVE[0]) * first / TANK[3]
    inflow[1, 1], inflow[2, 1] = VALVE[1] * second / TANK[1], (1 - VALVE[1]) * second / TANK[2]
    held = expm(STEP * np.block([[drift, inflow], [np.zeros((2, 6))]]))
    transition, moved = held[:4, :4], held[:4, 4:]
    noise = VOLTS**2 * moved @ moved.T + SPILL**2 * np.eye(4)
    ends = SPAN * np.arange(PROBES + 1) - LEVEL[:, None]
    return {
        "transition": transition,
        "process_covariance": noise,
        "initial_covariance": solve_discrete_lyapunov(transition, noise),
        "measurement_matrices": np.repeat(np.eye(4), PROBES, axis=0),
        "censoring_threshold": ends[:, :-1].ravel(),
        "censoring_upper": ends[:, 1:].ravel(),
    }


def main(episodes: int = 1000) -> None:
    """Print packets per step, mean squared error of the levels and consistency of every rule."""
    task = fusion_gym.make_task("fusion_gym/LinearFusion-v2", system=str(FILE))
    print(f"{episodes} episodes, seeds 0 to {episodes - 1}; 95 % intervals")
    print(f"{'rule':30s}{'packets per step':>15s}   {'MSE of four levels, cm²':26s}{'NEES':>6s}")
    for label, name in RULES.items():
        results = run_episodes(task, fusion_gym.make_policy(name, task), episodes, seed=0)
        mean, low, high = mean_interval(results.mse)
        error = f"{mean:.3f} [{low:.3f}, {high:.3f}]"
        print(f"{label:30s}{results.tokens.mean():15.3f}   {error:26s}{results.nees.mean():6.2f}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
