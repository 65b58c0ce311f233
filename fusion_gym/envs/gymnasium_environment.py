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
from fusion_gym.envs.predictor import Predictor, action_of, check_indices, check_spaces, sample
from fusion_gym.errors import ConfigurationError, refusal
from fusion_gym.importing import import_named
from fusion_gym.systems.bases import numbered_states
from fusion_gym.systems.nonlinear import FilteredEstimate, NonlinearEstimator, NonlinearSystem


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

    Live environments cannot branch, so policies that simulate alternatives raise an error.

    Starting state: the environment's own reset; its seed follows from the seed of the episode.

    The default is CartPole-v1 with one sensor of the cart and one of the pole.

    Example:
        >>> import fusion_gym
        >>> def swing(observations):
        ...     return -observations[:, 1:2] - 0.5 * observations[:, 2:]
        >>> task = fusion_gym.make_task(
        ...     "fusion_gym/GymnasiumEnvironment-v1",
        ...     env_id="Pendulum-v1",
        ...     controller=swing,
        ...     sensor_indices=[[0, 1], [2]],
        ...     best_reward=0.0,
        ... )
        >>> task.plant.system.predictor.explained_variance.shape
        (3,)
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
    """One episode of a live environment, which counts its moves and never goes back.

    A pickle holds the seed and the actions, and repeats them where it is read.
    """

    def __init__(
        self, pool: list[Any], make: Callable[[], Any], seed: int, actions: Sequence[Any] = ()
    ) -> None:
        self.pool, self.make, self.seed, self.actions = pool, make, seed, list(actions)
        self.env = pool.pop() if pool else make()
        self.first, _ = self.env.reset(seed=seed)
        for action in actions:
            self.env.step(action)

    def __del__(self) -> None:
        if hasattr(self, "env"):
            self.pool.append(self.env)

    def move(self, moves: int, action: Any) -> tuple[Any, ...]:
        """Step the environment from its state after ``moves`` moves."""
        if moves != len(self.actions):
            raise ConfigurationError("the environment has moved on: its states cannot branch")
        self.actions.append(action)
        result: tuple[Any, ...] = self.env.step(action)
        return result

    def __reduce__(self) -> Any:
        return Episode, ([], self.make, self.seed, self.actions)


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
    """An environment, its agent, and the predictor of the entries that are not transmitted."""

    def __init__(self, options: GymnasiumEnvironmentOptions) -> None:
        if not isinstance(options.env_kwargs, Mapping | None):
            raise refusal("env_kwargs", options.env_kwargs, "a dictionary of keyword arguments")
        self.make = functools.partial(_make, options.env_id, dict(options.env_kwargs or {}))
        self.best_reward, env = options.best_reward, self.make()
        self.pool: list[Any] = [env]
        check_spaces("env_id", options.env_id, env)
        self.dtype, self.actions = env.observation_space.dtype, env.action_space
        size = env.observation_space.shape[0]
        self.indices = check_indices(options.sensor_indices, size)
        self.agent = _agent(options.controller, env.observation_space, self.actions)
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
        samples = sample(env, self.control)
        self.predictor = Predictor(options.predictor, env, samples)
        moments = (samples.after**2).mean(1), samples.after.var(1)
        magnitude, variance = np.maximum(moments, 1e-12)
        self.typical = np.sqrt(magnitude), variance

    def control(self, mean: Array) -> Array:
        """Return the agent's actions (k, N) on estimates (n, N)."""
        actions = np.asarray(self.agent(mean.T.astype(self.dtype)), dtype=np.float64)
        shape = (mean.shape[-1], self.inputs)
        if actions.size != np.prod(shape):
            allowed = f"a function that returns actions of shape {shape[:1]} or {shape}"
            raise ConfigurationError(f"controller is not allowed: it must be {allowed}")
        actions = actions.reshape(shape)
        if isinstance(self.actions, spaces.Box):
            actions = np.clip(actions, self.actions.low, self.actions.high)
        return actions.T

    def move(self, state: Array, noise: Array) -> Array:
        """Raise an error, because the environment itself moves."""
        raise NotImplementedError("the environment itself moves")

    def measure(self, state: Array, noise: Array) -> Array:
        """Return the entries of each sensor, zero where others have more."""
        result = np.zeros((self.sensors, self.channels, state.shape[-1]))
        for sensor, entries in enumerate(self.indices):
            result[sensor, : len(entries)] = state[list(entries)]
        return result

    def predict(self, mean: Array, covariance: Array, control: Array) -> tuple[Array, Array]:  # type: ignore[override]
        """Return the predictor's estimate and its covariance, of at most the range of the fit."""
        predictor = self.predictor
        moved = linalg.congruence(predictor.slope[..., None], covariance)
        moved = moved + predictor.residual[..., None]
        excess = (linalg.diagonal(moved) / predictor.ranges[:, None] ** 2).max(0)
        return predictor(mean, control), moved / np.maximum(excess, 1.0)

    def update(
        self, mean: Array, covariance: Array, sensor: int, measurement: Array
    ) -> tuple[Array, Array]:
        """Take the exact entries of a sensor one after another."""
        for place, entry in enumerate(self.indices[sensor]):
            variance = covariance[entry, entry]
            known = variance > 1e-14 * self.predictor.ranges[entry] ** 2
            gain = np.where(known, covariance[:, entry] / np.where(known, variance, 1.0), 0.0)
            gain[entry] = 1.0
            mean = mean + gain * (measurement[place] - mean[entry])
            covariance = covariance - linalg.outer(gain, covariance[entry])
            covariance[entry] = covariance[:, entry] = 0.0
        return mean, covariance


def _make(env_id: str, env_kwargs: dict[str, Any]) -> Any:
    """Return a new environment without a limit of its steps and without wrappers that check."""
    try:
        env = gymnasium.make(env_id, max_episode_steps=-1, disable_env_checker=True, **env_kwargs)
    except Exception as error:  # an environment may raise any exception
        reason = f"an id that gymnasium.make takes with env_kwargs ({error})"
        raise refusal("env_id", env_id, reason) from error
    return env.env if isinstance(env, gymnasium.wrappers.OrderEnforcing) else env


def _agent(controller: Any, observations: spaces.Box, actions: Any) -> Any:
    """Return the agent as a function from observations (N, n) to actions."""
    if isinstance(controller, str):
        if controller.startswith("model:"):
            load = import_named("controller", "fusion_gym.policies.saved:load_controller")
            model = load(controller.removeprefix("model:"), observations, actions)
            return functools.partial(_predicted, model)
        controller = import_named("controller", controller)
    if not callable(controller):
        raise refusal("controller", controller, "a saved agent or a function")
    return controller


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
        seeds = np.ascontiguousarray(noise[0]).view(np.uint64) >> np.uint64(21)
        pool, make, episodes = self.system.pool, self.system.make, np.empty(runs, dtype=object)
        episodes[:] = [Episode(pool, make, seed) for seed in seeds.tolist()]
        first = np.array([episode.first for episode in episodes], np.float64)
        return self._state(first.T, np.zeros(runs), episodes, 0), None

    def sense(self, state: LiveState, noise: Array, control: Array) -> LiveState:  # type: ignore[override]
        """Step the environments that have not ended."""
        truth, loss, over = state.truth.copy(), np.zeros(len(state.loss)), state.over.copy()
        best, actions = self.system.best_reward, self.system.actions
        for run in np.flatnonzero(~over).tolist():
            episode, action = state.episodes[run], action_of(actions, control[:, run])
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

    def picture(self, state: LiveState, run: int) -> NDArray[np.uint8] | None:
        """Return the environment's picture, with ``render_mode`` "rgb_array" in ``env_kwargs``."""
        env = state.episodes[run].env
        return np.asarray(env.render()) if env.render_mode == "rgb_array" else None

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
        return np.full(len(state.loss), self.system.best_reward)


def build_gymnasium(options: GymnasiumEnvironmentOptions) -> Scenario:
    """Return the scenario of these options."""
    system = GymnasiumSystem(options)
    weights = 1.0 / (len(system.state_names) * system.typical[1])
    plant, centre = GymnasiumPlant(system), GymnasiumEstimator(system)
    agent, picture = AgentController(system), plant.picture
    return Scenario(options, plant, centre, weights, controller=agent, picture=picture)
