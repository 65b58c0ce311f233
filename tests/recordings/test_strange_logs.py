"""Logs as loggers, weather services and gateways export them: read right, or refused by name."""

import io
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from log_formats import draw_strange_log
from refusals import refused

from fusion_gym.recordings import Recording
from fusion_gym.recordings.field_report import fields_of
from fusion_gym.validation import ConfigurationError

ROWS = 96
VALUES = np.round(20.0 + np.cumsum(np.random.default_rng(0).normal(size=ROWS)), 1)
HOURS = pd.date_range("2024-03-01", periods=ROWS, freq="h")


def lines(row: Callable[[pd.Timestamp, float], str], head: str, end: str = "") -> bytes:
    rows = [row(time, value) for time, value in zip(HOURS, VALUES, strict=True)]
    return ("\n".join([head, *rows]) + "\n" + end).encode()


def table(form: str, head: str = "time,a", end: str = "") -> bytes:
    """A log whose times have a format of strftime."""
    return lines(lambda time, value: f"{time.strftime(form)},{value}", head, end)


def ends(time: pd.Timestamp) -> tuple[pd.Timestamp, int]:
    """The day, and the hour from 1 to 24 that ends at this time."""
    day = time if time.hour else time - pd.Timedelta("1D")
    return day, time.hour or 24


def of_hour(form: str, head: str) -> bytes:
    return lines(lambda t, v: form.format(d=ends(t)[0], h=ends(t)[1], v=v), head)


PLAIN = table("%Y-%m-%d %H:%M")
READ = {
    "UTF-16": PLAIN.decode().encode("utf-16"),
    "bars": PLAIN.replace(b",", b" | "),
    "spaces": lines(lambda t, v: f"{t:%Y-%m-%dT%H:%M}   {v:6.1f}", "time    a"),
    "a separator in the first line": b"sep=;\r\n" + PLAIN.replace(b",", b";"),
    "a footer": PLAIN + b"Total,1,2,3\n# end of file\n",
    "the German weather service": lines(
        lambda t, v: f"         44;{t:%Y%m%d%H};   10; {v:5.1f};eor",
        "STATIONS_ID;MESS_DATUM;QN_9;a;eor",
    ),
    "minutes without signs": table("%Y%m%d%H%M"),
    "weekdays": table("%a %d/%m/%Y %H:%M"),
    "long weekdays, month first": table('"%A, %m/%d/%Y %H:%M"'),
    "Greenwich": table("%d/%m/%Y %H:%M GMT"),
    "names of months": table("%a %b %d %Y %H:%M"),
    "hours and minutes as a number": lines(
        lambda t, v: f"{t:%Y%m%d},{100 * t.hour},{v}", "date,HrMn,a"
    ),
    "hours from 0 to 23": lines(lambda t, v: f"{t:%Y-%m-%d},{t.hour},{v}", "date,hour,a"),
    "hours from 1 to 24": of_hour("{d:%d.%m.%Y};{h};{v}", "Datum;Stunde;a"),
    "the end of a day": of_hour("{d:%Y-%m-%d} {h:02d}:00,{v}", "time,a"),
    "the end of a day beside its date": of_hour("{d:%d/%m/%Y},{h:02d}:00,{v}", "date,clock,a"),
    "thousands with a suffix": lines(
        lambda t, v: f"{t:%Y-%m-%d %H:%M},{f'{v / 1e3}k' if t.hour % 2 else v}", "time,a"
    ),
    "unsorted seconds": pd.DataFrame({"unix": [int(t.timestamp()) for t in HOURS], "a": VALUES})
    .sample(frac=1.0, random_state=0).to_csv(index=False).encode(),
}  # fmt: skip


@pytest.mark.parametrize("name", READ)
def test_a_strange_log_is_read_right(name: str, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(READ[name])
    recording = Recording.read(path)
    assert list(recording.values.index) == list(HOURS)
    np.testing.assert_allclose(recording.values["a"], VALUES, rtol=1e-12)


OTHER = VALUES + 5.0
TWO = [
    row
    for time, a, b in zip(HOURS, VALUES, OTHER, strict=True)
    for row in ((time, "bath", a, b), (time, "hall", b, a))
]
DEVICES = {
    "a room beside two values": (
        pd.DataFrame(TWO, columns=["time", "room", "air [°C]", "damp"]),
        {"air bath": VALUES, "air hall": OTHER, "damp bath": OTHER, "damp hall": VALUES},
    ),
    "two columns of names": (
        pd.DataFrame([(t, r, "air", a) for t, r, a, _ in TWO],
                     columns=["time", "device", "parameter", "value"]).assign(
                         parameter=["air", "damp"] * ROWS),
        {"bath air": VALUES, "hall damp": OTHER},
    ),
    "Influx with a tag": (
        pd.DataFrame([(0, t, a, "air", r) for t, r, a, _ in TWO],
                     columns=["table", "_time", "_value", "_field", "room"]),
        {"bath": VALUES, "hall": OTHER},
    ),
    "a receiver of many devices": (
        pd.DataFrame([(t + pd.Timedelta(f"{20 * (r == 'hall')}s"), "X1", 7 + (r == "hall"), a)
                      for t, r, a, _ in TWO], columns=["time", "model", "id", "temperature_C"]),
        {"temperature_C 7": VALUES, "temperature_C 8": OTHER},
    ),
    "sensors of a community": (
        pd.DataFrame([(11 + (r == "hall"), "DHT22", 500, t, a, b) for t, r, a, b in TWO],
                     columns=["sensor_id", "sensor_type", "location", "time", "air", "damp"]),
        {"air 11": VALUES, "air 12": OTHER, "damp 11": OTHER, "damp 12": VALUES},
    ),
    "a status": (
        pd.DataFrame({"time": HOURS, "a": VALUES, "status": ["ok", "warm", "late"] * 32}),
        {"a": VALUES},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", DEVICES)
def test_every_device_has_channels_of_its_own(name: str, tmp_path: Path) -> None:
    frame, expected = DEVICES[name]
    frame.to_csv(tmp_path / "log.csv", index=False)
    recording = Recording.read(tmp_path / "log.csv")
    assert set(recording.values) == set(expected)
    for channel, values in expected.items():
        np.testing.assert_allclose(recording.values[channel].to_numpy(), values, rtol=1e-12)


TURN = np.sin(np.arange(ROWS) / 4.0)
FAR = {
    "two runs of zeros": (
        np.where(np.arange(ROWS) % 40 < 15, 0.0, VALUES + 20.0),
        "45 readings of 0",
    ),
    "a code twice": (np.where(np.arange(ROWS) % 50 == 7, -55.0, VALUES), "2 readings of -55"),
    "the sun at night": (np.round(np.maximum(TURN, 0.0) * 900.0), ""),
    "rain": (np.where(np.arange(ROWS) % 7, 0.0, np.round(2.0 * TURN**2, 1)), ""),
    "a contact": (np.arange(ROWS) // 9 % 2 * 1.0, ""),
}


@pytest.mark.parametrize("name", FAR)
def test_repeated_values_far_from_all_others_are_named(name: str, tmp_path: Path) -> None:
    values, remark = FAR[name]
    path = tmp_path / "log.csv"
    pd.DataFrame({"time": HOURS, "a": values}).to_csv(path, index=False)
    recording = Recording.read(path)
    assert remark in "".join(recording.remarks)
    assert ("far from" in "".join(recording.remarks)) == bool(remark)
    if remark:
        code = float(remark.split()[-1])
        without = Recording.read(path, error_codes=[code])
        assert without.values["a"].min() > code
        assert "far from" not in "".join(without.remarks)


def test_units_are_read_from_round_brackets_and_given(tmp_path: Path) -> None:
    heads = ["a (°C)", "b [℃]", "c (hall)", "d (% RH)", "e", "f [Pa]"]
    frame = pd.DataFrame(dict.fromkeys(heads, VALUES), HOURS) * [1, 2, 3, 4, 5, 6]
    frame.to_csv(tmp_path / "log.csv", index_label="time")
    recording = Recording.read(tmp_path / "log.csv", units={"e": "°F"})
    units = {channel.name: channel.unit for channel in recording.channels}
    assert units == {"a": "°C", "b": "°C", "c (hall)": "", "d": "%", "e": "°F", "f": "Pa"}
    refused(
        lambda: Recording.read(tmp_path / "log.csv", units={"g": "m"}), "unit = 'g'", "one of a"
    )
    for unit, change in (("°C", 1.0), ("°F", 1.8), ("Pa", 10_000.0), ("hPa", 100.0)):
        assert fields_of("zigbee", unit, change, 60.0, 600.0)["reportable_change"] == 100


def parquet() -> bytes:
    return b"PAR1" + bytes(100) + b"PAR1"


def workbook() -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as book:
        book.writestr("xl/workbook.xml", "<workbook/>")
    return file.getvalue()


REFUSED = {
    "a workbook": (workbook(), "save the sheet as CSV"),
    "Parquet": (parquet(), "pandas.read_parquet"),
    "twelve hours": (table("%Y-%m-%d %I:%M"), "goes from 1 to 12"),
    "a zone": (table("%d/%m/%Y %H:%M CET"), "the zone 'CET'"),
    "an unnamed column of devices": (
        pd.DataFrame(TWO, columns=["time", "who", "air", "damp"]).to_csv(index=False).encode(),
        "its rows at one time differ in 'who'",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_strange_log_is_refused_by_name(name: str, tmp_path: Path) -> None:
    content, message = REFUSED[name]
    (tmp_path / "log.csv").write_bytes(content)
    refused(lambda: Recording.read(tmp_path / "log.csv"), "is not allowed", message)


@pytest.mark.slow
def test_a_drawn_strange_log_is_read_right_or_refused(tmp_path: Path) -> None:
    verdicts = []
    for seed in range(100):
        drawn = draw_strange_log(seed)
        (tmp_path / "log.csv").write_bytes(drawn.content)
        try:
            verdict = drawn.verdict(Recording.read(tmp_path / "log.csv"))
            verdicts.append("right" if verdict == "" else f"wrong {seed}: {verdict}")
        except ConfigurationError as error:
            right = drawn.refusal is not None and drawn.refusal in str(error)
            verdicts.append("rightly refused" if right else f"refused {seed}: {error}")
    wrong = [verdict for verdict in verdicts if verdict.startswith("wrong")]
    assert wrong == []
    assert verdicts.count("right") >= 72, verdicts
    assert verdicts.count("right") + verdicts.count("rightly refused") >= 95, verdicts
