"""Systems: a plant, its sensors, node filters and a fusion centre, joined into one step."""

from fusion_gym.systems.base import Feature, Signal, Signals, System
from fusion_gym.systems.censored import CensoredState, CensoredSystem
from fusion_gym.systems.centre import FeedbackCentre, SequentialCentre
from fusion_gym.systems.correlated_tracking import (
    CorrelatedTrackingState,
    CorrelatedTrackingSystem,
)
from fusion_gym.systems.markov_jump import MarkovJumpState, MarkovJumpSystem
from fusion_gym.systems.markov_jump_central import MarkovJumpCentralSystem
from fusion_gym.systems.remote_estimation import RemoteEstimationSystem
from fusion_gym.systems.unknown_input import UnknownInputSystem

__all__ = [
    "CensoredState",
    "CensoredSystem",
    "CorrelatedTrackingState",
    "CorrelatedTrackingSystem",
    "Feature",
    "FeedbackCentre",
    "MarkovJumpCentralSystem",
    "MarkovJumpState",
    "MarkovJumpSystem",
    "RemoteEstimationSystem",
    "SequentialCentre",
    "Signal",
    "Signals",
    "System",
    "UnknownInputSystem",
]
