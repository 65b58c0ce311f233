"""Covariance intersection and its inverse form against optimisers, and what their bounds cover."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.optimize import LinearConstraint, minimize, minimize_scalar

from fusion_gym.fusion.intersection import (
    covariance_intersection,
    inverse_covariance_intersection,
)
from fusion_gym.fusion.rules import Fused, InformationFusion
from fusion_gym.fusion.several import covariance_intersection_many

Array = NDArray[np.float64]
RULES = {"ci": covariance_intersection, "ici": inverse_covariance_intersection}
KINDS = ("alike", "crossed", "dominated", "scaled")


def parts(fused: Fused) -> tuple[Array, Array, Array, Array]:
    """Mean, covariance, weights and gains."""
    assert fused.weights is not None
    return fused.mean, fused.covariance, fused.weights, fused.gains


def many(means: Array, covariances: Array, active: Any = None) -> tuple[Array, Array, Array]:
    """Mean, covariance and weights of covariance intersection of several at once."""
    return parts(covariance_intersection_many(means, covariances, active))[:3]


def estimates(kind: str, count: int, size: int, runs: int, seed: int = 0) -> tuple[Array, Array]:
    """Means (count, n, N) and covariances (count, n, n, N) of one kind of difficulty."""
    generator = np.random.default_rng([seed, count, size])
    factor = generator.normal(size=(count, size, size + 1, runs))
    if kind == "crossed":  # each is good at something else
        factor *= 10.0 ** generator.uniform(-2, 2, size=(count, size, 1, runs))
    covariance = np.einsum("sikN,sjkN->sijN", factor, factor)
    if kind == "dominated":  # the last one is worse in every direction
        covariance[-1] += 5 * np.einsum("sijN->ijN", covariance)
    if kind == "scaled":  # entries from 1e-8 to 1e8
        unit = 10.0 ** np.linspace(-4, 4, size)
        covariance *= (unit[:, None] * unit)[:, :, None]
    return generator.normal(size=(count, size, runs)), covariance


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
        wanted = combined(rule, weight, a, b) / units
        np.testing.assert_allclose(p / units, wanted, rtol=1e-7, atol=1e-8 * np.abs(wanted).max())
        inside = np.linalg.inv(b)
        if rule == "ici":
            inside = inside - (1 - weight) * np.linalg.inv(weight * a + (1 - weight) * b)
        else:
            inside = (1 - weight) * inside
        gain = (p @ inside) / unit[:, None] * unit
        got = fused.gains[1][..., run] / unit[:, None] * unit
        np.testing.assert_allclose(got, gain, atol=1e-6 * max(1.0, np.abs(gain).max()))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("rule", RULES)
def test_gains_add_up_to_one_and_make_the_mean(rule: str, kind: str) -> None:
    mean, covariance = estimates(kind, 2, 3, 40)
    mean *= np.sqrt(covariance[0].diagonal().T)  # in the units of each state
    fused = RULES[rule](mean[0], covariance[0], mean[1], covariance[1])
    unit = np.sqrt(covariance[0].diagonal().T)
    total = (fused.gains[0] + fused.gains[1]) / unit[:, None] * unit
    np.testing.assert_allclose(total - np.eye(3)[:, :, None], 0.0, atol=1e-12)
    first, second = (
        np.einsum("ijN,jN->iN", gain, value) for gain, value in zip(fused.gains, mean, strict=True)
    )
    np.testing.assert_allclose(fused.mean / unit, (first + second) / unit, atol=1e-9)
    same = RULES[rule](mean[0], covariance[0], mean[0], covariance[1])
    assert np.array_equal(same.mean, mean[0])  # unbiased: what both say is kept


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


@pytest.mark.parametrize("rule", RULES)
def test_a_covariance_that_is_none_spoils_only_its_own_lane(rule: str) -> None:
    mean, covariance = estimates("alike", 2, 3, 3)
    clean = RULES[rule](mean[0], covariance[0], mean[1], covariance[1])
    covariance[1, 0, 0, 1] = -1.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        spoiled = RULES[rule](mean[0], covariance[0], mean[1], covariance[1])
    assert np.all(np.isnan(spoiled.covariance[..., 1]))
    for one, other in zip(parts(spoiled), parts(clean), strict=True):
        assert np.array_equal(one[..., [0, 2]], other[..., [0, 2]])


@pytest.mark.parametrize("kind", KINDS)
def test_a_lane_is_the_same_alone_and_in_a_batch(kind: str) -> None:
    mean, covariance = estimates(kind, 3, 3, 15)
    for run in range(15):
        one = slice(run, run + 1)
        for rule in RULES.values():
            alone = rule(
                mean[0][:, one], covariance[0][..., one], mean[1][:, one], covariance[1][..., one]
            )
            batch = rule(mean[0], covariance[0], mean[1], covariance[1])
            for single, batched in zip(parts(alone), parts(batch), strict=True):
                np.testing.assert_allclose(single, batched[..., one], rtol=1e-9, atol=0.0)
        single_many = many(mean[..., one], covariance[..., one])
        for single, batched in zip(single_many, many(mean, covariance), strict=True):
            np.testing.assert_allclose(single, batched[..., one], rtol=1e-9, atol=0.0)


def actual(fused: Any, first: Array, second: Array, cross: Array) -> Array:
    """The covariance (n, n) of K e_A + L e_B for errors with this cross-covariance."""
    k, other = fused.gains[0][..., 0], fused.gains[1][..., 0]
    mixed = k @ cross @ other.T
    return k @ first @ k.T + other @ second @ other.T + mixed + mixed.T


def overconfidence(conservative: Array, real: Array) -> float:
    """Largest generalised eigenvalue of the actual against the conservative covariance."""
    return float(eigh(real, conservative, eigvals_only=True)[-1])


def fuse_one(rule: str, first: Array, second: Array) -> Any:
    mean = np.zeros((len(first), 1))
    return RULES[rule](mean, first[..., None], mean, second[..., None])


matrices = st.integers(1, 4).flatmap(
    lambda size: arrays(np.float64, (3, size, size), elements=st.floats(-3, 3, width=32))
)


def covariance_of(factor: Array) -> Array:
    return factor @ factor.T + 1e-3 * np.eye(len(factor))


@given(matrices)
@settings(deadline=None, max_examples=150)
def test_covariance_intersection_bounds_every_correlation(factors: Array) -> None:
    first, second = covariance_of(factors[0]), covariance_of(factors[1])
    contraction = factors[2] / max(float(np.linalg.norm(factors[2], 2)), 1e-6)
    cross = np.linalg.cholesky(first) @ contraction @ np.linalg.cholesky(second).T
    fused = fuse_one("ci", first, second)
    real = actual(fused, first, second, cross)
    assert overconfidence(fused.covariance[..., 0], real) <= 1 + 1e-7


@given(matrices)
@settings(deadline=None, max_examples=150)
def test_inverse_covariance_intersection_bounds_common_information(factors: Array) -> None:
    """P_A⁻¹ = A⁻¹ + G, P_B⁻¹ = B⁻¹ + G: the common piece makes the cross-covariance P_A G P_B."""
    own_first, own_second = covariance_of(factors[0]), covariance_of(factors[1])
    common = factors[2] @ factors[2].T
    first = np.linalg.inv(np.linalg.inv(own_first) + common)
    second = np.linalg.inv(np.linalg.inv(own_second) + common)
    cross = first @ common @ second
    fused = fuse_one("ici", first, second)
    conservative, weight = fused.covariance[..., 0], fused.weights[0, 0]
    real = actual(fused, first, second, cross)
    assert overconfidence(conservative, real) <= 1 + 1e-7
    spread = np.linalg.inv(weight * first + (1 - weight) * second) @ conservative
    margin = weight * (1 - weight) * spread.T @ (first + second - cross - cross.T) @ spread
    np.testing.assert_allclose(
        conservative - real, margin, atol=1e-6 * np.trace(conservative), rtol=0.0
    )


def test_inverse_covariance_intersection_is_no_bound_for_other_correlations() -> None:
    """Correlated across the components: covariance intersection covers it, the inverse doesn't."""
    first, second = np.eye(2), np.diag([4.0, 0.25])
    turn = 0.9 * np.array([[0.0, 1.0], [1.0, 0.0]])
    cross = np.linalg.cholesky(first) @ turn @ np.linalg.cholesky(second).T
    joint = np.block([[first, cross], [cross.T, second]])
    assert np.linalg.eigvalsh(joint)[0] > 0.0  # an admissible correlation
    ici, ci = (fuse_one(rule, first, second) for rule in ("ici", "ci"))
    ici_ratio, ci_ratio = (
        overconfidence(fused.covariance[..., 0], actual(fused, first, second, cross))
        for fused in (ici, ci)
    )
    assert ci_ratio <= 1.0
    assert ici_ratio > 1.2


def test_information_fusion_does_not_bound_a_shared_prior() -> None:
    """Two copies of one estimate count twice; covariance intersection keeps what one says."""
    mean, covariance = estimates("alike", 1, 3, 5)
    twice_mean, twice = np.repeat(mean, 2, axis=0), np.repeat(covariance, 2, axis=0)
    summed = InformationFusion().fuse(twice_mean, twice)
    np.testing.assert_allclose(summed.covariance, covariance[0] / 2, rtol=1e-9)
    np.testing.assert_allclose(summed.mean, mean[0], rtol=1e-9)
    _, kept, _ = many(twice_mean, twice)
    np.testing.assert_allclose(kept, covariance[0], rtol=1e-9)


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
        wanted = np.linalg.lstsq(left, right, rcond=None)[0]
        np.testing.assert_allclose(fused_mean[:, run] / unit, wanted, rtol=1e-6)
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


def test_the_inverse_form_has_its_own_weight() -> None:
    """With the weight that suits covariance intersection its trace is a good deal larger."""
    mean, covariance = estimates("alike", 2, 3, 50)
    ci, ici = (rule(mean[0], covariance[0], mean[1], covariance[1]) for rule in RULES.values())
    loss = [
        np.trace(
            combined("ici", ci.weights[0, run], covariance[0, ..., run], covariance[1, ..., run])
        )
        / np.trace(ici.covariance[..., run])
        for run in range(50)
    ]
    assert min(loss) >= 1 - 1e-6
    assert np.median(loss) > 1.05


def slsqp_trace(covariance: Array) -> float:
    """Smallest trace over the simplex of weights by a general-purpose optimiser, (l, n, n)."""
    unit = np.sqrt(np.diag(covariance[0]))
    information = np.linalg.inv(covariance / (unit[:, None] * unit))
    scale = float(np.trace(covariance.mean(0)))

    def trace(weights: Array) -> float:
        fused = np.linalg.inv(np.tensordot(weights, information, 1))
        return float(unit**2 @ np.diag(fused)) / scale

    count = len(covariance)
    starts = [np.full(count, 1 / count), *(0.9 * np.eye(count) + 0.1 / count)]
    results = [
        minimize(
            trace,
            start,
            method="SLSQP",
            bounds=[(0.0, 1.0)] * count,
            constraints=LinearConstraint(np.ones(count), 1.0, 1.0),
            options={"ftol": 1e-13, "maxiter": 500},
        )
        for start in starts
    ]
    return scale * min(float(r.fun) for r in results if abs(r.x.sum() - 1) < 1e-9)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("count", "size"), [(3, 2), (3, 3), (4, 3), (5, 1), (6, 2)])
def test_many_estimates_reach_the_optimum(count: int, size: int, kind: str) -> None:
    runs = 5
    mean, covariance = estimates(kind, count, size, runs)
    fused_mean, fused, weights = many(mean, covariance)
    assert np.all(weights >= 0.0)
    np.testing.assert_allclose(weights.sum(0), 1.0, rtol=1e-12)
    for run in range(runs):
        each, p = covariance[..., run], fused[..., run]
        best = slsqp_trace(each)
        assert np.trace(p) <= best * (1 + 1e-6)
        assert np.trace(p) >= best * (1 - 1e-5)  # the optimiser's own accuracy
        parts = [w * np.linalg.inv(c) for w, c in zip(weights[:, run], each, strict=True)]
        gradient = [np.trace(p @ np.linalg.inv(c) @ p) for c in each]
        assert max(gradient) - np.trace(p) <= 1.1e-6 * np.trace(p)
        unit = np.sqrt(np.diag(p))
        wanted = np.sum([part @ mean[s, :, run] for s, part in enumerate(parts)], axis=0)
        np.testing.assert_allclose(fused_mean[:, run] / unit, p @ wanted / unit, atol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("count", "size"), [(3, 2), (4, 3), (6, 2), (8, 3)])
def test_the_gap_closes_in_every_lane(count: int, size: int, kind: str) -> None:
    """Many lanes, so that the few on which Newton's direction leaves the simplex are among them."""
    mean, covariance = estimates(kind, count, size, runs=300, seed=5)
    _, fused, _ = many(mean, covariance)
    units = np.einsum("iiN->iN", fused) ** 0.5
    scaled = covariance / units[:, None] / units
    information = np.linalg.inv(np.moveaxis(scaled, -1, 1))
    square = np.einsum("ijN,jkN->ikN", fused, fused) / units[:, None] / units
    gain = np.einsum("sNij,jiN->sN", information, square)
    assert np.all(gain.max(0) <= (1 + 1.1e-6) * np.einsum("iiN->N", fused))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [1, 2, 3, 4])
def test_of_two_estimates_the_many_form_is_the_pair(size: int, kind: str) -> None:
    mean, covariance = estimates(kind, 2, size, 60)
    pair = covariance_intersection(mean[0], covariance[0], mean[1], covariance[1])
    _, fused, weights = many(mean, covariance)
    wanted = np.einsum("iiN->N", pair.covariance)
    np.testing.assert_allclose(np.einsum("iiN->N", fused), wanted, rtol=1e-6)
    np.testing.assert_allclose(weights[0], pair.weights[0], atol=2e-3)


def test_inactive_estimates_are_not_read() -> None:
    mean, covariance = estimates("alike", 4, 3, 4)
    active = np.array([[1, 1, 0, 0], [0, 1, 1, 0], [1, 0, 0, 0], [1, 1, 0, 0]], dtype=np.bool_)
    dirty_mean = np.where(active[:, None], mean, np.nan)
    dirty = np.where(active[:, None, None], covariance, np.nan)
    fused_mean, fused, weights = many(dirty_mean, dirty, active)
    assert np.all(weights[~active] == 0.0)
    for run in (0, 1, 2):
        kept, one = active[:, run], slice(run, run + 1)
        wanted = many(mean[kept][..., one], covariance[kept][..., one])
        np.testing.assert_allclose(fused_mean[:, one], wanted[0], rtol=1e-9)
        np.testing.assert_allclose(fused[..., one], wanted[1], rtol=1e-9)
        np.testing.assert_allclose(weights[kept][:, one], wanted[2], rtol=1e-9)
    assert weights[1, 2] == 1.0  # alone
    np.testing.assert_allclose(fused[..., 2], covariance[1, :, :, 2], rtol=1e-9)
    assert np.all(np.isnan(fused[..., 3]))  # nobody
    assert np.all(np.isnan(fused_mean[:, 3]))


def gap(covariance: Array, fused: Array) -> Array:
    """max_i tr(P Y_i P) / tr P - 1 (N,), in unit deviations of P; never below -1e-8 or so."""
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
    alone = np.einsum("siiN->sN", covariance)
    assert np.all(np.einsum("iiN->N", fused) <= alone.min(0) * (1 + allowed))
    for run in (0, runs - 1):
        one = slice(run, run + 1)
        single = many(mean[..., one], covariance[..., one])
        np.testing.assert_array_equal(single[1], fused[..., one])
        np.testing.assert_array_equal(single[2], weights[:, one])


@given(
    count=st.integers(2, 6),
    size=st.integers(1, 6),
    kind=st.sampled_from(KINDS),
    seed=st.integers(0, 10**6),
)
@settings(deadline=None, max_examples=25)
def test_the_optimum_of_a_general_purpose_optimiser(
    count: int, size: int, kind: str, seed: int
) -> None:
    mean, covariance = estimates(kind, count, size, 1, seed)
    _, fused, _ = many(mean, covariance)
    assert np.trace(fused[..., 0]) <= slsqp_trace(covariance[..., 0]) * (1 + 1.1e-6)


def test_lanes_of_every_number_of_active_estimates_stand_side_by_side() -> None:
    """One alone, two, three, four, nobody, and a broken one: each as if it were on its own."""
    generator = np.random.default_rng(8)
    mean, covariance = estimates("crossed", 4, 3, 120)
    active = generator.random((4, 120)) < 0.6
    covariance[1, 2, 2, ::10] = -1.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        batch = many(mean, covariance, active)
    broken = ~active.any(0) | (active[1] & (np.arange(120) % 10 == 0))
    assert np.array_equal(np.isnan(batch[1]).all((0, 1)), broken)
    assert np.array_equal(np.isnan(batch[0]).all(0), broken)
    assert not np.isnan(batch[1][..., ~broken]).any()
    assert set(active[:, ~broken].sum(0)) == {1, 2, 3, 4}
    assert np.all(batch[2][~active] == 0.0)
    for run in range(120):
        one = slice(run, run + 1)
        alone = many(mean[..., one], covariance[..., one], active[:, one])
        for single, batched in zip(alone, batch, strict=True):
            np.testing.assert_array_equal(single, batched[..., one])


@pytest.mark.parametrize("count", [2, 3, 5])
def test_identical_estimates_are_kept(count: int) -> None:
    _, covariance = estimates("alike", 1, 3, 10)
    mean = np.zeros((count, 3, 10))
    _, fused, weights = many(mean, np.repeat(covariance, count, axis=0))
    np.testing.assert_allclose(fused, covariance[0], rtol=1e-9)
    np.testing.assert_allclose(weights.sum(0), 1.0, rtol=1e-12)


@pytest.mark.parametrize("count", [3, 4])
def test_a_weight_that_is_almost_one_is_found(count: int) -> None:
    """One estimate is 1e8 times better in all directions but one, in which it is a little worse."""
    covariance = np.stack([np.eye(3) * 1e8] * count)[..., None]
    covariance[0] = np.diag([1.0, 1.0, 1.5e8])[..., None]
    covariance[2, 0, 0] = 2e8
    _, fused, weights = many(np.zeros((count, 3, 1)), covariance)
    assert np.trace(fused[..., 0]) <= slsqp_trace(covariance[..., 0]) * (1 + 1.1e-6)
    assert gap(covariance, fused)[0] <= 1.1e-6
    assert np.all(weights >= 0.0)
