"""Relative value iteration: bounds of the least average cost of a step."""

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from fusion_gym.arrays import Array
from fusion_gym.validation import ConfigurationError

ChoiceT = TypeVar("ChoiceT")


def iterate_values(
    decide: Callable[[Array], tuple[Array, ChoiceT]],
    shape: tuple[int, ...],
    tolerance: float,
    iterations: int,
    laziness: float = 0.0,
) -> tuple[float, float, ChoiceT]:
    """Return bounds of the least average cost within a relative ``tolerance``, and the choice.

    Args:
        decide: function from the values of the next step to the present values and the choice.
        shape: shape of the values.
        tolerance: largest relative distance of the bounds.
        iterations: largest number of iterations.
        laziness: weight of the old values.
    """
    value, lower, upper = np.zeros(shape), 0.0, 0.0
    for _ in range(iterations):
        new, choice = decide(value)
        change = new - value
        lower, upper = float(change.min()), float(change.max())
        if upper - lower <= tolerance * max(abs(upper), 1e-300):
            return lower, upper, choice
        if laziness:
            value = value + (1.0 - laziness) * (change - change.flat[0])
        else:
            value = new - new.flat[0]
    raise ConfigurationError(
        f"iterations = {iterations} are not enough: the average cost is only known to lie between "
        f"{lower:.6g} and {upper:.6g}"
    )
