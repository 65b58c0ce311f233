"""The optimal cost of remote estimation by dynamic programming, and bounds on it."""

from fusion_gym.solvers.ages import AgeSolution, AgeSource, age_index, age_sources, solve_ages
from fusion_gym.solvers.joint import (
    JointAverageSolution,
    JointFiniteSolution,
    JointProblem,
    solve_joint_average,
    solve_joint_finite,
)
from fusion_gym.solvers.single import (
    AverageSolution,
    DiscountedSolution,
    DualBound,
    FiniteSolution,
    lagrangian_bound,
    solve_average,
    solve_discounted,
    solve_finite,
)
from fusion_gym.solvers.source import ErrorGrid, SourceProblem, TokenLevels
from fusion_gym.solvers.task import Optimum, solve_task, source_problems

__all__ = [
    "AgeSolution",
    "AgeSource",
    "AverageSolution",
    "DiscountedSolution",
    "DualBound",
    "ErrorGrid",
    "FiniteSolution",
    "JointAverageSolution",
    "JointFiniteSolution",
    "JointProblem",
    "Optimum",
    "SourceProblem",
    "TokenLevels",
    "age_index",
    "age_sources",
    "lagrangian_bound",
    "solve_ages",
    "solve_average",
    "solve_discounted",
    "solve_finite",
    "solve_joint_average",
    "solve_joint_finite",
    "solve_task",
    "source_problems",
]
