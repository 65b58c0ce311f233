"""Logs in formats that loggers and spreadsheets write, drawn with a seed, with their truth."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from fusion_gym.recordings import Recording

ZERO = pd.Timestamp("1970-01-01")
CODES = (-127.0, 85.0, -999.0, -9999.0, 9999.0)
UNITS = {"unix": 1.0, "time_ms": 1e-3, "elapsed [min]": 60.0, "hours": 3600.0}
UNITS |= {"excel days": 86400.0}
ZEROS = {"unix": ZERO, "time_ms": ZERO, "excel days": pd.Timestamp("1899-12-30")}
PLACES = {"excel days": 12, "time_ms": 3}
CLOCKS = ("%Y-%m-%d %H:%M:%S.%f", "%Y-%m-%dT%H:%M:%S.%fZ", "%Y/%m/%d %H:%M:%S.%f",
          "%d/%m/%Y %H:%M:%S.%f", "%m/%d/%Y %H:%M:%S.%f", "%d.%m.%Y %H:%M:%S.%f",
          "%m/%d/%Y %I:%M:%S %p", "%d.%m.%y %H:%M:%S.%f", *UNITS)  # fmt: skip


@dataclass
class Drawn:
    """The text of a log, and its true readings (T, channels) with even times."""

    text: str
    truth: pd.DataFrame
    wrapped: str | None
    seconds: float

    def verdict(self, recording: Recording) -> str:
        """Return what is wrong with the recording, or an empty text."""
        values, truth = recording.values, self.truth
        if set(values) != set(truth):
            return f"channels {list(values)}"
        interval = pd.Timedelta(self.seconds, "s")
        if abs(recording.interval - interval) > 1e-3 * interval:
            return f"interval {recording.interval} for {interval}"
        places = values.index.get_indexer(truth.index, method="nearest", tolerance=0.06 * interval)
        own = values[list(truth)].to_numpy()
        if (places < 0).any() or len(np.unique(places)) < len(places):
            return "times"
        if not np.allclose(own[places], truth, rtol=1e-12, equal_nan=True):
            return "values"
        if np.isfinite(np.delete(own, places, axis=0)).any():
            return "readings at no time"
        faults = {row.channel.name: row.fault for row in recording.card}
        if self.wrapped and faults[self.wrapped] != "wraps around":
            return "a wrapped channel"
        return ""


def draw_log(seed: int) -> Drawn:
    """Return a log in a drawn format."""
    draw = np.random.default_rng(seed)
    clock = str(draw.choice(CLOCKS))
    layout = str(draw.choice(["wide", "wide", "wide", "long", "TOA5"]))
    seconds, rows = draw.choice([1, 10, 60, 300, 600, 3600]), int(draw.integers(150, 1200))
    start = pd.Timestamp("2023-01-01") + pd.Timedelta(int(draw.integers(0, 700 * 144)) * 600, "s")
    channels = int(draw.integers(1, 5))
    decimals = draw.integers(1, 4, channels)
    size = 10.0 ** draw.integers(0, 3, channels)
    noise = draw.normal(size=(rows, channels))
    path = np.zeros((rows, channels))
    for row in range(1, rows):
        path[row] = 0.9 * path[row - 1] + noise[row]
    level = draw.choice([0.0, 20.0, 1000.0], channels)
    values = np.array([[round(x, d) for x, d in zip(row, decimals, strict=True)]
                       for row in level + size * path]) + 0.0  # fmt: skip
    names = [f"s{place}" for place in range(channels)]
    wrapped = None
    if draw.random() < 0.15:
        wrapped, values[:, 0] = names[0], np.round(350 + 8 * path[:, 0], 1) % 360.0
    values[draw.random(values.shape) < draw.choice([0.0, 0.05])] = np.nan
    cells = values.copy()
    code = draw.choice(CODES) if draw.random() < 0.3 else None
    if code is not None and wrapped is None and size[0] == 1.0 and level[0] < 1000.0:
        hit = draw.random(rows) < 0.01
        hit[:: rows // 4] = True
        cells[hit, 0], values[hit, 0] = code, np.nan
    even = start + pd.to_timedelta(np.arange(rows) * float(seconds), "s")
    jitter = draw.choice([0.0, 1e-6, 0.01 * seconds])
    if clock == "%m/%d/%Y %I:%M:%S %p":
        jitter = 0.0
    late = jitter * draw.random(rows)
    real = even + pd.to_timedelta(np.round(late, 6), "s")
    head = "time"
    if clock in UNITS:
        head, zero = clock, ZEROS.get(clock, start)
        even = even if clock in ZEROS else ZERO + (even - start)
        own = (real - zero).total_seconds().to_numpy() / UNITS[clock]
        texts = [f"{x:.{PLACES.get(clock, 9)}f}" for x in own]
    else:
        texts = list(real.strftime(clock))
    truth = pd.DataFrame(values, even, names)
    signs = [(",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ",")]
    separator, decimal = signs[draw.integers(5)]
    thousands = draw.choice(["", "", {".": ",", ",": "."}[decimal], " "])
    unit = draw.choice(["", " °C", " %"]) if layout == "wide" else ""

    def written(value: float, place: int) -> str:
        if np.isnan(value):
            return ""
        text = f"{value:,.{decimals[place]}f}".replace(",", "T").replace(".", decimal)
        return text.replace("T", thousands) + unit

    table = pd.DataFrame({name: [written(x, place) for x in cells[:, place]]
                          for place, name in enumerate(names)})  # fmt: skip
    heads = {name: draw.choice([name, f"{name} [m]"]) for name in names}
    apart = draw.random() < 0.3 and "%H" in clock and "T" not in clock and layout == "wide"
    if apart:
        parts = pd.Series(texts).str.split(" ", n=1, expand=True)
        table.insert(0, "date", parts[0])
        table.insert(1, "time", parts[1])
    else:
        table.insert(0, head, texts)
    if draw.random() < 0.2 and layout == "wide":
        table["status"] = draw.choice(["ok", "warm", "late"], rows)
    if draw.random() < 0.2:
        lost = slice(rows // 3, rows // 3 + int(draw.integers(2, 40)))
        table = table.drop(index=table.index[lost])
        truth.iloc[lost] = np.nan
    if draw.random() < 0.2:
        twice = table.iloc[10:20]
        table = pd.concat([table.iloc[:20], twice, table.iloc[20:]])
    if draw.random() < 0.1:
        table = table.iloc[::-1]
    if layout == "long":
        table = table.melt(id_vars=[head], var_name="sensor", value_name="value")
        table = table[table["value"] != ""]
    elif layout == "wide":
        table = table.rename(columns=heads)
    quoting = int(draw.choice([0, 0, 1]))
    text = table.to_csv(index=False, sep=separator, quoting=quoting)
    if layout == "TOA5":
        width = table.shape[1]
        top, body = text.split("\n", 1)
        above = f'"TOA5","logger","CR1000"{separator}\n'.replace(",", separator)
        units = separator.join(['"TS"', *['"m"'] * (width - 1)])
        kinds = separator.join(['"Smp"'] * width)
        text = f"{above}{top}\n{units}\n{kinds}\n{body}"
    truth = truth.dropna(how="all")
    return Drawn(text, truth, wrapped, seconds)


@dataclass
class Strange(Drawn):
    """A log as bytes, and a part of its refusal where none can read it."""

    content: bytes = b""
    refusal: str | None = None


STRANGE_CLOCKS = ("%Y-%m-%d %H:%M", "%d/%m/%Y %H:%M", "%m/%d/%Y %H:%M", "%a %d/%m/%Y %H:%M",
                  "%d/%m/%Y %H:%M GMT", "%Y%m%d%H%M", "%d.%m.%Y %H:%M UTC", "24:00", "hours",
                  "HrMn", "%d/%m/%Y %I:%M", "%d/%m/%Y %H:%M CET")  # fmt: skip
ENCODINGS = "utf-8", "utf-8-sig", "cp1252", "utf-16"


def draw_strange_log(seed: int) -> Strange:
    """Return a log in a drawn format with weekdays, hours, footers, devices or suffixes."""
    draw = np.random.default_rng(10_000 + seed)
    rows, minutes = int(draw.integers(400, 1500)), int(draw.choice([30, 60]))
    clock = str(draw.choice(STRANGE_CLOCKS))
    minutes = 60 if clock in ("24:00", "hours", "HrMn") else minutes
    first = pd.Timestamp("2023-01-01") + pd.Timedelta(int(draw.integers(0, 600)), "D")
    times = pd.date_range(first, periods=rows, freq=f"{minutes}min")
    devices = ("hall", "bath") if draw.random() < 0.25 else ("",)
    count = int(draw.integers(1, 4))
    path = draw.normal(size=(rows, count * len(devices)))
    for row in range(1, rows):
        path[row] += 0.9 * path[row - 1]
    suffix = draw.random() < 0.2
    values = np.round(900.0 + 100.0 * path if suffix else 20.0 + path, 1)
    cells = values.astype(object)
    if suffix:
        large = values >= 1000.0
        cells[large] = [f"{value / 1000.0:.4f}k" for value in values[large]]
    elif draw.random() < 0.3:  # an error code
        hit = draw.random(rows) < 0.02
        hit[:: rows // 5] = True
        cells[hit, 0], values[hit, 0] = float(draw.choice(CODES)), np.nan
    names = [f"s{place}" for place in range(count)]
    days = [time if time.hour else time - pd.Timedelta("1D") for time in times]
    stamps = {"time": [time.strftime(clock) for time in times]}
    if clock == "24:00":
        stamps = {
            "time": [
                f"{d:%d.%m.%Y} {t.hour or 24:02d}:00" for d, t in zip(days, times, strict=True)
            ]
        }
    elif clock == "hours":
        stamps = {"date": [f"{d:%Y-%m-%d}" for d in days], "hour": [t.hour or 24 for t in times]}
    elif clock == "HrMn":
        stamps = {"date": [f"{t:%Y%m%d}" for t in times], "HrMn": [t.hour * 100 for t in times]}
    parts = []
    for place, device in enumerate(devices):
        own = cells[:, place * count : (place + 1) * count]
        part = pd.DataFrame(stamps) if not device else pd.DataFrame(stamps).assign(room=device)
        parts.append(part.assign(**dict(zip(names, own.T, strict=True))))
    table = pd.concat(parts).sort_index(kind="stable") if len(parts) > 1 else parts[0]
    separator = str(draw.choice([",", ";", "\t", "|", " "]))
    if separator == " " and " " in str(table.iloc[0, 0]):
        separator = ";"
    text = table.to_csv(index=False, sep=separator)
    head, body = text.split("\n", 1)
    if draw.random() < 0.2 and separator != " ":  # a row of units
        units = ["" for _ in [*stamps, *(["room"] if devices[0] else [])]] + ["°C"] * count
        body = separator.join(units) + "\n" + body
    if draw.random() < 0.2:
        body += draw.choice(["# end of file\n", f"Total{separator}{rows}\n", "\n\n"])
    if draw.random() < 0.1 and separator == ";":
        head = f"sep=;\n{head}"
    content = f"{head}\n{body}".encode(str(draw.choice(ENCODINGS)), "replace")
    channels = [f"{name} {device}".strip() for device in devices for name in names]
    channels = list(devices) if count == 1 < len(devices) else channels
    refusal = {"%d/%m/%Y %I:%M": "from 1 to 12", "%d/%m/%Y %H:%M CET": "zone 'CET'"}.get(clock)
    truth = pd.DataFrame(values, times, channels)
    return Strange("", truth, None, 60.0 * minutes, content, refusal)
