"""Sequential fusion against the two-sensor rules applied by hand, and what its gains are for."""

from itertools import permutations, product
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fusion_gym import ConfigurationError
from fusion_gym.fusion.intersection import (
    SequentialIntersection,
    covariance_intersection,
    inverse_covariance_intersection,
)
from fusion_gym.fusion.rules import Fused

Array = NDArray[np.float64]
RULES = {"ci": covariance_intersection, "ici": inverse_covariance_intersection}
PATTERNS = np.array(list(product([False, True], repeat=3))).T  # every set of three sensors


def estimates(runs: int, size: int = 3, sensors: int = 3) -> tuple[Array, Array]:
    """Entry 0 is the prediction and the others are the sensors' estimates."""
    generator = np.random.default_rng(runs)
    factor = generator.normal(size=(sensors + 1, size, size + 1, runs))
    return (
        generator.normal(size=(sensors + 1, size, runs)),
        np.einsum("sikN,sjkN->sijN", factor, factor),
    )


def fuse(rule: Any, order: Any, mean: Array, covariance: Array, active: Any) -> Fused:
    """The prediction is always active and comes first; ``active`` and ``order`` are sensors'."""
    arrival = None if order is None else (0, *(sensor + 1 for sensor in order))
    everyone = np.concatenate((np.ones_like(active[:1]), active))
    return SequentialIntersection(RULES[rule], arrival).fuse(mean, covariance, everyone)


@pytest.mark.parametrize("order", [None, *permutations(range(3))])
@pytest.mark.parametrize("rule", RULES)
def test_it_is_the_two_sensor_rule_again_and_again(rule: str, order: Any) -> None:
    runs = PATTERNS.shape[1]
    mean, covariance = estimates(runs)
    result = fuse(rule, order, mean, covariance, PATTERNS)
    for run in range(runs):
        lane = slice(run, run + 1)
        expected_mean, expected = mean[0][:, lane], covariance[0][..., lane]
        for sensor in (0, 1, 2) if order is None else order:
            if PATTERNS[sensor, run]:
                pair = RULES[rule](
                    expected_mean,
                    expected,
                    mean[sensor + 1][:, lane],
                    covariance[sensor + 1][..., lane],
                )
                expected_mean, expected = pair.mean, pair.covariance
        np.testing.assert_allclose(result.mean[:, lane], expected_mean, rtol=1e-9)
        np.testing.assert_allclose(result.covariance[..., lane], expected, rtol=1e-9)


@pytest.mark.parametrize("rule", RULES)
def test_nobody_active_leaves_the_prediction(rule: str) -> None:
    mean, covariance = estimates(5)
    result = fuse(rule, None, mean, covariance, np.zeros((3, 5), dtype=np.bool_))
    np.testing.assert_array_equal(result.mean, mean[0])
    np.testing.assert_array_equal(result.covariance, covariance[0])
    assert result.gains.shape == (4, 3, 3, 5)


@pytest.mark.parametrize("order", [(), (0, 0, 1), (1, 2, 3), (-1, 0, 1), (True, False), 7, [0, 1]])
def test_an_order_that_is_no_permutation_is_refused(order: Any) -> None:
    with pytest.raises(ConfigurationError, match=r"^order = .* is not allowed"):
        SequentialIntersection(order=order)


@pytest.mark.parametrize("order", [(0, 1), (3, 2, 1, 0)])
def test_an_order_for_another_number_of_sensors_is_refused(order: Any) -> None:
    mean, covariance = estimates(2)
    with pytest.raises(ConfigurationError, match="each of the estimates 0 to 3 exactly once"):
        fuse("ci", order, mean, covariance, np.ones((3, 2), dtype=np.bool_))
