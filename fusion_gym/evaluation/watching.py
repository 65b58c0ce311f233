"""Draw one episode of several policies on the same noise."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fusion_gym import validation
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.envs.drawing import Film, Frame
from fusion_gym.errors import ConfigurationError
from fusion_gym.policies.base import Policy, Requests, decide, owner_of

_LETTERS = 90  # of a policy's name, above its picture


@dataclass
class _Watched:
    """A policy with its run; ``cost`` and ``tokens`` are sums over the steps so far."""

    name: str
    batch: EpisodeBatch
    film: Film
    requests: Iterator[Requests]
    cost: float = field(default=0.0)
    tokens: float = field(default=0.0)
    steps: int = field(default=0)

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

    def begin() -> list[_Watched]:
        watched = []
        for name, policy in policies.items():
            batch = EpisodeBatch.seeded(task, 1, seed, owner_of(policy))
            film = Film(task, 1, steps)
            film.begin()
            watched.append(_Watched(name, batch, film, decide(policy, batch, seed)))
        return watched

    return _frames(begin, task.horizon if steps is None else steps)


def _frames(begin: Callable[[], list[_Watched]], steps: int) -> Iterator[Frame]:
    """Run the episode for the limits of its axes, and again for its pictures."""
    ends, truth = [], []
    for watched in _run(begin(), steps):
        ends.append([item.film.limits() for item in watched])
        truth.append(watched[0].film.truth())
    low, high = np.min(ends, (0, 1))[:, 0].tolist(), np.max(ends, (0, 1))[:, 1].tolist()
    words: Any = {"limits": list(zip(low, high, strict=True)), "truth": np.array(truth)}
    for watched in _run(begin(), steps):
        yield np.hstack([item.film.frame(title=item.title(), **words) for item in watched])


def _run(watched: list[_Watched], steps: int) -> Iterator[list[_Watched]]:
    for _ in range(steps):
        for item in watched:
            item.step()
        yield watched
