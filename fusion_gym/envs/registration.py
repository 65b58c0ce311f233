"""The registered environments: an id names a ``build`` function from options to a scenario."""

import copy
import inspect
import json
import os
import pkgutil
import re
import typing
from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec, parse_env_id

from fusion_gym import validation
from fusion_gym.core.scale import rehearse, resolve
from fusion_gym.core.task import CommonOptions, Scenario, Task
from fusion_gym.entries import Options
from fusion_gym.envs.option_text import Option, list_options, options_in
from fusion_gym.envs.returns import reward_threshold
from fusion_gym.errors import forbidden, refusal
from fusion_gym.importing import imported, name_of
from fusion_gym.validation import ConfigurationError

Build = Callable[[Any], Scenario]
_REHEARSED: set[tuple[Any, ...]] = set()  # inputs of tasks that passed the rehearsal
_REGISTERED = "fusion_gym.envs.registered"
_CLASSES = ("Env", "VectorEnv")
_VERSION = re.compile(r"(?<=^fusion_gym/)(\w+)-v\d+$")


class FusionSpec(EnvSpec):
    """Gymnasium's specification with the type and default of every option."""

    @classmethod
    def from_spec(cls, spec: EnvSpec) -> EnvSpec:
        """Return a copy of a specification, a ``FusionSpec`` if this suite has the environment."""
        try:
            base_of(spec.id)
        except ConfigurationError:
            return copy.copy(spec)
        known = {field.name: getattr(spec, field.name) for field in fields(spec) if field.init}
        return cls(**known)

    @property
    def options(self) -> dict[str, Option]:
        """Type and default of every option by name."""
        return options_in(options_of(self.id))

    def pprint(
        self,
        disable_print: bool = False,
        include_entry_points: bool = False,
        print_all: bool = False,
    ) -> str | None:
        """Print Gymnasium's text and the options, or return it with ``disable_print``."""
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
    "fusion_gym/BiasedOscillator-v2": "fusion_gym.systems.tobit.biased:build_biased_oscillator",
    "fusion_gym/BiasedTracking-v1": "fusion_gym.systems.tobit.biased:build_biased_tracking",
    "fusion_gym/LinearFusion-v2": "fusion_gym.systems.tobit.linear:build_linear",
    "fusion_gym/RecordedFusion-v1": "fusion_gym.recordings.environment:build_recorded",
    "fusion_gym/RemoteEstimation-v1": "fusion_gym.systems.remote.environment:build_remote",
    "fusion_gym/GymnasiumEnvironment-v1": "fusion_gym.envs.gymnasium_environment:build_gymnasium",
}


def class_name(env_id: str) -> str:
    """Return the class name of an id in :mod:`fusion_gym.envs.registered`, without the suffix."""
    own = _VERSION.sub(r"\1", env_id).removeprefix("fusion_gym/")
    return own if own.isidentifier() else "".join(c if c.isalnum() else "_" for c in env_id)


def register(env_id: str | None = None, build: str | Build | None = None) -> None:
    """Register an environment with Gymnasium, or without arguments all environments of this suite.

    Afterwards ``gym.make``, ``gym.make_vec``, :func:`make_task` and all interfaces accept the id.

    Args:
        env_id: Id of the environment, such as ``"mine/Tank-v0"``.
        build: Function from an options object to a :class:`~fusion_gym.core.task.Scenario`, or
            its ``"module:function"``, which worker processes can import. The annotation of its
            argument is a dataclass that extends :class:`~fusion_gym.core.task.CommonOptions`.

    Raises:
        ConfigurationError: ``build`` is missing, or the id is already registered.
        gymnasium.error.Error: The id does not have Gymnasium's form.

    Example:
        >>> import fusion_gym
        >>> from fusion_gym.systems.tobit.linear import build_linear
        >>> fusion_gym.register("mine/Linear-v0", build_linear)
        >>> fusion_gym.make_task("mine/Linear-v0", horizon=20).horizon
        20
    """
    if env_id is not None:
        if build is None:
            raise validation.refusal("build", None, "a function or its name", f"for {env_id!r}")
        parse_env_id(str(env_id))
        if ENVIRONMENTS.get(env_id, build) != build:
            raise forbidden("env_id", env_id, "it is registered already")
        ENVIRONMENTS[env_id] = build
    for name in ENVIRONMENTS:
        if name not in gymnasium.registry:
            single, vector = (f"{_REGISTERED}:{class_name(name)}{end}" for end in _CLASSES)
            gymnasium.register(name, entry_point=single, vector_entry_point=vector)
            threshold = reward_threshold(name)
            gymnasium.registry[name] = FusionSpec(
                name, single, threshold, vector_entry_point=vector
            )


def id_of(name: str) -> str | None:
    """Return the id whose class in :mod:`fusion_gym.envs.registered` has this name, or ``None``."""
    classes = {f"{class_name(env_id)}{end}": env_id for env_id in ENVIRONMENTS for end in _CLASSES}
    return classes.get(name)


def present_id(name: str) -> str:
    """Return the present id of an environment's name or earlier id, or else the name."""
    return {class_name(env_id): env_id for env_id in ENVIRONMENTS}.get(class_name(name), name)


def base_of(env_id: str) -> tuple[str, Options]:
    """Return the environment of this suite behind an id, and the options of its registration.

    Args:
        env_id: Id of this suite, id that ``gymnasium.register`` gives to a class of
            :mod:`fusion_gym.envs.registered`, or ``module:id`` with a module to import first.

    Raises:
        ConfigurationError: The id is unknown, its module cannot be imported, or its entry point is
            another class or has wrappers.
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
    """Return the ``build`` function behind an id."""
    entry = ENVIRONMENTS[base_of(env_id)[0]]
    build: Build = pkgutil.resolve_name(entry) if isinstance(entry, str) else entry
    return build


def options_of(env_id: str) -> type[CommonOptions]:
    """Return the dataclass of an environment's options."""
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
    """Return the checked task of a registered environment.

    Args:
        env: Id, ``module:id`` with a module to import first, or an options object such as
            :class:`~fusion_gym.systems.tobit.oscillator.TobitOscillatorOptions`.
        **options: Options of the id. Every id takes ``max_episode_steps`` and ``system``, the path
            of a YAML file of options, which the other arguments replace. An options object takes
            ``max_episode_steps`` only.

    Raises:
        ConfigurationError: The id or an option is unknown, or a value is not allowed.

    Example:
        >>> import fusion_gym
        >>> task = fusion_gym.make_task("fusion_gym/TobitOscillator-v1", horizon=50)
        >>> task.horizon, task.sensors, task.plant.state_names
        (50, 3, ('x1', 'x2'))
    """
    validation.limit_options(options)
    if isinstance(env, str):
        env, registered = base_of(env)
        options = registered | options
    limit = options.pop("max_episode_steps", None)
    if limit is not None:
        limit = validation.integer("max_episode_steps", limit, at_least=1)
    if isinstance(env, CommonOptions):
        validation.keys("option together with an options object", options, [])
        env_id = next((name for name in ENVIRONMENTS if options_of(name) is type(env)), None)
        if env_id is None:
            raise ConfigurationError(
                f"options of type {type(env).__name__} are not allowed: they belong to no "
                "registered environment"
            )
        return _checked(build_of(env_id), env, limit)
    kind, options = options_of(env), open_options(env, options)
    validation.arguments(env, options, [field.name for field in fields(kind)])
    return _checked(build_of(env), kind(**options), limit)


def open_options(env_id: str, options: Mapping[str, Any]) -> Options:
    """Return the options with the entries of the file ``system``.

    Args:
        env_id: Id of the environment; options of its registration precede the file.
        options: Options of a call, which replace entries of the file.

    Raises:
        ConfigurationError: The id is unknown, or the file cannot be read.
    """
    base, registered = base_of(env_id)
    if "system" not in options or "system" in {field.name for field in fields(options_of(base))}:
        return dict(options)
    beside = dict(options)
    path = beside.pop("system")
    if not isinstance(path, (str, os.PathLike)):
        raise refusal("system", path, "the path of a YAML file")
    from fusion_gym.yaml_text import load_yaml

    content = load_yaml("system", Path(path))
    if not (isinstance(content, dict) and all(isinstance(key, str) for key in content)):
        raise ConfigurationError(
            f"system = {os.fspath(path)!r} is not allowed: it must hold a mapping of options"
        )
    return {name: content[name] for name in content if name not in registered} | beside


def _plain_text(args: Options) -> str | None:
    """Return options as text that determines them, or ``None`` if they hold objects."""
    try:
        return json.dumps(args, default=lambda value: value.tolist())
    except (AttributeError, TypeError, ValueError):
        return None


def _checked(build: Build, options: CommonOptions, limit: int | None) -> Task:
    """Return the task, rehearsed if options differ from their defaults; errors list them."""
    args = {
        field.name: value
        for field in fields(options)
        if (value := getattr(options, field.name)) is not field.default
    }
    try:
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):  # results are checked
            options, nominal_error = resolve(options, build)
            task = Task.create(build(options), limit, nominal_error)
            inputs = build, limit, _plain_text(args)
            if args and inputs not in _REHEARSED:
                rehearse(task)
                if inputs[-1] is not None:
                    _REHEARSED.add(inputs)
    except ConfigurationError as error:
        if not args or any(re.search(rf"\b{name}(\[\d+\])? ?=", str(error)) for name in args):
            raise
        listed = ", ".join(f"{name} = {validation.display(value)}" for name, value in args.items())
        raise ConfigurationError(f"{error} (given: {listed})") from None
    return task
