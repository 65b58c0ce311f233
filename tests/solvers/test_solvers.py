"""The solved optimum of remote estimation: published costs, integral equations, closed forms."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from buckets import make_bucket
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from rules import make_rule
from scalar_ages import by_age
from scipy.optimize import minimize_scalar

from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.solvers.ages import solve_ages
from fusion_gym.solvers.joint import JointProblem, solve_joint_average, solve_joint_finite
from fusion_gym.solvers.single import (
    lagrangian_bound,
    solve_average,
    solve_discounted,
    solve_finite,
)
from fusion_gym.solvers.source import ErrorGrid, SourceProblem, TokenLevels, gaussian_rows
from fusion_gym.solvers.task import solve_task, source_problems
from fusion_gym.validation import ConfigurationError

Array = NDArray[np.float64]

# --- the published example -----------------------------------------------------------------------

# (1 - β) times the discounted cost from zero error and a bad channel at time 0, of the paper's
# example: a = 1, σ = 1, β = 0.9, price 100, losses 0.7 (bad) and 0.2 (good). By the probabilities
# of going from bad to bad and from good to bad. From C_summary.tsv of the authors' repository
# Jhelum-Ch/remote-estimation-with-Gilbert-Elliott-channel: thresholds found by stochastic
# approximation, costs by Monte Carlo.
PUBLISHED = {
    (0.3, 0.1): 6.5286,
    (0.3, 0.4): 6.9019,
    (0.3, 0.8): 6.9346,
    (0.3, 0.9): 6.9287,
    (0.5, 0.1): 6.5687,
    (0.5, 0.4): 7.0768,
    (0.5, 0.8): 7.2771,
    (0.5, 0.9): 7.2555,
    (0.7, 0.1): 6.6911,
    (0.7, 0.4): 7.3072,
    (0.7, 0.8): 7.6557,
    (0.7, 0.9): 7.6665,
    (0.9, 0.1): 7.2214,
    (0.9, 0.4): 7.8102,
    (0.9, 0.8): 8.1102,
    (0.9, 0.9): 8.1336,
}


def published_problem(stays: float, falls: float) -> SourceProblem:
    transition = [[stays, 1.0 - stays], [falls, 1.0 - falls]]
    return SourceProblem.create(price=100.0, drop=(0.7, 0.2), transition=transition)


@pytest.mark.parametrize("chain", PUBLISHED)
def test_published_costs(chain: tuple[float, float]) -> None:
    solution = solve_discounted(published_problem(*chain), 0.9)
    assert solution.cost[0] == pytest.approx(PUBLISHED[chain], rel=0.002)
    assert solution.ordered


# --- a perfect channel: the integral equations of a renewal cycle --------------------------------


def cycle(threshold: float, a: float, price: float, nodes: int = 120) -> tuple[float, float]:
    """Average cost and rate of a threshold: Fredholm equations by Gauss-Legendre quadrature."""
    place, weight = np.polynomial.legendre.leggauss(nodes)
    place, weight = threshold * place, threshold * weight

    def density(to: Array, start: Array | float) -> Array:
        return np.exp(-0.5 * (to - a * start) ** 2) / math.sqrt(2.0 * math.pi)

    stay = np.eye(nodes) - density(place[None], place[:, None]) * weight
    paid = np.linalg.solve(stay, place**2)
    lasts = np.linalg.solve(stay, np.ones(nodes))
    first = density(place, 0.0) * weight
    length = 1.0 + first @ lasts
    return float((first @ paid + price) / length), float(1.0 / length)


@pytest.mark.parametrize("a", [0.8, 1.0, 1.1])
@pytest.mark.parametrize("price", [0.5, 5.0, 100.0])
def test_perfect_channel_against_the_integral_equations(a: float, price: float) -> None:
    solution = solve_average(SourceProblem.create(coefficient=a, price=price))
    best = minimize_scalar(
        lambda k: cycle(k, a, price)[0], bounds=(0.05, 10.0), options={"xatol": 1e-8}
    )
    assert solution.cost == pytest.approx(best.fun, rel=2e-4)
    assert solution.threshold[0, 0] == pytest.approx(best.x, abs=2e-3)
    assert solution.rate == pytest.approx(cycle(best.x, a, price)[1], rel=3e-3)
    assert solution.lower <= solution.cost <= solution.upper
    # A threshold that is 30 % off is told apart.
    assert cycle(1.3 * best.x, a, price)[0] > solution.cost * 1.0005


@settings(max_examples=15, deadline=None)
@given(sigma=st.floats(0.1, 10.0), weight=st.floats(0.1, 10.0), price=st.floats(0.5, 20.0))
def test_cost_scales_with_the_units(sigma: float, weight: float, price: float) -> None:
    plain = solve_average(SourceProblem.create(price=price))
    unit = weight * sigma**2
    other = solve_average(
        SourceProblem.create(deviation=sigma, price=price * unit, error_weight=weight)
    )
    assert other.cost == pytest.approx(plain.cost * unit, rel=1e-3)
    assert other.threshold[0, 0] == pytest.approx(plain.threshold[0, 0] * sigma, rel=1e-3)
    assert other.error == pytest.approx(plain.error * sigma**2, rel=1e-2)


@settings(max_examples=30, deadline=None)
@given(mean=st.floats(0.0, 5.0), step=st.floats(0.02, 0.5))
def test_grid_has_the_moments_of_the_gaussian(mean: float, step: float) -> None:
    points = step * np.arange(int(14.0 / step))
    row = gaussian_rows(np.array([mean]), 1.0, points)[0]
    assert (row >= 0.0).all()
    assert row.sum() == pytest.approx(1.0, abs=1e-14)
    assert row @ points**2 == pytest.approx(mean**2 + 1.0, rel=1e-7)
    assert row @ np.cos(points) == pytest.approx(math.exp(-0.5) * math.cos(mean), abs=1e-7)


# --- rules on age --------------------------------------------------------------------------------


def period_cost(period: int, a: float, price: float) -> float:
    silent = sum((period - 1 - j) * a ** (2 * j) for j in range(period - 1))
    return (price + silent) / period


@pytest.mark.parametrize("a", [0.9, 1.0, 1.2])
@pytest.mark.parametrize("price", [0.5, 6.0, 60.0])
def test_best_age_rule_of_one_source_is_the_best_period(a: float, price: float) -> None:
    best = min(period_cost(period, a, price) for period in range(1, 80))
    if a < 1.0:
        best = min(best, 1.0 / (1.0 - a * a))  # never
    problem = SourceProblem.create(coefficient=a, price=price)
    assert solve_ages((by_age(problem),)).cost == pytest.approx(best, rel=1e-4)


def test_round_robin_is_the_best_schedule_by_ages_of_equal_sources_only() -> None:
    free = by_age(SourceProblem.create(price=0.0), sharing=3.0)
    assert solve_ages((free,) * 3, at_most=1).cost == pytest.approx(3.0, rel=1e-6)  # 0 + 1 + 2
    wild = by_age(SourceProblem.create(price=0.0, deviation=4.0), sharing=3.0)
    uneven = solve_ages((wild, free), at_most=1).cost
    # Round robin costs 16/2 + 1/2; the calm source waits for τ steps, the wild one once.
    assert uneven == pytest.approx(
        min((16.0 + t * (t - 1) / 2.0) / t for t in range(2, 20)), rel=1e-6
    )
    assert uneven < 8.5


def test_losses_in_the_best_schedule_by_ages() -> None:
    """Always transmitting is best at price zero: the age is then geometric."""
    problem = SourceProblem.create(price=0.0, drop=0.4)
    assert solve_ages((by_age(problem),)).cost == pytest.approx(0.4 / 0.6, rel=1e-5)


# --- tokens --------------------------------------------------------------------------------------


def test_levels_of_a_bucket() -> None:
    bucket = make_bucket(1.0, 6.0, 2.0, 3.0, sensors=1)
    levels = TokenLevels.create(bucket)
    assert levels.level.tolist() == [1, 2, 3, 4, 5, 6]
    assert levels.level[levels.initial] == 2.0
    assert levels.affordable[:, 1].tolist() == [False] * 2 + [True] * 4
    assert levels.level[levels.following[:, 0]].tolist() == [2, 3, 4, 5, 6, 6]
    assert levels.level[levels.following[2:, 1]].tolist() == [1, 2, 3, 4]
    assert levels.index(np.array([1.0, 2.9999999, 6.0])).tolist() == [0, 2, 5]
    awkward = make_bucket(math.sqrt(0.5), 600.0, 0.0, 1.0, sensors=1)
    with pytest.raises(ConfigurationError, match="levels"):
        TokenLevels.create(awkward)


def test_tokens_in_plenty_do_not_bind() -> None:
    bucket = make_bucket(1.0, 2.0, 2.0, 1.0, sensors=1)
    wide = solve_average(SourceProblem.create(price=5.0, bucket=bucket))
    assert wide.cost == pytest.approx(solve_average(SourceProblem.create(price=5.0)).cost, rel=1e-4)


# --- episodes ------------------------------------------------------------------------------------


def test_short_episodes_by_hand() -> None:
    """One step: E min(w², 1) of a standard normal w; the first of two steps looks one ahead."""
    from scipy.integrate import quad

    def density(w: float) -> float:
        return math.exp(-0.5 * w * w) / math.sqrt(2.0 * math.pi)

    problem = SourceProblem.create(price=1.0, coefficient=1.2)

    def last(e: float) -> float:
        inside = quad(lambda w: ((1.2 * e + w) ** 2 - 1.0) * density(w), *_ends(e), epsabs=1e-12)
        return 1.0 + float(inside[0])

    def _ends(e: float) -> tuple[float, float]:
        return -1.0 - 1.2 * e, 1.0 - 1.2 * e

    reach = float(problem.grid(2).points[-1])
    fine = ErrorGrid.create(problem.coefficient, problem.deviation, reach, 0.02)
    assert solve_finite(problem, 1, grid=fine).cost == pytest.approx(last(0.0), rel=2e-4)
    both = quad(lambda w: min(w * w + last(w), 1.0 + last(0.0)) * density(w), -8, 8, limit=200)
    solution = solve_finite(problem, 2, grid=fine)
    assert solution.cost == pytest.approx(both[0], rel=2e-4)
    assert solution.threshold[1, 0, 0] == pytest.approx(1.0, abs=1e-3)
    assert solution.threshold[0, 0, 0] < 1.0


def test_long_episodes_approach_the_average() -> None:
    problem = SourceProblem.create(price=5.0)
    average = solve_average(problem)
    short, long = (solve_finite(problem, steps) for steps in (100, 200))
    assert long.cost - short.cost == pytest.approx(100.0 * average.cost, rel=2e-4)
    assert long.threshold[20, 0, 0] == pytest.approx(average.threshold[0, 0], abs=2e-3)
    assert long.cost == pytest.approx(200.0 * (long.error + 5.0 * long.rate), rel=1e-9)
    assert long.threshold.shape == (200, 1, 1)


def test_unstable_source_needs_a_reliable_channel() -> None:
    assert solve_average(SourceProblem.create(coefficient=1.2, price=5.0)).cost < 3.0
    lossy = SourceProblem.create(coefficient=1.2, price=5.0, drop=0.8)
    for solve in (solve_average, lambda p: JointProblem.create((p, p))):
        with pytest.raises(ConfigurationError, match=r"coefficient = 1.2 .* is infinite"):
            solve(lossy)
    with pytest.raises(ConfigurationError, match="iterations"):
        solve_average(SourceProblem.create(price=5.0), iterations=5)


def error_of_always(a: float, drop: float) -> float:
    """Mean squared error if every packet is sent: Σ (1-p) p^k (1 + a² + … + a^(2(k-1)))."""
    grown = drop * a * a
    return (1.0 - drop) / (a * a - 1.0) * (grown / (1.0 - grown) - drop / (1.0 - drop))


@pytest.mark.parametrize("drop", [0.1, 0.5, 0.6, 0.65, 0.69])
def test_losses_of_an_unstable_source_have_their_second_moment(drop: float) -> None:
    free = SourceProblem.create(coefficient=1.2, price=0.0, drop=drop)
    assert solve_average(free).cost == pytest.approx(error_of_always(1.2, drop), rel=1e-6)


@pytest.mark.parametrize("drop", [0.5, 0.8])
def test_an_episode_has_the_error_that_grows_beyond_the_grid(drop: float) -> None:
    before, total = 1.0, 0.0
    for _ in range(100):
        total += drop * before
        before = 1.44 * drop * before + 1.0
    free = SourceProblem.create(coefficient=1.2, price=0.0, drop=drop)
    assert solve_finite(free, 100).cost == pytest.approx(total, rel=1e-5)
    priced = solve_finite(SourceProblem.create(coefficient=1.2, price=1.0, drop=drop), 100)
    assert total <= priced.cost <= total + 100.0


@settings(max_examples=50, deadline=None)
@given(a=st.floats(0.5, 1.6), part=st.floats(0.0, 0.97), price=st.floats(0.1, 30.0))
def test_a_wider_grid_has_the_same_optimum(a: float, part: float, price: float) -> None:
    drop = part * min(0.95, 1.0 / a**2)
    problem = SourceProblem.create(coefficient=a, price=price, drop=drop)
    points = problem.grid().points
    wide = solve_average(problem, ErrorGrid.create(a, 1.0, 1.5 * points[-1], points[1]))
    solution = solve_average(problem)
    assert solution.lower <= solution.cost <= solution.upper
    assert solution.cost == pytest.approx(wide.cost, rel=1e-5)
    assert solution.cost <= error_of_always(a, drop) + price if abs(a - 1.0) > 1e-3 else True


def test_gilbert_elliott_of_an_unstable_source_agrees_with_a_wider_grid() -> None:
    channel = {"drop": (0.7, 0.2), "transition": ((0.7, 0.3), (0.1, 0.9))}
    problem = SourceProblem.create(coefficient=1.35, price=5.0, **channel)
    points = problem.grid().points
    wide = solve_average(problem, ErrorGrid.create(1.35, 1.0, 2.0 * points[-1], points[1]))
    assert solve_average(problem).cost == pytest.approx(wide.cost, rel=1e-6)


# --- several sources -----------------------------------------------------------------------------


@pytest.mark.slow
def test_joint_optimum_of_sources_that_share_nothing_is_the_sum() -> None:
    sources = (SourceProblem.create(price=3.0), SourceProblem.create(coefficient=0.8, price=6.0))
    joint = solve_joint_average(JointProblem.create(sources))
    assert joint.cost == pytest.approx(sum(solve_average(s).cost for s in sources), rel=2e-3)
    episode = solve_joint_finite(JointProblem.create(sources), 50, (2.0, 0.0))
    parts = solve_finite(sources[0], 50, 2.0).cost + solve_finite(sources[1], 50).cost
    assert episode.cost == pytest.approx(parts, rel=2e-3)
    lossy = SourceProblem.create(coefficient=1.2, price=2.0, drop=0.6)
    pair = JointProblem.create((lossy, lossy))
    both = 2.0 * solve_finite(lossy, 20, 1.0).cost
    assert solve_joint_finite(pair, 20, (1.0, 1.0)).cost == pytest.approx(both, rel=2e-3)


@pytest.mark.parametrize("drop", [0.0, 0.3])
def test_joint_optimum_lies_between_the_dual_bound_and_the_best_schedule(drop: float) -> None:
    """One transmission a step for two sources: bound <= optimum < best rule on ages."""
    sources = (
        SourceProblem.create(price=0.0, drop=drop),
        SourceProblem.create(price=0.0, drop=drop, deviation=1.5),
    )
    bound = lagrangian_bound(sources, (1.0, 1.0), 1.0).cost
    joint = solve_joint_average(JointProblem.create(sources, at_most=1))
    ages = solve_ages(tuple(by_age(source, sharing=2.0) for source in sources), at_most=1).cost
    assert bound < joint.cost < ages
    assert ages > 1.4 * joint.cost
    # With one packet per step the larger error goes first where all else is equal.
    same = (sources[0], sources[0])
    choice = solve_joint_average(JointProblem.create(same, at_most=1)).choice[..., 0]
    first, two = np.indices(choice.shape)
    inner = np.maximum(first, two) < 20
    assert (choice[inner & (first > two)] == 1).all()
    assert (choice[inner & (two > first)] == 2).all()


def test_dual_bound_of_an_episode() -> None:
    bucket = make_bucket(0.5, 4.0, 2.0, 1.0, sensors=2, sharing="fixed")
    sources = (SourceProblem.create(price=0.5), SourceProblem.create(price=0.5, coefficient=0.8))
    joint = solve_joint_finite(JointProblem.create(sources, bucket), 30)
    bound = lagrangian_bound(sources, (1.0, 1.0), 0.5, horizon=30, initial_tokens=2.0)
    assert 0.75 * joint.cost < bound.cost < joint.cost
    assert bound.multiplier > 0.0
    loose = lagrangian_bound(sources, (1.0, 1.0), 5.0, horizon=30)
    assert loose.multiplier == 0.0
    assert loose.cost == pytest.approx(sum(solve_finite(s, 30).cost for s in sources))


@pytest.mark.slow
@pytest.mark.parametrize("start", ["good", "bad", "stationary"])
def test_dual_bound_of_channels_that_start_in_a_state(start: str) -> None:
    """It lies below what always transmitting costs, and is the optimum where tokens abound."""
    task = make_task(
        "fusion_gym/RemoteEstimation-v1",
        sensors=3,
        channel="gilbert_elliott",
        channel_transition=((0.95, 0.05), (0.05, 0.95)),
        drop_probability=(1.0, 0.0),
        initial_channel=start,
        cost_weight=0.0,
        horizon=20,
    )
    problems = source_problems(task)
    bound = lagrangian_bound(problems, (1.0,) * 3, 3.0, horizon=20, initial_tokens=3.0)
    always = -run_episodes(task, make_rule("always"), 8000, 0).returns
    room = 4.0 * always.std() / math.sqrt(len(always))
    assert bound.cost == pytest.approx(solve_task(task).cost)
    assert abs(always.mean() - bound.cost) < room < 0.1 * bound.cost
    scarce = lagrangian_bound(problems, (1.0,) * 3, 0.5, horizon=20)
    assert scarce.cost > bound.cost
    assert scarce.multiplier > 0.0


def test_a_channel_starts_in_its_stationary_law_unless_reported() -> None:
    transition = ((0.9, 0.1, 0.0), (0.2, 0.7, 0.1), (0.0, 0.4, 0.6))
    problem = SourceProblem.create(drop=(0.9, 0.3, 0.0), transition=transition)
    assert problem.initial @ problem.transition == pytest.approx(problem.initial)
    assert problem.initial.sum() == pytest.approx(1.0)
    value = SourceProblem.create(drop=(0.9, 0.3, 0.0), transition=transition, initial=(0, 0, 1))
    assert solve_finite(value, 10).cost < solve_finite(problem, 10).cost


# --- what is refused -----------------------------------------------------------------------------


def make_problem(transition: Any, initial: Any = None) -> SourceProblem:
    return SourceProblem.create(drop=0.1, transition=transition, initial=initial)


PLAIN, STATES = SourceProblem.create(), published_problem(0.3, 0.1)
BUCKET = make_bucket(0.5, 2.0, 0.0, 1.0, sensors=1)


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda: make_problem([[0.5, 0.4], [0.1, 0.9]]), "transition"),
        (lambda: make_problem([[0.5, 0.5]]), "transition"),
        (lambda: make_problem(np.eye(2)), "initial = None"),
        (lambda: make_problem(np.eye(2), (0.5, 0.4)), "initial"),
        (lambda: solve_discounted(PLAIN, 1.0), "discount"),
        (lambda: solve_finite(PLAIN, 0), "horizon"),
        (lambda: JointProblem.create((PLAIN,) * 3), "sensors = 3"),
        (lambda: JointProblem.create((PLAIN, STATES)), "independently"),
        (lambda: solve_ages((by_age(PLAIN, 40),) * 4), "300000"),
        (lambda: lagrangian_bound((SourceProblem.create(bucket=BUCKET),), (1.0,), 0.5), "tokens"),
    ],
)
def test_what_the_solvers_refuse(call: Callable[[], Any], field: str) -> None:
    with pytest.raises(ConfigurationError, match=field):
        call()
