"""Sequential fusion: the centre's prediction and then one estimate after the other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.fusion.covariance_intersection import (
    covariance_intersection,
    inverse_covariance_intersection,
)
from fusion_gym.validation import ConfigurationError

_RULES = {"ci": covariance_intersection, "ici": inverse_covariance_intersection}


class SequentialResult(NamedTuple):
    """The fused estimate and what it is made of.

    ``mean`` (n, N) · ``covariance`` (n, n, N) · ``gains`` Θ (l + 1, n, n, N): the result is
    Θ_0 times the prediction plus Σ Θ_i times the estimate of sensor i (entry i of the input is
    entry i + 1 here), and the gains add up to I. The actual covariance of the result is
    Σ_ij Θ_i P̄_ij Θ_jᵀ with the actual covariances P̄_ij of the inputs.
    """

    mean: Array
    covariance: Array
    gains: Array


@dataclass(frozen=True)
class SequentialFusion:
    """Joins the prediction with each active estimate in turn, two at a time.

    ``rule`` is "ci" (covariance intersection, a bound for every correlation) or "ici" (inverse
    covariance intersection, smaller, a bound for common information only). ``order`` is the order
    of arrival, a permutation of the sensors 0 to l - 1; ``None`` stands for 0, 1, 2, ... The
    result depends on it.

    Raises:
        ConfigurationError: an unknown rule, or an order that is no permutation.

    Source: adaptive_innovation, equations (37) to (40) and (47) to (52), gains by (56) and (59).
    """

    rule: Literal["ci", "ici"] = "ci"
    order: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        validation.choice("rule", self.rule, _RULES)
        if self.order is not None:
            self.check_order(len(self.order) if isinstance(self.order, tuple) else 0)

    def check_order(self, sensors: int) -> None:
        """Whether the order, if there is one, is a permutation of so many sensors.

        Raises:
            ConfigurationError: it is none.
        """
        if self.order is None:
            return
        given = self.order if isinstance(self.order, tuple) else ()
        whole = all(
            isinstance(sensor, (int, np.integer)) and not isinstance(sensor, bool)
            for sensor in given
        )
        if not sensors or not whole or sorted(given) != list(range(sensors)):
            last = f"{sensors - 1}" if sensors else "l - 1"
            raise ConfigurationError(
                f"order = {self.order!r} is not allowed: it must be a tuple that holds each of "
                f"the sensors 0 to {last} exactly once"
            )

    def fuse(
        self,
        mean: Array,
        covariance: Array,
        means: Array,
        covariances: Array,
        active: NDArray[np.bool_],
    ) -> SequentialResult:
        """The prediction joined with the estimates of the active sensors.

        Args:
            mean, covariance: the centre's prediction, (n, N) and (n, n, N).
            means, covariances: the sensors' estimates, (l, n, N) and (l, n, n, N); not read where
                a sensor is not active.
            active: (l, N). Each sensor is joined in the lanes where it is active, others keep
                what they have, so only active lanes cost time.

        Raises:
            ConfigurationError: ``order`` does not have one entry for each of the l sensors.
        """
        sensors, size = means.shape[:2]
        if self.order is not None and len(self.order) != sensors:
            self.check_order(sensors)
        join = _RULES[self.rule]
        result = SequentialResult(
            mean.copy(), covariance.copy(), np.zeros((sensors + 1, *covariance.shape))
        )
        result.gains[0] = linalg.identity(size)
        joined = [0]
        for sensor in range(sensors) if self.order is None else self.order:
            chosen = active[sensor]
            if chosen.any():
                lanes = slice(None) if chosen.all() else np.flatnonzero(chosen)
                fused = join(
                    _lanes(result.mean, lanes),
                    _lanes(result.covariance, lanes),
                    _lanes(means[sensor], lanes),
                    _lanes(covariances[sensor], lanes),
                )
                result.mean[:, lanes] = fused.mean
                result.covariance[..., lanes] = fused.covariance
                for earlier in joined:
                    gain = result.gains[earlier]
                    gain[..., lanes] = linalg.matmul(fused.gain_first, _lanes(gain, lanes))
                result.gains[sensor + 1][..., lanes] = fused.gain_second
                joined.append(sensor + 1)
        return result


def _lanes(array: Array, lanes: slice | NDArray[np.int64]) -> Array:
    """These lanes with the batch axis contiguous, which plain indexing would not leave it."""
    return array if isinstance(lanes, slice) else array.take(lanes, axis=-1)
