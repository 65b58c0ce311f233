"""A Stable-Baselines3 agent as a policy, and the card that is saved with it."""

import copy
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from sb3_contrib import MaskablePPO, RecurrentPPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from fusion_gym.arrays import Array
from fusion_gym.core.knowledge import Knowledge, Signals, least_covering
from fusion_gym.core.observation import ObservationLayout
from fusion_gym.core.reward import Price
from fusion_gym.core.task import Task
from fusion_gym.envs.views import Rows, make_view
from fusion_gym.errors import forbidden
from fusion_gym.policies.archive import ENTRY, ModelView, algorithm_name, model_card
from fusion_gym.policies.base import Requests
from fusion_gym.policies.belief_rules import beliefs_of
from fusion_gym.validation import refusal


def tag_model(model: BaseAlgorithm, task: Task, local: bool = False) -> None:
    """Write the model's card (:mod:`fusion_gym.policies.archive`) into it before it is saved."""
    setattr(model, ENTRY, model_card(algorithm_name(model), task, local))


class ModelPolicy:
    """A Stable-Baselines3 model as a policy, which uses only the task's observation.

    A local model decides for every sensor on the view of that sensor. The entries of beliefs have
    the scale of the training.

    Args:
        model: the model.
        task: the task.
        deterministic: take the likeliest action instead of a draw.
        price: price of a token, for a model that was trained for a range of prices; it replaces the
            task's own price.
        trained: the view of the training; the whole view of a scheduler by default.

    Raises:
        ConfigurationError: a price for a model without a range, or a price outside its range.
    """

    def __init__(
        self,
        model: BaseAlgorithm,
        task: Task,
        deterministic: bool = True,
        price: float | None = None,
        trained: ModelView | None = None,
    ) -> None:
        trained = ModelView() if trained is None else trained
        self.model = model
        self.deterministic = deterministic
        self._visible = task.reward.price.span is not None
        self.task = trained.on(task)
        self.view = make_view(self.task, trained.local)
        same = np.array_equal(self.task.nominal_error, task.nominal_error)  # type: ignore[arg-type]
        owner = self.view.owner or "scheduler"
        self._layout = None if same else ObservationLayout(self.task, owner)
        self._memory: Any = None  # of a recurrent policy
        self.normalization: VecNormalize | None = None  # of the training
        self.stateless = deterministic and not isinstance(model, RecurrentPPO)
        self.knowledge: Knowledge = self.view.knowledge
        self.memory_owner = self.view.owner
        if isinstance(model, RecurrentPPO) and self.knowledge != "centre":
            self.knowledge = least_covering((self.knowledge, "own_memory"))
        span = self.task.reward.price.span
        self.price: float | None = None
        if price is None and span is not None and not self._visible:
            fixed = task.reward.price.fixed
            assert fixed is not None  # a drawn price is always shown
            price = min(max(fixed, span[0]), span[1])
        if price is not None:
            if span is None:
                reason = "the model has no price_range, only a single price"
                raise forbidden("price", price, reason)
            price_setting = Price.create(price, span)
            self.price = float(price_setting.encode(price_setting.draw(np.zeros(1)))[0])

    def reset(self, runs: int, seed: int = 0) -> None:
        """Clear the memory of a recurrent policy, and draw from the stream of ``seed``."""
        self._memory = None
        if not self.deterministic:
            self.model.set_random_seed(seed)

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        masks = {}
        if isinstance(self.model, MaskablePPO):
            masks["action_masks"] = self.view.action.masks(signals["grantable"])
        action, self._memory = self.model.predict(
            self.rows(signals),
            state=self._memory,
            episode_start=signals["start"].repeat(self.view.rows_per_run),
            deterministic=self.deterministic,
            **masks,
        )
        return self.view.action.requests(action, len(signals["start"]))

    def rows(self, signals: Signals) -> Rows:
        """Return the observation of the model (N·rows_per_run, entries), float32."""
        observation = signals["observation"]
        if self._layout is not None:
            beliefs = beliefs_of(signals, own=self.view.owner == "own")
            observation = self._layout.replace_beliefs(observation, beliefs)
        if self.price is not None:
            own = observation[:, :-1] if self._visible else observation  # the price comes last
            column = np.full((len(own), 1), self.price, dtype=np.float32)
            observation = np.concatenate((own, column), axis=1)
        rows: Any = self.view.rows(observation)
        if self.normalization is not None:
            rows = self.normalization.normalize_obs(rows)
        return rows

    @property
    def pairs(self) -> bool:
        """Whether each bit of an action has two outputs of the network, silence and a request."""
        multiple = isinstance(self.view.action.space, spaces.MultiDiscrete)
        return multiple or isinstance(self.model, MaskablePPO)

    def check_logits(self) -> None:
        """Refuse an agent without one logit for each sensor."""
        action, model = self.view.action, self.model
        if isinstance(model, RecurrentPPO) or not hasattr(model.policy, "action_net"):
            allowed = "an agent with one logit for each sensor (ppo, a2c, trpo, maskable_ppo)"
            raise refusal("policy", type(model).__name__, allowed)
        if action.places(0) is None:
            allowed = "MultiBinary, MultiDiscrete, or access='single'"
            raise refusal("action", str(action.space), allowed)

    def logits(self, signals: Signals) -> Array:
        """Return the logit (sensors, N) of each sensor's request over its silence."""
        policy: Any = self.model.policy
        rows = torch.as_tensor(self.rows(signals))
        with torch.no_grad():
            latent = policy.mlp_extractor.forward_actor(policy.extract_features(rows))
            outputs: Array = policy.action_net(latent).numpy().astype(np.float64)
        result = self.view.action.scores(outputs)
        assert result is not None  # or check_logits refuses
        masked = isinstance(self.model, MaskablePPO)
        return np.where(signals["grantable"], result, -np.inf) if masked else result

    def with_threshold(self, threshold: float) -> "ModelPolicy":
        """Return the agent whose logits are lower by a threshold, in its last layer."""
        result = copy.deepcopy(self)
        policy: Any = result.model.policy
        with torch.no_grad():
            bias = policy.action_net.bias
            bias[self.view.action.places(len(bias))] -= threshold
        return result
