"""Systems: a plant, its sensors, node filters and a fusion centre, joined into one step."""

from fusion_gym.systems.base import Feature, Signal, Signals, System
from fusion_gym.systems.censored import CensoredState, CensoredSystem
from fusion_gym.systems.centre import FederatedCentre, SequentialCentre

__all__ = [
    "CensoredState",
    "CensoredSystem",
    "Feature",
    "FederatedCentre",
    "SequentialCentre",
    "Signal",
    "Signals",
    "System",
]
