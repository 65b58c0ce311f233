"""Environments as pure functions under ``jax.jit``, with the interface of gymnax 1.

    env, params = fusion_gym.jax.make("fusion_gym/TobitOscillator-v1", filter="tobit")
    observation, state = env.reset(key, params)
    observation, state, reward, terminated, truncated, info = env.step(key, state, action, params)

The import switches JAX to 64 bits. A state is of one run; ``jax.vmap`` makes a batch.
"""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numpy as np
from gymnasium import spaces

from fusion_gym.core.jax_setup import jax
from fusion_gym.core.knowledge import Signals
from fusion_gym.core.memory import Memory
from fusion_gym.core.observation import ObservationLayout
from fusion_gym.core.runs import Branch, Outcome, Position, advance, start_of
from fusion_gym.core.task import CommonOptions, Task
from fusion_gym.envs.registration import make_task
from fusion_gym.envs.vector import ends_of, step_infos
from fusion_gym.envs.views import SchedulerView
from fusion_gym.errors import refusal
from fusion_gym.systems.solvable import ParametricEstimator

jnp = jax.numpy


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
        task.refuse_numpy_only()
        self.task = task
        self.__setstate__({})
        estimator = task.estimator
        self._memory, self._layout = Memory(task, "scheduler"), ObservationLayout(task)
        for name in ("memory", "belief_features"):
            if value := getattr(task.options, name):
                raise refusal(name, value, "the default", "in pure functions")
        self._view = SchedulerView(task)
        self._starts = task.plant.start_channels + task.network.start_channels
        self._channels = task.plant.noise_channels + task.network.noise_channels
        known = estimator.parameters if isinstance(estimator, ParametricEstimator) else {}
        self.default_params = EnvParams(task.reward.price.fixed, **known)

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        channels = self.task.plant.start_channels + self.task.network.start_channels
        _register_state(start_of(self.task, np.zeros((channels, 1)))[0])

    @property
    def name(self) -> str:
        """Name of the estimator."""
        return type(self.task.estimator).__name__

    @property
    def num_actions(self) -> int:
        """Number of actions of a ``Discrete`` space, or of bits or channels."""
        space = self._view.action.space
        return int(space.n) if isinstance(space, spaces.Discrete) else int(space.shape[0])

    def action_space(self, params: EnvParams | None = None) -> Any:
        """Return the action space."""
        return self._view.action.space

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
        return _for_one_run(self._begin)(params, key, ())

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
        requests = self.requests(action)[:, 0]
        observation, state, results = _for_one_run(self._move)(params, (key, requests), state)
        return observation, state, *results

    def _begin(self, params: EnvParams | None, keys: Any, _: tuple[()]) -> tuple[Any, Position]:
        """Return observations (N, entries) and state of N runs from their keys."""
        noise, price = jax.vmap(jax.random.split, out_axes=1)(keys)
        noise = _normals(noise, self._starts + self._channels)
        uniform = jax.vmap(jax.random.uniform)(price)
        start, first = noise[: self._starts], noise[self._starts :]
        return self._started(start, first, uniform, params)

    def _move(
        self, params: EnvParams | None, inputs: tuple[Any, Any], state: Position
    ) -> tuple[Any, Position, tuple[Any, ...]]:
        """Return observations, state and results of N runs from keys and requests (N, sensors)."""
        keys, requests = inputs
        noise, again = jax.vmap(jax.random.split, out_axes=1)(keys)
        task = self._task(params)
        runs = self._runs(task, state)
        outcome = runs.step(requests.T, _normals(noise, self._channels))
        last, moved, ended = runs.observe(), runs.position(), outcome.ended

        def renew(moved: Position) -> Position:
            fresh = self._begin(params, again, ())[1]
            return jax.tree.map(functools.partial(jnp.where, ended), fresh, moved)

        moved = jax.lax.cond(ended.any(), renew, lambda moved: moved, moved)
        info = step_infos(outcome) | {"final_observation": last}
        results = outcome.reward, *ends_of(task, outcome), info
        return self._runs(task, moved).observe(), moved, results

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
        observation, state = self._started(start, noise, uniform, params)
        return observation[0], state

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

    def expected_step(
        self, noise: Any, state: Position, probability: Any, params: EnvParams | None = None
    ) -> tuple[Position, Outcome]:
        """Return state and outcome of a step, averaged over random requests.

        The result is a smooth function of the probabilities, for a trigger that is learned by its
        gradient. Whole numbers, such as places in the queue, come from a step without requests.

        Args:
            noise: Standard normals (channels, 1).
            state: State of the run.
            probability: Probability (sensors,) of each sensor's request, independent of the others.
            params: Parameters, by default of the options.
        """
        count = self.task.sensors
        requests = (np.arange(2**count)[:, None] >> np.arange(count) & 1).astype(np.bool_)
        weights = jnp.where(requests, probability, 1.0 - jnp.asarray(probability)).prod(1)
        task = self._task(params)

        def step(own: Any) -> tuple[Position, Outcome]:
            branch = self._runs(task, state)
            outcome = branch.step(own[:, None], cast(Any, jnp.asarray(noise)))
            return branch.position(), outcome

        def average(values: Any) -> Any:
            whole = not jnp.issubdtype(values.dtype, jnp.floating)
            return values[0] if whole else jnp.tensordot(weights, values, 1)

        return jax.tree.map(average, jax.vmap(step)(jnp.asarray(requests)))

    def signals(self, state: Position, params: EnvParams | None = None) -> Signals:
        """Return the signals of a state, for ``innovation_threshold`` and other rules.

        Args:
            state: State of the run; axes N have the length 1.
            params: Parameters, by default of the options.
        """
        return self._runs(self._task(params), state).signals()

    def requests(self, action: Any) -> Any:
        """Return the requests (sensors, 1) bool of an action, or the channels of an assignment.

        Args:
            action: Action of :meth:`action_space`.

        Raises:
            ValueError: The action has another shape.
        """
        action, shape = jnp.asarray(action), self._view.action.space.shape
        if action.shape != shape:
            raise ValueError(f"action of shape {action.shape} is not allowed: it must be {shape}")
        return self._view.action.decode(action.reshape(-1, 1))

    def _started(
        self, start: Any, noise: Any, uniform: Any, params: EnvParams | None
    ) -> tuple[Any, Position]:
        task = self._task(params)
        start, noise = jnp.asarray(start), jnp.asarray(noise)
        steps = cast(Any, jnp.zeros(noise.shape[1], dtype=np.int64))
        price: Any = task.reward.price.draw(uniform)
        if params is not None and params.price is not None:
            price = params.price
        first = _each_run(lambda own: start_of(task, own)[0], start)
        state = advance(task, first, noise, steps)
        prices = cast(Any, jnp.broadcast_to(price, steps.shape))
        position = Position(state, prices, steps, steps + task.horizon)
        position = jax.tree.map(jnp.asarray, position)
        return self._runs(task, position).observe(), position

    def _runs(self, task: Task, position: Position) -> Branch:
        return Branch(task, self._memory, self._layout, position)

    def _task(self, params: EnvParams | None) -> Task:
        """Return the task with the filters' parameters."""
        values = {} if params is None else params._asdict()
        values.pop("price", None)
        changed = {name: value for name, value in values.items() if value is not None}
        if not changed:
            return self.task
        estimator = self.task.estimator
        if not isinstance(estimator, ParametricEstimator):
            raise refusal("params", sorted(changed), "only price", f"in {self.name}")
        return dataclasses.replace(self.task, estimator=estimator.with_parameters(**changed))


def _register_state(state: Any) -> None:
    """Register the dataclasses of states with JAX, through tuples and dataclasses."""
    if isinstance(state, tuple):
        for part in state:
            _register_state(part)
    elif dataclasses.is_dataclass(state):
        names = [field.name for field in dataclasses.fields(state)]
        if jax.tree_util.all_leaves([state]):
            jax.tree_util.register_dataclass(type(state), names, [])
        for name in names:
            _register_state(getattr(state, name))


def _refuse_in_forks(owner: type, *methods: str) -> None:
    """Make methods raise in a fork of a process that has run JAX, whose threads are absent."""

    def refuse(*_: Any, **__: Any) -> None:
        raise RuntimeError(
            "JAX may hang in a fork of a process that has run it: use the start method 'spawn'"
        )

    def forked() -> None:
        for method in methods if jax._src.xla_bridge.backends_are_initialized() else ():
            setattr(owner, method, refuse)

    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=forked)


def _normals(keys: Any, channels: int) -> Any:
    """Return standard normals (channels, N) from N keys."""
    return jax.vmap(lambda key: jax.random.normal(key, (channels,)))(keys).T


def _each_run(function: Callable[[Any], Any], noise: Any) -> Any:
    """Return a state (…, N) of noise (channels, N), whose constants do not have N entries."""
    states = jax.vmap(lambda own: function(own[:, None]), 1, -1)(noise)
    return jax.tree.map(lambda x: x[..., 0, :], jax.lax.optimization_barrier(states))


def _for_one_run(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of N runs as one of a single run, which ``jax.vmap`` turns back.

    Otherwise the batch axis would be the first one, and a step several times slower.

    Args:
        function: From parameters, arrays (N, …) and a state (…, N) to a tuple of arrays (N, …) and
            a state in second place.
    """

    def single(params: Any, inputs: Any, state: Any) -> Any:
        first, moved, *rest = function(params, jax.tree.map(lambda x: x[None], inputs), state)
        first, rest = jax.tree.map(lambda x: x[0], (first, rest))
        return first, moved, *rest

    def several(size: int, mapped: Any, params: Any, inputs: Any, state: Any) -> Any:
        axes = jax.tree.map(lambda own: 0 if own else None, tuple(mapped))
        if any(jax.tree.leaves(mapped[0])):
            result = jax.vmap(single, axes, axis_size=size)(params, inputs, state)
        else:
            whole = jax.vmap(lambda *values: values, axes, axis_size=size)(params, inputs, state)
            runs = jax.tree.map(lambda x: jnp.moveaxis(x[..., 0], 0, -1), whole[2])
            first, moved, *rest = function(params, whole[1], runs)
            moved = jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0)[..., None], moved)
            result = first, moved, *rest
        return result, jax.tree.map(lambda _: True, result)

    mapped = jax.custom_batching.custom_vmap(single)
    mapped.def_vmap(several)

    def depending(params: Any, inputs: Any, state: Any) -> Any:
        """Make every result depend on the inputs: JAX loses the axes of constants."""
        result = single(params, inputs, state)
        return jax.tree.map(lambda x: jnp.where(result[0].sum() > 0.0, x, x), result)

    differentiable = jax.custom_vjp(mapped)  # custom_vmap has no derivatives
    differentiable.defvjp(lambda *values: jax.vjp(depending, *values), lambda f, g: f(g))
    return differentiable


_refuse_in_forks(
    FunctionalEnv, "reset", "step", "reset_env", "step_env", "expected_step", "signals"
)


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
        """Return observation, state, reward (float32), done and info of a step.

        Args:
            key: Key of ``jax.random``.
            state: State of the run.
            action: Action of :meth:`action_space`.
            params: Parameters, by default of the options.
        """
        *values, terminated, truncated, info = super().step(key, state, action, params)
        info |= {"terminated": terminated, "truncated": truncated}
        return *values[:2], values[2].astype(np.float32), terminated | truncated, info


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
