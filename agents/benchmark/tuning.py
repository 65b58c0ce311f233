"""Rules at full strength: Optuna searches their parameters, price by price, seed by seed."""

import itertools
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import optuna
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)

from agents.benchmark.config import Choices, Family, Range, Tuning
from fusion_gym.core.task import Task
from fusion_gym.evaluation.beside import Brief, run_beside
from fusion_gym.evaluation.envelope import EnvelopePoint, height, lower_hull
from fusion_gym.policies.registry import make_policy

optuna.logging.set_verbosity(optuna.logging.WARNING)
_RUNS = 1024  # beside each other; fixed, so that results do not depend on the machine
_MOST = 3  # parameters of a rule that multiply its trials
WORST = 1e300  # the error of a policy whose error is no number


class TuningTrial(NamedTuple):
    """A tried policy: its text, its parameters for the sampler, mean rate and error."""

    policy: str
    values: dict[str, Any]
    rate: float
    mse: float


class Finalist(NamedTuple):
    """A policy on the episodes of all searches, and the numbers of those that found it."""

    policy: str
    brief: Brief
    found_by: tuple[int, ...]


def space_of(family: Family, sensors: int) -> dict[str, BaseDistribution]:
    """The numbers that a family's search sets, by name."""
    result: dict[str, BaseDistribution] = {}
    for name, space in family.parameters.items():
        if isinstance(space, Choices):
            result[name] = CategoricalDistribution(space.values)
            continue
        for key in _keys(name, space, sensors):
            if space.whole:
                result[key] = IntDistribution(int(space.low), int(space.high), log=True)
            else:
                result[key] = FloatDistribution(space.low, space.high, log=True)
    return result


def _keys(name: str, space: Range | Choices, sensors: int) -> list[str]:
    """Names of a parameter's numbers in the study."""
    if isinstance(space, Choices) or not space.per_sensor or sensors == 1:
        return [name]
    return [f"{name}_{place}" for place in range(sensors)]


def policy_text(family: Family, values: dict[str, Any], sensors: int) -> str:
    """The policy with these numbers, behind what the family fixes."""
    parts = [
        f"{name}={'/'.join(_text(values[key]) for key in _keys(name, space, sensors))}"
        for name, space in family.parameters.items()
    ]
    if not parts:
        return family.policy
    return f"{family.policy}{',' if ':' in family.policy else ':'}{','.join(parts)}"


def _text(value: Any) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value).lower()


def first_values(family: Family, trials: int, sensors: int, seed: int) -> list[dict[str, Any]]:
    """Trials to begin with: half with all sensors alike, over the whole range, half at random.

    Without the first a search with a number for every sensor can miss what a sweep of one shared
    value finds. Choices take turns. With one number to set there is nothing else to draw: all
    trials are the sweep. Searches of other seeds sweep between the values of this one.
    """
    generator = np.random.default_rng(seed)
    ranges = {n: s for n, s in family.parameters.items() if isinstance(s, Range)}
    choices = {n: s.values for n, s in family.parameters.items() if isinstance(s, Choices)}
    turns = list(itertools.product(*choices.values()))
    numbers = sum(len(_keys(name, space, sensors)) for name, space in ranges.items())
    swept = trials if numbers == 1 else -(-trials // 2)
    swept = swept if len(ranges) == 1 else 0
    count = max(-(-swept // len(turns)), 1)
    offset = generator.random()
    result = []
    for place in range(trials):
        values: dict[str, Any] = dict(zip(choices, turns[place % len(turns)], strict=True))
        for name, space in ranges.items():
            keys = _keys(name, space, sensors)
            shares = generator.random(len(keys))
            if place < swept:
                shares[:] = (place // len(turns) + offset) / count
            values |= zip(keys, (_between(space, share) for share in shares), strict=True)
        result.append(values)
    return result


def _between(space: Range, share: float) -> float | int:
    """The value at a share of the range, in the logarithm."""
    value = space.low * (space.high / space.low) ** share
    return round(value) if space.whole else float(value)


def search_family(
    task: Task, family: Family, tuning: Tuning, price_range: tuple[float, float], seed: int
) -> list[TuningTrial]:
    """All policies that the search of one tuning seed tried, each once.

    First those of :func:`first_values`. Then, price by price in turns, one that Optuna's sampler
    takes for good at that price once it has been told of all that was tried before, whatever it
    was tried for: it sets out from the policies that are nearest to the envelope there.

    Raises:
        ConfigurationError: a policy that does not fit the task.
    """
    space = space_of(family, task.sensors)
    tried: dict[str, TuningTrial] = {}

    def run(requested: Iterable[dict[str, Any]]) -> None:
        texts = {policy_text(family, values, task.sensors): values for values in requested}
        new = [text for text in texts if text not in tried]
        briefs = briefs_of(task, new, tuning.episodes, tuning.seed + seed * tuning.episodes)
        for text, brief in zip(new, briefs, strict=True):
            tried[text] = TuningTrial(text, texts[text], *_means(brief))

    effort = min(len(space), _MOST)
    run(first_values(family, max(effort * tuning.trials, 1), task.sensors, seed))
    if not space:
        return list(tried.values())
    slopes = [error_per_rate(task, price) for price in np.geomspace(*price_range, tuning.prices)]
    for turn in range(effort * tuning.refined):
        run(
            ask(space, list(tried.values()), slope, [seed, turn, place])
            for place, slope in enumerate(slopes)
        )
    return list(tried.values())


def error_per_rate(task: Task, price: float) -> float:
    """By how much a transmission of each sensor in each step must lower the mean squared error.

    The price in the reward's units, of a step in which every sensor transmits, in those of the
    error; with equal weights of the states and equal tokens of the sensors this is the reward.
    """
    weight = task.reward.error_weight * float(task.reward.state_weights.mean())
    return price * float(task.bucket.cost.sum()) / weight


def ask(
    space: dict[str, BaseDistribution],
    tried: Sequence[TuningTrial],
    slope: float,
    seed: Sequence[int],
) -> dict[str, Any]:
    """The next values for the least error plus ``slope`` times rate, after all that was tried."""
    state = int(np.random.SeedSequence(seed).generate_state(1)[0])
    sampler = optuna.samplers.TPESampler(seed=state, n_startup_trials=1, multivariate=True)
    study = optuna.create_study(sampler=sampler)
    study.add_trials(
        optuna.trial.create_trial(
            params=trial.values, distributions=space, value=trial.mse + slope * trial.rate
        )
        for trial in tried
    )
    return study.ask(fixed_distributions=space).params


def briefs_of(task: Task, policies: Sequence[str], episodes: int, seed: int) -> list[Brief]:
    """The policies on the same episodes, many at a time."""
    size = max(_RUNS // episodes, 1)
    result: list[Brief] = []
    for first in range(0, len(policies), size):
        built = [make_policy(text, task) for text in policies[first : first + size]]
        result += run_beside(task, built, episodes, seed)
    return result


def _means(brief: Brief) -> tuple[float, float]:
    mse = float(brief.mse.mean())
    return float(brief.rate.mean()), mse if np.isfinite(mse) else WORST


def near_hull(trials: Sequence[TuningTrial], near: float, finalists: int) -> list[str]:
    """The policies on the lower envelope of a search and those hardly above it, best first.

    All of the envelope, and more only up to ``finalists``, within a share ``near`` of its error.
    """
    points = [EnvelopePoint(trial.policy, trial.rate, trial.mse) for trial in trials]
    hull = lower_hull(points)
    on_it = [point.name for point in hull]

    def excess(point: EnvelopePoint) -> float:
        below = height(hull, point.rate)
        return point.mse / below - 1.0 if below else np.inf

    others = sorted((p for p in points if p.name not in set(on_it)), key=excess)
    close = [point.name for point in others if excess(point) <= near]
    return on_it + close[: max(finalists - len(on_it), 0)]


def tune_families(
    task: Task,
    family: Family,
    tuning: Tuning,
    price_range: tuple[float, float],
    known: Sequence[str] = (),
) -> tuple[int, list[Finalist]]:
    """The number of trials of all searches, and their finalists, each on all searches' episodes.

    ``known`` policies are the finalists in the place of searches, as if every one had found them.

    Raises:
        ConfigurationError: a policy that does not fit the task.
    """
    seeds = range(tuning.seeds)
    found_by: dict[str, list[int]] = {text: list(seeds) for text in known}
    tried = 0
    for seed in () if known else seeds:
        trials = search_family(task, family, tuning, price_range, seed)
        tried += len(trials)
        for text in near_hull(trials, tuning.near, tuning.finalists):
            found_by.setdefault(text, []).append(seed)
    briefs = briefs_of(task, list(found_by), tuning.seeds * tuning.episodes, tuning.seed)
    return tried, [
        Finalist(text, brief, tuple(own))
        for (text, own), brief in zip(found_by.items(), briefs, strict=True)
    ]
