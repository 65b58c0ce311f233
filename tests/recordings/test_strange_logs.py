"""Logs as weather services, loggers and spreadsheets write them: read right, or refused."""

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

ROWS = 400
TIMES = pd.date_range("2024-03-01", periods=ROWS, freq="h")
A, B = np.arange(ROWS) % 7 + 0.5, np.arange(ROWS) % 5 + 40.25
CODES = np.where(np.arange(ROWS) % 3, -999.0, A)
TRUTH = {"a": A, "b": B}


def rows(*cells: object, sep: str = ";") -> str:
    """Lines with a cell of each of these columns, or one cell for all rows."""
    columns = [[c] * ROWS if isinstance(c, str) else list(c) for c in cells]  # type: ignore
    return "".join(sep.join(map(str, row)) + "\n" for row in zip(*columns, strict=True))


def log(form: str = "%Y-%m-%d %H:%M", sep: str = ";", head: str = "time") -> str:
    return f"{head}{sep}a{sep}b\n" + rows(TIMES.strftime(form), A, B, sep=sep)


def read(text: str | bytes, folder: Path, **options: str) -> Recording:
    path = folder / "log.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return Recording.read(path, **options)  # type: ignore[arg-type]


def check(recording: Recording, truth: dict[str, np.ndarray], start: str = "2024-03-01") -> None:
    values = recording.values
    assert list(values) == list(truth)
    assert (values.index == pd.date_range(start, periods=len(values), freq="h")).all()
    for name, own in truth.items():
        assert np.array_equal(values[name], own, equal_nan=True), name


def hours(clock: Callable[[pd.Timestamp], object], head: str, form: str = "%Y%m%d") -> str:
    """A log of dates and clocks; an hour belongs to the day before where its clock is 24."""
    days = [time - pd.Timedelta(int(str(clock(time))[:2] == "24"), "h") for time in TIMES]
    return f"date;{head};a\n" + rows([d.strftime(form) for d in days], map(clock, TIMES), A)


FILES: dict[str, str | bytes] = {
    "UTF-16": log().encode("utf-16"),
    "UTF-16, high byte first": b"\xfe\xff" + log().encode("utf-16-be"),
    "bars": log(sep="|"),
    "runs of spaces": log("%Y-%m-%dT%H:%M", sep="   "),
    "a named separator": "sep=;\r\n" + log(),
    "a sum below": log() + "Total;12\n",
    "a comment below": log() + "# end\n",
    "more cells below": log() + "\nMean;1;2;3;4\nSum;1;2;3;4\n",
    "units under the heads": log().replace("\n", "\nyyyy-mm-dd;°C;%\n", 1),
    **{f"times as {form}": log(form) for form in (
        "%Y%m%d%H", "%Y%m%d%H%M", "%Y%m%d%H%M%S", "%Y%m%dT%H%M%SZ", "%a %d/%m/%Y %H:%M",
        "%a, %m/%d/%Y %H:%M", "%d/%m/%Y %H:%M GMT", "%d/%m/%Y %H:%M UTC", "%d.%m.%Y %I:%M %p UTC",
        "%A, %d %B %Y %H:%M", "%a %b %d %H:%M:%S %Y", "%d/%m/%Y %H:%M+00:00",
    )},
}  # fmt: skip
CLOCKS = {
    "HrMn": hours(lambda t: t.strftime("%H%M"), "HrMn"),
    "HrMn without zeros": hours(lambda t: int(t.strftime("%H%M")), "HrMn"),
    "hours": hours(lambda t: t.hour, "hour", "%d/%m/%Y"),
    "hours to 24": hours(lambda t: t.hour or 24, "Hour", "%d.%m.%Y"),
    "a clock to 24:00": hours(lambda t: f"{t.hour or 24:02}:00", "time", "%m/%d/%Y"),
    "24:00 in a cell": hours(lambda t: f"{t.hour or 24:02}:00", "x", "%d/%m/%Y")
    .replace("date;x", "date").replace("4;", "4 ", ROWS),
    "year, month, day and hour": "year;month;day;hour;a\n"
    + rows(TIMES.year, TIMES.month, TIMES.day, TIMES.hour, A),
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_a_file_of_another_form_is_read(name: str, tmp_path: Path) -> None:
    recording = read(FILES[name], tmp_path)
    check(recording, TRUTH)
    units = ["°C", "%"] if name.startswith("units") else ["", ""]
    assert [channel.unit for channel in recording.channels] == units


@pytest.mark.parametrize("name", CLOCKS)
def test_dates_and_hours_are_joined(name: str, tmp_path: Path) -> None:
    check(read(CLOCKS[name], tmp_path), {"a": A})


def test_a_height_beside_a_date_is_no_hour(tmp_path: Path) -> None:
    days = pd.date_range("2024-03-01", periods=ROWS).strftime("%Y-%m-%d")
    recording = read("date;h;a\n" + rows(days, np.arange(ROWS) % 5, A), tmp_path)
    assert list(recording.values) == ["h", "a"]
    assert recording.interval == pd.Timedelta("1D")


def test_a_format_reads_the_cells_of_date_and_clock_as_they_are(tmp_path: Path) -> None:
    text = log("%Y%m%d;%H:%M", head="date;time")
    check(read(text, tmp_path, date_format="%Y%m%d %H:%M"), TRUTH)


@pytest.mark.parametrize("form", ["%Y%m%d%H", "%Y%m%d%H%M", "%Y%m%d%H%M%S"])
def test_a_file_of_the_german_weather_service_is_read(form: str, tmp_path: Path) -> None:
    """With its code in most rows, too."""
    cells = [f"{x:6.1f}".replace("-999.0", "  -999") for x in CODES]
    humid = [f"{x:7.2f}" for x in B]
    body = rows("         44", TIMES.strftime(form), "   10", cells, humid, "eor")
    recording = read("STATIONS_ID;MESS_DATUM;QN_9;TT_TU;RF_TU;eor\n" + body, tmp_path)
    truth = {"TT_TU": np.where(CODES == -999.0, np.nan, A), "RF_TU": B}
    check(recording, {"STATIONS_ID": np.full(ROWS, 44.0), "QN_9": np.full(ROWS, 10.0), **truth})


def test_an_offset_is_a_zone(tmp_path: Path) -> None:
    for end in ("+0100", " GMT+1", " UTC+01:00"):
        check(read(log(f"%d/%m/%Y %H:%M{end}"), tmp_path), TRUTH, "2024-02-29 23:00")


def mixed(cells: list[str]) -> str:
    return "time;a\n" + rows(TIMES.strftime("%Y-%m-%d %H:%M"), cells * (ROWS // len(cells)))


REFUSED: dict[str, tuple[str | bytes, str]] = {
    "a workbook": (b"PK\x03\x04" + bytes(99), "an Excel workbook or an archive: save the sheet"),
    "Parquet": (b"PAR1" + bytes(99), "pandas.read_parquet(path).to_csv(...)"),
    **{f"the zone {zone}": (log(f"%d/%m/%Y %H:%M {zone}"), f"the zone {zone.upper()!r}; write UTC")
       for zone in ("CET", "PDT", "Europe/Berlin")},
    "a zone behind a month": (log("%d-%b-%Y %H:%M EST"), "the zone 'EST'; write"),
    "half a day": (log("%Y-%m-%d %I:%M"), "its clock has 12 hours without AM and PM"),
    "half a day apart": (log("%d.%m.%Y;%I:%M:%S", head="date;time"), "without AM and PM"),
    "a clock of an unknown name": (hours(lambda t: t.hour, "x"), "dates without a clock"),
    "a prefix in some cells": (mixed(["950", "1.02kW"]), "units ['kW', 'none']"),
    "thousandths in some cells": (mixed(["1.5", "950m"]), "units ['m', 'none']"),
    "an unknown weekday": (log("Xyz %d/%m/%Y %H:%M"), "0 of its 400 rows begin with a time"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_may_be_read_wrongly_is_refused(name: str, tmp_path: Path) -> None:
    table, message = REFUSED[name]
    assert refused(lambda: read(table, tmp_path), message).startswith("log = ")


@pytest.mark.parametrize(
    ("head", "zero", "factor", "unit"),
    [("unix", 1709251200, 3600, ""), ("elapsed [min]", 0, 60, ""), ("t [h]", 0, 1, ""),
     ("t", 0, 3600, "s")],
)  # fmt: skip
def test_numeric_times_in_any_order_are_read(
    head: str, zero: int, factor: int, unit: str, tmp_path: Path
) -> None:
    order = np.random.default_rng(0).permutation(ROWS)
    text = f"{head};a\n" + rows((zero + factor * np.arange(ROWS))[order], A[order])
    start = "2024-03-01" if zero else "1970-01-01"
    check(read(text, tmp_path, **({"time_unit": unit} if unit else {})), {"a": A}, start)


def test_suffixes_are_factors(tmp_path: Path) -> None:
    cells, values = ["950", "1.02k", "1.001k", "2M", "0.5G"], [950.0, 1020.0, 1001.0, 2e6, 5e8]
    check(read(mixed(cells), tmp_path), {"a": np.tile(values, ROWS // 5)})


STAMPS = TIMES.strftime("%Y-%m-%d %H:%M:%S")
LATE = (TIMES + pd.Timedelta("20min")).strftime("%Y-%m-%d %H:%M:%S")
ONE, TWO = (STAMPS, A, B), (LATE, A + 1.0, B + 1.0)
CLEAR = {"room", "location", "device", "id", "mac", "station", "sensor_id", "Node", "Raum"}


def devices(head: str, *lines: str) -> str:
    """The rows of devices in the order of time."""
    both = sorted("".join(lines).splitlines(), key=lambda line: line.split(";")[0])
    return "\n".join([head, *both, ""])


def both(first: str, second: str, single: bool = False) -> dict[str, np.ndarray]:
    parts = {"a": (A, A + 1.0), "b": (B, B + 1.0)}
    return {f"{name} {own}": values for name, pair in parts.items() if not (single and name == "b")
            for own, values in zip((first, second), pair, strict=True)}  # fmt: skip


TABLES: dict[str, tuple[str, dict[str, np.ndarray]]] = {
    **{f"{head}, {'at other times' if late else 'at the same times'}": (
        devices(f"time;{head};a;b", rows(STAMPS, names[0], A, B),
                rows(LATE if late else STAMPS, names[1], A + 1.0, B + 1.0)), both(*names))
       for head in sorted(CLEAR) for late in (False, True)
       for names in [("12", "7") if head in ("id", "sensor_id") else ("x", "y")]},
    "one value": (devices("time;room;a", rows(STAMPS, "x", A), rows(STAMPS, "y", A + 1.0)),
                  both("x", "y", single=True)),
    "two name columns": (
        devices("time;room;sensor;value", *(rows(STAMPS, room, own, values) for room, own, values in
                (("x", "t", A), ("x", "h", B), ("y", "t", A + 1.0), ("y", "h", B + 1.0)))),
        {"x t": A, "x h": B, "y t": A + 1.0, "y h": B + 1.0}),
    "rtl_433": (
        devices("time;model;id;channel;a;b", rows(STAMPS, "Tower", "12", "A", A, B),
                rows(LATE, "Tower", "7", "", A + 1.0, B + 1.0)), both("12", "7")),
    "rtl_433, two models": (
        devices("time;model;id;a;b", rows(STAMPS, "Tower", "12", A, B),
                rows(LATE, "TX", "12", A + 1.0, B + 1.0)), both("Tower", "TX")),
    "luftdaten": (
        devices("timestamp;sensor_id;sensor_type;location;a;b", rows(STAMPS, "12", "B", "5", A, B),
                rows(LATE, "7", "B", "6", A + 1.0, B + 1.0)), both("12", "7")),
    "InfluxDB": (
        "#group;false;false;true;true;false;false;true;true\n"
        ";result;table;_start;_stop;_time;_value;_field;tag2\n"
        + "".join(rows("", "", str(place), "2024-01-01T00:00:00Z", "2025-01-01T00:00:00Z",
                       [f"{stamp.replace(' ', 'T')}Z" for stamp in STAMPS], values, "a", tag)
                  for place, (tag, values) in enumerate((("x", A), ("y", A + 1.0)))),
        {"x": A, "y": A + 1.0}),
    "a constant id": (devices("time;id;a", rows(STAMPS, "12", A)),
                      {"id": np.full(ROWS, 12.0), "a": A}),
    "a status": (devices("time;a;status", rows(STAMPS, A, np.resize(["ok", "warm", "late"], ROWS))),
                 {"a": A}),
}  # fmt: skip


@pytest.mark.parametrize("name", TABLES)
def test_each_device_of_a_table_has_its_channels(name: str, tmp_path: Path) -> None:
    text, truth = TABLES[name]
    recording = read(text, tmp_path)
    assert recording.interval == pd.Timedelta("1h")
    check(recording, truth)


@pytest.mark.slow
def test_a_strange_log_is_read_right_or_refused(tmp_path: Path) -> None:
    """A refusal is right where the clock says no half of the day, or one day no order."""
    right, refusals = 0, 0
    for seed in range(100):
        drawn = draw_strange_log(seed)
        try:
            recording = read(drawn.raw, tmp_path)
        except ConfigurationError as error:
            refusals += any(part in str(error) for part in drawn.reasons)
        else:
            assert not drawn.unreadable, seed
            assert drawn.verdict(recording) == "", seed
            right += 1
    assert right >= 72
    assert right + refusals >= 95


DAYS = 96  # hours
WALK = np.round(20.0 + np.cumsum(np.random.default_rng(0).normal(size=DAYS)), 1)
TURN = np.sin(np.arange(DAYS) / 4.0)
FAR = {
    "two runs of zeros": (
        np.where(np.arange(DAYS) % 40 < 15, 0.0, WALK + 20.0),
        "45 readings of 0",
    ),
    "a code twice": (np.where(np.arange(DAYS) % 50 == 7, -55.0, WALK), "2 readings of -55"),
    "the sun at night": (np.round(np.maximum(TURN, 0.0) * 900.0), ""),
    "rain": (np.where(np.arange(DAYS) % 7, 0.0, np.round(2.0 * TURN**2, 1)), ""),
    "a contact": (np.arange(DAYS) // 9 % 2 * 1.0, ""),
}


@pytest.mark.parametrize("name", FAR)
def test_repeated_values_far_from_all_others_are_named(name: str, tmp_path: Path) -> None:
    values, remark = FAR[name]
    path = tmp_path / "log.csv"
    pd.DataFrame({"time": TIMES[:DAYS], "a": values}).to_csv(path, index=False)
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
    frame = pd.DataFrame(dict.fromkeys(heads, WALK), TIMES[:DAYS]) * [1, 2, 3, 4, 5, 6]
    frame.to_csv(tmp_path / "log.csv", index_label="time")
    recording = Recording.read(tmp_path / "log.csv", units={"e": "°F"})
    units = {channel.name: channel.unit for channel in recording.channels}
    assert units == {"a": "°C", "b": "°C", "c (hall)": "", "d": "%", "e": "°F", "f": "Pa"}
    refused(
        lambda: Recording.read(tmp_path / "log.csv", units={"g": "m"}), "unit = 'g'", "one of a"
    )
    for unit, change in (("°C", 1.0), ("°F", 1.8), ("Pa", 10_000.0), ("hPa", 100.0)):
        assert fields_of("zigbee", unit, change, 60.0, 600.0)["reportable_change"] == 100
