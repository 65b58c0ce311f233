"""What the readings of a channel say about its sensor: error codes, wraps, counters, copies."""

from __future__ import annotations

from itertools import groupby
from typing import Any

import numpy as np
import pandas as pd

from fusion_gym.arrays import Array

_SHARE, _COUNT = 0.05, 3  # most readings and least count of an error code beside the known ones
_CODES = {-127.0, 85.0, 32767.0, -32768.0, 65535.0, 6553.5, 3276.7, -3276.8, 327.67, -327.68}
_SIZE, _GAPS = 0.35, 0.2  # least over median change of a log on change, and its share of gaps


def error_codes(values: Array) -> list[tuple[float, int]]:
    """Return the error codes of readings (T,) in the order of time, with their counts.

    A code is repeated exactly, farther from the other readings than their range, and reached and
    left in one step. Where readings come near an extreme value and stay, it is a limit.
    """
    distinct, counts = np.unique(values, return_counts=True)
    listed = np.array([_is_code(value) for value in distinct], bool)
    bulk = values[np.isin(values, distinct[~listed])]
    if len(bulk) < 0.5 * len(values) or not len(bulk):
        return []
    low, middle, high = np.quantile(bulk, (0.05, 0.5, 0.95))
    far = np.abs(distinct - middle) > 1.5 * (high - low)
    often = listed | ((counts >= _COUNT) & (counts <= _SHARE * len(values)))
    rest, result = values[~np.isin(values, distinct[far & often])], list[tuple[float, int]]()
    if not len(rest) or rest.min() == rest.max():
        return []
    low, high = np.quantile(rest, (0.001, 0.999))
    for place in np.flatnonzero(far & often):
        code, count, known = float(distinct[place]), int(counts[place]), listed[place]
        gap = low - code if code < middle else code - high
        between = int((np.abs(rest - code) < 0.75 * gap).sum())
        lengths = [length for value, length in run_lengths(values) if value == code]
        brief = known or (len(lengths) > 1 and np.mean(lengths) <= 10.0)
        if gap > (0.5 if known else 1.0) * (high - low) and between <= 0.1 * count and brief:
            result.append((code, count))
    return result


def _is_code(value: float) -> bool:
    digits = f"{abs(value):.10g}".replace(".", "")
    return value in _CODES or (len(digits) > 2 and set(digits) == {"9"})


def wraps(values: Array) -> bool:
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


def counts_up(values: Array) -> bool:
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


def reported_change(values: Array) -> float:
    """Return the size that all changes between readings (T,) have, zero if any may occur.

    The gaps of a log recorded on change end in a change of at least one size. A gap of the longest
    time may end in a smaller one.
    """
    places = np.flatnonzero(np.isfinite(values))
    gaps, changes = np.diff(places), np.abs(np.diff(values[places]))
    if len(gaps) < 30 or np.mean(gaps > 1) < _GAPS or gaps.min() == gaps.max():
        return 0.0
    own = changes[gaps < gaps.max()] if np.mean(gaps == gaps.max()) > 0.02 else changes
    size, middle = np.quantile(own, (0.02, 0.5)) if len(own) >= 30 else (0.0, 1.0)
    return float(size) if size > _SIZE * middle else 0.0


def copies(values: pd.DataFrame) -> dict[str, str]:
    """Return the channels whose changes earlier channels determine, each with its fault."""
    changes = values.diff()
    changes /= changes.std().where(lambda size: size > 0.0, 1.0)
    equal = changes.corr(min_periods=20).abs() > 1.0 - 1e-6
    result: dict[str, str] = {}
    for name in changes:
        earlier = [other for other in changes.loc[:, :name].columns[:-1] if other not in result]
        same = [other for other in earlier if equal.loc[other, name]]
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


def run_lengths(values: Any) -> list[tuple[Any, int]]:
    """Return the values of runs of equal entries, and their lengths."""
    return [(value, len(list(same))) for value, same in groupby(np.asarray(values).tolist())]
