"""Systems: a plant, its sensors, node filters and a fusion centre, joined into one step."""

from fusion_gym.systems.base import Feature, Signal, Signals, System
from fusion_gym.systems.federated_tobit import FederatedTobitState, FederatedTobitSystem

__all__ = [
    "Feature",
    "FederatedTobitState",
    "FederatedTobitSystem",
    "Signal",
    "Signals",
    "System",
]
