"""Lossy channels: perfect, independent losses, Gilbert-Elliott."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.errors import forbidden
from fusion_gym.namespace import namespace, ndtr

STATES = ("bad", "good")  # of a Gilbert-Elliott channel, in the order of its matrices
InitialState = Literal["stationary", "bad", "good"]


@dataclass(frozen=True)
class Channel:
    """Each sensor's own channel: a Markov chain whose state sets the probability of a loss.

    The state moves from S(t-1) to S(t) at every step, used or not, and a packet sent at time t is
    lost with the probability of S(t). With one state, losses are independent.

    Args:
        transition: (states, states), rows sum to 1.
        drop: Loss probabilities (states, sensors).
        initial: Distribution (states,) of S(0).

    Source: Chakravorty and Mahajan, "Remote estimation over a packet-drop channel with Markovian
    state", IEEE Trans. Automatic Control 65, 2020, Section II.
    """

    transition: Array
    drop: Array
    initial: Array

    @classmethod
    def perfect(cls, sensors: int) -> Channel:
        """Return a channel without losses."""
        return cls(np.ones((1, 1)), np.zeros((1, sensors)), np.ones(1))

    @classmethod
    def independent(cls, drop_probability: ArrayLike, sensors: int) -> Channel:
        """Return a channel with independent losses, one probability or one per sensor."""
        drop = _probabilities("drop_probability", drop_probability, (1, sensors))
        return cls(np.ones((1, 1)), drop, np.ones(1))

    @classmethod
    def gilbert_elliott(
        cls,
        transition: ArrayLike,
        drop_probability: ArrayLike,
        sensors: int,
        initial: str = "stationary",
    ) -> Channel:
        """Return independent channels with the states bad and good, one channel per sensor.

        Args:
            transition: (2, 2), from the last state (row) to the next.
            drop_probability: Loss probabilities (bad, good).
            sensors: Number of sensors.
            initial: State at time 0: ``"stationary"``, ``"bad"`` or ``"good"``.

        Raises:
            ConfigurationError: A probability is outside [0, 1], a row does not sum to 1, or the
                chain has no unique stationary law.
        """
        matrix = validation.array("channel_transition", transition, (2, 2))
        if np.any(matrix < 0.0) or not np.allclose(matrix.sum(1), 1.0, rtol=0.0, atol=1e-9):
            reason = "it must have rows of probabilities that sum to 1"
            raise forbidden("channel_transition", matrix, reason)
        drop = _probabilities("drop_probability", drop_probability, (2,))
        if initial == "stationary":
            leaves = matrix[[0, 1], [1, 0]]
            if leaves.sum() == 0.0:
                where = "with a channel that never changes"
                raise validation.refusal("initial_channel", "stationary", "'bad' or 'good'", where)
            start = leaves[::-1] / leaves.sum()
        else:
            start = np.eye(2)[STATES.index(initial)]
        return cls(matrix, np.repeat(drop[:, None], sensors, axis=1), start)

    @property
    def states(self) -> int:
        """Number of channel states."""
        return len(self.initial)

    @property
    def loses(self) -> bool:
        """Whether a loss probability is positive."""
        return bool(np.any(self.drop > 0.0))

    def start(self, noise: Array) -> NDArray[np.int64]:
        """Return S(0), shape (sensors, N), from standard normals (sensors, N)."""
        return _choose(self.initial[:, None, None], noise)

    def advance(self, state: NDArray[np.int64], noise: Array) -> NDArray[np.int64]:
        """Return S(t), shape (sensors, N), from S(t-1) and standard normals (sensors, N)."""
        return _choose(namespace(state).asarray(self.transition.T)[:, state], noise)

    def lost(self, state: NDArray[np.int64], noise: Array) -> NDArray[np.bool_]:
        """Return whether a packet sent in this state is lost, drawn for every sensor and step.

        Args:
            state: S(t), shape (sensors, N).
            noise: Standard normals (sensors, N), used whether or not a packet is sent.
        """
        sensor = np.arange(len(state))[:, None]
        return ndtr(noise) < namespace(state).asarray(self.drop)[state, sensor]


def _choose(probability: Array, noise: Array) -> NDArray[np.int64]:
    """Draw from probabilities (states, sensors, N) with one normal each."""
    xp, uniform = namespace(probability, noise), ndtr(noise)
    result = xp.zeros(noise.shape, dtype=np.int64)
    reached = xp.zeros(noise.shape)
    for share in probability[:-1]:
        reached = reached + share
        result += uniform >= reached
    return result


def _probabilities(field: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    result = validation.not_negative(field, value, shape)
    if np.any(result > 1.0):
        raise validation.refusal(field, value, "between 0 and 1")
    return result
