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
    raw: bytes = b""
    reasons: tuple[str, ...] = ()  # parts of right refusals
    unreadable: bool = False

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


STRANGE = ("%Y-%m-%d %H:%M:%S", "%d/%m/%Y %H:%M:%S", "%m/%d/%Y %H:%M:%S", "%d.%m.%Y %H:%M:%S",
           "%a %d/%m/%Y %H:%M:%S", "%a, %m/%d/%Y %H:%M:%S", "%A %d %B %Y %H:%M:%S",
           "%Y%m%d%H%M%S", "%Y%m%dT%H%M%S",
           "%Y-%m-%d %I:%M:%S %p", "%d/%m/%Y %I:%M:%S")  # fmt: skip
ZONES = {"": False, " UTC": False, " GMT": False, "+00:00": False, " CET": True}
FOOTERS = (
    "",
    "",
    "Total{0}12{0}1{0}2{0}3{0}4{0}5{0}6\n",
    "# end\n",
    "\nMean{0}12\n",
    "End of file\n",
)


def draw_strange_log(seed: int) -> Drawn:
    """Return a log with a drawn encoding, clock, footer, devices, error code and suffixes."""
    draw = np.random.default_rng(seed)
    form = str(draw.choice(STRANGE))
    zone = str(draw.choice(list(ZONES), p=[0.7, 0.1, 0.1, 0.05, 0.05]))
    zone = "" if form.startswith(("%Y%m", "%d/%m/%Y %I")) else zone
    separator = str(draw.choice([",", ";", "\t", "|", "   "]))
    encoding = str(draw.choice(["utf-8", "utf-8-sig", "cp1252", "utf-16"]))
    clock = str(draw.choice(["one cell", "one cell", "24:00", "hours", "HrMn", "parts"]))
    seconds, rows = float(draw.choice([600, 3600])), int(draw.integers(300, 900))
    if clock in ("hours", "HrMn", "24:00"):  # whose hours are whole, of dates without a zone
        form, zone = str(draw.choice(["%Y-%m-%d", "%d/%m/%Y", "%a %m/%d/%Y", "%Y%m%d"])), ""
        seconds = 3600.0
    start = pd.Timestamp("2023-01-01") + pd.Timedelta(int(draw.integers(0, 700 * 24)), "h")
    times = start + pd.to_timedelta(np.arange(rows) * seconds, "s")
    ends = np.array(times.hour == 0) & (clock in ("hours", "24:00")) & (draw.random() < 0.7)
    days = times - pd.to_timedelta(ends.astype(int), "h")
    hours = np.where(ends, 24, times.hour)
    stamps = {"time": days.strftime(form) + zone}
    if clock == "24:00":
        own = stamps["time"]
        stamps = {"time": [f"{day} {hour:02}:00" for day, hour in zip(own, hours, strict=True)]}
    elif clock in ("hours", "HrMn"):
        factor = 100 if clock == "HrMn" else 1
        own = [str(factor * hour) for hour in hours]
        stamps = {"date": stamps["time"], "hour" if factor == 1 else "HrMn": own}
        if draw.random() < 0.5 and factor > 1:
            stamps["HrMn"] = [text.zfill(4) for text in own]
    elif clock == "parts" and not zone and form[1:3] in ("d/", "m/", "Y-", "d."):
        parts = [text.split(" ", 1) for text in stamps["time"]]
        stamps = {"date": [p[0] for p in parts], "time": [p[1] for p in parts]}
    if separator == "   ":  # whose cells have no space
        if list(stamps) == ["time"] and not any(" " in text for text in stamps["time"]):
            pass
        elif list(stamps) == ["time"] or any(
            " " in text for own in stamps.values() for text in own
        ):
            separator = ";"
    devices = ["kitchen", "cellar"] if draw.random() < 0.25 else [""]
    names, columns, readings = ["temp", "flow"], {}, {}
    suffixed = draw.random() < 0.15
    code = float(draw.choice(CODES)) if draw.random() < 0.25 else None
    comma = separator != "," and draw.random() < 0.4
    for name in names:
        for device in devices:
            path = np.zeros(rows)
            for row in range(1, rows):
                path[row] = 0.9 * path[row - 1] + draw.normal()
            values = np.round(
                (20.0 if name == "temp" else 980.0) + path * (5 * (name != "temp") + 1), 1
            )
            texts = [f"{value:.1f}" for value in values]
            if name == "flow" and suffixed:
                big = values > 1000.0
                values = np.where(big, np.round(values / 10.0) * 10.0, values)
                texts = [
                    f"{v / 1000.0:.2f}k" if b else f"{v:.1f}"
                    for v, b in zip(values, big, strict=True)
                ]
            if name == "temp" and code is not None:
                hit = draw.random(rows) < 0.02
                hit[:: rows // 5] = True
                values[hit], texts = (
                    np.nan,
                    [f"{code:g}" if h else t for h, t in zip(hit, texts, strict=True)],
                )
            texts = [text.replace(".", ",") for text in texts] if comma else texts
            columns[name, device] = texts
            readings[f"{name} {device}".strip()] = values
    key = str(draw.choice(["room", "location", "device"]))
    frames = []
    for device in devices:
        own = {key: device} if device else {}
        frames.append(pd.DataFrame({**stamps, **own, **{n: columns[n, device] for n in names}}))
    table = pd.concat(frames).sort_index(kind="stable")
    unit_row = draw.random() < 0.2 and separator != "   "
    if any(separator in text for text in stamps.get("time", ())):
        table["time"] = '"' + table["time"] + '"'
    lines = [separator.join(row) for row in table.itertuples(index=False)]
    heads = list(table)
    top = [separator.join(heads)]
    if unit_row:
        units = {"temp": "°C", "flow": "l/h"}
        top.append(separator.join(units.get(head, "") for head in heads))
    if draw.random() < 0.15 and separator != "   ":
        top.insert(0, f"sep={separator}")
    footer = str(draw.choice(FOOTERS)).format(separator)
    text = "\n".join([*top, *lines, ""]) + footer
    truth = pd.DataFrame(readings, times)
    halved = "%I" in form and "%p" not in form
    reasons = ["may be day first or month first", "may be month first or day first"]
    reasons += ["without AM and PM"] * halved + ["has the zone", "have the zone"] * ZONES[zone]
    return Drawn(text, truth.dropna(how="all"), None, seconds, text.encode(encoding),
                 tuple(reasons), halved or ZONES[zone])  # fmt: skip
