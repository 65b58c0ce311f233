"""Medium access: the sensors that may use the network in a step, before tokens are spent."""

from typing import get_args

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array
from fusion_gym.core.options import AccessRule
from fusion_gym.namespace import namespace, ndtr

ACCESS_RULES: tuple[str, ...] = get_args(AccessRule)


def access_mask(
    rule: str, sensors: int, step: NDArray[np.int64], noise: Array | None
) -> NDArray[np.bool_]:
    """Return the sensors (sensors, N) bool that the network admits in a step.

    Args:
        rule: ``"any"`` and ``"single"`` admit all sensors; ``"single"`` then grants one request
            (:func:`first_request`). ``"round_robin"`` admits sensor ``step % sensors``
            (round_robin_tobit, equation (4)), ``"random"`` a random one.
        sensors: Number of sensors.
        step: Steps taken so far (N,).
        noise: Standard normals (N,) for ``"random"``.
    """
    if rule == "round_robin":
        turn = step % sensors
    elif rule == "random":
        assert noise is not None, "random access needs noise"
        turn = namespace(noise).minimum((ndtr(noise) * sensors).astype(np.int64), sensors - 1)
    else:
        return np.ones((sensors, len(step)), dtype=np.bool_)
    return np.arange(sensors)[:, None] == turn


def first_request(requests: NDArray[np.bool_], place: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return at most one of the requests (sensors, N), from the sensor with the lowest place."""
    waiting = namespace(requests, place).where(requests, place, len(requests))
    return requests & (waiting == waiting.min(0))
