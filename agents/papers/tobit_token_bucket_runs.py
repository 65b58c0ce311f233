"""Recorded episodes of the token-bucket paper, and its theorems computed on them."""

from collections import Counter
from collections.abc import Callable
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import fusion_gym
from agents.papers.walk import walk
from agents.papers.whitening import leading_sample, whitened_square
from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.core.task import Task
from fusion_gym.policies.base import Policy
from fusion_gym.policies.rules import DynamicEvent
from fusion_gym.systems.tobit.oscillator import TobitOscillatorOptions

TRIGGER = "dynamic_event"
SENSORS = 3
_UNCENSORED = 0.01  # q from which (37) is evaluated as printed: it holds 1/q when nothing arrives
_FLOOR = 1e-140  # of q where it divides and the ratio is squared


class History(NamedTuple):
    """E episodes of H steps; t = 1..H first, episodes last.

    ``truth`` (H, n, E) · ``measurement`` (H, l, m, E), censored · ``held`` (H, l, m, E), the
    filters' value after the step, and ``held_before`` · ``requested``, ``granted`` (H, l, E) ·
    ``tokens`` (H, E) after the step, ``tokens_before`` · ``prior_mean`` (H, n, E) and
    ``prior_covariance`` (H, n, n, E) of the centre · ``uncensored`` and ``hazard`` (H, l, m, E), q
    and λ of the prediction · ``local_mean`` (H, l, n, E), ``local_bound`` (H, l, n, n, E) of the
    nodes before the feedback · ``mean`` (H, n, E), ``bound`` (H, n, n, E) fused.
    """

    truth: Array
    measurement: Array
    held: Array
    held_before: Array
    requested: NDArray[np.bool_]
    granted: NDArray[np.bool_]
    tokens: Array
    tokens_before: Array
    prior_mean: Array
    prior_covariance: Array
    uncensored: Array
    hazard: Array
    local_mean: Array
    local_bound: Array
    mean: Array
    bound: Array

    @property
    def local_error(self) -> Array:
        """The nodes' squared errors eᵀe (H, l, E)."""
        return np.square(self.truth[:, None] - self.local_mean).sum(2)

    @property
    def fused_error(self) -> Array:
        """The centre's squared error (H, E)."""
        return np.square(self.truth - self.mean).sum(1)

    @property
    def local_trace(self) -> Array:
        """Traces (H, l, E) of the nodes' bounds."""
        return np.trace(self.local_bound, axis1=2, axis2=3)

    @property
    def fused_trace(self) -> Array:
        """Trace (H, E) of the fused bound."""
        return np.trace(self.bound, axis1=1, axis2=2)


def scheme(**options: Any) -> Task:
    """Return the paper's example with changed ``options``."""
    return fusion_gym.make_task(TobitOscillatorOptions(**options))


def single_sensor(sensor: int, **options: Any) -> Task:
    """Return the task of a single sensor: its third of the bucket and no feedback."""
    bucket, trigger = scheme().network.bucket, DynamicEvent()
    return scheme(
        **options, measurement_matrices=(np.eye(2).tolist(),), token_rate=bucket.rate / SENSORS,
        token_capacity=bucket.capacity / SENSORS, initial_tokens=bucket.initial / SENSORS,
        trigger_threshold=trigger.column("threshold", SENSORS)[sensor],
        trigger_decay=trigger.column("decay", SENSORS)[sensor],
    )  # fmt: skip


def record_history(task: Task, episodes: int, seed: int, policy: Policy | str = TRIGGER) -> History:
    """Run the paper's trigger, or another policy, and record every step."""
    estimator: Any = task.estimator
    rows, share = [], estimator.centre.share[:, None, None]
    for batch, requests in walk(task, policy, episodes, seed):
        before, tokens = batch.state.estimate, batch.tokens
        outcome = batch.step(requests)
        (truth, state, *_), granted = batch.delivered, outcome.granted
        expected, _, root, _, planned = state.prediction[:5]
        local = estimator.local_means(state)
        bound = np.full((*local.shape[:2], *state.covariance.shape[1:]), np.nan)
        if planned is not None:
            bounds = (planned.delivered_covariance, planned.silent_covariance)
            bound = linalg.congruence(root, np.where(granted[:, None, None], *bounds) / share)
        values = (
            truth.truth, state.measurement, state.held, before.held, outcome.requested, granted,
            batch.tokens, tokens, state.prior_mean, state.prior_covariance,
            expected.uncensored_probability, expected.hazard, local, bound, state.mean,
            state.covariance,
        )  # fmt: skip
        rows.append([np.array(value) for value in values])
    return History(*map(np.array, zip(*rows, strict=True)))


class Terms(NamedTuple):
    """Equation (30) of a node and step as κ₁ (I - K q C) P (I - K q C)ᵀ + K S Kᵀ, in units of q.

    ``prior`` P (…, n, n) · ``matrix`` C (…, m, n) · ``probability`` q (…, m) · ``noise`` q⁻¹ S q⁻¹
    without the held value's square and ``pinned`` √κ₅ ȳ/q, zero after a delivery · ``silent``
    without a delivery. Axes: steps, nodes, episodes first.
    """

    first: float
    prior: Array
    matrix: Array
    probability: Array
    noise: Array
    pinned: Array
    silent: NDArray[np.bool_]

    @property
    def gain(self) -> Array:
        """Return K q by (37), without loss where ȳ/q is huge (Sherman and Morrison)."""
        cross = self.first * self.prior @ self.matrix.mT
        inverse = np.linalg.inv(self.matrix @ cross + self.noise)
        turned = inverse @ self.pinned[..., None]
        size = 1.0 + self.pinned[..., None, :] @ turned
        return cross @ (inverse - turned / size @ turned.mT)

    def _added(self, gain: Array) -> Array:
        pinned = gain @ self.pinned[..., None]
        return gain @ self.noise @ gain.mT + pinned @ pinned.mT

    def bound(self, gain: Array) -> Array:
        """Return the trace of (30) for any K q."""
        keep = np.eye(self.prior.shape[-1]) - gain @ self.matrix
        return np.linalg.trace(self.first * keep @ self.prior @ keep.mT + self._added(gain))

    @property
    def contraction(self) -> Array:
        """Return κ₁ w a² of (42), a the largest singular value of a rotation, which is 1."""
        keep = np.eye(self.prior.shape[-1]) - self.gain @ self.matrix
        return self.first * _norm(keep) ** 2

    def limit(self, process: Array) -> Array:
        """Return (43), infinite where (42) fails, for a node's process covariance (n, n).

        The step's own norms stand for their bounds (41), so that no other Δ is smaller.
        """
        delta = self.contraction * _norm(process) + _norm(self._added(self.gain))
        return np.where(self.contraction < 1.0, delta / (1.0 - self.contraction), np.inf)


def terms(task: Task, history: History) -> Terms:
    """Return the terms of (30) in every recorded step of the paper's filter, thresholds zero."""
    estimator: Any = task.estimator
    centre = estimator.centre
    sensors, constants = centre.sensors, centre.filter.constants
    k1, k2, k3, k4, k5, k6, _, _ = constants.kappa
    grow, shift = constants.second_moment
    horizon, _, episodes = history.truth.shape
    share = centre.share[:, 0]
    prior = np.moveaxis(history.prior_covariance, -1, 1)[:, None] / share[:, None, None, None]
    observed = sensors.measurement_matrix[..., 0][:, None]
    q = np.moveaxis(history.uncensored, -1, 2)
    mean = np.moveaxis(history.prior_mean, -1, 1)
    latent = (observed @ mean[:, None, ..., None])[..., 0]
    moment = grow * observed @ prior @ observed.mT + shift * _squared(latent)
    bias = np.moveaxis(history.hazard, -1, 2) * sensors.deviation[:, None, :, 0]
    time = np.arange(1.0, horizon + 1.0)
    event = centre.filter.event_error.at(time).T[:, :, None, None]
    variances = np.diagonal(moment, axis1=-2, axis2=-1)
    own = (q * sensors.variance[:, None, :, 0] + k3 * q * (1.0 - q) * variances + k6 * event) / q**2
    silent = ~np.moveaxis(history.granted, -1, 2)
    noise = np.where(
        silent[..., None, None], k4 * moment, own[..., None] * np.eye(q.shape[-1])
    ) + k2 * _squared(bias)
    held = np.moveaxis(history.held_before, -1, 2) / np.maximum(q, _FLOOR)
    return Terms(
        first=k1, prior=np.broadcast_to(prior, (horizon, len(share), episodes, *prior.shape[-2:])),
        matrix=observed, probability=q, noise=noise,
        pinned=np.where(silent[..., None], np.sqrt(k5) * held, 0.0), silent=silent,
    )  # fmt: skip


def perturbed(value: Terms, history: History, seed: int) -> dict[str, Array]:
    """Return a test of Theorem 2: other gains, and the library's bound against (30).

    Per episode (E,), over its steps with q of at least 0.01: ``larger``, the share of gains K + ΔK
    whose bound has the larger trace, ΔK random and of relative size 10⁻³ to 1; ``difference``, the
    largest relative difference of the trace from the filter's own.
    """
    generator = np.random.default_rng(seed)
    usable = value.probability.min(-1) >= _UNCENSORED
    gain = value.gain
    least = value.bound(gain)
    size = np.linalg.norm(gain, axis=(-2, -1))[..., None, None]
    larger = np.zeros(usable.shape)
    scales = (1e-3, 1e-2, 1e-1, 1.0)
    for scale in scales:
        other = gain + scale * size * generator.standard_normal(gain.shape)
        larger += (value.bound(other) >= least * (1.0 - 1e-12)) / len(scales)
    library = np.moveaxis(history.local_trace, -1, 2)
    difference = np.where(usable, np.abs(least / library - 1.0), 0.0)
    counted = usable.sum((0, 1))
    return {
        "larger": np.where(usable, larger, 0.0).sum((0, 1)) / np.maximum(counted, 1),
        "difference": difference.max((0, 1)), "counted": counted / usable[..., 0].size,
    }  # fmt: skip


def conditioned(value: Terms, task: Task, history: History) -> dict[str, Any]:
    """Return the share of steps (E,) in which condition (42) holds, of each kind.

    ``limit_ratio`` is the least ratio of (43) to the norm of the error's covariance over the
    episodes.
    """
    estimator: Any = task.estimator
    holds, silent = value.contraction < 1.0, value.silent
    error = history.truth[:, None] - history.local_mean
    norms = _norm(np.einsum("hlie,hlje->hlij", error, error) / error.shape[-1])[..., None]
    share = estimator.centre.share[0, 0]
    ratio = value.limit(estimator.model.process_covariance[..., 0] / share) / norms
    return {
        "holds_delivered": (holds & ~silent).sum((0, 1)) / np.maximum((~silent).sum((0, 1)), 1),
        "holds_silent": (holds & silent).sum((0, 1)) / np.maximum(silent.sum((0, 1)), 1),
        "least_silent": np.where(silent, value.contraction, np.inf).min((0, 1)),
        "holds": holds.mean((0, 1)), "limit_ratio": float(ratio.min()),
    }  # fmt: skip


def claimed(error: Array, bound: Array) -> tuple[Array, Array]:
    """Return the largest eigenvalue (H,) of E[z zᵀ], z = P^(-1/2) e, and its standard error.

    It is at most 1 if the bound holds on average. ``error`` (H, n, E), ``bound`` (H, n, n, E).
    """
    sample = leading_sample(whitened_square(error, bound))
    return sample.mean(-1), sample.std(-1, ddof=1) / np.sqrt(error.shape[-1])


def _norm(matrix: Array) -> Array:
    return np.linalg.norm(matrix, ord=2, axis=(-2, -1))


# --- other filters, and the operations of Algorithm 1 ---

Moments = Callable[[Array, Array, Array], tuple[Array, Array, Array]]


def extended(mean: Array, covariance: Array, matrix: Array) -> tuple[Array, Array, Array]:
    """Return mean, cross-covariance and covariance of max(C x, 0), linearised at the mean."""
    latent = mean @ matrix.T
    slope = matrix * (latent > 0.0)[..., None]
    cross = covariance @ slope.mT
    return np.maximum(latent, 0.0), cross, slope @ cross


def unscented(mean: Array, covariance: Array, matrix: Array) -> tuple[Array, Array, Array]:
    """Return the moments of :func:`extended` by the unscented transform with n + κ = 3."""
    size = mean.shape[-1]
    root = np.linalg.cholesky(3.0 * covariance).mT
    shifts = np.concatenate((np.zeros_like(root[:, :1]), root, -root), axis=1)
    weights = np.array([1.0 - size / 3.0, *np.full(2 * size, 1.0 / 6.0)])
    values = np.maximum((mean[:, None] + shifts) @ matrix.T, 0.0)
    value = weights @ values
    apart = values - value[:, None]
    cross = shifts.mT @ (weights[:, None] * apart)
    return value, cross, apart.mT @ (weights[:, None] * apart)


def filter_errors(task: Task, history: History, moments: Moments) -> Array:
    """Return squared errors (E,) of one filter of all deliveries, thresholds zero."""
    estimator: Any = task.estimator
    sensors, model = estimator.centre.sensors, estimator.model
    transition, process = model.transition[..., 0], model.process_covariance[..., 0]
    mean, covariance = history.prior_mean[0].T, np.moveaxis(history.prior_covariance[0], -1, 0)
    errors = []
    for step, truth in enumerate(history.truth):
        for m, matrix in enumerate(sensors.measurement_matrix[..., 0]):
            value, cross, total = moments(mean, covariance, matrix)
            total = total + np.diag(sensors.variance[m, :, 0])
            innovation = history.measurement[step, m].T - value
            gain = history.granted[step, m, :, None, None] * cross @ np.linalg.inv(total)
            mean = mean + (gain @ innovation[..., None])[..., 0]
            covariance = covariance - gain @ cross.mT
        errors.append(((truth.T - mean) ** 2).sum(-1))
        mean, covariance = mean @ transition.T, transition @ covariance @ transition.T + process
    return np.mean(errors, axis=0)


# Remark 5's terms in n_x³ and n_w of a node.
PRINTED_OPERATIONS = {"xxx": 10, "wwx": 2, "wxx": 0, "wx": -2}


def count_operations() -> dict[str, int]:
    """Return the terms of :data:`PRINTED_OPERATIONS` by count, products from left to right.

    (29) has A P Aᵀ and B Q Bᵀ, (30) one more product of three n_x by n_x matrices, and (50) the
    inverse of P_m in both lines.
    """
    count = Counter(xxx=2)
    for sizes in ("xxxx", "xwwx", "xxxx"):
        for inner, outer in pairwise(sizes[1:]):
            count["".join(sorted(sizes[0] + inner + outer))] += 2
            count["".join(sorted(sizes[0] + outer))] -= 1
    return {name: count[name] for name in PRINTED_OPERATIONS}


def _squared(vector: Array) -> Array:
    return vector[..., :, None] * vector[..., None, :]
