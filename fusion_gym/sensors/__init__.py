"""Sensors: how the state is measured."""

from fusion_gym.sensors.censored import CensoredSensors
from fusion_gym.sensors.correlated import CorrelatedSensors
from fusion_gym.sensors.fading import FadingSensors

__all__ = [
    "CensoredSensors",
    "CorrelatedSensors",
    "FadingSensors",
]
