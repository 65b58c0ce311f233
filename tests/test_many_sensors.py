"""The benchmark of many sensors: its floor, and what it plays side by side."""

import pytest

from benchmarks.many_sensors import comparison, floor
from fusion_gym.core.task import Task
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.registry import make_policy
from fusion_gym.solvers import lagrangian_bound
from fusion_gym.solvers.task import source_problems


def task_of(**options: object) -> Task:
    few = {"sensors": 3, "tokens": "limited", "token_rate": 0.5, "initial_tokens": 1.0}
    return make_task("fusion_gym/RemoteEstimation-v1", **few, horizon=5, **options)


def test_the_floor_of_sources_that_are_alike_is_that_of_all_together() -> None:
    task = task_of()
    bound = lagrangian_bound(source_problems(task), (1.0,) * 3, 0.5, horizon=5, initial_tokens=1.0)
    assert floor(task) == pytest.approx(-bound.cost, rel=1e-3)
    results = run_episodes(task, make_policy("innovation_threshold:threshold=2", task), 100, 0)
    assert results.returns.mean() < floor(task)
    with pytest.raises(ValueError, match="alike"):
        floor(task_of(noise_deviation=[1.0, 1.0, 1.5]))


def test_policies_stand_by_their_return_beside_the_agent() -> None:
    task = task_of()
    rows = comparison(task, "innovation_threshold:threshold=2", ["never", "always"], 20, 0)
    means = [row["return"]["mean"] for row in rows]
    assert means == sorted(means, reverse=True)
    by_name = {row["policy"]: row for row in rows}
    assert by_name["innovation_threshold:threshold=2"]["to_agent"]["mean"] == 0.0
    never = by_name["never"]
    assert never["to_agent"]["mean"] == pytest.approx(
        never["return"]["mean"] - by_name["innovation_threshold:threshold=2"]["return"]["mean"]
    )
    assert (never["rate"], by_name["always"]["requests"]) == (0.0, 1.0)
