"""The configs of trainings, sweeps and comparisons as typed YAML."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic

from fusion_gym import seeds
from fusion_gym.core.reward import Price
from fusion_gym.entries import Options, Plain
from fusion_gym.envs.registration import open_options
from fusion_gym.training.algorithms import AnyAlgorithm
from fusion_gym.training.checked import Positive, Share, Strict, checked


class EnvironmentConfig(Strict):
    """A registered environment and its options of ``gym.make``.

    ``local`` trains one policy that every sensor runs on its local view. If the option ``system``
    names a file of options, the config includes its content.
    """

    id: str
    options: Options = pydantic.Field(default_factory=dict)
    local: bool = False

    @pydantic.field_validator("options")
    @classmethod
    def _opened(cls, options: Options, info: pydantic.ValidationInfo) -> Options:
        return open_options(info.data["id"], options) if "id" in info.data else options


class TrainingConfig(Strict):
    """Length, number of runs, seed and threads of a training.

    If the price is drawn, an episode has the weight (middle of the range /
    price)^``price_exponent`` in training and validation. A positive exponent raises the weight of
    low prices. With more sensors than ``many_sensors``, ``timesteps`` falls in proportion, because
    a step takes longer.

    ``error`` is the trained error; validations use the true error. ``excess`` and ``mismatch``
    subtract the part that no policy can change, by an estimate from every measurement.
    ``error_filter`` is the filter of this estimate, by default the memory's filter. The mismatch
    has the least noise, and is correct if this estimate is the conditional mean.
    """

    timesteps: Positive
    num_envs: Positive = 256
    seed: int = pydantic.Field(default=0, ge=0, lt=2**32)
    threads: Annotated[int, pydantic.Field(gt=0, le=1024)] = 1
    price_exponent: Share = 0.0
    many_sensors: Positive | None = None
    error: Literal["squared", "excess", "mismatch"] = "squared"
    error_filter: str | None = None


class ValidationConfig(Strict):
    """Evaluation during training, on seeds that neither training nor tests use."""

    every: Positive = 500_000
    episodes: Positive = 256
    seed: int = pydantic.Field(default=seeds.VALIDATION.start, ge=0)


class CalibrationConfig(Strict):
    """Calibration after a training at drawn prices: tuning episodes of the first and last round."""

    episodes: tuple[Positive, Positive] = (16, 400)


class Experiment(Strict):
    """Declare one training.

    Args:
        environment: id, options, and whether the policy is local.
        algorithm: name and settings of the algorithm.
        training: length, number of runs, seed and threads.
        validation: steps between validations, and their episodes.
        calibration: tuning episodes; None for no calibration.
        output: folder of checkpoints, models and validations.

    Raises:
        ConfigurationError: an entry that is unknown or not allowed.

    Example:
        >>> from fusion_gym import Experiment
        >>> experiment = Experiment.model_validate(
        ...     {
        ...         "environment": {"id": "fusion_gym/LinearFusion-v2"},
        ...         "algorithm": {"name": "ppo"},
        ...         "training": {"timesteps": 100_000},
        ...         "output": "runs/ppo",
        ...     }
        ... )
        >>> experiment.algorithm.batch_size, experiment.training.num_envs
        (4096, 256)
    """

    environment: EnvironmentConfig
    algorithm: AnyAlgorithm
    training: TrainingConfig
    validation: ValidationConfig = ValidationConfig()
    calibration: CalibrationConfig | None = CalibrationConfig()
    output: str = pydantic.Field(min_length=1, pattern=r"^[^\n\t]+$")

    def inputs(self) -> Plain:
        """Return the inputs that determine the results, without length, folder and threads."""
        return self.model_dump(
            mode="json",
            exclude={
                "output": True,
                "calibration": True,
                "training": {"timesteps": True, "threads": True},
            },
        )

    def resolved(self, settings: Mapping[str, Any], sensors: int) -> Experiment:
        """Return the experiment with numbers in the place of ``"auto"`` and ``many_sensors``."""
        options, training = self.environment.options, self.training
        numbers = {
            name: settings[name]
            for name in ("reward_scale", "price_range")
            if options.get(name, "auto") == "auto" and settings[name] is not None
        }
        constants = {name: value for name, value in options.items() if name not in numbers}
        environment = self.environment.model_copy(update={"options": constants | numbers})
        share = min((training.many_sensors or sensors) / sensors, 1.0)
        length = {"timesteps": round(training.timesteps * share), "many_sensors": None}
        training = training.model_copy(update=length)
        return self.model_copy(update={"environment": environment, "training": training})

    def changed(
        self, output: str | Path | None, options: Mapping[str, Any] | None = None, **training: Any
    ) -> Experiment:
        """Return the experiment with other output, options and training, checked again."""
        plain = self.model_dump() | ({} if output is None else {"output": str(output)})
        environment = plain["environment"]
        environment["options"] |= open_options(environment["id"], options or {})
        plain["training"] |= {key: value for key, value in training.items() if value is not None}
        if training.get("timesteps") is not None:
            plain["training"]["many_sensors"] = None
        return checked(Experiment, plain, "config 'command line'")


class SweepCurve(Strict):
    """A baseline with one swept parameter, whose place in ``policy`` is ``{value}`` or ``{price}``.

    With ``{price}`` the values are multiples of the task's price, or of the middle of its range.
    """

    label: str
    policy: str
    values: tuple[float | int, ...] = pydantic.Field(min_length=1)

    def policies(self, price: Price) -> list[str]:
        """Return one policy text per value."""
        name = "{price}" if "{price}" in self.policy else "{value}"
        middle = price.middle if name == "{price}" else 1.0
        return [self.policy.replace(name, f"{middle * value:g}") for value in self.values]

    @pydantic.field_validator("policy")
    @classmethod
    def _has_place(cls, policy: str) -> str:
        if ("{value}" in policy) == ("{price}" in policy):
            raise ValueError("must hold {value} or {price} where the swept parameter stands")
        return policy


class Sweep(Strict):
    """Baselines with their swept parameters, and single policies."""

    curves: tuple[SweepCurve, ...]
    points: tuple[str, ...] = ()

    def policies(self, price: Price) -> list[str]:
        """Return every policy text of the sweep once, in order."""
        texts = [text for curve in self.curves for text in curve.policies(price)]
        return list(dict.fromkeys([*self.points, *texts]))


class ComparisonRow(Strict):
    """One policy in one setting of the comparison's environment, or of another environment."""

    label: str
    policy: str
    environment: str | None = None
    options: Options = pydantic.Field(default_factory=dict)


class SweepSettings(Strict):
    """Settings and policies of one environment, row by row."""

    environment: str
    rows: tuple[ComparisonRow, ...] = pydantic.Field(min_length=1)
