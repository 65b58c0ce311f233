"""Sensors: how the state is measured."""

from fusion_gym.sensors.censored import CensoredSensors

__all__ = ["CensoredSensors"]
