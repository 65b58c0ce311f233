"""The solved optimum of a remote-estimation task."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.core.channel import Channel, ChannelOptions
from fusion_gym.core.task import Task
from fusion_gym.solvers.joint import JointProblem, solve_joint_average, solve_joint_finite
from fusion_gym.solvers.single import AverageSolution, FiniteSolution, solve_average, solve_finite
from fusion_gym.solvers.source import ErrorGrid, SourceProblem, TokenLevels
from fusion_gym.systems.solvable import IndependentSources

CRITERIA = ("finite", "average")


@dataclass(frozen=True)
class Optimum:
    """The least expected cost, and requests by thresholds or by a table.

    Args:
        cost: cost of an episode, the negative expected return, with ``criterion="finite"``; average
            cost per step with ``"average"``.
        error: w e² per step, summed over the sources; nan for a table.
        rate: transmissions per step, summed over the sources; nan for a table.
        tokens: levels of the bucket.
        threshold: thresholds (T, n, S, K) by step, source, channel state and token level; T = 1 for
            ``"average"``.
        choice: best set of two sources (T, M1, M2, K), as bits, on ``grids``, instead of
            thresholds.
        grids: grids of the errors of two sources.
    """

    cost: float
    error: float
    rate: float
    tokens: TokenLevels
    threshold: Array | None = None
    choice: NDArray[np.int8] | None = None
    grids: tuple[ErrorGrid, ErrorGrid] | None = None


def source_problems(task: Task) -> tuple[SourceProblem, ...]:
    """Return the task's sources, each limited only by its price.

    Args:
        task: the task.

    Raises:
        ConfigurationError: another system, a drawn price, or a reward without the squared error.

    Example:
        >>> from fusion_gym import make_task
        >>> from fusion_gym.solvers import source_problems
        >>> len(source_problems(make_task("fusion_gym/RemoteEstimation-v1", sensors=2)))
        2
    """
    system, channel, reward = _sources(task), task.network.channel, task.reward
    task.refuse_delay("the optimum supposes arrivals in the step of a request")
    if task.network.rule.by_channel:
        where = "for the optimum"
        raise validation.refusal("access", task.options.access, "without an assignment", where)
    if task.network.acknowledgement < 1.0:
        value, allowed = task.settings.get("acknowledgements"), "'perfect'"
        raise validation.refusal("acknowledgements", value, allowed, "for the optimum")
    task.refuse_control("for the optimum")
    if reward.error != "squared":
        raise validation.refusal("error", reward.error_kind, "'squared'", "for the optimum")
    if reward.price.fixed is None:
        raise validation.refusal("cost_weight", "random", "a number", "for the optimum")
    channel = channel or Channel(ChannelOptions(), task.sensors)
    weights = reward.error_weight * reward.separate_weights("for the optimum")
    return tuple(
        SourceProblem.create(
            coefficient=float(system.coefficient[i]),
            deviation=float(system.deviation[i]),
            price=reward.price.fixed * float(task.network.bucket.cost[i, 0]),
            error_weight=float(weights[i]),
            drop=channel.drop[:, i],
            transition=channel.transition[i],
            initial=channel.initial[:, i],
        )
        for i in range(system.sensor_count)
    )


def _sources(task: Task) -> IndependentSources[Any]:
    if not isinstance(task.plant, IndependentSources):
        raise validation.ConfigurationError(
            f"plant = {type(task.plant).__name__} is not allowed: it must be remote estimation"
        )
    return task.plant


def solve_task(task: Task, criterion: str = "finite") -> Optimum:
    """Return the optimum of one source, of independent sources, or of two that share the network.

    Args:
        task: the task.
        criterion: ``"finite"`` for the exact optimum of the task's episodes, ``"average"`` for an
            infinite horizon.

    Raises:
        ConfigurationError: a task without a solver, for example three sources that share tokens
            (:func:`fusion_gym.solvers.single.lagrangian_bound` bounds its cost from below).
    """
    validation.choice("criterion", criterion, CRITERIA)
    problems, bucket = source_problems(task), task.network.bucket
    single = len(problems) == 1
    if not single and not (task.options.access == "any" and bucket.unlimited):
        return _solve_pair(task, problems, criterion)
    # Several independent sources have unlimited tokens, of one level.
    tokens = TokenLevels.create(bucket) if single else problems[0].tokens
    solutions: list[AverageSolution | FiniteSolution] = []
    for i, priced in enumerate(problems):
        problem = replace(priced, tokens=tokens) if single else priced
        if criterion == "average":
            solutions.append(solve_average(problem))
        else:
            spread = float(_sources(task).initial_deviation[i])
            solutions.append(solve_finite(problem, task.horizon, spread))
        if not solutions[-1].ordered:
            raise validation.ConfigurationError(
                "this task is not solved: its optimum has no thresholds on the error"
            )
    thresholds = [one.threshold.reshape(-1, *one.threshold.shape[-2:]) for one in solutions]
    pairs = zip(problems, solutions, strict=True)
    return Optimum(
        cost=sum(one.cost for one in solutions),
        error=sum(problem.error_weight * one.error for problem, one in pairs),
        rate=sum(one.rate for one in solutions),
        tokens=tokens,
        threshold=np.stack(thresholds, axis=1),
    )


def _solve_pair(task: Task, problems: tuple[SourceProblem, ...], criterion: str) -> Optimum:
    if len(problems) != 2:
        where = "for the optimum under limited tokens or access"
        raise validation.refusal("sensors", len(problems), "1 or 2", where)
    if task.options.access not in ("any", "single"):
        where = "for the optimum of two sources"
        raise validation.refusal("access", task.options.access, "'any' or 'single'", where)
    at_most = 1 if task.options.access == "single" else 2
    problem = JointProblem.create(problems, task.network.bucket, at_most)
    if criterion == "average":
        stationary = solve_joint_average(problem)
        cost, choice, grids = stationary.cost, stationary.choice[None], stationary.grids
    else:
        first, two = _sources(task).initial_deviation.tolist()
        episode = solve_joint_finite(problem, task.horizon, (first, two))
        cost, choice, grids = episode.cost, episode.choice, episode.grids
    return Optimum(cost, math.nan, math.nan, problem.tokens, choice=choice, grids=grids)
