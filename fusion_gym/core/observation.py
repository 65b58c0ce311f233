"""Which entries an agent's observation has, by name, and how it is filled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array
from fusion_gym.core.system import Feature
from fusion_gym.core.task import Task

_NOTHING = np.empty((0, 1))


class ObservationLayout:
    """Which entries an agent's observation has, by name, and how it is filled.

    ``entries`` are its features, ``names`` has one name an entry, ``low`` and ``high`` (entries,)
    float32 are its bounds.
    """

    def __init__(self, task: Task) -> None:
        admitted = tuple(
            Feature(f"admitted[{sensor}]", "centre", 0.0, 1.0, sensor=sensor)
            for sensor in range(task.sensors if task.access in ("round_robin", "random") else 0)
        )
        self._price = task.reward.price if task.reward.price.span is not None else None
        price = (
            () if self._price is None else (Feature("price", "centre", 0.0, 1.0, broadcast=True),)
        )
        tokens = (Feature("tokens", "centre", 0.0, 1.0, broadcast=True),)
        blocks = (*task.system.features, tokens, admitted, price)
        self._kept = [
            number
            for number, block in enumerate(blocks)
            if block and (task.information == "sensors" or block[0].knowledge == "centre")
        ]
        entries = [entry for number in self._kept for entry in blocks[number]]
        self.entries = tuple(entries)
        self.names = tuple(entry.name for entry in entries)
        self.low = np.array([entry.low for entry in entries], dtype=np.float32)
        self.high = np.array([entry.high for entry in entries], dtype=np.float32)
        self._shows_admitted = bool(admitted)
        self._capacity = task.bucket.capacity
        self._system = task.system

    def encode(
        self, state: Any, tokens: Array, admitted: Callable[[], NDArray[np.bool_]], price: Array
    ) -> np.ndarray[Any, np.dtype[np.float32]]:
        """Observations (N, entries) float32, clipped to their bounds.

        ``tokens`` (N,) and ``admitted()`` (sensors, N) are the network's, ``price`` (N,) is that
        of a token.
        """
        blocks = [*self._system.observe(state), tokens[None] / self._capacity]
        blocks.append(admitted().astype(np.float64) if self._shows_admitted else _NOTHING)
        if self._price is not None:
            blocks.append(self._price.encode(price)[None])
        rows = np.concatenate([blocks[number] for number in self._kept])
        result = np.ascontiguousarray(rows.T, dtype=np.float32)
        np.maximum(result, self.low, out=result)
        return np.minimum(result, self.high, out=result)
