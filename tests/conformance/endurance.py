"""Long runs under every pattern of requests: all stays finite, every covariance a covariance.

    python tests/conformance/endurance.py [SEEDS] [NAME …]

runs every case of the suite, or those with such a name, for a million run-steps a seed.
"""

from __future__ import annotations

import sys

import numpy as np
import own_system
from cases import LASTING, Case
from numpy.typing import NDArray

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch

PERIOD = 7  # steps between two looks at the covariances


def patterns(runs: int, steps: int, generator: np.random.Generator) -> tuple[NDArray, NDArray]:
    """A request rate for each run, and the steps between its bursts, or 0.

    A quarter is silent between bursts, one in eight for good; the rates of the others spread from
    one in 3,000 to always.
    """
    rate = 10.0 ** generator.uniform(-3.5, 0.0, runs)
    rate[: runs * 3 // 8] = 0.0
    burst = generator.integers(2, steps, runs)
    burst[: runs // 8] = burst[runs * 3 // 8 :] = 0
    return rate, burst


def endure(case: Case, runs: int, steps: int, seed: int = 0) -> None:
    """Assert that so many runs stay sound for so many steps.

    Raises:
        AssertionError: a reward, estimate or observation that is not finite, or a covariance
            that is not positive semi-definite.
    """
    batch = EpisodeBatch.seeded(case.task(steps, tokens="unlimited"), runs, seed)
    system, sensors = batch.task.system, batch.task.sensors
    generator = np.random.default_rng(seed)
    rate, burst = patterns(runs, steps, generator)
    for step in range(1, steps):
        wanted = generator.random((sensors, runs)) < rate
        wanted |= (burst > 0) & (step % np.maximum(burst, 1) == 0)
        if batch.task.access == "single":
            wanted &= wanted.cumsum(0) == 1
        outcome = batch.step(wanted)
        assert np.isfinite(outcome.reward).all(), f"{case}, seed {seed}, step {step}"
        if step % PERIOD and step < steps - 2:
            continue
        mean, covariance = system.fused(batch.delivered)
        assert np.isfinite(mean).all(), f"{case}, seed {seed}, step {step}: mean"
        assert smallest(covariance) > -1e-9, f"{case}, seed {seed}, step {step}: covariance"
        assert np.isfinite(batch.observe()).all(), f"{case}, seed {seed}, step {step}: observed"


def smallest(covariance: NDArray[np.float64]) -> float:
    """Smallest eigenvalue of all the correlation matrices of (n, n, N); NaN where not finite."""
    matrices = np.moveaxis(covariance, -1, 0)
    if not np.isfinite(matrices).all():
        return np.nan
    scale = np.sqrt(np.maximum(np.einsum("rii->ri", matrices), 1e-300))
    return float(np.linalg.eigvalsh(matrices / scale[:, :, None] / scale[:, None]).min())


if __name__ == "__main__":
    fusion_gym.register(own_system.OWN_ID, own_system.build)
    seeds, names = int(sys.argv[1]) if sys.argv[1:] else 1, sys.argv[2:]
    for chosen in LASTING:
        if names and not any(name in str(chosen) for name in names):
            continue
        for number in range(seeds):
            endure(chosen, 1000, 1000, 1000 * number)
        print(f"{chosen}: {seeds},000,000 run-steps are sound", flush=True)
