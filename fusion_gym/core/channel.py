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
        truth: Range (low, high) of the true probability of independent losses, of which each
            episode draws; ``None`` is ``drop``.

    Source: Chakravorty and Mahajan, "Remote estimation over a packet-drop channel with Markovian
    state", IEEE Trans. Automatic Control 65, 2020, Section II.
    """

    transition: Array
    drop: Array
    initial: Array
    truth: tuple[float, float] | None = None

    @classmethod
    def perfect(cls, sensors: int) -> Channel:
        """Return a channel without losses."""
        return cls(np.ones((1, 1)), np.zeros((1, sensors)), np.ones(1))

    @classmethod
    def independent(
        cls, drop_probability: ArrayLike, sensors: int, truth: ArrayLike | None = None
    ) -> Channel:
        """Return a channel with independent losses.

        Args:
            drop_probability: One probability, or one per sensor.
            sensors: Number of sensors.
            truth: True probability, or a range (low, high) of which each episode draws.

        Raises:
            ConfigurationError: A probability is outside [0, 1].
        """
        drop = _probabilities("drop_probability", drop_probability, (1, sensors))
        if truth is None:
            return cls(np.ones((1, 1)), drop, np.ones(1))
        low, high = _probabilities("true_drop_probability", truth, (2,)).tolist()
        if np.ndim(truth) > 0 and not low < high:
            allowed = "a number from 0 to 1, or such a pair (low, high), low < high"
            raise validation.refusal("true_drop_probability", truth, allowed)
        return cls(np.ones((1, 1)), drop, np.ones(1), (low, high))

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
        if validation.array_shape(drop_probability) != (2,):
            allowed = "a pair of probabilities (bad, good)"
            raise validation.refusal("drop_probability", drop_probability, allowed)
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
        return bool(np.any(self.drop > 0.0)) or self.truth is not None

    @property
    def start_channels(self) -> int:
        """Number of standard normals of a start per sensor, and one for a drawn probability."""
        drawn = self.truth is not None and self.truth[0] < self.truth[1]
        return (self.drop.shape[1] if self.states > 1 else 0) + drawn

    def begin(self, noise: Array) -> Array | None:
        """Return the true probability (N,) of a loss; ``None`` is the model's.

        Args:
            noise: Standard normals (start_channels, N).
        """
        if self.truth is None:
            return None
        low, high = self.truth
        uniform = ndtr(noise[-1]) if low < high else 0.0
        return low + (high - low) * uniform + np.zeros(noise.shape[-1])

    def start(self, noise: Array) -> NDArray[np.int64]:
        """Return S(0), shape (sensors, N), from standard normals (sensors, N)."""
        return _choose(self.initial[:, None, None], noise)

    def advance(self, state: NDArray[np.int64], noise: Array) -> NDArray[np.int64]:
        """Return S(t), shape (sensors, N), from S(t-1) and standard normals (sensors, N)."""
        return _choose(namespace(state).asarray(self.transition.T)[:, state], noise)

    def lost(
        self, state: NDArray[np.int64], noise: Array, truth: Array | None = None
    ) -> NDArray[np.bool_]:
        """Return whether a packet sent in this state is lost, drawn for every sensor and step.

        Args:
            state: S(t), shape (sensors, N).
            noise: Standard normals (sensors, N), used whether or not a packet is sent.
            truth: True probability (N,) of a loss; ``None`` is the model's.
        """
        if truth is not None:
            return ndtr(noise) < truth
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
