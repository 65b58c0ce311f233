"""The lower bound of every policy's error: against exact optima, policies and itself."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from parts import Parts
from scipy import stats
from scipy.optimize import brentq

from fusion_gym.arrays import Array
from fusion_gym.envs.registration import make_task, present_id
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.evaluation.metrics import mean_interval
from fusion_gym.policies.registry import make_policy
from fusion_gym.solvers.silence import (
    SilenceProblem,
    cost_bound,
    silence_bound,
    silence_model,
    simulate,
    solve_silence,
)
from fusion_gym.solvers.silence.induction import Survival
from fusion_gym.solvers.silence.lattice import Coordinates, hat_weights, margins, spread_values
from fusion_gym.solvers.single import solve_finite
from fusion_gym.solvers.source import ErrorGrid, SourceProblem
from fusion_gym.validation import ConfigurationError

TRUNCATED = {"filter": "truncated", "trigger": "send_on_delta", "trigger_threshold": 1.0}
OSCILLATOR: dict[str, Any] = {"filter": "tobit", "random_start": True, "horizon": 20}
TURN = [[0.8, -0.6], [0.6, 0.8]]


# --- against what is known exactly ----------------------------------------------------------------


@pytest.mark.parametrize(
    ("coefficient", "price", "horizon"),
    [(1.0, 5.0, 40), (1.0, 0.3, 40), (0.9, 0.5, 30), (0.5, 3.0, 20), (1.05, 8.0, 20)],
)
def test_never_above_the_exact_optimum_of_remote_estimation(
    coefficient: float, price: float, horizon: int
) -> None:
    """And within a thousandth of it: the bound is not low for safety."""
    source = SourceProblem.create(coefficient=coefficient, price=price)
    reach = float(source.grid(horizon).points[-1])
    grid = ErrorGrid.create(source.coefficient, source.deviation, reach, 0.02)
    exact = solve_finite(source, horizon, grid=grid).cost / horizon
    noise = np.ones((horizon, 1, 1))
    problem = SilenceProblem.create([[coefficient]], [1.0], noise, price)
    coarse, fine = (solve_silence(problem, step).lower for step in (0.2, 0.03))
    assert coarse < fine < exact
    assert fine > 0.998 * exact


def test_two_steps_in_the_plane_by_quadrature() -> None:
    """Turned by A, with round noise: the squared length is a noncentral chi-square."""
    price = 3.0

    place, weight = np.polynomial.legendre.leggauss(60)
    inner = 0.5 * price * (place + 1.0)

    def silent(square: Array) -> Array:
        """|e|² now, then the lesser of the next |e|² and a packet."""
        left = stats.ncx2.sf(inner[:, None], 2, np.maximum(square, 1e-12))
        return square + 0.5 * price * weight @ left

    packet = price + float(silent(np.zeros(1))[0])
    edge = float(brentq(lambda square: float(silent(np.array([square]))[0]) - packet, 0.0, 10.0))
    outer = 0.5 * edge * (place + 1.0)
    exact = 0.5 * edge * weight @ (silent(outer) * 0.5 * np.exp(-0.5 * outer))
    exact += packet * np.exp(-0.5 * edge)
    problem = SilenceProblem.create(TURN, [1.0, 1.0], np.tile(np.eye(2), (2, 1, 1)), price)
    result = solve_silence(problem, 0.02).lower
    assert result < 0.5 * exact
    assert result == pytest.approx(0.5 * exact, rel=2e-3)


def test_unequal_weights_are_a_change_of_units() -> None:
    noise = np.tile(np.diag([1.0, 0.3]), (20, 1, 1))
    plain = SilenceProblem.create(TURN, [1.0, 1.0], noise, 2.0)
    unit = np.diag([2.0, 0.5])
    other = SilenceProblem.create(
        unit @ np.array(TURN) @ np.linalg.inv(unit), [0.25, 4.0], unit @ noise @ unit, 2.0
    )
    assert solve_silence(other, 0.1).lower == pytest.approx(
        solve_silence(plain, 0.1).lower, rel=1e-3
    )


# --- against itself and against policies ----------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_the_policy_of_the_lattices_costs_no_less(seed: int) -> None:
    """Any matrix, noise of any rank that changes with time; both sides are close."""
    draw = np.random.default_rng(seed)
    size = 2 if seed % 2 else 3
    transition = draw.standard_normal((size, size))
    transition /= max(np.abs(np.linalg.eigvals(transition)))
    factor = draw.standard_normal((12, size, 1 + seed // 2))
    noise = factor @ np.swapaxes(factor, -1, -2)
    problem = SilenceProblem.create(transition, draw.uniform(0.5, 2.0, size), noise, 4.0)
    solution = solve_silence(problem, 0.2)
    above = simulate(problem, solution, 4000)
    assert solution.lower < above.high
    assert above.cost < 1.15 * solution.lower
    # Neither always silent nor always sending is as good as the bound.
    assert solution.lower < problem.price
    covariance, silent = np.zeros((size, size)), 0.0
    for step in noise:
        covariance = transition @ covariance @ transition.T + step
        silent += problem.weights @ np.diagonal(covariance) / len(noise)
    assert solution.lower < silent


@cache
def oscillator_bound() -> Any:
    return silence_bound(make_task("fusion_gym/TobitOscillator-v1", **OSCILLATOR), (0.03, 0.1))


@pytest.mark.parametrize(
    ("policy", "tokens"),
    [
        ("always", "unlimited"),
        ("always", "limited"),
        ("never", "limited"),
        ("innovation_threshold:threshold=1", "limited"),
        ("innovation_threshold:threshold=2,at_most=1", "unlimited"),
        ("innovation_threshold:threshold=3", "unlimited"),
        ("periodic:period=12", "unlimited"),
        ("value_of_information:price=0.02", "limited"),
    ],
)
def test_never_above_the_interval_of_a_policy(policy: str, tokens: str) -> None:
    options = OSCILLATOR | {"token_rate": 2.0, "tokens": tokens}
    task = make_task("fusion_gym/TobitOscillator-v1", **options)
    results = run_episodes(task, make_policy(policy, task), 300, 0)
    bound, _ = oscillator_bound().at(float(results.rate.mean()))
    assert bound < mean_interval(results.mse).low
    assert bound >= oscillator_bound().floor


def test_the_bound_is_tight_where_every_measurement_arrives_uncensored() -> None:
    """The Kalman filter of all measurements is the floor, but for the first measurement."""
    options = {"filter": "kalman", "censoring_threshold": -np.inf, "horizon": 100}
    task = make_task("fusion_gym/TobitOscillator-v1", tokens="unlimited", **options)
    error = run_episodes(task, make_policy("always", task), 200, 0).mse.mean()
    assert 0.9 * error < silence_model(task).floor < error


def test_halving_the_lattice_moves_the_bound_by_less_than_one_per_cent() -> None:
    task = make_task("fusion_gym/TobitOscillator-v1", **OSCILLATOR)
    model, bound = silence_model(task), oscillator_bound()
    for rate in (0.03, 0.1):
        value, cost = bound.at(rate)
        problem = replace(model.problem, price=cost.price)
        finer = solve_silence(problem, 0.5 * cost.step)
        assert 0.0 < model.floor + finer.lower - cost.lower < 0.01 * value
        assert model.floor + finer.lower < cost.upper
        assert 0.0 < cost.gap < 0.015


def test_the_bound_falls_with_the_rate_and_every_price_gives_one() -> None:
    bound = oscillator_bound()
    values = [bound.at(rate)[0] for rate in (0.01, 0.03, 0.06, 0.1, 0.5)]
    assert (np.diff(values) < 0.0).all()
    assert values[-1] == bound.floor
    dear, cheap = bound.at(0.03)[1], bound.at(0.1)[1]
    assert dear.price > cheap.price
    assert dear.rate == pytest.approx(0.03, rel=0.1)
    # The cost is concave in the price, its slope the packets per step.
    slope = (dear.lower - cheap.lower) / (dear.price - cheap.price)
    assert 3 * dear.rate < slope < 3 * cheap.rate


# --- the parts ------------------------------------------------------------------------------------


@pytest.mark.parametrize("deviation", [0.05, 0.7, 3.0, 20.0])
def test_hats_keep_the_mean_and_widen_the_noise(deviation: float) -> None:
    weights = hat_weights(deviation, int(9 * deviation) + 3)
    assert (weights >= -1e-16).all()
    assert weights[0] + 2.0 * weights[1:].sum() == pytest.approx(1.0, abs=1e-13)
    variance = 2.0 * weights @ np.arange(len(weights)) ** 2
    assert deviation**2 <= variance < deviation**2 + 0.25
    everywhere = 1 + margins(np.array([deviation]))
    single = np.array([0.0, -1.0, 0.0]), np.array([deviation])
    values, added = spread_values(*single, everywhere)
    assert (spread_values(*single, everywhere - 2)[0] == values[2:-2]).all()
    assert variance == pytest.approx(deviation**2 + added)
    assert -values.sum() == pytest.approx(1.0, abs=1e-12)
    # A concave function has its mean bounded from below: here that of -|X|.
    mean = -2.0 * weights @ np.arange(len(weights))
    assert mean <= -deviation * np.sqrt(2.0 / np.pi) + 1e-12


def test_silence_lasts_no_longer_than_its_bounds_say() -> None:
    draw, transition = np.random.default_rng(0), np.array(TURN)
    noise, form = np.diag([0.3, 0.1]), np.diag([1.0, 0.8])
    survival = Survival(transition, np.ones(2), 21)
    for _ in range(20):
        survival.add(form, noise)
    assert np.trace(survival.curvature) < 2 * 20
    for start in ([0.0, 0.0], [0.5, 0.0], [0.0, -0.9]):
        error = np.tile(np.array(start)[:, None], 20_000)
        silent = np.ones(20_000)
        total = np.ones(20_000)
        for _ in range(19):
            error = transition @ error + np.sqrt(noise) @ draw.standard_normal(error.shape)
            silent *= np.linalg.norm(form @ error, axis=0) <= 1.0
            total += silent
        assert total.mean() < 0.5 * np.trace(survival.curvature)


def test_coordinates_make_noise_and_curvature_diagonal() -> None:
    draw = np.random.default_rng(1)
    root, factor = draw.standard_normal((3, 3)), draw.standard_normal((3, 2))
    curvature, noise = root @ root.T, factor @ factor.T
    value = Coordinates.create(curvature, noise)
    assert value.basis.T @ curvature @ value.basis == pytest.approx(np.eye(3), abs=1e-9)
    assert value.basis @ np.diag(value.variance) @ value.basis.T == pytest.approx(noise, abs=1e-9)
    assert (value.variance == 0.0).sum() == 1


# --- where it does not apply ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("env", "options", "change", "message"),
    [
        ("TobitOscillator", {"filter": "paper"}, {}, "filter .*not allowed for the bound"),
        ("LinearFusion", {"filter": "hold"}, {}, "filter .*not allowed for the bound"),
        ("LinearFusion", TRUNCATED, {}, "filter .*not allowed for the bound"),
        ("BiasedOscillator", {"bias_aware": False}, {}, "bias_aware .*not allowed for the bound"),
        ("UnknownInput", {}, {}, "plant .*not allowed for the bound"),
        ("RemoteEstimation", {}, {}, "plant .*not allowed for the bound"),
        ("TobitOscillator", OSCILLATOR, {"rates": (0.0,)}, "rates"),
        ("TobitOscillator", OSCILLATOR, {"weights": (1.0, 0.0)}, "weights"),
        ("TobitOscillator", OSCILLATOR, {"accuracy": 0.0}, "accuracy"),
        ("TobitOscillator", OSCILLATOR, {"most_points": 10}, "most_points"),
    ],
)
def test_tasks_without_the_bound_and_other_values_are_refused(
    env: str, options: dict[str, Any], change: dict[str, Any], message: str
) -> None:
    task = make_task(present_id(env), **options)
    with pytest.raises(ConfigurationError, match=f"^{message}") as caught:
        silence_bound(task, **{"rates": (0.1,)} | change)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("env", "options"),
    [
        ("TobitOscillator", {"filter": "paper", "silent": "predict", "event_error": False}),
        ("TobitOscillator", {"filter": "adf"}),
        ("TobitOscillator", {"filter": "kalman", "fusion": "ci"}),
        ("TobitOscillator", {"filter": "tobit", "fusion": "sci"}),
        ("BiasedOscillator", {}),
        ("BiasedTracking", {"filter": "adf"}),
    ],
)
def test_where_it_applies_silence_is_prediction(env: str, options: dict[str, Any]) -> None:
    task = make_task(present_id(env), horizon=5, **options)
    assert silence_model(task).floor > 0.0
    system = Parts.of(task)
    draw = np.random.default_rng(0)
    state = system.start(draw.standard_normal((system.plant.start_channels, 3)))
    for granted in (True, False, False):
        before = system.fused(state)[0]
        state = system.sense(state, draw.standard_normal((system.plant.noise_channels, 3)))
        state = system.deliver(state, np.full((task.sensors, 3), granted))
    matrix = system.estimator.model.transition[..., 0]  # type: ignore[attr-defined]
    assert system.fused(state)[0] == pytest.approx(matrix @ before, rel=1e-9, abs=1e-12)


def test_no_rule_costs_less_than_the_bound_at_its_price() -> None:
    options = {"filter": "tobit", "random_start": True, "token_rate": 2.0, "memory": True}
    task = make_task("fusion_gym/TobitOscillator-v1", horizon=40, **options)
    for price in (0.05, 0.5):
        bound = cost_bound(task, price)
        assert bound.lower < bound.upper < 1.05 * bound.lower
        rule = make_policy(f"value_of_information:price={price / 4},at_most=1", task)
        results = run_episodes(task, rule, 200, 0)
        assert float((results.error_cost + price * results.tokens).mean()) > bound.lower
