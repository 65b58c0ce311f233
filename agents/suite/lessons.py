"""The pieces of work of a study: references on the test episodes, trainings with their curves."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fusion_gym.arrays import Array
from fusion_gym.deprecation import replace_value
from fusion_gym.evaluation.envelope import best_mse, height
from fusion_gym.evaluation.episodes import EpisodeResults, run_episodes
from fusion_gym.policies.registry import make_policy

from ..output.files import write
from ..training.monitor import Measure
from ..training.run import holds_training, train
from .committed import at_least, bound_of, measured
from .envelopes import Test, run_test
from .fronts import excess_over, meter
from .learned import report
from .study import Lesson, Study
from .verdict import AgentFront, excess, interval
from .work import check_vertex


def run_reference(test: Test, work: Path) -> None:
    """Run what a finished front is compared with on the test episodes, if that was not done."""
    torch.set_num_threads(1)
    if not test.path(work).exists():
        run_test(test, work)


def run_lesson(lesson: Lesson, seeds: int) -> None:
    """Train one seed, measure its front on the way, and test it if it is one with credit.

    The study's report, over so many ``seeds``, then holds it.

    Raises:
        KeyboardInterrupt: the training was interrupted.
    """
    torch.set_num_threads(1)
    experiment, study = lesson.experiment, lesson.study
    folder = Path(experiment.output)
    measure: Measure = meter(experiment, study.prices, study.learning.episodes)
    enough = False

    def watch(record: dict[str, Any]) -> bool:
        nonlocal enough
        if lesson.kind == "plain":
            enough = study.below(record["front"]) or record["cpu_seconds"] >= lesson.budget
        return enough

    summary = train(
        experiment, resume=holds_training(folder), quiet=True, watch=watch, measure=measure
    )
    if not summary["finished"] and not enough:
        raise KeyboardInterrupt
    result = {
        "seed": lesson.seed,
        "inputs": lesson.inputs,
        "algorithm": experiment.algorithm.name,
        "curve": curve(study, folder),
    }
    if lesson.kind == "front":
        result["points"] = tested(study, folder / "best_model.zip")
    write(lesson.path, result)
    report(study, seeds)


def curve(study: Study, folder: Path) -> list[dict[str, Any]]:
    """The fronts of a training, with what they are above the rules without memory by.

    ``cpu_seconds`` are of environment, policy and updates, on all threads.
    """
    lines = (folder / "validation.jsonl").read_text(encoding="utf-8").splitlines()
    result = []
    for record in map(json.loads, lines):
        point = {key: record[key] for key in ("timesteps", "cpu_seconds", "return", "front")}
        if study.memoryless is not None:
            above = excess_over(point["front"], study.memoryless)
            point["excess"] = above if above < float("inf") else None
            point["below"] = study.below(point["front"])
        result.append(point)
    return result


def tested(study: Study, model: Path) -> list[dict[str, Any]]:
    """A finished front on the test episodes, price by price, beside what it is compared with.

    Raises:
        ConfigurationError: a rule does other than its committed envelope says.
    """
    references = {test.name: test.read(study.work) for test in study.tests}
    for vertex in study.vertices if study.episodes == study.suite.episodes else []:
        check_vertex(vertex, references[vertex["name"]])
    task, result = study.task(), []
    for place, price in enumerate(study.prices):
        policy = make_policy(f"model:{model},price={price!r}", task)
        agent = run_episodes(task, policy, study.episodes, study.suite.seed)
        point: dict[str, Any] = {
            "price": price,
            "rate": float(agent.rate.mean()),
            "mse": float(agent.mse.mean()),
        }
        if study.course.against == "optimum":
            point |= above_optimum(price, task.horizon, agent, [list(references.values())[place]])
        elif study.course.schedules:
            point |= above_optimum(price, task.horizon, agent, references.values())
        else:
            point |= beside_envelope(study, agent, references)
        result.append(point)
    return result


def above_optimum(
    price: float, horizon: int, agent: EpisodeResults, candidates: Iterable[EpisodeResults]
) -> dict[str, Any]:
    """The cost of an episode at a price, and that of the candidate that costs least there.

    All of them with tokens that cost nothing.
    """

    def returns(results: EpisodeResults) -> Array:
        return results.returns - price * horizon * results.tokens

    own = returns(agent)
    best = max(map(returns, candidates), key=lambda each: float(each.mean()))
    return {
        "cost": -float(own.mean()),
        "optimum": -float(best.mean()),
        "difference": excess(own, best),
    }


def beside_envelope(
    study: Study, agent: EpisodeResults, references: Mapping[str, EpisodeResults]
) -> dict[str, Any]:
    """The line through the references at the front's own rate; left of it there is nothing."""
    rate = float(agent.rate.mean())
    below = best_mse(references, rate)
    if below is None:
        return {}
    front = AgentFront(
        agent.mse[None, None], below[None, None], np.array([[rate]]), np.ones((1, 1, 1))
    )
    difference = interval(front, np.array([rate]))
    known = beyond(study, rate, references)
    return {"envelope": float(below.mean()), "difference": difference} | known


def beyond(study: Study, rate: float, envelope: Mapping[str, EpisodeResults]) -> dict[str, float]:
    """What is known of the best possible at a rate: a ``rollout`` and a lower ``bound``.

    The rollout was run on the first of the test episodes: it is taken as a share of the envelope
    on these, times the envelope on all.
    """
    result, folder = {}, study.results / study.setting.name
    rollout, episodes = measured(folder)
    same = replace_value(study.envelope(study.course.against)["knows"]) == "scheduler_memory"
    inside = same and bool(rollout) and rollout[0].rate <= rate <= rollout[-1].rate
    below, own = best_mse(envelope, rate), height(rollout, rate) if inside else None
    if own is not None and below is not None:
        result["rollout"] = own / float(below[:episodes].mean()) * float(below.mean())
    bound = bound_of(folder)
    if bound is not None:
        result["bound"] = at_least(bound, rate)
    return result
