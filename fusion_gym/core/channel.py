"""Lossy channels: perfect, independent losses, Gilbert-Elliott."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.declaration import NumpyOnly, OptionGroup, Scaling
from fusion_gym.errors import forbidden
from fusion_gym.namespace import namespace, ndtr

STATES = ("bad", "good")  # of a Gilbert-Elliott channel, in the order of its matrices
InitialState = Literal["stationary", "bad", "good"]


# Channels of each option, and the defaults of each channel.
_CHANNELS = {
    "drop_probability": ("independent", "gilbert_elliott"),
    "channel_transition": ("gilbert_elliott",),
    "initial_channel": ("gilbert_elliott",),
    "true_drop_probability": ("independent",),
}
_LONGEST = 100  # steps of a delay
_DROP: dict[str, ArrayLike] = {"perfect": 0.0, "independent": 0.2, "gilbert_elliott": (0.7, 0.2)}
_TRANSITION: ArrayLike = ((0.7, 0.3), (0.1, 0.9))


@dataclass(frozen=True)
class ChannelOptions(OptionGroup):
    """The options of losses, acknowledgements and delays."""

    channel: Annotated[Literal["perfect", "independent", "gilbert_elliott"], Scaling()] = "perfect"
    """Model of losses. ``"independent"`` loses every packet with one probability,
    ``"gilbert_elliott"`` with a probability for each channel state. The network feeds the last
    channel states back."""
    drop_probability: Annotated[ArrayLike | None, Scaling()] = None
    """Probability of a loss. Independent: one number, or one per sensor, by default 0.2; with
    ``access="assignment"`` also a matrix (sensors, channels). Gilbert-Elliott: the pair (bad,
    good), or without an assignment a row of it per sensor, by default (0.7, 0.2)."""
    channel_transition: Annotated[ArrayLike | None, Scaling()] = None
    """Probabilities from the last state (row; bad, good) to the next of a Gilbert-Elliott channel:
    a matrix, or one per sensor. By default ((0.7, 0.3), (0.1, 0.9))."""
    initial_channel: Annotated[InitialState, Scaling()] = "stationary"
    """State of a Gilbert-Elliott channel at time 0; ``"stationary"`` draws it from the stationary
    distribution."""
    true_drop_probability: ArrayLike | None = None
    """True probability of a loss of independent channels. Estimators and policies assume
    ``drop_probability``, the default. A pair (low, high) is a range from which each episode
    draws."""
    acknowledgements: Annotated[Literal["perfect", "none"] | float | None, NumpyOnly()] = "perfect"
    """Whether a sensor learns that a packet arrives or is lost: always (``"perfect"``), never
    (``"none"``), or with a probability. Otherwise it assumes an arrival, so that its ``held``
    and ``age`` refer to its last packet. The scheduler always knows."""
    delay: Annotated[ArrayLike, Scaling(), NumpyOnly()] = 0
    """Steps from a transmission to its arrival, at most 100: a whole number, or a pair (least,
    most) from which each packet draws uniformly, or a row (least, most) per sensor. The fusion
    centre repeats its updates from the time of a late packet on."""


@dataclass(frozen=True)
class Channel:
    """Each sensor's own channel: a Markov chain whose state sets the probability of a loss.

    The state moves from S(t-1) to S(t) at every step, used or not, and a packet sent at time t is
    lost with the probability of S(t). With one state, losses are independent.

    Args:
        options: The options.
        sensors: Number of sensors.
        channels: Number of channels of an assignment, of which every sensor has a link on each;
            ``None`` is one channel of each sensor's own.

    Raises:
        ConfigurationError: A probability is outside [0, 1], a row of the transition does not sum to
            1, the chain has no unique stationary distribution, or an option belongs to another
            channel.

    Source: Chakravorty and Mahajan, "Remote estimation over a packet-drop channel with Markovian
    state", IEEE Trans. Automatic Control 65, 2020, Section II.
    """

    options: ChannelOptions
    sensors: int
    channels: int | None = None

    def __post_init__(self) -> None:
        kind = self.options.channel
        for name, kinds in _CHANNELS.items():
            value = getattr(self.options, name)
            given = value is not None and not (isinstance(value, str) and value == "stationary")
            if given and kind not in kinds:
                reason = f"it belongs to {' and '.join(map(repr, kinds))}"
                raise forbidden(name, value, reason, f"with channel={kind!r}")
        for part in ("transition", "drop", "initial", "truth"):
            getattr(self, part)  # which checks it

    @cached_property
    def transition(self) -> Array:
        """Probabilities (sensors · channels, states, states) from the last state (row) on."""
        if self.options.channel != "gilbert_elliott":
            return np.ones((self.drop.shape[1], 1, 1))
        value: ArrayLike | None = self.options.channel_transition
        value = _TRANSITION if value is None else value
        each = validation.array_shape(value) == (self.sensors, 2, 2)
        matrix = validation.array("channel_transition", value, (self.sensors,) * each + (2, 2))
        if np.any(matrix < 0.0) or not np.allclose(matrix.sum(-1), 1.0, rtol=0.0, atol=1e-9):
            reason = "it must have rows of probabilities that sum to 1"
            raise forbidden("channel_transition", matrix, reason)
        return self._by_link(matrix, (2, 2))

    @cached_property
    def drop(self) -> Array:
        """Loss probabilities (states, sensors · channels)."""
        kind = self.options.channel
        shape = (self.sensors,) if self.channels is None else (self.sensors, self.channels)
        drop: ArrayLike | None = self.options.drop_probability
        drop = _DROP[kind] if drop is None else drop
        if kind != "gilbert_elliott":
            drop = validation.by_row(drop, shape) if self.channels else drop
            return _probabilities("drop_probability", drop, shape).reshape(1, -1)
        own = validation.array_shape(drop)
        if own != (2,) and (own != (self.sensors, 2) or self.channels):  # a column is a channel's
            allowed = "a pair of probabilities (bad, good), or without an assignment one per sensor"
            raise validation.refusal("drop_probability", drop, allowed)
        return self._by_link(_probabilities("drop_probability", drop, own), (2,)).T

    def _by_link(self, value: Array, shape: tuple[int, ...]) -> Array:
        """Return a value for all or each of the sensors as one for each link."""
        return np.repeat(np.broadcast_to(value, (self.sensors, *shape)), self.channels or 1, axis=0)

    @cached_property
    def initial(self) -> Array:
        """Distributions (states, sensors · channels) of S(0)."""
        initial, matrix = self.options.initial_channel, self.transition
        if matrix.shape[-1] == 1:
            return np.ones((1, len(matrix)))
        if initial != "stationary":
            return np.repeat(np.eye(2)[:, [STATES.index(initial)]], len(matrix), axis=1)
        leaves = matrix[:, [0, 1], [1, 0]].T
        if np.any(leaves.sum(0) == 0.0):
            where = "with a channel that never changes"
            raise validation.refusal("initial_channel", "stationary", "'bad' or 'good'", where)
        return np.asarray(leaves[::-1] / leaves.sum(0))

    @cached_property
    def truth(self) -> tuple[float, float] | None:
        """Range (low, high) of the true probability of a loss; ``None`` is :attr:`drop`."""
        truth = self.options.true_drop_probability
        if truth is None:
            return None
        low, high = _probabilities("true_drop_probability", truth, (2,)).tolist()
        if np.ndim(truth) > 0 and not low < high:
            allowed = "a number from 0 to 1, or such a pair (low, high), low < high"
            raise validation.refusal("true_drop_probability", truth, allowed)
        return low, high

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
        return _choose(self.initial[..., None], noise)

    def advance(self, state: NDArray[np.int64], noise: Array) -> NDArray[np.int64]:
        """Return S(t), shape (sensors, N), from S(t-1) and standard normals (sensors, N)."""
        following, link = np.moveaxis(self.transition, -1, 0), np.arange(len(state))[:, None]
        return _choose(namespace(state).asarray(following)[:, link, state], noise)

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


def make_acknowledgement(options: ChannelOptions) -> float:
    """Return the probability that the sender of a packet learns whether it arrives."""
    value, allowed = options.acknowledgements, "'perfect', 'none' or a number from 0 to 1"
    if value is None or isinstance(value, str):
        if (value or "none") not in (words := {"perfect": 1.0, "none": 0.0}):
            raise validation.refusal("acknowledgements", value, allowed)
        return words[value or "none"]
    return validation.number("acknowledgements", value, at_least=0.0, at_most=1.0)


def make_delay(options: ChannelOptions, sensors: int) -> Array:
    """Return the probabilities (sensors, D + 1) of a delay of 0, 1, … steps."""
    value: Any = options.delay
    shape = validation.array_shape(value)
    allowed = (
        "a whole number, a pair (least, most), least < most, or a row (least, most) per sensor"
    )
    if shape not in ((), (2,), (sensors, 2)):
        raise validation.refusal("delay", value, allowed)
    rows = value if shape == (sensors, 2) else [value if shape else (value, value)] * sensors
    ends = [
        [validation.integer("delay", end, at_least=0, at_most=_LONGEST) for end in row]
        for row in rows
    ]
    least, most = np.array(ends).T[..., None]
    if np.any(least > most) or (shape == (2,) and np.any(least == most)):
        raise validation.refusal("delay", value, allowed)
    steps = np.arange(most.max() + 1)
    possible = (least <= steps) & (steps <= most)
    return np.asarray(possible / possible.sum(1, keepdims=True))
