"""Small dense linear algebra for many parallel runs, batch axis last.

A quantity of shape S for N runs is an array of shape ``(*S, N)``: a matrix is
``(..., n, m, N)`` and a vector ``(..., n, N)``. Leading axes (for example sensors) and a
batch axis of length 1 broadcast as in NumPy, so a constant matrix has the shape ``(n, m, 1)``.

Every routine is a short sequence of element-wise operations of NumPy or JAX along the two small
axes. NumPy's large matrices use BLAS and LAPACK, run by run, and JAX's use LAPACK from three rows
on, because an elimination takes long to compile. The floating-point operations of a run do not
depend on the number of runs, so its result is bitwise the same in every batch.

The routines for symmetric positive definite matrices (`cholesky`, `solve`, `solve_vector`,
`inverse`) read only the diagonal and the lower triangle. They first
scale rows and columns by ``1 / sqrt(diagonal)``, which gives a unit diagonal: the accuracy then
depends on the conditioning of the correlation matrix and not on the units of the components,
and diagonal entries from 1e-200 to 1e200 neither overflow nor underflow. A run whose matrix is
not positive definite is NaN; other runs are unaffected, and there is no error and no warning.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym.namespace import namespace, set_at, update_at

FloatArray = NDArray[np.float64]
_MANY = 8  # rows from which on NumPy sums in pairs, and a test for a diagonal matrix saves time
_LARGE = 16  # rows from which on BLAS and LAPACK are faster than element-wise operations
_ROUNDING = 2e-15  # relative rounding error of a difference of variances, per row
_CHUNK = 32  # runs per transposition, which then stays in the cache
_ALL = slice(None)
TOLERANCE = 1e-6  # share of a threshold within which a change reaches it


def reaches(change: FloatArray, threshold: FloatArray) -> Any:
    """Return where a change is not zero and at least a threshold, up to ``TOLERANCE``."""
    return (change > 0.0) & (change >= (1.0 - TOLERANCE) * threshold)


def identity(size: int) -> FloatArray:
    """Return the identity matrix of shape ``(size, size, 1)``."""
    return np.eye(size)[:, :, None]


def transpose(a: FloatArray) -> FloatArray:
    """Return the transpose ``(..., m, n, N)`` of ``(..., n, m, N)``, a view."""
    return a.swapaxes(-3, -2)


def diagonal(a: FloatArray) -> FloatArray:
    """Return the diagonal ``(..., n, N)`` of ``(..., n, n, N)``, a read-only view."""
    return a.diagonal(0, -3, -2).swapaxes(-1, -2)


def total(a: FloatArray, axis: int = -2) -> FloatArray:
    """Return the sum over an axis that is not the last, in ascending order for every N.

    NumPy sums eight or more numbers of a contiguous axis in pairs, so alone where N is 1.
    """
    if a.shape[-1] > 1 or a.shape[axis] < _MANY or namespace(a) is not np:
        result: FloatArray = a.sum(axis)
        return result
    return a.cumsum(axis).take(-1, axis)


def trace(a: FloatArray) -> FloatArray:
    """Return the trace ``(..., N)``.

    Args:
        a: ``(..., n, n, N)``.

    Example:
        >>> from fusion_gym import linalg
        >>> linalg.trace(linalg.identity(3)).tolist()
        [3.0]
    """
    total = a[..., 0, 0, :].copy()
    for k in range(1, a.shape[-2]):
        total += a[..., k, k, :]
    return total


def weighted_trace(a: FloatArray, weights: FloatArray) -> FloatArray:
    """Return Σ w_i a_ii or tr(W a), ``(..., N)``, of ``(..., n, n, N)``, w (n,) or W (n, n)."""
    if weights.ndim > 1:
        return total(total(weights[..., None] * a))
    result = weights[0] * a[..., 0, 0, :]
    for k in range(1, a.shape[-2]):
        result += weights[k] * a[..., k, k, :]
    return result


def add_diagonal(a: FloatArray, d: FloatArray) -> FloatArray:
    """Return ``a + diag(d)``.

    Args:
        a: ``(..., n, n, N)``.
        d: broadcastable to ``(..., n, N)``.

    Example:
        >>> import numpy as np
        >>> from fusion_gym import linalg
        >>> linalg.add_diagonal(linalg.identity(2), np.array([[1.0], [2.0]]))[..., 0].tolist()
        [[2.0, 0.0], [0.0, 3.0]]
    """
    result = a.copy()
    for k in range(a.shape[-2]):
        result = update_at(np.add, result, (..., k, k, _ALL), d[..., k, :])
    return result


def symmetrise(a: FloatArray) -> FloatArray:
    """Return the symmetric part ``(a + a^T) / 2`` of ``(..., n, n, N)``, exactly symmetric."""
    result = a + a.swapaxes(-3, -2)
    result *= 0.5
    return result


def _require_equal_lengths(operation: str, left: int, right: int) -> None:
    if left != right:
        raise ValueError(
            f"{operation}: the summed axes must be equally long, not {left} and {right}"
        )


def matmul(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the matrix product ``(..., n, m, N)``.

    The sum over k is accumulated in ascending order in ``2 k - 1`` array operations, or by BLAS
    where all three axes are large.

    Args:
        a: ``(..., n, k, N)``.
        b: ``(..., k, m, N)``.

    Raises:
        ValueError: The two axes of length k differ.
    """
    length = a.shape[-2]
    _require_equal_lengths("matmul", length, b.shape[-3])
    if min(a.shape[-3], length, b.shape[-2]) >= _LARGE and namespace(a, b) is np:
        return _by_lane(np.matmul, a, b)
    result: FloatArray = a[..., 0:1, :] * b[..., 0:1, :, :]
    for k in range(1, length):
        result += a[..., k : k + 1, :] * b[..., k : k + 1, :, :]
    return result


def _by_lane(function: Callable[..., FloatArray], *matrices: FloatArray) -> FloatArray:
    """Apply a function of stacks ``(..., N, n, m)`` that treats each run separately."""
    lanes = max(matrix.shape[-1] for matrix in matrices)
    parts = []
    for first in range(0, lanes, _CHUNK):
        chunk = slice(first, first + _CHUNK)
        stacks = (m if m.shape[-1] == 1 else m[..., chunk] for m in matrices)
        stacks = (np.ascontiguousarray(np.moveaxis(stack, -1, -3)) for stack in stacks)
        parts.append(np.moveaxis(function(*stacks), -3, -1))
    return np.concatenate(parts, axis=-1)


def _inverse_of_stack(stack: FloatArray) -> FloatArray:
    """Return inverses of a stack ``(..., n, n)`` by LAPACK, NaN where Cholesky's method fails."""
    # Imported here, because scipy.linalg takes a fifth of a second to load.
    from scipy.linalg.lapack import dpotrf, dpotri

    size = stack.shape[-1]
    lower = np.empty((stack.size // size**2, size, size))
    for matrix, result in zip(stack.reshape(lower.shape), lower, strict=True):
        factor, failed = dpotrf(matrix.T)  # upper triangle in column-major order
        result[:] = np.nan if failed else dpotri(factor)[0].T
    whole: FloatArray = lower + lower.swapaxes(-1, -2)
    whole[:, range(size), range(size)] *= 0.5
    return whole.reshape(stack.shape)


def matvec(a: FloatArray, v: FloatArray) -> FloatArray:
    """Return the product ``a v``, ``(..., n, N)``.

    Args:
        a: ``(..., n, k, N)``.
        v: ``(..., k, N)``.

    Raises:
        ValueError: The two axes of length k differ.

    Example:
        >>> import numpy as np
        >>> from fusion_gym import linalg
        >>> rotation = np.array([[0.0, -1.0], [1.0, 0.0]])[..., None]
        >>> linalg.matvec(rotation, np.array([[2.0], [3.0]]))[:, 0].tolist()
        [-3.0, 2.0]
    """
    length = a.shape[-2]
    _require_equal_lengths("matvec", length, v.shape[-2])
    if min(a.shape[-3], length) >= _LARGE and namespace(a, v) is np:
        return _by_lane(np.matmul, a, v[..., None, :])[..., 0, :]
    result: FloatArray = a[..., 0, :] * v[..., 0:1, :]
    for k in range(1, length):
        result += a[..., k, :] * v[..., k : k + 1, :]
    return result


def outer(u: FloatArray, v: FloatArray) -> FloatArray:
    """Return ``u v^T``, ``(..., n, m, N)``.

    Args:
        u: ``(..., n, N)``.
        v: ``(..., m, N)``.

    Example:
        >>> import numpy as np
        >>> from fusion_gym import linalg
        >>> u = np.array([[1.0], [2.0]])
        >>> linalg.outer(u, u)[..., 0].tolist()
        [[1.0, 2.0], [2.0, 4.0]]
    """
    return u[..., :, None, :] * v[..., None, :, :]


def dot(u: FloatArray, v: FloatArray) -> FloatArray:
    """Return the inner product ``u^T v``, ``(..., N)``.

    Args:
        u: ``(..., n, N)``.
        v: ``(..., n, N)``.

    Raises:
        ValueError: The two axes of length n differ.

    Example:
        >>> import numpy as np
        >>> from fusion_gym import linalg
        >>> u = np.array([[1.0], [2.0]])
        >>> linalg.dot(u, u).tolist()
        [5.0]
    """
    _require_equal_lengths("dot", u.shape[-2], v.shape[-2])
    return total(u * v)


def quadratic(v: FloatArray, a: FloatArray) -> FloatArray:
    """Return ``v^T a v``, ``(..., N)``, of ``(..., n, N)`` and ``(..., n, n, N)``."""
    return dot(v, matvec(a, v))


def weighted_square(v: FloatArray, weights: FloatArray) -> FloatArray:
    """Return Σ w_i v_i² or v^T W v, ``(..., N)``, of ``(..., n, N)``, w (n, 1) or W (n, n, 1)."""
    return total(weights * (v * v)) if weights.ndim == 2 else quadratic(v, weights)


def congruence(a: FloatArray, p: FloatArray) -> FloatArray:
    """Return the congruence ``a p a^T`` for symmetric `p`, exactly symmetric.

    Args:
        a: ``(..., m, n, N)``.
        p: ``(..., n, n, N)``, symmetric (not checked).

    Returns:
        The symmetric part ``(..., m, m, N)`` of the computed product, so that repeated covariance
        updates do not drift.

    Raises:
        ValueError: The sizes of `a` and `p` differ.

    Example:
        >>> import numpy as np
        >>> from fusion_gym import linalg
        >>> motion = np.array([[1.0, 2.0], [0.0, 1.0]])[..., None]
        >>> linalg.congruence(motion, linalg.identity(2))[..., 0].tolist()
        [[5.0, 2.0], [2.0, 1.0]]
    """
    product = matmul(matmul(a, p), a.swapaxes(-3, -2))
    return product if product.shape[-2] == 1 else symmetrise(product)


def gram(f: FloatArray) -> FloatArray:
    """Return ``f f^T``, ``(..., n, n, N)``, of ``(..., n, k, N)``, exactly symmetric."""
    return matmul(f, f.swapaxes(-3, -2))


def _inverse_root(x: FloatArray) -> FloatArray:
    """Return ``1 / sqrt(x)`` for positive x and NaN for zero, negative or infinite x."""
    root: FloatArray = x**0.5
    root /= x
    return root


def _pair_scales(a: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the correlation r (..., N) and the scales w (..., 2, N) of 2x2 matrices.

    With w_i = 1 / sqrt(a_ii (1 - r^2)), the inverse of `a` is
    [[w_0^2, -r w_0 w_1], [-r w_0 w_1, w_1^2]], without the determinant.

    Args:
        a: ``(..., 2, 2, N)``.
    """
    scale = _inverse_root(diagonal(a))
    correlation: FloatArray = a[..., 1, 0, :] * scale[..., 0, :]
    correlation *= scale[..., 1, :]
    complement: FloatArray = 1.0 - correlation
    complement *= 1.0 + correlation
    return correlation, scale * _inverse_root(complement)[..., None, :]


def _equilibrate(a: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return correlations ``(..., n, n, N)`` and scales 1 / sqrt(a_ii) ``(..., n, N)``."""
    scale = _inverse_root(diagonal(a))
    correlation: FloatArray = a * scale[..., :, None, :]
    correlation *= scale[..., None, :, :]
    return correlation, scale


def _eliminate(work: FloatArray, right: Any) -> tuple[FloatArray, Any, FloatArray]:
    """Factorise by Cholesky's method, with an optional forward substitution.

    A pivot that is not positive makes its own column and every later one NaN. NumPy's arrays are
    changed in place.

    Args:
        work: ``(..., n, n, N)``.
        right: ``(..., n, m, N)`` or ``None``.

    Returns:
        The factor L in the lower triangle with 1 / L_kk on its diagonal, L^-1 `right`, and the
        last inverse pivot ``(..., N)``, which is NaN exactly where the factorisation fails.
    """
    size = work.shape[-2]
    for k in range(size):
        inverse_pivot, below = _inverse_root(work[..., k, k, :]), slice(k + 1, None)
        work = set_at(work, (..., k, k, _ALL), inverse_pivot)
        if right is not None:
            scale = inverse_pivot[..., None, :]
            right = update_at(np.multiply, right, (..., k, _ALL, _ALL), scale)
        if k + 1 == size:
            break
        work = update_at(np.multiply, work, (..., below, k, _ALL), inverse_pivot[..., None, :])
        column = work[..., k + 1 :, k, :]
        square = column[..., :, None, :] * column[..., None, :, :]
        work = update_at(np.subtract, work, (..., below, below, _ALL), square)
        if right is not None:
            product = column[..., :, None, :] * right[..., k : k + 1, :, :]
            right = update_at(np.subtract, right, (..., below, _ALL, _ALL), product)
    return work, right, inverse_pivot


@np.errstate(all="ignore")
def cholesky(a: FloatArray) -> FloatArray:
    """Return the lower Cholesky factor L with ``L L^T = a``.

    Args:
        a: ``(..., n, n, N)``, symmetric positive definite; only the lower triangle is read.

    Returns:
        ``(..., n, n, N)`` with a positive diagonal and zeros above it, all NaN in a run whose
        matrix is not positive definite.
    """
    correlation, scale = _equilibrate(a)
    work, _, last = _eliminate(correlation, None)
    poison = last * 0.0
    factor = namespace(work).empty_like(work)
    for i in range(work.shape[-2]):
        left = work[..., i, :i, :] / scale[..., i : i + 1, :] + poison[..., None, :]
        pivot = 1.0 / (work[..., i, i, :] * scale[..., i, :]) + poison
        factor = set_at(factor, (..., i, slice(i + 1, None), _ALL), poison[..., None, :])
        factor = set_at(factor, (..., i, slice(i), _ALL), left)
        factor = set_at(factor, (..., i, i, _ALL), pivot)
    return factor


@np.errstate(all="ignore")
def whiten(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return ``L^-1 b`` (..., n, m, N) with L the Cholesky factor of `a`."""
    work, scale = _equilibrate(a)
    right = b * scale[..., :, None, :]
    if a.shape[-2] < 3 or namespace(a, b) is np:
        return _eliminate(work, right)[1]
    from jax.scipy.linalg import solve_triangular

    xp, right = namespace(right), namespace(right).moveaxis(right, -1, -3)
    factor = xp.linalg.cholesky(xp.moveaxis(work, -1, -3), symmetrize_input=False)
    factor = xp.broadcast_to(factor, (*right.shape[:-2], *factor.shape[-2:]))
    return xp.moveaxis(solve_triangular(factor, right, lower=True), -3, -1)


@np.errstate(all="ignore")
def root(a: FloatArray) -> FloatArray:
    """Return a root F with ``F F^T = a`` of a positive semi-definite matrix.

    It is a Cholesky factorisation of the correlations with complete pivoting. A direction whose
    variance is only rounding error gets zero. The root of ``D a D`` with D diagonal is ``D F``.

    Args:
        a: ``(..., n, n, N)``, symmetric positive semi-definite.
    """
    xp, size = namespace(a), a.shape[-2]
    scale = xp.sqrt(xp.maximum(diagonal(a), 0.0))
    if size == 1:
        return scale[..., None, :]
    unit = xp.where(scale == 0.0, 0.0, 1.0 / scale)
    result = xp.zeros_like(a)
    if size == 2:
        correlation = unit[..., 1, :] * a[..., 1, 0, :] * unit[..., 0, :]
        correlation = xp.minimum(xp.maximum(correlation, -1.0), 1.0)
        left = (1.0 - correlation) * (1.0 + correlation)
        left = xp.where(left <= size * _ROUNDING, 0.0, left)
        result = set_at(result, (..., 0, 0, _ALL), scale[..., 0, :])
        result = set_at(result, (..., 1, 0, _ALL), scale[..., 1, :] * correlation)
        return set_at(result, (..., 1, 1, _ALL), scale[..., 1, :] * xp.sqrt(left))
    rest = unit[..., :, None, :] * a * unit[..., None, :, :]
    for k in range(size):  # exact, so that rounding does not decide the first pivot
        rest = set_at(rest, (..., k, k, _ALL), xp.where(scale[..., k, :] == 0.0, 0.0, 1.0))
    if size >= _LARGE and xp is np:
        return scale[..., :, None, :] * _by_lane(_root_of_stack, rest)
    for k in range(size):
        left = diagonal(rest)
        first = left.argmax(-2)[..., None, :]
        pivot = xp.take_along_axis(left, first, -2)
        column = xp.take_along_axis(rest, first[..., None, :, :], -3)[..., 0, :, :]
        column = xp.where(pivot <= size * _ROUNDING, 0.0, column / xp.sqrt(pivot))
        result = set_at(result, (..., _ALL, k, _ALL), scale * column)
        rest -= outer(column, column)
    return result


def _root_of_stack(stack: FloatArray) -> FloatArray:
    """Return roots of a stack ``(..., n, n)`` by LAPACK's pivoted Cholesky factorisation."""
    from scipy.linalg.lapack import dpstrf

    size = stack.shape[-1]
    result = np.zeros((stack.size // size**2, size, size))
    for matrix, lower in zip(stack.reshape(result.shape), result, strict=True):
        factor, order, rank, _ = dpstrf(matrix, tol=size * _ROUNDING, lower=1)
        lower[order - 1, :rank] = np.tril(factor)[:, :rank]
        lower[np.isnan(matrix).any(-1)] = np.nan
    return result.reshape(stack.shape)


def draw_normal(mean: FloatArray, covariance: FloatArray, normals: FloatArray) -> FloatArray:
    """Return samples ``(..., n, N)`` of N(mean, covariance) from standard normals."""
    return mean + matvec(root(covariance), normals)


@np.errstate(all="ignore")
def solve(a: FloatArray, b: FloatArray) -> FloatArray:
    """Solve ``a x = b`` for symmetric positive definite `a`.

    Sizes 1 and 2 use closed forms, larger ones a Cholesky factorisation of the equilibrated
    matrix.

    Args:
        a: ``(..., n, n, N)``; only the lower triangle is read.
        b: ``(..., n, m, N)``.

    Returns:
        x ``(..., n, m, N)``, all NaN in a run where `a` is not positive definite.

    Raises:
        ValueError: The sizes of `a` and `b` differ.
    """
    xp, size = namespace(a, b), a.shape[-2]
    _require_equal_lengths("solve", size, b.shape[-3])
    x: FloatArray
    if size == 1:
        return b / xp.where(a > 0.0, a, np.nan)
    if size == 2:
        correlation, weight = _pair_scales(a)
        scaled = b * weight[..., :, None, :]
        x = scaled - correlation[..., None, None, :] * scaled[..., ::-1, :, :]
        x *= weight[..., :, None, :]
        return x
    if xp is not np:
        every = xp.broadcast_to(identity(size), (*b.shape[:-2], size, b.shape[-1]))
        both = whiten(a, xp.concatenate([every, b], axis=-2))
        return matmul(transpose(both[..., :size, :]), both[..., size:, :])
    work, scale = _equilibrate(a)
    work, x, _ = _eliminate(work, b * scale[..., :, None, :])
    for k in range(size - 1, -1, -1):
        x = update_at(np.multiply, x, (..., k, _ALL, _ALL), work[..., k, k, None, :])
        if k:
            product = work[..., k, :k, None, :] * x[..., k : k + 1, :, :]
            x = update_at(np.subtract, x, (..., slice(k), _ALL, _ALL), product)
    x *= scale[..., :, None, :]
    return x


def solve_vector(a: FloatArray, v: FloatArray) -> FloatArray:
    """Solve ``a x = v`` for symmetric positive definite `a` and one right-hand side.

    Large diagonal matrices need no elimination; the result is bitwise equal to :func:`solve`.

    Args:
        a: ``(..., n, n, N)``; only the lower triangle is read.
        v: ``(..., n, N)``.

    Returns:
        x ``(..., n, N)``, all NaN in a run where `a` is not positive definite.

    Raises:
        ValueError: The sizes of `a` and `v` differ.
    """
    many = a.shape[-2] >= _MANY and namespace(a, v) is np
    if many and np.count_nonzero(a) == np.count_nonzero(diagonal(a)):
        return _solve_diagonal(diagonal(a), v)
    return solve(a, v[..., None, :])[..., 0, :]


@np.errstate(all="ignore")
def _solve_diagonal(d: FloatArray, v: FloatArray) -> FloatArray:
    """Return ``v / d`` of ``(..., n, N)``, with the rounding and the NaN of :func:`solve`."""
    scale = _inverse_root(d)
    pivot = _inverse_root(d * scale * scale)
    x: FloatArray = v * scale * pivot
    failed = np.isnan(pivot).any(-2, keepdims=True)
    return np.where(failed, np.nan, x * pivot * scale)


@np.errstate(all="ignore")
def inverse(a: FloatArray) -> FloatArray:
    """Return the inverse of symmetric positive definite matrices, exactly symmetric.

    Size 2 uses its closed form, larger ones ``L^-T L^-1`` with the Cholesky factor L, large ones
    LAPACK.

    Args:
        a: ``(..., n, n, N)``; only the lower triangle is read.

    Returns:
        The inverse, all NaN in a run where `a` is not positive definite.
    """
    xp, size = namespace(a), a.shape[-2]
    if size == 1:
        return 1.0 / xp.where(a > 0.0, a, np.nan)
    if size == 2:
        correlation, weight = _pair_scales(a)
        result = outer(weight, weight)
        result = update_at(np.multiply, result, (..., 0, 1, _ALL), -correlation)
        return set_at(result, (..., 1, 0, _ALL), result[..., 0, 1, :])
    if xp is not np:
        return gram(transpose(whiten(a, identity(size))))
    work, scale = _equilibrate(a)
    if size >= _LARGE and xp is np:
        return _by_lane(_inverse_of_stack, work) * outer(scale, scale)
    # Rows from n on become the upper triangular diag(scale) L^-T.
    stack = xp.zeros((*a.shape[:-3], 2 * size, size, a.shape[-1]))
    stack = set_at(stack, (..., slice(size), _ALL, _ALL), work)
    for k in range(size):
        rows, pivot = slice(k + 1, size + k + 1), _inverse_root(stack[..., k, k, :])
        stack = set_at(stack, (..., size + k, k, _ALL), scale[..., k, :])
        stack = update_at(np.multiply, stack, (..., rows, k, _ALL), pivot[..., None, :])
        if k + 1 < size:
            column = stack[..., rows, k, :]
            product = column[..., :, None, :] * column[..., None, : size - k - 1, :]
            stack = update_at(np.subtract, stack, (..., rows, slice(k + 1, None), _ALL), product)
    column = stack[..., size:, size - 1, :]
    result = outer(column, column)
    for k in range(size - 1):
        column, corner = stack[..., size : size + k + 1, k, :], slice(k + 1)
        result = update_at(np.add, result, (..., corner, corner, _ALL), outer(column, column))
    return result
