"""Environments as pure functions under ``jax.jit``, with the interface of gymnax 1.

    env, params = fusion_gym.jax.make("fusion_gym/TobitOscillator-v1", filter="tobit")
    observation, state = env.reset(key, params)
    observation, state, reward, terminated, truncated, info = env.step(key, state, action, params)

The import switches JAX to 64 bits. A state is of one run; ``jax.vmap`` makes a batch.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple, cast

import numpy as np
from gymnasium import spaces

from fusion_gym.core.access import access_mask
from fusion_gym.core.memory import Memory
from fusion_gym.core.observation import ObservationLayout
from fusion_gym.core.options import CommonOptions
from fusion_gym.core.runs import Branch, Outcome, Position
from fusion_gym.core.system import Signals
from fusion_gym.core.task import Task
from fusion_gym.envs.registration import make_task
from fusion_gym.envs.views import SchedulerView
from fusion_gym.errors import refusal
from fusion_gym.fusion.rules import InformationFusion
from fusion_gym.importing import require
from fusion_gym.systems.remote.system import RemoteEstimationState, RemoteEstimationSystem
from fusion_gym.systems.tobit.system import CensoredState, CensoredSystem

require("an environment under JAX", "jax", "jax")
import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402

jax.config.update("jax_enable_x64", True)
for _kind in (CensoredState, RemoteEstimationState):
    _names = [field.name for field in dataclasses.fields(_kind)]
    jax.tree_util.register_dataclass(_kind, _names, [])


class EnvParams(NamedTuple):
    """The parameters of an environment that ``jax.vmap`` and ``jax.grad`` may vary.

    ``None`` is the value of the options, or a parameter that the environment does not have.

    Args:
        price: Price of a token.
        process_covariance: W (n, n) of the filters.
        measurement_variance: R (sensors, m) of the filters.
        information_shares: Shares (sensors,) of the feedback, of sum 1.

    Example:
        >>> import fusion_gym.jax
        >>> fusion_gym.jax.EnvParams(price=0.5).price
        0.5
    """

    price: Any = None
    process_covariance: Any = None
    measurement_variance: Any = None
    information_shares: Any = None


class FunctionalEnv:
    """An environment of one run whose methods are pure functions.

    Args:
        task: The task, without memory.

    Attributes:
        task: The task.
        default_params: Parameters of the options.

    Raises:
        ConfigurationError: The task does not run under JAX.

    Example:
        >>> import fusion_gym.jax
        >>> task = fusion_gym.make_task("fusion_gym/LinearFusion-v2")
        >>> env = fusion_gym.jax.FunctionalEnv(task)
        >>> env.num_actions, env.observation_space().shape
        (2, (13,))
    """

    def __init__(self, task: Task) -> None:
        self.task, system = task, task.system
        refuse(task)
        self._memory, self._layout = Memory(task, "scheduler"), ObservationLayout(task)
        self._view = SchedulerView(task)
        price = task.reward.price.fixed
        self.default_params = EnvParams(price)
        if isinstance(system, CensoredSystem):
            shares = getattr(getattr(system.centre, "feedback", None), "share", None)
            self.default_params = EnvParams(
                price,
                system.model.process_covariance[..., 0],
                system.centre.sensors.variance[..., 0],
                None if shares is None else shares[:, 0],
            )

    @property
    def name(self) -> str:
        """Name of the system."""
        return type(self.task.system).__name__

    @property
    def num_actions(self) -> int:
        """Number of actions of a ``Discrete`` space, or of bits."""
        space = self._view.actions
        return int(space.n) if isinstance(space, spaces.Discrete) else self.task.sensors

    def action_space(self, params: EnvParams | None = None) -> Any:
        """Return the action space."""
        return self._view.actions

    def observation_space(self, params: EnvParams | None = None) -> spaces.Box:
        """Return the observation space (entries,) float32."""
        return self._view.space

    @functools.partial(jax.jit, static_argnums=0)
    def reset(self, key: Any, params: EnvParams | None = None) -> tuple[Any, Position]:
        """Return the first observation (entries,) and state of an episode.

        Args:
            key: Key of ``jax.random``.
            params: Parameters, by default of the options.
        """
        start, first, price = jax.random.split(key, 3)
        noise = jax.random.normal(start, (self.task.system.start_channels, 1))
        uniform = jax.random.uniform(price, (1,))
        return self.reset_env(noise, self._normals(first), uniform, params)

    @functools.partial(jax.jit, static_argnums=0)
    def step(
        self, key: Any, state: Position, action: Any, params: EnvParams | None = None
    ) -> tuple[Any, Position, Any, Any, Any, dict[str, Any]]:
        """Return observation, state, reward, terminated, truncated and info of a step.

        An episode that ends is reset: ``info["final_observation"]`` has its last observation. A
        truncated episode continues in truth, so a learner bootstraps from that observation.

        Args:
            key: Key of ``jax.random``.
            state: State of the run.
            action: Action of :meth:`action_space`.
            params: Parameters, by default of the options.
        """
        noise, again = jax.random.split(key)
        last, moved, outcome = self.step_env(self._normals(noise), state, action, params)
        observation, fresh = self.reset(again, params)
        ended = outcome.ended[0]
        terminated = ended & self.task.clock
        info = {
            "cost": outcome.cost[0],
            "reward_error": outcome.reward_error[0],
            "reward_cost": outcome.reward_communication[0],
            "granted": outcome.granted[:, 0],
            "denied": (outcome.requested & ~outcome.granted)[:, 0],
            "squared_error": outcome.squared_error[:, 0],
            "diverged": outcome.diverged[0],
            "final_observation": last,
        }
        observation = jnp.where(ended, observation, last)
        state = jax.tree.map(functools.partial(jnp.where, ended), fresh, moved)
        return observation, state, outcome.reward[0], terminated, ended & ~terminated, info

    def reset_env(
        self, start: Any, noise: Any, uniform: Any, params: EnvParams | None = None
    ) -> tuple[Any, Position]:
        """Return observation (entries,) and state of a new episode with given noise.

        Args:
            start: Standard normals (start_channels, 1).
            noise: Standard normals (channels, 1) of the first measurement.
            uniform: Number (1,) in [0, 1) that draws a random price.
            params: Parameters, by default of the options.
        """
        task, steps = self._task(params), cast(Any, jnp.zeros(1, dtype=np.int64))
        price: Any = task.reward.price.draw(uniform)
        if params is not None and params.price is not None:
            price = jnp.full(1, params.price)
        system, noise = task.system, jnp.asarray(noise)
        first = system.start(cast(Any, jnp.asarray(start)))
        position = Position(
            system.sense(first, noise[: system.noise_channels]),
            task.bucket.start(1),
            price,
            steps,
            steps + task.horizon,
            task.bucket.start_queue(1),
            self._admitted(steps, noise),
        )
        position = jax.tree.map(jnp.asarray, position)
        return self._runs(task, position).observe()[0], position

    def step_env(
        self, noise: Any, state: Position, action: Any, params: EnvParams | None = None
    ) -> tuple[Any, Position, Outcome]:
        """Return observation (entries,), state and outcome of a step with given noise, no reset.

        Args:
            noise: Standard normals (channels, 1).
            state: State of the run.
            action: Action of :meth:`action_space`.
            params: Parameters, by default of the options.
        """
        runs = self._runs(self._task(params), state)
        outcome = runs.step(self.requests(action), cast(Any, jnp.asarray(noise)))
        return runs.observe()[0], runs.position(), outcome

    def signals(self, state: Position, params: EnvParams | None = None) -> Signals:
        """Return the signals of a state, for ``innovation_threshold`` and other rules.

        Args:
            state: State of the run; axes N have the length 1.
            params: Parameters, by default of the options.
        """
        return self._runs(self._task(params), state).signals()

    def requests(self, action: Any) -> Any:
        """Return the requests (sensors, 1) bool of an action.

        Args:
            action: Action of :meth:`action_space`.

        Raises:
            ValueError: The action has another shape.
        """
        action, shape = jnp.asarray(action), self._view.actions.shape
        if action.shape != shape:
            raise ValueError(f"action of shape {action.shape} is not allowed: it must be {shape}")
        if isinstance(self._view.actions, spaces.MultiBinary):
            return action.reshape(-1, 1).astype(np.bool_)
        sensors = jnp.arange(self.task.sensors)[:, None]
        if self.task.access == "single":
            return action == sensors + 1
        return (action >> sensors & 1).astype(np.bool_)

    def _normals(self, key: Any) -> Any:
        channels = self.task.system.noise_channels + (self.task.access == "random")
        return jax.random.normal(key, (channels, 1))

    def _admitted(self, steps: Any, noise: Any) -> Any:
        return access_mask(self.task.access, self.task.sensors, steps, noise[-1])

    def _runs(self, task: Task, position: Position) -> Branch:
        return Branch(task, self._memory, self._layout, position)

    def _task(self, params: EnvParams | None) -> Task:
        """Return the task with the filters' parameters."""
        values = {} if params is None else params._asdict()
        values.pop("price", None)
        changed = {name: value for name, value in values.items() if value is not None}
        if not changed:
            return self.task
        if not isinstance(self.task.system, CensoredSystem):
            raise refusal("params", sorted(changed), "only price", f"in {self.name}")
        return dataclasses.replace(self.task, system=self.task.system.with_model(**changed))


class FiveValueEnv(FunctionalEnv):
    """An environment with the ``step`` of gymnax before version 1.

    Args:
        task: The task, without memory.

    Raises:
        ConfigurationError: The task does not run under JAX.

    Example:
        >>> import fusion_gym.jax, jax
        >>> task = fusion_gym.make_task("fusion_gym/LinearFusion-v2", action="discrete")
        >>> env, key = fusion_gym.jax.FiveValueEnv(task), jax.random.key(0)
        >>> observation, state, reward, done, info = env.step(key, env.reset(key)[1], 3)
        >>> bool(done)
        False
    """

    def step(  # type: ignore[override]
        self, key: Any, state: Position, action: Any, params: EnvParams | None = None
    ) -> tuple[Any, Position, Any, Any, dict[str, Any]]:
        """Return observation, state, reward, done and info of a step.

        Args:
            key: Key of ``jax.random``.
            state: State of the run.
            action: Action of :meth:`action_space`.
            params: Parameters, by default of the options.
        """
        *values, terminated, truncated, info = super().step(key, state, action, params)
        info |= {"terminated": terminated, "truncated": truncated}
        return values[0], values[1], values[2], terminated | truncated, info


def refuse(task: Task) -> None:
    """Refuse a task that does not run under JAX.

    Args:
        task: The task.

    Raises:
        ConfigurationError: The system, its fusion rule, its memory or its error function is
            NumPy's only.
    """
    system = task.system
    if not isinstance(system, CensoredSystem | RemoteEstimationSystem):
        raise refusal("system", type(system).__name__, "a system that JAX runs")
    if system.nature.departing:
        raise refusal(system.nature.departing[0], "a departure", "the default under JAX")
    if task.memory or task.belief_features:
        raise refusal("memory", True, "False under JAX")
    if callable(task.reward.error):
        raise refusal("error", task.reward.error_kind, "'squared', 'trace' or 'maximum' under JAX")
    fusion = getattr(getattr(system, "centre", None), "fusion", None)
    if fusion is not None and not isinstance(fusion, InformationFusion):
        raise refusal("fusion", type(fusion).__name__, "'federated' under JAX")


def make(env: str | CommonOptions, /, **options: Any) -> tuple[FunctionalEnv, EnvParams]:
    """Return an environment that runs under ``jax.jit``, and its parameters.

    Args:
        env: An id, or an options object.
        **options: Options of the environment, as of :func:`fusion_gym.make_task`.

    Raises:
        ConfigurationError: An option is not allowed, or does not run under JAX.

    Example:
        >>> import fusion_gym.jax, jax
        >>> env, params = fusion_gym.jax.make("fusion_gym/RemoteEstimation-v1", horizon=50)
        >>> observation, state = env.reset(jax.random.key(0), params)
        >>> observation, state, *_ = env.step(jax.random.key(1), state, [1], params)
        >>> observation.shape, int(state.steps[0])
        ((3,), 1)
    """
    result = FunctionalEnv(make_task(env, **options))
    return result, result.default_params
