"""Plants: how the state moves."""

from fusion_gym.plants.linear import LinearPlant
from fusion_gym.plants.markov_jump import MarkovJumpPlant
from fusion_gym.plants.unknown_input import UnknownInputPlant

__all__ = [
    "LinearPlant",
    "MarkovJumpPlant",
    "UnknownInputPlant",
]
