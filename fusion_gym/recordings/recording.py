"""A log of sensors as a table on even times."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from fusion_gym.errors import ConfigurationError, display, refusal
from fusion_gym.recordings import reading
from fusion_gym.recordings.card import ChannelCard, RecordedChannel, cards
from fusion_gym.validation import LARGEST, number

# Shipped logs by name: three made-up tanks, and a wind mast (from brightwind 2.7.0, MIT).
SHIPPED = {name: Path(__file__).with_name(f"{name}.csv{end}")
           for name, end in (("tanks", ""), ("mast", ".xz"))}  # fmt: skip
_HIDING = 0.8  # reported change over the deviation, at most
_LIMIT = r"-?[0-9]+(?:\.[0-9]+)?|-?\.[0-9]+"
_ENDS = {"low": -np.inf, "high": np.inf}
_ROUND_UNIT = r"\(([°℃℉%].{0,4}|[mhk]?Pa|mbar|deg ?[CF]|[CFK]|[mk]?[VAWm]|[cm]m|ppm|lx|k?Wh|m/s)\)"
_UNITS = {"℃": "°C", "deg C": "°C", "℉": "°F", "deg F": "°F", "%RH": "%", "% RH": "%", "%rH": "%"}
_HEAD = re.compile(
    r"(?P<name>[^\[\]]*?[^\[\]\s])\s*(\[(?P<unit>[^\[\]]*)\])?"
    rf"(\s+(?P<low>{_LIMIT})?\.\.(?P<high>{_LIMIT})?)?"
)


@dataclass(frozen=True)
class Recording:
    """A log of sensors at equally spaced times.

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
    def read(
        cls,
        path: str | os.PathLike[str],
        *,
        date_format: str | None = None,
        time_unit: str | None = None,
        error_codes: Sequence[float] = (),
        units: Mapping[str, str] | None = None,
    ) -> Recording:
        """Read a log from a CSV file.

        A column has the times. The header of every other column is the name of a channel, its unit
        in brackets and its limits: ``humidity [%] 0..100``; unit and limits may be left
        out. A file with one row per reading has a column of times, of names and of values.
        Where columns such as ``room`` or ``id`` name devices, each has its own channels.
        An empty cell, text and an error code count as missing. Columns of text are left
        out. Times are rounded to multiples of the channels' median interval.

        Args:
            path: the file, which may be compressed, or the name of a shipped log: ``"tanks"`` or
                ``"mast"``.
            date_format: format of the times for ``strftime``. By default all rows decide the order
                of day and month.
            time_unit: unit of numeric times: ``"s"``, ``"ms"``, ``"us"``, ``"ns"``, ``"min"``,
                ``"h"``, ``"d"`` or ``"excel"``. By default the header names it.
            error_codes: values that count as missing, beside the recognised ones.
            units: units of channels by name, in place of the units in the header.

        Raises:
            ConfigurationError: the file cannot be read as a log.
        """
        if not isinstance(path, str | os.PathLike):
            raise refusal("log", path, "the path of a CSV file")
        if time_unit is not None and time_unit not in reading.TIME_UNITS:
            raise refusal("time_unit", time_unit, f"one of {', '.join(reading.TIME_UNITS)}")
        codes = [number("error_codes", code) for code in error_codes]
        source, remarks = f"log = {os.fspath(path)!r}", list[str]()
        cells = reading.read_cells(SHIPPED.get(str(path), Path(path)), remarks)
        times, table = reading.split_times(cells, source, date_format, time_unit, remarks)
        times, table = reading.pivoted(times, table, source, remarks)
        channels = [_channel(str(head), source) for head in table.columns]
        names = [channel.name for channel in channels]
        if len(set(names)) < len(names) or not names:
            raise ConfigurationError(
                f"{source} is not allowed: its channels are {names}, and must be different ones"
            )
        numbers, cell_units = reading.numbers_of(table.set_axis(names, axis=1), source)
        numbers[np.abs(numbers) > LARGEST] = np.nan
        absent = np.isnan(numbers)
        keep = np.flatnonzero(~absent.all(0))
        without = [name for place, name in enumerate(names) if place not in keep]
        if not len(keep):
            raise ConfigurationError(
                f"{source} is not allowed: its channel {names[0]!r} has no number up to {LARGEST:g}"
            )
        remarks += [f"column {name!r} has no numbers: left out" for name in without]
        lost = int((table.notna().to_numpy() & absent)[:, keep].sum())
        remarks += [f"{lost} cells without a finite number up to 1e15: no reading"] if lost else []
        channels = [replace(channels[place], unit=channels[place].unit or cell_units[place])
                    for place in keep]  # fmt: skip
        for name, unit in (units or {}).items():
            if name not in [channel.name for channel in channels]:
                raise refusal("unit", name, f"one of {', '.join(c.name for c in channels)}")
            channels = [replace(c, unit=unit) if c.name == name else c for c in channels]
        channels = [replace(c, unit=_UNITS.get(c.unit, c.unit)) for c in channels]
        own = pd.DataFrame(numbers[:, keep], columns=[channel.name for channel in channels])
        values = reading.on_even_times(own, times, source, remarks)
        return cls(
            reading.without_codes(values, codes, source, remarks), tuple(channels), tuple(remarks)
        )

    @property
    def interval(self) -> pd.Timedelta:
        """Time between two steps."""
        return self.values.index[1] - self.values.index[0]

    @property
    def gaps(self) -> tuple[int, pd.Timedelta]:
        """Number of gaps without any reading, and the time of the longest."""
        silent = reading.run_lengths(self.values.isna().all(axis=1))
        lengths = [length for value, length in silent if value]
        return len(lengths), max(lengths, default=0) * self.interval

    @property
    def card(self) -> tuple[ChannelCard, ...]:
        """The data card: a row for every channel."""
        return cards(self.values, self.channels)

    def select(self, names: Sequence[str] = (), share: float = 1.0) -> Recording:
        """Return some channels, by default all without a fault, with no readings at their limits.

        Args:
            names: names of channels.
            share: share of the rows, from the first, for a fit: a channel that is constant there,
                or has no reading after it, has a fault.

        Raises:
            ConfigurationError: a name is unknown, or every channel has a fault.
        """
        known = [channel.name for channel in self.channels]
        for name in names:
            if name not in known:
                raise refusal("channels", name, f"some of {', '.join(known)}")
        card = self.card
        low, high = ([getattr(row.channel, end) for row in card] for end in ("low", "high"))
        values = self.values.where((self.values > low) & (self.values < high))
        rows = int(share * len(values))
        different, after = values.iloc[:rows].nunique(), values.iloc[rows:].count()
        late = {name: "constant in the fitted part" for name in known if different[name] < 2}
        if rows < len(values):
            late |= {name: "no reading after the fitted part" for name in known if not after[name]}
        faults = {row.channel.name: row.fault or late.get(row.channel.name, "") for row in card}
        chosen = [name for name in known if (name in names if names else not faults[name])]
        if not chosen:
            text = "; ".join(f"{name}: {fault}" for name, fault in faults.items())
            raise refusal("channels", None, f"channels without a fault ({text})")
        remarks = [
            f"{name}: {fault}{'' if name in chosen else ', left out'}"
            for name, fault in faults.items()
            if fault and (name in chosen or not names)
        ]
        for row in (row for row in card if row.channel.name in chosen):
            counts = f"{row.spikes} spikes" * (row.spikes > 0)
            stuck = f"{row.stuck:.1%} of the readings are stuck" * (row.stuck >= 0.001)
            remarks += [f"{row.channel.name}: {text}" for text in (counts, stuck) if text]
        channels = tuple(row.channel for row in card if row.channel.name in chosen)
        return Recording(values[chosen], channels, (*self.remarks, *remarks))

    def hold(self) -> Recording:
        """Return the recording with the last reading of a channel where the channel is silent.

        In a log recorded on change, silence says that the quantity is within one change of the last
        reading. The difference acts like measurement noise, with at most the change squared as
        its variance.

        Raises:
            ConfigurationError: changes above .8 of the readings' deviation, which hide the plant.
        """
        for row in self.card:
            if row.change > _HIDING * row.deviation:
                raise ConfigurationError(
                    f"on_change = True is not allowed with {row.channel.name}: it reports changes "
                    f"of {row.change:.3g}, and its deviation is {row.deviation:.3g}, so silence "
                    f"hides the plant; record changes below {_HIDING * row.deviation:.2g}"
                )
        held = self.values.ffill()
        count = int((held.notna() & self.values.isna()).to_numpy().sum())
        remark = f"{count} steps of silence have the last reading of their channel"
        return replace(self, values=held, remarks=(*self.remarks, remark))

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write a log that ``read`` reads without options.

        Args:
            path: the CSV file.
        """
        heads = []
        for c in self.channels:
            limits = f" {c.low:f}..{c.high:f}".replace("-inf", "").replace("inf", "")
            heads.append(c.name + f" [{c.unit}]" * bool(c.unit) + limits * (limits != " .."))
        self.values.set_axis(heads, axis=1).to_csv(path, index_label="time")


def _channel(head: str, source: str) -> RecordedChannel:
    match = _HEAD.fullmatch(re.sub(_ROUND_UNIT, r"[\1]", " ".join(head.split())))
    low, high = (float(match[end] or size) if match else 0 for end, size in _ENDS.items())
    if match is None or ".." in match["name"] or not low < high:
        raise ConfigurationError(
            f"{source} is not allowed: the head {display(head)} must be a name, perhaps with a "
            "unit and rising limits, as in 'humidity [%] 0..100'"
        )
    return RecordedChannel(match["name"], match["unit"] or "", low, high)
