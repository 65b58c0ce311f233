"""The reward: the error term and the price of tokens."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.declaration import Mark, OptionGroup, Scaling
from fusion_gym.errors import forbidden
from fusion_gym.importing import import_named, name_of
from fusion_gym.namespace import namespace
from fusion_gym.validation import ConfigurationError

ErrorKind = Literal["squared", "trace", "maximum"]
Cost = Callable[[Array, Array], Any]  # of errors (n, N) and covariances (n, n, N)
ERROR_KINDS: tuple[str, ...] = get_args(ErrorKind)
TRAINING_ERRORS = ("squared", "excess", "mismatch")
_LARGEST = 1e32  # mean square; rewards become float32


def equal_weights(open_loop: Array) -> Array:
    """Return weights 1/(n vᵢ) (n,) of open-loop variances vᵢ, so that open loop costs 1."""
    if np.any(open_loop <= 0.0):
        raise _at_rest(open_loop)
    return 1.0 / (len(open_loop) * open_loop)


def checked_weights(value: ArrayLike, states: int) -> Array:
    """Return weights (n,) or a matrix (n, n) with entries off its diagonal."""
    name, shape = "state_weights", validation.array_shape(value)
    if shape is None or len(shape) < 2:
        return validation.not_negative(name, value, (states,))
    matrix = validation.covariance(name, value, states)
    diagonal: Array = np.diagonal(matrix)
    return matrix if np.count_nonzero(matrix - np.diag(diagonal)) else diagonal.copy()


def _separate(weights: Array, where: str) -> Array:
    """Return weights (n,), or refuse a matrix."""
    if weights.ndim > 1:
        raise validation.refusal("state_weights", weights, "a number for each state", where)
    return weights


def reward_weights(
    options: RewardOptions, state_weights: ArrayLike | None, open_loop: Array
) -> Array:
    """Return the checked weights (n,) or (n, n) of the states' errors.

    Args:
        options: Options with a number or ``None`` as ``reward_scale``.
        state_weights: Weights if the options have none; ``None`` weighs all states equally so that
            open loop costs 1.
        open_loop: Mean error variance (n,) of each state without any transmission.

    Raises:
        ConfigurationError: A weight is negative or has a wrong shape, or the open-loop cost exceeds
            the limit.
    """
    weights = state_weights if options.state_weights is None else options.state_weights
    if options.reward_scale is not None:
        factor = validation.number("reward_scale", options.reward_scale, above=0.0)
        ratios = np.ones(()) if weights is None else weights
        weights = factor * checked_weights(ratios, len(open_loop))
    if weights is None:
        if not open_loop.sum() > 0.0:
            raise _at_rest(open_loop)
        weights = np.full(open_loop.shape, 1.0 / open_loop.sum())
    result, weight = checked_weights(weights, len(open_loop)), options.error_weight
    deviation = np.sqrt(open_loop)
    most = result @ open_loop if result.ndim == 1 else deviation @ abs(result) @ deviation
    if not weight * most <= _LARGEST:
        raise ConfigurationError(
            f"error_weight = {weight:g} is not allowed with state_weights = "
            f"{validation.display(result)}: without transmissions the error may cost up to "
            f"{_LARGEST:g} a step, not {weight * most:g}"
        )
    return result


def _at_rest(open_loop: Array) -> ConfigurationError:
    """Return the error of a plant with a state that is known without transmissions."""
    return ConfigurationError(
        f"a squared error of {validation.display(open_loop)} without transmissions is not "
        "allowed: every state must have noise before the horizon, or an uncertain start"
    )


def _cost(error: str | Cost, states: int) -> str | Cost:
    """Return the error kind, or the function of ``error`` after a test on sample errors."""
    own = import_named("error", error) if isinstance(error, str) and ":" in error else error
    if own not in ERROR_KINDS if isinstance(own, str) else not callable(own):
        listed = ", ".join(repr(kind) for kind in ERROR_KINDS)
        near = validation.nearest(own, ERROR_KINDS) if isinstance(own, str) else None
        hint = f" (did you mean {near!r}?)" if near else ""
        allowed = f"one of {listed}, a function, or its 'module:name'{hint}"
        raise validation.refusal("error", own, allowed)
    if not isinstance(own, str):
        name = error if isinstance(error, str) else name_of(own)
        errors = np.ones((states, states + 1))
        try:
            _own_cost(own, name, errors, errors[:, None] * np.eye(states)[:, :, None])
        except ConfigurationError:
            raise
        except Exception as reason:  # a user's function may raise any exception
            text = " ".join(f"{type(reason).__name__}: {reason}".split())
            raise ConfigurationError(
                f"error = {name!r} is not allowed: it must take errors (n, N) and covariances "
                f"(n, n, N), and return numbers >= 0 (N,) ({text})"
            ) from reason
    return own


def _own_cost(function: Cost, name: str, error: Array, covariance: Array) -> Array:
    """Return the checked values of a user's function."""
    values = np.asarray(function(error, covariance), dtype=np.float64)
    if values.shape != error.shape[1:] or not np.all(values >= 0.0):
        raise ConfigurationError(
            f"error = {name!r} is not allowed: for errors {error.shape} it must return numbers >= "
            f"0 of shape {error.shape[1:]}, but it returned {validation.display(values)} of shape "
            f"{values.shape}"
        )
    return values


@dataclass(frozen=True)
class RewardOptions(OptionGroup):
    """The options of the reward."""

    reward: Literal["scalar", "vector"] = "scalar"
    """``"scalar"`` returns the sum of the reward's two terms, ``"vector"`` both terms."""
    error: ErrorKind | str | Callable[[Array, Array], Any] = "squared"
    """Error term of the reward: ``"squared"`` is Σ w_i e_i², ``"trace"`` is Σ w_i P_ii of the
    estimated covariance P (which a policy can exploit), ``"maximum"`` is max w_i e_i². Otherwise a
    function of errors and covariances, or its ``"module:name"``."""
    objective: Annotated[Literal["estimation", "control"] | None, Scaling()] = None
    """Meaning of the error term: ``"estimation"`` is the option ``error``, ``"control"`` is the
    cost of state and input, the default with a controller."""
    error_weight: Annotated[float, Mark(validation.number, at_least=0.0)] = 1.0
    """Weight of the reward's error term."""
    cost_weight: float | Literal["random"] = 0.5
    """Price of a token in the reward. ``"random"`` draws it from ``price_range`` for each episode,
    uniformly in its logarithm."""
    price_range: ArrayLike | Literal["auto"] | None = None
    """Pair (low, high) of prices, which adds the price to the observation. ``"auto"`` simulates
    rules without a delay: it takes the prices at which the best value of information with memory
    sends 60 and 12 % of the sustained rate, but at least two packets per sensor and episode."""
    state_weights: ArrayLike | None = None
    """Weights of the states' squared errors in the reward, or a matrix W of eᵀWe. The default is
    the environment's own, which ``help`` shows. Explicit weights also weigh the trace that
    covariance intersection minimises, which is unweighted by default; rules and signals with
    such a trace do not support a matrix."""
    reward_scale: float | Literal["auto"] | None = "auto"
    """Factor of the state weights. ``"auto"`` simulates requests at an even pace and takes the
    factor with which their error costs 1 per step; explicit ``state_weights`` are not scaled. The
    pace is half of the sustained rate, or a quarter of all packets with unlimited tokens. These
    errors also scale the entries of ``belief_features``. ``None`` uses the error without
    transmissions, and does not scale a controller's cost, which the factor otherwise multiplies as
    well."""

    def own_weights(self, states: int) -> Array | None:
        """Return the checked ``state_weights`` (n,), or ``None`` without them; refuse a matrix."""
        if self.state_weights is None:
            return None
        return _separate(checked_weights(self.state_weights, states), "here")


@dataclass(frozen=True)
class Reward:
    """reward = -(error_weight · D + price · tokens), with D the cost of the error.

    The error e (n, N) is the truth minus the fused estimate, P (n, n, N) its estimated covariance.

    Args:
        options: The options.
        state_weights: Weights w (n, 1), or W (n, n, 1).
        error: ``"squared"`` is D = Σᵢ wᵢ eᵢ² or eᵀWe, ``"maximum"`` D = maxᵢ wᵢ eᵢ², ``"trace"``
            D = Σᵢ wᵢ Pᵢᵢ or tr(WP), which a policy can exploit. A function takes e and P, and
            returns D (N,) >= 0 without the weights.
    """

    options: RewardOptions
    state_weights: Array
    error: str | Cost

    @classmethod
    def create(
        cls, options: RewardOptions, state_weights: Array, error: str | Cost | None = None
    ) -> Reward:
        """Return the reward of the options.

        Args:
            options: The options.
            state_weights: Weights (n,) or (n, n) (:func:`reward_weights`).
            error: A kind, a function, or its ``module:name``, in place of the option.

        Raises:
            ConfigurationError: The kind is unknown, the function cannot be imported, or the price
                is not allowed.
        """
        cost = _cost(options.error if error is None else error, len(state_weights))
        if cost == "maximum":
            _separate(state_weights, "with error='maximum'")
        reward = cls(options, state_weights[..., None], cost)
        reward.price  # noqa: B018  which checks it
        return reward

    def separate_weights(self, where: str) -> Array:
        """Return the weights (n,), or refuse a matrix, with the place."""
        return _separate(self.state_weights[..., 0], where)

    @cached_property
    def diagonal(self) -> Array:
        """Weights (n, 1) of the states' squared errors: of a matrix its diagonal."""
        weights = self.state_weights
        return weights if weights.ndim == 2 else linalg.diagonal(weights)

    @cached_property
    def price(self) -> Price:
        """Price of a token."""
        return Price.create(self.options.cost_weight, self.options.price_range)

    @cached_property
    def error_weight(self) -> float:
        """Weight of the error term."""
        return self.options.error_weight

    @property
    def error_kind(self) -> str:
        """Kind of the error term, or the name of its function."""
        return self.error if isinstance(self.error, str) else name_of(self.error)

    def terms(
        self, error: Array, covariance: Array, spent: Array, price: Array
    ) -> tuple[Array, Array]:
        """Return the two terms of the reward (N,), both <= 0: error and tokens.

        Args:
            error: Truth minus fused estimate (n, N).
            covariance: Fused covariance (n, n, N).
            spent: Tokens (N,).
            price: Price of a token (N,).

        Raises:
            ConfigurationError: A user's function returns no numbers >= 0 of shape (N,).
        """
        return -self.error_weight * self._error_cost(error, covariance), -price * spent

    def control_term(self, cost: Array) -> Array:
        """Return the error term (N,) of a cost (N,) of state and input."""
        return -self.error_weight * self.control_scale * cost

    @cached_property
    def control_scale(self) -> float:
        """Factor of a cost of state and input."""
        factor = self.options.reward_scale
        return 1.0 if factor is None else float(factor)

    def _error_cost(self, error: Array, covariance: Array) -> Array:
        if self.error == "squared":
            return linalg.weighted_square(error, self.state_weights)
        if self.error == "trace":
            if self.state_weights.ndim > 2:
                return linalg.weighted_trace(covariance, self.state_weights[..., 0])
            return linalg.total(self.state_weights * linalg.diagonal(covariance))
        if self.error == "maximum":
            return (self.state_weights * (error * error)).max(0)
        assert not isinstance(self.error, str)
        return _own_cost(self.error, self.error_kind, error, covariance)

    def training_error(self, kind: str, error: Array, reference_error: Array) -> Array:
        """Return the error term (…,) of the reward for training, weighted.

        With x̂ the fused estimate and x* the full-information estimate, ``"squared"`` is ‖x - x̂‖²,
        ``"excess"`` is ‖x - x̂‖² - ‖x - x*‖² and ``"mismatch"`` is ‖x* - x̂‖². No policy changes
        the second term of the excess. If x* is the conditional mean given everything that x̂ and
        the policy use, excess and mismatch have the same mean, and the mismatch has the smaller
        variance.

        Args:
            kind: ``"squared"``, ``"excess"`` or ``"mismatch"``.
            error: x - x̂ (n, …).
            reference_error: x - x* (n, …).
        """
        weights = self.state_weights[..., 0]
        matrix = weights.ndim > 1

        def square(values: Array) -> Array:
            return values * np.tensordot(weights, values, axes=1) if matrix else values * values

        if kind == "mismatch":
            squared = square(error - reference_error)
        elif kind == "excess":
            squared = square(error) - square(reference_error)
        else:
            squared = square(error)
        each = np.ones(len(weights)) if matrix else weights
        return np.asarray(-self.error_weight * np.tensordot(each, squared, axes=1))


@dataclass(frozen=True)
class Price:
    """The price of a token in the reward.

    Args:
        fixed: The price; ``None`` draws one per episode from ``span``, uniformly in the logarithm.
        span: Range (low, high), with which the observation shows the price; ``None`` without a
            range.
    """

    fixed: float | None
    span: tuple[float, float] | None = None

    @classmethod
    def create(cls, cost_weight: Any, price_range: Any = None) -> Price:
        """Return the price of the options.

        Args:
            cost_weight: A number >= 0 or ``"random"``.
            price_range: Pair (low, high) or ``None``.

        Raises:
            ConfigurationError: The price is negative or outside its range, the range is not
                0 < low < high, or a random price has no range.
        """
        span = None if price_range is None else _span(price_range)
        if isinstance(cost_weight, str):
            validation.choice("cost_weight", cost_weight, ("random",))
            if span is None:
                allowed = "a pair (low, high) with 0 < low < high"
                raise validation.refusal("price_range", None, allowed, "with cost_weight='random'")
            return cls(None, span)
        price = validation.number("cost_weight", cost_weight, at_least=0.0)
        if span is not None and not span[0] <= price <= span[1]:
            raise forbidden("cost_weight", price, f"it must lie in price_range = {list(span)}")
        return cls(price, span)

    def draw(self, uniform: Array) -> Array:
        """Return prices (N,) from uniform numbers in [0, 1); a fixed price ignores them."""
        if self.fixed is not None or self.span is None:
            return np.full(uniform.shape, self.fixed)
        low, high = self.span
        return low * (high / low) ** uniform

    @property
    def middle(self) -> float:
        """The fixed price, or the geometric mean of the range."""
        return float(self.draw(np.array([0.5]))[0])

    def encode(self, price: Array) -> Array:
        """Return the position of prices in the logarithmic range, from 0 to 1."""
        if self.span is None:
            raise ConfigurationError("price_range = None is not allowed here: no price is observed")
        low, high = self.span
        return namespace(price).log(price / low) / math.log(high / low)

    def scale(self, price: Array, exponent: float) -> Array:
        """Return (geometric mean of the range / price)^exponent, or 1 without a range.

        The factor does not change the best policy of a price. It makes the values of decisions at
        low and high prices comparable, because close decisions at price p differ by about p.

        Args:
            price: Prices.
            exponent: From 0 to 1.
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
