"""The cells of a log's CSV file, their times, numbers and even steps, and its error codes."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pandas.io.common import get_handle

from fusion_gym.arrays import Array
from fusion_gym.errors import ConfigurationError, display, refusal
from fusion_gym.validation import LONGEST, LONGEST_TEXT

_LEAST, _MOST = 20, 5_000_000  # rows of a log, and steps from its first to its last time
_OFF = 0.05  # of an interval: a time that is farther from the even times is counted
_PHASE = 1e-3  # of an interval: a channel that reads later than the first by more is named
_FIRST, _LAST = 1678, 2261  # years that nanoseconds reach
_SAMPLE = 200  # lines or rows that show the layout of a file
_ROUND = 3600.0, 60.0, 10.0, 1.0, 0.1, 0.01, 1e-3, 1e-6, 1e-9  # seconds of round intervals
_FOOTER = 10  # lines under the rows, at most
_BINARIES = {
    b"PK\x03\x04": "a workbook or an archive: save the sheet as CSV",
    b"\xd0\xcf\x11\xe0": "a workbook: save the sheet as CSV",
    b"PAR1": "Parquet: write it by pandas.read_parquet(path).to_csv(file)",
}
_SHARE, _COUNT = 0.05, 3  # most readings and least count of an error code beside the known ones
_CODES = {-127.0, 85.0, 32767.0, -32768.0, 65535.0, 6553.5, 3276.7, -3276.8, 327.67, -327.68}

TIME_UNITS = {  # and their words in heads
    "excel": "excel.*", "s": "s|secs?|seconds?", "ms": "ms|milliseconds?",
    "us": "us|µs|μs|microseconds?", "ns": "ns|nanoseconds?", "min": "mins?|minutes?",
    "h": "h|hrs?|hours?", "d": "d|days?",
}  # fmt: skip
_CLOCK_HEAD = re.compile("time|date|unix|epoch|stamp", re.IGNORECASE)
_DATE = r"(\d{1,4})[-/.](\d{1,2})[-/.](\d{1,4})"
_CLOCK = r"\d{1,2}:\d{2}(?::\d{2}(?:[.,]\d+)?)?(?:\s*[AaPp]\.?[Mm]\.?)?"
_ORDERS = {"year first": (0, 1, 2), "day first": (2, 1, 0), "month first": (2, 0, 1)}
_COMPACT = r"((?:19|20)\d\d)(0[1-9]|1[0-2])(0[1-9]|[12]\d|3[01])"
_COMPACT_CLOCK = r"([01]\d|2[0-4])([0-5]\d)?([0-5]\d)?"
_HOUR_HEAD = re.compile(r"(hr_?mn|hhmm|hours?|hrs?|h|stunde|uhrzeit|time)\b.*", re.IGNORECASE)
_WEEKDAY = r"^(?:MON|TUE|WED|THU|FRI|SAT|SUN)[A-Z]*[.,]?\s+"
_MONTH = r"(?i)\b(?:jan|feb|mar|apr|may|jun|jul|aug|sep|oct|nov|dec)"
_TWELVE = "%Y-%m-%d %I:%M:%S %p", "%Y-%m-%d %I:%M %p"
_IDS = "sensor|channel|device|node|station|id"  # whose numbers are names, too
_NAMES = re.compile(
    rf"entity_id|_field|name|({_IDS}|variable|parameter|metric|tag|topic|series|signal|quantity|point|"
    "room|location|place|zone|site|host|mac|address|model)([ _]?(id|name|type))?",
    re.IGNORECASE,
)
_FACTORS = {"k": 1e3, "M": 1e6, "G": 1e9}
_VALUES = re.compile("_?value|state|reading|measurement", re.IGNORECASE)
_CELL = r"([+-]?[\d., ]*\d\.?(?:[eE][+-]?\d+)?)\s*([^\d\s.,+'-]\D{0,9}\d?)?"
_SPREAD = 3.0  # ratio of the relative deviations of two ways to read a column's numbers


def read_cells(path: Path, remarks: list[str]) -> pd.DataFrame:
    """Return the cells of a CSV file as texts under its heads."""
    try:
        if path.exists() and not path.is_file():
            raise ValueError("it is no regular file")
        with get_handle(path, "rb", compression="infer", is_text=False) as handle:
            raw = handle.handle.read(LONGEST_TEXT + 1)
        for start, reason in _BINARIES.items():
            if raw.startswith(start):
                raise ValueError(reason)
        try:
            utf_16 = raw.startswith((b"\xff\xfe", b"\xfe\xff"))
            text = raw.decode("utf-16" if utf_16 else "utf-8-sig")
        except UnicodeDecodeError:
            text = raw.decode("cp1252")
        text = re.sub(r"(?m)^#.*\n(?=\D|\Z)", "", text)
        text = re.sub(r"""(?i)\A"?sep=.{1,2}"?\r?\n""", "", text)
        width, separator, above = _layout(text)
        text, below = _without_footer(text, separator, width)
        if len(raw) > LONGEST_TEXT or width > 1 + LONGEST or "\0" in text:
            most = f"above {LONGEST_TEXT:,} bytes or {LONGEST} channels, or binary"
            raise ValueError(f"{width} columns: {most}")
        cells = pd.read_csv(
            io.StringIO(text), sep=r"\s+" if separator == " " else separator, header=None,
            dtype=str, skiprows=above, skipinitialspace=True,
        ).apply(lambda column: column.str.strip())  # fmt: skip
        heads = cells.iloc[0].fillna("").str.lstrip("# ")
        numeric = heads.str.fullmatch(r"[\d\s.,:/TZ+-]+")
        if above and numeric.any():
            raise ValueError("its rows have more cells than heads: quote decimal commas")
        if numeric.all():
            raise ValueError(f"its heads are numbers, such as {display(heads.iloc[-1])}")
    except Exception as error:  # a damaged archive may raise any exception
        text = getattr(error, "strerror", None) or " ".join(str(error).split()[:20])
        text = text or type(error).__name__
        text += "; quote decimal commas" if isinstance(error, pd.errors.ParserError) else ""
        raise refusal("log", str(path), f"a CSV file ({text})") from None
    if text.lstrip('"').startswith("TOA5") and len(cells) > 2:  # units and aggregations
        units = cells.iloc[1].fillna("")
        heads = heads.where(units.isin(("", "TS", "RN")), heads + " [" + units + "]")
        cells = cells.iloc[2:]
    remarks += [f"{above} lines above the heads: left out"] if above else []
    remarks += [f"{below} lines below the rows: left out"] if below else []
    return cells.iloc[1:].set_axis(list(heads), axis=1).reset_index(drop=True)


def _layout(text: str) -> tuple[int, str, int]:
    """Return the number of columns, the separator, and the number of lines above the heads."""
    lines, choices = text.split("\n", _SAMPLE)[:_SAMPLE], []
    for separator in ",;\t| ":
        widths = _widths(lines, separator)
        width = max(widths, key=widths.count)
        above = 1 if text.lstrip('"').startswith("TOA5") else widths.index(width)
        choices.append((widths.count(width) * (width > 1), width, separator, above))
    single = max(choices[:-1])[0] == 0 and choices[-1][-1] == 0  # no head is above
    return max(choices if single else choices[:-1])[1:]


def _widths(lines: Sequence[str], separator: str) -> list[int]:
    """Return the number of cells of each line."""
    plain = [line.strip(" \r") for line in lines] if separator == " " else lines
    rows = csv.reader(plain, delimiter=separator, skipinitialspace=True)
    return [len(row) for row in rows]


def _without_footer(text: str, separator: str, width: int) -> tuple[str, int]:
    """Return the text without last lines of other widths, and their number."""
    lines = text.rstrip().split("\n")
    count = 0
    while len(lines) > 1 and _widths([lines[-1]], separator) != [width]:
        if re.match(r"\W*\d", lines.pop()) or count == _FOOTER:
            return text, 0
        count += 1
    return "\n".join([*lines, ""]), count


def split_times(
    table: pd.DataFrame, source: str, date_format: str | None, time_unit: str | None,
    remarks: list[str],
) -> tuple[pd.Series, pd.DataFrame]:  # fmt: skip
    """Return the times of the rows, NaT where a row has none, and the other columns."""
    columns = [table.iloc[:, place] for place in range(table.shape[1])]
    samples = [column.dropna().head(_SAMPLE) for column in columns]
    dates, clocks = (
        [place for place, own in enumerate(samples) if len(own) and own.str.fullmatch(form).all()]
        for form in (_DATE, _CLOCK)
    )
    if not clocks:
        days = [place for place, own in enumerate(samples)
                if len(own) and own.str.fullmatch(_COMPACT).all()]  # fmt: skip
        for place in [place for place, own in enumerate(samples) if dates or days]:
            if (clock := _clock_of(columns[place], str(table.columns[place]))) is not None:
                columns[place], clocks, dates = clock, [place], dates or days
                break
    if dates and clocks:
        cells, used = columns[dates[0]] + " " + columns[clocks[0]], {dates[0], clocks[0]}
    else:
        readings = [_times(own, date_format, time_unit) for own in samples]
        shares = [max((t.notna().mean() for t in own.values()), default=0.0) for own in readings]
        counts = [c.nunique() * (share > 0.5) for c, share in zip(columns, shares, strict=True)]
        likely = (place for place, count in enumerate(counts) if count > max(counts) / 2)
        place = min(likely, key=lambda n: _is_numeric(samples[n]), default=0)
        cells, used = columns[place], {place}
    times = _parse(cells, source, date_format, time_unit, remarks)
    blank = {place for place, head in enumerate(table.columns) if head == ""} - used
    if table.iloc[:, list(blank)].notna().to_numpy().any():
        remarks.append("a column without a head: left out")
    return times, table.iloc[:, [n for n in range(len(columns)) if n not in used | blank]]


def _clock_of(cells: pd.Series, head: str) -> pd.Series | None:
    """Return hours, or hours and minutes as one number, as texts such as 07:30."""
    if not _HOUR_HEAD.fullmatch(head) or not cells.dropna().str.fullmatch(r"\d{1,4}").all():
        return None
    numbers = pd.to_numeric(cells)
    numbers = numbers * 100 if numbers.max() <= 24 else numbers
    if numbers.max() > 2400 or (numbers % 100).max() > 59:
        return None
    digits = numbers.map("{:04.0f}".format, na_action="ignore")
    return digits.str[:2] + ":" + digits.str[2:]


def _is_numeric(cells: pd.Series) -> bool:
    return bool(pd.to_numeric(cells, errors="coerce").notna().mean() > 0.5)


def _parse(
    cells: pd.Series, source: str, date_format: str | None, time_unit: str | None,
    remarks: list[str],
) -> pd.Series:  # fmt: skip
    """Return the times of the cells, NaT where a cell has none."""
    choices = _times(cells, date_format, time_unit)
    if time_unit is not None and not _is_numeric(cells):
        raise refusal("time_unit", time_unit, "left out: the times of this log are no numbers")
    scores = {order: _evenness(times) for order, times in choices.items()}
    order = max(scores, key=scores.__getitem__, default="")
    times = choices.pop(order, pd.Series(pd.NaT, cells.index))
    for other, values in choices.items():
        if scores[other] == scores[order] and not values.equals(times):
            raise ConfigurationError(
                f"{source} is not allowed: its dates, such as {cells.dropna().iloc[0]!r}, may be "
                f"{order} or {other}; give date_format (--date-format), such as '%d/%m/%Y %H:%M'"
            )
    if choices and order != "year first":
        remarks.append(f"dates such as {cells.dropna().iloc[0]!r} are read {order}")
    falls, hours = times.dropna().diff() / pd.Timedelta("1h"), times.dt.hour.dropna()
    twelve = hours.between(1, 12).all() and hours.nunique() > 6
    if twelve and ((falls < -9.0) & (falls > -13.0)).any() and not cells.str.contains("[Mm]").any():
        raise ConfigurationError(
            f"{source} is not allowed: its clock goes from 1 to 12, such as "
            f"{cells.dropna().iloc[0]!r}, without AM or PM; export 24 hours"
        )
    lost = int(times.isna().sum())
    zones = cells.str.extract(r"\d\s*([A-Z]{3,5})$")[0].dropna().unique()
    if lost > len(times) / 2 and len(zones) and date_format is None:
        raise ConfigurationError(
            f"{source} is not allowed: its times have the zone {zones[0]!r}; export UTC, or "
            "offsets such as +01:00"
        )
    if lost > len(times) / 2 or len(times) - lost < _LEAST:
        for name, value in (("date_format", date_format), ("time_unit", time_unit)):
            if value is not None:
                raise refusal(name, value, f"for times such as {cells.dropna().iloc[:1].tolist()}")
        raise ConfigurationError(
            f"{source} is not allowed: {len(times) - lost} of its {len(times)} rows begin with a "
            f"time, and at least {_LEAST} and half of them must; other dates need --date-format, "
            "and numbers a unit in the head, as in 'elapsed [min]', or --time-unit"
        )
    remarks += [f"{lost} rows without a time: left out"] if lost else []
    back = int((times.dropna().diff() < pd.Timedelta(0)).sum())
    remarks += [f"{back} times before the row above: sorted"] if back else []
    return times.dt.tz_localize(None)


def _times(
    cells: pd.Series, date_format: str | None, time_unit: str | None
) -> dict[str, pd.Series]:
    """Return the times for each order of year, month and day that some cells allow."""
    if date_format is not None:
        try:
            return {"": pd.to_datetime(cells, format=date_format, errors="coerce", utc=True)}
        except (TypeError, ValueError) as error:
            raise refusal("date_format", date_format, f"a format of strftime ({error})") from None
    compact = cells.str.extract(f"^{_COMPACT}[ ]?{_COMPACT_CLOCK}$".replace("[ ]?", ""))
    if time_unit is None and compact[0].notna().mean() > 0.9:
        clock = compact[3] + ":" + compact[4].fillna("00") + ":" + compact[5].fillna("00")
        cells = compact[0] + "-" + compact[1] + "-" + compact[2] + " " + clock
    cells = cells.str.replace(rf"^{_COMPACT} (?=\d\d:)", r"\1-\2-\3 ", regex=True)
    if _is_numeric(cells):
        numbers = pd.to_numeric(cells, errors="coerce")
        changes = numbers.diff().dropna()
        ordered = max((changes >= 0.0).mean(), (changes <= 0.0).mean()) > 0.75
        unit = time_unit if ordered else None
        unit = unit or _head_unit(str(cells.name), numbers, ordered)
        if unit is None:
            return {}
        size = numbers * pd.Timedelta(1, "D" if unit in ("d", "excel") else unit).value
        size += pd.Timestamp("1899-12-30").value if unit == "excel" else 0
        size = size.where(size.abs() < 9e18).round(0 if unit == "ns" else -3)
        return {"": pd.to_datetime(size, unit="ns", errors="coerce")}
    plain = cells.str.upper().str.replace(r"(?<=\d),(?=\d)", ".", regex=True)
    plain = plain.str.replace(r"\s*([AP])\.?M\.?$", r" \1M", regex=True)
    plain = plain.str.replace(_WEEKDAY, "", regex=True)
    midnight = plain.str.contains(r"[T\s]24:00(?::00)?$", na=False)
    plain = plain.str.replace(r"([T\s])24:00(?=$|:00$)", r"\g<1>00:00", regex=True)
    parts = plain.str.replace(r"\s*(?:UTC|GMT)$", "Z", regex=True).str.extract(
        rf"^{_DATE}(?:[T.,\s]\s*(.*))?$"
    )
    result = {}
    for order, places in _ORDERS.items():
        year, month, day = (parts[place] for place in places)
        if order != "year first" or plain.str[2:3].eq("-").any():
            year = year.where(year.str.len() != 2, "20" + year)
        date = (year + "-" + month + "-" + day + " " + parts[3].fillna("")).str.strip()
        times = pd.to_datetime(date, format="ISO8601", errors="coerce", utc=True)
        for form in _TWELVE:
            times = times.fillna(pd.to_datetime(date, format=form, errors="coerce", utc=True))
        if times.notna().any():
            result[order] = times + pd.to_timedelta(midnight.astype(int), "D")
    words = cells.where(cells.str.contains(_MONTH, na=False))
    return result or {"": pd.to_datetime(words, errors="coerce", utc=True, format="mixed")}


def _head_unit(head: str, numbers: pd.Series, ordered: bool) -> str | None:
    """Return the unit of numeric times, which are ordered or count from 1970."""
    low, high = numbers.quantile((0.01, 0.99))
    for unit, factor in (("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)):
        if _CLOCK_HEAD.search(head) and 9e8 < low / factor <= high / factor < 4e9:
            return unit
    words = re.sub(r"[^\wµμ]+|_", " ", head).strip() if ordered else ""
    units = (u for u, word in TIME_UNITS.items() if re.search(rf"(?i)\b(?:{word})$", words))
    return next(units, None)


def _evenness(times: pd.Series) -> int:
    """Return the number of even differences, less the times that fall or are missing."""
    known = times.dropna().astype("int64").to_numpy()
    apart = np.diff(np.unique(known))
    even = np.abs(apart - np.median(apart)) <= 0.1 * np.median(apart) if len(apart) else apart
    changes = np.diff(known)
    falls = min((changes < 0).sum(), (changes > 0).sum())
    return int(even.sum() - falls - times.isna().sum())


def pivoted(
    times: pd.Series, table: pd.DataFrame, source: str, remarks: list[str]
) -> tuple[pd.Series, pd.DataFrame]:
    """Return the times and columns of a log with one row a reading as one row a time."""
    heads = [str(head) for head in table.columns]
    names, values = ([head for head in heads if form.fullmatch(head)] for form in (_NAMES, _VALUES))
    words = [h for h in heads if not table[[h]].iloc[:, 0].str.match(r"[+-]?\.?\d", na=False).any()]
    if len(heads) == len(set(heads)) == 2 and times.duplicated().mean() > 0.3:
        names = words or names
        values = [h for h in heads if h not in names]
    if len(set(heads)) < len(heads):
        return times, table
    long = len(values) == 1 and names
    names = [h for h in names if long or h in words or re.match(rf"(?i){_IDS}", h)]
    keys = [h for h in names if table[h].nunique() > 1] or (names[:1] if long else [])
    if not keys:
        if times.duplicated().mean() > 0.3:
            for head in words:
                if not table.assign(time=times).duplicated(["time", head]).any():
                    raise ConfigurationError(
                        f"{source} is not allowed: its rows at one time differ in {head!r}; export "
                        "one device, or call this column 'device'"
                    )
        return times, table
    constant = [h for h in heads if _NAMES.fullmatch(h) and table[h].nunique() < 2]
    values = values if long else [h for h in heads if h not in (*names, *constant)]
    name = table[keys[0]].str.cat([table[key] for key in keys[1:]], sep=" ")
    rows = table.assign(time=times, name=name).dropna(subset=["time", "name"])
    single = rows.drop_duplicates(["time", "name"])
    different, twice = single["name"].nunique() * len(values), len(rows) - len(single)
    key = repr(keys[0]) if len(keys) == 1 else str(keys)
    if different > LONGEST or twice > len(single) / 2:
        raise ConfigurationError(
            f"{source} is not allowed: its column {key} has {different} channels and {twice} "
            f"readings at the time of another; export one place with at most {LONGEST} channels"
        )
    remarks += [f"{twice} readings at the time of another: the first counts"] if twice else []
    if long:
        remarks.append(f"one row a reading: columns are the values {values[0]!r} of each {key}")
    else:
        remarks.append(f"several devices in one table: a column for each {key}")
    wide = single.pivot(index="time", columns="name", values=values)
    order = [(value, name) for value in values for name in single["name"].unique()]
    wide = wide[order]
    heads = [name if long else re.sub(r"(?=\s*\[)|$", f" {name}", value, count=1)
             for value, name in order]  # fmt: skip
    wide = wide.set_axis(heads, axis=1).reset_index()
    return wide["time"], wide.drop(columns="time")


def numbers_of(table: pd.DataFrame, source: str) -> tuple[Array, list[str]]:
    """Return the numbers of the cells (rows, columns), and the units in the cells.

    A column has a decimal point or a decimal comma: the sign that more cells allow. Where both
    give other numbers, the sign of the other columns decides, or the numbers that vary less.
    """
    columns, units, counts = [], [], []
    for place, name in enumerate(table.columns):
        plain = table.iloc[:, place].str.replace("[\u00a0\u202f\u2009']", " ", regex=True)
        parts = plain.str.replace("\u2212", "-").str.extract(f"^{_CELL}$")
        own, factors = parts[1].dropna().str.strip().unique(), None
        if set(own) <= set(_FACTORS) and (parts[0].notna() & parts[1].isna()).any():
            own, factors = own[:0], parts[1].str.strip().map(_FACTORS).fillna(1.0)
        if len(own) > 1:
            raise ConfigurationError(
                f"{source} is not allowed: its column {name!r} has units {own[:3].tolist()}"
            )
        units.append("".join(own))
        read = {sign: _read(parts[0], sign) for sign in ".,"}
        columns.append(
            (parts[0], {s: v if factors is None else v * factors for s, v in read.items()})
        )
        counts.append({sign: int(v.notna().sum()) for sign, v in columns[-1][1].items()})
    signs = {max(own, key=own.__getitem__) for own in counts if own["."] != own[","]}
    result = np.full(table.shape, np.nan)
    for place, ((texts, own), count) in enumerate(zip(columns, counts, strict=True)):
        sign = max(count, key=count.__getitem__)
        clear = count[sign] >= 0.9 * texts.notna().sum()
        if count["."] == count[","] and not own["."].equals(own[","]):
            spread = {key: v.std() / max(abs(v.mean()), 1e-300) for key, v in own.items()}
            sign = min(signs) if len(signs) == 1 else min(spread, key=spread.__getitem__)
            clear = len(signs) == 1 or max(spread.values()) > _SPREAD * spread[sign]
            if not (clear or signs or texts.str.contains(",").any()):
                sign, clear = ".", True
        if not clear:
            example = texts[texts.str.contains("[., ]", na=False)].iloc[0]
            raise ConfigurationError(
                f"{source} is not allowed: its column {table.columns[place]!r} has numbers such as "
                f"{example!r}: their sign is decimal or separates thousands; write a decimal point"
            )
        result[:, place] = own[sign]
    return result, units


def _read(texts: pd.Series, sign: str) -> pd.Series:
    """Return the numbers of texts with a decimal sign, NaN where a text has another form."""
    group = "[, ]" if sign == "." else "[. ]"
    whole = rf"\d*|[1-9]\d{{0,2}}(?:{group}\d{{3}})+"
    form = rf"[+-]?(?:{whole})(?:\{sign}\d*)?(?:[eE][+-]?\d+)?"
    plain = texts.where(texts.str.fullmatch(form, na=False)).str.replace(group, "", regex=True)
    return plain.str.replace(sign, ".", regex=False).astype(float)


def on_even_times(
    numbers: pd.DataFrame, times: pd.Series, source: str, remarks: list[str]
) -> pd.DataFrame:
    """Return the first reading of each channel at each step.

    The interval is the median difference of a channel's own readings, or the shortest where the
    others are multiples of it. A channel that reads later than the first by part of an interval
    has its readings moved.
    """
    numbers = numbers[times.notna()].set_axis(pd.DatetimeIndex(times.dropna()), axis=0)
    twice = int(numbers.index.duplicated().sum())
    remarks += [f"{twice} rows at the time of another: the first reading counts"] if twice else []
    numbers = numbers.groupby(level=0).first()
    first, last = numbers.index[0], numbers.index[-1]
    if first == last:
        raise ConfigurationError(f"{source} is not allowed: all its rows have the same time")
    clock = (numbers.index - first).total_seconds().to_numpy()
    known = [clock[column] for column in numbers.notna().to_numpy().T]
    apart = np.concatenate([np.diff(own) for own in known])
    interval = _interval(apart if len(apart) else np.diff(clock), clock[-1])
    steps = clock[-1] / interval
    if first.year < _FIRST or last.year > _LAST or steps >= min(_MOST, 200 * len(clock)):
        raise ConfigurationError(
            f"{source} is not allowed: from {first} to {last} are {steps:,.0f} intervals of "
            f"{interval:g} s, too many for its {len(numbers):,} rows; look for a wrong time"
        )
    phases = [_phase(own / interval) for own in known]
    columns, merged, moved = dict[str, pd.Series](), 0, set[float]()
    for name, own, phase in zip(numbers, known, phases, strict=True):
        place = own / interval - phase
        step = np.rint(place).astype(np.int64)
        columns[name] = numbers[name].dropna().set_axis(step).groupby(level=0).first()
        merged += len(own) - len(columns[name])
        moved |= set(own[np.abs(place - step) > _OFF].tolist())
        if abs(late := phase - phases[0]) > _PHASE and len(own):
            shift = f"moved by {-late * interval:.4g} s to the steps of the others"
            remarks.append(f"{len(own)} readings of {name}: {shift}")
    remarks += [f"{len(moved)} times between the even ones: rounded"] if moved else []
    remarks += [f"{merged} readings in the step of another: the first counts"] if merged else []
    values = pd.DataFrame(columns)
    ends = *values.index, *np.rint(clock[[0, -1]] / interval - phases[0]).astype(np.int64)
    values = values.reindex(np.arange(min(ends), max(ends) + 1))
    start = first.as_unit("ns") + pd.Timedelta(round(phases[0] * interval, 6), "s")
    index = start + pd.Timedelta(round(interval * 1e9), "ns") * values.index.to_numpy()
    return values.set_axis(pd.DatetimeIndex(index), axis=0)


def _interval(differences: Array, span: float) -> float:
    """Return the interval of differences in seconds, round where that moves no step."""
    *lows, middle = np.quantile(differences, (0.1, 0.02, 0.5), method="lower")
    for low in lows:
        ratio = differences / low
        even = np.mean(np.abs(ratio - np.rint(ratio)) <= _OFF * np.sqrt(ratio)) > 0.95
        if even and middle <= 10.0 * low:
            middle = low
            break
    mean = float(differences[np.abs(differences - middle) <= 0.5 * middle].mean())
    rounds = (round(mean / size) * size for size in _ROUND)
    return next((r for r in rounds if r and abs(r - mean) * span <= 0.1 * mean * mean), mean)


def _phase(steps: Array) -> float:
    """Return the mean lateness of times, in (-1/2, 1/2] of a step; zero where they are uneven."""
    mean = np.exp(2j * np.pi * steps).mean() if len(steps) else 0.0
    return float(np.angle(mean)) / (2 * np.pi) if abs(mean) > 0.5 else 0.0


def without_codes(
    values: pd.DataFrame, codes: Sequence[float], source: str, remarks: list[str]
) -> pd.DataFrame:
    """Return the readings that are no error code."""
    result = values.copy()
    for name in values:
        readings = values[name].dropna().to_numpy()
        counts = [(code, int((readings == code).sum())) for code in codes]
        known = [pair for pair in counts if pair[1]]
        known += _error_codes(readings[~np.isin(readings, codes)])
        result[name] = values[name].where(~values[name].isin([code for code, _ in known]))
        remarks += [f"{name}: {count} readings of {code:g} are an error code: no reading"
                    for code, count in known]  # fmt: skip
        if result[name].isna().all():
            raise ConfigurationError(
                f"{source} is not allowed: its channel {name!r} has error codes alone"
            )
        remarks += [f"{name}: {count} readings of {value:g} are far from all others; "
                    f"--error-code={value:g} drops them"
                    for value, count in _far_values(result[name].dropna().to_numpy())]  # fmt: skip
    for code in codes:
        if not (values == code).to_numpy().any():
            remarks.append(f"no reading is the error code {code:g}")
    return result


def _error_codes(values: Array) -> list[tuple[float, int]]:
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


def _far_values(values: Array) -> list[tuple[float, int]]:
    """Return a lowest or highest value that is repeated far from all others, with its count."""
    distinct, counts = np.unique(values, return_counts=True)
    if len(distinct) < 10:
        return []
    ends = (0, 1, distinct[-1] - distinct[1]), (-1, -2, distinct[-2] - distinct[0])
    return [(float(distinct[end]), int(counts[end])) for end, other, span in ends
            if counts[end] > 1 and abs(distinct[end] - distinct[other]) > 0.5 * span]  # fmt: skip


def _is_code(value: float) -> bool:
    digits = f"{abs(value):.10g}".replace(".", "")
    return value in _CODES or (len(digits) > 2 and set(digits) == {"9"})


def run_lengths(values: Any) -> list[tuple[Any, int]]:
    """Return the values of runs of equal entries, and their lengths."""
    return [(value, len(list(same))) for value, same in groupby(np.asarray(values).tolist())]
