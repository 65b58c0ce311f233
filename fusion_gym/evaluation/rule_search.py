"""Search the numbers of the rule ``priced_threshold`` for several prices at once, by CMA-ES.

    search = search_of_class("scheduler", task, prices=(0.003, 0.01, 0.03, 0.1))
    result = search_rule(search)
    policy = make_policy(result.policy, task)

The search starts with the best single threshold at each price, and the power of the price that fits
these thresholds. Every generation uses fresh episodes, and their number grows. The result is the
mean of the means of the second half of the generations.

Source: N. Hansen and A. Ostermeier, "Completely derandomized self-adaptation in evolution
strategies", Evolutionary Computation 9, 2001, as in the package cmaes.
"""

import functools
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any, Literal

import numpy as np

from fusion_gym import seeds, validation
from fusion_gym.arrays import Array
from fusion_gym.core.noise import PhiloxNoise
from fusion_gym.core.task import Task
from fusion_gym.evaluation.episodes import EpisodeResults, run_priced, run_several
from fusion_gym.evaluation.rule_loop import RuleLoop, make_loop
from fusion_gym.importing import require
from fusion_gym.policies.registry import make_policy
from fusion_gym.policies.rules.priced_threshold import PricedThreshold, Score, ThresholdNumbers
from fusion_gym.validation import ConfigurationError

ClassName = Literal["centre", "local", "scheduler"]
# The scores of each class's search.
_SCORES: dict[ClassName, tuple[Score, ...]] = {
    "centre": ("variance",),
    "local": ("value", "innovation"),
    "scheduler": ("value",),
}
_RUNS = 2048  # in one batch; fixed, so that results do not depend on the machine
_WIDE = 20.0  # a margin that hardly ever lets two sensors transmit in the same step
_WORST = 1e30  # the cost of a candidate whose error is no number
# Each coordinate's first standard deviation and limits; threshold and margin as logarithms.
_RANGES = {
    "threshold": (0.15, -np.inf, np.inf),
    "price_exponent": (0.075, -1.0, 4.0),
    "mixture": (0.1, 0.0, 1.0),
    "token_exponent": (0.15, -3.0, 3.0),
    "age_exponent": (0.1, -3.0, 3.0),
    "margin": (0.15, 0.0, 4.0),
    "margin_exponent": (0.075, -3.0, 3.0),
}


@dataclass(frozen=True)
class ThresholdTrial:
    """A rule with a threshold: its tokens and its error per step, means over episodes."""

    policy: str
    threshold: float
    tokens: float
    error: float

    def cost(self, price: float) -> float:
        """Return error + price · tokens."""
        return self.error + price * self.tokens


@dataclass(frozen=True)
class Generation:
    """One generation of the search.

    Its JSON is ``dataclasses.asdict``, and ``Generation(**value)`` restores it.

    Args:
        number: its number, from 0.
        objectives: objective of each candidate.
        mean: mean of the distribution after it, in the coordinates of the search.
    """

    number: int
    objectives: Sequence[float]
    mean: Sequence[float]


@dataclass(frozen=True)
class SearchResult:
    """The result of a search.

    Args:
        policy: the rule as text.
        prices: prices of a token.
        costs: cost of the rule at each price, on fresh episodes.
        threshold_costs: cost of the best single threshold at each price, on the same episodes.
    """

    policy: str
    prices: tuple[float, ...]
    costs: tuple[float, ...]
    threshold_costs: tuple[float, ...]

    @property
    def relative(self) -> float:
        """Mean over the prices of cost / cost of the best single threshold, minus 1."""
        return float(np.mean(np.divide(self.costs, self.threshold_costs)) - 1.0)


@dataclass(frozen=True)
class RuleSearch:
    """A search of one rule for all prices.

    Args:
        task: the task.
        prices: prices of a token, > 0 and different.
        own: whether every sensor decides locally.
        score: score of the rule, as in :class:`PricedThreshold`.
        bounds: least and largest threshold of the first sweep; derived from the prices by default.
        generations: number of generations.
        population: candidates of a generation, >= 3.
        episodes: episodes of the first and of the last generation.
        seed: seed of the first episode and of the candidates.

    Raises:
        ConfigurationError: a value that is not allowed.
    """

    task: Task = field(repr=False)
    prices: tuple[float, ...]
    own: bool = False
    score: Score = "value"
    bounds: tuple[float, float] | None = None
    generations: int = 30
    population: int = 12
    episodes: tuple[int, int] = (16, 96)
    seed: int = seeds.TRAINING.start

    def __post_init__(self) -> None:
        validation.positive("prices", self.prices, (len(self.prices),))
        if len(set(self.prices)) < max(len(self.prices), 1):
            raise validation.refusal("prices", self.prices, "one or more different numbers")
        for name, least in (("generations", 1), ("population", 3), ("seed", 0)):
            validation.integer(name, getattr(self, name), at_least=least)
        for count in self.episodes:
            validation.integer("episodes", count, at_least=1)
        PricedThreshold(self.task, own=self.own, score=self.score)

    @property
    def text(self) -> str:
        """The text of the policy without its numbers."""
        return f"priced_threshold:own={str(self.own).lower()},score={self.score}"

    @property
    def reference_price(self) -> float:
        """The geometric mean of the prices, with five digits."""
        return float(f"{np.exp(np.mean(np.log(self.prices))):.5g}")

    @functools.cached_property
    def coordinates(self) -> tuple[str, ...]:
        """The name of the number of each coordinate; the sensors follow one another."""
        task = self.task
        per_sensor = ["threshold", "price_exponent"] if len(self.prices) > 1 else ["threshold"]
        names = [name for name in per_sensor for _ in range(task.sensors)]
        names += ["mixture"] if task.network.bucket.unlimited else ["mixture", "token_exponent"]
        names.append("age_exponent")
        if task.sensors > 1 and not self.own:
            names += ["margin", "margin_exponent"] if len(self.prices) > 1 else ["margin"]
        return tuple(names)

    @functools.cached_property
    def start(self) -> tuple[ThresholdTrial, ...]:
        """The best single threshold at each price, with or without a wide margin."""
        worth = np.array(self.prices) * self.task.network.bucket.cost / self.task.error_scale
        low, high = self.bounds or (worth.min() / 30.0, worth.max() * 3.0)
        values = np.geomspace(low, high, 24).tolist()
        margins = (1.0, _WIDE) if "margin" in self.coordinates else (1.0,)
        trials = []
        for margin in margins:
            text = f"{self.text},price_exponent=0,margin={margin},threshold={{value}}"
            count = 2 * self.episodes[1]
            trials += try_thresholds(self.task, text, values, count, self.seed, self.loop)
        return tuple(min(trials, key=lambda t: t.cost(price)) for price in self.prices)

    @functools.cached_property
    def loop(self) -> RuleLoop | None:
        """The loop of the rule in machine code, where it saves time."""
        rule = PricedThreshold(self.task, own=self.own, score=self.score)
        runs = self.generations * self.population * len(self.prices) * self.episodes[0]
        sizes = Counter((*self.coordinates, "reference_price"))
        return make_loop(self.task, rule, sizes, runs * self.task.horizon)

    def start_costs(self, trials: Sequence[ThresholdTrial]) -> Array:
        """Return the costs of the trials, each at its price."""
        return np.array([t.cost(p) for t, p in zip(trials, self.prices, strict=True)])

    def first_point(self) -> Array:
        """Return the start in coordinates: the powers of the price that fit its numbers best."""
        ratio = np.log(np.array(self.prices) / self.reference_price)
        values = dict[str, float]()
        for name, exponent in (("threshold", "price_exponent"), ("margin", "margin_exponent")):
            rules: list[Any] = [make_policy(trial.policy, self.task) for trial in self.start]
            logs = np.log([getattr(rule, name) for rule in rules])
            slope = float(ratio @ logs) / float(ratio @ ratio) if len(ratio) > 1 else 1.0
            values |= {exponent: slope, name: (logs - slope * ratio).mean()}
        limits = (_RANGES[name][1:] for name in self.coordinates)
        start = zip(self.coordinates, limits, strict=True)
        return np.array([np.clip(values.get(name, 0.0), *ends) for name, ends in start])

    def rule(self, point: Array) -> str:
        """Return the rule of a point (coordinates,) as text."""
        settings = {"reference_price": self.reference_price, **self.numbers(point[None])._asdict()}
        texts = (
            f"{name}={'/'.join(f'{value:.5g}' for value in np.ravel(column))}"
            for name, column in settings.items()
        )
        return ",".join((self.text, *texts))

    def numbers(self, points: Array) -> ThresholdNumbers:
        """Return the numbers (…, K) of K points (K, coordinates)."""
        names = np.array(self.coordinates)
        none = np.zeros((1, len(points)))
        columns = dict.fromkeys(ThresholdNumbers._fields, none) | {"price_exponent": none + 1.0}
        columns |= {name: points[:, names == name].T for name in self.coordinates}
        for name in ("threshold", "margin"):
            columns[name] = np.exp(columns[name])
        return ThresholdNumbers(**columns)


def class_of(task: Task, local: bool) -> ClassName:
    """Return the class of the agents of a task; ``local`` ones decide at each sensor."""
    if local:
        return "local"
    return "centre" if task.information == "centre" else "scheduler"


def search_of_class(
    name: ClassName, task: Task, prices: Sequence[float], **options: Any
) -> RuleSearch:
    """Return the search of a class of rules, with the score of the cheapest single thresholds.

    Args:
        name: the class.
        task: the task.
        prices: prices of a token.
        **options: other fields of :class:`RuleSearch`.

    Raises:
        ConfigurationError: a value that is not allowed, or a task without such rules.
    """
    searches = [
        RuleSearch(task, tuple(prices), name == "local", score, **options)
        for score in _SCORES[name]
    ]
    if len(searches) == 1:
        return searches[0]
    return min(searches, key=lambda item: float(np.log(item.start_costs(item.start)).sum()))


def try_thresholds(
    task: Task,
    template: str,
    values: Sequence[float],
    episodes: int,
    seed: int,
    loop: RuleLoop | None = None,
) -> list[ThresholdTrial]:
    """Run a rule with each of several thresholds, ``{value}`` in the template, in one batch."""
    if "{value}" not in template:
        raise validation.refusal("template", template, "a policy with {value} as its threshold")
    texts = [template.replace("{value}", f"{value:.5g}") for value in values]
    rules = [make_policy(text, task) for text in texts]
    error, tokens = _means(task, rules, episodes, seed, loop)
    error = np.nan_to_num(error, nan=_WORST, posinf=_WORST)
    columns = texts, values, tokens.tolist(), error.tolist()
    return [
        ThresholdTrial(text, float(f"{value:.5g}"), *means)
        for text, value, *means in zip(*columns, strict=True)
    ]


def _means(
    task: Task, rules: Sequence[Any], episodes: int, seed: int, loop: RuleLoop | None = None
) -> Array:
    """Return the error and the tokens (2, rules) of each rule, means over its episodes."""
    rule = rules[0]
    if loop is None and is_dataclass(rule):
        sizes = {
            field.name: np.size(getattr(rule, field.name))
            for field in fields(rule)
            if field.name != "task" and len({repr(getattr(own, field.name)) for own in rules}) > 1
        }
        loop = make_loop(task, rule, sizes, len(rules) * episodes * task.horizon)
    if loop is not None:
        values = {
            name: np.array([np.broadcast_to(getattr(own, name), size) for own in rules]).T
            for name, size in loop.sizes.items()
        }
        values = {name: column.repeat(episodes, axis=1) for name, column in values.items()}
        seeds = seed + np.arange(episodes)
        uniform = [PhiloxNoise().uniform(own, 0) for own in seeds.tolist()]
        prices = task.reward.price.draw(np.array(uniform))
        costs = loop.costs(values, np.tile(seeds, len(rules)), np.tile(prices, len(rules)))
        return costs.reshape(2, len(rules), episodes).mean(-1)
    size, briefs = max(_RUNS // episodes, 1), list[EpisodeResults]()
    for first in range(0, len(rules), size):
        briefs += run_several(task, rules[first : first + size], episodes, seed)
    return np.array([(brief.error_cost.mean(), brief.tokens.mean()) for brief in briefs]).T


def search_rule(
    search: RuleSearch,
    earlier: Sequence[Generation] = (),
    progress: Callable[[Generation], Any] | None = None,
) -> SearchResult:
    """Run a search, and measure its result on fresh episodes.

    Args:
        search: the search.
        earlier: generations of an interrupted search, which continues after them with the same
            result.
        progress: function that receives every new generation.

    Raises:
        ConfigurationError: the package cmaes is missing, or ``earlier`` belongs to another search.
    """
    generations = list(earlier)
    for generation in run_generations(search, earlier):
        generations.append(generation)
        if progress is not None:
            progress(generation)
    return search_result(search, generations)


def run_generations(search: RuleSearch, earlier: Sequence[Generation] = ()) -> Iterator[Generation]:
    """Yield the generations of a search after the earlier ones."""
    require("the search of a rule", "agents", "cmaes")
    from cmaes import CMA

    ranges = np.array([_RANGES[name] for name in search.coordinates])
    scale, limits = ranges[:, 0], ranges[:, 1:] / ranges[:, :1]
    seed, size = search.seed, search.population
    optimiser = CMA(search.first_point() / scale, 1.0, limits, 100, seed % 2**32, size)
    seed += 2 * search.episodes[1]  # after the start's
    for number in range(search.generations):
        share = number / max(search.generations - 1, 1)
        episodes = round(search.episodes[0] * (search.episodes[1] / search.episodes[0]) ** share)
        points = [optimiser.ask() for _ in range(size)]
        if number < len(earlier):
            objectives = tuple(earlier[number].objectives)
        else:
            objectives = _objectives(search, np.array(points) * scale, episodes, seed)
        optimiser.tell(list(zip(points, objectives, strict=True)))
        generation = Generation(number, objectives, tuple((optimiser.mean * scale).tolist()))
        if number >= len(earlier):
            yield generation
        elif not np.allclose(generation.mean, earlier[number].mean):
            raise ConfigurationError(
                f"earlier[{number}] is not allowed: it must be a generation of this search, with "
                f"the mean {validation.display(generation.mean)}"
            )
        seed += episodes


def search_result(search: RuleSearch, generations: Sequence[Generation]) -> SearchResult:
    """Measure the mean of the second half of the generations' means on fresh episodes."""
    if not generations:
        raise validation.refusal("generations", generations, "one or more")
    mean = np.mean([item.mean for item in generations[len(generations) // 2 :]], axis=0)
    policy = search.rule(mean)
    episodes = 4 * search.episodes[1]
    seed = search.seed + (2 + search.generations) * search.episodes[1]
    rule: Any = make_policy(policy, search.task)
    costs = _costs(search, rule.numbers, episodes, seed)[0]
    single: list[Any] = [make_policy(item.policy, search.task) for item in search.start]
    error, tokens = _means(search.task, single, episodes, seed, search.loop)
    references = error + np.array(search.prices) * tokens
    return SearchResult(policy, search.prices, tuple(costs.tolist()), tuple(references.tolist()))


def _objectives(search: RuleSearch, points: Array, episodes: int, seed: int) -> tuple[float, ...]:
    """Return each point's cost over the cost of the best single threshold, averaged over prices."""
    costs = _costs(search, search.numbers(points), episodes, seed)
    return tuple((costs / search.start_costs(search.start)).mean(-1).tolist())


def _costs(search: RuleSearch, numbers: ThresholdNumbers, episodes: int, seed: int) -> Array:
    """Return the costs (K, prices) of the numbers (…, K), on the same episodes."""
    shape = (numbers.margin.shape[-1], len(search.prices), episodes)
    candidate, price, episode = (place.ravel() for place in np.indices(shape))
    seeds, prices = seed + episode, np.array(search.prices)[price]
    if search.loop is not None:
        columns = numbers._asdict()
        columns |= {"reference_price": np.full(shape[:1], search.reference_price)[None]}
        values = {name: columns[name][:, candidate] for name in search.loop.sizes}
        error, tokens = search.loop.costs(values, seeds, prices)
        costs = error + prices * tokens
    else:
        policy = PricedThreshold(search.task, own=search.own, score=search.score)
        policy.reference_price, costs = search.reference_price, np.empty(len(candidate))
        for first in range(0, len(costs), _RUNS):
            part = slice(first, first + _RUNS)
            policy.numbers = ThresholdNumbers(*(column[:, candidate[part]] for column in numbers))
            own = prices[part]
            costs[part] = run_priced(search.task, policy, seeds[part], own).cost(own)
    return np.nan_to_num(costs, nan=_WORST, posinf=_WORST).reshape(shape).mean(-1)
