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
from numpy.typing import NDArray
from pandas.io.common import get_handle

from fusion_gym.arrays import Array
from fusion_gym.errors import ConfigurationError, display, refusal
from fusion_gym.validation import LONGEST, LONGEST_TEXT

_LEAST, _MOST = 20, 5_000_000  # rows of a log, and steps from its first to its last time
_OFF = 0.05  # of an interval: a time that is farther from the even times is counted
_PHASE = 1e-3  # of an interval: a channel that reads later than the first by more is named
_SIZE, _GAPS = 0.35, 0.2  # least over median change of a log on change, and its share of gaps
_EXPECTED, _RARE = 12.0, 0.1  # rows of small changes, and their share in a log on change, at most
_FEW, _LARGEST = (
    (0.06, 0.02),
    0.7,
)  # shares of a channel's changes that are small, and the largest share
_PARTS_OF_GAP, _EVEN = 40, 0.1  # most intervals of a short gap, and their error, on change
_FIRST, _LAST = 1678, 2261  # years that nanoseconds reach
_SAMPLE = 200  # lines or rows that show the layout of a file
_ROUND = 3600.0, 60.0, 10.0, 1.0, 0.1, 0.01, 1e-3, 1e-6, 1e-9  # seconds of round intervals
_SHARE, _COUNT = 0.05, 3  # most readings and least count of an error code beside the known ones
_CODES = {-127.0, 85.0, 32767.0, -32768.0, 65535.0, 6553.5, 3276.7, -3276.8, 327.67, -327.68}

TIME_UNITS = {  # and their names in headers
    "excel": "excel.*", "s": "s|secs?|seconds?", "ms": "ms|milliseconds?",
    "us": "us|µs|μs|microseconds?", "ns": "ns|nanoseconds?", "min": "mins?|minutes?",
    "h": "h|hrs?|hours?", "d": "d|days?",
}  # fmt: skip
_CLOCK_HEAD = re.compile("time|date|unix|epoch|stamp|elapsed", re.IGNORECASE)
_HOUR_HEAD = re.compile(
    r"(?i)h|(hrs?|hours?|hr_?mn|hhmm(ss)?|(obs |local )?time|stunde|uhrzeit|zeit|heure|hora)\b.*"
)
_PARTS = {
    "year": "(?i:years?|yr|yyyy)|YY", "month": "(?i:months?|mo)|MM", "day": "(?i:days?|dy)|DD",
    "hour": "(?i:hours?|hr)|hh", "minute": "(?i:minutes?|min|mn)|mm",
}  # fmt: skip
_DATE = r"(\d{1,4})[-/.](\d{1,2})[-/.](\d{1,4})"
_CLOCK = r"\d{1,2}:\d{2}(?::\d{2}(?:\.\d+)?)?(?: [AP]M)?"
_MONTH = r"\b(?:JAN|FEB|MAR|APR|MAY|JUN|JUL|AUG|SEP|OCT|NOV|DEC)[A-Z]*"
_ZONE = rf"(?:(?<=\d)|\s)\s*(?!(?:UTC|GMT|[AP]M|UHR|{_MONTH})$)([A-Z]{{2,5}}|\[?[A-Z]+/[A-Z_]+]?)$"
_SPELLINGS: tuple[tuple[str, Any], ...] = (
    (r"\b(?:MON|TUE|WED|THU|FRI|SAT|SUN)[A-Z]*\b[.,]*\s*", ""),
    (r"\s*(?:UTC|GMT)(?=[+-]\d)|\s*(?:UTC|GMT|UHR)$", ""),
    (_ZONE, ""),
    (r"(?<=\d),(?=\d)", "."),
    (r"\s*\b([AP])\.?\s?M\.?$|(?<=\d)([AP])\.?M\.?$", lambda m: f" {m[1] or m[2]}M"),
    # YYYYMMDD, perhaps with HH, HHMM or HHMMSS
    (r"^((?:18|19|20)\d\d)(0[1-9]|1[0-2])(0[1-9]|[12]\d|3[01])(?=$|[T ]?([01]\d|2[0-4]))"
     r"(?:[T ]?\d\d:?([0-5]\d)?:?([0-5]\d(?:\.\d+)?)?)?(?=$|Z|[+-])",
     lambda m: "-".join(m.groups()[:3]) + f" {m[4]}:{m[5] or '00'}:{m[6] or '00'}" * bool(m[4])),
)  # fmt: skip
_ORDERS = {"year first": (0, 1, 2), "day first": (2, 1, 0), "month first": (2, 0, 1)}
_TWELVE = "%Y-%m-%d %I:%M:%S %p", "%Y-%m-%d %I:%M %p"
_PLACE = "(sensor|channel|device|station|node|room|zone|mac|serial|host|site|location|probe)s?"
_NAMES = re.compile(
    f"(?i)entity_id|_field|id|name|model|place|building|floor|area|ort|raum|zimmer|gerät|({_PLACE}|"
    "variable|parameter|metric|tag|topic|series|signal|quantity|point)"
    "([ _-]?(id|name|type|no|nr|number|model|address))?"
)
_IDS = re.compile(f"(?i)id|name|.*[ _-]id|{_PLACE}([ _-]?(id|no|nr|number|address))?")
_VALUES = re.compile("(?i)_?value|state|reading|measurement|wert|messwert|valeur|valor")
_FACTORS = {"k": "e3", "M": "e6", "G": "e9"}
_CELL = r"([+-]?[\d., ]*\d\.?(?:[eE][+-]?\d+)?)\s*([^\d\s.,+'-]\D{0,9}\d?)?"
_SPREAD = 3.0  # ratio of the relative deviations of two ways to read a column's numbers


def read_cells(path: Path, remarks: list[str]) -> pd.DataFrame:
    """Return the cells of a CSV file as texts under its headers."""
    try:
        if path.exists() and not path.is_file():
            raise ValueError("it is no regular file")
        with get_handle(path, "rb", compression="infer", is_text=False) as handle:
            raw = handle.handle.read(LONGEST_TEXT + 1)
        if raw.startswith((b"PK\x03\x04", b"\xd0\xcf\x11\xe0")):
            raise ValueError("it is an Excel workbook or an archive: save the sheet as CSV")
        if raw.startswith(b"PAR1"):
            raise ValueError("it is Parquet: write it by pandas.read_parquet(path).to_csv(...)")
        try:
            text = raw.decode("utf-16" if raw[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
        except UnicodeDecodeError:
            text = raw.decode("cp1252")
        named = re.match(r'"?sep=(.)"?\r?\n', text, re.IGNORECASE)
        text = re.sub(r"(?m)^#.*\n(?=\D)", "", text[named.end() if named else 0 :])
        width, separator, above = _layout(text, named[1] if named else ",;\t| ")
        lines = text.rstrip("\r\n ").rsplit("\n", _LEAST)
        rows = [bool(re.match(r"\s*[\"']?\d", line)) or _width(line, separator) == width
                for line in reversed(lines[1:])]  # fmt: skip
        below = [*rows, True].index(True)
        text = "\n".join(lines[: len(lines) - below])
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
            raise ValueError("its rows have more cells than headers: quote decimal commas")
        if numeric.all():
            raise ValueError(f"its headers are numbers, such as {display(heads.iloc[-1])}")
    except Exception as error:  # a damaged archive may raise any exception
        text = getattr(error, "strerror", None) or " ".join(str(error).split()[:20])
        text = text or type(error).__name__
        text += "; quote decimal commas" if isinstance(error, pd.errors.ParserError) else ""
        raise refusal("log", str(path), f"a CSV file ({text})") from None
    if len(cells) > 2 and not cells.iloc[1].str.contains(r"^[+-]?[\d.]|\d\d", na=False).any():
        units = cells.iloc[1].fillna("").str.replace(r"[\[\]()]", "", regex=True)
        named = units.isin(("", "-", "TS", "RN")) | heads.str.contains(r"\[|\.\.")
        heads = heads.where(named, heads + " [" + units + "]")
        cells = cells.iloc[2 if text.lstrip('"').startswith("TOA5") else 1 :]  # aggregations
    remarks += [f"{above} lines above the header: left out"] if above else []
    remarks += [f"{below} lines below the rows: left out"] if below else []
    # Deutscher Wetterdienst's code may be frequent.
    cells = cells.replace("-999", np.nan) if "MESS_DATUM" in set(heads) else cells
    return cells.iloc[1:].set_axis(list(heads), axis=1).reset_index(drop=True)


def _layout(text: str, separators: str) -> tuple[int, str, int]:
    """Return the number of columns, the separator, and the number of lines above the header."""
    lines, choices = text.split("\n", _SAMPLE)[:_SAMPLE], []
    for separator in separators:
        widths = [_width(line, separator) for line in lines]
        width = max(widths, key=widths.count)
        above = 1 if text.lstrip('"').startswith("TOA5") else widths.index(width)
        doubt = 0.6 * bool(re.match(r"\s*\d", lines[above])) + 0.5 * (separator == " ")
        count = widths.count(width) * (width > 1) - doubt * len(lines)
        choices.append((count, separator != " ", width, separator, above))
    return max(choices)[2:]


def _width(line: str, sign: str) -> int:
    return len(next(csv.reader([line.strip(" \r")], delimiter=sign, skipinitialspace=True), ()))


def split_times(
    table: pd.DataFrame, source: str, date_format: str | None, time_unit: str | None,
    remarks: list[str],
) -> tuple[pd.Series, pd.DataFrame]:  # fmt: skip
    """Return the times of the rows, NaT where a row has none, and the other columns."""
    columns = [table.iloc[:, place] for place in range(table.shape[1])]
    samples = [column.dropna().head(_SAMPLE) for column in columns]
    plain = [_spelled(own) for own in samples]
    dates, clocks, hours = (
        [place for place, own in enumerate(plain) if own.str.fullmatch(form).mean() > 0.9]
        for form in (_DATE, _CLOCK, r"\d{1,6}")
    )
    hours = [place for place in hours if _HOUR_HEAD.fullmatch(table.columns[place])
             and dates and columns[dates[0]].duplicated().mean() > 0.5]  # fmt: skip
    parts = {unit: place for unit, form in _PARTS.items()
             for place, head in enumerate(table.columns) if re.fullmatch(form, head)}  # fmt: skip
    if {"year", "month", "day"} <= parts.keys() and date_format is None:
        frame = table.iloc[:, [*parts.values()]].set_axis([*parts], axis=1)
        cells, used = pd.to_datetime(frame, errors="coerce").astype(str), set(parts.values())
    elif dates and (clocks or (hours and date_format is None)):
        clock = columns[clocks[0]] if clocks else _clock(columns[hours[0]])
        date = columns[dates[0]] if date_format else _spelled(columns[dates[0]])
        cells, used = date + " " + clock, {dates[0], (clocks or hours)[0]}
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


def _clock(hours: pd.Series) -> pd.Series:
    """Return hours, or hours and minutes in one number, with colons."""
    most = pd.to_numeric(hours, errors="coerce").max()
    width = 4 if most > 24 or "m" in str(hours.name).lower().replace("time", "") else 2
    digits = hours.str.zfill(6 if most > 2400 else width).str.ljust(6, "0")
    return digits.str[:2] + ":" + digits.str[2:4] + ":" + digits.str[4:]


def _spelled(cells: pd.Series) -> pd.Series:
    """Return times in capitals, without weekdays and zones, with dashes in dates of digits."""
    plain = cells.str.upper()
    for form, text in _SPELLINGS:
        plain = plain.str.replace(form, text, regex=True)
    return plain.str.strip()


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
    zones = cells.str.upper().str.extract(_ZONE)[0].dropna()
    if date_format is None and len(zones) and not _is_numeric(cells):
        raise ConfigurationError(
            f"{source} is not allowed: its times have the zone {zones.iloc[0]!r}; write UTC"
        )
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
    lost = int(times.isna().sum())
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
    known = times.dropna()
    change = known[known != known.shift()].diff().dropna() / pd.Timedelta("12h")
    change *= -1.0 if change.median() < 0.0 else 1.0
    halves = (change + 1.0).between(0.0, min(0.5, 2.0 * change.abs().median())).any()
    shown = _is_numeric(_spelled(cells.head(_SAMPLE))) or cells.str.contains("(?i)[ap].?.?m").any()
    if halves and known.dt.hour.between(1, 12).all() and not shown:
        raise ConfigurationError(
            f"{source} is not allowed: its clock has 12 hours without AM and PM; export one of 24"
        )
    back = int((known.diff() < pd.Timedelta(0)).sum())
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
    plain = _spelled(cells)
    if _is_numeric(cells if time_unit else plain):
        numbers = pd.to_numeric(cells, errors="coerce").replace([np.inf, -np.inf], np.nan)
        changes = numbers.diff().dropna()
        ordered = max((changes >= 0.0).mean(), (changes <= 0.0).mean()) > 0.75
        apart = np.diff(np.unique(numbers.dropna()))
        if len(apart) > max(0.9 * len(numbers) - 1, 2):
            ordered |= np.quantile(apart, 0.9) < 1.1 * np.quantile(apart, 0.1)
        unit = time_unit or _head_unit(str(cells.name), numbers)
        if unit is None or not (ordered or _CLOCK_HEAD.search(str(cells.name))):
            return {}
        size = numbers * pd.Timedelta(1, "D" if unit in ("d", "excel") else unit).value
        size += pd.Timestamp("1899-12-30").value if unit == "excel" else 0
        size = size.where(size.abs() < 9e18).round(0 if unit == "ns" else -3)
        return {"": pd.to_datetime(size, unit="ns", errors="coerce")}
    ends = plain.str.contains(r"[T ]24:00(?::00)?(?:\.0+)?(?![:.\d])", na=False)
    plain = plain.where(~ends, plain.str.replace("24:00", "00:00", n=1))
    parts = plain.str.extract(rf"^{_DATE}(?:[T.,\s]\s*(.*))?$")
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
            result[order] = times
    if not result:
        words = plain.where(plain.str.contains(_MONTH) & plain.str.contains(r"\d"))
        result[""] = pd.to_datetime(words, errors="coerce", utc=True, format="mixed")
    day = pd.Timedelta(1, "D")
    return {order: times.where(~ends, times + day) for order, times in result.items()}


def _head_unit(head: str, numbers: pd.Series) -> str | None:
    """Return the unit of numeric times."""
    low, high = numbers.quantile((0.01, 0.99))
    for unit, factor in (("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)):
        if _CLOCK_HEAD.search(head) and 9e8 < low / factor <= high / factor < 4e9:
            return unit
    words = re.sub(r"[^\wµμ]+|_", " ", head).strip()
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
    """Return the times and columns of a log with one row a reading or device as one row a time."""
    rows = times.notna()
    times, table = times[rows].reset_index(drop=True), table[rows].reset_index(drop=True)
    heads = list(table.columns)
    if len(set(heads)) < len(heads):
        return times, table
    cells = {head: table[head].dropna().drop_duplicates() for head in heads}
    shares = {head: own.str.fullmatch(_CELL).mean() for head, own in cells.items()}
    varied = [h for h in heads if 1 < len(cells[h]) <= len(table) / 2
              and not cells[h].str.fullmatch(r"-\d+|[+-]?\d*[.,]\d+").any()]  # fmt: skip
    names = [h for h in heads if (_IDS if shares[h] > 0.5 else _NAMES).fullmatch(h)]
    values = [h for h in heads if _VALUES.fullmatch(h) and shares[h] > 0.0]
    if "_value" in heads:  # InfluxDB, whose other columns are tags
        names = [h for h in heads if not re.fullmatch("result|table|_value|_start|_stop", h)]
    if table[names].assign(**{"": times}).duplicated().mean() > 0.3:
        names += [h for h in varied if shares[h] <= 0.5 and h not in names and (
                  table[[*names, h]].assign(**{"": times}).duplicated().mean() < 0.05)]  # fmt: skip
    keys, count = list[str](), 1
    for head in (h for h in names if h in varied):
        if (different := len(table[[*keys, head]].drop_duplicates())) > count:
            keys, count = [*keys, head], different
    keys = keys or names * (len(names) == len(values) == 1)
    if len(values) != 1:
        values = [head for head in heads if head not in {*names, *keys}]
    if not keys or not values:
        if times.duplicated().mean() > 0.5 and (times == times.dt.normalize()).all():
            raise ConfigurationError(
                f"{source} is not allowed: its times are dates without a clock; join both columns"
            )
        return times, table
    label = table[keys[0]].fillna("").str.cat([table[key].fillna("") for key in keys[1:]], sep=" ")
    long = table.assign(**{"": times, " ": label.str.strip()})[label.str.strip() != ""]
    single = long.drop_duplicates(["", " "])
    different, twice = single[" "].nunique(), len(long) - len(single)
    name = " and ".join(map(repr, keys))
    if different * len(values) > LONGEST or twice > len(single) / 2:
        raise ConfigurationError(
            f"{source} is not allowed: its column {name} has {different} channels and {twice} "
            f"readings at the time of another; export one place with at most {LONGEST} channels"
        )
    remarks += [f"{twice} readings at the time of another: the first counts"] if twice else []
    shown = ", ".join(map(repr, values))
    remarks.append(f"one row a reading: columns are the values {shown} of each {name}")
    wide = single.pivot(index="", columns=" ", values=values)
    wide = wide[[(value, own) for value in values for own in single[" "].unique()]]
    wide.columns = [own if _VALUES.fullmatch(v) else re.sub(r"(?= \[|$)", f" {own}", v, count=1)
                    for v, own in wide.columns]  # fmt: skip
    return wide.index.to_series().reset_index(drop=True), wide.reset_index(drop=True)


def numbers_of(table: pd.DataFrame, source: str) -> tuple[Array, list[str]]:
    """Return the numbers of the cells (rows, columns), and the units in the cells.

    A column has a decimal point or a decimal comma: the sign that more cells allow. Where both
    give other numbers, the sign of the other columns decides, or the numbers that vary less.
    """
    columns, units, counts = [], [], []
    for place, name in enumerate(table.columns):
        plain = table.iloc[:, place].str.replace("[\u00a0\u202f\u2009']", " ", regex=True)
        parts = plain.str.replace("\u2212", "-").str.extract(f"^{_CELL}$")
        unit = parts[1].str.strip()
        own = unit.dropna().unique()
        bare = pd.to_numeric(parts[0][unit.isna()].dropna(), errors="coerce").unique()
        mixed = not all(map(_is_code, bare))
        if len(own) and (mixed or len(own) > 1) and set(own) <= set(_FACTORS):
            parts[0], own = parts[0].str.strip() + unit.map(_FACTORS).fillna(""), own[:0]
        elif len(own) > 1 or (len(own) and mixed and re.match("[kMGTmµμunp][A-Za-z]*$", own[0])):
            raise ConfigurationError(
                f"{source} is not allowed: its column {name!r} has units "
                f"{[*own[:3], *['none'] * mixed]}; write all its numbers in one unit"
            )
        units.append("".join(own))
        columns.append((parts[0], {sign: _read(parts[0], sign) for sign in ".,"}))
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
    others are multiples of it, or the step of which all are multiples where a channel is recorded
    on change. A channel that reads later than the first by part of an interval
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
    fine = reported_changes(clock, numbers.to_numpy()).any()
    interval = _interval(apart if len(apart) else np.diff(clock), clock[-1], bool(fine))
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


def _interval(differences: Array, span: float, fine: bool) -> float:
    """Return the interval of differences in seconds, round where that moves no step."""
    *lows, middle = np.quantile(differences, (0.1, 0.02, 0.5), method="lower")
    for low in lows:
        ratio = differences / low
        even = np.mean(np.abs(ratio - np.rint(ratio)) <= _OFF * np.sqrt(ratio)) > 0.95
        if even and middle <= 10.0 * low:
            middle = low
            break
    mean = float(differences[np.abs(differences - middle) <= 0.5 * middle].mean())
    mean = _largest_divisor(differences, lows[-1]) if fine else mean
    rounds = (round(mean / size) * size for size in _ROUND)
    return next((r for r in rounds if r and abs(r - mean) * span <= 0.1 * mean * mean), mean)


def _largest_divisor(differences: Array, low: float) -> float:
    """Return the largest part of ``low`` of which nearly all differences are multiples, or it."""
    for part in range(1, _PARTS_OF_GAP + 1):
        size = low / part
        for most in low * 2.0 ** np.arange(1, 16):  # longer differences need a more exact size
            near = differences[differences <= most]
            size = float(near.sum() / np.rint(near / size).sum())
        ratio = differences / size
        if np.mean(np.abs(ratio - np.rint(ratio)) <= _EVEN) > 0.95:
            return size
    return float(low)


def reported_changes(times: NDArray[Any], values: Array) -> Array:
    """Return the size (l,) of a channel's changes in readings (T, l) at times (T,), 0 for any size.

    A log on change may have a row for each channel that changes, or for all if one changes. Small
    changes of all channels together are then far rarer than their shares say.
    """
    pairs = ((times[known], column[known])
             for column, known in zip(values.T, np.isfinite(values).T, strict=True))  # fmt: skip
    result = np.array([_reported_change(*own) for own in pairs])
    known = np.isfinite(values).all(axis=1)
    count, changes = len(result), np.abs(np.diff(values[known], axis=0))
    if result.any() or count == 1 or not _has_gaps(np.diff(times[known])):
        return result
    share = _EXPECTED / len(changes)
    levels = [np.full(count, share ** (1.0 / count))]
    for few in _FEW:
        levels += [*np.where(np.eye(count) > 0.0, few, (share / few) ** (1.0 / (count - 1)))]
    for level in levels:  # the same share of each channel, or few of one
        if level.max() > _LARGEST:
            continue
        limits = [
            np.quantile(own, q, method="lower") for own, q in zip(changes.T, level, strict=True)
        ]
        small = changes <= limits
        if small.all(axis=1).sum() <= _RARE * len(changes) * small.mean(axis=0).prod():
            others = [np.delete(small, place, axis=1).all(axis=1) for place in range(count)]
            alone = [own[rows] for own, rows in zip(changes.T, others, strict=True)]
            return np.array([np.quantile(own, 0.1) if len(own) else 0.0 for own in alone])
    return result


def _has_gaps(gaps: Array) -> bool:
    return len(gaps) >= 30 and bool(np.mean(gaps > 1.5 * np.quantile(gaps, 0.02)) >= _GAPS)


def _reported_change(times: NDArray[Any], values: Array) -> float:
    """Return the size that all changes of readings (T,) at times (T,) have, zero for any size.

    The gaps of a log recorded on change end in a change of at least one size. A gap of the longest
    time may end in a smaller one.
    """
    gaps, changes = np.diff(times), np.abs(np.diff(values))
    if not _has_gaps(gaps):
        return 0.0
    longest = gaps > 0.95 * gaps.max()
    own = changes[~longest] if longest.mean() > 0.02 else changes
    size, middle = np.quantile(own, (0.02, 0.5)) if len(own) >= 30 else (0.0, 1.0)
    return float(size) if size > _SIZE * middle else 0.0


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
