"""A lower bound of every policy's error, by the optimal times of silence in a relaxed problem."""

from fusion_gym.solvers.silence.bound import PricedCost, SilenceBound, cost_bound, silence_bound
from fusion_gym.solvers.silence.induction import SilenceSolution, solve_silence
from fusion_gym.solvers.silence.model import SilenceModel, silence_model
from fusion_gym.solvers.silence.problem import SilenceProblem
from fusion_gym.solvers.silence.simulation import UpperValue, simulate

__all__ = [
    "PricedCost",
    "SilenceBound",
    "SilenceModel",
    "SilenceProblem",
    "SilenceSolution",
    "UpperValue",
    "cost_bound",
    "silence_bound",
    "silence_model",
    "simulate",
    "solve_silence",
]
