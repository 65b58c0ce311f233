"""PPO with credit over a window: many sets of requests of a decision branch.

From one state and on the same noise, each set runs on for some steps under the policy's likeliest
actions, by which it is used. A critic that sees the true error and the steps left values the end.
The advantage of a set is the policy's mean cost minus its cost, so it has no noise of other
decisions. The policy starts at a searched rule, whose log ratios are entries of its observation.
The saved model is an ordinary PPO model.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from fusion_gym import seeds
from fusion_gym.arrays import Array
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.knowledge import covers
from fusion_gym.core.memory import Memory
from fusion_gym.core.observation import ObservationLayout
from fusion_gym.core.runs import Runs
from fusion_gym.core.task import Task
from fusion_gym.entries import State
from fusion_gym.envs.sb3 import FusionSB3VecEnv
from fusion_gym.envs.views import LARGEST_RATIO, append_ratios, space_with_ratios
from fusion_gym.errors import forbidden, refusal
from fusion_gym.evaluation.episodes import run_priced
from fusion_gym.lowering import LoweringError
from fusion_gym.namespace import namespace
from fusion_gym.policies.base import refused_signals
from fusion_gym.policies.rules import PricedThreshold
from fusion_gym.policies.saved import calibration_rule

MOST_SETS = 64
_ALL = 3  # sensors of which any requests change; of more, at most two
_SLOPE = 3.0  # of the first logits on the rule's log ratios
_ALONE = 0.04  # share of the training in which only the critic learns
_SHORTEST = 10  # steps of a branch
_OFTEN = 0.6  # share of the episodes that have one of the validation's prices
_PRICES, _EPISODES = 9, 64  # of the rule's costs
_VALUE = 10.0  # steps of the rule's cost that one unit of the critic is
_FAR = 10.0  # advantage in units of the spread


@dataclass(frozen=True)
class RuleSignals:
    """A rule's log ratios (sensors, N) and the errors (n, N) of a row."""

    rule: PricedThreshold

    def __call__(self, runs: Runs) -> Sequence[Any]:
        """Return the arrays of runs."""
        rule, task = self.rule, self.rule.task
        local = not covers(rule.knowledge, "centre")
        ratio = rule.log_ratio(runs.signals().limit(refused_signals(rule, task), local))
        state, xp = runs.state, namespace(ratio)
        error = task.plant.truth(state.plant) - task.estimator.mean(state.estimate)
        shape = task.sensors, error.shape[-1]
        ratio = xp.clip(xp.broadcast_to(ratio, shape), -LARGEST_RATIO, LARGEST_RATIO)
        return ratio, error


class RuleVecEnv(FusionSB3VecEnv):
    """Runs whose observations end with the log ratios of a rule.

    Args:
        task: the task.
        num_envs: number of runs.
        rule: text of a priced_threshold, which knows no more than the agent.
        prices: prices of a token that most episodes have.
        **options: as of :class:`~fusion_gym.envs.sb3.FusionSB3VecEnv`.

    Raises:
        ConfigurationError: another rule, or one that knows more.
    """

    def __init__(
        self, task: Task, num_envs: int, *, rule: str, prices: Sequence[float], **options: Any
    ) -> None:
        super().__init__(task, num_envs, **options)
        self.text, self.rule, self.prices = rule, calibration_rule(rule, task), prices
        if not covers(self.view.knowledge, self.rule.knowledge):
            allowed = f"a rule that knows what the agent knows ({self.view.knowledge})"
            raise refusal("rule", rule, allowed)
        self.owner = self.rule.memory_owner or self.view.owner or "scheduler"
        self.batch = EpisodeBatch(task, num_envs, self.owner)
        self.observation_space = space_with_ratios(self.view, True)
        self.branches: Branches | None = None  # of a training

    def snapshot(self) -> State:
        """Return the state of all runs and branches for :meth:`restore`."""
        return super().snapshot() | {"branches": self.branches and self.branches.changing_state}

    def restore(self, snapshot: State) -> None:
        """Set all runs and branches to a :meth:`snapshot`."""
        super().restore(snapshot)
        vars(self.branches).update(snapshot["branches"])

    def _observe(self) -> NDArray[np.float32]:
        return append_ratios(super()._observe(), RuleSignals(self.rule)(self.batch)[0].T)


class BranchedDecisions(NamedTuple):
    """B decisions of runs, each with A sets of requests.

    Args:
        observations: (B, entries), or with local decisions (B, sensors, entries).
        privileged: inputs of the critic (B, entries).
        sets: (B, A, sensors), float32.
        old: log-probabilities (B, A) of the sets before the update.
        advantages: (B, A).
        values: cost (B,) up to the end of the episode beyond the rule's, in units of the critic.
    """

    observations: torch.Tensor
    privileged: torch.Tensor
    sets: torch.Tensor
    old: torch.Tensor
    advantages: torch.Tensor
    values: torch.Tensor


class Branches:
    """N runs in machine code, whose decisions branch.

    Costs are relative to the rule's cost per step at the price of the run.

    Args:
        env: the training's environment.
        window: steps of a branch, in mean times between two packets of the rule.
        seed: seed of the noise.

    Attributes:
        timesteps: steps of all branches so far.
        changes: (A, sensors) bool, which requests of the likeliest action each set changes.

    Raises:
        ConfigurationError: too many sensors, or a task that machine code does not run.
    """

    def __init__(self, env: RuleVecEnv, window: float, seed: int | None) -> None:
        from fusion_gym.core.compiled import CompiledStep

        task, sensors = env.task, env.task.sensors
        self.env, self.window, self.random = env, window, np.random.default_rng(seed)
        self.changes = changes_of(sensors, env.view.action.bits)
        if len(self.changes) > MOST_SETS:
            allowed = f"fewer: {len(self.changes)} sets of requests branch, at most {MOST_SETS}"
            raise refusal("sensors", sensors, allowed, "with algorithm 'branching_ppo'")
        memory, layout = Memory(task, env.owner), ObservationLayout(task, env.owner)
        try:
            task.refuse_numpy_only()
            sizes = sensors, len(task.plant.state_names)
            self.step = CompiledStep(task, memory, layout, sizes, RuleSignals(env.rule))
        except LoweringError as error:
            reason = f"machine code does not run it ({error}); use counterfactual_ppo"
            raise forbidden("algorithm", "branching_ppo", reason) from None
        self._prices = np.geomspace(min(env.prices), max(env.prices), _PRICES)
        each = np.repeat(self._prices, _EPISODES)
        numbers = seeds.TUNING.start + np.tile(np.arange(_EPISODES), _PRICES)
        means = run_priced(task, env.rule, numbers, each)
        parts = means.cost(each), means.rate.sum(-1)
        cost, packets = (part.reshape(_PRICES, -1).mean(1) for part in parts)
        self._costs, self._packets = np.maximum(cost, 1e-12), packets
        weights = np.asarray(task.reward.state_weights)
        self._weights = np.sqrt(weights if weights.ndim == 1 else weights.diagonal())
        runs = np.arange(env.runs)
        self.rows = np.empty((env.runs, self.step.width))
        self._buffers = np.empty((2, env.runs * len(self.changes), self.step.width))
        self.timesteps = 0
        self.price, self.left = np.ones(env.runs), np.zeros(env.runs, dtype=np.int64)
        self._begin(runs, self.random.integers(1, task.horizon + 1, env.runs))

    @property
    def changing_state(self) -> State:
        """What a step changes."""
        return {name: vars(self)[name] for name in ("random", "rows", "price", "left")}

    def _begin(self, runs: NDArray[np.int64], left: Any) -> None:
        """Begin episodes of ``left`` steps in ``runs``."""
        if not runs.size:
            return
        drawn = self.env.task.reward.price.draw(self.random.random(runs.size))
        often = self.random.choice(self.env.prices, runs.size)
        self.price[runs] = np.where(self.random.random(runs.size) < _OFTEN, often, drawn)
        self.left[runs] = left
        start, noise = (
            self._normals(len(own), runs.size) for own in (self.step.start_noise, self.step.noise)
        )
        self.rows[runs] = self.step.begin(start, noise, self.price[runs], self.left[runs])

    def _normals(self, channels: int, runs: int) -> Array:
        return self.random.standard_normal((channels, runs))

    def unit(self, price: Array) -> Array:
        """Return the rule's cost per step at prices."""
        return np.exp(np.interp(np.log(price), np.log(self._prices), np.log(self._costs)))

    def windows(self, price: Array) -> NDArray[np.int64]:
        """Return the steps of branches at prices."""
        horizon = self.env.task.horizon
        packets = np.interp(np.log(price), np.log(self._prices), self._packets)
        steps = np.ceil(self.window / np.maximum(packets, self.window / horizon))
        return np.clip(steps, min(_SHORTEST, horizon), horizon).astype(np.int64)

    def observations(self, rows: Array) -> torch.Tensor:
        """Return the policy's observations of rows."""
        view = self.env.view
        own = view.rows(self.step.observation(rows))
        result = torch.as_tensor(append_ratios(own, rows[:, self.step.further[0]]))
        return result.reshape(len(rows), -1, result.shape[1]) if view.local else result

    def privileged(self, rows: Array, price: Array, left: NDArray[np.int64]) -> torch.Tensor:
        """Return the critic's inputs: all observations, errors in units of the cost, steps left."""
        ratio, error = (rows[:, part] for part in self.step.further)
        error = error * self._weights / np.sqrt(self.unit(price))[:, None]
        square = np.log1p((error * error).sum(1, keepdims=True))
        error, share = np.sign(error) * np.log1p(np.abs(error)), left / self.env.task.horizon
        parts = self.step.observation(rows), ratio / LARGEST_RATIO, error, square, share[:, None]
        return torch.as_tensor(np.concatenate(parts, axis=1).astype(np.float32))

    def requests(self, logits: torch.Tensor) -> NDArray[np.bool_]:
        """Return the requests (N, sensors) of the likeliest actions."""
        return self.env.view.action.choose(logits.numpy().T, np.zeros(1)).T

    def decide(
        self,
        logits_of: Callable[[torch.Tensor], torch.Tensor],
        value_of: Callable[[torch.Tensor], torch.Tensor],
    ) -> BranchedDecisions:
        """Branch the decisions of all runs, and move each run into the branch that it chooses.

        Args:
            logits_of: function from observations to the logits (B, sensors) of requests.
            value_of: function from the critic's inputs to values (B,).
        """
        count, width = len(self.rows), len(self.changes)
        observations = self.observations(self.rows)
        privileged = self.privileged(self.rows, self.price, self.left)
        logits = logits_of(observations)
        likeliest = self.requests(logits)[:, None] & self.env.view.action.bits
        own = likeliest ^ self.changes  # requests of the sets (N, A, sensors)
        sets = torch.as_tensor(own, dtype=torch.float32)
        old = log_probabilities(logits, sets)
        noise = self.random.gumbel(size=old.shape)
        choice = (old.numpy() + noise).argmax(1)
        window, unit = self.windows(self.price), self.unit(self.price)
        moment = np.ceil(self.random.random(count) * window)  # at which a run goes on
        cost, steps, over = np.zeros((count, width)), np.zeros(count, np.int64), moment < 0
        run, branch = np.indices((count, width)).reshape(2, -1)  # of each lane
        first, second = self._buffers  # memory that is used again
        lanes = np.take(self.rows, run, axis=0, out=first, mode="clip")
        requests, successor = own[run, branch], self.rows.copy()
        for step in range(1, window.max() + 1):
            if step > 1:
                requests = self.requests(logits_of(self.observations(lanes)))
            noise, after = self._normals(len(self.step.noise), count), second[: len(run)]
            began = time.perf_counter()
            self.step.move(lanes, requests.T, noise[:, run], after, torch.get_num_threads())
            self.env.seconds += time.perf_counter() - began
            self.timesteps += len(run)
            outcome = self.step.outcome(after)
            charge = self.price[run] * outcome.cost - outcome.reward_error
            cost[run, branch] += charge / unit[run]
            leaves = (branch == choice[run]) & (steps[run] == 0)
            leaves &= outcome.ended | (moment[run] == step)
            place = run[leaves]
            successor[place], over[place], steps[place] = after[leaves], outcome.ended[leaves], step
            last = ~outcome.ended & (window[run] == step)
            left = self.left[run[last]] - step
            end = value_of(self.privileged(after[last], self.price[run[last]], left)).numpy()
            cost[run[last], branch[last]] += _VALUE * end + left
            (stays,) = np.nonzero(~outcome.ended & ~last)
            if not stays.size:
                break
            first, second, lanes = second, first, after
            if stays.size < run.size:
                run, branch = run[stays], branch[stays]
                first, second = second, first
                lanes = np.take(after, stays, axis=0, out=first[: stays.size], mode="clip")
        costs = np.nan_to_num(cost, nan=1e6, posinf=1e6)
        mean = (np.exp(old.numpy()) * costs).sum(1, keepdims=True)
        values = (mean[:, 0] - self.left) / _VALUE
        self.rows, self.left = successor, self.left - steps
        self._begin(np.flatnonzero(over), self.env.task.horizon)
        real = (torch.as_tensor(part, dtype=torch.float32) for part in (mean - costs, values))
        return BranchedDecisions(observations, privileged, sets, old, *real)


def changes_of(sensors: int, several: bool) -> NDArray[np.bool_]:
    """Return the changes (A, sensors) of requests that branch, of one sensor or of several."""
    most = 1 if not several else sensors if sensors <= _ALL else 2
    places = [own for size in range(most + 1) for own in combinations(range(sensors), size)]
    return np.array([np.isin(np.arange(sensors), own) for own in places])


def log_probabilities(logits: torch.Tensor, sets: torch.Tensor) -> torch.Tensor:
    """Return the log-probabilities (B, A) of sets (B, A, sensors) from logits (B, sensors)."""
    return torch.log_softmax((logits[:, None] * sets).sum(-1), dim=1)


class BranchingPPO(PPO):
    """PPO whose advantages come from branches over a window.

    Each update has one decision of every run. The surrogate and its clipping are from Schulman et
    al. 2017, as a sum over all sets. The entropy keeps every set in the sum, whereas branches and
    use follow the likeliest action.

    Args:
        policy: class of the policy.
        env: a RuleVecEnv.
        window: steps of a branch, in mean times between two packets of the rule.
        **kwargs: arguments of PPO.
    """

    policy: Any
    clip_range: Any

    def __init__(self, policy: Any, env: Any, *, window: float = 1.0, **kwargs: Any) -> None:
        self.window = window
        size = 2 if env is None else max(2, env.num_envs)
        super().__init__(policy, env, n_steps=1, batch_size=size, **kwargs)

    def _setup_model(self) -> None:
        super()._setup_model()
        env = None if self.env is None else self.env.unwrapped
        if env is None:  # a model for use, not for training
            return
        if not isinstance(env, RuleVecEnv):
            raise refusal("env", type(env).__name__, "a RuleVecEnv", "with branches")
        self._branches = branches = env.branches = Branches(env, self.window, self.seed)
        places = env.view.action.places(self.policy.action_net.out_features)
        assert places is not None  # or the table of algorithms refuses the action
        self._places, ratios = places, env.task.sensors // env.view.rows_per_run
        self._masks = _start_at_rule(self.policy, places, ratios)
        inputs = branches.privileged(branches.rows, branches.price, branches.left).shape[1]
        self.critic = nn.Sequential(*create_mlp(inputs, 1, self.policy.net_arch, nn.SiLU))
        for parameter in self.critic[-1].parameters():
            nn.init.zeros_(parameter)
        self.critic_optimizer = torch.optim.Adam(self.critic.parameters())

    def _excluded_save_params(self) -> list[str]:
        own = ["_branches", "_decisions", "_masks", "critic", "critic_optimizer"]
        return [*super()._excluded_save_params(), *own]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        modules, tensors = super()._get_torch_save_params()
        return [*modules, "critic", "critic_optimizer"], tensors

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:
        """Branch a decision of every run; false if a callback ends it."""
        self.policy.set_training_mode(False)
        callback.on_rollout_start()
        before = self._branches.timesteps
        with torch.no_grad():
            self._decisions = self._branches.decide(self._logits, self._value)
        self.num_timesteps += self._branches.timesteps - before
        goes_on = callback.on_step()
        callback.on_rollout_end()
        return goes_on

    def train(self) -> None:
        """Improve policy and critic on the last decisions."""
        self.policy.set_training_mode(True)
        optimizers = self.policy.optimizer, self.critic_optimizer
        self._update_learning_rate([*optimizers])
        observations, privileged, sets, old, advantages, values = self._decisions
        left = self._current_progress_remaining
        weight, lowest = old.exp(), 1.0 - float(self.clip_range(left))
        spread = (weight * advantages**2).sum(1).mean().sqrt() + 1e-8
        advantages = (advantages / spread).clamp(-_FAR, _FAR)
        entries = []
        for _ in range(self.n_epochs):
            new = log_probabilities(self._logits(observations), sets)
            ratio = (new - old).exp()
            clipped = ratio.clamp(lowest, 1.0 / lowest)
            gain = torch.minimum(ratio * advantages, clipped * advantages)
            policy, entropy = -(weight * gain).sum(1).mean(), -(new.exp() * new).sum(1).mean()
            value = nn.functional.smooth_l1_loss(self._value(privileged), values)
            for optimizer in optimizers:
                optimizer.zero_grad()
            (policy - self.ent_coef * entropy + value).backward()
            for parameter, mask in self._masks:
                assert parameter.grad is not None
                parameter.grad *= mask
            for network in (self.policy, self.critic):
                nn.utils.clip_grad_norm_(network.parameters(), self.max_grad_norm)
            for optimizer in optimizers if left <= 1.0 - _ALONE else optimizers[1:]:
                optimizer.step()
            entries.append([part.item() for part in (policy, value, -entropy, spread)])
            self._n_updates += 1
        names = "policy_gradient_loss", "value_loss", "entropy_loss", "advantage_spread"
        for name, entry in zip(names, np.mean(entries, axis=0), strict=True):
            self.logger.record(f"train/{name}", float(entry))
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

    def _logits(self, observations: torch.Tensor) -> torch.Tensor:
        """Return the logits (B, sensors) of requests over silence."""
        outputs = self.policy.action_net(self.policy.mlp_extractor.forward_actor(observations))
        silence = 0.0 if self._places == slice(None) else outputs[..., :1]
        return (outputs[..., self._places] - silence).reshape(len(observations), -1)

    def _value(self, inputs: torch.Tensor) -> torch.Tensor:
        result: torch.Tensor = self.critic(inputs)[:, 0]
        return result


def _start_at_rule(
    policy: Any, places: slice, ratios: int
) -> list[tuple[nn.Parameter, torch.Tensor]]:
    """Set the logits to a multiple of the last inputs, the rule's log ratios.

    Two units of each layer pass a ratio on, because silu(z) - silu(-z) = z. The training changes
    only the multiples: the masks of the gradients are returned, each with its parameter.
    """
    layers = [part for part in policy.mlp_extractor.policy_net if isinstance(part, nn.Linear)]
    units = slice(2 * ratios)
    if min((layer.out_features for layer in layers), default=0) < units.stop:
        raise refusal("hidden", policy.net_arch, f"layers of at least {units.stop} units")
    pair = torch.cat((torch.eye(ratios), -torch.eye(ratios)))  # of units, from ratios
    masks, last = [], policy.action_net
    with torch.no_grad():
        for number, layer in enumerate(layers):
            inputs = units if number else slice(-ratios, None)
            for parameter in (layer.weight, layer.bias):
                parameter[units] = 0.0
                mask = torch.ones_like(parameter)
                mask[units] = 0.0
                masks.append((parameter, mask))
            layer.weight[units, inputs] = pair @ pair.T if number else pair
        last.weight.zero_()
        last.bias.zero_()
        last.weight[places, units] = _SLOPE * pair.T
        mask = torch.ones_like(last.weight)
        mask[:, units] = (last.weight[:, units] != 0.0).float()
    return [*masks, (last.weight, mask)]
