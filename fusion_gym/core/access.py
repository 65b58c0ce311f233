"""Medium access: the sensors that may use the network in a step, before tokens are spent."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.declaration import Mark, OptionGroup, Scaling
from fusion_gym.errors import refusal
from fusion_gym.namespace import namespace, ndtr, ranked_sum

Requests = NDArray[np.bool_]


@dataclass(frozen=True)
class AccessRow:
    """A row of the table of access rules.

    Args:
        meaning: Short description.
        turn: Function of the number of sensors, the steps taken so far (N,) and standard normals
            (channels, N) that returns the only sensor (N,) that may request; ``None`` admits all.
        random: Whether ``turn`` uses the first row of the normals.
        limited: Whether at most ``slots`` requests are granted in a step.
        by_discrepancy: Whether the requests of the largest discrepancies are granted, instead of
            the first in the queue.
        contended: Whether two packets on one of ``channels`` destroy each other.
        by_channel: Whether each granted request has one of ``slots`` channels of its own.
    """

    meaning: str
    turn: Callable[[int, NDArray[np.int64], Array], NDArray[np.int64]] | None = None
    random: bool = False
    limited: bool = False
    by_discrepancy: bool = False
    contended: bool = False
    by_channel: bool = False


def _lottery(sensors: int, step: NDArray[np.int64], noise: Array) -> NDArray[np.int64]:
    drawn = (ndtr(noise[0]) * sensors).astype(np.int64)
    result: NDArray[np.int64] = namespace(noise).minimum(drawn, sensors - 1)
    return result


ACCESS: dict[str, AccessRow] = {
    "any": AccessRow("All requests are admitted."),
    "single": AccessRow("The first request in the queue is granted.", limited=True),
    "round_robin": AccessRow(
        "One sensor is admitted in turn (round_robin_tobit, equation (4)).",
        lambda sensors, step, noise: step % sensors,
    ),
    "random": AccessRow("One sensor is admitted at random.", _lottery, random=True),
    "slots": AccessRow("The first ``slots`` requests in the queue are granted.", limited=True),
    "try_once_discard": AccessRow(
        "The ``slots`` requests with the largest discrepancies are granted (G. C. Walsh, H. Ye and "
        'L. G. Bushnell, "Stability analysis of networked control systems", IEEE Trans. Control '
        "Systems Technology 10, 2002).",
        limited=True,
        by_discrepancy=True,
    ),
    "collision": AccessRow(
        "Every request goes to one of ``channels`` at random, and two on one are lost (L. G. "
        'Roberts, "ALOHA packet system with and without slots and capture", ACM SIGCOMM Computer '
        "Communication Review 5, 1975).",
        contended=True,
    ),
    "assignment": AccessRow(
        "At most ``channels`` requests are granted, each on a channel of its own. In the order of "
        "the queue each takes the free channel of the highest probability of arrival, unless the "
        "action assigns one.",
        limited=True,
        by_channel=True,
    ),
}


AccessRule = Annotated[str, ACCESS]


@dataclass(frozen=True)
class AccessOptions(OptionGroup):
    """The options of medium access."""

    access: Annotated[AccessRule, Scaling()] = "any"
    """Rule of medium access. ``"any"`` admits all requests, ``"single"`` the first in the queue.
    ``"round_robin"`` admits one sensor per step in turn, ``"random"`` one at random. ``"slots"``
    grants the first ``slots`` requests in the queue, ``"try_once_discard"`` those with the largest
    discrepancies. With ``"collision"`` every request goes to one of ``channels`` at random, and two
    on one are lost and paid for. ``"assignment"`` grants at most ``channels`` requests, each on a
    channel of its own, by default the free one of the highest probability of arrival in the order
    of the queue. With ``"single"`` the action space is ``Discrete(sensors + 1)``: 0
    is no request, m + 1 is sensor m."""
    slots: Annotated[int, Scaling(), Mark(validation.integer, at_least=1)] = 1
    """Largest number of grants per step with ``access="slots"`` or ``"try_once_discard"``."""
    discrepancy: Annotated[Literal["innovation", "held"], Scaling()] = "innovation"
    """Discrepancy of ``"try_once_discard"``: of the new measurement against its expectation
    (``"innovation"``) or the last delivered one (``"held"``)."""
    discrepancy_weights: Annotated[ArrayLike, Scaling()] = 1.0
    """Weights of the squared discrepancies: one number, or one per sensor."""
    channels: Annotated[int, Scaling(), Mark(validation.integer, at_least=1)] = 1
    """Channels of ``access="collision"`` or ``"assignment"``."""


def check_requests(requests: NDArray[Any], channels: int) -> None:
    """Check that requests are bool or numbers of channels, 0 for silence; JAX checks nothing."""
    kind = getattr(requests, "dtype", None)
    if kind == np.bool_ or (kind is not None and not isinstance(requests, np.ndarray)):
        return
    whole = kind is not None and kind.kind in "iu" and channels > 0
    if not whole or not np.all((requests >= 0) & (requests <= channels)):
        allowed = f"bool, or with access='assignment' channels from 1 to {channels} and 0"
        allowed = allowed if channels else "bool, because this access assigns no channels"
        raise refusal("requests", requests, allowed)


def first_requests(requests: NDArray[Any], place: NDArray[np.int64], slots: int = 1) -> Requests:
    """Return at most ``slots`` of the requests (sensors, N), from the sensors of lowest place.

    Of requests that are numbers of channels it is one on each.
    """
    if requests.dtype != np.bool_:
        each = (first_requests(requests == channel, place) for channel in range(1, slots + 1))
        return functools.reduce(operator.or_, each)
    if slots > 1:
        return requests & (ranked_sum(requests * 1, place) <= slots)
    waiting = namespace(requests, place).where(requests, place, len(requests))
    return requests & (waiting == waiting.min(0))


def discrepancy(signals: Mapping[str, Any], kind: str) -> Array:
    """Return the sensors' own discrepancies (sensors, N), squared norms.

    Args:
        signals: Signals of an estimator, as arrays or functions.
        kind: ``"innovation"`` of the new measurement, or ``"held"`` for its difference from the
            last delivered one.
    """
    names = ("innovation",) if kind == "innovation" else ("measurement", "held")
    parts: list[Any] = [signals[name] for name in names]
    first, *second = (part() if callable(part) else part for part in parts)
    difference = first - second[0] if second else first
    return linalg.dot(difference, difference)


def place_of(size: Array, queue: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return places (sensors, N), 0 for the largest size; equal ones follow the queue."""
    xp = namespace(size, queue)
    place: NDArray[np.int64] = xp.argsort(xp.lexsort((queue, -size), axis=0), axis=0)
    return place


def assign(granted: Requests, place: NDArray[np.int64], probability: Array) -> NDArray[np.int64]:
    """Return the channels (sensors, N) of granted requests, 0 without one.

    In the order of places each takes the free channel of the highest probability of arrival.

    Args:
        granted: (sensors, N), at most one for each channel.
        place: Places (sensors, N) of the sensors, a permutation.
        probability: Probability of an arrival (sensors, channels, N).
    """
    xp, channels = namespace(granted, probability), probability.shape[1]
    rank, numbers = ranked_sum(granted * 1, place), np.arange(channels)[:, None]
    result, free = granted * 0, xp.ones(probability.shape[1:], dtype=np.bool_)
    for turn in range(1, channels + 1):
        own = granted & (rank == turn)
        chance = xp.where(own[:, None], probability, 0.0).sum(0)
        best = xp.where(free, chance, -1.0).argmax(0)
        result = xp.where(own, best + 1, result)
        free = free & ((numbers != best) | ~own.any(0))
    return result


def channel_requests(assignment: NDArray[Any], sensors: int) -> NDArray[np.int64]:
    """Return the channel (…, sensors, N) of each sensor, its first of several, or 0.

    Args:
        assignment: Number (…, channels, N) of the sensor of each channel from 1, or 0 for nobody.
        sensors: Number of sensors.
    """
    own = assignment[..., None, :, :] == np.arange(1, sensors + 1)[:, None, None]
    result: NDArray[np.int64] = namespace(own).where(own.any(-2), own.argmax(-2) + 1, 0)
    return result


def collisions(granted: Requests, frequency: NDArray[np.int64] | int, channels: int) -> Requests:
    """Return the packets (sensors, N) that share their ``frequency`` (channel) with another one."""
    lost = granted & False
    for channel in range(channels):
        packets = granted & (frequency == channel)
        lost = lost | (packets & (packets.sum(0) > 1))
    return lost
