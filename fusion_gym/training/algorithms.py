"""The table of algorithms: class, settings and requirements of each.

Settings have their names in Stable-Baselines3 and sb3-contrib.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import pydantic

from fusion_gym.core.action import ACTIONS
from fusion_gym.docstrings import table
from fusion_gym.entries import Arguments
from fusion_gym.importing import import_named
from fusion_gym.training.checked import Positive, Rate, Several, Share, Strict, Weight
from fusion_gym.validation import choice

# Share of the steps in which the untrained policy requests each sensor; by default one half. Far
# above the tokens' rate, fewer requests of one sensor only grant another sensor's requests, so the
# training may stagnate.
InitialRate = Annotated[float | None, pydantic.Field(gt=0, lt=1)]


class NetworkConfig(Strict):
    """The agent's networks."""

    hidden: tuple[Positive, ...] = (64, 64)
    activation: Literal["tanh", "relu"] = "tanh"


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
        activation = {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU}[self.network.activation]
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
    actions: tuple[str, ...] = tuple(ACTIONS)

    @property
    def model(self) -> Any:
        """Class of the algorithm, whose import takes seconds."""
        return import_named("algorithm", self.place)

    @property
    def privileged(self) -> bool:
        """Whether it learns from information that no policy may use."""
        return self.place.startswith(_OWN)


_OWN, _SB3, _MORE = "fusion_gym.training.counterfactual:", "stable_baselines3:", "sb3_contrib:"
_CREDIT = "this library ([Learning](learning.md))"
TABLE = {
    "a2c": Algorithm(
        f"{_SB3}A2C", A2CConfig, "advantage actor-critic",
        "V. Mnih et al., ICML 2016 (arXiv 1602.01783)",
    ),
    "counterfactual_maskable_ppo": Algorithm(
        f"{_OWN}CounterfactualMaskablePPO", CounterfactualConfig,
        "PPO with counterfactual credit and the mask of `maskable_ppo`", _CREDIT,
    ),
    "counterfactual_ppo": Algorithm(
        f"{_OWN}CounterfactualPPO", CounterfactualConfig, "PPO with counterfactual credit", _CREDIT
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
        "J. Schulman et al., arXiv 1707.06347",
    ),
    "recurrent_ppo": Algorithm(
        f"{_MORE}RecurrentPPO", RecurrentPPOConfig, "PPO with an LSTM, for tasks that hide signals",
        "J. Schulman et al., arXiv 1707.06347", "MlpLstmPolicy",
        actions=("multidiscrete", "discrete", "assignment"),
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
