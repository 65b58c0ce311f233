"""The registered environments: an id stands for a ``build`` function from options to a scenario."""

import copy
import importlib
import inspect
import re
import typing
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec, parse_env_id

from fusion_gym import validation
from fusion_gym.core.options import CommonOptions, Scenario
from fusion_gym.core.rehearsal import rehearse
from fusion_gym.core.scale import resolve
from fusion_gym.core.task import Task
from fusion_gym.envs.option_file import read_options
from fusion_gym.envs.option_text import Option, list_options, options_in
from fusion_gym.importing import imported, name_of
from fusion_gym.validation import ConfigurationError

Build = Callable[[Any], Scenario]
_REGISTERED = "fusion_gym.envs.registered"
_CLASSES = ("Env", "VectorEnv")
_VERSION = re.compile(r"(?<=^fusion_gym/)(\w+)-v\d+$")


class FusionSpec(EnvSpec):
    """What Gymnasium knows of an environment, and every option with its type and default.

    ``gymnasium.spec(id).pprint()`` lists them, ``env.unwrapped.spec.pprint()`` also what was given.
    """

    @classmethod
    def of(cls, spec: EnvSpec) -> EnvSpec:
        """A copy of what Gymnasium knows, of this kind where the environment is registered."""
        try:
            base_of(spec.id)
        except ConfigurationError:
            return copy.copy(spec)
        known = {field.name: getattr(spec, field.name) for field in fields(spec) if field.init}
        return cls(**known)

    @property
    def options(self) -> dict[str, Option]:
        """Type and default of every option, by its name."""
        return options_in(options_of(self.id))

    def pprint(
        self,
        disable_print: bool = False,
        include_entry_points: bool = False,
        print_all: bool = False,
    ) -> str | None:
        """See Gymnasium's; the options follow."""
        lines = [f"    {option}" for option in list_options(self.options, self.kwargs)]
        text = super().pprint(True, include_entry_points, print_all)
        text = "\n".join([f"{text}", "options:", *lines])
        if disable_print:
            return text
        print(text)
        return None


ENVIRONMENTS: dict[str, str | Build] = {
    "fusion_gym/TobitOscillator-v1": "fusion_gym.systems.tobit.oscillator:build_tobit",
    "fusion_gym/CorrelatedTracking-v1": "fusion_gym.systems.correlated.environment:build_adaptive",
    "fusion_gym/MarkovJumpTracking-v1": "fusion_gym.systems.markov_jump.environment:build_markov",
    "fusion_gym/UnknownInput-v1": "fusion_gym.systems.unknown_input.environment:build_unknown",
    "fusion_gym/BiasedOscillator-v1": "fusion_gym.systems.tobit.biased:build_biased_oscillator",
    "fusion_gym/BiasedTracking-v1": "fusion_gym.systems.tobit.biased:build_biased_tracking",
    "fusion_gym/LinearFusion-v2": "fusion_gym.systems.tobit.linear:build_linear",
    "fusion_gym/RemoteEstimation-v1": "fusion_gym.systems.remote.environment:build_remote",
}


def class_name(env_id: str) -> str:
    """Name of an environment's class in :mod:`fusion_gym.envs.registered`, without the ending.

    ``fusion_gym/TobitOscillator-v1`` is TobitOscillator, ``mine/Tank-v1`` mine_Tank_v1.
    """
    own = _VERSION.sub(r"\1", env_id).removeprefix("fusion_gym/")
    return own if own.isidentifier() else "".join(c if c.isalnum() else "_" for c in env_id)


def register(env_id: str | None = None, build: str | Build | None = None) -> None:
    """Register an environment of your own with Gymnasium, or (no arguments) all of this suite.

    ``build`` takes one argument, annotated with a dataclass that extends
    :class:`~fusion_gym.core.options.CommonOptions`, and returns a
    :class:`~fusion_gym.core.options.Scenario`; ``"module:function"`` names one that is imported
    when it is needed (and by worker processes). After that ``gym.make``, ``gym.make_vec``,
    :func:`make_task` and all faces know ``env_id``.

    Raises:
        ConfigurationError: an id without a build function, or one that is taken.
        gymnasium.error.Error: an id of another form than Gymnasium's.
    """
    if env_id is not None:
        if build is None:
            raise validation.refusal("build", None, "a function or its name", f"for {env_id!r}")
        parse_env_id(str(env_id))
        if ENVIRONMENTS.get(env_id, build) != build:
            raise ConfigurationError(
                f"env_id = {env_id!r} is not allowed: it is registered already"
            )
        ENVIRONMENTS[env_id] = build
    for name in ENVIRONMENTS:
        if name not in gymnasium.registry:
            single, vector = (f"{_REGISTERED}:{class_name(name)}{end}" for end in _CLASSES)
            gymnasium.register(name, entry_point=single, vector_entry_point=vector)
            gymnasium.registry[name] = FusionSpec(name, single, vector_entry_point=vector)


def id_of(name: str) -> str | None:
    """The id whose class in :mod:`fusion_gym.envs.registered` has this name."""
    classes = {f"{class_name(env_id)}{end}": env_id for env_id in ENVIRONMENTS for end in _CLASSES}
    return classes.get(name)


def present_id(name: str) -> str:
    """Return the present id of an environment's name or earlier id, or else the name."""
    return {class_name(env_id): env_id for env_id in ENVIRONMENTS}.get(class_name(name), name)


def base_of(env_id: str) -> tuple[str, dict[str, Any]]:
    """Return the environment of this suite behind an id, and the options of its registration.

    ``module:id`` imports a module first, which registers the id. ``gymnasium.register`` may give an
    id to a class of :mod:`fusion_gym.envs.registered`: its ``kwargs`` and ``max_episode_steps`` are
    the options.

    Raises:
        ConfigurationError: an unknown id, a module that cannot be imported, an entry point that is
            no such class, or additional wrappers.
    """
    if not isinstance(env_id, str):
        raise validation.refusal("env", env_id, "the id of an environment")
    module, colon, name = env_id.rpartition(":")
    if colon:
        imported("env", env_id, module)
    if name not in gymnasium.registry and (present := present_id(name)) != name:
        raise validation.refusal("environment", name, f"{present!r}, its present version")
    if name in ENVIRONMENTS or name not in gymnasium.registry:
        validation.keys("environment", [name], ENVIRONMENTS)
        return name, {}
    spec = gymnasium.registry[name]
    entry = spec.entry_point or spec.vector_entry_point
    text = entry if isinstance(entry, str) else name_of(entry)
    base = id_of(text.removeprefix(f"{_REGISTERED}:"))
    if base is None or spec.additional_wrappers:
        reason = "additional wrappers" if base else f"the entry point {text!r}"
        raise ConfigurationError(
            f"environment {name!r} is not allowed: it is registered with {reason}; it must be a "
            f"class of {_REGISTERED} without wrappers"
        )
    options = {key: value for key, value in spec.kwargs.items() if key != "render_mode"}
    if spec.max_episode_steps is not None:
        options["max_episode_steps"] = spec.max_episode_steps
    return base, options


def build_of(env_id: str) -> Build:
    """The ``build`` function behind an id.

    Raises:
        ConfigurationError: an id that :func:`base_of` does not know.
    """
    entry = ENVIRONMENTS[base_of(env_id)[0]]
    if not isinstance(entry, str):
        return entry
    module, _, name = entry.partition(":")
    member: Build = getattr(importlib.import_module(module), name)
    return member


def options_of(env_id: str) -> type[CommonOptions]:
    """The dataclass of an environment's options, with their defaults.

    Raises:
        ConfigurationError: an unknown id, or a build function whose argument is not annotated with
            such a dataclass.
    """
    build = build_of(env_id)
    first = next(iter(inspect.signature(build).parameters), "")
    kind = typing.get_type_hints(build).get(first)
    if not (isinstance(kind, type) and issubclass(kind, CommonOptions)):
        raise ConfigurationError(
            f"build of {env_id!r} is not allowed: its argument must be annotated with a dataclass "
            "that extends CommonOptions"
        )
    return kind


def make_task(env: str | CommonOptions, /, **options: Any) -> Task:
    """The task of a registered environment, everything checked before anything runs.

    ``env`` is an id, or ``module:id`` of one that a module registers, also by
    ``gymnasium.register`` with an environment's class of this suite; to it ``options`` and what
    every environment takes are added, or an options object such as
    :class:`~fusion_gym.systems.tobit.oscillator.TobitOscillatorOptions`. Every environment takes
    ``max_episode_steps``, and ``system``, the path of a YAML file of options, which those beside it
    replace.

    Raises:
        ConfigurationError: an id that is not registered, an unknown option, or a value that is
            not allowed.
    """
    validation.limit_options(options)
    if isinstance(env, str):
        env, registered = base_of(env)
        options = registered | options
    limit = options.pop("max_episode_steps", None)
    if limit is not None:
        limit = validation.integer("max_episode_steps", limit, at_least=1)
    if isinstance(env, CommonOptions):
        validation.keys("option beside an options object", options, [])
        env_id = next((name for name in ENVIRONMENTS if options_of(name) is type(env)), None)
        if env_id is None:
            raise ConfigurationError(
                f"options of type {type(env).__name__} are not allowed: they belong to none of the "
                "registered environments"
            )
        return _checked(build_of(env_id), env, limit)
    kind, options = options_of(env), open_options(env, options)
    validation.arguments(env, options, [field.name for field in fields(kind)])
    return _checked(build_of(env), kind(**options), limit)


def open_options(env_id: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """The options of an environment with those of the file that ``system`` names, if it does.

    What the id's own registration says goes before the file.

    Raises:
        ConfigurationError: an id that is not registered, or a file that cannot be read.
    """
    base, registered = base_of(env_id)
    if "system" not in options or "system" in {field.name for field in fields(options_of(base))}:
        return dict(options)
    beside = {name: value for name, value in options.items() if name != "system"}
    content = read_options(options["system"])
    return {name: content[name] for name in content if name not in registered} | beside


def _checked(build: Build, options: CommonOptions, limit: int | None) -> Task:
    """The task, rehearsed if options were given, which an error names in any case.

    A default may be what does not fit beside them, as the 2 entries of ``initial_mean`` beside a
    ``transition`` of 3 states.
    """
    args = {
        field.name: value
        for field in fields(options)
        if (value := getattr(options, field.name)) is not field.default
    }
    try:
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):  # results are checked
            options, nominal_error = resolve(options, build)
            task = Task.create(build(options), limit, nominal_error)
            if args:
                rehearse(task)
    except ConfigurationError as error:
        if not args or any(re.search(rf"\b{name}(\[\d+\])? ?=", str(error)) for name in args):
            raise
        listed = ", ".join(f"{name} = {validation.display(value)}" for name, value in args.items())
        raise ConfigurationError(f"{error} (given: {listed})") from None
    return task
