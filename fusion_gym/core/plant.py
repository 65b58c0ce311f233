"""The contract of a plant: the truth that no policy knows, and its sensors."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Generic, TypeVar, cast

from numpy.typing import NDArray

from fusion_gym.arrays import Array
from fusion_gym.core.nature import AS_ASSUMED, Nature

StateT = TypeVar("StateT")
_NOTHING: Mapping[int, tuple[float, float]] = MappingProxyType({})


class Plant(ABC, Generic[StateT]):
    """Define a plant and its sensors for N runs at once.

    A state is a dataclass of arrays whose last axis is the batch; no method changes a state in
    place. In the shapes below n is the number of states, l of sensors, m of a sensor's channels.
    A state has the fields ``truth`` (n, N) and ``measurement`` (l, m, N), or the class overrides
    :meth:`truth` and :meth:`measurement`.

    Attributes:
        state_names: Names of the n states.
        nature: Departure of the truth from the model.
        traceable: Whether JAX traces the methods, so that compiled code and JAX run them, too.
        censored_beyond: Lowest and highest uncensored value of a state, by its number, for
            pictures.

    Example:
        >>> import numpy as np
        >>> import fusion_gym
        >>> plant = fusion_gym.make_task("fusion_gym/TobitOscillator-v1").plant
        >>> state, _ = plant.start(np.zeros((plant.start_channels, 4)))
        >>> state = plant.sense(state, np.zeros((plant.noise_channels, 4)))
        >>> plant.truth(state).shape, plant.measurement(state).shape
        ((2, 4), (3, 2, 4))
    """

    state_names: tuple[str, ...]
    nature: Nature = AS_ASSUMED
    traceable: bool = False
    censored_beyond: Mapping[int, tuple[float, float]] = _NOTHING

    @property
    @abstractmethod
    def sensor_count(self) -> int:
        """Number of sensors."""

    @property
    @abstractmethod
    def noise_channels(self) -> int:
        """Number of standard normals that :meth:`sense` takes per run."""

    @property
    @abstractmethod
    def start_channels(self) -> int:
        """Number of standard normals that :meth:`start` takes per run, including ``nature``."""

    @abstractmethod
    def start(self, noise: Array) -> tuple[StateT, Any]:
        """Return the state at time 0, and what the estimator knows of the start.

        A measurement of NaN is none.

        Args:
            noise: Standard normals (start_channels, N).
        """

    @abstractmethod
    def sense(self, state: StateT, noise: Array) -> StateT:
        """Return the state after a step of the plant and the new measurements.

        Args:
            state: Any state.
            noise: Standard normals (noise_channels, N).
        """

    def truth(self, state: StateT) -> Array:
        """Return the plant's state (n, N), for the reward and metrics, never for a policy.

        Args:
            state: Any state.
        """
        truth: Array = cast(Any, state).truth
        return truth

    def measurement(self, state: StateT) -> Array:
        """Return the new measurements (l, m, N).

        Args:
            state: State after :meth:`sense` or :meth:`start`.
        """
        measurement: Array = cast(Any, state).measurement
        return measurement

    @property
    def draw_channels(self) -> int | None:
        """Number of standard normals that :meth:`draw` takes per run; ``None`` if it cannot."""
        return None

    def draw(
        self, measurement: Array, mean: Array, covariance: Array, noise: Array, time: Array
    ) -> StateT:
        """Return a state that a policy imagines from a belief.

        The truth follows N(mean, covariance), and other quantities follow their own laws without a
        departure from the model.

        Args:
            measurement: The new measurements (l, m, N), which the state has.
            mean: (n, N).
            covariance: (n, n, N).
            noise: Standard normals (draw_channels, N).
            time: Sensings since the start (N,).
        """
        raise NotImplementedError(f"{type(self).__name__} does not offer 'draw'")

    def available(self, state: StateT) -> tuple[NDArray[Any], NDArray[Any]] | None:
        """Return the sensors (l, N) with a reading and the states (n, N) of known truth.

        A sensor without a reading cannot request, and errors of other states count as zero.
        ``None`` is all.

        Args:
            state: State after :meth:`sense`.
        """
        return None

    @abstractmethod
    def open_loop(self, horizon: int) -> Array:
        """Return the mean error variance (n,) over t = 1..horizon without any delivery.

        Args:
            horizon: Steps of an episode.
        """

    def rounding(self, horizon: int) -> tuple[float, float]:
        """Return two ratios that bound the loss of float64's precision; 0 if unknown.

        Args:
            horizon: Steps of an episode.

        Returns:
            The largest mean square of a measurement over its noise variance, and the largest ratio
            of a predicted variance to the variance after a packet that ends a silence.
        """
        return 0.0, 0.0
