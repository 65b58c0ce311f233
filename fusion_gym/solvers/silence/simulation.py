"""The cost of the lattice policy, an upper bound of the least cost."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array
from fusion_gym.solvers.silence.induction import SilenceSolution, Stage
from fusion_gym.solvers.silence.problem import SilenceProblem
from fusion_gym.systems.linear_plant import covariance_factor

_SURE = 3.0  # standard errors


class UpperValue(NamedTuple):
    """Means over simulated episodes, per step: ``cost`` with its standard error, and packets."""

    cost: float
    deviation: float
    packets: float

    @property
    def high(self) -> float:
        """The cost plus three standard errors."""
        return self.cost + _SURE * self.deviation


def simulate(
    problem: SilenceProblem, solution: SilenceSolution, episodes: int = 20_000, seed: int = 0
) -> UpperValue:
    """Run the solution's policy: silence near points of optimal silence, e = 0 after a packet."""
    draw = np.random.default_rng(seed)
    error = np.zeros((problem.size, episodes))
    cost, packets = np.zeros(episodes), 0.0
    for stage, noise in zip(solution.stages, problem.noise, strict=True):
        factor = covariance_factor(noise)
        moved = factor @ draw.standard_normal((factor.shape[1], episodes))
        error = problem.transition @ error + moved
        sends = _sends(stage, error)
        error[:, sends] = 0.0
        cost += problem.weights @ error**2 + problem.price * sends
        packets += float(sends.mean())
    cost /= problem.horizon
    deviation = float(cost.std(ddof=1)) / np.sqrt(episodes)
    return UpperValue(float(cost.mean()), deviation, packets / problem.horizon)


def _sends(stage: Stage, error: Array) -> NDArray[np.bool_]:
    """Return whether a packet is best at the point nearest to each of the errors (n, M)."""
    place = np.rint(stage.coordinates.inverse @ error / stage.step).astype(np.int64)
    place += stage.half[:, None]
    shape = np.array(stage.gain.shape)[:, None]
    inside = ((place >= 0) & (place < shape)).all(0)
    result = np.ones(error.shape[1], dtype=np.bool_)
    result[inside] = stage.gain[tuple(place[:, inside])] == 0.0
    return result
