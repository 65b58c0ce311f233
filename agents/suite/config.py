"""The benchmark's config: settings, baselines with the ranges of their parameters, agents."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import pydantic

from fusion_gym.core.system import Knowledge

from ..training.algorithms import AlgorithmConfig, AnyAlgorithm, settings
from ..training.checked import Positive, Rate, Share, Strict, parse, read_yaml
from ..training.config import EnvironmentConfig

Mode = Literal["sensors", "centre", "local"]
# With which rules an agent of this mode is compared: those that know no more than this. Rules may
# remember what a sensor did not send, and these agents do not: the envelope favours the rules.
COMPARED_UP_TO: dict[Mode, Knowledge] = {
    "sensors": "coordinator_memory",
    "centre": "centre",
    "local": "own_memory",
}


class Range(Strict):
    """A parameter between ``low`` and ``high``, in the logarithm, of one value or one a sensor."""

    low: Rate
    high: Rate
    whole: bool = False
    per_sensor: bool = False

    @pydantic.model_validator(mode="after")
    def _ordered(self) -> Range:
        if self.low >= self.high:
            raise ValueError(f"low = {self.low} must be below high = {self.high}")
        return self


class Choices(Strict):
    """A parameter with few values."""

    values: tuple[Any, ...] = pydantic.Field(min_length=1)


class Family(Strict):
    """A rule with parameters to tune."""

    label: str
    policy: str
    parameters: dict[str, Range | Choices]


class Tuning(Strict):
    """One budget of trials for every rule, on seeds that no test uses."""

    trials: Positive = 40
    episodes: Positive = 200
    seed: int = pydantic.Field(default=600_000_000, ge=0)
    kept: Positive = 14


class Genie(Strict):
    """A system that always receives, with these options changed: a lower bound of the error."""

    options: dict[str, Any]
    assumes: str


class Hindsight(Strict):
    """What a clairvoyant would do at some prices; ``width`` is that of its beam search."""

    prices: tuple[Rate, ...] = pydantic.Field(min_length=1)
    width: Positive = 32


class Setting(Strict):
    """One environment in one setting; ``families`` are labels, all of them by default.

    ``informed`` are policies that know the model and all new signals, ``references`` computed
    ones that know no more than the centre. ``longer`` multiplies the length of its trainings,
    ``price_exponent`` and ``algorithm`` replace the suite's.
    """

    name: str = pydantic.Field(pattern=r"^[a-z0-9_]+$")
    title: str
    environment: EnvironmentConfig
    price_range: tuple[Rate, Rate]
    families: tuple[str, ...] | None = None
    points: tuple[str, ...] = ("always", "never")
    informed: tuple[str, ...] = ()
    references: tuple[str, ...] = ()
    longer: float = pydantic.Field(default=1.0, gt=0)
    price_exponent: Share | None = None
    algorithm: dict[str, Any] = pydantic.Field(default_factory=dict)
    genie: Genie | None = None
    hindsight: Hindsight | None = None


class Suite(Strict):
    """The whole benchmark."""

    episodes: Positive = 1000
    seed: int = pydantic.Field(default=0, ge=0)
    training_seeds: Positive = 5
    timesteps: Positive = 4_000_000
    num_envs: Positive = 256
    prices: Positive = 7
    price_exponent: Share = 0.5
    hindsight_episodes: Positive = 100
    modes: tuple[Mode, ...] = ("sensors", "centre", "local")
    tuning: Tuning = Tuning()
    algorithm: AnyAlgorithm
    families: tuple[Family, ...]
    settings: tuple[Setting, ...]

    def algorithm_of(self, setting: Setting) -> AlgorithmConfig:
        """The setting's algorithm, checked again.

        Raises:
            ValueError: a hyper-parameter that is unknown or not allowed.
        """
        return settings(self.algorithm.model_dump() | setting.algorithm)

    def families_of(self, setting: Setting) -> list[Family]:
        """The setting's baselines."""
        names = setting.families
        return [f for f in self.families if names is None or f.label in names]

    @pydantic.model_validator(mode="after")
    def _named(self) -> Suite:
        labels = [family.label for family in self.families]
        for setting in self.settings:
            self.algorithm_of(setting)
            for name in setting.families or ():
                if name not in labels:
                    raise ValueError(f"families of {setting.name}: {name!r} is none of {labels}")
        return self


# What --quick changes: the same work, less of it.
QUICK: dict[str, Any] = {
    "episodes": 200,
    "training_seeds": 1,
    "timesteps": 600_000,
    "prices": 5,
    "hindsight_episodes": 10,
    "tuning": {"trials": 10, "episodes": 60, "kept": 8},
}


def load_suite(path: str | Path, quick: bool = False) -> Suite:
    """The benchmark's config, or its quick version.

    Raises:
        ConfigurationError: unreadable, an unknown key, or a value that is not allowed.
    """
    plain = read_yaml(path)
    changed = quick and isinstance(plain, dict)  # all else is refused
    return parse(Suite, plain | QUICK if changed else plain, str(path))
