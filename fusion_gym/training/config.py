"""The configs of trainings, sweeps and comparisons as typed YAML, and the table of algorithms.

All keys and values are validated before anything runs. Settings of algorithms have their names in
Stable-Baselines3 and sb3-contrib.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import pydantic

from fusion_gym import seeds, validation
from fusion_gym.core.action import ACTIONS
from fusion_gym.docstrings import table
from fusion_gym.entries import Arguments, Options, Plain
from fusion_gym.envs.registration import open_options
from fusion_gym.errors import display
from fusion_gym.importing import import_named
from fusion_gym.training import EPISODES
from fusion_gym.validation import choice
from fusion_gym.yaml_text import parsed

try:
    SHIPPED = Path(str(files("fusion_gym.configs")))
except ModuleNotFoundError:  # a source tree that is not installed
    SHIPPED = Path(__file__).parents[2] / "configs"

Model = TypeVar("Model", bound=pydantic.BaseModel)
Shape = TypeVar("Shape")
Positive = Annotated[int, pydantic.Field(gt=0, le=10**12)]
Several = Annotated[int, pydantic.Field(gt=1, le=10**12)]
Weight = Annotated[float, pydantic.Field(ge=0)]
Rate = Annotated[float, pydantic.Field(gt=0)]
Share = Annotated[float, pydantic.Field(ge=0, le=1)]


class Strict(pydantic.BaseModel):
    """A model without unknown keys, conversions, infinite numbers and later changes."""

    model_config = pydantic.ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False
    )

    @pydantic.model_validator(mode="before")
    @classmethod
    def _tuples(cls, content: Any) -> Any:
        """Convert lists to tuples, because YAML has only lists."""
        if not isinstance(content, Mapping):
            return content
        return {
            key: tuple(value) if isinstance(value, list) else value
            for key, value in content.items()
        }


def config_path(name: str | Path, option: str = "config") -> Path:
    """Return the file of a path, or the shipped config of a name (``tobit_oscillator_ppo``)."""
    path = Path(name)
    if os.path.isfile(path) or path.suffix or path.name != str(name):
        return path
    shipped = sorted(file.stem for file in SHIPPED.glob("*.yaml"))
    return SHIPPED / f"{validation.choice(option, str(name), shipped)}.yaml"


def load_checked(kind: type[Model], name: str | Path, option: str = "config") -> Model:
    """Return the checked config of a path or shipped name."""
    return checked(kind, read_yaml(name, option), f"{option} {str(name)!r}")


def read_yaml(name: str | Path, option: str = "config") -> Any:
    """Return the content of the config of a path or shipped name."""
    text = validation.read_text(option, config_path(name, option), str(name))
    return parsed(text, f"{option} {str(name)!r}")


def checked(shape: type[Shape], content: Any, source: str) -> Shape:
    """Return the content as an object of a type; an error names the first wrong field."""
    try:
        return pydantic.TypeAdapter(shape).validate_python(content)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "the whole file"
        text = "" if first["type"] == "missing" else f" = {display(first['input'])}"
        raise validation.ConfigurationError(
            f"{source}: {place}{text} is not allowed: {first['msg']}"
        ) from None


# Share of the steps in which the untrained policy requests each sensor; by default one half. Far
# above the tokens' rate, fewer requests of one sensor only grant another sensor's requests, so the
# training may stagnate.
InitialRate = Annotated[float | None, pydantic.Field(gt=0, lt=1)]


class NetworkConfig(Strict):
    """The agent's networks."""

    hidden: tuple[Positive, ...] = (64, 64)
    activation: Literal["tanh", "relu", "silu"] = "tanh"


class AlgorithmConfig(Strict):
    """The settings of every algorithm; the rate falls linearly to ``learning_rate_end``."""

    name: str
    learning_rate: Rate = 1e-3
    learning_rate_end: Rate | None = None
    gamma: Share = 0.97
    network: NetworkConfig = NetworkConfig()

    def arguments(self) -> Arguments:
        """Return the arguments of the algorithm's class."""
        import torch
        from stable_baselines3.common.utils import LinearSchedule

        ours = {"name", "learning_rate_end", "network", "initial_rate"}
        value = self.model_dump(exclude=ours)
        if self.learning_rate_end is not None:
            value["learning_rate"] = LinearSchedule(self.learning_rate, self.learning_rate_end, 1.0)
        kinds = {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU, "silu": torch.nn.SiLU}
        activation = kinds[self.network.activation]
        shape = {"net_arch": list(self.network.hidden), "activation_fn": activation}
        return value | {"policy_kwargs": shape}


class A2CConfig(AlgorithmConfig):
    """The settings of A2C, which PPO shares."""

    gae_lambda: Share = 0.9
    ent_coef: Weight = 0.0
    vf_coef: Weight = 0.5
    max_grad_norm: Rate = 0.5
    initial_rate: InitialRate = None
    n_steps: Positive = 8


class PPOConfig(A2CConfig):
    """The settings of PPO and of PPO with masked actions (``maskable_ppo``)."""

    n_steps: Positive = 64
    batch_size: Several = 4096
    n_epochs: Positive = 4
    clip_range: Rate = 0.2


class CounterfactualConfig(PPOConfig):
    """PPO with counterfactual credit (:mod:`.counterfactual`).

    ``alternatives`` of a decision are ``all`` actions, or ``flips``, the requests with one sensor
    changed at a time. The default is ``all`` for a scheduler with at most 8 sets of requests.
    Without ``path_credit`` the surplus δ trains only the critic.
    """

    learning_rate: Rate = 2e-3
    learning_rate_end: Rate | None = 1e-5
    ent_coef: Weight = 0.003
    initial_rate: InitialRate = 0.1
    n_steps: Positive = 32
    batch_size: Several = 1024
    n_epochs: Positive = 8
    alternatives: Literal["all", "flips"] | None = None
    path_credit: bool = True


class BranchingConfig(AlgorithmConfig):
    """PPO with branches over a window (:mod:`.branching`), without discount.

    Every set of requests of a decision runs on for a while, ``window`` mean times between two
    packets of the rule, at least 10 steps. All these steps count as time steps.
    ``rule`` is the text of a ``priced_threshold``, at which the policy starts, by default the best
    single threshold at each price.
    """

    gamma: Annotated[float, pydantic.Field(ge=1, le=1)] = 1.0
    learning_rate_end: Rate | None = 1e-5
    network: NetworkConfig = NetworkConfig(hidden=(128, 128), activation="silu")
    ent_coef: Weight = 0.03
    max_grad_norm: Rate = 0.5
    n_epochs: Positive = 4
    clip_range: Annotated[float, pydantic.Field(gt=0, lt=1)] = 0.2
    window: Rate = 1.0
    rule: str | None = None

    def arguments(self) -> Arguments:
        """Return the arguments of the algorithm's class; the rule belongs to the environment."""
        result = super().arguments()
        result.pop("rule")
        result["policy_kwargs"]["ortho_init"] = False
        return result

    @pydantic.field_validator("network")
    @classmethod
    def _of_pairs(cls, network: NetworkConfig) -> NetworkConfig:
        if network.activation != "silu":
            raise ValueError("activation must be silu, of which two units pass on a log ratio")
        return network


class RecurrentPPOConfig(PPOConfig):
    """The settings of PPO with a recurrent policy, for modes that hide the sensors' signals."""

    memory: Positive = 64

    def arguments(self) -> Arguments:
        """Return the arguments of the algorithm's class; ``memory`` is the size of the LSTM."""
        result = super().arguments()
        result["policy_kwargs"]["lstm_hidden_size"] = result.pop("memory")
        return result


class DQNConfig(AlgorithmConfig):
    """The settings of DQN."""

    buffer_size: Positive = 500_000
    batch_size: Positive = 1024
    learning_starts: Positive = 20_000
    train_freq: Positive = 4
    gradient_steps: Positive = 4
    target_update_interval: Positive = 10_000
    exploration_fraction: Share = 0.2
    exploration_final_eps: Share = 0.02
    max_grad_norm: Rate = 10.0


@dataclass(frozen=True)
class Algorithm:
    """A row of the table of algorithms.

    RecurrentPPO accepts MultiBinary actions but fails on them during training.

    Args:
        place: ``module:name`` of its class.
        config: class of its settings.
        meaning: its meaning, in a few words.
        source: paper or library.
        policy: kind of policy.
        actions: possible kinds of action.
    """

    place: str
    config: type[AlgorithmConfig]
    meaning: str
    source: str
    policy: str = "MlpPolicy"
    actions: tuple[str, ...] = tuple(name for name in ACTIONS if name != "threshold")

    @property
    def model(self) -> Any:
        """Class of the algorithm, whose import takes seconds."""
        return import_named("algorithm", self.place)

    @property
    def privileged(self) -> bool:
        """Whether it learns from information that no policy may use."""
        return self.place.startswith(_OWN)


_OWN, _SB3, _MORE = "fusion_gym.training.", "stable_baselines3:", "sb3_contrib:"
_CREDIT = "this library ([Learning](learning.md))"
TABLE = {
    "a2c": Algorithm(
        f"{_SB3}A2C", A2CConfig, "advantage actor-critic",
        "V. Mnih et al., ICML 2016 (arXiv 1602.01783)", actions=tuple(ACTIONS),
    ),
    "branching_ppo": Algorithm(
        f"{_OWN}branching:BranchingPPO", BranchingConfig, "PPO with branches over a window",
        _CREDIT, actions=("binary",),
    ),
    "counterfactual_ppo": Algorithm(
        f"{_OWN}counterfactual:CounterfactualPPO", CounterfactualConfig,
        "PPO with counterfactual credit", _CREDIT,
    ),
    "dqn": Algorithm(
        f"{_SB3}DQN", DQNConfig, "deep Q-learning", "V. Mnih et al., arXiv 1312.5602",
        actions=("discrete",),
    ),
    "maskable_ppo": Algorithm(
        f"{_MORE}MaskablePPO", PPOConfig, "PPO with a mask of the requests that the tokens deny",
        "S. Huang and S. Ontañón, arXiv 2006.14171",
    ),
    "ppo": Algorithm(
        f"{_SB3}PPO", PPOConfig, "proximal policy optimisation",
        "J. Schulman et al., arXiv 1707.06347", actions=tuple(ACTIONS),
    ),
    "recurrent_ppo": Algorithm(
        f"{_MORE}RecurrentPPO", RecurrentPPOConfig, "PPO with an LSTM, for tasks that hide signals",
        "J. Schulman et al., arXiv 1707.06347", "MlpLstmPolicy",
        actions=("multidiscrete", "discrete", "assignment", "threshold"),
    ),
}  # fmt: skip


def algorithm_table(_: str) -> str:
    """Return the algorithms as a Markdown table."""
    rows = (
        (f"`{name}`", row.meaning, ", ".join(f"`{kind}`" for kind in row.actions), row.source)
        for name, row in TABLE.items()
    )
    return table(("algorithm", "meaning", "actions", "source"), rows)


def settings(content: Any) -> AlgorithmConfig:
    """Return the settings of an algorithm, in the class that the table has for its name."""
    if isinstance(content, AlgorithmConfig):
        return content
    if not isinstance(content, Mapping):
        raise ValueError("it must be a name and settings")
    name = choice("name", content.get("name"), TABLE)
    return TABLE[name].config.model_validate(content)


AnyAlgorithm = Annotated[
    pydantic.SerializeAsAny[AlgorithmConfig], pydantic.BeforeValidator(settings)
]


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

    episodes: tuple[Positive, Positive] = EPISODES


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
        left_out: Any = {"output": True, "calibration": True, "training": {"timesteps", "threads"}}
        return self.model_dump(mode="json", exclude=left_out)

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
