"""The environment of a command, from ``--env``, ``--set`` and ``--config``."""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING, Any

from fusion_gym.policies.settings import parse_settings
from fusion_gym.validation import ConfigurationError

if TYPE_CHECKING:
    from fusion_gym.training.config import Experiment


def environment_of(
    env: str | None, config: str | None, settings: tuple[tuple[str, ...], ...]
) -> tuple[str, dict[str, Any], Experiment | None]:
    """Return id, options and training of a command line; ``settings`` override the config."""
    options = parse_settings("option", list(chain(*settings)))
    if config is None:
        if env is None:
            raise ConfigurationError("env = None is not allowed: give --env ID or --config FILE")
        return env, options, None
    # Imported here, because Stable-Baselines3 takes seconds to load.
    from fusion_gym.training.checked import load_checked
    from fusion_gym.training.config import Experiment

    experiment = load_checked(Experiment, config)
    environment = experiment.environment
    return env or environment.id, dict(environment.options) | options, experiment
