"""A lower bound of every policy's error, by the optimal times of silence in a relaxed problem."""

from fusion_gym.solvers.silence.bound import PricedCost, SilenceBound, cost_bound, silence_bound
from fusion_gym.solvers.silence.induction import (
    SilenceSolution,
    UpperValue,
    simulate,
    solve_silence,
)
from fusion_gym.solvers.silence.problem import SilenceModel, SilenceProblem, silence_model

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
