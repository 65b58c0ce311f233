"""A plain second implementation of the token-bucket paper's example, to hold the library against.

It is written from the equations and shares no code with the library's filters, fusion, network,
triggers or systems: one run after another, one sensor after another, ordinary batch-free matrices
with ``numpy.linalg``. What is delicate in float64, the paper's filter with its covariance bound,
is evaluated in many-digit arithmetic exactly as printed, without any simplification.

Numbers in parentheses are the paper's equations (tobit_token_bucket).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import mpmath
import numpy as np
from numpy.typing import NDArray
from scipy import special

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

ANGLE = 0.052 * math.pi
TRANSITION = np.array(
    [[math.cos(ANGLE), math.sin(ANGLE)], [-math.sin(ANGLE), math.cos(ANGLE)]], dtype=np.float64
)
GAIN = np.array([0.16, 0.18])


@dataclass(frozen=True)
class Example:
    """Section 4 of the paper, in its notation; thresholds and matrices one for each sensor."""

    transition: Array = field(default_factory=TRANSITION.copy)
    process_covariance: Array = field(default_factory=lambda: 0.05 * np.outer(GAIN, GAIN))
    initial_mean: Array = field(default_factory=lambda: np.array([5.0, 0.0]))
    initial_covariance: Array = field(default_factory=lambda: 0.1 * np.eye(2))
    matrices: tuple[Array, ...] = field(default_factory=lambda: (np.eye(2),) * 3)
    variances: tuple[Array, ...] = field(default_factory=lambda: (np.full(2, 0.5),) * 3)
    thresholds: tuple[Array, ...] = field(default_factory=lambda: (np.zeros(2),) * 3)
    shares: tuple[float, ...] = (1 / 3, 1 / 3, 1 / 3)
    token_rate: float = 5.0
    token_capacity: float = 30.0
    initial_tokens: float = 10.0
    token_cost: tuple[float, ...] = (3.0, 3.0, 3.0)
    unlimited: bool = False
    sigma: tuple[float, ...] = (0.1, 0.2, 0.3)
    decay: tuple[float, ...] = (0.1, 0.2, 0.1)
    chi: tuple[float, ...] = (5.0, 5.0, 5.0)
    eta: tuple[float, ...] = (1.5, 1.5, 1.5)
    young: tuple[float, float] = (1.5, 2.0)
    epsilon: tuple[float, ...] = (0.05,) * 5 + (0.7,) * 8 + (1.0,)

    @property
    def sensors(self) -> int:
        return len(self.matrices)


@dataclass
class Run:
    """One run, times 1..T first: what the simulation left behind."""

    truth: list[Array] = field(default_factory=list)
    mean: list[Array] = field(default_factory=list)
    covariance: list[Array] = field(default_factory=list)
    local_mean: list[list[Array]] = field(default_factory=list)
    tokens: list[float] = field(default_factory=list)
    requested: list[list[bool]] = field(default_factory=list)
    granted: list[list[bool]] = field(default_factory=list)


def kappas(epsilon: Sequence[float]) -> list[float]:
    """κ₁..κ₈ below (30), with ε counted from 1 as in the paper."""
    e = [math.nan, *epsilon]
    return [
        1 + e[1] + e[2] + e[3] + e[4] + e[5],
        1 + 1 / e[1] + 1 / e[7] + 1 / e[10] + 1 / e[12] + 1 / e[13],
        1 + e[6],
        1 + e[7] + e[8] + e[9] + 1 / e[2],
        1 + 1 / e[3] + 1 / e[8] + e[10] + e[11],
        1 + 1 / e[4] + e[12],
        1 + 1 / e[5] + 1 / e[9] + 1 / e[11] + e[13],
        1 + 1 / e[6],
    ]


def event_error(example: Example, sensor: int, time: int) -> float:
    """Ξ(G_{t-1}) of a sensor, by the recursion below (30) from G₀ = η₀²."""
    d, e = example.young
    lam, chi, sigma = example.decay[sensor], example.chi[sensor], example.sigma[sensor]
    bound = example.eta[sensor] ** 2
    for _ in range(time):
        bound = ((1 + d) * (1 + e) * lam**2 + (1 + chi) * (1 + 1 / d) / chi**2) * bound + (
            (1 + d) * (1 + 1 / e) + (1 + 1 / d) * (1 + 1 / chi)
        ) * sigma**2
    return bound


# --- the paper's filter in many digits -------------------------------------------------------


def exact_matrix(value: Any) -> Any:
    """An mpmath matrix of a NumPy matrix, or of a vector as one column."""
    return mpmath.matrix(np.asarray(value, dtype=np.float64).tolist())


def exact_float(value: Any) -> Array:
    """A float64 matrix of an mpmath matrix."""
    return np.array([[float(entry) for entry in row] for row in value.tolist()])


def exact_inverse(a: Any) -> Any:
    """Of a positive definite matrix whose diagonal may span more orders than there are digits."""
    scale = mpmath.diag([1 / mpmath.sqrt(a[i, i]) for i in range(a.rows)])
    return scale * (scale * a * scale) ** -1 * scale


def hadamard(a: Any, b: Any) -> Any:
    result = a.copy()
    for i in range(a.rows):
        for j in range(a.cols):
            result[i, j] = a[i, j] * b[i, j]
    return result


def exact_tobit(mean: Any, matrix: Any, variance: Array, threshold: Array) -> tuple[Any, Any, Any]:
    """Q̄ as a diagonal matrix, λ √R as a column, τ as a column (zero where there is none)."""
    size = len(variance)
    latent = matrix * mean
    quality, bias, level = mpmath.zeros(size), mpmath.zeros(size, 1), mpmath.zeros(size, 1)
    for j in range(size):
        if threshold[j] == -math.inf:
            quality[j, j] = 1
            continue
        root = mpmath.sqrt(mpmath.mpf(float(variance[j])))
        level[j] = mpmath.mpf(float(threshold[j]))
        zeta = (level[j] - latent[j]) / root
        quality[j, j] = mpmath.erfc(zeta / mpmath.sqrt(2)) / 2
        density = mpmath.exp(-zeta * zeta / 2) / mpmath.sqrt(2 * mpmath.pi)
        bias[j] = density / quality[j, j] * root
    return quality, bias, level


def exact_bound_update(
    mean: Any,
    covariance: Any,
    matrix: Any,
    variance: Array,
    threshold: Array,
    value: Any,
    silent: bool,
    kappa: Sequence[float],
    last_epsilon: float,
    event: float,
) -> tuple[Any, Any]:
    """(22) and (30) with the gain (37), term by term; θ is 1 where ``silent``.

    ``value`` is the delivered measurement, or the held one where nothing arrived. Three
    misprints are set right: K_{t+1} is K_t, C{Υ∘Ω}Cᵀ is Υ∘(C Ω Cᵀ), and Ω₁ takes the node's own
    prior covariance.
    """
    k = [mpmath.mpf(0), *(mpmath.mpf(entry) for entry in kappa)]
    theta = mpmath.mpf(1 if silent else 0)
    other = (1 - theta) ** 2
    size = matrix.rows
    q, bias, tau = exact_tobit(mean, matrix, variance, threshold)
    eye, noise = mpmath.eye(size), mpmath.diag([mpmath.mpf(float(r)) for r in variance])
    upsilon = q * (eye - q)
    omega1 = (1 + mpmath.mpf(last_epsilon)) * covariance + (1 + 1 / mpmath.mpf(last_epsilon)) * (
        mean * mean.T
    )
    omega2 = value * value.T
    omega3 = upsilon + q * q.T
    xi = mpmath.mpf(event) * eye
    observed = matrix * omega1 * matrix.T
    missed = (eye - q) * tau
    psi = k[1] * covariance * matrix.T * q.T
    phi = (
        k[1] * q * matrix * covariance * matrix.T * q.T
        + k[2] * q * bias * bias.T * q.T
        + theta**2 * (k[4] * q * observed * q.T + k[5] * omega2 + k[7] * missed * missed.T)
        + other
        * (
            hadamard(omega3, noise)
            + k[3] * hadamard(upsilon, observed)
            + k[8] * hadamard(upsilon, tau * tau.T)
            + k[6] * xi
        )
    )
    gain = psi * exact_inverse(phi)
    keep = mpmath.eye(covariance.rows) - gain * q * matrix
    bound = (
        k[1] * keep * covariance * keep.T
        + other * gain * hadamard(omega3, noise) * gain.T
        + k[2] * gain * q * bias * bias.T * q.T * gain.T
        + other * k[3] * gain * hadamard(upsilon, observed) * gain.T
        + theta**2 * k[4] * gain * q * observed * q.T * gain.T
        + theta**2 * k[5] * gain * omega2 * gain.T
        + other * k[6] * gain * xi * gain.T
        + theta**2 * k[7] * gain * missed * missed.T * gain.T
        + other * k[8] * gain * hadamard(upsilon, tau * tau.T) * gain.T
    )
    expected = q * (matrix * mean + bias) + missed
    return mean + gain * (value - expected), bound


# --- the other filters, in float64 -------------------------------------------------------------


def tobit_update(
    mean: Array, covariance: Array, matrix: Array, variance: Array, threshold: Array, value: Array
) -> tuple[Array, Array]:
    """The standard Tobit Kalman filter: (5)-(7), (22), (23) with κ₁ = 1 and S = diag(R v).

    Without thresholds it is the Kalman filter.
    """
    free = np.isneginf(threshold)
    level = np.where(free, 0.0, threshold)
    root = np.sqrt(variance)
    zeta = (level - matrix @ mean) / root
    q = np.where(free, 1.0, special.ndtr(-zeta))
    density = np.exp(-0.5 * zeta**2 - special.log_ndtr(-zeta)) / math.sqrt(2 * math.pi)
    hazard = np.where(free, 0.0, density)
    spread = variance * np.maximum(1 - hazard * (hazard - zeta), 0.0)
    weighted = np.diag(q) @ matrix
    expected = q * (matrix @ mean + hazard * root) + (1 - q) * level
    total = weighted @ covariance @ weighted.T + np.diag(spread)
    gain = np.linalg.solve(total, weighted @ covariance).T
    keep = np.eye(len(mean)) - gain @ weighted
    bound = keep @ covariance @ keep.T + gain @ np.diag(spread) @ gain.T
    return mean + gain @ (value - expected), bound


# --- the whole simulation ------------------------------------------------------------------------


def simulate(
    example: Example,
    initial_state: Array,
    process_noise: Array,
    measurement_noise: Array,
    kind: str = "paper",
    hold: bool = True,
    with_event_error: bool = True,
    requests: Flags | None = None,
) -> Run:
    """One run driven by given noise, in physical units.

    ``initial_state`` (n,), ``process_noise`` (T, n), ``measurement_noise`` (T + 1, sensors, m).
    ``kind`` is "paper", "tobit" or "kalman"; without ``requests`` (T, sensors) the dynamic event
    trigger (11)-(15) decides.
    """
    sensors, run = range(example.sensors), Run()
    kappa = kappas(example.epsilon)
    state = np.array(initial_state)

    def measure(time: int) -> list[Array]:
        return [
            np.maximum(
                example.matrices[m] @ state + measurement_noise[time][m], example.thresholds[m]
            )
            for m in sensors
        ]

    delivered = measure(0)
    requested = [value.copy() for value in delivered]
    eta = [float(value) for value in example.eta]
    tokens = example.token_capacity if example.unlimited else example.initial_tokens
    local_mean = [example.initial_mean.copy() for _ in sensors]
    local_covariance = [example.initial_covariance / example.shares[m] for m in sensors]
    for time in range(1, len(process_noise) + 1):
        state = example.transition @ state + process_noise[time - 1]
        values = measure(time)
        count, answered, spent = [], [], 0.0
        for m in sensors:
            size = math.sqrt(float(np.sum((requested[m] - values[m]) ** 2)))
            ask = size >= eta[m] / example.chi[m] + example.sigma[m]
            eta[m] = max(example.decay[m] * eta[m] + example.sigma[m] - (0.0 if ask else size), 0.0)
            if ask:
                requested[m] = values[m]
            if requests is not None:
                ask = bool(requests[time - 1][m])
            allow = example.unlimited or example.token_cost[m] <= tokens / example.sensors
            count.append(ask)
            answered.append(ask and allow)
            spent += example.token_cost[m] if ask and allow else 0.0
        if not example.unlimited:
            tokens = min(tokens + example.token_rate - spent, example.token_capacity)
        new_mean, new_covariance = [], []
        for m in sensors:
            if answered[m]:
                delivered[m] = values[m]
            prior = example.transition @ local_mean[m]
            spread = example.transition @ local_covariance[m] @ example.transition.T
            spread = spread + example.process_covariance / example.shares[m]
            posterior = (prior, spread)
            if kind == "paper" and (answered[m] or hold):
                event = event_error(example, m, time) if with_event_error else 0.0
                mean, bound = exact_bound_update(
                    exact_matrix(prior),
                    exact_matrix(spread),
                    exact_matrix(example.matrices[m]),
                    example.variances[m],
                    example.thresholds[m],
                    exact_matrix(delivered[m]),
                    not answered[m],
                    kappa,
                    example.epsilon[13],
                    event,
                )
                posterior = (exact_float(mean)[:, 0], exact_float(bound))
            elif answered[m]:
                level = example.thresholds[m]
                if kind == "kalman":  # which knows of none
                    level = np.full_like(level, -math.inf)
                sensor = (example.matrices[m], example.variances[m], level)
                posterior = tobit_update(prior, spread, *sensor, values[m])
            new_mean.append(posterior[0])
            new_covariance.append(posterior[1])
        information = [np.linalg.inv(bound) for bound in new_covariance]
        fused = np.linalg.inv(sum(information, np.zeros_like(information[0])))
        total = [i @ x for i, x in zip(information, new_mean, strict=True)]
        mean = fused @ sum(total, np.zeros_like(total[0]))
        local_mean = [mean.copy() for _ in sensors]
        local_covariance = [fused / example.shares[m] for m in sensors]
        run.truth.append(state.copy())
        run.mean.append(mean)
        run.covariance.append(fused)
        run.local_mean.append(new_mean)
        run.tokens.append(tokens)
        run.requested.append(count)
        run.granted.append(answered)
    return run
