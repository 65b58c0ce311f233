"""Two hundred sensors: what grows with their square goes, what grows faster is refused by name."""

from typing import Any

import numpy as np
import pytest
from buckets import make_bucket
from scalar_ages import by_age

import fusion_gym
from fusion_gym.core.task import Task
from fusion_gym.envs.privileged import PrivilegedVecEnv
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.registry import make_policy
from fusion_gym.solvers import solve_ages, solve_task
from fusion_gym.solvers.source import TokenLevels
from fusion_gym.solvers.task import source_problems
from fusion_gym.training.counterfactual import Decisions
from fusion_gym.validation import ConfigurationError

MANY = 200
REMOTE = "fusion_gym/RemoteEstimation-v1"


def linear(sensors: int, states: int = 3, **options: Any) -> Task:
    rng = np.random.default_rng(0)
    return fusion_gym.make_task(
        "fusion_gym/LinearFusion-v2",
        transition=(0.9 * np.eye(states)).tolist(),
        process_covariance=np.eye(states).tolist(),
        measurement_matrices=rng.normal(size=(sensors, states)).tolist(),
        token_capacity=3.0 * sensors,
        token_rate=0.3 * sensors,
        **{"horizon": 3} | options,
    )


def sources(sensors: int, **options: Any) -> Task:
    return fusion_gym.make_task(REMOTE, sensors=sensors, horizon=3, **options)


def test_two_hundred_sensors_run_under_every_rule_that_is_no_worse_than_square() -> None:
    for policy in (
        "always", "information_gain:threshold=0.01", "value_of_information:price=0.001",
        "value_of_information:price=0.001,own=true", "innovation_threshold:threshold=2",
    ):  # fmt: skip
        task = linear(MANY)
        results = run_episodes(task, make_policy(policy, task), 2, 0)
        assert np.isfinite(results.mse).all()
        assert results.rate.shape == (2, MANY)
        assert results.rate.mean() > 0.0, policy
    task = linear(MANY, fusion="sci")
    assert np.isfinite(run_episodes(task, make_policy("always", task), 1, 0).mse).all()


REFUSED: dict[str, tuple[Any, str]] = {
    "joint": (lambda: linear(101, filter="joint"), r"'joint'.*101 sensors.*at most 100.*'kalman'"),
    "ci": (lambda: linear(41, fusion="ci"), r"'ci'.*41 sensors.*at most 40.*'sci'"),
    "discrete": (lambda: linear(17, action="discrete"), r"'discrete'.*17 sensors.*at most 16"),
    "periodic_optimum": (
        lambda: make_policy("periodic_optimum:packets=3,period=2", linear(MANY)),
        r"200 sensors.*at most 200000",
    ),
    "optimal": (
        lambda: make_policy("optimal", sources(MANY, tokens="limited")),
        r"sensors = 200.*must be 1 or 2",
    ),
    "tokens": (
        lambda: TokenLevels.create(make_bucket(1.0, 13.0, 1.0, 1.0, sensors=13)),
        r"sensors = 13 .*at most 12.*2\^13",
    ),
    "ages": (
        lambda: solve_ages(tuple(by_age(p, 1) for p in source_problems(sources(60)))),
        r"60 sources.*2\^60",
    ),
    "sensors": (lambda: sources(1001), r"sensors = 1001.*<= 1000"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_grows_faster_than_the_square_is_refused(name: str) -> None:
    refused, message = REFUSED[name]
    with pytest.raises(ConfigurationError, match=message):
        refused()


def test_up_to_their_bounds_they_are_not_refused() -> None:
    linear(100, filter="joint")
    linear(40, fusion="ci")
    linear(41, fusion="sci")
    linear(16, action="discrete")


@pytest.mark.parametrize("action", ["binary", "multidiscrete", "discrete"])
def test_all_alternatives_are_those_of_few_sensors(action: str) -> None:
    def decisions(sensors: int) -> Decisions:
        env = PrivilegedVecEnv(sources(sensors, action=action), 2)
        return Decisions(env, "all")

    assert decisions(10).choices == 1024
    instead = "'binary'" if action == "discrete" else "'flips'"
    with pytest.raises(ConfigurationError, match=rf"11 sensors: it steps all 2\^11 .*{instead}"):
        decisions(11)


def test_one_sensor_at_a_time_has_as_many_alternatives_as_sensors() -> None:
    env = PrivilegedVecEnv(sources(MANY, access="single"), 2)
    assert Decisions(env, None).choices == MANY + 1


def test_the_optimum_of_many_sources_that_share_nothing_is_solved_one_by_one() -> None:
    """30 alike cost 30 times one; all sets of them were once counted up."""
    first, many = (solve_task(sources(count), "average") for count in (1, 30))
    assert many.cost == pytest.approx(30.0 * first.cost)
    task = sources(30)
    results = run_episodes(task, make_policy("optimal", task), 4, 0)
    assert results.rate.shape == (4, 30)
