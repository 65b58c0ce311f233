"""The config of perturbed cases: how far the truth departs from what rules and agents assume."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pydantic

from fusion_gym.envs.registration import make_task
from fusion_gym.validation import ConfigurationError, choice

from ..training.checked import Rate, Strict, load_checked
from .config import Setting, load_suite

NOMINAL = "as_assumed"


class Case(Strict):
    """Other options of a setting: ``options`` as they are, ``scaled`` ones by a factor."""

    name: str = pydantic.Field(pattern=r"^[a-z0-9_]+$")
    title: str
    options: dict[str, Any] = pydantic.Field(default_factory=dict)
    scaled: dict[str, Rate] = pydantic.Field(default_factory=dict)


class Perturbed(Strict):
    """The cases of a setting: ``shared`` ones by name, then its ``own``.

    ``drawn`` are options that agents trained over draws have: pairs, drawn anew in every episode.
    """

    setting: str
    shared: tuple[str, ...] = ()
    own: tuple[Case, ...] = ()
    drawn: dict[str, Any] = pydantic.Field(default_factory=dict)


class RobustnessSettings(Strict):
    """Which settings of a suite are tried, and under which cases; the nominal one goes before."""

    suite: str = "benchmark"
    cases: tuple[Case, ...]
    settings: tuple[Perturbed, ...] = pydantic.Field(min_length=1)

    @pydantic.model_validator(mode="after")
    def _named(self) -> RobustnessSettings:
        known = [case.name for case in self.cases]
        for setting in self.settings:
            unknown = [name for name in setting.shared if name not in known]
            if unknown:
                raise ValueError(f"shared of {setting.setting}: {unknown[0]!r} is none of {known}")
            names = [NOMINAL, *setting.shared, *(case.name for case in setting.own)]
            if len(set(names)) < len(names):
                raise ValueError(f"cases of {setting.setting} must differ: {names}")
        return self

    def cases_of(self, setting: Perturbed) -> list[Case]:
        """A setting's cases, the nominal one first."""
        shared = {case.name: case for case in self.cases}
        nominal = Case(name=NOMINAL, title="as assumed")
        return [nominal, *(shared[name] for name in setting.shared), *setting.own]


def load_robustness(path: str | Path) -> RobustnessSettings:
    """The config.

    Raises:
        ConfigurationError: unreadable, an unknown key, or a value that is not allowed.
    """
    return load_checked(RobustnessSettings, path)


def select_settings(config: RobustnessSettings, names: tuple[str, ...]) -> list[Perturbed]:
    """The settings of these names (none: all), each of which the suite has.

    Raises:
        ConfigurationError: one that the config or the suite does not have.
    """
    by_name = {setting.setting: setting for setting in config.settings}
    known = [setting.name for setting in load_suite(config.suite).settings]
    for name in by_name:
        choice("setting", name, known)
    return [by_name[choice("envs", name, by_name)] for name in names or by_name]


def world(setting: Setting, case: Case) -> Setting:
    """The setting as it is in a case.

    Raises:
        ConfigurationError: an option that is scaled and is no number.
    """
    environment, options = setting.environment, dict(setting.environment.options)
    defaults = make_task(environment.id).settings
    for name, factor in case.scaled.items():
        value = options.get(name, defaults.get(name))
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ConfigurationError(
                f"scaled = {{{name!r}: {factor:g}}} of the case {case.name!r} is not allowed: "
                f"{name} of {setting.name} must be a number, and is {value!r}"
            )
        options[name] = value * factor
    return _with_options(setting, options | case.options)


def drawn_world(setting: Setting, perturbed: Perturbed) -> Setting:
    """The setting in which agents are trained over draws."""
    return _with_options(setting, setting.environment.options | perturbed.drawn)


def _with_options(setting: Setting, options: dict[str, Any]) -> Setting:
    environment = setting.environment.model_copy(update={"options": options})
    return setting.model_copy(update={"environment": environment})
