"""When to be silent: the problem that is left once everything else is given away."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.validation import ConfigurationError


@dataclass(frozen=True)
class SilenceProblem:
    """How far the centre may be from what the sensors know, at a price for each packet.

    The difference e starts at 0 and moves as e(t) = A e(t-1) + w(t), w(t) ~ N(0, Σ(t)), for
    t = 1..H. Each step then costs Σᵢ Wᵢ eᵢ² after silence; a packet costs ``price`` and leaves
    whatever e is best for the future.

    Shapes: ``transition`` A (n, n), ``weights`` W (n,), all > 0, ``noise`` Σ (H, n, n), of any
    rank. Build one with :meth:`create`, which checks its arguments.
    """

    transition: Array
    weights: Array
    noise: Array
    price: float

    @classmethod
    def create(
        cls, transition: ArrayLike, weights: ArrayLike, noise: ArrayLike, price: float
    ) -> SilenceProblem:
        """Check the arrays; ``noise`` is one covariance a step.

        Raises:
            ConfigurationError: a wrong shape, a weight or a price that is not above 0, or a
                covariance that is not symmetric positive semi-definite.
        """
        matrix = validation.array("transition", transition, (None, None))
        size = len(matrix)
        matrix = validation.array("transition", matrix, (size, size))
        values = np.asarray(noise, dtype=np.float64)
        if values.ndim != 3 or not len(values):
            raise ConfigurationError(
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
