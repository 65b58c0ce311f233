"""Covariances without full rank: what is known exactly stays known, and nothing becomes NaN."""

from typing import Any

import mpmath
import numpy as np
import pytest
from numpy.typing import NDArray
from parts import Parts
from structured_systems import flaw

import fusion_gym
from fusion_gym import linalg
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.fusion.intersection import covariance_intersection, inverse_covariance_intersection
from fusion_gym.fusion.table import RULES
from fusion_gym.policies.registry import make_policy
from fusion_gym.systems.unknown_input.nodes import tracked_intersection

Array = NDArray[np.float64]
CORRELATED = "fusion_gym/CorrelatedTracking-v1"
JUMP = "fusion_gym/MarkovJumpTracking-v1"
UNKNOWN = "fusion_gym/UnknownInput-v1"
PAIRS = {"ci": covariance_intersection, "ici": inverse_covariance_intersection}


def factors(ranks: tuple[int, ...], shared: int, runs: int, size: int = 4) -> Array:
    """Roots (l, n, n, N) of whole numbers: all exact, ``shared`` directions known to everyone."""
    generator = np.random.default_rng([*ranks, shared])
    space = generator.integers(-3, 4, size=(size, size - shared, runs))
    result = np.zeros((len(ranks), size, size, runs))
    for root, rank in zip(result, ranks, strict=True):
        own = generator.integers(-3, 4, size=(size - shared, min(rank, size - shared), runs))
        root[:, : own.shape[1]] = np.einsum("imN,mkN->ikN", space, own)
    return result


def squares(roots: Array) -> Array:
    return np.asarray(np.einsum("limN,ljmN->lijN", roots, roots))


CASES = [
    ((4, 4, 4), 0),
    ((3, 4, 4), 0),
    ((3, 3, 4), 0),
    ((3, 3, 3), 0),
    ((2, 3, 4), 0),
    ((1, 1, 1), 0),
    ((4, 4, 4), 1),
    ((2, 3, 3), 1),
    ((4, 4, 4), 2),
]


@pytest.mark.parametrize(("ranks", "shared"), CASES)
@pytest.mark.parametrize("rule", ["ci", "sci", "tracked", "sici"])
def test_what_one_estimate_knows_exactly_the_result_knows(
    rule: str, ranks: tuple[int, ...], shared: int
) -> None:
    """Errors lie in the ranges of the covariances; so does the fused one, and it is bounded."""
    runs = 40
    roots = factors(ranks, shared, runs)
    generator = np.random.default_rng(0)
    truth = generator.normal(size=(4, runs))
    means = truth + linalg.matvec(roots, generator.normal(size=(3, 4, runs)))
    covariance = squares(roots)
    if rule == "tracked":
        fused = tracked_intersection(means, covariance, np.full((3, runs), 1 / 3))
    else:
        fused = RULES[rule].make().fuse(means, covariance)
    maps = np.einsum("lijN,ljkN->ilkN", fused.gains, roots).reshape(4, 12, runs)
    scale = np.einsum("liiN->lN", covariance).max(0)
    identity = np.broadcast_to(np.eye(4)[..., None], fused.covariance.shape)
    np.testing.assert_allclose(fused.gains.sum(0), identity, atol=1e-8)
    np.testing.assert_allclose(np.einsum("lijN,ljN->iN", fused.gains, means), fused.mean, atol=1e-7)
    for _ in range(20):
        each = [np.linalg.qr(generator.normal(size=(4, 4)))[0] for _ in ranks]
        common, part = np.concatenate(each), generator.uniform()
        joint = part * common @ common.T + (1 - part) * np.eye(12)
        if rule == "sici":  # no bound, but it knows what is known
            known = np.linalg.matrix_rank(np.moveaxis(fused.covariance, -1, 0), 1e-9)
            for root in roots:
                assert np.all(known <= np.linalg.matrix_rank(np.moveaxis(root, -1, 0), 1e-9))
            break
        actual = np.einsum("iaN,ab,jbN->Nij", maps, joint, maps)
        margin = np.linalg.eigvalsh(np.moveaxis(fused.covariance, -1, 0) - actual)[:, 0]
        assert np.all(margin >= -1e-9 * scale)


def limit(rule: str, weight: float, roots: Array) -> tuple[Array, Array]:
    """Covariance and b's gain times its root, of covariances that are 1e-40 larger."""
    with mpmath.workdps(120):
        tiny = mpmath.mpf(10) ** -40
        a, b = (mpmath.matrix(r.tolist()) * mpmath.matrix(r.tolist()).T for r in roots)
        a, b = a + tiny * mpmath.eye(4), b + tiny * mpmath.eye(4)
        w = min(max(mpmath.mpf(weight), mpmath.mpf(10) ** -15), 1 - mpmath.mpf(10) ** -15)
        if rule == "ci":
            second = (1 - w) * b**-1
            fused = (w * a**-1 + second) ** -1
        else:
            mixed = (w * a + (1 - w) * b) ** -1
            second = b**-1 - (1 - w) * mixed
            fused = (a**-1 + b**-1 - mixed) ** -1
        gain = fused * second * mpmath.matrix(roots[1].tolist())
        return np.array(fused.tolist(), float), np.array(gain.tolist(), float)


@pytest.mark.parametrize(("ranks", "shared"), [((r[0], r[1]), s) for r, s in CASES])
@pytest.mark.parametrize("rule", PAIRS)
def test_a_pair_is_the_limit_of_regular_ones(
    rule: str, ranks: tuple[int, ...], shared: int
) -> None:
    roots = factors(ranks, shared, 6)
    covariance = squares(roots)
    fused = PAIRS[rule](np.zeros((4, 6)), covariance[0], np.zeros((4, 6)), covariance[1])
    assert fused.weights is not None
    for run in range(6):
        expected, mapped = limit(rule, float(fused.weights[0, run]), roots[..., run])
        scale = np.trace(covariance[:, ..., run].sum(0))
        np.testing.assert_allclose(fused.covariance[..., run], expected, atol=1e-10 * scale)
        got = fused.gains[1][..., run] @ roots[1][..., run]
        np.testing.assert_allclose(got, mapped, atol=1e-9 * np.sqrt(scale))


def diagonal(value: float, size: int) -> list[list[float]]:
    return (value * np.eye(size)).tolist()


CHAIN = {
    "transition": [[1.0, 20.0, 200.0], [0.0, 1.0, 20.0], [0.0, 0.0, 1.0]],
    "process_gain": [[200.0], [20.0], [1.0]],
}
SINGULAR = ((0.0, 0.01, 5e-05), (0.0, 1.0, 0.01), (0.0, 0.0, 1.0))
STILL = {"process_gains": (((0.0,), (0.0,)),) * 2}
PART = {
    "transitions": (((0.5, 0.0), (0.0, 0.9)), ((0.5, 0.0), (0.0, 0.1))),
    "process_gains": (((1.0,), (0.0,)), ((0.5,), (0.0,))),
}
PLANTS: list[tuple[str, dict[str, Any], int]] = [
    *((CORRELATED, {"transition": diagonal(0.5, 3), "fusion": f}, 80) for f in ("sici", "ci")),
    (CORRELATED, {"transition": diagonal(0.05, 3), "track_actual": True}, 150),
    (CORRELATED, {"transition": SINGULAR}, 150),
    (CORRELATED, CHAIN, 49),  # no longer without a warning: CHAIN grows
    *((JUMP, {**PART, "filter": f}, 80) for f in ("local", "centralised", "imm")),
    (JUMP, {**STILL, "transitions": (diagonal(0.1, 2),) * 2}, 200),
    (JUMP, {**STILL, "transitions": (diagonal(0.1, 2),) * 2, "fusion": "ci"}, 200),
    *(
        (UNKNOWN, {"transition": diagonal(0.05, 4), "process_covariance": diagonal(0.0, 4)} | o, 60)
        for o in ({"input_memory": 0.0}, {"filter": "predict"}, {"fusion": "sci"})
    ),
]


@pytest.mark.parametrize(("env_id", "options", "horizon"), PLANTS)
@pytest.mark.parametrize("policy", ["always", "never", "periodic"])
def test_noise_free_plants_stay_finite(
    env_id: str, options: dict[str, Any], horizon: int, policy: str
) -> None:
    task = fusion_gym.make_task(env_id, horizon=horizon, **options)
    rule, batch = make_policy(policy, task), EpisodeBatch.seeded(task, 2, 0)
    rule.reset(2, 0)
    for _ in range(horizon):
        outcome = batch.step(rule(batch.signals()))
        assert flaw(batch, outcome.reward, ()) is None
        assert np.isfinite(batch.signals()["variance_reduction"]).all()


@pytest.mark.parametrize(
    "options",
    [
        {"transition": diagonal(0.5, 3)},
        {**CHAIN, "horizon": 49},
        {"measurement_variance": (1e-8, 1e-8, 1e-8)},
        {"measurement_variance": (1e-10, 1.0, 1e6), "noise_coupling": 5.0},
    ],
)
def test_the_robust_filter_against_fifty_digits(options: dict[str, Any]) -> None:
    task = fusion_gym.make_task(CORRELATED, **({"horizon": 60} | options))
    batch, generator = EpisodeBatch.seeded(task, 1, 0), np.random.default_rng(0)
    plant, sensors = task.plant.dynamics, task.estimator.filter.sensors

    def exact(values: Array) -> Any:
        return mpmath.matrix(values.tolist())

    with mpmath.workdps(50):
        move, drive = exact(plant.transition[..., 0]), exact(plant.process_factor[..., 0])
        rows = [exact(row) for row in sensors.measurement_matrix[..., 0]]
        shares = [exact(share) for share in sensors.coupling[..., 0]]
        own = [exact(np.diag(d)) ** 2 for d in sensors.deviation[..., 0]]
        covariances = [exact(plant.initial_covariance[..., 0])] * 3
        means = [exact(plant.initial_mean)] * 3
        for _ in range(task.horizon):
            granted = generator.random((3, 1)) < 0.7
            measured = batch.state.estimate.measurement[..., 0].copy()
            batch.step(granted)
            for i in range(3):
                prior, mean = move * covariances[i] * move.T + drive * drive.T, move * means[i]
                if granted[i, 0]:
                    shared = drive * shares[i].T
                    cross = prior * rows[i].T + shared
                    spread = rows[i] * cross + (rows[i] * shared).T
                    gain = cross * (spread + shares[i] * shares[i].T + own[i]) ** -1
                    mean += gain * (exact(measured[i]) - rows[i] * mean)
                    prior -= gain * cross.T
                covariances[i], means[i] = prior, mean
                variance = np.array([float(prior[k, k]) for k in range(3)])
                delivered = batch.delivered.estimate
                got = np.diagonal(delivered.covariances[i + 1, ..., 0])
                np.testing.assert_allclose(got, variance, rtol=1e-9)
                apart = [
                    float(mpmath.mpf(delivered.means[i + 1, k, 0]) - mean[k]) for k in range(3)
                ]
                assert np.all(np.abs(apart) <= 1e-9 * np.sqrt(variance))


@pytest.mark.parametrize("name", ["local", "centralised"])
def test_a_decaying_state_keeps_its_own_variance_in_the_tables(name: str) -> None:
    """Nothing is delivered, so the covariance is that of the plant; the tables end long before."""
    task = fusion_gym.make_task(JUMP, horizon=150, filter=name, **PART)
    batch = EpisodeBatch.seeded(task, 1, 0)
    _, moments = task.estimator.model.state_moments(150)
    for time in range(1, 151):
        batch.step(np.zeros((3, 1), dtype=np.bool_))
        covariance = Parts.of(task).fused(batch.delivered)[1]
        np.testing.assert_allclose(linalg.diagonal(covariance)[:, 0], moments[time], rtol=1e-9)


def test_directions_without_a_variance_do_not_count_in_the_normalised_error() -> None:
    """Two of three states are decided by the start alone and soon known; one is noisy."""
    gain = [[1.0], [0.0], [0.0]]
    task = fusion_gym.make_task(
        CORRELATED, horizon=400, transition=diagonal(0.05, 3), process_gain=gain, fusion="sci"
    )
    result = run_episodes(task, make_policy("never", task), 200, seed=0)
    assert result.nees.mean() == pytest.approx(1.0, abs=0.05)
