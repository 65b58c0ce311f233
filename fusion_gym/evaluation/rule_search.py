"""Search the parameters of a rule by CMA-ES.

    search = search_of_class("scheduler", task, prices=(0.003, 0.01, 0.03, 0.1))
    result = search_rule(search)
    policy = make_policy(result.policies[0], task)

``priced_threshold`` is searched for all prices at once. The search starts with the best single
threshold at each price, and the power of the price that fits these thresholds. Any other rule whose
parameters declare a range (:class:`~fusion_gym.policies.base.SearchRange`) is searched at each
price, from the best value of its first parameter. Every generation uses fresh episodes, and their
number grows. The result is the mean of the means of the second half of the generations.

Costs of many episodes come from one loop of rule, step and memory in machine code: JAX traces the
rule, whose parameters differ between the runs, and LLVM compiles the loop.

Source: N. Hansen and A. Ostermeier, "Completely derandomized self-adaptation in evolution
strategies", Evolutionary Computation 9, 2001, as in the package cmaes.
"""

from __future__ import annotations

import dataclasses
import functools
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fusion_gym import seeds, validation
from fusion_gym.arrays import Array, arrays_of, map_arrays
from fusion_gym.core.batch import draw_episodes
from fusion_gym.core.knowledge import covers
from fusion_gym.core.memory import Memory
from fusion_gym.core.noise import PhiloxNoise
from fusion_gym.core.observation import ObservationLayout
from fusion_gym.core.runs import Branch
from fusion_gym.core.task import Task
from fusion_gym.evaluation.episodes import run_several
from fusion_gym.importing import require
from fusion_gym.lowering import Buffer, LoweringError
from fusion_gym.namespace import namespace
from fusion_gym.policies.base import Policy, SearchRange, owner_of, refused_signals
from fusion_gym.policies.registry import make_policy, search_ranges, with_settings
from fusion_gym.policies.rules import PricedThreshold, Score
from fusion_gym.validation import ConfigurationError

_FEWEST = 300_000  # steps of all runs, below which NumPy takes less time than a compilation
_TOGETHER = 64  # runs whose rows stay in the cache of the processor
_REAL = np.dtype(np.float64)


class RuleLoop:
    """Episodes of a rule without variables.

    Args:
        task: The task.
        rule: The rule, a dataclass.
        sizes: Numbers per run, 1 or one for each sensor, of each field of the rule that differs
            between the runs.

    Attributes:
        sizes: The argument.

    Raises:
        LoweringError: The step or the rule has a primitive that is not lowered, or too many
            instructions.
        ConfigurationError: JAX is absent, and the code is not in the cache.
    """

    def __init__(self, task: Task, rule: Any, sizes: Mapping[str, int]) -> None:
        from fusion_gym.core.compiled import RowStep, compile_function

        owner = owner_of(rule) or "scheduler"
        self._step = RowStep(task, Memory(task, owner), ObservationLayout(task, owner))
        self._task, self._rule, self.sizes = task, rule, dict(sizes)
        self._refused = refused_signals(rule, task)
        self._local = not covers(rule.knowledge, "centre")
        values = tuple(np.zeros((size, 1)) for size in sizes.values())
        requests = np.zeros((task.sensors, 1), np.bool_)
        self._template: Any = self._step.template, values, requests, np.zeros((2, 1))
        arrays = arrays_of(self._template)
        self._width = sum(array.size for array in arrays)
        own = (field.name for field in dataclasses.fields(rule) if field.name != "task")
        others = {name: getattr(rule, name) for name in own if name not in sizes}
        key, row = (task, type(rule), others, self.sizes), Buffer(_REAL, arrays, self._width)
        step, limit = self._step, np.zeros(1, np.int64)
        inputs: Any = step.start_noise, step.noise, np.zeros(1), limit, *values
        sources = [Buffer(array.dtype, [array]) for array in inputs]
        self._start = compile_function((*key, "start"), self._begin, sources, [row])
        sources = [row, Buffer(_REAL, [step.noise])]
        self._move = compile_function((*key, "step"), self._advance, sources, [row])

    def costs(self, values: Mapping[str, Array], seeds: NDArray[np.int64], prices: Array) -> Array:
        """Return error and tokens (2, N), means over the steps of an episode.

        Args:
            values: Values (…, N) of the fields.
            seeds: Seeds (N,).
            prices: Price of a token (N,).
        """
        horizon, result = self._task.horizon, np.empty((2, len(seeds)))
        different, places = np.unique(seeds, return_inverse=True)
        starts, noise = draw_episodes(self._task, different)
        for first in range(0, len(seeds), _TOGETHER):
            part = slice(first, first + _TOGETHER)
            some, price = places[part], np.ascontiguousarray(prices[part], _REAL)
            normals, runs = noise.take(some, axis=-1), len(some)
            rows, limit = np.empty((2, runs, self._width)), np.full(runs, horizon)
            own = [np.ascontiguousarray(values[field][:, part], _REAL) for field in self.sizes]
            inputs = starts.take(some, axis=-1), normals[0], price, limit, *own
            before, after = (row.ctypes.data for row in rows)
            self._start(runs, *(array.ctypes.data for array in inputs), before)
            for step in range(1, horizon + 1):
                address = normals.ctypes.data + step * normals.strides[0]
                self._move(runs, before, address, after)
                before, after = after, before
            result[:, part] = rows[horizon % 2, :, -2:].T / horizon
        return result

    def _begin(self, start: Any, noise: Any, price: Any, limit: Any, *values: Any) -> list[Any]:
        """Return the arrays of a row at the start."""
        branch = self._step.begin_run(start, noise, price, limit)
        return self._arrays(branch, values, namespace(price).zeros((2, 1)))

    def _advance(self, arrays: list[Any], noise: Any) -> list[Any]:
        """Return the arrays of a row after a step, from those before and noise."""
        parts, (task, memory, layout) = iter(arrays), self._step.runs
        (position, states), values, requests, sums = map_arrays(
            lambda _: next(parts), self._template
        )
        branch = Branch(task, memory.with_states(states), layout, position)
        outcome = branch.step(requests, noise)
        costs = namespace(sums).stack([-outcome.reward_error, outcome.cost])
        return self._arrays(branch, values, sums + costs)

    def _arrays(self, branch: Branch, values: Any, sums: Any) -> list[Any]:
        changes = {name: value[:, 0] for name, value in zip(self.sizes, values, strict=True)}
        rule = dataclasses.replace(self._rule, **changes)
        requests = rule(branch.signals().limit(self._refused, self._local))
        requests = namespace(sums).broadcast_to(requests, (self._task.sensors, 1))
        return arrays_of(((branch.position(), branch.memory.states), values, requests, sums))


def make_loop(task: Task, rule: Any, sizes: Mapping[str, int], run_steps: int) -> RuleLoop | None:
    """Return the loop of a rule, or ``None`` where NumPy is faster or alone runs it.

    Args:
        task: The task.
        rule: The rule, a dataclass.
        sizes: As of :class:`RuleLoop`.
        run_steps: Steps of all runs.
    """
    foreign = task.noise is not None or task.network.rule.by_channel
    if run_steps < _FEWEST or foreign or not rule.stateless:
        return None
    try:
        task.refuse_numpy_only()
        return RuleLoop(task, rule, sizes)
    except (ConfigurationError, LoweringError):
        return None


ClassName = Literal["centre", "local", "scheduler"]
# The scores of each class's search.
_SCORES: dict[ClassName, tuple[Score, ...]] = {
    "centre": ("variance",),
    "local": ("value", "innovation"),
    "scheduler": ("value",),
}
_WIDE = 20.0  # a margin that hardly ever lets two sensors transmit in the same step
_WORST = 1e30  # the cost of a candidate whose error is no number
_FIRST = 24, 48  # values of the first sweep, of a priced_threshold and of another rule


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
        policies: the rule at each price as text.
        prices: prices of a token.
        costs: cost of the rule at each price, on fresh episodes.
        threshold_costs: cost of the best single threshold at each price, on the same episodes.
    """

    policies: tuple[str, ...]
    prices: tuple[float, ...]
    costs: tuple[float, ...]
    threshold_costs: tuple[float, ...]

    @property
    def relative(self) -> float:
        """Mean over the prices of cost / cost of the best single threshold, minus 1."""
        return float(np.mean(np.divide(self.costs, self.threshold_costs)) - 1.0)


@dataclass(frozen=True)
class RuleSearch:
    """A search of a rule for all prices.

    Args:
        task: the task.
        prices: prices of a token, > 0 and different.
        rule: text of the rule; the search leaves the parameters that it sets.
        parameters: names of the searched parameters; by default all that declare a range.
        bounds: least and largest value of the first sweep; derived from the prices or from the
            range of the first parameter by default.
        generations: number of generations.
        population: candidates of a generation, >= 3.
        episodes: episodes of the first and of the last generation.
        seed: seed of the first episode and of the candidates.

    Raises:
        ConfigurationError: a value that is not allowed, or a rule without a range.
    """

    task: Task = field(repr=False)
    prices: tuple[float, ...]
    rule: str = "priced_threshold"
    parameters: tuple[str, ...] = ()
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
        if not self.ranges:
            raise validation.refusal("rule", self.rule, "a rule with parameters to search")

    @functools.cached_property
    def base(self) -> Any:
        """The rule with the parameters that the search leaves."""
        return make_policy(self.text, self.task)

    @functools.cached_property
    def text(self) -> str:
        """The text of the rule without the searched parameters."""
        every = search_ranges(self.rule)
        single = {name: f"{own.low:g}" for name, own in every.items() if own.low == own.high}
        return with_settings(self.rule, single)

    @functools.cached_property
    def ranges(self) -> dict[str, SearchRange]:
        """The range of each searched parameter, in the order of the rule's parameters."""
        every, idle = search_ranges(self.text), set[str]()
        if every and self.joint:
            alone = self.base.own or self.task.sensors == 1
            idle |= {"price_exponent", "margin_exponent"} if len(self.prices) == 1 else set()
            idle |= {"token_exponent"} if self.task.network.bucket.unlimited else set()
            idle |= {"margin", "margin_exponent"} if alone else set()
        if unknown := set(self.parameters) - every.keys():
            allowed = f"names of {', '.join(every)}"
            raise validation.refusal("parameters", sorted(unknown), allowed)
        names = [name for name in every if name in (self.parameters or every)]
        return {name: every[name] for name in names if name not in idle}

    @property
    def joint(self) -> bool:
        """Whether one rule serves all prices."""
        return isinstance(self.base, PricedThreshold)

    @property
    def parts(self) -> tuple[RuleSearch, ...]:
        """The searches of all prices, or of each price, with one first sweep."""
        if self.joint:
            return (self,)
        parts = tuple(replace(self, prices=(price,)) for price in self.prices)
        for part in parts:
            vars(part).update(sweeps=self.sweeps, loop=self.loop)
        return parts

    @property
    def reference_price(self) -> float:
        """The geometric mean of the prices, with five digits."""
        return float(f"{np.exp(np.mean(np.log(self.prices))):.5g}")

    @functools.cached_property
    def coordinates(self) -> tuple[str, ...]:
        """The parameter of each coordinate; the sensors follow one another."""
        every = self.ranges.items()
        sizes = {name: self.task.sensors if own.per_sensor else 1 for name, own in every}
        return tuple(name for name, size in sizes.items() for _ in range(size))

    @functools.cached_property
    def sweeps(self) -> tuple[list[ThresholdTrial], ...]:
        """The first parameter's values, for all sensors alike.

        A priced_threshold has a sweep of each score, with and without a wide margin.
        """
        name, own = next(iter(self.ranges.items()))
        low, high = self.bounds or own[:2]
        if self.joint:
            worth = np.array(self.prices) * self.task.network.bucket.cost / self.task.error_scale
            low, high = self.bounds or (worth.min() / 30.0, worth.max() * 3.0)
        first, last = own.coordinate(np.array([low, high]))
        values = np.unique(own.value(np.linspace(first, last, _FIRST[not self.joint])))
        if self.joint:
            margins = (1.0, _WIDE) if "margin" in self.ranges else (1.0,)
            fixed = [{"mixture": share, "price_exponent": 0.0} for share in (0.0, 1.0)]
            every = [
                [one | {"margin": s, name: v} for s in margins for v in values] for one in fixed
            ]
        else:
            points = np.tile(self._point(self.base, {}), (len(values), 1))
            points[:, np.array(self.coordinates) == name] = own.coordinate(values)[:, None]
            every = [[self.values(point[None]) for point in points]]
        count, sweeps = 2 * self.episodes[1], []
        for texts in ([with_settings(self.text, one) for one in some] for some in every):
            thresholds = np.resize(values, len(texts)).tolist()
            sweeps.append(_try(self.task, texts, thresholds, count, self.seed, self.loop))
        return tuple(sweeps)

    @functools.cached_property
    def start(self) -> tuple[ThresholdTrial, ...]:
        """The best trial at each price, of the sweep that costs least at all prices."""
        starts = (
            tuple(min(sweep, key=lambda t: t.cost(price)) for price in self.prices)
            for sweep in self.sweeps
        )
        return min(starts, key=lambda trials: float(np.log(self.start_costs(trials)).sum()))

    @functools.cached_property
    def loop(self) -> RuleLoop | None:
        """The loop of the rule in machine code, where it saves time."""
        if not is_dataclass(self.base):
            return None
        runs = self.generations * self.population * len(self.prices) * self.episodes[0]
        sizes = Counter((*self.coordinates, *(("reference_price",) if self.joint else ())))
        return make_loop(self.task, self.base, sizes, runs * self.task.horizon)

    def start_costs(self, trials: Sequence[ThresholdTrial]) -> Array:
        """Return the costs of the trials, each at its price."""
        return np.array([t.cost(p) for t, p in zip(trials, self.prices, strict=True)])

    def first_point(self) -> Array:
        """Return the start in coordinates: the powers of the price that fit the start best."""
        ratio = np.log(np.array(self.prices) / self.reference_price)
        rules: list[Any] = [make_policy(trial.policy, self.task) for trial in self.start]
        fitted = dict[str, float]()
        for name, exponent in (("threshold", "price_exponent"), ("margin", "margin_exponent")):
            if self.joint:
                logs = np.log([getattr(rule, name) for rule in rules])
                slope = float(ratio @ logs) / float(ratio @ ratio) if len(ratio) > 1 else 1.0
                fitted |= {exponent: slope, name: (logs - slope * ratio).mean()}
        return self._point(rules[0], fitted)

    def _point(self, rule: Any, fitted: dict[str, float]) -> Array:
        """Return the coordinates of a rule, with fitted ones in the place of its own."""
        point = list[float]()
        for name, own in self.ranges.items():
            value = getattr(rule, name)
            value = fitted.get(name, own.coordinate(self.task.horizon if value is None else value))
            value = np.clip(value, *own.coordinate(np.array(own[:2])))
            point += np.broadcast_to(value, self.coordinates.count(name)).tolist()
        return np.array(point)

    def values(self, points: Array) -> dict[str, Array]:
        """Return the parameters (size, K) of K points (K, coordinates), nearest allowed ones."""
        names = np.array(self.coordinates)
        columns = {name: own.value(points[:, names == name].T) for name, own in self.ranges.items()}
        allowed: dict[str, Array] = getattr(self.base, "admissible", lambda some: some)(columns)
        return allowed

    def policy(self, point: Array) -> str:
        """Return the rule of a point (coordinates,) as text."""
        fixed = {"reference_price": self.reference_price} if self.joint else {}
        return with_settings(self.text, fixed | self.values(point[None]))

    def rules(self, values: dict[str, Array], price: float) -> list[Policy]:
        """Return the rules of parameters (size, K) at a price."""
        fixed = {"reference_price": self.reference_price, "price": price} if self.joint else {}
        count = next(iter(values.values())).shape[1]
        every = (fixed | {name: c[:, k] for name, c in values.items()} for k in range(count))
        texts = (with_settings(self.text, some, digits=17) for some in every)
        return [make_policy(text, self.task, trial=False) for text in texts]


def class_of(task: Task, local: bool) -> ClassName:
    """Return the class of the agents of a task; ``local`` ones decide at each sensor."""
    if local:
        return "local"
    return "centre" if task.options.information == "centre" else "scheduler"


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
    own = str(name == "local").lower()
    searches = [
        RuleSearch(task, tuple(prices), f"priced_threshold:own={own},score={score}", **options)
        for score in _SCORES[name]
    ]
    if len(searches) == 1:
        return searches[0]
    return min(searches, key=lambda item: float(np.log(item.start_costs(item.start)).sum()))


def try_thresholds(
    task: Task, template: str, values: Sequence[float], episodes: int, seed: int
) -> list[ThresholdTrial]:
    """Run a rule with each of several thresholds, ``{value}`` in the template, in one batch."""
    if "{value}" not in template:
        raise validation.refusal("template", template, "a policy with {value} as its threshold")
    texts = [template.replace("{value}", f"{value:.5g}") for value in values]
    return _try(task, texts, values, episodes, seed)


def _try(
    task: Task,
    texts: Sequence[str],
    values: Sequence[float],
    episodes: int,
    seed: int,
    loop: RuleLoop | None = None,
) -> list[ThresholdTrial]:
    """Run the rules of several texts, each with its value, in one batch."""
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
            name: np.array([np.broadcast_to(_number(getattr(own, name)), size) for own in rules]).T
            for name, size in loop.sizes.items()
        }
        values = {name: column.repeat(episodes, axis=1) for name, column in values.items()}
        seeds = seed + np.arange(episodes)
        uniform = [PhiloxNoise().uniform(own, 0) for own in seeds.tolist()]
        prices = task.reward.price.draw(np.array(uniform))
        costs = loop.costs(values, np.tile(seeds, len(rules)), np.tile(prices, len(rules)))
        return costs.reshape(2, len(rules), episodes).mean(-1)
    return _run(task, rules, episodes, seed)


def _run(task: Task, rules: Sequence[Any], episodes: int, seed: int) -> Array:
    """Return the error and the tokens (2, rules) of each rule under NumPy."""
    results = run_several(task, rules, episodes, seed)
    return np.array([(result.error_cost.mean(), result.tokens.mean()) for result in results]).T


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
    count = search.generations
    for place, part in enumerate(search.parts):
        yield from _run_part(part, earlier[place * count : (place + 1) * count], place * count)


def _run_part(part: RuleSearch, earlier: Sequence[Generation], before: int) -> Iterator[Generation]:
    """Yield the generations of one search after the earlier ones; others came ``before``."""
    from cmaes import CMA

    ranges = [part.ranges[name] for name in part.coordinates]
    scale = np.array([own.deviation for own in ranges])
    limits = np.array([own.coordinate(np.array(own[:2])) for own in ranges]) / scale[:, None]
    seed, size = part.seed, part.population
    optimiser = CMA(part.first_point() / scale, 1.0, limits, 100, seed % 2**32, size)
    seed += 2 * part.episodes[1]  # after the start's
    for number in range(part.generations):
        share = number / max(part.generations - 1, 1)
        episodes = round(part.episodes[0] * (part.episodes[1] / part.episodes[0]) ** share)
        points = [optimiser.ask() for _ in range(size)]
        if number < len(earlier):
            objectives = tuple(earlier[number].objectives)
        else:
            objectives = _objectives(part, np.array(points) * scale, episodes, seed)
        optimiser.tell(list(zip(points, objectives, strict=True)))
        mean = tuple((optimiser.mean * scale).tolist())
        generation = Generation(before + number, objectives, mean)
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
    policies, costs = list[str](), list[float]()
    episodes = 4 * search.episodes[1]
    seed = search.seed + (2 + search.generations) * search.episodes[1]
    for place, part in enumerate(search.parts):
        own = generations[place * search.generations : (place + 1) * search.generations]
        if not own:
            raise validation.refusal("generations", generations, "one or more at each price")
        mean = np.mean([item.mean for item in own[len(own) // 2 :]], axis=0)
        policies += [part.policy(mean)] * len(part.prices)
        costs += _costs(part, mean[None], episodes, seed)[0].tolist()
    single: list[Any] = [make_policy(item.policy, search.task) for item in search.start]
    error, tokens = _means(search.task, single, episodes, seed, search.loop)
    references = error + np.array(search.prices) * tokens
    return SearchResult(tuple(policies), search.prices, tuple(costs), tuple(references.tolist()))


def _objectives(search: RuleSearch, points: Array, episodes: int, seed: int) -> tuple[float, ...]:
    """Return each point's cost over the cost of the best single threshold, averaged over prices."""
    costs = _costs(search, points, episodes, seed)
    return tuple((costs / search.start_costs(search.start)).mean(-1).tolist())


def _costs(search: RuleSearch, points: Array, episodes: int, seed: int) -> Array:
    """Return the costs (K, prices) of K points (K, coordinates), on the same episodes."""
    values, prices = search.values(points), np.array(search.prices)
    if search.loop is None:
        rules = [rule for price in search.prices for rule in search.rules(values, price)]
        error, tokens = _run(search.task, rules, episodes, seed).reshape(2, len(prices), -1)
        costs = (error + prices[:, None] * tokens).T
    else:
        shape = (len(points), len(prices), episodes)
        candidate, price, episode = (place.ravel() for place in np.indices(shape))
        values |= {"reference_price": np.full((1, len(points)), search.reference_price)}
        columns = {name: values[name][:, candidate] for name in search.loop.sizes}
        error, tokens = search.loop.costs(columns, seed + episode, prices[price])
        costs = (error + prices[price] * tokens).reshape(shape).mean(-1)
    return np.nan_to_num(costs, nan=_WORST, posinf=_WORST)


def _number(value: Any) -> Any:
    """Return a parameter as numbers; ``None``, no limit, is infinite."""
    return np.inf if value is None else value
