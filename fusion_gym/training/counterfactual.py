"""PPO with counterfactual credit: the simulator steps the alternatives of each decision.

The advantage of a request is the difference to the alternatives of the decision, which are stepped
on the same noise. It has less noise than the return. Only the training uses the alternatives: the
policy has its usual observation, and the saved model is an ordinary PPO model.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from gymnasium.spaces import Discrete
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import explained_variance
from stable_baselines3.common.vec_env import VecEnv

from fusion_gym.arrays import Array
from fusion_gym.core.action import Sets
from fusion_gym.envs.privileged import PrivilegedVecEnv
from fusion_gym.validation import ConfigurationError, refusal


class RolloutBatch(NamedTuple):
    """The data of one rollout of T steps, with B = T · runs.

    D is the number of factors of a decision and C the number of choices of a factor.

    Args:
        observations: (B, entries), or with local decisions (B, sensors, entries).
        choices: the choices (B, D).
        old: log-probabilities before the update (B, D, C).
        advantages: A (B, D, C).
        surplus: δ (B,).
        returns: G (B,).
        values: V (B,).
    """

    observations: torch.Tensor
    choices: torch.Tensor
    old: torch.Tensor
    advantages: torch.Tensor
    surplus: torch.Tensor
    returns: torch.Tensor
    values: torch.Tensor


class CounterfactualPPO(PPO):
    """PPO with counterfactual credit, which saves models of PPO.

    The surrogate, its clipping and the λ-returns are from Schulman et al. 2015, 2017. For the
    action b taken and each alternative a of a decision, on the same noise,

        Q_a = r_a + γ V(o'_a),  V̄ = Σ π_a Q_a,  A_a = Q_a - V̄,

    with one factor of the decision at a time and the mean of V̄ over the factors. Along the path

        G = V̄ + δ,  δ = γ λ (G' - V(o'_b)),

    and δ = 0 at the end of an episode and of the rollout. G is the critic's target. Advantages and
    δ are divided by the spread √(mean Σ π_a A_a²).

    With local decisions V of a run is the sum of the critic's values of its rows (value
    decomposition: Sunehag et al. 2018), and δ has each sensor's own ratio.

    Without ``path_credit`` δ trains only the critic. δ contains the noise of the whole reward of a
    run, which with many sensors exceeds the effect of one decision.

    Args:
        *args: arguments of the algorithm.
        alternatives: kind of alternatives.
        path_credit: whether δ trains the policy.
        **kwargs: arguments of the algorithm.
    """

    batch_size: Any
    clip_range: Any
    _decisions: Decisions

    def __init__(
        self, *args: Any, alternatives: Kind | None = None, path_credit: bool = True, **kwargs: Any
    ) -> None:
        self.alternatives, self.path_credit = alternatives, path_credit
        self.value_scale = 1.0
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        super()._setup_model()
        if self.env is not None:
            self._decisions = Decisions(_privileged(self.env), self.alternatives)
        self._rollout: RolloutBatch | None = None

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_decisions", "_rollout"]

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:
        """Step all runs and the alternatives of their decisions; false if a callback ends it."""
        privileged, decisions = _privileged(env), self._decisions
        first = slice(None, None, privileged.view.rows_per_run)  # of a run's rows
        self.policy.set_training_mode(False)
        callback.on_rollout_start()
        steps: list[_Step] = []
        while len(steps) < n_rollout_steps:
            assert self._last_obs is not None
            observation = decisions.by_run(torch.as_tensor(self._last_obs))
            with torch.no_grad():
                old = decisions.log_probabilities(self._logits(observation))
                noise = -torch.log(-torch.log(torch.rand(old.shape)))
            choice = (old + noise).argmax(-1).numpy()
            (after, rewards, dones, infos), branched = privileged.step_alternatives(
                decisions.actions(choice), decisions.alternatives(choice)
            )
            self.num_timesteps += env.num_envs
            callback.update_locals(locals())
            if not callback.on_step():
                return False
            self._update_info_buffer(infos, dones)
            follows, terminated = np.array(after), dones.copy()
            for row in np.flatnonzero(dones):
                follows[row] = infos[row]["terminal_observation"]
                terminated[row] = not infos[row]["TimeLimit.truncated"]
            goes_on = ~terminated[first]
            beyond = goes_on * self._beyond(branched.observation)
            value = goes_on * self._value(decisions.by_run(follows))
            taken = rewards[first] + self.gamma * value
            values = decisions.arranged(choice, taken, branched.reward + self.gamma * beyond)
            steps.append(_Step(observation, choice, old, values, value, dones[first]))
            self._last_obs = after  # type: ignore[assignment]
            self._last_episode_starts = dones
        self._rollout = self._credited(steps)
        callback.update_locals(locals())
        callback.on_rollout_end()
        return True

    def _credited(self, steps: list[_Step]) -> RolloutBatch:
        """Return the batch of a rollout, before the division by the spread."""
        means = [(np.exp(step.old.numpy()) * step.values).sum(-1) for step in steps]
        returns = np.array([mean.mean(-1) for mean in means])  # before δ
        surplus = np.zeros_like(returns)
        for place, step in reversed(list(enumerate(steps[:-1]))):
            left = self.gamma * self.gae_lambda * (returns[place + 1] - step.follows)
            surplus[place] = np.where(step.dones, 0.0, left)
            returns[place] += surplus[place]

        def joined(parts: Any) -> torch.Tensor:
            return torch.as_tensor(np.concatenate(parts), dtype=torch.float32)

        return RolloutBatch(
            torch.cat([step.observation for step in steps]),
            torch.as_tensor(np.concatenate([step.choices for step in steps])),
            torch.cat([step.old for step in steps]),
            joined([s.values - mean[..., None] for s, mean in zip(steps, means, strict=True)]),
            joined(surplus),
            joined(returns),
            joined([self._value(step.observation.numpy()) for step in steps]),
        )

    def train(self) -> None:
        """Improve policy and critic on the last rollout."""
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        rollout = self._rollout
        assert rollout is not None
        clip = float(self.clip_range(self._current_progress_remaining))
        weight = rollout.old.exp()
        spread = float((weight * rollout.advantages**2).sum(-1).mean().sqrt()) + 1e-8
        self._rescale_critic(float(rollout.returns.square().mean().sqrt()))
        entries: dict[str, list[float]] = {}
        size = max(self.batch_size // _privileged(self.env).view.rows_per_run, 1)
        for _ in range(self.n_epochs):
            order = np.random.permutation(len(rollout.returns))  # noqa: NPY002
            for first in range(0, len(order), size):
                batch = torch.as_tensor(order[first : first + size])
                loss, parts = self._loss(rollout, batch, spread, clip)
                self.policy.optimizer.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
                self.policy.optimizer.step()
                for name, part in parts.items():
                    entries.setdefault(name, []).append(part.item())
            self._n_updates += 1
        surplus = float(rollout.surplus.square().mean())
        entries |= {
            "advantage_spread": [spread],
            "surplus_share": [surplus / (surplus + spread**2)],
            "explained_variance": [
                float(explained_variance(rollout.values.numpy(), rollout.returns.numpy()))
            ],
        }
        for name, entry in entries.items():
            self.logger.record(f"train/{name}", float(np.mean(entry)))
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

    def _rescale_critic(self, size: float) -> None:
        """Adapt the critic's scale to the returns' root mean square, with unchanged values.

        Otherwise a large loss of the critic would dominate the clipped gradient.

        Source: van Hasselt et al. 2016 (Pop-Art).

        Args:
            size: root mean square of the returns.
        """
        policy: Any = self.policy
        scale = self.value_scale * (size / self.value_scale) ** (0.05 if self._n_updates else 1.0)
        with torch.no_grad():
            for parameter in policy.value_net.parameters():
                parameter.mul_(self.value_scale / scale)
        self.value_scale = scale

    def _loss(
        self, rollout: RolloutBatch, batch: torch.Tensor, spread: float, clip: float
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        observation = rollout.observations[batch]
        new = self._decisions.log_probabilities(self._logits(observation))
        old = rollout.old[batch]
        weight, change = old.exp(), new - old
        ratio = change.exp()
        credit = rollout.advantages[batch] / spread
        gain = torch.minimum(ratio * credit, ratio.clamp(1.0 - clip, 1.0 + clip) * credit)
        selection = rollout.choices[batch][..., None]
        taken = change.gather(-1, selection)
        whole = (taken if self._decisions.local else taken.sum((-1, -2), keepdim=True)).exp()
        surplus = rollout.surplus[batch][:, None, None] / spread
        late = torch.minimum(whole * surplus, whole.clamp(1.0 - clip, 1.0 + clip) * surplus)
        policy = -(weight * gain).sum((-1, -2)).mean()
        if self.path_credit:
            policy = policy - late.sum((-1, -2)).mean()
        entropy = -(new.exp() * new).sum((-1, -2)).mean()
        error = (self._critic(observation) - rollout.returns[batch]) / self.value_scale
        value = error.square().mean()
        loss = policy - self.ent_coef * entropy + self.vf_coef * value
        with torch.no_grad():
            parts = {
                "policy_gradient_loss": policy,
                "value_loss": value,
                "entropy_loss": -entropy / (new.shape[1] if self._decisions.local else 1),
                "approx_kl": ((whole - 1.0) - whole.log()).mean(),
                "clip_fraction": ((whole - 1.0).abs() > clip).float().mean(),
            }
        return loss, parts

    def _logits(self, observation: torch.Tensor) -> torch.Tensor:
        """Return the logits of ``Discrete`` choices or of requests."""
        policy: Any = self.policy
        rows = policy.pi_features_extractor(observation.reshape(-1, observation.shape[-1]))
        logits: torch.Tensor = policy.action_net(policy.mlp_extractor.forward_actor(rows))
        logits = logits.reshape(*observation.shape[:-1], -1)
        if self._decisions.binary and logits.shape[-1] > self._decisions.sensors:
            pairs = logits.reshape(len(logits), -1, 2)  # silence and a request
            logits = pairs[..., 1] - pairs[..., 0]
        return logits

    def _critic(self, observation: torch.Tensor) -> torch.Tensor:
        policy: Any = self.policy
        rows = policy.vf_features_extractor(observation.reshape(-1, observation.shape[-1]))
        values: torch.Tensor = policy.value_net(policy.mlp_extractor.forward_critic(rows))
        values = self.value_scale * values.reshape(observation.shape[:-1])
        return values.sum(-1) if self._decisions.local else values

    def _value(self, observation: NDArray[np.float32]) -> Array:
        """Return V of runs, from observations (…, entries) or local ones (…, sensors, entries)."""
        with torch.no_grad():
            return self._critic(torch.as_tensor(observation)).numpy().astype(np.float64)

    def _beyond(self, observation: NDArray[np.float32]) -> Array:
        """Return V (A, runs) after the alternatives, from observations (A, runs, entries)."""
        if not self._decisions.local:
            return self._value(observation)
        # One by one, because the rows of all alternatives would not fit into the cache.
        rows = map(self._decisions.view.rows, observation)
        return np.stack([self._value(self._decisions.by_run(item)) for item in rows])


class _Step(NamedTuple):
    """One step of all runs, before it becomes part of a :class:`RolloutBatch`.

    ``values`` (runs, D, C) are the values Q of all choices, ``follows`` (runs,) the values of the
    next states, ``dones`` (runs,) bool.
    """

    observation: torch.Tensor
    choices: Choices
    old: torch.Tensor
    values: Array
    follows: Array
    dones: NDArray[np.bool_]


def _privileged(env: Any) -> PrivilegedVecEnv:
    """Return the training's environment without wrappers, or refuse one without alternatives."""
    result = env.unwrapped
    if not isinstance(result, PrivilegedVecEnv):
        raise ConfigurationError(
            f"env = {type(result).__name__} is not allowed with counterfactual credit: it must be "
            "a PrivilegedVecEnv, which steps alternatives"
        )
    return result


Kind = Literal["all", "flips"]
MOST_ALTERNATIVES = 8  # largest number of sets of requests for the default "all"
MOST_SENSORS = 10  # largest number of sensors for "all"
Choices = NDArray[np.int64]  # choices (runs, D)


class Decisions:
    """The alternatives of every run's decision, as D factors of C choices each.

    - ``"all"``: one factor, whose choices are all actions of a scheduler.
    - ``"flips"``: one factor per sensor, silence or a request, with the other sensors unchanged;
      also for local decisions. An assignment has one factor per channel, whose choices are nobody
      and every sensor.

    Args:
        env: the environment.
        kind: kind of alternatives; None for the default.

    Raises:
        ConfigurationError: flips of an action that is one number, all assignments, or all sets of
            more than 10 sensors.
    """

    def __init__(self, env: PrivilegedVecEnv, kind: Kind | None) -> None:
        self.view, self.local, action = env.view, env.view.local, env.view.action
        self.sensors, self.runs, self.action = env.task.sensors, env.runs, action
        self.binary, assigns = action.bits and not self.local, action.factors[0] > 1
        self.kind: Kind = "flips" if self.local or assigns else "all"
        if self.binary:
            few = self.sensors < 60 and 2**self.sensors <= MOST_ALTERNATIVES
            self.kind = kind or ("all" if few else "flips")
        if kind is not None and kind != self.kind:
            form = "assigns channels" if assigns else "is one number"
            why = "sensors decide locally" if self.local else f"an action {form}"
            raise refusal("alternatives", kind, f"{self.kind!r}, because {why}", "here")
        if self.kind == "all" and self.binary:
            self.action = Sets(self.sensors)
        self.choices = self.action.factors[1]
        if self.kind == "all" and self.choices > 2**MOST_SENSORS:
            text, instead = "action = 'discrete'", "action must be 'binary'"
            if self.binary:
                text, instead = "alternatives = 'all'", "it must be 'flips'"
            raise ConfigurationError(
                f"{text} is not allowed here with {self.sensors} sensors: it steps all "
                f"2^{self.sensors} sets of requests of at most {MOST_SENSORS} sensors; {instead}"
            )
        self.flips = self.kind == "flips" and action.bits

    def log_probabilities(self, logits: torch.Tensor) -> torch.Tensor:
        """Return the log-probabilities of all choices (runs, D, C).

        Args:
            logits: for bits (runs, sensors), for local decisions (runs, sensors, 2), and otherwise
                (runs, D · C).
        """
        if not self.binary:
            return torch.log_softmax(logits.reshape(len(logits), -1, self.choices), -1)
        silent = -torch.nn.functional.softplus(logits)
        if self.flips:
            return torch.stack((silent, logits + silent), -1)
        bits = torch.as_tensor(self.action.table, dtype=torch.float32)
        return (silent.sum(-1, keepdim=True) + logits @ bits.T)[:, None]

    def by_run(self, rows: Any) -> Any:
        """Return local rows (rows, entries) by run (runs, sensors, entries); others unchanged."""
        return rows.reshape(-1, self.sensors, rows.shape[-1]) if self.local else rows

    def actions(self, choice: Choices) -> NDArray[Any]:
        """Return the actions of the rows from the choices (runs, D)."""
        if self.binary and not self.flips:
            return self.action.table[choice[:, 0]].astype(np.int64)
        return choice.reshape(-1) if isinstance(self.view.action.space, Discrete) else choice

    def alternatives(self, choice: Choices) -> NDArray[Any]:
        """Return the alternative requests (A, sensors, N) of the choices (runs, D)."""
        taken, every = choice.T, np.arange(self.choices)[:, None, None]
        changed = np.eye(len(taken), dtype=np.bool_)[:, None, :, None]
        each = np.where(changed, 1 - taken if self.flips else every, taken)
        return self.action.decode(each.reshape(-1, *taken.shape))

    def arranged(self, choice: Choices, taken: Array, stepped: Array) -> Array:
        """Return the values (runs, D, C) of all choices, from taken and stepped (A, runs) ones."""
        values = stepped.T
        if not self.flips:
            return values.reshape(*choice.shape, -1)
        rest, request = np.broadcast_to(taken[:, None], values.shape), choice == 1
        return np.stack((np.where(request, values, rest), np.where(request, rest, values)), -1)
