"""Draw one episode of several policies on the same noise."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

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
    """A policy with its run; ``error`` and ``packets`` are sums over the steps so far."""

    name: str
    batch: EpisodeBatch
    film: Film
    requests: Iterator[Requests]
    error: float = field(default=0.0)
    packets: int = field(default=0)
    steps: int = field(default=0)

    def step(self) -> None:
        outcome = self.batch.step(next(self.requests))
        self.film.record(self.batch, outcome)
        self.error += float(outcome.squared_error.sum())
        self.packets += int(outcome.granted.sum())
        self.steps += 1

    def title(self) -> str:
        """Return the name of the policy with its mean error and packets."""
        after = max(self.steps, 1)
        name = self.name if len(self.name) <= _LETTERS else f"{self.name[: _LETTERS - 1]}…"
        error, packets = self.error / after, self.packets / after
        return f"{name}\nstep {self.steps}: squared error {error:.3g}, {packets:.2f} packets a step"


def watch(
    task: Task, policies: Mapping[str, Policy], seed: int = 0, steps: int | None = None
) -> Iterator[Frame]:
    """Return pictures of one episode, before the first step and after each step.

    All policies run on the same noise. Their pictures stand side by side and share their axes.

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
        [3, 3, 3]
    """
    validation.integer("seed", seed, at_least=0)
    if steps is not None:
        validation.integer("steps", steps, at_least=1, at_most=task.horizon)
    if not policies:
        raise ConfigurationError("policies = {} is not allowed: it must name at least one")
    watched = []
    for name, policy in policies.items():
        batch = EpisodeBatch.seeded(task, 1, seed, owner_of(policy))
        film = Film(task, 1, steps)
        film.begin()
        watched.append(_Watched(name, batch, film, decide(policy, batch, seed)))
    return _frames(watched, task.horizon if steps is None else steps)


def _frames(watched: list[_Watched], steps: int) -> Iterator[Frame]:
    yield _join_frames(watched)
    for _ in range(steps):
        for item in watched:
            item.step()
        yield _join_frames(watched)


def _join_frames(watched: list[_Watched]) -> Frame:
    """Return the pictures side by side, with common limits of their axes."""
    needed = zip(*(item.film.limits() for item in watched), strict=True)
    limits = [(min(low for low, _ in ends), max(high for _, high in ends)) for ends in needed]
    return np.hstack([item.film.frame(title=item.title(), limits=limits) for item in watched])
