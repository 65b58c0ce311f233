"""The noise of episodes as a function of seed, episode number and step."""

from typing import Protocol

import numpy as np

from fusion_gym.arrays import Array

_CHUNK = 256  # normals per counter position, at least one step
_START, _STEPS, _UNIFORM = range(3)


class NoiseSource(Protocol):
    """A stateless source of standard normals: equal arguments give equal numbers."""

    def start(self, seed: int, episode: int, channels: int) -> Array:
        """Return the normals (channels,) of the episode's start."""

    def steps(self, seed: int, episode: int, first: int, count: int, channels: int) -> Array:
        """Return the normals (count, channels) of the sensings from number ``first`` on."""

    def uniform(self, seed: int, episode: int) -> float:
        """Return the number in [0, 1) that draws the episode's price."""


class PhiloxNoise:
    """The default :class:`NoiseSource`: a Philox generator with the seed as its key.

    The counter's words are the episode, the purpose and the chunk of steps, so every part of an
    episode is drawn independently of the other parts. Seeds from 2⁶⁴ on are hashed.

    Source: Salmon, Moraes, Dror and Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC 2011.

    Args:
        stream: Number of an independent stream: 0 of the plant, 1 of the network.
    """

    def __init__(self, stream: int = 0) -> None:
        self._first = 3 * stream
        self._generator = np.random.Generator(np.random.Philox(key=0))
        self._fresh = {**self._generator.bit_generator.state, "buffer": [0, 0, 0, 0]}

    def start(self, seed: int, episode: int, channels: int) -> Array:
        """Return the normals (channels,) of the episode's start."""
        return self._at(seed, episode, _START).standard_normal(channels)

    def steps(self, seed: int, episode: int, first: int, count: int, channels: int) -> Array:
        """Return the normals (count, channels) of the sensings from number ``first`` on."""
        length = max(1, _CHUNK // max(1, channels))
        chunk, skipped = divmod(first, length)
        drawn = np.empty((skipped + count, channels))
        for begin in range(0, len(drawn), length):
            generator = self._at(seed, episode, _STEPS, chunk + begin // length)
            generator.standard_normal(out=drawn[begin : begin + length])
        return drawn[skipped:]

    def uniform(self, seed: int, episode: int) -> float:
        """Return the number in [0, 1) that draws the episode's price."""
        return self._at(seed, episode, _UNIFORM).random()

    def _at(self, seed: int, episode: int, purpose: int, chunk: int = 0) -> np.random.Generator:
        key = [seed, 0]
        if seed >= 2**64:
            key = np.random.SeedSequence(seed).generate_state(2, np.uint64).tolist()
        position = {"counter": [0, chunk, episode, self._first + purpose], "key": key}
        self._generator.bit_generator.state = self._fresh | {"state": position}
        return self._generator
