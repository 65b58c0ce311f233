"""Whittle's index: against the optimum of one source and of two, its inverse, and its limits."""

from typing import Any

import numpy as np
import pytest

import fusion_gym
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.optimal import WhittleIndex
from fusion_gym.policies.registry import make_policy
from fusion_gym.solvers.single import solve_average
from fusion_gym.solvers.source import SourceProblem
from fusion_gym.validation import ConfigurationError

ENV = "fusion_gym/RemoteEstimation-v1"


def cost(policy: str, episodes: int = 400, **options: Any) -> tuple[float, float]:
    task = fusion_gym.make_task(ENV, **options)
    results = run_episodes(task, make_policy(policy, task), episodes, seed=0)
    return -float(results.returns.mean()), float(results.rate.mean())


@pytest.mark.parametrize("price", [0.7, 5.0, 60.0])
@pytest.mark.parametrize("coefficient", [1.0, 0.8])
def test_the_index_is_the_price_of_indifference(price: float, coefficient: float) -> None:
    """At a price's own threshold the index is that price; the table is interpolated over prices."""
    task = fusion_gym.make_task(ENV, coefficient=coefficient, noise_deviation=1.3)
    solved = solve_average(
        SourceProblem.create(coefficient=coefficient, deviation=1.3, price=price)
    )
    threshold = solved.threshold[0, 0]
    index = WhittleIndex(task).index(np.array([[threshold, -threshold]]), np.zeros((1, 2), int))
    np.testing.assert_allclose(index, price, rtol=0.06)


def test_it_grows_with_the_error_without_end() -> None:
    task = fusion_gym.make_task(ENV)
    error = np.geomspace(1e-3, 1e3, 200)[None]
    index = WhittleIndex(task).index(error, np.zeros(error.shape, int))[0]
    assert (np.diff(index) > 0).all()
    # Below and beyond the prices that were solved it is a parabola.
    assert index[0] == pytest.approx(index[1] * (error[0, 0] / error[0, 1]) ** 2)
    assert index[-1] == pytest.approx(index[-2] * (error[0, -1] / error[0, -2]) ** 2)


@pytest.mark.parametrize(
    "options", [{}, {"channel": "gilbert_elliott", "cost_weight": 20.0}, {"channel": "independent"}]
)
def test_one_source_at_a_price_is_solved_by_it(options: dict[str, Any]) -> None:
    """Paired over 400 episodes; the optimum is flat, the interpolation costs little."""
    best, rate = cost("optimal:criterion=average", **options)
    result, own = cost("whittle", **options)
    assert result == pytest.approx(best, rel=0.006)
    assert own == pytest.approx(rate, rel=0.04)


def test_two_sources_that_share_a_link_are_near_their_joint_optimum() -> None:
    options = {
        "sensors": 2, "noise_deviation": (1.0, 1.5), "access": "single", "cost_weight": 0.0,
    }  # fmt: skip
    best, _ = cost("optimal", **options)
    index, _ = cost("whittle", **options)
    ages, _ = cost("round_robin", **options)
    assert best * 0.995 < index < best * 1.02
    assert ages > 2 * best


@pytest.mark.slow
def test_many_sources_need_it_more_than_the_largest_error() -> None:
    """Four different sources on one link: paired differences, far beyond their deviation."""
    options: dict[str, Any] = {
        "sensors": 4, "noise_deviation": (1.0, 1.5, 0.7, 2.0), "coefficient": (1.0, 0.9, 1.0, 0.8),
        "access": "single", "cost_weight": 0.0,
    }  # fmt: skip
    task = fusion_gym.make_task(ENV, **options)
    index = run_episodes(task, make_policy("whittle", task), 400, seed=0).returns
    text = "innovation_threshold:threshold=0,at_most=1"
    largest = run_episodes(task, make_policy(text, task), 400, seed=0).returns
    difference = index - largest
    assert difference.mean() > 4 * difference.std() / 20


def test_what_it_asks_for() -> None:
    task = fusion_gym.make_task(ENV, sensors=3, cost_weight=5.0)
    dear = run_episodes(task, make_policy("whittle:price=1e6", task), 10, seed=0)
    assert dear.requests.max() == 0.0
    results = run_episodes(task, make_policy("whittle:price=0,at_most=1", task), 10, seed=0)
    assert results.requests.sum(1).max() <= 1.0
    for text, message in (("whittle:price=-1", "price = -1"), ("whittle:at_most=0", "at_most = 0")):
        with pytest.raises(ConfigurationError, match=message):
            make_policy(text, task)
    with pytest.raises(ConfigurationError, match=r"coefficient = 1\.2 of source 0"):
        make_policy("whittle", fusion_gym.make_task(ENV, coefficient=1.2, horizon=100))
    with pytest.raises(ConfigurationError, match="it must be remote estimation"):
        make_policy("whittle", fusion_gym.make_task("fusion_gym/TobitOscillator-v1"))
