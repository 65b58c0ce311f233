"""A linear plant whose episodes are windows of a recording: RecordedFusion-v1."""

from __future__ import annotations

import functools
import os
import pickle
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from fusion_gym.arrays import Array
from fusion_gym.core.noise import PhiloxNoise
from fusion_gym.core.task import Scenario
from fusion_gym.errors import ConfigurationError, forbidden, refusal
from fusion_gym.systems.bases import Truth
from fusion_gym.systems.linear_plant import LinearPlant
from fusion_gym.systems.tobit.linear import LinearFusionOptions, build_linear
from fusion_gym.systems.tobit.system import Announcement, CensoredPlant, DailyLevel
from fusion_gym.validation import number

_EXAMPLE = ("transition", "process_covariance", "initial_covariance", "measurement_matrices",
            "measurement_covariances", "state_names", "joint_measurement_covariance")  # fmt: skip
_PRIME = 7919  # windows between two episodes of a seed
_LEAST = 100  # residuals to draw from
_RESIDUAL = 1e-6  # of a deviation: changes that the process noise cannot make
_READINGS = 0.5  # of the usual number in a window


@dataclass(frozen=True)
class RecordedFusionOptions(LinearFusionOptions):
    """LinearFusion on the readings of a recording instead of simulated ones.

    An episode is a window of the part of the log that was not fitted. Seed and episode determine
    the window, and windows repeat beyond their number. The noise of the window leads the plant
    through the recorded values, so every rule, agent and interface runs unchanged.

    The states are the channels without level and daily cycle, and their lags. The signals
    ``measurement``, ``held`` and ``expected_measurement`` are readings. A sensor without a reading
    cannot request. Errors of states without a reading count as zero.

    ``fusion-gym fit`` writes the plant for ``system``. Without ``--exact`` it has measurement
    noise, and the truth is drawn once, given the plant and all readings.

    The default is a made-up log of three tanks.

    Example:
        >>> import fusion_gym
        >>> task = fusion_gym.make_task("fusion_gym/RecordedFusion-v1")
        >>> task.noise.count, task.plant.state_names
        (29, ('inflow', 'middle', 'outflow'))
    """

    log: str | None = None
    """Path of the log, a CSV file, or the name of a shipped log: ``"mast"`` or ``"tanks"``."""
    fit_share: float = 0.5
    """Share of the log, from its start, that was fitted."""
    source: Literal["recorded", "fitted", "resampled", "normal"] = "recorded"
    """Source of the process noise: ``"recorded"`` replays the windows, ``"fitted"`` windows of the
    fitted part. ``"resampled"`` draws from the residuals of the fitted part, for training.
    ``"normal"`` draws from the plant's model."""

    def nominal(self) -> RecordedFusionOptions:
        """Return the options whose simulation scales the reward."""
        own: Any = super().nominal()
        result: RecordedFusionOptions = replace(own, source="normal")
        return result


@dataclass(frozen=True)
class RecordedPlant(CensoredPlant):
    """A linear plant with gaps in its measurements: a measurement's noise of NaN is a gap."""

    traceable = False

    @property
    def start_channels(self) -> int:
        """Normals of a start, and the time of day."""
        return super().start_channels + 1

    def start(self, noise: Array) -> tuple[Truth, Announcement]:
        """See :class:`Plant`; the last normal is the time of day."""
        first = 2 * self.dynamics.size
        own = noise[first : first + self.sensor_count]
        state, mean = super().start(np.nan_to_num(noise[:-1]))
        return self._with_gaps(state, own), Announcement(mean, noise[-1])

    def sense(self, state: Truth, noise: Array, control: Array | None = None) -> Truth:
        """See :class:`Plant`."""
        own = noise[self.dynamics.noise_channels :]
        return self._with_gaps(super().sense(state, np.nan_to_num(noise), control), own)

    def available(self, state: Truth) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """See :class:`Plant`; lagged states have no truth of their own."""
        present = np.isfinite(state.measurement[:, 0])
        known = np.zeros(state.truth.shape, dtype=np.bool_)
        known[: self.sensor_count] = present
        return present, known

    def _with_gaps(self, state: Truth, own: Array) -> Truth:
        measurement = np.where(np.isfinite(own)[:, None], state.measurement, np.nan)
        return replace(state, measurement=measurement)


@dataclass(frozen=True)
class WindowNoise:
    """A :class:`~fusion_gym.core.noise.NoiseSource` that replays windows of a recording.

    Args:
        start_rows: start normals of each window (count, start_channels), with the time of day.
        rows: normals of each step (T, noise_channels), NaN where a sensor has no reading.
        first: row of each window's first step (count,).
        processes: process noises r, the first normals of a step.
    """

    start_rows: Array
    rows: Array
    first: NDArray[np.int64]
    processes: int

    @property
    def count(self) -> int:
        """Number of windows."""
        return len(self.first)

    def window(self, seed: int, episode: int) -> int:
        """Return the window of an episode."""
        return (seed + _PRIME * episode) % self.count

    def start(self, seed: int, episode: int, channels: int) -> Array:
        """Return the normals (channels,) of the episode's start."""
        return self.start_rows[self.window(seed, episode), :channels]

    def steps(self, seed: int, episode: int, first: int, count: int, channels: int) -> Array:
        """Return the normals (count, channels)."""
        begin = int(self.first[self.window(seed, episode)]) + first
        return self.rows[begin : begin + count]

    def uniform(self, seed: int, episode: int) -> float:
        """Return the number in [0, 1) that draws the episode's price."""
        return PhiloxNoise().uniform(seed, episode)


class ResampledNoise(PhiloxNoise):
    """Normals whose process noise is drawn from residuals (K, r), with their own first normal."""

    def __init__(self, residuals: Array) -> None:
        super().__init__()
        self.residuals = residuals

    def steps(self, seed: int, episode: int, first: int, count: int, channels: int) -> Array:
        """Return the noise (count, channels)."""
        drawn = super().steps(seed, episode, first, count, channels)
        chosen = (ndtr(drawn[:, 0]) * len(self.residuals)).astype(np.int64)
        drawn[:, : self.residuals.shape[1]] = self.residuals[chosen]
        return drawn


class _Part(NamedTuple):
    """The channels of a log.

    Deviations (T, l), normals of the measurement noise (T, l), NaN without a reading, fitted rows,
    level (l, 5), times and step in days, and a millionth of the resolutions (l,).
    """

    names: tuple[str, ...]
    truth: Array
    noise: Array
    rows: int
    level: Array
    day: Array
    step: float
    quantum: Array


@functools.lru_cache(maxsize=4)
def _part(
    log: str, modified: float, names: tuple[str, ...] | None, share: float, plant: bytes
) -> _Part:
    """Read the channels of a log, which was modified at a time, for a pickled plant."""
    from fusion_gym.recordings import Recording
    from fusion_gym.recordings.fitting import levels, words

    whole = Recording.read(log)
    known = dict(zip(words(whole), whole.channels, strict=True))
    if names is None or not set(names) <= known.keys():
        raise refusal("state_names", names, f"channels of {', '.join(known)}")
    recording = whole.select([known[name].name for name in names])
    values, rows, level = levels(recording, share)
    index, day = recording.values.index, 86_400.0
    times = np.asarray((index - index.normalize()).total_seconds()) / day
    quantum = np.array([1e-6 * (row.resolution or 1.0) for row in recording.card])
    step = recording.interval.total_seconds() / day
    fitted = pickle.loads(plant)
    path = fitted.truth(values)
    noise = (values - path) / np.sqrt(fitted.measurement_variance)
    return _Part(names, path, noise, rows, level, times, step, quantum)


def build_recorded(choice: RecordedFusionOptions) -> Scenario:
    """Return the scenario of these options."""
    from fusion_gym.recordings import FittedPlant

    if choice.input_matrix is not None:
        reason = "what was recorded follows no other input"
        raise forbidden("input_matrix", choice.input_matrix, reason, "with a recording")
    if choice.log is None:
        choice = _example(choice)
    if (joint := choice.joint_measurement_covariance) is not None:
        reason = "the noises of a fitted plant are independent"
        raise forbidden("joint_measurement_covariance", joint, reason, "with a recording")
    if not isinstance(choice.log, str | os.PathLike):
        raise refusal("log", choice.log, "the path of a CSV file")
    share = number("fit_share", choice.fit_share, above=0.0, at_most=0.95)
    scenario = build_linear(choice)
    truth, memory = scenario.plant, cast(Any, scenario.memory_estimator)
    assert isinstance(truth, CensoredPlant)
    plant = truth.dynamics
    for fitted_part in (plant, truth.sensors):
        fitted_part.refuse_schedule("with a recording")
    if choice.source != "normal":
        truth.nature.refuse("with a recording", "the truth is the recording")
    count, order = truth.sensor_count, plant.size // truth.sensor_count
    names = None if choice.state_names is None else truth.state_names[:count]
    modified = os.path.getmtime(choice.log) if os.path.exists(choice.log) else 0.0
    matrix = truth.sensors.measurement_matrix[:, 0, :, 0]
    if not np.array_equal(matrix, np.eye(count, count * order)):
        raise refusal("measurement_matrices", matrix, "rows of the identity, one for each channel")
    fitted = FittedPlant(
        names or (), plant.transition[..., 0], plant.process_covariance[..., 0],
        truth.sensors.variance[:, 0, 0], order,
    )  # fmt: skip
    part = _part(choice.log, modified, names, share, pickle.dumps(fitted))
    noise = {
        "normal": lambda: None,
        "resampled": lambda: ResampledNoise(_residuals(plant, part)),
        "recorded": lambda: _windows(plant, part, choice.horizon, slice(part.rows, None)),
        "fitted": lambda: _windows(plant, part, choice.horizon, slice(part.rows)),
    }[choice.source]()
    recorded = RecordedPlant(**{item.name: getattr(truth, item.name) for item in fields(truth)})

    level = DailyLevel(part.level, part.step, part.quantum[:, None, None])
    filters: Any = scenario.estimator
    return replace(
        scenario,
        plant=recorded,
        estimator=replace(filters, level=level),
        memory_estimator=None if memory is None else replace(memory, level=level),
        noise=noise,
    )


def _example(choice: RecordedFusionOptions) -> RecordedFusionOptions:
    """Return the options with the made-up log and its plant."""
    for name in _EXAMPLE:
        if getattr(choice, name) is not getattr(LinearFusionOptions, name):
            raise refusal(name, getattr(choice, name), "left out without a log")
    from fusion_gym.yaml_text import load_yaml

    options = load_yaml("system", Path(__file__).with_name("tanks.yaml"))
    if choice.state_weights is not None:
        options["state_weights"] = choice.state_weights
    return replace(choice, log="tanks", **options)


def _noises(plant: LinearPlant, path: Array, count: int) -> Array:
    """Return the process noise (T - 1, r) that leads along the states of a path (T, n)."""
    factor, transition = plant.process_factor[..., 0], plant.transition[..., 0]
    changes = path[1:] - path[:-1] @ transition.T
    result: Array = changes @ np.linalg.pinv(factor).T
    scale = np.sqrt(np.diagonal(factor @ factor.T))[:count].min()
    if not np.abs(result @ factor.T - changes).max() <= _RESIDUAL * max(scale, _RESIDUAL):
        raise ConfigurationError(
            "process_covariance is not allowed with this recording: its noise cannot lead through "
            "all readings; each channel needs process noise of its own"
        )
    return result


def _states(values: Array, order: int) -> Array:
    """Return states (T, n) of deviations (T, l): the newest first, then its lags.

    Gaps have straight lines, which no policy sees.
    """
    import pandas as pd

    path = np.ascontiguousarray(pd.DataFrame(values).interpolate(limit_direction="both"))
    lags = [np.vstack([path[:1]] * lag + [path[: len(path) - lag]]) for lag in range(order)]
    return np.hstack(lags)


def _residuals(plant: LinearPlant, part: _Part) -> Array:
    """Return the process noises (K, r) between complete steps of the fitted part."""
    count = len(part.names)
    order = plant.size // count
    noise = _noises(plant, _states(part.truth[: part.rows], order), count)
    known: Any = np.isfinite(part.noise[: part.rows]).all(axis=1)
    complete: Any = np.all(
        [known[order - lag : len(known) - lag] for lag in range(order + 1)], axis=0
    )
    noise = noise[order - 1 :][complete]
    if len(noise) < _LEAST:
        raise refusal(
            "source", "resampled", f"'normal' with this recording: {len(noise)} neighbouring steps "
            f"have all readings, and {_LEAST} must"
        )  # fmt: skip
    return noise


def _windows(plant: LinearPlant, part: _Part, horizon: int, rows: slice) -> WindowNoise:
    """Return the windows of some rows."""
    count = len(part.names)
    order = plant.size // count
    path, own = _states(part.truth, order)[rows], part.noise[rows]
    known = np.isfinite(own)
    steps = np.hstack([_noises(plant, path, count), own[1:]])
    starts = np.arange(order - 1, len(path) - horizon - 1, horizon + 1)
    present = np.array([known[first : first + horizon + 1].mean() for first in starts])
    starts = starts[present >= _READINGS * known.mean()]
    if not len(starts):
        allowed = f"shorter: this part of the log has {len(path):,} steps"
        raise refusal("horizon", horizon, allowed)
    root = plant.initial_factor[..., 0]
    moved = (path[starts] - plant.initial_mean[:, 0]) @ np.linalg.pinv(root).T
    still, day = np.zeros_like(moved), part.day[rows][starts, None]
    start = np.hstack([still, moved, own[starts], day])
    return WindowNoise(start, steps, starts, plant.noise_channels)
