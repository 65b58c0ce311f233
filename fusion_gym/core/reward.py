"""What the answer is worth: the error, and the price of a token."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.options import ErrorKind
from fusion_gym.importing import import_named, name_of
from fusion_gym.validation import ConfigurationError

Cost = Callable[[Array, Array], Any]  # of errors (n, N) and covariances (n, n, N)
ERROR_KINDS: tuple[str, ...] = get_args(ErrorKind)
TRAINING_ERRORS = ("squared", "excess", "mismatch")
_LARGEST = 1e32  # of squares on average: rewards are also handed on as float32


def equal_weights(open_loop: Array) -> Array:
    """Weights (n,) by which every state counts alike and open loop (n,) costs one.

    Raises:
        ConfigurationError: a state that is known without any transmission.
    """
    if np.any(open_loop <= 0.0):
        raise _at_rest(open_loop)
    return 1.0 / (len(open_loop) * open_loop)


def _at_rest(open_loop: Array) -> ConfigurationError:
    """The error of a plant some of whose states are known without any transmission."""
    return ConfigurationError(
        f"a squared error of {validation.display(open_loop)} without transmissions is not allowed: "
        "every state must be moved by noise before the horizon, or be uncertain at the start"
    )


def _cost(error: str | Cost, states: int) -> str | Cost:
    """A kind as it is, or the function that ``error`` is or names, tried out on some errors.

    Raises:
        ConfigurationError: neither, or a function that cannot be imported or is of another kind.
    """
    own = import_named("error", error) if isinstance(error, str) and ":" in error else error
    if own not in ERROR_KINDS if isinstance(own, str) else not callable(own):
        listed = ", ".join(repr(kind) for kind in ERROR_KINDS)
        near = validation.nearest(own, ERROR_KINDS) if isinstance(own, str) else None
        hint = f" (did you mean {near!r}?)" if near else ""
        allowed = f"one of {listed}, a function, or 'module:name' of one{hint}"
        raise validation.refusal("error", own, allowed)
    if not isinstance(own, str):
        name = error if isinstance(error, str) else name_of(own)
        errors = np.ones((states, states + 1))
        try:
            _own_cost(own, name, errors, errors[:, None] * np.eye(states)[:, :, None])
        except ConfigurationError:
            raise
        except Exception as reason:  # whatever its own code raises
            text = " ".join(f"{type(reason).__name__}: {reason}".split())
            raise ConfigurationError(
                f"error = {name!r} is not allowed: it must take errors (n, N) and covariances "
                f"(n, n, N), and return numbers >= 0 (N,) ({text})"
            ) from reason
    return own


def _own_cost(function: Cost, name: str, error: Array, covariance: Array) -> Array:
    """What a function of one's own returns, checked; ``name`` is what an error calls it."""
    values = np.asarray(function(error, covariance), dtype=np.float64)
    if values.shape != error.shape[1:] or not np.all(values >= 0.0):
        raise ConfigurationError(
            f"error = {name!r} is not allowed: of errors {error.shape} it must "
            f"return numbers >= 0 of shape {error.shape[1:]}, and returned "
            f"{validation.display(values)} of shape {values.shape}"
        )
    return values


@dataclass(frozen=True)
class Reward:
    """reward = -(error_weight · D + price · tokens spent), D what an error costs.

    ``error="squared"`` takes D = Σᵢ wᵢ eᵢ² of the error e of the fused estimate, ``"maximum"``
    D = maxᵢ wᵢ eᵢ², ``"trace"`` D = Σᵢ wᵢ Pᵢᵢ of the covariance P as the filter claims it (which a
    policy can game, see the documentation). A function takes e (n, N) = truth - estimate and
    P (n, n, N), and returns D (N,) >= 0; the weights w, of shape (n, 1), are not in it.
    """

    error: str | Cost
    error_weight: float
    price: Price
    state_weights: Array

    @classmethod
    def create(
        cls,
        error: str | Cost,
        error_weight: float,
        price: Price,
        state_weights: ArrayLike | None,
        open_loop: Array,
    ) -> Reward:
        """Check the weights; ``None`` weighs all states alike so that open loop costs 1.

        ``error`` is a kind, a function, or ``module:name`` of one. ``open_loop`` (n,) is the mean
        error variance of each state without any transmission.

        Raises:
            ConfigurationError: an unknown kind, a function that cannot be imported, a negative
                weight, a wrong shape, or weights that make of the error without transmissions more
                than can be worked with.
        """
        if state_weights is None and not open_loop.sum() > 0.0:
            raise _at_rest(open_loop)
        weights = (
            np.full(open_loop.shape, 1.0 / open_loop.sum())
            if state_weights is None
            else validation.not_negative("state_weights", state_weights, open_loop.shape)
        )
        weight = validation.number("error_weight", error_weight, at_least=0.0)
        if not weight * (weights @ open_loop) <= _LARGEST:
            raise ConfigurationError(
                f"error_weight = {weight:g} is not allowed with state_weights = "
                f"{validation.display(weights)}: without transmissions the error may cost up to "
                f"{_LARGEST:g} a step, not {weight * (weights @ open_loop):g}"
            )
        return cls(
            error=_cost(error, len(open_loop)),
            error_weight=weight,
            price=price,
            state_weights=weights[:, None],
        )

    @property
    def error_kind(self) -> str:
        """The kind of the error's term, or the name of its function."""
        return self.error if isinstance(self.error, str) else name_of(self.error)

    def terms(
        self, error: Array, covariance: Array, spent: Array, price: Array
    ) -> tuple[Array, Array]:
        """The two terms of the reward (N,), both <= 0: error and cost.

        From errors (n, N), the fused covariance (n, n, N), tokens spent (N,) and the price of a
        token (N,).

        Raises:
            ConfigurationError: a function of one's own returns no numbers >= 0 of shape (N,).
        """
        return -self.error_weight * self._error_cost(error, covariance), -price * spent

    def _error_cost(self, error: Array, covariance: Array) -> Array:
        if self.error == "squared":
            return np.asarray((self.state_weights * (error * error)).sum(0))
        if self.error == "trace":
            return np.asarray((self.state_weights * linalg.diagonal(covariance)).sum(0))
        if self.error == "maximum":
            return np.asarray((self.state_weights * (error * error)).max(0))
        assert not isinstance(self.error, str)
        return _own_cost(self.error, self.error_kind, error, covariance)

    def training_error(self, kind: str, error: Array, reference_error: Array) -> Array:
        """The error's term of the reward (…,) to train with, of errors (n, …): truth - estimate.

        With x̂ the fused estimate, and x* the one that takes in every measurement, whose error is
        ``reference_error`` (n, …): ``"squared"`` is ‖x - x̂‖², ``"excess"`` ‖x - x̂‖² - ‖x - x*‖²,
        which differs by what no policy can change, ``"mismatch"`` ‖x* - x̂‖², all weighted. If x*
        is the conditional mean given all that x̂ and the policy use, the last two have the same
        mean, and the mismatch the least noise.
        """
        if kind == "mismatch":
            squared = (error - reference_error) ** 2
        elif kind == "excess":
            squared = error * error - reference_error * reference_error
        else:
            squared = error * error
        result = -self.error_weight * np.tensordot(self.state_weights[:, 0], squared, axes=1)
        return np.asarray(result)


@dataclass(frozen=True)
class Price:
    """What a token costs in the reward.

    ``fixed`` is the price, or ``None`` where each episode draws its own, evenly in the logarithm,
    from ``span`` (low, high). With a span the observation shows the price, so that one agent can
    learn the whole trade-off between error and transmissions.
    """

    fixed: float | None
    span: tuple[float, float] | None = None

    @classmethod
    def create(cls, cost_weight: Any, price_range: Any = None) -> Price:
        """The options ``cost_weight`` (a number >= 0 or "random") and ``price_range``.

        Raises:
            ConfigurationError: a negative price, a range that is not 0 < low < high, a random
                price without a range, or a fixed one outside its range.
        """
        span = None if price_range is None else _span(price_range)
        if isinstance(cost_weight, str):
            validation.choice("cost_weight", cost_weight, ("random",))
            if span is None:
                raise ConfigurationError(
                    "price_range = None is not allowed with cost_weight='random': it must be a "
                    "pair (low, high) with 0 < low < high"
                )
            return cls(None, span)
        price = validation.number("cost_weight", cost_weight, at_least=0.0)
        if span is not None and not span[0] <= price <= span[1]:
            raise ConfigurationError(
                f"cost_weight = {price} is not allowed: it must lie in price_range = {list(span)}"
            )
        return cls(price, span)

    def draw(self, uniform: Array) -> Array:
        """Prices (N,) from uniform numbers in [0, 1); fixed ones do not depend on them."""
        if self.fixed is not None or self.span is None:
            return np.full(uniform.shape, self.fixed)
        low, high = self.span
        return low * (high / low) ** uniform

    def encode(self, price: Array) -> Array:
        """Position of the price in the range, 0 to 1 in the logarithm; same shape.

        Raises:
            ConfigurationError: there is no range.
        """
        if self.span is None:
            raise ConfigurationError("price_range = None is not allowed here: no price is observed")
        low, high = self.span
        return np.log(price / low) / math.log(high / low)

    def scale(self, price: Array, exponent: float) -> Array:
        """(geometric mean of the range / price)^exponent, same shape; 1 without a range.

        Multiplying an episode's rewards by it changes no policy that is best for its price, and
        brings what a decision is worth at low and at high prices closer together: at a price p the
        decisions that are hard to make are worth about p.
        """
        if self.span is None:
            return np.ones(price.shape)
        return np.asarray((math.sqrt(self.span[0] * self.span[1]) / price) ** exponent)


def _span(value: Any) -> tuple[float, float]:
    pair = validation.positive("price_range", validation.array("price_range", value, (2,)), (2,))
    low, high = pair.tolist()
    if low >= high:
        raise ConfigurationError(
            f"price_range = {[low, high]} is not allowed: it must be a pair with 0 < low < high"
        )
    return low, high
