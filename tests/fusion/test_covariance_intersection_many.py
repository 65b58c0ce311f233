"""Covariance intersection of many estimates, and the gap to the optimum that it certifies."""

import numpy as np
import pytest
from difficult_estimates import KINDS, Array, estimates, many
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fusion_gym.fusion.intersection import covariance_intersection


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("count", "size"), [(3, 2), (3, 3), (4, 3), (5, 1), (6, 2)])
def test_many_estimates_reach_the_optimum(count: int, size: int, kind: str) -> None:
    """Conditions of the optimum (Karush, Kuhn and Tucker), and the fusion by its weights."""
    runs = 5
    mean, covariance = estimates(kind, count, size, runs)
    fused_mean, fused, weights = many(mean, covariance)
    assert np.all(weights >= 0.0)
    np.testing.assert_allclose(weights.sum(0), 1.0, rtol=1e-12)
    assert np.all(gap(covariance, fused) <= 1.1e-6)
    for run in range(runs):
        parts = weights[:, run, None, None] * np.linalg.inv(covariance[..., run])
        p, unit = np.linalg.inv(parts.sum(0)), np.sqrt(np.diag(fused[..., run]))
        units = unit[:, None] * unit
        np.testing.assert_allclose(fused[..., run] / units, p / units, atol=1e-7)
        expected = np.einsum("sij,sj->i", parts, mean[..., run])
        np.testing.assert_allclose(fused_mean[:, run] / unit, p @ expected / unit, atol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [1, 2, 3, 4])
def test_of_two_estimates_the_many_form_is_the_pair(size: int, kind: str) -> None:
    mean, covariance = estimates(kind, 2, size, 60)
    pair = covariance_intersection(mean[0], covariance[0], mean[1], covariance[1])
    _, fused, weights = many(mean, covariance)
    expected = np.einsum("iiN->N", pair.covariance)
    np.testing.assert_allclose(np.einsum("iiN->N", fused), expected, rtol=1e-6)
    np.testing.assert_allclose(weights[0], pair.weights[0], atol=2e-3)


def gap(covariance: Array, fused: Array) -> Array:
    """max_i tr(P Y_i P) / tr P - 1 (N,), in unit deviations of P; never below -1e-8 or so.

    The trace is convex in the weights, so that no weights have one that is less by more.
    """
    units = np.einsum("iiN->iN", fused) ** 0.5
    information = np.linalg.inv(np.moveaxis(covariance / units[:, None] / units, -1, 1))
    square = np.einsum("ijN,jkN->ikN", fused, fused) / units[:, None] / units
    gain = np.einsum("sNij,jiN->sN", information, square)
    result: Array = gain.max(0) / np.einsum("iiN->N", fused) - 1.0
    return result


@given(
    count=st.integers(2, 6),
    size=st.integers(1, 6),
    spread=st.floats(0.0, 4.0),
    likeness=st.sampled_from([0.0, 1e-9, 1e-5, 1e-2, 1.0]),
    seed=st.integers(0, 2**32 - 1),
)
@example(count=5, size=3, spread=0.75, likeness=0.01, seed=25010)
@settings(deadline=None, max_examples=200)
def test_the_gap_closes_for_alike_and_for_extreme_estimates(
    count: int, size: int, spread: float, likeness: float, seed: int
) -> None:
    """Ratios of variances up to 1e8 in random directions; from identical to unrelated estimates."""
    generator = np.random.default_rng(seed)
    runs = 8
    shared = generator.normal(size=(1, size, size + 1, runs))
    own = generator.normal(size=(count, size, size + 1, runs))
    factor = (1.0 - likeness) * shared + likeness * own
    stretch = 10.0 ** generator.uniform(-spread / 2, spread / 2, size=(count, size, 1, runs))
    factor = factor * stretch ** min(likeness, 1.0)
    covariance = np.einsum("sikN,sjkN->sijN", factor, factor)
    covariance += 1e-6 * np.einsum("siiN->sN", covariance)[:, None, None] * np.eye(size)[..., None]
    mean = generator.normal(size=(count, size, runs))
    _, fused, weights = many(mean, covariance)
    assert np.all(weights >= 0.0)
    np.testing.assert_allclose(weights.sum(0), 1.0, rtol=1e-12)
    allowed = 1.1e-6 if count > 2 else 1e-9  # of more than two the search ends at a gap
    if count > 2:
        assert np.all(gap(covariance, fused) <= allowed)
    single_values = np.einsum("siiN->sN", covariance)
    assert np.all(np.einsum("iiN->N", fused) <= single_values.min(0) * (1 + allowed))
    for run in (0, runs - 1):
        lane = slice(run, run + 1)
        single = many(mean[..., lane], covariance[..., lane])
        np.testing.assert_array_equal(single[1], fused[..., lane])
        np.testing.assert_array_equal(single[2], weights[:, lane])


@pytest.mark.parametrize("count", [3, 4])
def test_a_weight_that_is_almost_one_is_found(count: int) -> None:
    """One estimate is 1e8 times better in all directions but one, in which it is a little worse."""
    covariance = np.stack([np.eye(3) * 1e8] * count)[..., None]
    covariance[0] = np.diag([1.0, 1.0, 1.5e8])[..., None]
    covariance[2, 0, 0] = 2e8
    _, fused, weights = many(np.zeros((count, 3, 1)), covariance)
    assert gap(covariance, fused)[0] <= 1.1e-6
    assert np.all(weights >= 0.0)
