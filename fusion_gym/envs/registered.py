"""The classes of the registered environments, made from their options on first access.

``gym.make`` and ``gym.make_vec`` instantiate ``TobitOscillatorEnv`` and
``TobitOscillatorVectorEnv`` for ``fusion_gym/TobitOscillator-v1``; ``help`` shows every option.
"""

import inspect
from typing import Any

from gymnasium.vector import AutoresetMode

from fusion_gym.envs.option_text import options_in
from fusion_gym.envs.pages import page
from fusion_gym.envs.registration import id_of, make_task, options_of
from fusion_gym.envs.single import FusionEnv
from fusion_gym.envs.vector import FusionVectorEnv


class _Page:
    """A docstring that is written on first access, for an object from its own task."""

    def __init__(self, env_id: str) -> None:
        self._env_id = env_id

    def __get__(self, env: FusionEnv | FusionVectorEnv | None, owner: type) -> str:
        return page(self._env_id, None if env is None else env.task)


def __getattr__(name: str) -> type:
    """Return the environment class of this name, and cache it."""
    env_id = id_of(name)
    if env_id is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    result = _vector(env_id) if name.endswith("VectorEnv") else _single(env_id)
    result.__name__ = result.__qualname__ = name
    globals()[name] = result
    return result


def _single(env_id: str) -> type:
    def __init__(self: FusionEnv, /, render_mode: str | None = None, **options: Any) -> None:
        FusionEnv.__init__(self, make_task(env_id, **options), render_mode)

    return _environment_class(env_id, FusionEnv, __init__)


def _vector(env_id: str) -> type:
    def __init__(
        self: FusionVectorEnv,
        /,
        num_envs: int = 1,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        task = make_task(env_id, **options)
        FusionVectorEnv.__init__(self, task, num_envs, autoreset_mode, render_mode)

    return _environment_class(env_id, FusionVectorEnv, __init__)


def _environment_class(env_id: str, base: type, init: Any) -> type:
    """Return a class whose signature shows every option with its default."""
    own = list(inspect.signature(init).parameters.values())[:-1]
    named = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)
        for name, (kind, default, *_) in options_in(options_of(env_id)).items()
    ]
    init.__signature__ = inspect.Signature([*own, *named])
    body = {"__init__": init, "__module__": __name__, "__doc__": _Page(env_id)}
    return type(base.__name__, (base,), body)
