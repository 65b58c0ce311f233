"""Channels that lose what was granted: perfect, independent losses, Gilbert-Elliott."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.validation import ConfigurationError

STATES = ("bad", "good")  # of a Gilbert-Elliott channel, in the order of its matrices
InitialState = Literal["stationary", "bad", "good"]


@dataclass(frozen=True)
class Channel:
    """Each sensor's own channel: a Markov chain whose state sets the probability of a loss.

    The state moves from S(t-1) to S(t) at every step, used or not, and a packet sent at time t is
    lost with the probability that belongs to S(t). With one state, losses are independent.

    Shapes: ``transition`` (states, states), rows sum to 1; ``drop`` (states, sensors);
    ``initial`` (states,), the distribution of S(0).

    Source: Chakravorty and Mahajan, "Remote estimation over a packet-drop channel with Markovian
    state", IEEE Trans. Automatic Control 65, 2020, Section II.
    """

    transition: Array
    drop: Array
    initial: Array

    @classmethod
    def perfect(cls, sensors: int) -> Channel:
        """Nothing is ever lost."""
        return cls(np.ones((1, 1)), np.zeros((1, sensors)), np.ones(1))

    @classmethod
    def independent(cls, drop_probability: ArrayLike, sensors: int) -> Channel:
        """Every packet is lost with a probability: one number, or one for each sensor.

        Raises:
            ConfigurationError: not a probability, or another shape.
        """
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
        """Two states, bad and good, of the same chain for every sensor's own channel.

        ``transition`` is the (2, 2) matrix from the last state (row) to the next, ``drop`` the
        pair of loss probabilities (bad, good); ``initial`` is the state at time 0.

        Raises:
            ConfigurationError: not probabilities, rows that do not sum to 1, an unknown initial
                state, or a stationary start where the chain has no unique stationary law.
        """
        matrix = validation.array("channel_transition", transition, (2, 2))
        if np.any(matrix < 0.0) or not np.allclose(matrix.sum(1), 1.0, rtol=0.0, atol=1e-9):
            raise ConfigurationError(
                f"channel_transition = {validation.display(matrix)} is not allowed: it must have "
                "rows of probabilities that sum to 1"
            )
        drop = _probabilities("drop_probability", drop_probability, (2,))
        if initial == "stationary":
            leaves = matrix[[0, 1], [1, 0]]
            if leaves.sum() == 0.0:
                raise ConfigurationError(
                    "initial_channel = 'stationary' is not allowed with a channel that never "
                    "changes: it must be 'bad' or 'good'"
                )
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
        """Whether anything can be lost."""
        return bool(np.any(self.drop > 0.0))

    def start(self, noise: Array) -> NDArray[np.int64]:
        """S(0), shape (sensors, N), from standard normals (sensors, N)."""
        return _choose(self.initial[:, None, None], noise)

    def advance(self, state: NDArray[np.int64], noise: Array) -> NDArray[np.int64]:
        """S(t), shape (sensors, N), from S(t-1) and standard normals (sensors, N)."""
        return _choose(self.transition.T[:, state], noise)

    def lost(self, state: NDArray[np.int64], noise: Array) -> NDArray[np.bool_]:
        """Whether a packet sent in this state (sensors, N) is lost; standard normals (sensors, N).

        It is decided whether or not one is sent, so that a seed fixes it whatever the actions.
        """
        sensor = np.arange(len(state))[:, None]
        return ndtr(noise) < self.drop[state, sensor]


def _choose(probability: Array, noise: Array) -> NDArray[np.int64]:
    """Draw from probabilities (states, sensors, N) with one normal each."""
    uniform = ndtr(noise)
    result = np.zeros(noise.shape, dtype=np.int64)
    reached = np.zeros(noise.shape)
    for share in probability[:-1]:
        reached = reached + share
        result += uniform >= reached
    return result


def _probabilities(field: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    result = validation.not_negative(field, value, shape)
    if np.any(result > 1.0):
        raise validation.refusal(field, value, "between 0 and 1")
    return result
