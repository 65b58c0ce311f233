"""Run policies over episodes whose noise is fixed by their seeds, record and draw an episode."""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from itertools import groupby
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array, take_runs
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.knowledge import KNOWLEDGE, Knowledge, Signals
from fusion_gym.core.memory import Beliefs, Owner
from fusion_gym.core.runs import Outcome
from fusion_gym.core.task import Task
from fusion_gym.envs.drawing import Film, Frame
from fusion_gym.errors import ConfigurationError
from fusion_gym.fusion.diagonal import orthonormalise
from fusion_gym.policies.base import Policy, Requests, decide, guard, owner_of

Progress = Callable[[int], Any] | None
BATCH = 1024  # episodes in one batch; fixed, so that results do not depend on the machine


@dataclass(frozen=True)
class EpisodeResults:
    """The results of E episodes of H steps; most fields are averages over an episode's steps.

    An episode in which the estimate is not finite is lost: its values are NaN, and its cost is
    infinite.

    Args:
        mse: squared error of the fused estimate (E,), summed over states.
        error_cost: error in the units of the reward (E,), >= 0.
        bound_trace: trace of the estimated covariance (E,).
        nees: normalised squared error (E,), divided by the rank of the covariance; 1 for a
            consistent filter.
        rate: transmissions (E, sensors).
        requests: requests (E, sensors).
        tokens: tokens spent (E,).
        denied: requests that the network refused (E,), summed over sensors.
        returns: sum of the rewards (E,).
        diverged: share of diverged steps (E,).
        squared_error: squared error (H, n) at each time and state, averaged over the episodes that
            are not lost by then.
        age: age of information (E, sensors), steps since the measurement of the newest packet that
            has arrived (S. Kaul, R. Yates and M. Gruteser, "Real-time status: how often should one
            update?", IEEE INFOCOM 2012).
        peak_age: mean age of information just before an arrival (E, sensors); NaN without one.
        age_95: 95 % quantile of the age of information (E, sensors).
        incorrect_age: age of incorrect information (E,), steps since the weighted squared error was
            last at most 1 (A. Maatouk, S. Kriouile, M. Assaad and A. Ephremides, "The age of
            incorrect information", IEEE/ACM Trans. Networking 28, 2020).
        control_cost: cost of state and input (E,), with a controller; a step that the plant ends
            is charged for each forfeited step, whose errors count as zero.
        control: squared input (E, k), with a controller.

    Example:
        >>> from fusion_gym import make_policy, make_task
        >>> from fusion_gym.evaluation import run_episodes
        >>> task = make_task("fusion_gym/TobitOscillator-v1", horizon=20)
        >>> results = run_episodes(task, make_policy("always", task), episodes=4, seed=0)
        >>> results.episodes, results.rate.shape, results.squared_error.shape
        (4, (4, 3), (20, 2))
    """

    mse: Array
    error_cost: Array
    bound_trace: Array
    nees: Array
    rate: Array
    requests: Array
    tokens: Array
    denied: Array
    returns: Array
    diverged: Array
    squared_error: Array
    age: Array
    peak_age: Array
    age_95: Array
    incorrect_age: Array
    control_cost: Array | None = None
    control: Array | None = None

    @property
    def episodes(self) -> int:
        """Number of episodes E."""
        return len(self.mse)

    def cost(self, price: float | Array) -> Array:
        """Return error + price · tokens (E,), for one price of a token or one per episode (E,)."""
        cost = self.error_cost + price * self.tokens
        return np.where(np.isnan(cost), np.inf, cost)


def run_episodes(
    task: Task, policy: Policy, episodes: int = 100, seed: int = 0, progress: Progress = None
) -> EpisodeResults:
    """Run a policy on episodes with consecutive seeds from ``seed``.

    The same seed gives the same noise, so the results of two policies are paired.

    Args:
        task: the task.
        policy: the policy, for example of :func:`~fusion_gym.make_policy`.
        episodes: number of episodes, >= 1.
        seed: seed of the first episode, >= 0.
        progress: function that receives the number of environment steps since its last call.

    Returns:
        The results, with the episodes in the order of their seeds.

    Raises:
        ConfigurationError: fewer than one episode, or a negative seed.
        LookupError: the policy uses a signal that the task withholds.

    Example:
        >>> from fusion_gym import make_policy, make_task
        >>> from fusion_gym.evaluation import run_episodes
        >>> task = make_task("fusion_gym/TobitOscillator-v1", horizon=20)
        >>> results = run_episodes(task, make_policy("periodic:period=4", task), 4, seed=0)
        >>> round(float(results.rate.mean()), 2)
        0.25
    """
    return run_several(task, [policy], episodes, seed, progress)[0]


def run_several(
    task: Task, policies: Sequence[Policy], episodes: int, seed: int, progress: Progress = None
) -> list[EpisodeResults]:
    """Run policies as :func:`run_episodes` does, those with one owner of beliefs in one batch.

    Args:
        task: the task.
        policies: the policies.
        episodes: number of episodes of each policy, >= 1.
        seed: seed of the first episode, >= 0.
        progress: function that receives the number of environment steps since its last call.

    Raises:
        ConfigurationError: fewer than one episode, or a negative seed.
        LookupError: a policy uses a signal that the task withholds.
    """
    validation.integer("episodes", episodes, at_least=1)
    validation.integer("seed", seed, at_least=0)
    windows = getattr(task.noise, "count", episodes)
    if episodes > windows:
        text = f"episodes = {episodes}: the recording has {windows} windows, which repeat"
        warnings.warn(text, stacklevel=3)
    results: list[EpisodeResults] = []
    for _, same in groupby(policies, owner_of):
        group, size = list(same), max(1, BATCH // episodes)
        for some in (group[place : place + size] for place in range(0, len(group), size)):
            policy = some[0] if len(some) == 1 else Together(task, some)
            parts = []
            for first in range(0, episodes, BATCH):
                seeds = seed + np.arange(first, min(first + BATCH, episodes))
                batch = seeded(task, owner_of(some[0]), np.tile(seeds, len(some)))
                parts.append(_results(batch, policy, seed + first, len(some), progress))
            results += map(_joined, zip(*parts, strict=True))
    return results


def run_priced(
    task: Task, policy: Policy, seeds: NDArray[np.int64], prices: Array
) -> EpisodeResults:
    """Run one policy on E seeds, each at its own price of a token.

    The signals and the reward use these prices instead of the price of the task.

    Args:
        task: the task.
        policy: the policy.
        seeds: seeds of the episodes (E,).
        prices: price of a token in each episode (E,).

    Raises:
        LookupError: the policy uses a signal that the task withholds.
    """
    batch = seeded(task, owner_of(policy), seeds)
    batch.price = np.array(prices, dtype=np.float64)
    return _results(batch, policy, int(seeds[0]))[0]


def _joined(parts: Sequence[EpisodeResults]) -> EpisodeResults:
    """Return the results of all episodes of a policy."""
    weights = np.array([part.episodes for part in parts])
    weights = weights / weights.sum()
    joined = {
        field.name: np.concatenate([getattr(part, field.name) for part in parts])
        for field in fields(EpisodeResults)
        if field.name != "squared_error" and getattr(parts[0], field.name) is not None
    }
    error = sum(w * part.squared_error for w, part in zip(weights, parts, strict=True))
    return EpisodeResults(**joined, squared_error=np.asarray(error))


class _Step(NamedTuple):
    """A step of N runs: the batch after it, its outcome, and the estimated covariance."""

    batch: EpisodeBatch
    outcome: Outcome
    covariance: Array


def _normalised_error(step: _Step) -> Array:
    """Return eᵀ P⁺ e over the rank of P (N,), of the known truths alone."""
    error, covariance = step.outcome.error, step.covariance
    known = step.batch.delivered.known
    if known is not None:
        covariance = np.where(known[:, None] & known, covariance, np.eye(len(known))[..., None])
        error = error * np.sqrt(len(known) / np.maximum(known.sum(0), 1))
    result = linalg.dot(error, linalg.solve_vector(covariance, error)) / len(error)
    lanes = np.flatnonzero(np.isnan(result) & np.isfinite(covariance).all((0, 1)))
    if lanes.size:
        root = linalg.root(covariance.take(lanes, axis=-1))
        inverse = orthonormalise(root[None])[:, len(error) : 2 * len(error)]
        unit = linalg.matvec(inverse, error.take(lanes, axis=-1))
        result[lanes] = linalg.dot(unit, unit) / np.maximum(inverse.any(1).sum(0), 1)
    return result


# Fields of EpisodeResults that are means over an episode's steps, as functions of a step.
_MEANS: dict[str, Callable[[_Step], NDArray[Any]]] = {
    "mse": lambda step: step.outcome.squared_error.sum(0),
    "error_cost": lambda step: -step.outcome.reward_error,
    "bound_trace": lambda step: linalg.trace(step.covariance),
    "nees": _normalised_error,
    "tokens": lambda step: step.outcome.cost,
    "denied": lambda step: (step.outcome.requested & ~step.outcome.granted).sum(0),
    "diverged": lambda step: step.outcome.diverged,
    "age": lambda step: step.outcome.age,
    "incorrect_age": lambda step: step.outcome.incorrect_age,
}
_OF_CONTROL: dict[str, Callable[[_Step], NDArray[Any]]] = {
    "control_cost": lambda step: cast(Array, step.outcome.control_cost),
    "control": lambda step: cast(Array, step.outcome.control) ** 2,
}


def _results(
    batch: EpisodeBatch, policy: Policy, seed: int, parts: int = 1, progress: Progress = None
) -> list[EpisodeResults]:
    """Run an episode of all runs of a batch, and return the results of its equal parts."""
    task, runs = batch.task, batch.num_envs
    horizon, sensors, episodes = task.horizon, task.sensors, runs // parts
    functions = _MEANS if task.controller is None else _MEANS | _OF_CONTROL
    means: dict[str, Any] = dict.fromkeys(functions, 0.0)
    rate, requests = np.zeros((sensors, runs)), np.zeros((sensors, runs))
    returns, squared_error, ages = np.zeros(runs), [], [np.zeros((sensors, runs))]
    batch.nonfinite = lost = np.zeros(runs, dtype=np.bool_)
    for request in decide(policy, batch, seed):
        outcome = batch.step(request)
        covariance = task.estimator.covariance(batch.delivered.estimate)
        errors = np.where(lost, 0.0, outcome.squared_error).reshape(-1, parts, episodes).sum(-1)
        finite = (~lost).reshape(parts, episodes).sum(-1)
        squared_error.append(np.where(finite > 0, errors / np.maximum(finite, 1), np.nan))
        for name, mean in functions.items():
            means[name] = means[name] + mean(_Step(batch, outcome, covariance))
        rate += outcome.granted
        requests += outcome.requested
        returns += outcome.reward
        ages.append(outcome.age)
        if progress is not None:
            progress(runs)
    values = {name: total.T / horizon for name, total in means.items()}
    values |= {"rate": (rate / horizon).T, "requests": (requests / horizon).T, "returns": returns}
    values |= {name: value.T.copy() for name, value in _age_statistics(np.array(ages)).items()}
    for value in values.values():
        value[lost] = np.nan
    paths = np.moveaxis(np.array(squared_error), -1, 0)
    return [
        EpisodeResults(
            **{name: value[first : first + episodes] for name, value in values.items()},
            squared_error=path,
        )
        for first, path in zip(range(0, runs, episodes), paths, strict=True)
    ]


def _age_statistics(ages: Array) -> dict[str, Array]:
    """Return mean peak and 95 % quantile (sensors, N) of ages (H + 1, sensors, N) from time 0."""
    before, after = ages[:-1], ages[1:]
    fell = after <= before
    arrivals = fell.sum(0)
    peak = np.where(fell, before + 1.0, 0.0).sum(0) / np.where(arrivals, arrivals, np.nan)
    return {"peak_age": peak, "age_95": np.quantile(after, 0.95, axis=0)}


@dataclass(frozen=True)
class Trajectory:
    """One episode of H steps, at the times 1..H.

    Args:
        truth: true state (H, n).
        mean: fused estimate (H, n).
        variance: diagonal of the estimated covariance (H, n).
        local_mean: local estimates (H, sensors, n), before the feedback.
        tokens: tokens after each step (H,).
        requested: requests (H, sensors), bool.
        granted: grants (H, sensors), bool.
        control: input (H, k) after each step, with a controller.

    Example:
        >>> from fusion_gym import make_policy, make_task
        >>> from fusion_gym.evaluation import record_episode
        >>> task = make_task("fusion_gym/TobitOscillator-v1", horizon=20)
        >>> record_episode(task, make_policy("always", task), seed=0).local_mean.shape
        (20, 3, 2)
    """

    truth: Array
    mean: Array
    variance: Array
    local_mean: Array
    tokens: Array
    requested: NDArray[np.bool_]
    granted: NDArray[np.bool_]
    control: Array | None = None


def record_episode(task: Task, policy: Policy, seed: int) -> Trajectory:
    """Return states, estimates, requests and tokens of the episode with this seed.

    Args:
        task: the task.
        policy: the policy.
        seed: seed of the episode, >= 0.

    Returns:
        The trajectory, with the time as its first axis.

    Raises:
        ConfigurationError: a negative seed.
        LookupError: the policy uses a signal that the task withholds.

    Example:
        >>> from fusion_gym import make_policy, make_task
        >>> from fusion_gym.evaluation import record_episode
        >>> task = make_task("fusion_gym/TobitOscillator-v1", horizon=20)
        >>> trajectory = record_episode(task, make_policy("never", task), seed=0)
        >>> trajectory.truth.shape, int(trajectory.granted.sum())
        ((20, 2), 0)
    """
    validation.integer("seed", seed, at_least=0)
    batch = EpisodeBatch.seeded(task, 1, seed, owner_of(policy))
    rows, estimator = [], task.estimator
    for request in decide(policy, batch, seed):
        outcome = batch.step(request)
        plant, estimate, *_ = batch.delivered
        variance = linalg.diagonal(estimator.covariance(estimate))
        means = estimator.mean(estimate), variance, estimator.local_means(estimate)
        network = batch.tokens, outcome.requested, outcome.granted
        loop = () if outcome.control is None else (outcome.control,)
        values = task.plant.truth(plant), *means, *network, *loop
        rows.append([np.array(value[..., 0]) for value in values])
    return Trajectory(*map(np.array, zip(*rows, strict=True)))


Runs = NDArray[np.int64]


def seeded(task: Task, owner: Owner | None, seeds: Runs) -> EpisodeBatch:
    """Return runs with these seeds (N,), at the start of an episode."""
    batch = EpisodeBatch(task, len(seeds), owner)
    batch.seed(np.arange(len(seeds)), seeds.tolist())
    batch.reset()
    return batch


class Together:
    """Several policies as one, each with an equal part of the runs."""

    knowledge: Knowledge = KNOWLEDGE[-1]

    def __init__(self, task: Task, policies: Sequence[Policy]) -> None:
        self._policies = policies
        self._decisions = [guard(policy, task) for policy in policies]

    def reset(self, runs: int, seed: int = 0) -> None:
        """Divide the runs among the policies, and reset these."""
        self.parts = np.arange(runs).reshape(len(self._policies), -1)
        for policy, part in zip(self._policies, self.parts, strict=True):
            policy.reset(len(part), seed)

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        each = zip(self._decisions, self.parts, strict=True)
        return np.concatenate([decision(_part(signals, part)) for decision, part in each], axis=-1)


def _part(whole: Signals, runs: Runs) -> Signals:
    """Return the signals of some runs; each is computed at its first use."""
    values: dict[str, Callable[[], Any]] = {
        name: partial(_take, whole, name, runs) for name in whole
    }
    nodes = None if whole.nodes is None else _part(whole.nodes, runs)
    return Signals(values, missing=whole.withheld, nodes=nodes)


def _take(whole: Signals, name: str, runs: Runs) -> Any:
    value: Any = whole[name]
    if isinstance(value, Beliefs):
        return _Part(value, runs)
    if name == "token_cost":  # the same for all runs
        return value
    # The observation has the batch first.
    return value[runs] if name == "observation" else take_runs(value, runs)


class _Part:
    """The beliefs of some runs; each attribute is computed on first access."""

    def __init__(self, whole: Beliefs, runs: Runs) -> None:
        self._whole, self._runs = whole, runs

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        vars(self)[name] = value = take_runs(getattr(self._whole, name), self._runs)
        return value


_LETTERS = 90  # of a policy's name, above its picture


class _Watched:
    """A policy with its run; ``cost`` and ``tokens`` are sums over the steps so far."""

    def __init__(self, name: str, policy: Policy, task: Task, seed: int, steps: int | None) -> None:
        self.name, self.cost, self.tokens, self.steps = name, 0.0, 0.0, 0
        self.batch = EpisodeBatch.seeded(task, 1, seed, owner_of(policy))
        self.film = Film(task, 1, steps)
        self.film.begin(self.batch)
        self.requests = decide(policy, self.batch, seed)

    def step(self) -> None:
        outcome = self.batch.step(next(self.requests))
        self.film.record(self.batch, outcome)
        self.cost -= float(outcome.reward.sum())
        self.tokens += float(outcome.cost.sum())
        self.steps += 1

    def title(self) -> str:
        """Return the name of the policy with its cost and tokens, means over the steps so far."""
        name = self.name.replace("_", " ").replace(":", ": ", 1).replace(",", ", ")
        name = name if len(name) <= _LETTERS else f"{name[: _LETTERS - 1]}…"
        cost, tokens = self.cost / self.steps, self.tokens / self.steps
        return f"{name}\ncost {cost:.3g} per step, tokens {tokens:.2f} per step (step {self.steps})"


def watch(
    task: Task, policies: Mapping[str, Policy], seed: int = 0, steps: int | None = None
) -> Iterator[Frame]:
    """Return pictures of one episode, one after each step.

    All policies run on the same noise. Their pictures stand side by side and share their axes,
    which a first run of the episode fixes, as it does the states that they show faintly. The cost
    of a step is minus its reward.

    Args:
        task: the task.
        policies: policies by the name above their picture.
        seed: seed of the episode, >= 0.
        steps: number of steps; the horizon by default.

    Returns:
        An iterator of pictures (height, width, 3).

    Raises:
        ConfigurationError: no policy, a negative seed, more steps than the horizon, or matplotlib
            is missing; before the first picture.
        LookupError: a policy uses a signal that the task withholds.

    Example:
        >>> from fusion_gym import make_policy, make_task
        >>> from fusion_gym.evaluation import watch
        >>> task = make_task("fusion_gym/TobitOscillator-v1", horizon=20)
        >>> frames = watch(task, {"always": make_policy("always", task)}, steps=2)
        >>> [frame.ndim for frame in frames]
        [3, 3]
    """
    validation.integer("seed", seed, at_least=0)
    if steps is not None:
        validation.integer("steps", steps, at_least=1, at_most=task.horizon)
    if not policies:
        raise ConfigurationError("policies = {} is not allowed: it must name at least one")

    def run() -> Iterator[list[_Watched]]:
        """Yield the policies after each step of the episode."""
        watched = [_Watched(*named, task, seed, steps) for named in policies.items()]
        for _ in range(task.horizon if steps is None else steps):
            for item in watched:
                item.step()
            yield watched

    return _frames(run)


def _frames(run: Callable[[], Iterator[list[_Watched]]]) -> Iterator[Frame]:
    """Run the episode for the limits of its axes, and again for its pictures."""
    ends, truth = [], []
    for watched in run():
        ends.append([item.film.limits() for item in watched])
        truth.append(watched[0].film.truth())
    low, high = np.min(ends, (0, 1))[:, 0].tolist(), np.max(ends, (0, 1))[:, 1].tolist()
    words: Any = {"limits": list(zip(low, high, strict=True)), "truth": np.array(truth)}
    for watched in run():
        yield np.hstack([item.film.frame(title=item.title(), **words) for item in watched])
