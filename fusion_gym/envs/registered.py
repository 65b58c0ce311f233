"""Base of the registered environments: a ``build`` function from options to a task, two faces."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

from gymnasium.vector import AutoresetMode

from fusion_gym.core.task import Task
from fusion_gym.envs.single import FusionEnv
from fusion_gym.envs.vector import FusionVectorEnv


class RegisteredEnv(FusionEnv):
    """The single environment of :attr:`build`; keyword arguments are its options.

    Raises:
        ConfigurationError: an unknown option, or a value that is not allowed.
    """

    build: ClassVar[Callable[..., Task]]

    def __init__(self, render_mode: str | None = None, **options: Any) -> None:
        super().__init__(type(self).build(**options), render_mode)


class RegisteredVectorEnv(FusionVectorEnv):
    """The vector environment of :attr:`build`; further keyword arguments are its options.

    Raises:
        ConfigurationError: an unknown option, or a value that is not allowed.
    """

    build: ClassVar[Callable[..., Task]]

    def __init__(
        self,
        num_envs: int = 1,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        super().__init__(type(self).build(**options), num_envs, autoreset_mode, render_mode)
