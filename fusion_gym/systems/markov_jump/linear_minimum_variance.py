"""Local linear minimum-variance filters of a Markov jump system, and their joint errors.

The mode is hidden. The filters' gains and covariances do not depend on the measurements: they are
tables over time.

Source: markov_jump (event-triggered distributed fusion estimation for asynchronous Markov jump
systems with correlated noises and fading measurements).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.namespace import namespace, take
from fusion_gym.systems.markov_jump.plant import FadingSensors, MarkovJumpPlant

Times = NDArray[np.int64]

LONGEST = 2000  # steps after which tables that have not become periodic end anyway
_SETTLED = 1e-13  # change over a period, in deviations of each state, below which they have
_CANCELLED = 1e-6  # of two squares, what is left has lost six digits
ROUNDING = 1e-14  # relative, of a sum over modes


class AugmentedStep(NamedTuple):
    """The augmented model at one time k, without a batch axis; a = modes · n.

    ``moment`` P(k) (a, a), block diagonal, the second moment of ζ(k) · ``mean`` of ζ(k) (a,) ·
    ``input`` B̄(k) (a, r) · ``additional`` Q_c(k) (a, a), the covariance that the hidden mode adds
    between k and k + 1.
    """

    moment: Array
    mean: Array
    input: Array
    additional: Array

    def moments(self, plant: MarkovJumpPlant) -> tuple[Array, Array]:
        """Return P(k) and B̄ Q B̄ᵀ (a, a), which determine the rest of the step."""
        return self.moment, self.input @ plant.noise_covariance @ self.input.T


@dataclass(frozen=True)
class AugmentedModel:
    """ζ(k+1) = Ā ζ(k) + B̄(k) w(k) + ξ(k), y_i = c_i ζ + v*_i, with ζ = col(x 1{θ = m}).

    The hidden mode adds ξ, of covariance Q_c = P(k+1) - Ā P(k) Āᵀ - B̄ Q B̄ᵀ and uncorrelated with
    the past. v*_i = (β_i - β̄_i) C_i ζ + α_i w + η_i has variance σ_i² C_i P(k) C_iᵀ + α_i Q α_iᵀ +
    R_i, and Cov(v*_i, v*_j) = α_i Q α_jᵀ. Mode probabilities move with π(k+1) = π(k) p, so that B̄
    depends on time.

    Shapes: ``transition`` Ā (a, a), ``faded`` c_i = β̄_i C_i (l, a), ``unfaded`` C_i (l, a).

    Source: markov_jump, equations (5)-(11); in (9) the variance is sensor i's, and P_n and
    π_n of (10) are those at k - 1.
    """

    plant: MarkovJumpPlant
    sensors: FadingSensors
    transition: Array
    faded: Array
    unfaded: Array

    @classmethod
    def create(cls, plant: MarkovJumpPlant, sensors: FadingSensors) -> AugmentedModel:
        """Return the model of a plant and its sensors."""
        chain, phi = plant.mode_transition, plant.transition
        modes = range(plant.modes)
        unfaded = sensors.measurement_matrix.transpose(0, 2, 1).reshape(sensors.count, -1)
        return cls(
            plant=plant,
            sensors=sensors,
            transition=np.block([[chain[n, m] * phi[..., n] for n in modes] for m in modes]),
            faded=sensors.fading_mean[:, None] * unfaded,
            unfaded=unfaded,
        )

    @property
    def size(self) -> int:
        """Length a of ζ."""
        return len(self.transition)

    @property
    def initial_mean(self) -> Array:
        """Mean of ζ(0), col(π_m μ₀) (a,), from which all estimates begin."""
        plant = self.plant
        return np.outer(plant.initial_probabilities, plant.initial_mean[:, 0]).reshape(-1)

    def steps(self) -> Iterator[AugmentedStep]:
        """Yield the model at k = 0, 1, 2, … without end."""
        plant = self.plant
        phi, gamma = np.moveaxis(plant.transition, -1, 0), np.moveaxis(plant.process_gain, -1, 0)
        chain, noise = plant.mode_transition, plant.noise_covariance
        start, pi = plant.initial_mean[:, 0], plant.initial_probabilities
        second = plant.initial_covariance[..., 0] + np.outer(start, start)
        moments = pi[:, None, None] * second
        now = _diagonal_blocks(moments)
        mean = self.initial_mean
        driven = gamma @ noise @ gamma.swapaxes(1, 2)
        while True:
            second = phi @ moments @ phi.swapaxes(1, 2) + pi[:, None, None] * driven
            following = (chain.T @ second.reshape(plant.modes, -1)).reshape(second.shape)
            entry = chain.T @ (pi[:, None, None] * gamma).reshape(plant.modes, -1)
            entry = entry.reshape(self.size, -1)
            later = _diagonal_blocks(following)
            carried = self.transition @ now @ self.transition.T + entry @ noise @ entry.T
            yield AugmentedStep(now, mean, entry, later - carried)
            moments, now, pi, mean = following, later, pi @ chain, self.transition @ mean

    def state_moments(self, last: int) -> tuple[Array, Array]:
        """Return E x and the diagonal of E x xᵀ at k = 0..last, both (last + 1, n)."""
        means, squares = [], []
        for _, step in zip(range(last + 1), self.steps(), strict=False):
            means.append(step.mean.reshape(-1, self.plant.size).sum(0))
            squares.append(np.diagonal(step.moment).reshape(-1, self.plant.size).sum(0))
        return np.array(means), np.array(squares)

    def scales(self, horizon: int) -> tuple[Array, Array]:
        """Return mean variance (n,) over k = 1..horizon and root mean square (n,) with k = 0."""
        means, squares = self.state_moments(horizon)
        variances = squares - means * means
        if (variances < _CANCELLED * squares).any():
            variances = self._variances(horizon)
        magnitude = np.sqrt(squares.mean(0))
        return variances[1:].mean(0), np.where(magnitude > 0.0, magnitude, 1.0)

    def _variances(self, last: int) -> Array:
        """Return the state's variances (last + 1, n) as sums of squares, which cannot cancel."""
        plant = self.plant
        phi, gamma = np.moveaxis(plant.transition, -1, 0), np.moveaxis(plant.process_gain, -1, 0)
        chain, pi = plant.mode_transition, plant.initial_probabilities
        driven = gamma @ plant.noise_covariance @ gamma.swapaxes(1, 2)
        means = np.tile(plant.initial_mean[:, 0], (plant.modes, 1))
        spreads = np.tile(plant.initial_covariance[..., 0], (plant.modes, 1, 1))
        result = []
        for _ in range(last + 1):  # means (M, n) and covariances (M, n, n) given the mode
            apart = means - pi @ means
            result.append(pi @ (np.diagonal(spreads, 0, 1, 2) + apart**2))
            pi, before = pi @ chain, pi
            share = (chain * before[:, None] / np.where(pi > 0.0, pi, 1.0)).T
            moved = np.einsum("mij,mj->mi", phi, means)
            means = share @ moved
            apart = moved - means[:, None]
            spreads = phi @ spreads @ phi.swapaxes(1, 2) + driven
            between = np.einsum("mn,mni,mnj->mij", share, apart, apart)
            spreads = np.tensordot(share, spreads, 1) + between
        return np.array(result)


def _diagonal_blocks(blocks: Array) -> Array:
    count, size, _ = blocks.shape
    result = np.zeros((count, size, count, size))
    every = np.arange(count)
    result[every, :, every] = blocks
    return result.reshape(count * size, count * size)


@dataclass(frozen=True)
class LocalFilters:
    r"""Best linear filters at the nodes, with the joint covariance of their errors.

    Every table has time as its last axis; :meth:`at` maps times to places. A table ends when it has
    become periodic (to 1e-13), and its last period then represents all later times.

    With l sensors, a = modes · n: ``transition`` Ā (a, a, 1) · ``measurement_matrix`` c (l, a, 1) ·
    ``input`` B̄ (a, r, T) · ``gain`` K (l, a, T) · ``noise_gain`` K_w (l, r, T) ·
    ``innovation_covariance`` E ε_i ε_j (l, l, T), as if all sampled · ``step`` u_i = Ā K_i + B̄
    K_wi (l, a, T), the innovation's part in the next prediction · ``covariance`` E L⁺_i L⁺_jᵀ
    (l, l, a, a, T), L⁺ the errors after the update · ``filtered_cross`` E ε_i L⁺_j (l, l, a, T) ·
    ``predicted_cross`` E ε_i L_j(k+1|k) (l, l, a, T). ``period`` is the number of steps after which
    the sensors' sampling repeats, at most T.

    Equation:
        $$
        \zeta(k+1)=\bar A\,\zeta(k)+\bar B\,w(k)+\xi(k),\qquad y_i=c_i\zeta+v_i
        $$

        $$
        K_i=\frac{P_i c_i^{\mathsf T}}{q_i},\qquad K_{w,i}=\frac{Q\alpha_i^{\mathsf
        T}}{q_i},\qquad q_i=c_i P_i c_i^{\mathsf T}+\sigma_i^2 C_i M C_i^{\mathsf T}+\alpha_i
        Q\alpha_i^{\mathsf T}+R_i
        $$

        $$
        \hat\zeta_i^{+}=\hat\zeta_i+K_i\varepsilon_i,\qquad \hat w_i=K_{w,i}\varepsilon_i,\qquad
        \hat\zeta_i(k+1)=\bar A\,\hat\zeta_i^{+}+\bar B\,\hat w_i
        $$

        ζ stacks x·1{θ = m} over the modes m; ξ is what the unknown mode adds, of covariance M(k+1)
        − Ā M(k) Āᵀ − B̄ Q B̄ᵀ with M the second moment of ζ. εᵢ = yᵢ − cᵢ ζ̂ᵢ is the innovation, cᵢ
        = β̄ᵢ Cᵢ the faded measurement row, σᵢ² the fading's variance. Where the sensor does not
        sample both gains are zero.

    Assumes: a Markov jump system whose mode nobody sees; the estimate is the best linear one,
    not the best.

    Source: markov_jump, equations (12)-(22).
    """

    transition: Array
    measurement_matrix: Array
    input: Array
    gain: Array
    noise_gain: Array
    innovation_covariance: Array
    step: Array
    covariance: Array
    filtered_cross: Array
    predicted_cross: Array
    period: int

    @classmethod
    def create(cls, model: AugmentedModel, horizon: int) -> LocalFilters:
        """Return tables for the times 0..horizon + 1 at least, or until they are periodic.

        At k = 0 nothing is measured, and all nodes hold the mean of ζ(0).
        """
        sensors, plant = model.sensors, model.plant
        period = math.lcm(*sensors.period[:, 0].tolist())
        first = next(model.steps())
        joint = np.empty((sensors.count, sensors.count, model.size, model.size))
        joint[:] = first.moment - np.outer(first.mean, first.mean)
        shared = sensors.noise_coupling[..., 0] @ plant.noise_covariance
        noise = shared @ sensors.noise_coupling[..., 0].T
        rows: list[dict[str, Array]] = []
        observed: list[tuple[Array, ...]] = []
        for time, step in enumerate(model.steps()):
            row, following = _advance(model, step, joint, shared, noise, time)
            rows.append(row)
            observed.append((*step.moments(plant), joint.swapaxes(1, 2)))
            periodic = time > period and settled(observed[time], observed[time - period])
            if periodic or time >= max(horizon + 2, LONGEST):
                break
            joint = following
        tables = {
            name: np.ascontiguousarray(np.stack([row[name] for row in rows], axis=-1))
            for name in rows[0]
        }
        return cls(
            transition=model.transition[..., None],
            measurement_matrix=model.faded[..., None],
            period=min(period, len(rows)),
            **tables,
        )

    @property
    def length(self) -> int:
        """Number of times in the tables."""
        return self.gain.shape[-1]

    def at(self, time: Times) -> Times:
        """Return the places (N,) of the times (N,) in the tables."""
        beyond = self.length - self.period + (time - self.length) % self.period
        return namespace(time).where(time < self.length, time, beyond)

    def predict(self, mean: Array, noise_mean: Array, place: Times) -> Array:
        """Return ζ̂(k+1|k) = Ā ζ̂(k|k) + B̄ ŵ(k|k), (l, a, N), with ``place`` of the time k.

        Source: markov_jump, equations (16), (36) and, with ŵ = 0, (38).
        """
        moved = linalg.matvec(self.transition, mean)
        return moved + linalg.matvec(take(self.input, place), noise_mean)

    def update(
        self, mean: Array, measurement: Array, sampled: NDArray[np.bool_], place: Times
    ) -> tuple[Array, Array, Array]:
        """Return ζ̂(k|k) (l, a, N), ŵ(k|k) (l, r, N) and the innovations (l, N).

        An innovation is zero where a sensor is not ``sampled`` (l, N).

        Source: markov_jump, equations (12), (13), (17).
        """
        surprise = measurement - linalg.dot(self.measurement_matrix, mean)
        innovation = namespace(sampled, surprise).where(sampled, surprise, 0.0)
        correction = take(self.gain, place) * innovation[:, None]
        noise_mean = take(self.noise_gain, place) * innovation[:, None]
        return mean + correction, noise_mean, innovation


def settled(now: tuple[Array, ...], before: tuple[Array, ...]) -> bool:
    """Return whether second moments (a, a) or (l, a, l, a) agree to 1e-13 of their deviations."""
    for a, b in zip(now, before, strict=True):
        rows = math.isqrt(a.size)
        deviation = np.sqrt(np.abs(np.diagonal(a.reshape(rows, rows))))
        change = np.abs(a - b).reshape(rows, rows)
        if (change > _SETTLED * np.outer(deviation, deviation)).any():
            return False
    return True


def _advance(
    model: AugmentedModel, step: AugmentedStep, joint: Array, shared: Array, noise: Array, time: int
) -> tuple[dict[str, Array], Array]:
    """Return one time's row of the tables, and the next joint prediction covariance."""
    sensors, transition, faded = model.sensors, model.transition, model.faded
    square = np.einsum("la,ab,lb->l", model.unfaded, step.moment, model.unfaded)
    own = sensors.fading_variance * square
    noise = noise + np.diag(own + sensors.variance[:, 0])
    observed = np.einsum("ijab,jb->ija", joint, faded)  # E L_i (c_j L_j)
    innovation = np.einsum("ia,ija->ij", faded, observed) + noise
    sampled = (time % sensors.period[:, 0] == 0) & (time > 0)
    scale = np.where(sampled, 1.0 / np.diagonal(innovation), 0.0)[:, None]
    gain = scale * np.einsum("iia->ia", observed)
    noise_gain = scale * shared
    stride = gain @ transition.T + noise_gain @ step.input.T
    factor = np.eye(model.size) - gain[:, :, None] * faded[:, None]
    moved = transition - stride[:, :, None] * faded[:, None]
    covariance = _both_sides(factor, joint) + _both_sides(gain[..., None], noise[..., None, None])
    entering = shared @ step.input.T  # E v*_i (B̄ w)
    crossed = stride[:, None, :, None] * entering[:, None, None]
    process = step.input @ model.plant.noise_covariance @ step.input.T + step.additional
    following = _both_sides(moved, joint) + process
    following -= crossed + crossed.transpose(1, 0, 3, 2)
    following += _both_sides(stride[..., None], noise[..., None, None])
    filtered_cross = np.einsum("jab,jib->ija", factor, observed) - noise[..., None] * gain
    predicted_cross = np.einsum("jab,jib->ija", moved, observed) + entering[:, None]
    predicted_cross -= noise[..., None] * stride
    row = {
        "input": step.input, "gain": gain, "noise_gain": noise_gain, "step": stride,
        "innovation_covariance": innovation, "covariance": _symmetric(covariance),
        "filtered_cross": filtered_cross, "predicted_cross": predicted_cross,
    }  # fmt: skip
    return row, _symmetric(following)


def _symmetric(blocks: Array) -> Array:
    return (blocks + blocks.transpose(1, 0, 3, 2)) / 2


def _both_sides(factor: Array, blocks: Array) -> Array:
    """Return F_i X_ij F_jᵀ for all pairs: (l, b, a) and (l, l, a, a) to (l, l, b, b)."""
    return np.asarray(factor[:, None] @ blocks @ factor.swapaxes(1, 2)[None])


class LagCovariances(NamedTuple):
    """Covariances of the lags d_i, node i's prediction minus the centre's copy of it, at k|k-1.

    ``lag`` E d_i d_jᵀ (l (l + 1)/2, a, a, N), first i = j, then the pairs i < j in the order (0,
    1), (0, 2), … · ``crossed`` E d_i L_jᵀ (l (l - 1), a, a, N) with the node's error L_j, first
    these pairs, then the same with i and j exchanged.
    """

    lag: Array
    crossed: Array


class JointPrediction(NamedTuple):
    """Covariances after the nodes' update at time k, before a transmission, in the plant's states.

    ``local`` E L⁺_i L⁺_jᵀ, ``crossed`` E d⁺_i L⁺_jᵀ and ``lag`` E d⁺_i d⁺_jᵀ, each (l, l, n, n, N),
    with L⁺ the nodes' errors and d⁺ their lags before a transmission. The copy of a node has the
    error L⁺_i after a transmission, else L⁺_i + d⁺_i. A variance below ``floor`` (l, n, N) is the
    rounding of a sum over modes and counts as zero.
    """

    local: Array
    crossed: Array
    lag: Array
    floor: Array

    def joint(self, sent: NDArray[np.bool_]) -> Array:
        """Return the covariance of the copies' errors (l, l, n, n, N) after packets (l, N)."""
        behind = 1.0 - sent
        crossed = behind[:, None, None, None] * self.crossed
        result = crossed + crossed.swapaxes(0, 1).swapaxes(2, 3)
        result += self.local
        result += (behind[:, None] * behind[None])[:, :, None, None] * self.lag
        xp = namespace(result)
        certain = xp.einsum("iissN->isN", result) <= self.floor
        if xp is np and not certain.any():
            return result
        return xp.where(certain[:, None, :, None] | certain[None, :, None], 0.0, result)


@dataclass(frozen=True)
class LagRecursion:
    """The joint recursion of the errors of nodes and centre, in the lags.

    The errors of the nodes, L_i, and their covariances depend on time only. The error of the
    centre's copy is F_i = L_i + d_i with the lag d_i, the node's estimate minus its copy. A packet
    sets the lag to zero; otherwise d_i' = Ā d_i + u_i ε_i, driven by the node's innovations only:

    - E d_i' L_j'ᵀ = s_i [Ā D Āᵀ - Ā y_ij u_jᵀ + u_i E(ε_i L_j')ᵀ], D = E d_i L_jᵀ, y_ij = D c_jᵀ; -
    E d_i' d_j'ᵀ = s_i s_j [Ā D Āᵀ + Ā y_ij u_jᵀ + u_i (Ā y_ji)ᵀ + u_i u_jᵀ E ε_i ε_j],   D = E d_i
    d_jᵀ,

    with s_i = 0 after a transmission of node i and 1 otherwise. E d_i L_iᵀ = 0, because a node's
    error is orthogonal to its measurements. The result is the exact (2 l a)² recursion for every
    pattern of packets that does not depend on the noise; the paper's (46)-(50) hold at full rate
    only.

    ``filters`` holds the tables by time; ``states`` is n.
    """

    filters: LocalFilters
    states: int
    local: Array  # E L⁺_i L⁺_jᵀ, (l, l, n, n, T)
    floor: Array  # the rounding of its variances, (l, n, T)
    gain: Array  # K, (l, n, T)
    filtered_cross: Array  # E ε_i L⁺_j, (l, l, n, T)

    @classmethod
    def create(cls, filters: LocalFilters, states: int) -> LagRecursion:
        """Return the recursion of the nodes' tables and the number n of the plant's states."""
        count, size, steps = filters.gain.shape
        modes = size // states
        blocks = filters.covariance.reshape(count, count, modes, states, modes, states, steps)
        crosses = filters.filtered_cross.reshape(count, count, modes, states, steps)
        own = np.abs(np.einsum("iimskst->imkst", blocks)).sum((1, 2))
        return cls(
            filters=filters,
            states=states,
            local=blocks.sum((2, 4)),
            floor=ROUNDING * own,
            gain=filters.gain.reshape(count, modes, states, steps).sum(1),
            filtered_cross=crosses.sum(2),
        )

    @property
    def local_trace(self) -> Array:
        """Trace of each node's error covariance after the update, (l, T), in the states."""
        count = len(self.local)
        return np.stack([linalg.trace(self.local[node, node]) for node in range(count)])

    def start(self, runs: int) -> LagCovariances:
        """Return zero lags: at k = 0 the copies are the nodes' estimates."""
        count, size, _ = self.filters.gain.shape
        return LagCovariances(
            np.zeros((count * (count + 1) // 2, size, size, runs)),
            np.zeros((count * (count - 1), size, size, runs)),
        )

    def predict(self, now: LagCovariances, sent: NDArray[np.bool_], place: Times) -> LagCovariances:
        """Return the covariances at k+1|k after ``sent`` (l, N), with the ``place`` (N,) of k."""
        filters, xp = self.filters, namespace(now.lag, sent)
        silent = 1.0 - sent[:, None, None]
        transition, count = filters.transition, len(silent)
        nodes, step = np.arange(count), take(filters.step, place)
        innovation = take(filters.innovation_covariance, place)[..., None, :]
        ahead = take(filters.predicted_cross, place)
        first, second = self._pairs
        half, back = len(first), linalg.transpose(transition)
        carried, crossed = [], []
        for i, j, block in zip(
            (first, second), (second, first), (now.crossed[:half], now.crossed[half:]), strict=True
        ):
            block = linalg.matmul(transition, block)
            carried.append(linalg.matvec(block, filters.measurement_matrix[j]))
            block = linalg.matmul(block, back)
            block -= linalg.outer(carried[-1], step[j])
            block += linalg.outer(step[i], ahead[i, j])
            block *= silent[i]
            crossed.append(block)
        own = linalg.congruence(transition, now.lag[:count])
        own += linalg.outer(step, innovation[nodes, nodes] * step)
        own *= silent
        lag = linalg.matmul(linalg.matmul(transition, now.lag[count:]), back)
        lag += linalg.outer(carried[0], step[second])
        lag += linalg.outer(step[first], carried[1] + innovation[first, second] * step[second])
        lag *= silent[first] * silent[second]
        return LagCovariances(xp.concatenate((own, lag)), xp.concatenate(crossed))

    def prediction(self, now: LagCovariances, place: Times) -> JointPrediction:
        """Return the covariances after the nodes' update at the time with the ``place`` (N,)."""
        filters, xp, count = self.filters, namespace(now.lag, place), len(self.filters.gain)
        nodes, gain = np.arange(count), take(self.gain, place)
        innovation = take(filters.innovation_covariance, place)[..., None, :]
        filtered = take(self.filtered_cross, place)
        first, second = self._pairs
        half, i, j = len(first), np.append(first, second), np.append(second, first)
        rows = self._collapse(now.crossed)
        observed = linalg.matvec(rows, filters.measurement_matrix[j])
        crossed = self._collapse(rows.swapaxes(1, 2)).swapaxes(1, 2)
        crossed = crossed - linalg.outer(observed, gain[j])
        crossed += linalg.outer(gain[i], filtered[i, j])
        lag = self._collapse(self._collapse(now.lag).swapaxes(1, 2)).swapaxes(1, 2)
        own, lag = lag[:count], lag[count:]
        own = own + linalg.outer(gain, innovation[nodes, nodes] * gain)
        right = innovation[first, second] * gain[second] + observed[half:]
        lag = lag + linalg.outer(observed[:half], gain[second])
        lag += linalg.outer(gain[first], right)
        places = np.concatenate((nodes * (count + 1), i * count + j))
        order = places.argsort().reshape(count, count)
        return JointPrediction(
            take(self.local, place),
            xp.concatenate((xp.zeros_like(own), crossed))[order],
            xp.concatenate((own, lag, linalg.transpose(lag)))[order],
            take(self.floor, place),
        )

    @property
    def _pairs(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Nodes i and j of the pairs i < j."""
        first, second = np.triu_indices(len(self.filters.gain), 1)
        return first, second

    def _collapse(self, rows: Array) -> Array:
        """Return the sum of the modes' parts of the second axis: (p, a, ...) to (p, n, ...)."""
        pairs, size, *rest = rows.shape
        parts = rows.reshape(pairs, size // self.states, self.states, *rest)
        return linalg.total(parts, 1)
