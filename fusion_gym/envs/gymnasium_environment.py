"""Any Gymnasium environment as the plant: its observation is the state, an agent controls it."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.control import Controller
from fusion_gym.core.knowledge import Block
from fusion_gym.core.plant import Plant
from fusion_gym.core.task import CommonOptions, Scenario
from fusion_gym.core.token_bucket import Tokens
from fusion_gym.declaration import Mark
from fusion_gym.errors import ConfigurationError, refusal
from fusion_gym.importing import import_named
from fusion_gym.systems.bases import numbered_states
from fusion_gym.systems.nonlinear import FilteredEstimate, NonlinearEstimator, NonlinearSystem

_SEED, _EPISODES, _STEPS = 0, 20, 200  # of the episodes that fit a predictor and scale observations
_RANDOM = 0.2  # share of their actions that is random
_ACTIONS = (spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary, spaces.Box)
Function = Callable[..., Any]


def balance(observations: Array) -> NDArray[np.int64]:
    """Push the cart of CartPole-v1 (N, 4) to the side to which its pole falls."""
    angle, rate = observations.T[2:4]
    return (angle + 0.5 * rate > 0.0).astype(np.int64)


@dataclass(frozen=True)
class GymnasiumEnvironmentOptions(CommonOptions):
    """An environment of Gymnasium whose agent acts on an estimate of the observation.

    Sensors measure entries of the observation without noise. The centre holds or predicts the
    entries that are not transmitted, and the agent acts on this estimate after each delivery. The
    centre receives the first observation without charge.

    The cost of a step is ``best_reward`` less the environment's reward of the move before. A
    termination forfeits the rewards of all steps that are left, so an episode costs horizon ·
    ``best_reward`` less the environment's return.

    The states of live environments cannot branch: what simulates alternatives is refused.

    Starting state: the environment's own reset; its seed follows from the seed of the episode.

    The default is CartPole-v1 with one sensor of the cart and one of the pole.
    """

    env_id: str = "CartPole-v1"
    """Id of the environment, or ``"module:id"`` with a module to import first. Its observation is a
    vector."""
    env_kwargs: Mapping[str, Any] | None = None
    """Keyword arguments of ``gymnasium.make``, by default none."""
    controller: str | Callable[[Array], Any] = "fusion_gym.envs.gymnasium_environment:balance"
    """Agent that acts on the estimate: ``"model:PATH"`` of Stable-Baselines3, or a function from
    estimates (N, n) to actions (N,) or (N, k), or its ``"module:name"``. It must be
    deterministic."""
    sensor_indices: Sequence[Sequence[int]] = ((0, 1), (2, 3))
    """Entries of the observation that each sensor measures; together all entries."""
    predictor: str | Callable[[Array, Any], Any] = "hold"
    """Estimate of the entries that are not transmitted: ``"hold"`` keeps them, ``"linear"`` fits
    the next observation to observation and action, or a function from estimates (N, n) and actions
    to next estimates (N, n), or its ``"module:name"``."""
    best_reward: Annotated[float, Mark(validation.number)] = 1.0
    """Largest reward of a step."""
    horizon: Annotated[int, Mark(validation.integer, at_least=1)] = 200
    tokens: Tokens = "unlimited"
    token_cost: Any = 1.0
    cost_weight: float | Literal["random"] = 0.1
    reward_scale: float | Literal["auto"] | None = None


class Episode:
    """One episode of a live environment, which counts its moves and never goes back."""

    def __init__(self, pool: list[Any], make: Callable[[], Any]) -> None:
        self.pool, self.moves = pool, 0
        self.env = pool.pop() if pool else make()

    def __del__(self) -> None:
        if hasattr(self, "env"):
            self.pool.append(self.env)

    def move(self, moves: int, action: Any) -> tuple[Any, ...]:
        """Step the environment from its state after ``moves`` moves."""
        if moves != self.moves:
            raise ConfigurationError("the environment has moved on: its states cannot branch")
        self.moves += 1
        result: tuple[Any, ...] = self.env.step(action)
        return result

    def __reduce__(self) -> Any:
        raise ConfigurationError("a live environment cannot be copied: its states cannot branch")


@dataclass(slots=True)
class LiveState:
    """The true state of N runs at one time; n entries, l sensors, m channels.

    ``truth`` (n, N) · ``measurement`` (l, m, N) · ``loss`` (N,) of the last move · ``over`` (N,)
    bool, whether it ended the episode · ``moves`` (N,) · ``episodes`` (N,), the live environments.
    """

    truth: Array
    measurement: Array
    loss: Array
    over: NDArray[np.bool_]
    moves: NDArray[np.int64]
    episodes: NDArray[Any]


class GymnasiumSystem(NonlinearSystem):
    """An environment, its agent, and the predictor of the entries that are not transmitted.

    ``explained_variance`` (n,) is R² of the predictor's changes in episodes that did not fit it.
    """

    def __init__(self, options: GymnasiumEnvironmentOptions) -> None:
        self.options, self.pool = options, list[Any]()
        if not isinstance(options.env_kwargs, Mapping | None):
            raise refusal("env_kwargs", options.env_kwargs, "a dictionary of keyword arguments")
        observations, self.actions = _spaces(options.env_id, env := self.make())
        self.pool.append(env)
        self.low, self.high, self.dtype = observations.low, observations.high, observations.dtype
        size = observations.shape[0]
        self.indices = _indices(options.sensor_indices, size)
        self.agent = _agent(options.controller, observations, self.actions)
        zeros = np.zeros(size)
        super().__init__(
            numbered_states(size),
            sensors=len(self.indices),
            channels=max(map(len, self.indices)),
            process_channels=0,
            initial_mean=zeros,
            initial_covariance=np.diag(zeros),
            inputs=int(np.prod(self.actions.shape)) or 1,
        )
        self._fit(options.predictor)

    def make(self) -> Any:
        """Return a new environment without a limit of its steps."""
        options = self.options
        try:
            return gymnasium.make(
                options.env_id,
                max_episode_steps=-1,
                disable_env_checker=True,
                **(options.env_kwargs or {}),
            )
        except Exception as error:  # an environment may raise any exception
            reason = f"an id that gymnasium.make takes with env_kwargs ({error})"
            raise refusal("env_id", options.env_id, reason) from error

    def control(self, mean: Array) -> Array:
        """Return the agent's actions (k, N) on estimates (n, N)."""
        observations = np.clip(mean.T, self.low, self.high).astype(self.dtype)
        actions = np.asarray(self.agent(observations), dtype=np.float64)
        if isinstance(self.actions, spaces.Box):
            actions = np.clip(actions.reshape(-1, self.inputs), self.actions.low, self.actions.high)
        shape = (mean.shape[-1], self.inputs)
        if actions.size != np.prod(shape):
            allowed = f"a function that returns actions of shape {shape[:1]} or {shape}"
            raise ConfigurationError(f"controller is not allowed: it must be {allowed}")
        return actions.reshape(shape).T

    def action(self, control: Array) -> Any:
        """Return the environment's action of an input (k,)."""
        if isinstance(self.actions, spaces.Discrete):
            return int(control[0])
        return control.astype(self.actions.dtype)

    def move(self, state: Array, noise: Array) -> Array:
        """Not defined: the environment itself moves."""
        raise NotImplementedError

    def measure(self, state: Array, noise: Array) -> Array:
        """Return the entries of each sensor, zero where others have more."""
        result = np.zeros((self.sensors, self.channels, state.shape[-1]))
        for sensor, entries in enumerate(self.indices):
            result[sensor, : len(entries)] = state[list(entries)]
        return result

    def predict(self, mean: Array, covariance: Array, control: Array) -> tuple[Array, Array]:  # type: ignore[override]
        """Return the predictor's estimate within twice the range of the fit, and its covariance."""
        predicted = np.clip(self._predict(mean, control), *self._limits)
        moved = linalg.congruence(self._slope, covariance) + self._residual
        excess = (linalg.diagonal(moved) / self._largest[:, None]).max(0)
        return predicted, moved / np.maximum(excess, 1.0)

    def update(
        self, mean: Array, covariance: Array, sensor: int, measurement: Array
    ) -> tuple[Array, Array]:
        """Take the exact entries of a sensor one after another."""
        for place, entry in enumerate(self.indices[sensor]):
            variance = covariance[entry, entry]
            known = variance > 1e-14 * self._largest[entry]
            gain = np.where(known, covariance[:, entry] / np.where(known, variance, 1.0), 0.0)
            gain[entry] = 1.0
            mean = mean + gain * (measurement[place] - mean[entry])
            covariance = covariance - linalg.outer(gain, covariance[entry])
            covariance[entry] = covariance[:, entry] = 0.0
        return mean, covariance

    @functools.cached_property
    def typical(self) -> tuple[Array, Array]:
        """Root mean square and open-loop error variance (n,) of each entry in the episodes."""
        return self._magnitude, self._spread

    def _fit(self, predictor: Any) -> None:
        """Run episodes, and fit the predictor and the scales to them."""
        before, control, after, split = self._sample()
        change = after - before
        size = len(before)
        self._weights: Array | None = None
        self._function: Function | None = None
        slope = np.eye(size)
        if predictor == "linear":
            regressors = self._regressors(before, control)
            fit = np.linalg.lstsq(regressors[:, :split].T, change[:, :split].T, rcond=None)
            self._weights = weights = np.asarray(fit[0].T, dtype=np.float64)
            slope = slope + weights[:, :size]
        elif predictor != "hold":
            named = isinstance(predictor, str)
            self._function = import_named("predictor", predictor) if named else predictor
            if not callable(self._function):
                raise refusal("predictor", predictor, "'hold', 'linear' or a function")
        residual = (after - self._predict(before, control))[:, split:]
        total = ((change[:, split:] - change[:, split:].mean(1, keepdims=True)) ** 2).mean(1)
        error = residual @ residual.T / residual.shape[1]
        self.explained_variance = 1.0 - np.diag(error) / np.maximum(total, 1e-300)
        if predictor == "hold":
            error = np.diag(np.diag(error))
        low, high = after.min(1), after.max(1)
        self._limits = (1.5 * low - 0.5 * high)[:, None], (1.5 * high - 0.5 * low)[:, None]
        self._spread = np.maximum(after.var(1), 1e-12)
        self._largest = np.maximum((high - low) ** 2, 1e-12)
        self._magnitude = np.sqrt(np.maximum((after**2).mean(1), 1e-12))
        self._slope, self._residual = slope[..., None], error[..., None]

    def _predict(self, mean: Array, control: Array) -> Array:
        """Return the next estimate (n, N)."""
        if self._function is not None:
            actions = control.T if self.actions.shape else control[0].astype(np.int64)
            result = np.asarray(self._function(mean.T, actions), dtype=np.float64).T
            if result.shape != mean.shape:
                allowed = f"a function that returns the shape {mean.T.shape}, not {result.T.shape}"
                raise ConfigurationError(f"predictor is not allowed: it must be {allowed}")
            return result
        if self._weights is None:
            return mean
        moved: Array = mean + self._weights @ self._regressors(mean, control)
        return moved

    def _regressors(self, mean: Array, control: Array) -> Array:
        """Return estimate, action (a discrete one as a unit vector) and 1, (entries, N)."""
        if isinstance(self.actions, spaces.Discrete):
            control = 1.0 * (
                np.arange(int(self.actions.n))[:, None] == control - self.actions.start
            )
        return np.vstack((mean, control, np.ones((1, mean.shape[-1]))))

    def _sample(self) -> tuple[Array, Array, Array, int]:
        """Return observations, inputs and next observations, and the number of those that fit."""
        generator, steps, split = np.random.default_rng(_SEED), list[Any](), 0
        for number in range(_EPISODES):
            split = len(steps) if number == _EPISODES * 3 // 4 else split
            episode = Episode(self.pool, self.make)
            seen, _ = episode.env.reset(seed=number)
            self.actions.seed(number)
            for moves in range(_STEPS):
                control = self.control(np.asarray(seen, np.float64)[:, None])[:, 0]
                if generator.random() < _RANDOM:
                    control = np.array(self.actions.sample(), np.float64).reshape(-1)
                following, _, *ends, _ = episode.move(moves, self.action(control))
                steps.append((seen, control, following))
                seen = following
                if any(ends):
                    break
        before, control, after = (np.array(part, np.float64).T for part in zip(*steps, strict=True))
        return before, control, after, split


def _spaces(env_id: str, env: Any) -> tuple[spaces.Box, Any]:
    """Return checked spaces of observations and actions."""
    observations, actions = env.observation_space, env.action_space
    if not isinstance(observations, spaces.Box) or len(observations.shape) != 1:
        allowed = "an environment whose observation is a vector (FlattenObservation makes one)"
        raise refusal("env_id", env_id, f"{allowed}, not {observations}")
    if not isinstance(actions, _ACTIONS) or len(actions.shape or ()) > 1:
        raise refusal("env_id", env_id, f"an environment with numbers as action, not {actions}")
    return observations, actions


def _indices(value: Any, size: int) -> tuple[tuple[int, ...], ...]:
    """Return the checked entries of each sensor."""
    allowed = f"a list of entries from 0 to {size - 1} for each sensor, together all of them"
    try:
        result = tuple(tuple(int(entry) for entry in entries) for entries in value)
        exact = all(
            a == b for s, t in zip(result, value, strict=True) for a, b in zip(s, t, strict=True)
        )
    except (TypeError, ValueError):
        raise refusal("sensor_indices", value, allowed) from None
    every = [entry for entries in result for entry in entries]
    whole = set(every) == set(range(size)) and all(result)
    if not (exact and whole and all(len(set(s)) == len(s) for s in result)):
        raise refusal("sensor_indices", value, allowed)
    return result


def _agent(controller: Any, observations: spaces.Box, actions: Any) -> Function:
    """Return the agent as a function from observations (N, n) to actions."""
    if isinstance(controller, str):
        if controller.startswith("model:"):
            load = import_named("controller", "fusion_gym.policies.saved:load_controller")
            model = load(controller.removeprefix("model:"), observations, actions)
            return functools.partial(_predicted, model)
        controller = import_named("controller", controller)
    if not callable(controller):
        raise refusal("controller", controller, "a saved agent or a function")
    function: Function = controller
    return function


def _predicted(model: Any, observations: Array) -> Any:
    """Return the likeliest actions of a model of Stable-Baselines3."""
    return model.predict(observations, deterministic=True)[0]


class GymnasiumPlant(Plant[LiveState]):
    """The live environments of N runs."""

    noise_channels = 0
    start_channels = 1
    branches = False

    def __init__(self, system: GymnasiumSystem) -> None:
        self.system, self.state_names = system, system.state_names

    @property
    def sensor_count(self) -> int:
        """Number of sensors."""
        return self.system.sensors

    def start(self, noise: Array) -> tuple[LiveState, None]:
        """Reset the environments, with seeds from the noise."""
        runs = noise.shape[-1]
        episodes = np.empty(runs, dtype=object)
        episodes[:] = [Episode(self.system.pool, self.system.make) for _ in range(runs)]
        seeds = np.ascontiguousarray(noise[0]).view(np.uint64) >> np.uint64(21)
        seen = [e.env.reset(seed=int(seed))[0] for e, seed in zip(episodes, seeds, strict=True)]
        return self._state(np.array(seen, np.float64).T, np.zeros(runs), episodes, 0), None

    def sense(self, state: LiveState, noise: Array, control: Array) -> LiveState:  # type: ignore[override]
        """Step the environments that have not ended."""
        truth, loss, over = state.truth.copy(), np.zeros(len(state.loss)), state.over.copy()
        best = self.system.options.best_reward
        for run in np.flatnonzero(~over).tolist():
            episode, action = state.episodes[run], self.system.action(control[:, run])
            seen, reward, *ends, _ = episode.move(int(state.moves[run]), action)
            truth[:, run], loss[run], over[run] = seen, best - float(reward), any(ends)
        if not np.all(loss >= 0.0):
            raise refusal("best_reward", best, f"at least {best - loss.min():.6g}, which was paid")
        return self._state(truth, loss, state.episodes, state.moves + ~state.over, over)

    def _state(
        self, truth: Array, loss: Array, episodes: Any, moves: Any, over: Any = False
    ) -> LiveState:
        runs, (size, channels) = truth.shape[-1], (self.system.sensors, self.system.channels)
        measurement = self.system.measured(truth, np.zeros((size * channels, runs)))
        moves = np.broadcast_to(moves, runs).astype(np.int64)
        return LiveState(truth, measurement, loss, np.broadcast_to(over, runs), moves, episodes)

    def available(self, state: LiveState) -> tuple[NDArray[Any], NDArray[Any]]:
        """See :class:`Plant`; an episode that has ended has no readings."""
        everything = np.ones(state.truth.shape, dtype=np.bool_)
        return np.tile(~state.over, (self.sensor_count, 1)), everything

    def open_loop(self, horizon: int) -> Array:
        """Return the variance (n,) of the entries in episodes with transmissions."""
        return self.system.typical[1]


class GymnasiumEstimator(NonlinearEstimator):
    """The centre's estimate of the observation."""

    @property
    def observation(self) -> tuple[Block, ...]:
        """Blocks of the observation; what was held is compared on the scale of the fit."""
        first, held, *others = super().observation
        size = self.system.sensors * self.system.channels
        scale = self.system.measured(np.sqrt(self.system.typical[1])[:, None], np.zeros((size, 1)))
        scale = np.where(scale > 0.0, scale, 1.0)
        meaning = "new minus last delivered measurement, over the entry's deviation"
        compared = replace(
            held,
            meaning=meaning,
            value=lambda s: (s.measurement - s.held) / scale,
            constants={"entry's deviation": scale[..., 0]},
        )
        return (first, compared, *others)

    def start(self, measurement: Array, announcement: None) -> FilteredEstimate:
        """Return the first observation, which every node knows."""
        system, runs = self.system, measurement.shape[-1]
        mean = np.zeros((len(system.state_names), runs))
        for sensor, entries in enumerate(system.indices):  # type: ignore[attr-defined]
            mean[list(entries)] = measurement[sensor, : len(entries)]
        covariance = np.zeros((len(mean), *mean.shape))
        return FilteredEstimate.begin(measurement, mean, covariance, mean, covariance)


class AgentController(Controller):
    """The environment's agent, and the loss of its rewards."""

    def __init__(self, system: GymnasiumSystem) -> None:
        self.system = system

    def act(self, mean: Array) -> Array:
        """Return the agent's actions."""
        return self.system.control(mean)

    def cost(self, state: LiveState, control: Array) -> Array:
        """Return the loss of the last move."""
        return state.loss

    def terminated(self, state: LiveState) -> NDArray[np.bool_]:
        """Return the runs whose episode has ended."""
        return state.over

    def forfeit(self, state: LiveState) -> Array:
        """Return the best reward."""
        return np.full(len(state.loss), self.system.options.best_reward)


def build_gymnasium(options: GymnasiumEnvironmentOptions) -> Scenario:
    """Return the scenario of these options."""
    system = GymnasiumSystem(options)
    weights = 1.0 / (len(system.state_names) * system.typical[1])
    parts = GymnasiumPlant(system), GymnasiumEstimator(system)
    return Scenario(options, *parts, weights, controller=AgentController(system))
