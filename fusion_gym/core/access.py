"""Medium access: the sensors that may use the network in a step, before tokens are spent."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array
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
    """

    meaning: str
    turn: Callable[[int, NDArray[np.int64], Array], NDArray[np.int64]] | None = None
    random: bool = False
    limited: bool = False
    by_discrepancy: bool = False
    contended: bool = False


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
}


def first_requests(requests: Requests, place: NDArray[np.int64], slots: int = 1) -> Requests:
    """Return at most ``slots`` of the requests (sensors, N), from the sensors of lowest place."""
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


def collisions(granted: Requests, frequency: NDArray[np.int64] | int, channels: int) -> Requests:
    """Return the packets (sensors, N) that share their ``frequency`` (channel) with another one."""
    lost = granted & False
    for channel in range(channels):
        packets = granted & (frequency == channel)
        lost = lost | (packets & (packets.sum(0) > 1))
    return lost
