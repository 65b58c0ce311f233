"""The problem of optimal silence that remains after all other limits are relaxed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import validation
from fusion_gym.arrays import Array


@dataclass(frozen=True)
class SilenceProblem:
    """The difference between the sensors' and the centre's knowledge, with a price of each packet.

    The difference e starts at 0 and moves as e(t) = A e(t-1) + w(t), w(t) ~ N(0, Σ(t)), for t =
    1..H. A silent step then costs Σᵢ Wᵢ eᵢ². A packet costs ``price`` and leaves the e that is best
    for the future.

    Shapes: ``transition`` A (n, n), ``weights`` W (n,), all > 0, ``noise`` Σ (H, n, n), of any
    rank. :meth:`create` builds a checked problem.
    """

    transition: Array
    weights: Array
    noise: Array
    price: float

    @classmethod
    def create(
        cls, transition: ArrayLike, weights: ArrayLike, noise: ArrayLike, price: float
    ) -> SilenceProblem:
        """Return the checked problem; ``noise`` is one covariance per step."""
        matrix = validation.square("transition", transition)
        size = len(matrix)
        values = np.asarray(noise, dtype=np.float64)
        if values.ndim != 3 or not len(values):
            raise validation.ConfigurationError(
                f"noise of shape {values.shape} is not allowed: it must be (steps, {size}, {size})"
            )
        for covariance in values:
            validation.covariance("noise", covariance, size)
        return cls(
            transition=matrix,
            weights=validation.positive("weights", weights, (size,)),
            noise=values,
            price=validation.number("price", price, above=0.0),
        )

    @property
    def horizon(self) -> int:
        """Number of steps H."""
        return len(self.noise)

    @property
    def size(self) -> int:
        """Number of states n."""
        return len(self.transition)
