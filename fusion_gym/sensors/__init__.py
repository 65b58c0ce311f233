"""Sensors: how the state is measured."""

from fusion_gym.sensors.censored import CensoredSensors
from fusion_gym.sensors.correlated import CorrelatedSensors

__all__ = ["CensoredSensors", "CorrelatedSensors"]
