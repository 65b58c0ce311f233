"""The action: what the output of a policy means, for every interface.

An action is a choice for each of some factors, such as silence or a request of each sensor.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from fusion_gym.arrays import Array
from fusion_gym.core.access import channel_requests
from fusion_gym.declaration import OptionGroup
from fusion_gym.errors import display, refusal

Backend = Literal["numpy", "compiled"]
Choices = NDArray[Any]
Requests = NDArray[np.bool_]
_ONE = np.array(1, np.int8)  # which NumPy compares in half the time of a Python number


class Action:
    """One bit per sensor, as ``MultiBinary``; 1 is a request.

    Args:
        sensors: Number of sensors.
        channels: Number of channels of an assignment.

    Attributes:
        meaning: Text for pages.
        bits: Whether each factor is a sensor's silence or request.
    """

    meaning: ClassVar[str] = "A 1 requests the sensor"
    bits: ClassVar[bool] = True

    def __init__(self, sensors: int, channels: int = 1) -> None:
        self.sensors, self.channels = sensors, channels

    @cached_property
    def space(self) -> Any:
        """The action space."""
        return spaces.MultiBinary(self.sensors)

    @cached_property
    def factors(self) -> tuple[int, int]:
        """Number D of factors, and number C of choices of each."""
        return self.sensors, 2

    def decode(self, choices: Choices) -> NDArray[Any]:
        """Return the requests (…, sensors, N), or assigned channels, of choices (…, D, N).

        JAX may trace it.
        """
        requests: Requests = choices == 1
        return requests

    def requests(self, actions: Any, runs: int | None) -> NDArray[Any]:
        """Return the requests (sensors, N), or assigned channels, of the actions of N runs.

        Args:
            actions: Actions of N runs, or of one run without the axis N.
            runs: Number N of runs; ``None`` is one run without the axis N.

        Raises:
            ValueError: The actions have another shape, are not finite, or are not in the action
                space.
        """
        values, (count, choices) = self._values(actions, runs), self.factors
        if self.bits:
            requests: Requests = values == _ONE
            if np.count_nonzero(requests) < np.count_nonzero(values):
                _check(values, requests | (values == 0), "0 or 1")
            return np.ascontiguousarray(requests.reshape(-1, count).T)
        valid = (values >= 0) & (values < choices) & (values == np.floor(values))
        _check(values, valid, f"0..{choices - 1}")
        return self.decode(values.astype(np.int64).reshape(-1, count).T)

    def _values(self, actions: Any, runs: int | None) -> NDArray[Any]:
        """Return the actions as numbers of the right shape."""
        shape = self.space.shape or ()
        return _numbers(actions, shape if runs is None else (runs, *shape))

    @cached_property
    def table(self) -> Requests:
        """Requests (D·C, sensors) of each choice alone, with the first choice of other factors."""
        count, choices = self.factors
        alone = np.kron(np.eye(count, dtype=np.int64), np.arange(choices))
        return self.decode(alone).T > 0

    def masks(self, allowed: Requests) -> NDArray[np.bool_]:
        """Return the allowed choices (N, D·C), in the layout of sb3-contrib's MaskablePPO.

        Args:
            allowed: (sensors, N), whether the sensor may request.
        """
        closed: Any = (self.table[:, :, None] & ~allowed).any(1)
        return np.logical_not(closed).T

    def places(self, outputs: int) -> slice | None:
        """Return the places of requests among outputs; ``None`` if a sensor has none of its own."""
        return slice(1, None, 2) if outputs > self.sensors else slice(None)

    def scores(self, outputs: Array) -> Array | None:
        """Return the score (sensors, N) of each request over silence, from outputs (N, k)."""
        places = self.places(outputs.shape[1])
        if places is None:
            return None
        silence = np.delete(outputs, places, axis=1)
        scores: Array = outputs[:, places] - (silence if silence.size else 0.0)
        return scores.reshape(-1, self.sensors).T

    def choose(self, scores: Array, threshold: Array) -> Requests:
        """Return the requests (sensors, N) of an action by scores (sensors, N) and thresholds."""
        chosen: Requests = scores >= threshold
        return chosen

    def logits(self, rate: float) -> Array:
        """Return logits (D·C,) with which every sensor requests at ``rate``, from 0 to 1."""
        return self.table.sum(1) * np.log(rate / (1.0 - rate))


class Pairs(Action):
    """One bit per sensor, as ``MultiDiscrete``."""

    @cached_property
    def space(self) -> Any:
        """See :class:`Action`."""
        return spaces.MultiDiscrete([2] * self.sensors)


class OwnBit(Action):
    """The bit of one local sensor, ``Discrete(2)``, whose rows are adjacent in a run."""

    @cached_property
    def space(self) -> Any:
        """See :class:`Action`."""
        return spaces.Discrete(2)

    def _values(self, actions: Any, runs: int | None) -> NDArray[Any]:
        return _numbers(actions, ((1 if runs is None else runs) * self.sensors,))

    def masks(self, allowed: Requests) -> NDArray[np.bool_]:
        """Return the allowed choices (N·sensors, 2): silence and a request."""
        return super().masks(allowed).reshape(-1, 2)

    def places(self, outputs: int) -> slice | None:
        """See :class:`Action`."""
        return slice(1, None)

    def logits(self, rate: float) -> Array:
        """See :class:`Action`."""
        return super().logits(rate)[:2]


class Sets(Action):
    """The number Σ u_m 2^m of a set of requests, as ``Discrete``."""

    meaning = "The number has a bit for each sensor, the lowest bit for sensor 0"
    bits = False

    @cached_property
    def space(self) -> Any:
        """See :class:`Action`."""
        return spaces.Discrete(self.factors[1])

    @cached_property
    def factors(self) -> tuple[int, int]:
        """See :class:`Action`."""
        return 1, 2**self.sensors

    def decode(self, choices: Choices) -> NDArray[Any]:
        """See :class:`Action`."""
        requests: Requests = (choices >> np.arange(self.sensors)[:, None] & 1).astype(np.bool_)
        return requests

    def places(self, outputs: int) -> slice | None:
        """See :class:`Action`."""
        return None


class Assignment(Action):
    """The number of a sensor for each channel, as ``MultiDiscrete``; 0 is nobody."""

    meaning = "The number of each channel is 0 for nobody, m for sensor m - 1"
    bits = False

    @cached_property
    def space(self) -> Any:
        """See :class:`Action`."""
        count, choices = self.factors
        return spaces.MultiDiscrete([choices] * count)

    @cached_property
    def factors(self) -> tuple[int, int]:
        """See :class:`Action`."""
        return self.channels, self.sensors + 1

    def decode(self, choices: Choices) -> NDArray[Any]:
        """See :class:`Action`."""
        return channel_requests(choices, self.sensors)

    def places(self, outputs: int) -> slice | None:
        """See :class:`Action`."""
        return None

    def logits(self, rate: float) -> Array:
        """See :class:`Action`."""
        count, sensors = self.factors[0], self.sensors
        share = rate / count  # of each channel
        if sensors * share >= 1.0:
            allowed = f"< {count}/{sensors}, because one of {sensors} sensors uses a channel"
            raise refusal("initial_rate", rate, allowed)
        return np.tile(np.log([1.0 - sensors * share, *[share] * sensors]), count)


class Single(Assignment):
    """The number of the only sensor that requests, as ``Discrete``; 0 is nobody."""

    meaning = "0 is no request, m requests sensor m - 1"

    @cached_property
    def space(self) -> Any:
        """See :class:`Action`."""
        return spaces.Discrete(self.sensors + 1)

    @cached_property
    def factors(self) -> tuple[int, int]:
        """See :class:`Action`."""
        return 1, self.sensors + 1

    def decode(self, choices: Choices) -> NDArray[Any]:
        """See :class:`Action`."""
        requests: Requests = choices == np.arange(1, self.sensors + 1)[:, None]
        return requests

    def places(self, outputs: int) -> slice | None:
        """See :class:`Action`."""
        return slice(1, None)

    def choose(self, scores: Array, threshold: Array) -> Requests:
        """See :class:`Action`."""
        best = scores.argmax(0) == np.arange(self.sensors)[:, None]
        return super().choose(scores, threshold) & best


ACTIONS: dict[str, type[Action]] = {
    "binary": Action,
    "multidiscrete": Pairs,
    "discrete": Sets,
    "assignment": Assignment,
}


@dataclass(frozen=True)
class ActionOptions(OptionGroup):
    """The options of the action space, and of the code that computes a step."""

    action: Annotated[str, ACTIONS] = "binary"
    """Action space: one bit u_m per sensor, as ``MultiBinary`` (``"binary"``) or as
    ``MultiDiscrete`` (``"multidiscrete"``), or the number Σ u_m 2^m (``"discrete"``).
    ``"assignment"``, with that access, is ``MultiDiscrete([sensors + 1] * channels)``: each channel
    has 0 for nobody or m + 1 for sensor m, and a sensor on several uses the first."""
    backend: Backend = "numpy"
    """Code that computes the steps. ``"compiled"``, the fastest, needs the extra ``compiled``: LLVM
    compiles the step once, in at most six seconds."""


def space_text(space: spaces.Space[Any]) -> str:
    """Return a space as Gymnasium writes it, in one line and with all its numbers."""
    with np.printoptions(threshold=sys.maxsize, linewidth=sys.maxsize):
        return str(space)


def _numbers(actions: Any, shape: tuple[int, ...]) -> NDArray[Any]:
    """Return the actions as a numeric array of this shape, or raise a ``ValueError``."""
    try:
        values = np.asarray(actions)
    except ValueError:
        values = np.array(None)
    if values.dtype.kind not in "biuf":
        raise ValueError(
            f"action {display(actions)} is not allowed: it must be numbers of shape {shape}, not "
            f"{type(actions).__name__} of {values.dtype}"
        )
    if values.shape != shape:
        raise ValueError(
            f"action {display(values)} of shape {values.shape} is not allowed: its shape must be "
            f"{shape}"
        )
    return values


def _check(values: NDArray[Any], valid: NDArray[np.bool_], allowed: str) -> None:
    if not valid.all():
        place = tuple(int(i) for i in np.argwhere(~valid)[0])
        where = f"action {list(place)}" if place else "action"
        raise ValueError(f"{where} = {values[place]} is not allowed: it must be {allowed}")
