"""Policies side by side on the same noise, as pictures of one episode."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from fusion_gym import validation
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.envs.drawing import Film, Frame
from fusion_gym.errors import ConfigurationError
from fusion_gym.policies.base import Policy, owner_of, refused_signals

_LETTERS = 90  # of a policy's name, above its picture


@dataclass
class _Watched:
    """A policy with its run; ``error`` and ``packets`` are sums over the steps so far."""

    name: str
    policy: Policy
    batch: EpisodeBatch
    film: Film
    refused: dict[str, str]
    error: float = field(default=0.0)
    packets: int = field(default=0)
    steps: int = field(default=0)

    def step(self) -> None:
        outcome = self.batch.step(self.policy(self.batch.signals().limit(self.refused)))
        self.film.record(self.batch, outcome)
        self.error += float(outcome.squared_error.sum())
        self.packets += int(outcome.granted.sum())
        self.steps += 1

    def title(self) -> str:
        """The policy, and what it has brought so far."""
        after = max(self.steps, 1)
        name = self.name if len(self.name) <= _LETTERS else f"{self.name[: _LETTERS - 1]}…"
        error, packets = self.error / after, self.packets / after
        return f"{name}\nstep {self.steps}: squared error {error:.3g}, {packets:.2f} packets a step"


def watch(
    task: Task, policies: Mapping[str, Policy], seed: int = 0, steps: int | None = None
) -> Iterator[Frame]:
    """Pictures (height, width, 3) of the episode with this seed, before it and after each step.

    Every policy, by the name that stands above its picture, meets the same noise; the pictures
    stand side by side, with the same axes. ``steps`` instead of the whole horizon.

    Raises:
        ConfigurationError: no policy, a negative seed, more steps than the horizon, or matplotlib
            is absent; at once, not with the first picture.
        LookupError: a policy looks at a signal that the task withholds.
    """
    validation.integer("seed", seed, at_least=0)
    if steps is not None:
        validation.integer("steps", steps, at_least=1, at_most=task.horizon)
    if not policies:
        raise ConfigurationError("policies = {} is not allowed: name one at least")
    watched = []
    for name, policy in policies.items():
        batch = EpisodeBatch.seeded(task, 1, seed, owner_of(policy))
        policy.reset(1, seed)
        film = Film(task, 1)
        film.begin()
        watched.append(_Watched(name, policy, batch, film, refused_signals(policy, task)))
    return _frames(watched, task.horizon if steps is None else steps)


def _frames(watched: list[_Watched], steps: int) -> Iterator[Frame]:
    yield _beside(watched)
    for _ in range(steps):
        for item in watched:
            item.step()
        yield _beside(watched)


def _beside(watched: list[_Watched]) -> Frame:
    """The pictures of all, with axes that reach as far as any of them needs."""
    needed = zip(*(item.film.limits() for item in watched), strict=True)
    limits = [(min(low for low, _ in ends), max(high for _, high in ends)) for ends in needed]
    return np.hstack([item.film.frame(title=item.title(), limits=limits) for item in watched])
