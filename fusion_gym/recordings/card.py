"""The data card of a log: what the readings of a channel say about its sensor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from fusion_gym.arrays import Array
from fusion_gym.recordings.reading import reported_changes, run_lengths

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
        change: least change, in the channel's unit, of a channel recorded on change; zero if it
            is recorded at even times.

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
    change: float = 0.0


def cards(values: pd.DataFrame, channels: Sequence[RecordedChannel]) -> tuple[ChannelCard, ...]:
    """Return the data card of readings (T, channels): a row for every channel."""
    peers = {c.name: [o.name for o in channels if o.unit == c.unit != "" and o != c]
             for c in channels}  # fmt: skip
    agreements = {name: float(values[name].corr(values[own].median(axis=1)))
                  for name, own in peers.items() if len(own) > 1}  # fmt: skip
    copied, result = _copies(values), []
    moved = reported_changes(np.arange(len(values)), values.to_numpy())
    for channel, change in zip(channels, moved.tolist(), strict=True):
        name, others = channel.name, [agreements.get(peer, 0.0) for peer in peers[channel.name]]
        card = _card(values[name], channel, agreements.get(name, float("nan")))
        apart = card.agreement < _FAULTY and np.median(others) >= _AGREEMENT
        fault = card.fault or copied.get(name, "disagrees with its peers" * bool(apart))
        result.append(replace(card, fault=fault, change=change))
    return tuple(result)


def _card(column: pd.Series, channel: RecordedChannel, agreement: float) -> ChannelCard:
    """Return the card of a channel, without the faults that others show."""
    values = column.dropna().to_numpy()
    distinct, counts = np.unique(values, return_counts=True)
    channel = _with_limits(channel, distinct, counts)
    saturated = (values <= channel.low) | (values >= channel.high)
    free = [n for value, n in run_lengths(values) if channel.low < value < channel.high]
    long = max(_STUCK, 8.0 * float(np.mean(free or [1])))
    stuck = sum(length for length in free if length >= long) / max(len(values), 1)
    changes = np.diff(values)
    usual = 1.4826 * np.median(np.abs(changes)) or changes.std() if changes.size else 0.0
    size = np.abs(changes)
    jumps = np.minimum(size[1:], size[:-1]) * (changes[1:] * changes[:-1] < 0.0)
    faults = {"constant": len(distinct) == 1, "stuck": stuck > 0.5, "counts": _counts_up(values),
              "wraps around": _wraps(values)}  # fmt: skip
    every = float(np.median(np.diff(np.flatnonzero(column.notna())))) if changes.size else 0.0
    several = len(distinct) > 1
    return ChannelCard(
        channel=channel, readings=len(values), missing=1.0 - len(values) / len(column),
        every=every, mean=float(values.mean()), deviation=float(values.std()),
        resolution=float(np.diff(distinct).min()) if several else 0.0,
        saturated=float(saturated.mean()) if several else 0.0, stuck=stuck,
        spikes=int((jumps > _SPIKE * usual).sum()), agreement=agreement,
        fault=next((fault for fault, true in faults.items() if true), ""),
    )  # fmt: skip


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


def _wraps(values: Array) -> bool:
    """Return whether readings jump by their range and are near each other on a circle."""
    size = float(np.ptp(values))
    if len(values) < 3 or size == 0.0:
        return False
    turns = (values - values.min()) / size
    changes = np.diff(turns)
    jumps = np.flatnonzero(np.abs(changes) > 0.7)
    ends = np.concatenate([turns[jumps], turns[jumps + 1]])
    sides = [len(np.unique(ends[side])) for side in (ends < 0.5, ends > 0.5)]  # one is a code
    ratio = float(np.sqrt((((changes + 0.5) % 1.0 - 0.5) ** 2).mean() / (changes**2).mean()))
    middle = float(((turns > 0.2) & (turns < 0.8)).mean())
    angle = any(0.95 * turn < size <= turn for turn in (360.0, 2.0 * np.pi))
    return len(jumps) >= 3 and min(sides) > 1 and ratio < 0.6 and (angle or middle > 0.1)


def _counts_up(values: Array) -> bool:
    """Return whether readings count: by equal increments, or never falling but to a restart."""
    changes = np.diff(values)
    if len(changes) < 20 or np.ptp(values) == 0.0:
        return False
    common = np.unique(np.round(changes, 12), return_counts=True)
    equal = common[1].max() / len(changes) > 0.9 and common[0][common[1].argmax()] != 0.0
    falls = changes < 0.0
    restarts = values[1:][falls] <= values.min() + 0.05 * np.ptp(values)
    never = len(changes) >= 100 and falls.mean() <= 0.01 and bool(restarts.all())
    return bool(equal or never)


def _copies(values: pd.DataFrame) -> dict[str, str]:
    """Return the channels that earlier channels determine, each with its fault."""
    resolutions = {name: np.diff(np.unique(values[name].dropna())).min(initial=np.inf)
                   for name in values}  # fmt: skip
    changes = values.diff()
    changes /= changes.std().where(lambda size: size > 0.0, 1.0)
    equal = changes.corr(min_periods=20).abs() > 1.0 - 1e-6
    result: dict[str, str] = {}
    for name in changes:
        earlier = [other for other in changes.loc[:, :name].columns[:-1] if other not in result]
        same = [
            other
            for other in earlier
            if equal.loc[other, name]
            or _is_rounded(values[other], values[name], resolutions[other], resolutions[name])
        ]
        complete = changes[[*earlier, name]].dropna().to_numpy()
        if same:
            result[name] = f"repeats {same[0]}"
        elif earlier and len(complete) > 10 * (len(earlier) + 1):
            factors, *_ = np.linalg.lstsq(complete[:, :-1], complete[:, -1])
            error = complete[:, -1] - complete[:, :-1] @ factors
            if error.std() < 1e-3 * complete[:, -1].std():
                used = [o for o, f in zip(earlier, factors, strict=True) if abs(f) > 0.01]
                result[name] = f"a sum of {', '.join(used)}"
    return result


def _is_rounded(first: pd.Series, other: pd.Series, resolution: float, own: float) -> bool:
    """Return whether a line through the first column gives the other up to their resolutions."""
    known = first.notna() & other.notna()
    x, y = first[known].to_numpy(), other[known].to_numpy()
    if len(x) < 20 or np.ptp(x) == 0.0 or np.ptp(y) == 0.0:
        return False
    slope, level = np.polyfit(x, y, 1)
    limit = 0.5 * own + 0.5 * abs(slope) * resolution
    return bool(np.abs(y - level - slope * x).max() <= 1.05 * limit < 0.2 * y.std())
