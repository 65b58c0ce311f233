"""Plants: how the state moves."""

from fusion_gym.plants.linear import LinearPlant

__all__ = ["LinearPlant"]
