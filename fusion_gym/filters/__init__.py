"""Node filters: what a sensor's local filter makes of a delivery, and of its absence."""

from fusion_gym.filters.assumed_density import AssumedDensityFilter
from fusion_gym.filters.base import Expectation, NodeFilter, Plan
from fusion_gym.filters.bound import BoundConstants, BoundTobitFilter, EventError
from fusion_gym.filters.centralised_linear import CentralisedLinearFilter
from fusion_gym.filters.interacting_models import InteractingModels
from fusion_gym.filters.kalman import KalmanFilter
from fusion_gym.filters.linear_minimum_variance import AugmentedModel, LocalFilters
from fusion_gym.filters.markov_jump_errors import LagRecursion
from fusion_gym.filters.robust import JointErrorCovariance, RobustKalmanFilter, RobustPlan
from fusion_gym.filters.stochastic import StochasticEventFilter
from fusion_gym.filters.tobit import TobitKalmanFilter

__all__ = [
    "AssumedDensityFilter",
    "AugmentedModel",
    "BoundConstants",
    "BoundTobitFilter",
    "CentralisedLinearFilter",
    "EventError",
    "Expectation",
    "InteractingModels",
    "JointErrorCovariance",
    "KalmanFilter",
    "LagRecursion",
    "LocalFilters",
    "NodeFilter",
    "Plan",
    "RobustKalmanFilter",
    "RobustPlan",
    "StochasticEventFilter",
    "TobitKalmanFilter",
]
