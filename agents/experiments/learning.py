"""How fast agents learn: their fronts while they train, and beside the rules when finished."""

from __future__ import annotations

import functools
import json
import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm

from fusion_gym.arrays import Array
from fusion_gym.core.reward import Price
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.beside import run_beside
from fusion_gym.evaluation.envelope import EnvelopePoint, best_mse, height, lower_hull
from fusion_gym.evaluation.episodes import EpisodeResults
from fusion_gym.policies.model import ModelPolicy
from fusion_gym.validation import ConfigurationError, choice

from ..output.files import read_json
from ..training.checked import load_checked, parse
from ..training.config import EnvironmentConfig, Experiment, TrainingConfig, ValidationConfig
from ..training.monitor import Measure
from ..training.run import holds_training, train
from .classes import classes_of
from .config import SOLVED, Course, Setting, Suite, front_prices
from .envelopes import (
    EnvelopeStore,
    Test,
    at_least,
    bound_of,
    check_vertex,
    envelope_task,
    hull_of,
    read_tests,
    rollout_of,
    rule_tests,
    run_test,
)
from .tables import Row, group_by, read_rows, write_rows
from .verdict import MIDDLE, compare_classes, excess
from .workers import Folders, Pool, check_training, missing, side_by_side, training_of

Points = Sequence[Sequence[float]]  # (rate, MSE) at each price
WIDTH = 3.0  # the least factor between the rates of a front: less is hardly more than a point


def meter(experiment: Experiment, prices: Sequence[float], episodes: int) -> Measure:
    """What measures a training's ``front`` on its validation seeds, beside its ``cpu_seconds``."""
    task = make_task(experiment.environment.id, **experiment.environment.options)
    local, seed = experiment.environment.local, experiment.validation.seed

    def measure(model: BaseAlgorithm, seconds: float) -> dict[str, Any]:
        policies = [ModelPolicy(model, task, price=price, local=local) for price in prices]
        result = run_beside(task, policies, episodes, seed)
        points = [[float(brief.rate.mean()), float(brief.mse.mean())] for brief in result]
        return {"cpu_seconds": seconds, "front": points}

    return measure


def excess_over(front: Points, envelope: Sequence[EnvelopePoint]) -> float:
    """The most by which a front lies above an envelope over the front's range, as a share of it.

    Every point of the front counts at its own rate, and between its lowest and its highest rate
    the front's lower hull (mixtures of two prices) at each vertex of the envelope. Both are
    straight between these rates, so a share below zero says that the front is below the envelope
    everywhere in its range. Infinite where a rate is left of the envelope or an error not finite.
    """
    own = lower_hull(EnvelopePoint(str(place), *point) for place, point in enumerate(front))
    hull = lower_hull(envelope)
    low, high = range_of(front)
    pairs: list[tuple[float | None, float | None]]
    pairs = [(mse, height(hull, rate)) for rate, mse in front]
    pairs += [(height(own, v.rate), v.mse) for v in hull if low < v.rate < high]
    shares = [mse / above - 1.0 if mse is not None and above else np.inf for mse, above in pairs]
    result = float(np.max(shares))
    return result if np.isfinite(result) else np.inf


def is_below(front: Points, envelope: Sequence[EnvelopePoint], least: float) -> bool:
    """Whether a front is below an envelope over its whole range, and has one.

    A policy that does the same at every price would have no range to be above in, and one that
    sends next to nothing is as good as any rule there: the highest rate is at least three times
    the lowest, and three times the rate ``least``, below which the lowest is taken for it.
    """
    low, high = range_of(front)
    return excess_over(front, envelope) < 0.0 and high >= WIDTH * max(low, least)


def range_of(front: Points) -> tuple[float, float]:
    """The lowest and the highest rate."""
    rates = [rate for rate, _ in front]
    return min(rates), max(rates)


Kind = Literal["front", "plain"]
KINDS: tuple[Kind, ...] = ("front", "plain")
_SPEED = 40_000  # steps of a training in a second, about
# Options that change neither the task nor what a policy may know of it: rules see the time anyway.
_FREE = ("memory_filter", "belief_features", "clock")


@dataclass(frozen=True)
class LearningSetup:
    """A course of a setting, the committed envelopes, and where its files are."""

    suite: Suite
    setting: Setting
    course: Course
    store: EnvelopeStore
    folders: Folders

    @property
    def prices(self) -> list[float]:
        """The prices at which every front is measured."""
        return front_prices(self.setting.price_range, self.suite.learning.prices)

    @property
    def inner(self) -> list[bool]:
        """Which prices lie in the inner part of the range, in the logarithm."""
        low, high = self.setting.price_range
        price = Price(None, (low, high))
        first, last = self.suite.learning.inner
        places = price.encode(np.array(self.prices)).tolist()
        return [first <= place <= last for place in places]

    @functools.cached_property
    def envelopes(self) -> dict[str, Any]:
        """The committed envelopes of the setting, made from what the suite says now."""
        return self.store.read(self.setting)

    def envelope(self, name: str) -> dict[str, Any]:
        """Return a class of the committed envelopes."""
        return dict(self.envelopes["classes"][name])

    @property
    def classes(self) -> list[str]:
        """The classes of the committed envelopes that it is compared with."""
        own = [] if self.solved else [self.course.against]
        return own + ([self.course.memoryless] if self.course.memoryless else [])

    @functools.cached_property
    def memoryless(self) -> list[EnvelopePoint] | None:
        """The envelope to get below while learning, as it was measured on the test seeds."""
        name = self.course.memoryless
        return None if name is None else hull_of(self.envelope(name))

    def below(self, front: Points) -> bool:
        """Whether a front is below the rules without memory; it counts from the middle's begin."""
        if self.memoryless is None:
            return False
        return is_below(front, self.memoryless, MIDDLE[0] * self.envelopes["always"])

    @property
    def solved(self) -> bool:
        """Whether the finished front is compared with an optimum, by costs."""
        return self.course.against in SOLVED

    def rules(self, name: str) -> list[Test]:
        """Return the tests of a class's rules."""
        vertices = self.envelope(name)["vertices"]
        return rule_tests(self.setting, vertices, self.suite.episodes, self.suite.seed)

    @property
    def tests(self) -> list[Test]:
        """What the finished front is compared with, to be run on the test episodes."""
        if not self.solved:
            return self.rules(self.course.against)
        # What was spent is counted at each price.
        prices = self.prices if self.course.against == "optimum" else []
        policies = self.course.schedules or [f"optimal:price={price!r}" for price in prices]
        free = {"options": {"cost_weight": 0.0}}
        vertices = [free | {"policy": policy} for policy in policies]
        return rule_tests(self.setting, vertices, self.suite.episodes, self.suite.seed)

    def agents(self, model: Path) -> list[Test]:
        """Return the tests of a finished front's model at each price.

        Raises:
            OSError: the model cannot be read.
        """
        options, count = tuple(self.options.items()), self.suite.learning.prices
        requested = (self.suite.episodes, self.suite.seed)
        return Test.at_prices(self.setting, options, f"model:{model}", count, *requested)

    @property
    def front(self) -> Experiment:
        """The course's training as its config has it.

        Raises:
            ConfigurationError: a config that is not allowed.
        """
        return load_checked(Experiment, self.course.front, "front")

    @property
    def options(self) -> dict[str, Any]:
        """The options of a finished front's test: its environment's, without a price in sight.

        Where costs are compared tokens are free of charge, and counted at each price.
        """
        priced = ("cost_weight", "price_range")
        own = {k: v for k, v in self.front.environment.options.items() if k not in priced}
        return own | ({"cost_weight": 0.0} if self.solved else {})

    def check(self) -> None:
        """Whether the front knows what it is compared with: neither less nor more.

        Raises:
            ConfigurationError: another environment, setting or class; names the first difference.
        """
        where = self.front.environment
        options: dict[str, Any] = {}
        local, free = False, set(_FREE)
        if self.course.against == "schedules":
            options = {"information": "centre"}
        elif self.course.against == "optimum":
            free.add("memory")  # it knows the errors themselves
        else:
            classes = {of.name: of for of in classes_of(self.setting)}
            compared = classes[choice("class", self.course.against, classes)]
            options, local = dict(compared.options), compared.mode == "local"
        expected = {"id": self.setting.environment.id, "local": local}
        expected |= envelope_task(self.setting, options.items()).settings
        value = {"id": where.id, "local": where.local}
        value |= make_task(where.id, **self.options).settings
        expected |= {"cost_weight": "random", "price_range": list(self.setting.price_range)}
        value |= {key: where.options.get(key) for key in ("cost_weight", "price_range")}
        for key in dict.fromkeys([*expected, *value]):
            if key not in free and value.get(key) != expected.get(key):
                raise ConfigurationError(
                    f"front = {self.course.front!r}: {key} = {value.get(key)!r} is not allowed in "
                    f"{self.setting.name}: what it is compared with has {expected.get(key)!r}"
                )


@dataclass(frozen=True)
class LearningRun:
    """The training of one seed in a setup; ``budget`` in processor seconds ends a plain one."""

    setup: LearningSetup
    kind: Kind
    seed: int
    budget: float = math.inf

    @property
    def weight(self) -> float:
        """About how long it takes, in seconds on one core."""
        return self.experiment.training.timesteps / _SPEED

    @property
    def experiment(self) -> Experiment:
        """What is trained, with the measurements' spacing.

        Raises:
            ConfigurationError: a config that is not allowed.
        """
        setup, learning = self.setup, self.setup.suite.learning
        front = self.kind == "front"
        value = setup.front if front else self._plain()
        plain = value.model_dump()
        plain["validation"]["every"] = learning.every if front else learning.plain.every
        timesteps = learning.timesteps or value.training.timesteps
        plain["training"] |= {"seed": self.seed, "threads": 1, "timesteps": timesteps}
        place = setup.folders.work / "learning" / setup.setting.name
        plain["output"] = str(place / f"{self.kind}_{self.seed}")
        return parse(Experiment, plain, setup.course.front, "front")

    def _plain(self) -> Experiment:
        """Plain PPO's training: without memory, on the squared error, at the suite's prices."""
        suite, setting, course = self.setup.suite, self.setup.setting, self.setup.course
        plain, own = suite.learning.plain, setting.price_exponent
        priced = {"cost_weight": "random", "price_range": list(setting.price_range)}
        options = setting.environment.options | priced
        return Experiment(
            environment=EnvironmentConfig(id=setting.environment.id, options=options),
            algorithm=suite.learning.algorithm_of(course),
            training=TrainingConfig(
                timesteps=round(plain.timesteps * course.plain.longer),
                num_envs=plain.num_envs,
                price_exponent=suite.price_exponent if own is None else own,
            ),
            validation=ValidationConfig(episodes=512),
            output=str(self.setup.folders.work),
        )

    @property
    def inputs(self) -> dict[str, Any]:
        """All that its result depends on, the budget apart."""
        setup, course = self.setup, self.setup.course
        return {
            "training": training_of(self.experiment),
            "course": {"setting": setup.setting.name} | course.model_dump(mode="json"),
            "prices": setup.prices,
            "episodes": setup.suite.learning.episodes,
            "test": {"episodes": setup.suite.episodes, "seed": setup.suite.seed},
            "envelopes": {name: setup.envelope(name)["sha256"] for name in setup.classes},
        }


def learn(setups: Sequence[LearningSetup], pool: Pool) -> None:
    """Run the references, then fronts, then plain PPO for a multiple of the fronts' seconds.

    The tables of every setup are written after each of these.

    Raises:
        ConfigurationError: a training that is there has another config.
    """
    if not setups:
        return
    cache, seeds = setups[0].folders.cache, range(setups[0].suite.training_seeds)
    tests = [test for setup in setups for test in setup.tests]
    side_by_side(missing(run_test, tests, cache), pool, "references")
    for kind in KINDS:
        runs = [run for setup in setups for run in runs_of(setup, kind, seeds)]
        for run in runs:
            if not cache.holds(run_course, run.inputs):
                check_training(run.experiment)
        side_by_side(missing(run_course, runs, cache), pool, f"{kind} trainings")
        for setup in setups:
            write_learning(setup)


def runs_of(setup: LearningSetup, kind: Kind, seeds: Iterable[int]) -> list[LearningRun]:
    """Return the trainings of a kind, plain ones with their budget."""
    if kind == "front":
        return [LearningRun(setup, kind, seed) for seed in seeds]
    if setup.memoryless is None:
        return []
    plain, trained = setup.suite.learning.plain, finished_runs(setup, "front")
    taken = [item["curve"][-1]["cpu_seconds"] for item in trained]
    budget = plain.budget * statistics.fmean(taken) if taken else math.inf
    return [LearningRun(setup, kind, seed, budget) for seed in list(seeds)[: plain.seeds]]


def finished_runs(setup: LearningSetup, kind: Kind) -> list[Row]:
    """Return the results of the finished trainings of a kind."""
    cache = setup.folders.cache
    runs = [LearningRun(setup, kind, seed) for seed in range(setup.suite.training_seeds)]
    return [
        {"kind": kind, "inputs": run.inputs} | cache.call(run_course, run.inputs, run)
        for run in runs
        if cache.holds(run_course, run.inputs)
    ]


def throughput_path(work: Path, setting: str) -> Path:
    """Return where the JSON of this machine's steps per second in a setting is."""
    return work / "learning" / setting / "throughput.json"


def write_learning(setup: LearningSetup) -> None:
    """Write the tables of a setup, the setup itself at the end."""
    runs = [*finished_runs(setup, "front"), *finished_runs(setup, "plain")]
    speed = throughput_path(setup.folders.work, setup.setting.name)
    whole = {
        "title": setup.setting.title,
        "env": setup.setting.environment.id,
        "course": {"setting": setup.setting.name} | setup.course.model_dump(mode="json"),
        "prices": setup.prices,
        "inner": setup.inner,
        "seeds": setup.suite.training_seeds,
    }
    whole |= {"throughput": read_json(speed, "work")} if speed.exists() else {}
    curves = [
        run | point | {"rate": rate, "mse": mse}
        for run in runs
        for point in run["curve"]
        for rate, mse in point["front"]
    ]
    points = [{"seed": run["seed"]} | point for run in runs for point in run.get("points", ())]
    tables = {"_trainings": runs, "_curves": curves, "_points": points, "": [whole]}
    for table, rows in tables.items():
        folder = setup.folders.results / "learning" / setup.setting.name
        write_rows(folder, f"learning{table}", rows)


def read_learning(folder: Path) -> dict[str, Any]:
    """Return what a setup has found, from its tables.

    Raises:
        ConfigurationError: a table that cannot be read or is of another shape.
    """
    trainings, curves, points, whole = (
        read_rows(folder, f"learning{table}", "output")
        for table in ("_trainings", "_curves", "_points", "")
    )
    for run in trainings:
        own = [row for row in curves if all(row[key] == run[key] for key in ("kind", "seed"))]
        run["curve"] = [
            {"excess": None, "timesteps": steps}
            | rows[0]
            | {"front": [[row["rate"], row["mse"]] for row in rows]}
            for steps, rows in group_by(own, "timesteps").items()
        ]
        if run["kind"] == "front":
            run["points"] = [point for point in points if point["seed"] == run["seed"]]
    runs = {kind: [run for run in trainings if run["kind"] == kind] for kind in KINDS}
    result: Row = {"setting": folder.name, "throughput": None} | whole[0]
    result |= {"fronts": runs["front"], "plain": runs["plain"]}
    result["reached"] = {kind: [first_below(run) for run in own] for kind, own in runs.items()}
    return result | {"finished": judge_fronts(result)}


def first_below(run: Mapping[str, Any]) -> dict[str, Any]:
    """When a training's front first was below the memoryless envelope over its whole range.

    Without ``first`` it never was, or there is no such envelope; ``above_later`` counts the
    measurements after it that were not below.
    """
    curve = run["curve"]
    result: dict[str, Any] = {
        "seed": run["seed"],
        "timesteps": curve[-1]["timesteps"],
        "cpu_seconds": curve[-1]["cpu_seconds"],
    }
    below = [place for place, point in enumerate(curve) if point.get("below")]
    if below:
        first, later = curve[below[0]], curve[below[0] :]
        result["first"] = {
            "timesteps": first["timesteps"],
            "cpu_seconds": first["cpu_seconds"],
            "excess": first["excess"],
            "rates": range_of(first["front"]),
            "above_later": sum(not point["below"] for point in later),
        }
    return result


def judge_fronts(setup: Mapping[str, Any]) -> dict[str, Any] | None:
    """All seeds' finished fronts at the prices that count, beside what they are compared with.

    With an optimum all prices count, otherwise the inner ones. ``above`` are seeds and prices
    whose whole interval lies more than the allowed share above, ``worst`` has the largest
    difference, ``rates`` are the lowest and the highest, ``closed`` the share of the gaps to
    rollout and bound.
    """
    course = setup["course"]
    counted = [course["against"] in SOLVED or inside for inside in setup["inner"]]
    points = [
        point | {"seed": front["seed"]}
        for front in setup["fronts"]
        for point, counts in zip(front["points"], counted, strict=True)
        if counts and "difference" in point
    ]
    if not points:
        return None
    above = [p for p in points if p["difference"]["low"] > course["allowed"]]
    worst = max(points, key=lambda point: float(point["difference"]["mean"]))
    return {
        "compared": len(points),
        "above": above,
        "worst": worst,
        "rates": [choose(point["rate"] for point in points) for choose in (min, max)],
        "closed": {name: gap_share(points, name) for name in ("rollout", "bound")},
    }


def gap_share(points: Sequence[Mapping[str, Any]], name: str) -> float | None:
    """The share of the gap between the envelope and what is known beyond it that is closed.

    Over all points whose rate has both; ``None`` where nothing lies between.
    """
    known = [point for point in points if name in point]
    gap = sum(point["envelope"] - point[name] for point in known)
    return sum(point["envelope"] - point["mse"] for point in known) / gap if gap > 0.0 else None


def run_course(run: LearningRun) -> dict[str, Any]:
    """Train one seed, measure its front on the way, and test it if it is one with credit.

    Raises:
        KeyboardInterrupt: the training was interrupted.
    """
    torch.set_num_threads(1)
    experiment, setup = run.experiment, run.setup
    folder = Path(experiment.output)
    measure: Measure = meter(experiment, setup.prices, setup.suite.learning.episodes)
    enough = False

    def watch(record: dict[str, Any]) -> bool:
        nonlocal enough
        if run.kind == "plain":
            enough = setup.below(record["front"]) or record["cpu_seconds"] >= run.budget
        return enough

    summary = train(
        experiment, resume=holds_training(folder), quiet=True, watch=watch, measure=measure
    )
    if not summary["finished"] and not enough:
        raise KeyboardInterrupt
    result = {
        "seed": run.seed,
        "algorithm": experiment.algorithm.name,
        "curve": curve(setup, folder),
    }
    if run.kind == "front":
        result["points"] = evaluate_front(setup, folder / "best_model.zip")
    return result


def curve(setup: LearningSetup, folder: Path) -> list[dict[str, Any]]:
    """The fronts of a training, with what they are above the rules without memory by.

    ``cpu_seconds`` are of environment, policy and updates, on all threads.
    """
    lines = (folder / "validation.jsonl").read_text(encoding="utf-8").splitlines()
    result = []
    for record in map(json.loads, lines):
        point = {key: record[key] for key in ("timesteps", "cpu_seconds", "return", "front")}
        if setup.memoryless is not None:
            above = excess_over(point["front"], setup.memoryless)
            point["excess"] = above if above < float("inf") else None
            point["below"] = setup.below(point["front"])
        result.append(point)
    return result


def evaluate_front(setup: LearningSetup, model: Path) -> list[dict[str, Any]]:
    """Return a finished front on the test episodes, price by price, and what it is compared with.

    Raises:
        ConfigurationError: a rule does other than its committed envelope says.
    """
    cache = setup.folders.cache
    references = read_tests(setup.tests, cache)
    if not setup.solved and setup.suite.episodes == setup.store.suite.episodes:
        for vertex in setup.envelope(setup.course.against)["vertices"]:
            check_vertex(vertex, references[vertex["name"]])
    horizon, result = envelope_task(setup.setting).horizon, []
    agents = read_tests(setup.agents(model), cache).values()
    for place, (price, agent) in enumerate(zip(setup.prices, agents, strict=True)):
        point: dict[str, Any] = {
            "price": price,
            "rate": float(agent.rate.mean()),
            "mse": float(agent.mse.mean()),
        }
        if setup.solved:
            every = list(references.values())
            own = every if setup.course.schedules else every[place : place + 1]
            point |= above_optimum(price, horizon, agent, own)
        else:
            point |= beside_envelope(setup, agent, references)
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
    setup: LearningSetup, agent: EpisodeResults, references: Mapping[str, EpisodeResults]
) -> dict[str, Any]:
    """The line through the references at the front's own rate; left of it there is nothing."""
    rate = float(agent.rate.mean())
    below = best_mse(references, rate)
    if below is None:
        return {}
    difference = compare_classes(agent.mse[None, None], below[None, None], [rate])
    known = best_known(setup, rate, references)
    return {"envelope": float(below.mean()), "difference": difference} | known


def best_known(
    setup: LearningSetup, rate: float, envelope: Mapping[str, EpisodeResults]
) -> dict[str, float]:
    """What is known of the best possible at a rate: a ``rollout`` and a lower ``bound``.

    The rollout was run on the first of the test episodes: it is taken as a share of the envelope
    on these, times the envelope on all.
    """
    result, folder = {}, setup.store.results / setup.setting.name
    rollout, episodes = rollout_of(folder)
    same = setup.envelope(setup.course.against)["knows"] == "scheduler_memory"
    inside = same and bool(rollout) and rollout[0].rate <= rate <= rollout[-1].rate
    below, own = best_mse(envelope, rate), height(rollout, rate) if inside else None
    if own is not None and below is not None:
        result["rollout"] = own / float(below[:episodes].mean()) * float(below.mean())
    bound = bound_of(folder)
    if bound is not None:
        result["bound"] = at_least(bound, rate)
    return result
