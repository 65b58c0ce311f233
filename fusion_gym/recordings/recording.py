"""A log of sensors as a table on even times, and its data card."""

from __future__ import annotations

import csv
import io
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pandas.io.common import get_handle

from fusion_gym.arrays import Array
from fusion_gym.errors import ConfigurationError, display, refusal
from fusion_gym.validation import LARGEST, LONGEST, LONGEST_TEXT

# Shipped logs by name: three made-up tanks, and a wind mast (from brightwind 2.7.0, MIT).
SHIPPED = {name: Path(__file__).with_name(f"{name}.csv{end}")
           for name, end in (("tanks", ""), ("mast", ".xz"))}  # fmt: skip
_LIMIT = r"-?[0-9]+(?:\.[0-9]+)?|-?\.[0-9]+"
_ENDS = {"low": -np.inf, "high": np.inf}
_HEAD = re.compile(
    r"(?P<name>[^\[\]]*?[^\[\]\s])\s*(\[(?P<unit>[^\[\]]*)\])?"
    rf"(\s+(?P<low>{_LIMIT})?\.\.(?P<high>{_LIMIT})?)?"
)
_LEAST, _MOST = 20, 5_000_000  # rows of a log, and steps from its first to its last time
_OFF = 0.05  # of an interval: a time that is farther from the even times is counted
_SATURATED = 0.01  # share of readings at an extreme value that is a limit
_STUCK = 12  # equal readings in a row, at least, of a channel that is stuck
_SPIKE = 12.0  # robust deviations of the changes between readings
_AGREEMENT, _FAULTY = 0.95, 0.9  # correlations with the median of the peers


@dataclass(frozen=True)
class RecordedChannel:
    """A channel of a recording: one sensor.

    Args:
        name: its name.
        unit: unit of its readings; empty if unknown.
        low: lowest reading, at which it saturates; minus infinity for none.
        high: highest reading, at which it saturates; infinity for none.

    Example:
        >>> from fusion_gym.recordings import RecordedChannel
        >>> RecordedChannel("humidity", "%", high=100.0).low
        -inf
    """

    name: str
    unit: str = ""
    low: float = -np.inf
    high: float = np.inf


@dataclass(frozen=True)
class ChannelCard:
    """What a recording says about a channel.

    Args:
        channel: the channel, with its given or observed limits.
        readings: number of readings.
        missing: share of the steps without a reading.
        every: median of the steps between two readings.
        mean: mean of the readings, in the channel's unit.
        deviation: standard deviation of the readings, in the channel's unit.
        resolution: least difference of two different readings, in the channel's unit.
        saturated: share of the readings at a limit.
        stuck: share of the readings that repeat the one before for long.
        spikes: readings far from both neighbours.
        agreement: correlation with the median of the channels of its unit; NaN without two others.
        fault: reason why the channel is not used; empty if it is.

    Example:
        >>> from fusion_gym.recordings import Recording
        >>> [card.fault for card in Recording.read("tanks").card]
        ['', '', '']
    """

    channel: RecordedChannel
    readings: int
    missing: float
    every: float
    mean: float
    deviation: float
    resolution: float
    saturated: float
    stuck: float
    spikes: int
    agreement: float
    fault: str = ""


@dataclass(frozen=True)
class Recording:
    """A log of sensors on even times.

    Args:
        values: readings (T, channels), with NaN where there is none; the index has the times.
        channels: the channels, in the order of the columns.
        remarks: what was changed when the log was read.

    Example:
        >>> from fusion_gym.recordings import Recording
        >>> recording = Recording.read("tanks")
        >>> [channel.unit for channel in recording.channels]
        ['cm', 'cm', 'cm']
    """

    values: pd.DataFrame
    channels: tuple[RecordedChannel, ...]
    remarks: tuple[str, ...] = ()

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Recording:
        """Read a log from a CSV file.

        The first column has the times. The head of every other column is the name of a channel,
        its unit in brackets and its limits: ``humidity [%] 0..100``; unit and limits may be left
        out. An empty cell is no reading. Times are rounded to multiples of the most frequent
        interval.

        Args:
            path: the file, which may be compressed, or the name of a shipped log: ``"tanks"`` or
                ``"mast"``.

        Raises:
            ConfigurationError: the file cannot be read as a log.
        """
        if not isinstance(path, str | os.PathLike):
            raise refusal("log", path, "the path of a CSV file")
        table, source = _table(SHIPPED.get(str(path), Path(path))), f"log = {os.fspath(path)!r}"
        channels = [_channel(str(head), source) for head in table.columns[1:]]
        names = [channel.name for channel in channels]
        if len(set(names)) < len(names) or not names:
            raise ConfigurationError(
                f"{source} is not allowed: its channels are {names}, and it must have one or more "
                "different ones after the column of times"
            )
        numbers = table.iloc[:, 1:].set_axis(names, axis=1)
        texts, remarks = numbers.notna(), list[str]()
        times = _times(table.iloc[:, 0], source, remarks)
        for name in names:
            if not pd.api.types.is_numeric_dtype(numbers[name]):
                plain = numbers[name].astype("string").str.strip().str.replace(",", ".")
                numbers[name] = pd.to_numeric(plain, errors="coerce")
        numbers = numbers.astype(float).where(numbers.astype(float).abs() <= LARGEST)
        lost = int((texts & numbers.isna()).to_numpy().sum())
        remarks += [f"{lost} cells without a finite number up to 1e15: no reading"] if lost else []
        for name in names:
            if numbers[name].isna().all():
                raise ConfigurationError(
                    f"{source} is not allowed: its channel {name!r} has no number up to {LARGEST:g}"
                )
        values = _on_even_times(numbers, times, source, remarks)
        return cls(values, tuple(channels), tuple(remarks))

    @property
    def interval(self) -> pd.Timedelta:
        """Time between two steps."""
        return self.values.index[1] - self.values.index[0]

    @property
    def gaps(self) -> tuple[int, pd.Timedelta]:
        """Number of gaps without any reading, and the time of the longest."""
        runs = [length for value, length in _runs(self.values.isna().all(axis=1)) if value]
        return len(runs), max(runs, default=0) * self.interval

    @property
    def card(self) -> tuple[ChannelCard, ...]:
        """The data card: a row for every channel."""
        agreements = [self._agreement(place) for place in range(len(self.channels))]
        return tuple(self._card(place, agreements) for place in range(len(self.channels)))

    def select(self, names: Sequence[str] = ()) -> Recording:
        """Return some channels, by default all without a fault, with no readings at their limits.

        Args:
            names: names of channels.

        Raises:
            ConfigurationError: a name is unknown, or every channel has a fault.
        """
        known = [channel.name for channel in self.channels]
        for name in names:
            if name not in known:
                raise refusal("channels", name, f"some of {', '.join(known)}")
        rows = [row for row in self.card if (row.channel.name in names if names else not row.fault)]
        if not rows:
            faults = "; ".join(f"{row.channel.name}: {row.fault}" for row in self.card)
            raise refusal("channels", None, f"channels without a fault ({faults})")
        channels = tuple(row.channel for row in rows)
        values = self.values[[channel.name for channel in channels]]
        low, high = ([getattr(channel, end) for channel in channels] for end in ("low", "high"))
        return Recording(values.where((values > low) & (values < high)), channels, self.remarks)

    def _card(self, place: int, agreements: Sequence[float]) -> ChannelCard:
        column = self.values.iloc[:, place]
        readings = column.dropna()
        values = readings.to_numpy()
        distinct, counts = np.unique(values, return_counts=True)
        channel = _with_limits(self.channels[place], distinct, counts)
        saturated = (values <= channel.low) | (values >= channel.high)
        free = [length for value, length in _runs(values) if channel.low < value < channel.high]
        long = max(_STUCK, 8.0 * float(np.mean(free or [1])))
        stuck = sum(length for length in free if length >= long) / max(len(values), 1)
        changes = np.diff(values)
        usual = 1.4826 * float(np.median(np.abs(changes))) or float(changes.std())
        jumps = np.minimum(np.abs(changes[1:]), np.abs(changes[:-1])) * (
            changes[1:] * changes[:-1] < 0.0
        )
        agreement, fault = agreements[place], ""
        others = [agreements[other] for other in self._peers(place)]
        if len(distinct) == 1:
            fault = "constant"
        elif stuck > 0.5:
            fault = "stuck"
        elif agreement < _FAULTY and np.median(others) >= _AGREEMENT:
            fault = "disagrees with its peers"
        return ChannelCard(
            channel=channel,
            readings=len(values),
            missing=1.0 - len(values) / len(column),
            every=float(np.median(np.diff(np.flatnonzero(column.notna())))) if changes.size else 0,
            mean=float(values.mean()),
            deviation=float(values.std()),
            resolution=float(np.diff(distinct).min()) if len(distinct) > 1 else 0.0,
            saturated=float(saturated.mean()) if len(distinct) > 1 else 0.0,
            stuck=stuck,
            spikes=int((jumps > _SPIKE * usual).sum()),
            agreement=agreement,
            fault=fault,
        )

    def _peers(self, place: int) -> list[int]:
        unit = self.channels[place].unit
        same = (other for other, channel in enumerate(self.channels) if channel.unit == unit)
        return [other for other in same if other != place and unit]

    def _agreement(self, place: int) -> float:
        """Return the correlation with the median of the other channels of the unit."""
        peers = self._peers(place)
        if len(peers) < 2:
            return float("nan")
        return float(self.values.iloc[:, place].corr(self.values.iloc[:, peers].median(axis=1)))


def _table(path: Path) -> pd.DataFrame:
    """Return the cells of a CSV file, with the separator of its first line."""
    try:
        if path.exists() and not path.is_file():
            raise ValueError("it is no regular file")
        with get_handle(path, "rb", compression="infer", is_text=False) as handle:
            raw = handle.handle.read(LONGEST_TEXT + 1)
        text = raw.decode("utf-8-sig")
        line = text.lstrip().partition("\n")[0]
        separator = max(",;\t", key=line.count)
        columns = len(next(csv.reader([line], delimiter=separator), []))
        if len(raw) > LONGEST_TEXT or columns > 1 + LONGEST:
            raise ValueError(f"above {LONGEST_TEXT:,} bytes or {LONGEST} channels")
        return pd.read_csv(io.StringIO(text), sep=separator, skipinitialspace=True)
    except Exception as error:  # a damaged archive may raise any exception
        reason = getattr(error, "strerror", None) or " ".join(str(error).split()[:20])
        allowed = f"a CSV file ({reason or type(error).__name__})"
        raise refusal("log", str(path), allowed) from None


def _channel(head: str, source: str) -> RecordedChannel:
    match = _HEAD.fullmatch(" ".join(head.split()))
    low, high = (float(match[end] or size) if match else 0 for end, size in _ENDS.items())
    if match is None or ".." in match["name"] or not low < high:
        raise ConfigurationError(
            f"{source} is not allowed: the head {display(head)} must be a name, perhaps with a "
            "unit and rising limits, as in 'humidity [%] 0..100'"
        )
    return RecordedChannel(match["name"], match["unit"] or "", low, high)


def _times(cells: pd.Series, source: str, remarks: list[str]) -> pd.Series:
    """Return the times of the rows, NaT where a cell has none; numbers are seconds."""
    if pd.api.types.is_numeric_dtype(cells):
        rises = (cells.diff().dropna() >= 0.0).mean() > 0.75  # else it is a channel
        seconds = cells.where((cells.abs() < 9e9) & rises)  # the years of pandas
        times = pd.to_datetime(seconds, unit="s", errors="coerce", utc=True)
    else:
        times = pd.to_datetime(cells, errors="coerce", utc=True, format="ISO8601")
        if times.isna().mean() > 0.5:
            times = pd.to_datetime(cells, errors="coerce", utc=True)
    lost = int(times.isna().sum())
    if lost > len(times) / 2 or len(times) - lost < _LEAST:
        raise ConfigurationError(
            f"{source} is not allowed: {len(times) - lost} of its {len(times)} rows begin with a "
            f"time, and at least {_LEAST} and half of them must, as in '2026-01-31 12:30:00'"
        )
    remarks += [f"{lost} rows without a time: left out"] if lost else []
    back = int((times.dropna().diff() < pd.Timedelta(0)).sum())
    remarks += [f"{back} times before the row above: sorted"] if back else []
    return times


def _on_even_times(
    numbers: pd.DataFrame, times: pd.Series, source: str, remarks: list[str]
) -> pd.DataFrame:
    """Return the first reading of each channel at each multiple of the most frequent interval."""
    numbers = numbers[times.notna()].set_index(pd.DatetimeIndex(times.dropna()))
    numbers = numbers.sort_index(kind="stable")
    twice = int(numbers.index.duplicated().sum())
    remarks += [f"{twice} rows at the time of another: the first reading counts"] if twice else []
    apart = numbers.index.to_series().diff()
    apart = apart[apart > pd.Timedelta(0)]
    if apart.empty:
        raise ConfigurationError(f"{source} is not allowed: all its rows have the same time")
    interval = apart.mode().iloc[0]
    places = np.asarray((numbers.index - numbers.index[0]) / interval)
    steps = np.rint(places).astype(np.int64)
    if steps[-1] >= min(_MOST, 200 * len(steps)):
        raise ConfigurationError(
            f"{source} is not allowed: from {numbers.index[0]} to {numbers.index[-1]} are "
            f"{steps[-1]:,} intervals of {interval}, too many for its {len(steps):,} rows; look "
            "for a wrong time"
        )
    off = int((np.abs(places - steps) > _OFF).sum())
    remarks += [f"{off} times between the even ones: rounded"] if off else []
    values = numbers.groupby(steps).first().reindex(np.arange(steps[-1] + 1))
    first = numbers.index[0].tz_localize(None)
    return values.set_axis(first + interval * values.index, axis=0)


def _with_limits(
    channel: RecordedChannel, distinct: Array, counts: NDArray[np.int64]
) -> RecordedChannel:
    """Return the channel with limits where many readings have an extreme value."""
    if len(distinct) < 10:
        return channel
    often = max(_SATURATED * counts.sum(), 10.0 * float(np.median(counts)), 20.0)
    low, high = channel.low, channel.high
    low = float(distinct[0]) if low == -np.inf and counts[0] >= often else low
    high = float(distinct[-1]) if high == np.inf and counts[-1] >= often else high
    return RecordedChannel(channel.name, channel.unit, low, high)


def _runs(values: Any) -> list[tuple[Any, int]]:
    """Return the values of runs of equal entries, and their lengths."""
    return [(value, len(list(same))) for value, same in groupby(np.asarray(values).tolist())]
