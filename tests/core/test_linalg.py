"""Batch-last linear algebra against numpy.linalg, lane by lane, and at the extremes."""

import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from fusion_gym import linalg

Array = NDArray[np.float64]

sizes = st.one_of(st.integers(1, 8), st.sampled_from((16, 19)))  # BLAS and LAPACK do the last
leads = st.sampled_from([(), (1,), (3,), (2, 3)])
lanes = st.sampled_from([1, 2, 7, 70])
seeds = st.integers(0, 2**32 - 1)


@pytest.fixture(autouse=True)
def every_warning_is_an_error() -> Iterator[None]:
    with warnings.catch_warnings(), np.errstate(all="warn"):
        warnings.simplefilter("error")
        yield


def first(a: Array) -> Any:
    """Batch-last matrices as batch-first ones, what numpy.linalg takes."""
    return np.moveaxis(a, -1, 0)


def last(a: Any) -> Any:
    return np.moveaxis(a, 0, -1)


def definite(rng: np.random.Generator, lead: tuple[int, ...], size: int, count: int) -> Array:
    """Random symmetric positive definite matrices with a condition number of some hundreds."""
    root = rng.normal(size=(*lead, count, size, size))
    matrix = root @ np.swapaxes(root, -1, -2) / size + 0.05 * np.eye(size)
    return np.ascontiguousarray(np.moveaxis(matrix, -3, -1))


@settings(deadline=None)
@given(seed=seeds, lead=leads, count=lanes, n=sizes, k=sizes, m=sizes)
def test_products(seed: int, lead: tuple[int, ...], count: int, n: int, k: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(*lead, n, k, count))
    b = rng.normal(size=(*lead, k, m, count))
    v = rng.normal(size=(*lead, k, count))
    u = rng.normal(size=(*lead, n, count))
    close: dict[str, Any] = {"rtol": 1e-12, "atol": 1e-13}
    product = linalg.matmul(a, b)
    assert product.shape == (*lead, n, m, count)
    np.testing.assert_allclose(product, last(first(a) @ first(b)), **close)
    np.testing.assert_allclose(linalg.matvec(a, v), np.einsum("...ikl,...kl->...il", a, v), **close)
    np.testing.assert_array_equal(linalg.outer(u, v), np.einsum("...il,...kl->...ikl", u, v))
    np.testing.assert_allclose(linalg.dot(v, 2 * v), 2 * (v**2).sum(axis=-2), **close)
    np.testing.assert_array_equal(linalg.transpose(a), last(np.swapaxes(first(a), -1, -2)))
    p = definite(rng, lead, k, count)
    congruent = linalg.congruence(a, p)
    expected = last(first(a) @ first(p) @ np.swapaxes(first(a), -1, -2))
    np.testing.assert_allclose(congruent, expected, rtol=1e-12, atol=1e-11)
    np.testing.assert_array_equal(congruent, linalg.transpose(congruent))
    np.testing.assert_allclose(
        linalg.quadratic(v, p), np.einsum("...il,...ikl,...kl->...l", v, p, v), rtol=1e-11
    )


def test_diagonal_trace_symmetrise_identity() -> None:
    rng = np.random.default_rng(2)
    a = rng.normal(size=(3, 4, 4, 5))
    before = a.copy()
    assert linalg.diagonal(a).shape == (3, 4, 5)
    for i in range(4):
        np.testing.assert_array_equal(linalg.diagonal(a)[:, i], a[:, i, i])
    np.testing.assert_allclose(linalg.trace(a), np.trace(a, axis1=-3, axis2=-2), rtol=1e-13)
    symmetric = linalg.symmetrise(a)
    np.testing.assert_array_equal(symmetric, linalg.transpose(symmetric))
    np.testing.assert_allclose(symmetric, (before + np.swapaxes(before, 1, 2)) / 2, rtol=1e-15)
    np.testing.assert_array_equal(a, before)
    assert linalg.identity(3).shape == (3, 3, 1)
    np.testing.assert_array_equal(linalg.matmul(a, linalg.identity(4)), a)


def test_unequal_lengths_are_refused() -> None:
    square, wide, vector = np.ones((1, 1, 4)), np.ones((3, 3, 4)), np.ones((3, 4))
    calls: list[tuple[str, Any]] = [
        ("matmul", lambda: linalg.matmul(square, wide)),
        ("matvec", lambda: linalg.matvec(square, vector)),
        ("dot", lambda: linalg.dot(square[0], vector)),
        ("solve", lambda: linalg.solve(square, wide)),
        ("solve", lambda: linalg.solve_vector(square, vector)),
    ]
    for name, call in calls:
        with pytest.raises(ValueError, match=f"{name}: .*equally long, not 1 and 3"):
            call()


@settings(deadline=None)
@given(seed=seeds, lead=leads, count=lanes, n=sizes, m=st.integers(1, 3))
def test_definite_systems(seed: int, lead: tuple[int, ...], count: int, n: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    a = definite(rng, lead, n, count)
    b = rng.normal(size=(*lead, n, m, count))
    untouched, untouched_b = a.copy(), b.copy()
    factor = linalg.cholesky(a)
    np.testing.assert_allclose(factor, last(np.linalg.cholesky(first(a))), rtol=1e-9, atol=1e-11)
    np.testing.assert_array_equal(np.triu(first(factor), 1), 0.0)
    close: dict[str, Any] = {"rtol": 1e-9, "atol": 1e-9}
    np.testing.assert_allclose(
        linalg.solve(a, b), last(np.linalg.solve(first(a), first(b))), **close
    )
    np.testing.assert_allclose(
        linalg.solve_vector(a, b[..., 0, :]), linalg.solve(a, b)[..., 0, :], rtol=1e-12
    )
    inverse = linalg.inverse(a)
    np.testing.assert_allclose(inverse, last(np.linalg.inv(first(a))), **close)
    np.testing.assert_array_equal(inverse, linalg.transpose(inverse))
    np.testing.assert_array_equal(a, untouched)
    np.testing.assert_array_equal(b, untouched_b)


@settings(deadline=None, max_examples=50)
@given(seed=seeds, n=sizes)
def test_only_the_lower_triangle_is_read(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    a = definite(rng, (2,), n, 3)
    b = rng.normal(size=(2, n, 2, 3))
    hidden = a.copy()
    hidden[:, *np.triu_indices(n, 1)] = np.nan
    np.testing.assert_array_equal(linalg.cholesky(hidden), linalg.cholesky(a))
    np.testing.assert_array_equal(linalg.solve(hidden, b), linalg.solve(a, b))
    np.testing.assert_array_equal(linalg.inverse(hidden), linalg.inverse(a))
    assert np.isfinite(linalg.cholesky(hidden)).all()


@settings(deadline=None)
@given(seed=seeds, n=sizes)
def test_badly_scaled_matrices_keep_full_precision(seed: int, n: int) -> None:
    """Powers of four on the diagonal scale without rounding, so the scaled answer is known."""
    rng = np.random.default_rng(seed)
    a = definite(rng, (), n, 4)
    b = rng.normal(size=(n, 2, 4))
    power: Any = 2.0 ** rng.integers(-332, 333, size=(n, 4))  # squared: from 1e-200 to 1e200
    scaled = a * linalg.outer(power, power)
    scaled_b = b * power[:, None]
    close: dict[str, Any] = {"rtol": 1e-10}
    np.testing.assert_allclose(
        linalg.inverse(scaled) * power[:, None], linalg.inverse(a) / power, **close
    )
    np.testing.assert_allclose(
        linalg.solve(scaled, scaled_b) * power[:, None], linalg.solve(a, b), **close
    )
    np.testing.assert_allclose(
        linalg.cholesky(scaled) / power[:, None], linalg.cholesky(a), **close
    )


def test_nearly_singular_pair() -> None:
    gap = 2.0**-40
    a = np.array([[1.0, 1.0 - gap], [1.0 - gap, 1.0]])[:, :, None]
    determinant = gap * (2.0 - gap)
    expected = np.array([[1.0, gap - 1.0], [gap - 1.0, 1.0]]) / determinant
    np.testing.assert_allclose(linalg.inverse(a)[..., 0], expected, rtol=1e-14)
    assert np.isfinite(linalg.cholesky(a)).all()


def indefinite(n: int) -> dict[str, Array]:
    """Matrices that are not positive definite, each failing at another place."""
    cases = {
        "zero": np.zeros((n, n)),
        "negative": -np.eye(n),
        "negative last": np.diag([1.0] * (n - 1) + [-1.0]),
        "zero first": np.diag([0.0] + [1.0] * (n - 1)),
        "nan": np.full((n, n), np.nan),
    }
    if n > 1:
        cases["singular"] = np.ones((n, n))
        beyond = np.eye(n)
        beyond[1, 0] = beyond[0, 1] = 2.0
        cases["correlation above one"] = beyond
        tail = np.eye(n)
        tail[-1, -2] = tail[-2, -1] = -1.5
        cases["correlation below minus one"] = tail
    return cases


@pytest.mark.parametrize("n", [*range(1, 9), 17])
def test_a_lane_that_is_not_definite_is_nan_and_alone(n: int) -> None:
    good = definite(np.random.default_rng(n), (), n, 3)
    b = np.random.default_rng(n + 50).normal(size=(n, 2, 3))
    for name, bad in indefinite(n).items():
        a = good.copy()
        a[:, :, 1] = bad
        pairs = [
            (linalg.cholesky(a), linalg.cholesky(good)),
            (linalg.inverse(a), linalg.inverse(good)),
            (linalg.solve(a, b), linalg.solve(good, b)),
            (linalg.solve_vector(a, b[:, 0]), linalg.solve_vector(good, b[:, 0])),
        ]
        for actual, expected in pairs:
            assert np.isnan(actual[..., 1]).all(), name
            np.testing.assert_array_equal(actual[..., [0, 2]], expected[..., [0, 2]], name)


@settings(deadline=None)
@given(seed=seeds, n=sizes)
def test_constants_broadcast(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    constant = definite(rng, (), n, 1)
    varying = definite(rng, (3,), n, 5)
    spread = np.broadcast_to(constant, (3, n, n, 5))
    for operation in (linalg.matmul, linalg.solve, linalg.congruence):
        actual = operation(constant, varying)
        assert actual.shape == (3, n, n, 5)
        np.testing.assert_array_equal(actual, operation(spread, varying))
        np.testing.assert_array_equal(operation(varying, constant), operation(varying, spread))
    vector = rng.normal(size=(n, 5))
    for single in (linalg.matvec, linalg.solve_vector):
        wide = single(spread, np.broadcast_to(vector, (3, n, 5)))
        np.testing.assert_array_equal(single(constant, vector), wide[1])
        mixed = single(varying, vector[:, :1])
        assert mixed.shape == (3, n, 5)
    np.testing.assert_array_equal(
        linalg.quadratic(vector, constant), linalg.quadratic(vector, spread)[2]
    )


@settings(deadline=None)
@given(seed=seeds, n=sizes, count=st.sampled_from([2, 9, 33]))
def test_a_lane_is_the_same_alone_and_in_the_batch(seed: int, n: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    a = definite(rng, (2,), n, count)
    v = rng.normal(size=(2, n, count))
    lane = int(rng.integers(count))
    item, vector = a[..., lane : lane + 1].copy(), v[..., lane : lane + 1].copy()
    for unary in (linalg.cholesky, linalg.inverse, linalg.trace, linalg.symmetrise):
        np.testing.assert_array_equal(unary(a)[..., lane], unary(item)[..., 0])
    for binary in (linalg.matmul, linalg.solve, linalg.congruence):
        np.testing.assert_array_equal(binary(a, a)[..., lane], binary(item, item)[..., 0])
    for mixed in (linalg.matvec, linalg.solve_vector):
        np.testing.assert_array_equal(mixed(a, v)[..., lane], mixed(item, vector)[..., 0])
    np.testing.assert_array_equal(
        linalg.quadratic(v, a)[..., lane], linalg.quadratic(vector, item)[..., 0]
    )
    np.testing.assert_array_equal(linalg.dot(v, v)[..., lane], linalg.dot(vector, vector)[..., 0])


@pytest.mark.parametrize("count", [3, 8, 21])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_sum_has_one_order_in_every_batch(count: int, axis: int) -> None:
    shape = [2, 3, 4, 5]
    shape[axis] = count
    terms = np.random.default_rng(0).normal(size=shape)
    for order in ((0, 1, 2), (2, 0, 1)):  # also of views
        values, place = terms.transpose(*order, 3), order.index(axis)
        lanes = [linalg.total(values[..., lane : lane + 1], place) for lane in range(5)]
        together = linalg.total(values, place)
        np.testing.assert_array_equal(together, np.concatenate(lanes, axis=-1))
        np.testing.assert_allclose(together, values.sum(place), rtol=0.0, atol=1e-13)
