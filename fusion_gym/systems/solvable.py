"""What solvers, references and JAX need of a plant or an estimator, which families extend."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any

from fusion_gym.arrays import Array
from fusion_gym.core.estimator import Estimator
from fusion_gym.core.plant import Plant, StateT


@dataclass(frozen=True)
class IndependentSources(Plant[StateT]):
    """A plant of n sources x(t+1) = a x(t) + w(t), w ~ N(0, σ²), each measured without noise.

    Shapes: ``coefficient`` a, ``deviation`` σ, ``initial_deviation`` of x(0): (n,).
    """

    state_names: tuple[str, ...]
    coefficient: Array
    deviation: Array
    initial_deviation: Array


class AgedSources(Plant[StateT]):
    """A plant of l independent sources whose error follows from the age of the last delivery."""

    @abstractmethod
    def age_costs(self, weights: Array, ages: int) -> Array:
        """Return the weighted traces (ages, l) of each source's error at the ages 0, 1, ….

        Args:
            weights: Weights of the states (n, 1).
            ages: Number of ages.
        """

    @property
    @abstractmethod
    def radii(self) -> Array:
        """Spectral radius (l,) of each source."""


@dataclass(frozen=True)
class LinearProblem:
    """A linear plant, all of its measurements, and a centre that predicts with its matrix.

    Shapes: ``transition`` A, ``process_covariance`` W, ``initial_covariance`` (n, n),
    ``measurement_matrix`` C (c, n) and ``noise_covariance`` R (c, c) of all c channels, without
    their censoring.
    """

    transition: Array
    process_covariance: Array
    initial_covariance: Array
    measurement_matrix: Array
    noise_covariance: Array


class LinearEstimator(Estimator[StateT]):
    """An estimator of a linear plant that may predict in silence with the plant's own matrix."""

    @abstractmethod
    def linear_problem(self, plant: Plant[Any], where: str) -> LinearProblem | None:
        """Return the problem of a plant, ``None`` if it is not a linear one that it senses whole.

        Args:
            plant: The truth.
            where: What needs the problem, for errors.

        Raises:
            ConfigurationError: The centre does more or less in silence than predict, or the truth
                departs from its model.
        """


class BoundingEstimator(Estimator[StateT]):
    """An estimator whose covariance is a bound, and which can also compute its errors' own."""

    @abstractmethod
    def with_actual_covariance(self) -> BoundingEstimator[StateT]:
        """Return the same estimator with tracked covariances of the errors."""

    @abstractmethod
    def error_covariance(self, state: StateT) -> Array:
        """Return the actual covariance (n, n, N) of the fused error.

        Args:
            state: State after :meth:`update`, of an estimator that tracks them.
        """


class ParametricEstimator(Estimator[StateT]):
    """An estimator whose filters have parameters, which JAX may vary."""

    @property
    @abstractmethod
    def parameters(self) -> dict[str, Array]:
        """Parameters by name; a scheduled one is absent."""

    @abstractmethod
    def with_parameters(self, **parameters: Array) -> Estimator[StateT]:
        """Return the estimator with other parameters; arrays of JAX allow derivatives.

        Args:
            **parameters: Values by name.
        """
