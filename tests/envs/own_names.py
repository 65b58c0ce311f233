"""An environment, policies and errors of a user, found by this module's name."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

import fusion_gym
from fusion_gym.policies.base import Rule
from fusion_gym.systems.tobit.linear import LinearFusionOptions, build_linear


@dataclass(frozen=True)
class CartOptions(LinearFusionOptions):
    """A cart."""

    token_rate: Any = 2.0


def build(chosen: CartOptions) -> Any:
    return build_linear(chosen)


fusion_gym.register("me/OwnCart-v0", build)


@dataclass
class Oldest(Rule):
    """Whoever was silent for longer than some steps."""

    knowledge: ClassVar[Any] = "centre"
    steps: float = 3.0

    def __call__(self, signals: Any) -> Any:
        return signals["age"] > self.steps


@dataclass
class Tasked(Rule):
    """One that is given the task."""

    knowledge: ClassVar[Any] = "centre"
    task: Any = None

    def __call__(self, signals: Any) -> Any:
        return np.ones((self.task.sensors, len(signals["tokens"])), dtype=bool)


def worst(error: Any, covariance: Any) -> Any:
    return np.abs(error).max(0)


def wrong(error: Any, covariance: Any) -> Any:
    return error


def below(error: Any, covariance: Any) -> Any:
    return -np.abs(error).max(0)
