"""A stable linear plant from the first part of a recording, and its criticism on the rest."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from scipy.linalg import solve_discrete_lyapunov
from statsmodels.tsa.deterministic import CalendarFourier, DeterministicProcess

from fusion_gym.arrays import Array
from fusion_gym.entries import Options
from fusion_gym.errors import ConfigurationError, refusal
from fusion_gym.recordings.recording import Recording
from fusion_gym.validation import integer, number

RATES = 0.3, 0.2, 0.1, 0.05, 0.02
RATIOS = 0.8, 1.25  # real over model error without a warning
_NOISY = 1e-4  # measurement variance over process variance of a channel whose truth is unknown
_TARGET = 0.05  # rate at which the held-out error chooses the order
_CLOSE = 1.02  # an order is good enough if its error is at most this times the least
_ORDERS = 1, 2  # a lag adds a state for each channel
_ITERATIONS = 200  # of expectation maximisation, at most
_ROWS = 3000  # of a maximum-likelihood fit; least squares takes all
_CYCLE = pd.Timedelta("7D"), pd.Timedelta("6h")  # least fitted time, longest interval
_RADIUS = 0.9999  # largest spectral radius of a fitted plant
_LEAST = 50  # complete steps of a fit, for each number in a row of the regression
_DEVIATION = 1e-7, 1e7  # whose squares LinearFusion allows
_CONSTANT = 1e-9  # deviation over the largest reading of a constant channel, at most
_EXACT = 1e-10  # variance of measurement noise over a channel's variance, at least
_DEPENDENT = 1e-7  # singular value of channels that determine each other, over the rows
_REGULAR = 1e-10  # least eigenvalue of the correlations of process noise
_CORRELATION = 0.25  # of residuals in the first ten lags: above it, a warning


@dataclass(frozen=True)
class FittedPlant:
    """A vector autoregression of a recording's deviations, as a linear plant.

    Args:
        names: names of the channels as words.
        transition: A (n, n) of the last ``order`` deviations of all channels, the newest first.
        process_covariance: W (n, n).
        measurement_variance: R (channels,).
        order: number of lags.
        remarks: remarks on the fit.

    Example:
        >>> from fusion_gym.recordings import Recording, fit
        >>> plant = fit(Recording.read("tanks").select(), exact=True)
        >>> plant.names, plant.order
        (('inflow', 'middle', 'outflow'), 1)
    """

    names: tuple[str, ...]
    transition: Array
    process_covariance: Array
    measurement_variance: Array
    order: int
    remarks: tuple[str, ...] = ()

    @property
    def stationary_covariance(self) -> Array:
        """Covariance (n, n) of the deviations without measurements."""
        result = solve_discrete_lyapunov(self.transition, self.process_covariance)
        return np.asarray(0.5 * (result + result.T), dtype=np.float64)

    @property
    def typical_changes(self) -> tuple[float, ...]:
        """Standard deviation of each channel's change in ten steps, in its unit."""
        now = self.stationary_covariance
        both = np.linalg.matrix_power(self.transition, 10) @ now
        changes = np.sqrt(np.diagonal(2.0 * now - both - both.T))
        return tuple(changes[: len(self.names)].tolist())

    @property
    def options(self) -> Options:
        """The options of LinearFusion; an error of a standard deviation costs 1 / channels.

        Raises:
            ConfigurationError: a deviation below 1e-7 or above 1e7; choose another unit.
        """
        count, size = len(self.names), len(self.transition)
        weights, variance = np.zeros(size), np.diagonal(self.stationary_covariance)[:count]
        for name, value in zip(self.names, np.sqrt(variance).tolist(), strict=True):
            number(f"deviation of {name}", value, at_least=_DEVIATION[0], at_most=_DEVIATION[1])
        weights[:count] = 1.0 / variance / count
        lags = (f"_lag{lag}" if lag else "" for lag in range(self.order))
        return {
            "state_names": [f"{name}{lag}" for lag in lags for name in self.names],
            "transition": self.transition.tolist(),
            "process_covariance": self.process_covariance.tolist(),
            "initial_covariance": self.stationary_covariance.tolist(),
            "measurement_matrices": np.eye(count, size).tolist(),
            "measurement_covariances": self.measurement_variance.tolist(),
            "state_weights": weights.tolist(),
        }

    def filter(self, deviations: Array, smooth: bool = False) -> Any:
        """Return statsmodels' results of deviations (T, channels), NaN where unknown.

        Args:
            deviations: deviations (T, channels).
            smooth: whether to smooth after filtering.
        """
        from statsmodels.tsa.statespace.kalman_smoother import KalmanSmoother

        count, size = len(self.names), len(self.transition)
        model = KalmanSmoother(k_endog=count, k_states=size)
        model.bind(np.asfortranarray(deviations.T))
        model["design"] = np.eye(count, size)
        model["obs_cov"] = np.diag(self.measurement_variance)
        model["transition"] = self.transition
        model["selection"] = np.eye(size)
        model["state_cov"] = self.process_covariance
        model.initialize_known(np.zeros(size), self.stationary_covariance)
        return model.smooth() if smooth else model.filter()

    def truth(self, deviations: Array, seed: int = 0) -> Array:
        """Return deviations without measurement noise, drawn given all readings.

        The mean squared error of an estimate that depends on the readings alone is then the error
        that the plant predicts. Without measurement noise a reading is the truth.

        Args:
            deviations: deviations (T, channels), NaN where there is no reading.
            seed: seed of the draw.

        Returns:
            The deviations (T, channels).

        Source: J. Durbin and S. J. Koopman, "A simple and efficient simulation smoother for state
        space time series analysis", Biometrika 89, 2002.
        """
        count, noise = len(self.names), self.measurement_variance
        if (noise <= _NOISY * np.diagonal(self.process_covariance)[:count]).all():
            return deviations
        draw, size = np.random.default_rng(seed), len(self.transition)
        path = draw.multivariate_normal(np.zeros(size), self.process_covariance, len(deviations))
        path[0] = draw.multivariate_normal(np.zeros(size), self.stationary_covariance)
        for row in range(1, len(path)):
            path[row] += self.transition @ path[row - 1]
        own = path[:, :count] + np.sqrt(noise) * draw.normal(size=deviations.shape)
        result = self.filter(deviations - own, smooth=True)
        return np.asarray(path[:, :count] + result.smoothed_state[:count].T, dtype=np.float64)


@dataclass(frozen=True)
class Criticism:
    """How well a plant predicts held-out deviations under a periodic schedule.

    Args:
        rate: packets per sensor and step.
        real: mean squared error, each channel over its variance.
        model: the error that the plant predicts.
        nees: normalised squared error of the channels that do not send; 1 for an honest plant.

    Example:
        >>> from fusion_gym.recordings import Criticism
        >>> Criticism(rate=0.05, real=0.2, model=0.25, nees=0.9).ratio
        0.8
    """

    rate: float
    real: float
    model: float
    nees: float

    @property
    def ratio(self) -> float:
        """Real over model error."""
        return self.real / self.model


def words(recording: Recording) -> tuple[str, ...]:
    """Return the channels' names as different words of letters, digits and '_'."""
    result: list[str] = []
    for channel in recording.channels:
        word = re.sub(r"\W", "_", channel.name)
        word = word if word.isidentifier() else f"_{word}"
        result.append(word if word not in result else f"{word}_{len(result)}")
    return tuple(result)


def levels(recording: Recording, share: float) -> tuple[Array, int, Array]:
    """Return deviations, fitted rows, and what was removed.

    Least squares on the first ``share`` of the rows determines the level of each channel and, with
    a week or more, two harmonics of a day.

    Args:
        recording: the recording.
        share: share of the rows for the fit.

    Returns:
        Readings (T, channels) without level and cycle, the number of fitted rows, and the constant,
        sine and cosine of one and of two periods per day (channels, 5).
    """
    values, rows = recording.values, int(share * len(recording.values))
    interval = pd.tseries.frequencies.to_offset(recording.interval)
    index = pd.DatetimeIndex(values.index, freq=interval)
    least, longest = _CYCLE
    cycle = rows * recording.interval >= least and recording.interval <= longest
    terms = [CalendarFourier("D", 2)] if cycle else []
    process = DeterministicProcess(index, constant=True, additional_terms=terms)
    known = process.in_sample().to_numpy()
    result, removed = np.empty(values.shape), np.zeros((values.shape[1], 5))
    for place, column in enumerate(values.to_numpy().T):
        present = np.flatnonzero(np.isfinite(column[:rows]))
        first = np.linalg.pinv(known[present]) @ column[present]
        result[:, place] = column - known @ first
        removed[place, : len(first)] = first
    return result, rows, removed


def deviations(recording: Recording, share: float) -> tuple[Array, int]:
    """Return readings (T, channels) without level and daily cycle, and the fitted rows."""
    return levels(recording, share)[:2]


def fit(
    recording: Recording, share: float = 0.5, exact: bool = False, order: int | None = None
) -> FittedPlant:
    """Fit a plant to the first part of a recording.

    By default the order, 1 or 2, is the smallest whose error at a rate of 0.05 is within 2 % of the
    least, on the last third of this part. With measurement noise it is 1. The fit is least squares
    where neighbouring steps have all readings. Otherwise, or without ``exact``, it is maximum
    likelihood of a state space with missing values.

    Args:
        recording: the recording, with selected channels.
        share: share of the rows for the fit, in (0, 0.95].
        exact: whether the readings are the truth, without measurement noise.
        order: number of lags.

    Raises:
        ConfigurationError: too few readings, or a value that is not allowed.

    Example:
        >>> from fusion_gym.recordings import Recording, fit
        >>> fit(Recording.read("tanks").select(), exact=True).order
        1
    """
    share = number("share", share, above=0.0, at_most=0.95)
    card = recording.card
    if changes := [f"{c.channel.name} by {c.change:g}" for c in card if c.change]:
        raise ConfigurationError(
            f"on_change = False is not allowed with this log, which is recorded on change "
            f"({', '.join(changes)}): silence is no missing reading; give --on-change (hold())"
        )
    values, rows = deviations(recording, share)
    least = _LEAST * (1 + len(recording.channels))
    scale = np.ones(len(recording.channels))
    for place, (name, readings) in enumerate(recording.values[:rows].items()):
        known = np.isfinite(values[:rows, place])
        integer(f"readings of {name} in the fitted part", int(known.sum()), at_least=least)
        if not np.isfinite(values[rows:, place]).any():
            raise refusal("channels", name, "channels with readings after the fitted part, too")
        scale[place] = values[:rows][known, place].std()
        if scale[place] <= _CONSTANT * readings.abs().max():
            raise refusal("channels", name, "channels that change in the fitted part")
    values = values / scale
    resolution = np.array([0.0 if exact else row.resolution for row in card])
    floor = np.maximum(_EXACT, (resolution / scale) ** 2 / 12.0)
    train, validation = values[: 2 * rows // 3], values[2 * rows // 3 : rows]
    whole = values[:rows][np.isfinite(values[:rows]).all(axis=1)]
    errors: dict[int, float] = {}
    order = order or (None if exact else 1)  # readings hardly tell noise from a second lag
    try:
        if len(whole) > len(scale) > np.linalg.matrix_rank(whole, tol=_DEPENDENT * len(whole)):
            raise np.linalg.LinAlgError
        for lags in _orders(train) if order is None else ():
            plant = _fit(recording, train, lags, exact, floor)
            errors[lags] = criticise(plant, validation, (_TARGET,))[0].real
        good = _CLOSE * float(np.nanmin([*errors.values(), np.inf]))
        order = order or next(lags for lags, error in errors.items() if not error > good)
        plant = _fit(recording, values[:rows], order, exact, floor)
        size = np.sqrt(np.diagonal(plant.process_covariance)[: values.shape[1]])
        own = plant.process_covariance[: len(size), : len(size)] / np.outer(size, size)
        np.linalg.cholesky(own - _REGULAR * np.eye(len(size)))
    except np.linalg.LinAlgError:
        allowed = "some that do not determine each other"
        raise refusal("channels", list(recording.values), allowed) from None
    sizes = np.tile(scale, order)
    return replace(
        plant,
        transition=plant.transition * np.divide.outer(sizes, sizes),
        process_covariance=plant.process_covariance * np.outer(sizes, sizes),
        measurement_variance=plant.measurement_variance * scale**2,
    )


def criticise(
    plant: FittedPlant, values: Array, rates: Sequence[float] = RATES
) -> tuple[Criticism, ...]:
    """Compare real with predicted errors on deviations under periodic schedules.

    Args:
        plant: the plant.
        values: deviations (T, channels), NaN where there is no reading.
        rates: packets per sensor and step, in (0, 1].

    Example:
        >>> import numpy as np
        >>> from fusion_gym.recordings import FittedPlant, criticise
        >>> plant = FittedPlant(("x",), np.array([[0.5]]), np.eye(1), np.array([1e-6]), 1)
        >>> values = np.random.default_rng(0).normal(size=(100, 1))
        >>> [row.rate for row in criticise(plant, values, rates=(0.5, 0.1))]
        [0.5, 0.1]
    """
    count, rows = values.shape[1], []
    scale, truth = np.diagonal(plant.stationary_covariance)[:count], plant.truth(values)
    for rate in rates:
        period = round(1.0 / rate)
        turn = np.arange(len(values))[:, None] + (np.arange(count) * period) // count
        sent = turn % period == 0
        result = plant.filter(np.where(sent, values, np.nan))
        error = truth - result.filtered_state[:count].T
        covariance = result.filtered_state_cov[:count, :count]
        known = np.isfinite(values)
        variance = np.diagonal(covariance).clip(0.0)
        real, model = (float((s / scale)[known].mean()) for s in (error**2, variance))
        rows.append(Criticism(rate, real, model, _nees(error, covariance, known & ~sent)))
    return tuple(rows)


def warnings_of(plant: FittedPlant, values: Array, rows: Sequence[Criticism]) -> list[str]:
    """Return the warnings of a criticism on deviations ``values`` (T, channels)."""
    low, high = RATIOS
    result = [
        f"at rate {row.rate:g} the real error is {row.ratio:.2f} times the model's: the part that "
        "was not fitted differs"
        for row in rows
        if not low <= row.ratio <= high
    ]
    for name, lag, value in residual_correlations(plant, values):
        if abs(value) > _CORRELATION:
            result.append(f"residuals of {name} are not white: correlation {value:.2f}, lag {lag}")
    return result


def residual_correlations(plant: FittedPlant, values: Array) -> Iterator[tuple[str, int, float]]:
    """Yield the largest correlation of each channel's residuals in ten lags, with its lag."""
    from statsmodels.stats.diagnostic import acorr_ljungbox

    residuals = np.asarray(plant.filter(values).standardized_forecasts_error)
    for name, residual in zip(plant.names, residuals, strict=True):
        present = residual[np.isfinite(residual) & (residual != 0.0)]
        table = acorr_ljungbox(present, lags=min(10, len(present) // 5), return_df=True)
        steps = table["lb_stat"].diff().fillna(table["lb_stat"])  # each lag's n r² (n+2)/(n-k)
        size = np.sqrt(steps * (len(present) - table.index) / (len(present) * (len(present) + 2)))
        yield name, int(size.idxmax()), float(size.max())


def _nees(error: Array, covariance: Array, marks: Any) -> float:
    """Return the mean over steps of eᵀ P⁻¹ e / rank, of the marked channels."""
    total = count = 0.0
    patterns, places = np.unique(marks, axis=0, return_inverse=True)
    for place, pattern in enumerate(patterns):
        (chosen,) = np.nonzero(pattern)
        steps = np.flatnonzero(places == place)
        if len(chosen):
            part = np.moveaxis(covariance[np.ix_(chosen, chosen, steps)], -1, 0)
            own = error[np.ix_(steps, chosen)]
            total += float((own * np.linalg.solve(part, own[..., None])[..., 0]).sum())
            count += len(chosen) * len(steps)
    return total / max(count, 1.0)


def _is_complete(values: Array) -> bool:
    """Return whether most steps and the steps before them have all readings."""
    complete: Any = np.isfinite(values).all(axis=1)
    return float((complete[1:] & complete[:-1]).mean()) > 0.5


def _regression(values: Array, order: int) -> tuple[Array, Array]:
    """Return the complete deviations (T, channels), each with those before (T, n)."""
    lags = [values[order - lag : len(values) - lag] for lag in range(order + 1)]
    complete = np.isfinite(np.hstack(lags)).all(axis=1)
    return lags[0][complete], np.hstack(lags[1:])[complete]


def _orders(values: Array) -> list[int]:
    """Return the orders for which these deviations suffice, at least the first."""
    least = _LEAST * values.shape[1]
    return [n for n in _ORDERS if n == 1 or len(_regression(values, n)[0]) >= least * n]


def _fit(recording: Recording, values: Array, order: int, exact: bool, noise: Array) -> FittedPlant:
    """Return the plant of scaled deviations, with at least the variances ``noise`` (channels,)."""
    count, remarks = values.shape[1], []
    if exact and _is_complete(values):
        now, lags = _regression(values, order)
        if len(now) < _LEAST * count * order:
            raise ConfigurationError(
                f"recording is not allowed with order {order}: {len(now)} steps have all "
                f"readings with those before, and {_LEAST * count * order} must"
            )
        coefficients = (np.linalg.pinv(lags) @ now).T
        residuals = now - lags @ coefficients.T
        process = residuals.T @ residuals / (len(now) - np.linalg.matrix_rank(lags))
    else:
        values, few = _fullest(values), _LEAST * (1 + count)
        for name, readings in zip(recording.values, np.isfinite(values).sum(0), strict=True):
            integer(f"readings of {name} in {len(values):,} steps", int(readings), at_least=few)
        coefficients, process, noise = _expectation_maximisation(values, order, noise, exact)
    transition = np.eye(count * order, k=-count)
    transition[:count] = coefficients
    radius = float(np.abs(np.linalg.eigvals(transition)).max())
    if radius > _RADIUS:
        powers = np.repeat((_RADIUS / radius) ** np.arange(1, order + 1), count)
        transition[:count] *= powers
        remarks.append(f"spectral radius {radius:.5f} reduced to {_RADIUS}")
    covariance = np.zeros((count * order, count * order))
    covariance[:count, :count] = process
    return FittedPlant(words(recording), transition, covariance, noise, order, tuple(remarks))


def _fullest(values: Array) -> Array:
    """Return the neighbouring steps with the most readings of the channel that has the fewest."""
    most = min(max(_ROWS, _LEAST * (1 + values.shape[1])), len(values))
    fewest = pd.DataFrame(np.isfinite(values)).rolling(most).sum().min(axis=1)
    last = len(values) - int(np.argmax(fewest.fillna(-1.0)[::-1]))
    return values[last - most : last]


def _expectation_maximisation(
    values: Array, order: int, noise: Array, exact: bool
) -> tuple[Array, Array, Array]:
    """Return coefficients (channels, n), W and R (channels,) of the largest likelihood.

    Source: R. H. Shumway and D. S. Stoffer, "An approach to time series smoothing and forecasting
    using the EM algorithm", Journal of Time Series Analysis 3, 1982.
    """
    count = values.shape[1]
    size, variance, last = count * order, np.nanvar(values, axis=0), -np.inf
    names = tuple(map(str, range(count)))
    transition, process = np.eye(size, k=-count), np.zeros((size, size))
    transition[:count, :count] = 0.9 * np.eye(count)
    process[:count, :count] = np.diag(0.19 * variance)
    noise = noise if exact else np.maximum(noise, 0.01 * variance)
    for _ in range(_ITERATIONS):
        plant = FittedPlant(names, transition, process, noise, order)
        result = plant.filter(values, smooth=True)
        mean, covariance = result.smoothed_state, result.smoothed_state_cov
        moment = mean[:, :-1] @ mean[:, :-1].T + covariance[..., :-1].sum(-1)
        # Statsmodels' autocovariance at t is that of the states at t + 1 and t.
        both = mean[:count, 1:] @ mean[:, :-1].T
        both += result.smoothed_state_autocov[:count, :, :-1].sum(-1)
        now = mean[:count, 1:] @ mean[:count, 1:].T + covariance[:count, :count, 1:].sum(-1)
        transition, process = transition.copy(), np.zeros((size, size))
        transition[:count] = np.linalg.solve(moment, both.T).T
        own = (now - transition[:count] @ both.T) / (len(values) - 1)
        process[:count, :count] = 0.5 * (own + own.T)
        radius = float(np.abs(np.linalg.eigvals(transition)).max())
        transition[:count] *= min(1.0, _RADIUS / radius)
        if not exact:
            error = (values.T - mean[:count]) ** 2 + np.diagonal(covariance)[..., :count].T
            noise = np.maximum(np.nanmean(error, axis=1), noise * 1e-3)
        if abs(result.llf - last) < 1e-6 * abs(result.llf):
            break
        last = result.llf
    return transition[:count], process[:count, :count], noise
