"""Covariance intersection and its inverse form against optimisers, and what their bounds cover."""

import warnings

import numpy as np
import pytest
from difficult_estimates import KINDS, Array, estimates, many, parts
from scipy.optimize import minimize_scalar

from fusion_gym.fusion.intersection import covariance_intersection, inverse_covariance_intersection
from fusion_gym.fusion.rules import InformationFusion

RULES = {"ci": covariance_intersection, "ici": inverse_covariance_intersection}


def combined(rule: str, weight: float, first: Array, second: Array) -> Array:
    """The fused covariance (n, n) at a weight by the formula, computed in unit deviations."""
    unit = np.sqrt(np.diag(first))
    units = unit[:, None] * unit
    a, b = first / units, second / units
    if rule == "ci":
        information = weight * np.linalg.inv(a) + (1 - weight) * np.linalg.inv(b)
    else:
        mixed = np.linalg.inv(weight * a + (1 - weight) * b)
        information = np.linalg.inv(a) + np.linalg.inv(b) - mixed
    return np.linalg.inv(information) * units


def smallest_trace(rule: str, first: Array, second: Array) -> float:
    def trace(weight: float) -> float:
        return float(np.trace(combined(rule, weight, first, second)))

    inside = minimize_scalar(trace, bounds=(0, 1), method="bounded", options={"xatol": 1e-10})
    return min(float(inside.fun), trace(0.0), trace(1.0))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [1, 2, 3, 4, 6])
@pytest.mark.parametrize("rule", RULES)
def test_the_trace_is_optimal_and_the_formulas_hold(rule: str, size: int, kind: str) -> None:
    runs = 6
    mean, covariance = estimates(kind, 2, size, runs)
    fused = RULES[rule](mean[0], covariance[0], mean[1], covariance[1])
    for run in range(runs):
        a, b, p = covariance[0, :, :, run], covariance[1, :, :, run], fused.covariance[..., run]
        weight = fused.weights[0, run]
        best = smallest_trace(rule, a, b)
        assert best * (1 - 1e-8) <= np.trace(p) <= best * (1 + 1e-6)
        unit = np.sqrt(np.diag(a))
        units = unit[:, None] * unit
        target = combined(rule, weight, a, b) / units
        np.testing.assert_allclose(p / units, target, rtol=1e-7, atol=1e-8 * np.abs(target).max())
        inside = np.linalg.inv(b)
        if rule == "ici":
            inside = inside - (1 - weight) * np.linalg.inv(weight * a + (1 - weight) * b)
        else:
            inside = (1 - weight) * inside
        gain = (p @ inside) / unit[:, None] * unit
        got = fused.gains[1][..., run] / unit[:, None] * unit
        np.testing.assert_allclose(got, gain, atol=1e-6 * max(1.0, np.abs(gain).max()))


@pytest.mark.parametrize("scale", [1e-16, 1.0, 1e16])
@pytest.mark.parametrize("rule", RULES)
def test_equal_covariances_are_kept_and_the_means_averaged(rule: str, scale: float) -> None:
    covariance = scale * np.array([[2.0, 0.6], [0.6, 0.5]])[:, :, None]
    mean = np.array([[1.0], [0.0]])
    fused = RULES[rule](mean, covariance, -mean, covariance)
    assert fused.weights[0].tolist() == [0.5]
    np.testing.assert_allclose(fused.covariance, covariance, rtol=1e-12)
    np.testing.assert_allclose(fused.mean, 0.0, atol=1e-12)


@pytest.mark.parametrize("rule", RULES)
def test_a_worse_estimate_is_dropped_whichever_side_it_is_on(rule: str) -> None:
    mean, covariance = estimates("dominated", 2, 3, 20)
    good_first = RULES[rule](mean[0], covariance[0], mean[1], covariance[1])
    good_second = RULES[rule](mean[1], covariance[1], mean[0], covariance[0])
    for fused in (good_first, good_second):
        np.testing.assert_allclose(fused.covariance, covariance[0], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(fused.mean, mean[0], rtol=1e-9, atol=1e-12)
    # CI weighs the information that it keeps, ICI the covariance that it takes off.
    assert np.all(good_first.weights[0] == (1.0 if rule == "ci" else 0.0))
    assert np.all(good_second.weights[0] == (0.0 if rule == "ci" else 1.0))
    assert np.all(good_first.gains[1] == 0.0)


@pytest.mark.parametrize("rule", [*RULES, "many"])
def test_a_covariance_that_is_none_spoils_only_its_own_lane(rule: str) -> None:
    def fuse() -> tuple[Array, ...]:
        if rule == "many":
            return many(mean, covariance)
        return parts(RULES[rule](mean[0], covariance[0], mean[1], covariance[1]))

    mean, covariance = estimates("alike", 4 if rule == "many" else 2, 3, 3)
    clean = fuse()
    covariance[1, 0, 0, 1] = np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        spoiled = fuse()
    assert np.all(np.isnan(spoiled[1][..., 1]))
    for first, other in zip(spoiled, clean, strict=True):
        assert np.array_equal(first[..., [0, 2]], other[..., [0, 2]])


@pytest.mark.parametrize("kind", KINDS)
def test_information_fusion_is_the_optimum_for_independent_errors(kind: str) -> None:
    """Three estimates as measurements of one state: weighted least squares says the same."""
    mean, covariance = estimates(kind, 3, 2, 6)
    result = InformationFusion().fuse(mean, covariance)
    fused_mean, fused = result.mean, result.covariance
    design = np.tile(np.eye(2), (3, 1))
    for run in range(6):
        whiten = np.zeros((6, 6))
        for s in range(3):
            root = np.linalg.cholesky(covariance[s, :, :, run])
            whiten[2 * s : 2 * s + 2, 2 * s : 2 * s + 2] = np.linalg.inv(root)
        unit = np.sqrt(np.diag(covariance[0, :, :, run]))
        left, right = whiten @ design * unit, whiten @ mean[..., run].ravel()
        expected = np.linalg.lstsq(left, right, rcond=None)[0]
        np.testing.assert_allclose(fused_mean[:, run] / unit, expected, rtol=1e-6)
        units = unit[:, None] * unit
        np.testing.assert_allclose(
            fused[..., run] / units, np.linalg.inv(left.T @ left), rtol=1e-6, atol=1e-9
        )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [2, 3, 4])
def test_the_inverse_form_is_never_looser(size: int, kind: str) -> None:
    mean, covariance = estimates(kind, 2, size, 200)
    traces = [
        np.einsum("iiN->N", rule(mean[0], covariance[0], mean[1], covariance[1]).covariance)
        for rule in RULES.values()
    ]
    assert np.all(traces[1] <= traces[0] * (1 + 1e-6))
    assert np.any(traces[1] < 0.99 * traces[0]) == (kind != "dominated")
