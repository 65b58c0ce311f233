"""Experiments as typed YAML: every key is known, every value checked before anything runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import pydantic
import yaml

from fusion_gym.validation import ConfigurationError

Model = TypeVar("Model", bound=pydantic.BaseModel)
Positive = Annotated[int, pydantic.Field(gt=0)]
Rate = Annotated[float, pydantic.Field(gt=0)]
Share = Annotated[float, pydantic.Field(ge=0, le=1)]
# Share of the steps in which the untrained policy lets every sensor request; by default one half.
# Where that is far more than the tokens pay for, asking for less changes nothing (another sensor's
# request is granted instead), and a training can stay there for long.
InitialRate = Annotated[float | None, pydantic.Field(gt=0, lt=1)]


class _Strict(pydantic.BaseModel):
    """No unknown keys, no silent conversions."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)


class EnvironmentConfig(_Strict):
    """A registered environment and the options of ``gym.make`` that differ from its defaults.

    ``local`` trains one policy that every sensor runs by itself, on what it sees by itself.
    """

    id: str
    options: dict[str, Any] = {}
    local: bool = False


class NetworkConfig(_Strict):
    """The agent's networks."""

    hidden: tuple[Positive, ...] = (64, 64)
    activation: Literal["tanh", "relu"] = "tanh"


class _Algorithm(_Strict):
    """What every algorithm has; ``learning_rate_end`` makes the rate fall linearly to it."""

    learning_rate: Rate = 1e-3
    learning_rate_end: Rate | None = None
    gamma: Share = 0.97
    network: NetworkConfig = NetworkConfig()


class _OnPolicy(_Algorithm):
    """What PPO and A2C have in common."""

    gae_lambda: Share = 0.9
    ent_coef: float = 0.0
    vf_coef: float = 0.5
    max_grad_norm: Rate = 0.5
    initial_rate: InitialRate = None


class PPOConfig(_OnPolicy):
    """Stable-Baselines3's PPO; the names are its own."""

    name: Literal["ppo"]
    n_steps: Positive = 64
    batch_size: Positive = 4096
    n_epochs: Positive = 4
    clip_range: Rate = 0.2


class MaskablePPOConfig(PPOConfig):
    """sb3-contrib's MaskablePPO: PPO that cannot choose what the tokens do not allow."""

    name: Literal["maskable_ppo"]  # type: ignore[assignment]


class RecurrentPPOConfig(PPOConfig):
    """sb3-contrib's RecurrentPPO: PPO with a memory, for modes that hide the sensors' signals."""

    name: Literal["recurrent_ppo"]  # type: ignore[assignment]
    memory: Positive = 64


class A2CConfig(_OnPolicy):
    """Stable-Baselines3's A2C; the names are its own."""

    name: Literal["a2c"]
    n_steps: Positive = 8


class DQNConfig(_Algorithm):
    """Stable-Baselines3's DQN; the names are its own. The environment needs action: discrete."""

    name: Literal["dqn"]
    buffer_size: Positive = 500_000
    batch_size: Positive = 1024
    learning_starts: Positive = 20_000
    train_freq: Positive = 4
    gradient_steps: Positive = 4
    target_update_interval: Positive = 10_000
    exploration_fraction: Share = 0.2
    exploration_final_eps: Share = 0.02
    max_grad_norm: Rate = 10.0


class TrainingConfig(_Strict):
    """How long, with how many runs side by side, from which seed, on how many threads.

    ``target_rate`` trains to an average rate of transmissions per sensor and step: the price of a
    token starts at the environment's ``cost_weight`` and is adapted. ``price_exponent`` is for a
    price that is drawn: episodes count by (middle of the range / price)^exponent, in training and
    in validation, so that an agent does not neglect the low prices.
    """

    timesteps: Positive
    num_envs: Positive = 256
    seed: int = pydantic.Field(default=0, ge=0)
    threads: Positive = 1
    target_rate: float | None = pydantic.Field(default=None, gt=0, le=1)
    price_exponent: Share = 0.0


class ValidationConfig(_Strict):
    """Evaluation during training, on seeds that neither training nor a test uses."""

    every: Positive = 500_000
    episodes: Positive = 256
    seed: int = pydantic.Field(default=500_000_000, ge=0)


class Experiment(_Strict):
    """One training: environment, algorithm, length, validation, and where results go."""

    environment: EnvironmentConfig
    algorithm: PPOConfig | MaskablePPOConfig | RecurrentPPOConfig | A2CConfig | DQNConfig = (
        pydantic.Field(discriminator="name")
    )
    training: TrainingConfig
    validation: ValidationConfig = ValidationConfig()
    output: str


class Curve(_Strict):
    """A baseline swept over one parameter: ``policy`` holds ``{value}`` in its place."""

    label: str
    policy: str
    values: tuple[float | int, ...] = pydantic.Field(min_length=1)

    @property
    def policies(self) -> list[str]:
        """One policy text a value."""
        return [self.policy.format(value=f"{value:g}") for value in self.values]

    @pydantic.field_validator("policy")
    @classmethod
    def _has_place(cls, policy: str) -> str:
        if "{value}" not in policy:
            raise ValueError("must hold {value} where the swept parameter stands")
        return policy


class Sweep(_Strict):
    """Baselines over their thresholds, and the single policies that stand beside them."""

    curves: tuple[Curve, ...]
    points: tuple[str, ...] = ()

    @property
    def policies(self) -> list[str]:
        """Every policy text of the sweep, each once, in order."""
        texts = [text for curve in self.curves for text in curve.policies]
        return list(dict.fromkeys([*self.points, *texts]))


class ComparisonRow(_Strict):
    """One policy in one setting of the comparison's environment, or of another."""

    label: str
    policy: str
    environment: str | None = None
    options: dict[str, Any] = {}


class Comparison(_Strict):
    """Settings and policies of one environment, row by row."""

    environment: str
    rows: tuple[ComparisonRow, ...] = pydantic.Field(min_length=1)


def read_yaml(path: str | Path) -> Any:
    """The parsed file.

    Raises:
        ConfigurationError: no such file, or no YAML.
    """
    try:
        return yaml.safe_load(Path(path).read_text())
    except OSError as error:
        raise ConfigurationError(
            f"config {str(path)!r} cannot be read: {error.strerror or error}"
        ) from None
    except yaml.YAMLError as error:
        raise ConfigurationError(f"config {str(path)!r} is no YAML: {error}") from None


def load_experiment(path: str | Path) -> Experiment:
    """A training's config.

    Raises:
        ConfigurationError: unreadable, an unknown key, or a value that is not allowed; names the
            file and the first such field.
    """
    return parse(Experiment, read_yaml(path), str(path))


def load_sweep(path: str | Path) -> Sweep:
    """A sweep's config; raises like :func:`load_experiment`."""
    return parse(Sweep, read_yaml(path), str(path))


def load_comparison(path: str | Path) -> Comparison:
    """A comparison's config; raises like :func:`load_experiment`."""
    return parse(Comparison, read_yaml(path), str(path))


def parse(kind: type[Model], content: Any, source: str) -> Model:
    """The content as a checked model.

    Raises:
        ConfigurationError: an unknown key or a value that is not allowed; names ``source`` and
            the first such field.
    """
    try:
        return kind.model_validate(content)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "the whole file"
        given = "" if first["type"] == "missing" else f" = {first['input']!r}"
        raise ConfigurationError(
            f"config {source!r}: {place}{given} is not allowed: {first['msg']}"
        ) from None
