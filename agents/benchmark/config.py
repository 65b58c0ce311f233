"""The one description of the experiments: settings, rules, agents, and cases."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
import pydantic

from fusion_gym.envs.registration import make_task
from fusion_gym.training.algorithms import AlgorithmConfig, AnyAlgorithm, settings
from fusion_gym.training.checked import Positive, Rate, Share, Strict, parse, read_yaml
from fusion_gym.training.config import EnvironmentConfig
from fusion_gym.validation import ConfigurationError

Mode = Literal["sensors", "centre", "local"]
Broadcast = Literal["none", "estimate", "packets"]
Packet = Literal["measurement", "estimate"]
Error = Literal["squared", "excess", "mismatch"]
Longer = Annotated[float, pydantic.Field(gt=0)]


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
    """A rule with parameters to tune; ``policy`` may fix others (``paced:rate=0.1``).

    ``tuned_in`` says where: ``"setting"`` once in each setting, for what the rule looks at depends
    neither on memory nor on what is broadcast; ``"sensors"`` or ``"local"`` anew in each class of
    the scheduler or of sensors that decide by themselves, for it does.
    """

    label: str
    policy: str
    parameters: dict[str, Range | Choices]
    tuned_in: Literal["setting", "sensors", "local"] = "setting"


class Tuning(Strict):
    """One budget of trials for every rule, on seeds that no test uses.

    Each of ``seeds`` searches runs by itself, on ``episodes`` episodes of its own from ``seed`` on:
    ``trials`` policies over the whole range, then ``refined`` at each of ``prices`` prices of the
    setting's range, for the least error plus price times tokens, both times the number of
    parameters, 3 at most (one for each sensor counts as many). The policies on a search's lower
    envelope, and those within ``near`` (a share of the error) of it up to ``finalists`` in all, are
    run again on the episodes of all searches.
    """

    trials: Positive = 12
    prices: Positive = 8
    refined: Positive = 1
    episodes: Positive = 80
    seeds: Positive = 3
    seed: int = pydantic.Field(default=600_000_000, ge=0)
    near: Share = 0.02
    finalists: Positive = 8


class Genie(Strict):
    """A system that always receives, with these options changed: a lower bound of the error."""

    options: dict[str, Any]
    assumes: str


class Hindsight(Strict):
    """What a clairvoyant would do at some prices; ``width`` is that of its beam search."""

    prices: tuple[Rate, ...] = pydantic.Field(min_length=1)
    width: Positive = 32


class Case(Strict):
    """Other options of a setting: ``options`` as they are, ``scaled`` ones by a factor."""

    name: str = pydantic.Field(pattern=r"^[a-z0-9_]+$")
    title: str
    options: dict[str, Any] = pydantic.Field(default_factory=dict)
    scaled: dict[str, Rate] = pydantic.Field(default_factory=dict)


NOMINAL = Case(name="as_assumed", title="as assumed")  # the case without a perturbation


class Setting(Strict):
    """One environment in one setting; ``families`` are labels, all of them by default.

    ``informed`` are policies that know the model and all new signals, ``references`` computed
    ones that know no more than the centre. ``broadcasts`` are what a sensor by itself may hear, by
    rising knowledge, the environment's default first; with ``estimates`` there is a class of
    schedulers whose packets hold the estimate. ``known`` are policies that earlier searches
    found: they compete with what the search finds, as if every tuning seed had found them.

    ``agents`` are the classes in which agents are trained, by name (all by default), and
    ``agent_options`` tell them what rules know anyway. ``longer`` multiplies the length of their
    trainings, ``lengths`` those of one mode or class; ``price_exponent``, ``num_envs``, ``error``
    and ``tuning`` replace the suite's, ``envs`` the number of environments of one mode or class;
    ``algorithm`` changes entries of the suite's, ``algorithms`` those of one mode; ``pace`` is
    about how many steps a second they train, for the time that is told to remain.

    ``cases`` are perturbed cases: names of the suite's, or cases of its own. ``drawn`` are options
    that agents trained over draws have: pairs, drawn anew in every episode.
    """

    name: str = pydantic.Field(pattern=r"^[a-z0-9_]+$")
    title: str
    environment: EnvironmentConfig
    price_range: tuple[Rate, Rate]
    families: tuple[str, ...] | None = None
    points: tuple[str, ...] = ("always", "never")
    known: tuple[str, ...] = ()
    informed: tuple[str, ...] = ()
    references: tuple[str, ...] = ()
    longer: Longer = 1.0
    lengths: dict[str, Longer] = pydantic.Field(default_factory=dict)
    price_exponent: Share | None = None
    num_envs: Positive | None = None
    envs: dict[str, Positive] = pydantic.Field(default_factory=dict)
    error: Error | None = None
    agents: tuple[str, ...] | None = None
    agent_options: dict[str, Any] = pydantic.Field(default_factory=dict)
    algorithm: dict[str, Any] = pydantic.Field(default_factory=dict)
    algorithms: dict[Mode, dict[str, Any]] = pydantic.Field(default_factory=dict)
    pace: Positive = 10_000
    tuning: dict[str, Any] = pydantic.Field(default_factory=dict)
    broadcasts: tuple[Broadcast, ...] = pydantic.Field(default=("none",), min_length=1)
    estimates: bool = False
    genie: Genie | None = None
    hindsight: Hindsight | None = None
    cases: tuple[str | Case, ...] = ()
    drawn: dict[str, Any] = pydantic.Field(default_factory=dict)

    def with_options(self, options: dict[str, Any]) -> Setting:
        """Return the setting with these options of the environment in the place of its own."""
        environment = self.environment.model_copy(update={"options": options})
        return self.model_copy(update={"environment": environment})


class Suite(Strict):
    """The whole benchmark; ``classes`` are those in which agents are trained, by name (all).

    Settings name ``cases``, in each of which a policy runs ``robustness_episodes`` episodes.
    ``quick`` has what the quick version changes.
    """

    episodes: Positive = 1000
    seed: int = pydantic.Field(default=0, ge=0)
    training_seeds: Positive = 5
    timesteps: Positive = 4_000_000
    num_envs: Positive = 256
    prices: Positive = 7
    price_exponent: Share = 0.5
    hindsight_episodes: Positive = 100
    robustness_episodes: Positive = 300
    error: Error = "squared"
    classes: tuple[str, ...] | None = None
    tuning: Tuning = Tuning()
    algorithm: AnyAlgorithm
    algorithms: dict[Mode, dict[str, Any]] = pydantic.Field(default_factory=dict)
    families: tuple[Family, ...]
    cases: tuple[Case, ...] = ()
    quick: dict[str, Any] = pydantic.Field(default_factory=dict)
    settings: tuple[Setting, ...]

    def algorithm_of(self, setting: Setting, mode: Mode) -> AlgorithmConfig:
        """The algorithm of a setting's agents of a mode, checked again.

        Raises:
            ValueError: a hyper-parameter that is unknown or not allowed.
        """
        of_mode = self.algorithms.get(mode, {}) | setting.algorithms.get(mode, {})
        return settings(self.algorithm.model_dump() | setting.algorithm | of_mode)

    def num_envs_of(self, setting: Setting, name: str, mode: Mode) -> int:
        """Environments side by side in a training of a class."""
        own = setting.envs.get(name, setting.envs.get(mode))
        return own or setting.num_envs or self.num_envs

    def timesteps_of(self, setting: Setting, name: str, mode: Mode) -> int:
        """Steps of a training of a class; where sensors decide by themselves, of all their rows."""
        length = setting.lengths.get(name, setting.lengths.get(mode, 1.0))
        return round(self.timesteps * setting.longer * length)

    def tuning_of(self, setting: Setting) -> Tuning:
        """The setting's budget of tuning, checked again.

        Raises:
            ValueError: an entry that is unknown or not allowed.
        """
        return Tuning(**(self.tuning.model_dump() | setting.tuning))

    def families_of(self, setting: Setting) -> list[Family]:
        """The setting's baselines."""
        names = setting.families
        return [f for f in self.families if names is None or f.label in names]

    def cases_of(self, setting: Setting) -> list[Case]:
        """Return a setting's cases, the nominal one first.

        Raises:
            ValueError: one that the suite does not have, or two of one name.
        """
        shared = {case.name: case for case in self.cases}
        for case in setting.cases:
            if isinstance(case, str) and case not in shared:
                raise ValueError(f"cases of {setting.name}: {case!r} is none of {list(shared)}")
        own = [shared[case] if isinstance(case, str) else case for case in setting.cases]
        names = [case.name for case in (NOMINAL, *own)]
        if len(set(names)) < len(names):
            raise ValueError(f"cases of {setting.name} must differ: {names}")
        return [NOMINAL, *own]

    @pydantic.model_validator(mode="after")
    def _named(self) -> Suite:
        labels = [family.label for family in self.families]
        if len(set(labels)) < len(labels):
            raise ValueError(f"labels of families must differ: {labels}")
        for setting in self.settings:
            for mode in get_args(Mode):
                self.algorithm_of(setting, mode)
            self.tuning_of(setting)
            self.cases_of(setting)
            for name in setting.families or ():
                if name not in labels:
                    raise ValueError(f"families of {setting.name}: {name!r} is none of {labels}")
        return self


def load_suite(path: str | Path, quick: bool = False, **changes: Any) -> Suite:
    """Return the benchmark's description or its quick version, with ``changes`` of its entries.

    Raises:
        ConfigurationError: unreadable, an unknown key, or a value that is not allowed.
    """
    content = read_yaml(path)
    if isinstance(content, dict):  # all else is refused
        content |= changes
    suite = parse(Suite, content, str(path))
    if quick and not suite.quick:
        raise ConfigurationError(
            f"quick = True is not allowed with config {str(path)!r}, which has no quick"
        )
    return parse(Suite, _merge(content, suite.quick) | changes, str(path)) if quick else suite


def _merge(content: dict[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content with the changes, those within an entry as well."""
    result = dict(content)
    for key, value in changes.items():
        within = isinstance(value, dict) and isinstance(content.get(key), dict)
        result[key] = _merge(content[key], value) if within else value
    return result


def world(setting: Setting, case: Case) -> Setting:
    """Return the setting as it is in a case.

    Raises:
        ConfigurationError: an option that is scaled and is no number.
    """
    options = dict(setting.environment.options)
    defaults = make_task(setting.environment.id).settings
    for name, factor in case.scaled.items():
        value = options.get(name, defaults.get(name))
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ConfigurationError(
                f"scaled = {{{name!r}: {factor:g}}} of the case {case.name!r} is not allowed: "
                f"{name} of {setting.name} must be a number, and is {value!r}"
            )
        options[name] = value * factor
    return setting.with_options(options | case.options)


def front_prices(price_range: tuple[float, float], count: int) -> list[float]:
    """Prices over the whole range, evenly in the logarithm, both ends exactly."""
    low, high = price_range
    return [min(max(float(price), low), high) for price in np.geomspace(low, high, count)]
