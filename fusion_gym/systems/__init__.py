"""Systems: a plant, its sensors, node filters and a fusion centre, joined into one step."""

from fusion_gym.systems.base import Feature, Signal, Signals, System
from fusion_gym.systems.censored import CensoredState, CensoredSystem
from fusion_gym.systems.centre import FeedbackCentre, SequentialCentre
from fusion_gym.systems.correlated_tracking import (
    CorrelatedTrackingState,
    CorrelatedTrackingSystem,
)

__all__ = [
    "CensoredState",
    "CensoredSystem",
    "CorrelatedTrackingState",
    "CorrelatedTrackingSystem",
    "Feature",
    "FeedbackCentre",
    "SequentialCentre",
    "Signal",
    "Signals",
    "System",
]
