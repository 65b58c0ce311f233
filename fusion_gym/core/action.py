"""The action: what the output of a policy means, for every interface.

An action is a choice for each of some factors, such as silence or a request of each sensor.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.core.access import channel_requests
from fusion_gym.core.knowledge import Knowledge
from fusion_gym.declaration import NumpyOnly, OptionGroup
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
        limited: Whether some sets of requests have no action.
    """

    meaning: str = "A 1 requests the sensor"
    bits: ClassVar[bool] = True
    limited: ClassVar[bool] = False

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

    def requests(
        self, actions: Any, runs: int | None, signals: Callable[[], Mapping[str, Any]] = dict
    ) -> NDArray[Any]:
        """Return the requests (sensors, N), or assigned channels, of the actions of N runs.

        Args:
            actions: Actions of N runs, or of one run without the axis N.
            runs: Number N of runs; ``None`` is one run without the axis N.
            signals: Function that returns the present signals, for thresholds.

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

    def actions(self, requests: Requests) -> NDArray[Any]:
        """Return the actions (N, …) of N runs with these requests (sensors, N)."""
        return np.ascontiguousarray(requests.T.astype(self.space.dtype))

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

    def actions(self, requests: Requests) -> NDArray[Any]:
        """See :class:`Action`."""
        return super().actions(requests).reshape(-1)

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

    def actions(self, requests: Requests) -> NDArray[Any]:
        """See :class:`Action`."""
        return np.asarray(2 ** np.arange(self.sensors) @ requests.astype(np.int64))

    def places(self, outputs: int) -> slice | None:
        """See :class:`Action`."""
        return None


class Assignment(Action):
    """The number of a sensor for each channel, as ``MultiDiscrete``; 0 is nobody."""

    meaning = "The number of each channel is 0 for nobody, m for sensor m - 1"
    bits = False
    limited = True

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

    def actions(self, requests: NDArray[Any]) -> NDArray[Any]:
        """See :class:`Action`."""
        each = requests == np.arange(1, self.channels + 1)[:, None, None]
        return np.where(each.any(1), each.argmax(1) + 1, 0).T

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

    def actions(self, requests: Requests) -> NDArray[Any]:
        """See :class:`Action`."""
        return np.where(requests.any(0), requests.argmax(0) + 1, 0)

    def places(self, outputs: int) -> slice | None:
        """See :class:`Action`."""
        return slice(1, None)

    def choose(self, scores: Array, threshold: Array) -> Requests:
        """See :class:`Action`."""
        return super().choose(scores, threshold) & _largest(scores)


class Score(NamedTuple):
    """A quantity of each sensor that its threshold is compared with.

    Args:
        meaning: Short description, over the reference of the threshold.
        names: Names of the signals that it uses.
        value: Function from signals and the reward's weight of a squared error to (sensors, N).
        knowledge: Least class that knows it.
        bounds: Lowest and highest logarithm of the threshold, which tell the scores apart.
    """

    meaning: str
    names: tuple[str, ...]
    value: Callable[[Mapping[str, Any], float], Array]
    knowledge: Knowledge
    bounds: tuple[float, float]


def _innovation(signals: Mapping[str, Any], scale: float) -> Array:
    whitened = signals["innovation"] / signals["innovation_deviation"]
    return np.asarray(np.sqrt(linalg.dot(whitened, whitened)))


SCORES = {
    "innovation": Score(
        "the norm of the innovation in its predicted deviations",
        ("innovation", "innovation_deviation"), _innovation, "own", (-3.0, 3.0),
    ),
    "value": Score(
        "the value of a transmission in units of the reward",
        ("transmission_value",),
        lambda signals, scale: scale * signals["transmission_value"], "scheduler", (-7.0, 4.0),
    ),
    "variance": Score(
        "the variance that a transmission removes, in units of the reward",
        ("variance_reduction",),
        lambda signals, scale: scale * signals["variance_reduction"], "centre", (-6.0, 5.0),
    ),
}  # fmt: skip
_FAR = 50.0  # logarithm of a ratio that decides alone


class Threshold(Action):
    """The logarithm of a threshold for each sensor, as ``Box``, on one of :data:`SCORES`.

    A sensor requests if its score reaches its threshold. At the lower bound it always requests, at
    the upper bound never.

    Args:
        sensors: Number of sensors.
        score: The score.
        scale: The reward's weight of a squared error.
        single: Whether only the largest ratio of score and threshold requests.
    """

    bits = False

    def __init__(self, sensors: int, score: Score, scale: float, single: bool) -> None:
        super().__init__(sensors)
        self.score, self.scale, self.single = score, scale, single
        self.meaning = f"A number is the logarithm of the sensor's threshold on {score.meaning}"

    @cached_property
    def space(self) -> Any:
        """See :class:`Action`."""
        return spaces.Box(*self.score.bounds, (self.sensors,), np.float32)

    def requests(
        self, actions: Any, runs: int | None, signals: Callable[[], Mapping[str, Any]] = dict
    ) -> Requests:
        """See :class:`Action`."""
        values, (low, high) = self._values(actions, runs), self.score.bounds
        _check(values, (values >= low) & (values <= high), f"a number from {low:g} to {high:g}")
        ratio = self.log_ratio(values.reshape(-1, self.sensors).T, signals())
        return self.choose(ratio, np.zeros(()))

    def log_ratio(self, thresholds: Array, signals: Mapping[str, Any]) -> Array:
        """Return the finite logarithm (sensors, N) of scores over thresholds (logarithms)."""
        score, (low, high) = self.score.value(signals, self.scale), self.score.bounds
        ratio = np.log(np.clip(score, np.exp(-_FAR), np.exp(_FAR))) - thresholds
        ratio = np.where(thresholds <= low, _FAR, ratio)
        return np.where(thresholds >= high, -_FAR, ratio)

    def choose(self, scores: Array, threshold: Array) -> Requests:
        """See :class:`Action`."""
        chosen = super().choose(scores, threshold)
        return chosen & _largest(scores) if self.single else chosen

    def actions(self, requests: Requests) -> NDArray[Any]:
        """Return the bounds of the space as the actions (N, sensors) of requests (sensors, N)."""
        return np.where(requests.T, *self.score.bounds).astype(np.float32)

    def logits(self, rate: float) -> Array:
        """Refuse a rate, which depends on the scores."""
        raise refusal("initial_rate", rate, "left out", "with action='threshold'")

    def masks(self, allowed: Requests) -> NDArray[np.bool_]:
        """Refuse masks, which choices alone have."""
        raise refusal("action", "threshold", "a kind of choices", "with a mask")


ACTIONS: dict[str, type[Action]] = {
    "binary": Action,
    "multidiscrete": Pairs,
    "discrete": Sets,
    "assignment": Assignment,
    "threshold": Threshold,
}


@dataclass(frozen=True)
class ActionOptions(OptionGroup):
    """The options of the action space, and of the code that computes a step."""

    action: Annotated[str, ACTIONS, NumpyOnly("threshold")] = "binary"
    """Action space: one bit u_m per sensor, as ``MultiBinary`` (``"binary"``) or as
    ``MultiDiscrete`` (``"multidiscrete"``), or the number Σ u_m 2^m (``"discrete"``).
    ``"assignment"``, with that access, is ``MultiDiscrete([sensors + 1] * channels)``: each channel
    has 0 for nobody or m + 1 for sensor m, and a sensor on several uses the first.
    ``"threshold"`` is a ``Box`` with the logarithm of a threshold for each sensor, which requests
    if its ``score`` reaches it."""
    score: Annotated[str, SCORES] = "innovation"
    """Score of ``action="threshold"``: the norm of the innovation in its predicted deviations
    (``"innovation"``), the value of a transmission (``"value"``) or the variance that it removes
    (``"variance"``), both in units of the reward."""
    backend: Backend = "numpy"
    """Code that computes the steps. ``"compiled"``, the fastest, needs the extra ``compiled``: LLVM
    compiles the step once, in at most five seconds."""


def space_text(space: spaces.Space[Any]) -> str:
    """Return a space as Gymnasium writes it, in one line and with all its numbers."""
    with np.printoptions(threshold=sys.maxsize, linewidth=sys.maxsize):
        return str(space)


def _largest(scores: Array) -> Requests:
    """Return the sensor (sensors, N) of the largest score in each run, the first of equal ones."""
    result: Requests = scores.argmax(0) == np.arange(len(scores))[:, None]
    return result


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
