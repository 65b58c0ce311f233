"""How fast agents learn, as typed YAML."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pydantic

from ..training.algorithms import AlgorithmConfig, AnyAlgorithm, PPOConfig, settings
from ..training.checked import Positive, Rate, Share, Strict, load_changed


class Plain(Strict):
    """Plain PPO without memory in the suite's settings, for comparison.

    It ends below the memoryless envelope, or after ``budget`` times the processor seconds that the
    fronts' trainings took.
    """

    every: Positive = 100_000
    seeds: Positive = 2
    budget: Rate = 3.0
    timesteps: Positive = 3_200_000
    num_envs: Positive = 256
    algorithm: AnyAlgorithm = PPOConfig(name="ppo")


class PlainChanges(Strict):
    """What is other in a setting; ``longer`` multiplies the length."""

    longer: float = pydantic.Field(default=1.0, gt=0)
    algorithm: dict[str, Any] = pydantic.Field(default_factory=dict)


class Course(Strict):
    """What is trained in one setting of the suite, and what it is compared with.

    ``front`` is the training's config, ``memoryless`` the class of the committed envelope to get
    below while learning. The finished front is compared with ``against``: a class of the committed
    envelope, the ``optimum`` at each price, or the best of ``schedules`` there; a share of
    ``allowed`` above it is still good.
    """

    setting: str
    front: str
    memoryless: str | None = None
    against: str
    schedules: tuple[str, ...] = ()
    allowed: Rate = 0.01
    plain: PlainChanges = PlainChanges()

    @pydantic.model_validator(mode="after")
    def _scheduled(self) -> Course:
        if (self.against == "schedules") != bool(self.schedules):
            raise ValueError("schedules and against: schedules stand together")
        return self


class Learning(Strict):
    """All settings; ``timesteps`` and ``test_episodes`` stand for those of configs and suite."""

    suite: str = "benchmark"
    prices: Positive = 7
    inner: tuple[Share, Share] = (0.05, 0.95)
    every: Positive = 50_000
    episodes: Positive = 128
    timesteps: Positive | None = None
    test_episodes: Positive | None = None
    plain: Plain = Plain()
    settings: tuple[Course, ...] = pydantic.Field(min_length=1)

    def algorithm_of(self, course: Course) -> AlgorithmConfig:
        """Plain PPO's hyper-parameters in a setting, checked again.

        Raises:
            ValueError: a hyper-parameter that is unknown or not allowed.
        """
        return settings(self.plain.algorithm.model_dump() | course.plain.algorithm)

    @pydantic.model_validator(mode="after")
    def _trainable(self) -> Learning:
        for course in self.settings:
            self.algorithm_of(course)
        return self


# What --quick changes: the same work, less of it.
QUICK: dict[str, Any] = {
    "timesteps": 50_000,
    "every": 25_000,
    "test_episodes": 100,
    "episodes": 32,
    "plain": {"every": 25_000, "seeds": 1, "budget": 1.0},
}


def load_learning(path: str | Path, quick: bool = False) -> Learning:
    """The config, or its quick version.

    Raises:
        ConfigurationError: unreadable, an unknown key, or a value that is not allowed.
    """
    return load_changed(Learning, path, QUICK if quick else {})
