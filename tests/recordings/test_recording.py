"""Logs of sensors: what a data card says, and what is refused."""

import gzip
import io
import lzma
import os
import tarfile
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from command_runs import refusal, succeed
from log_formats import draw_log
from refusals import refused

from fusion_gym.recordings import ChannelCard, RecordedChannel, Recording, fit
from fusion_gym.validation import ConfigurationError


def log(rows: int = 60, **columns: object) -> pd.DataFrame:
    """Three channels of noise, or other columns, every ten minutes."""
    draw = np.random.default_rng(0)
    times = pd.date_range("2026-03-01", periods=rows, freq="10min").astype(str)
    table = pd.DataFrame({"time": times, **{f"{c} [m]": draw.normal(size=rows) for c in "abc"}})
    return table.assign(**columns)


def read(table: pd.DataFrame | str | bytes, folder: Path, **options: object) -> Recording:
    path = folder / "log.csv"
    if isinstance(table, pd.DataFrame):
        table.to_csv(path, index=False, **options)
    else:
        path.write_bytes(table if isinstance(table, bytes) else table.encode())
    return Recording.read(path)


def walk(rows: int, seed: int = 0, factor: float = 0.9) -> np.ndarray:
    """A path of mean zero whose reading is ``factor`` times the one before, and a normal."""
    draw, path = np.random.default_rng(seed).normal(size=rows), np.zeros(rows)
    for row in range(1, rows):
        path[row] = factor * path[row - 1] + draw[row]
    return path


def clock(form: str, rows: int, every: str = "h", start: str = "2024-03-01") -> np.ndarray:
    return np.array(pd.date_range(start, periods=rows, freq=every).strftime(form))


def card(recording: Recording, name: str) -> ChannelCard:
    return next(row for row in recording.card if row.channel.name == name)


def with_cell(row: int, column: int, value: object, rows: int = 60) -> pd.DataFrame:
    table = log(rows).astype(object)
    table.iat[row, column] = value
    return table


def changed(values: Callable[[np.ndarray], np.ndarray], rows: int = 600) -> pd.DataFrame:
    """A log whose channel a is a function of its noise."""
    table = log(rows)
    return table.assign(**{"a [m]": values(table["a [m]"].to_numpy())})


def shuffled(table: pd.DataFrame) -> pd.DataFrame:
    return table.sample(frac=1.0, random_state=0)


TEXT = log().to_csv(index=False)
HEADS = ("b [m", "b 5..1", "b [m] .5..0.5", "b [m] ...", "b 1.2.3..4", "b [m] ..high")
TIMELESS = {
    "no column of times": log().drop(columns="time"),
    "times in words": log(time="yesterday"),
    "years beyond pandas": log(time=1e25),
    "a column that rises slowly": log(time=np.cumsum(np.random.default_rng(0).random(60)) / 10),
    "a channel of seconds": log().drop(columns="time").rename(columns={"a [m]": "period [s]"}),
}
REFUSED = {
    "an empty file": ("", "it must be a CSV file"),
    "a picture": (b"\x89PNG\r\n\x1a\n" + bytes(range(256)), "it must be a CSV file"),
    "rows of different lengths": (TEXT + "2026-03-02,1,2,3,4,5,6\n", "it must be a CSV file"),
    "heads without rows": (TEXT.splitlines()[0], "0 of its 0 rows begin with a time"),
    "one row": (log(1), "1 of its 1 rows begin with a time, and at least 20"),
    "nineteen rows": (log(19), "19 of its 19 rows begin with a time"),
    "no channel": (log()[["time"]], "its channels are []"),
    "half the times lost": (log(time=["2026-01-01", *["?"] * 59]), "1 of its 60 rows begin"),
    "one time for all": (log(time="2026-01-01 10:00"), "all its rows have the same time"),
    "a clock that jumps to 1970": (with_cell(0, 0, "1970-01-01 00:00:00"), "look for a wrong time"),
    "a clock that jumps to 2199": (with_cell(59, 0, "2199-01-01 00:00:00"), "look for a wrong"),
    "two channels of one name": (TEXT.replace("b [m]", "a [K]"), "channels are ['a', 'a', 'c']"),
    "no numbers": (log()[["time"]].assign(a=np.nan, b="on", c=1e200), "channel 'a' has no number"),
    **{
        f"the head {head}": (TEXT.replace("b [m]", head), f"the head {head!r} must be")
        for head in HEADS
    },
    **{name: (table, "0 of its 60 rows begin with a time") for name, table in TIMELESS.items()},
    "many columns": ("t" + ",x" * 300, "(301 columns: above 100,000,000 bytes or 100 channels"),
    "decimal commas without quotes": (
        "time,a,b\n" + "".join(f"{time},1,5,2,{n}\n" for n, time in enumerate(log()["time"])),
        "more cells than headers: quote decimal commas",
    ),
    "a line without an end": ("x" * 200_000, "field larger than field limit"),
    "numbers without a unit": (log(time=np.arange(60)), "numbers a unit in the head"),
    "a long log of many channels": (
        pd.concat([log(2)[["time"]].assign(name=name, value=1.0) for name in range(101)]),
        "has 101 channels and 0 readings at the time of another; export",
    ),
    "no heads": ("\n".join(TEXT.splitlines()[1:]), "its headers are numbers, such as"),
    "days of two orders": (log(time=clock("%d/%m/%Y %H:%M", 60, "10min", "2024-03-05")), "--date"),
    "a sign of two meanings": (log()[["time"]].assign(d="1,500"), "decimal or separates thousands"),
    "some decimal commas": (TEXT + "2026-03-02 00:00:00,1,5,2,3\n", "saw 5; quote decimal commas"),
    "two units in a column": (log(d=["1 V", "5 mV"] * 30), "has units ['V', 'mV']"),
    "readings of several places": (
        pd.DataFrame({"time": [*log()["time"]] * 4, "sensor": "a", "value": range(240)}),
        "180 readings at the time of another; export one place",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_log_that_is_none_is_refused_in_one_line(name: str, tmp_path: Path) -> None:
    table, message = REFUSED[name]
    assert refused(lambda: read(table, tmp_path), message).startswith("log = ")


def archive(kind: str) -> bytes:
    """A log in a zip or tar archive, or such an archive with damage."""
    stream = io.BytesIO()
    form, _, damage = kind.partition(" ")
    member = tarfile.TarInfo("log.csv")
    if form == "zip":
        with zipfile.ZipFile(stream, "w") as file:
            for name in ("a", "b") if damage == "twice" else ("a",):
                file.writestr(name, TEXT)
    else:
        with tarfile.open(fileobj=stream, mode="w") as file:
            member.size, member.type = len(TEXT), tarfile.REGTYPE
            if damage == "link":
                member.size, member.type, member.linkname = 0, tarfile.LNKTYPE, "other"
            file.addfile(member, io.BytesIO(TEXT.encode()))
    raw = bytearray(stream.getvalue())
    if damage == "encrypted":
        raw[6] |= 1
        raw[raw.find(b"PK\x01\x02") + 8] |= 1
    if damage == "changed":
        raw[100] ^= 255
    return bytes(raw[: len(raw) // 4 if damage == "cut" else None])


PACKED = {
    **{f"{form}{' ' * bool(damage)}{damage}": (form, archive(f"{form} {damage}"))
       for form, damages in (("zip", ("", "cut", "changed", "encrypted", "twice")),
                             ("tar", ("", "cut", "changed", "link")))
       for damage in damages},
    "gz": ("gz", gzip.compress(TEXT.encode())),
    "gz cut": ("gz", gzip.compress(TEXT.encode())[:500]),
    "gz no archive": ("gz", TEXT.encode()),
    "gz nested": ("gz", gzip.compress(gzip.compress(TEXT.encode()))),
    "gz of zeros": ("gz", gzip.compress(bytes(200_000))),
    "xz cut": ("xz", lzma.compress(TEXT.encode())[:500]),
    "zst no archive": ("zst", b"\x28\xb5\x2f\xfd" + bytes(50)),
}  # fmt: skip


@pytest.mark.parametrize("name", PACKED)
def test_a_packed_log_is_read_and_a_damaged_one_refused(name: str, tmp_path: Path) -> None:
    end, content = PACKED[name]
    path = tmp_path / f"log.csv.{end}"
    path.write_bytes(content)
    if name == end:
        assert Recording.read(path).values.equals(read(TEXT, tmp_path).values)
        return
    with pytest.raises(ConfigurationError, match=r"^log = .*it must be a CSV file \(.+\)$"):
        Recording.read(path)


def test_a_log_is_a_regular_file_of_limited_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    os.mkfifo(tmp_path / "pipe.csv")
    for path in (tmp_path / "pipe.csv", tmp_path, Path(os.devnull)):
        assert "it is no regular file" in refusal("fit", [str(path)])
    assert "it is no regular file" in refusal("info", [str(tmp_path / "pipe.csv")])
    monkeypatch.setattr("fusion_gym.recordings.reading.LONGEST_TEXT", len(TEXT) - 1)
    with pytest.raises(ConfigurationError, match=f"above {len(TEXT) - 1:,} bytes"):
        read(TEXT, tmp_path)


def test_a_log_without_a_plant_makes_no_file(tmp_path: Path) -> None:
    read(changed(lambda a: np.where(np.arange(600) < 599, 3.0, 4.0)), tmp_path)
    words = ["--share=0.9", "--output", str(tmp_path / "made.yaml"), "--channels", "a", "b"]
    assert "change in the fitted part" in refusal("fit", [str(tmp_path / "log.csv"), *words])
    assert not (tmp_path / "made.yaml").exists()
    assert "channels = () is not allowed" in refusal("fit", ["tanks", "--channels"])


def test_a_head_without_a_unit_has_limits(tmp_path: Path) -> None:
    recording = read(TEXT.replace("a [m]", "a b -.5..2").replace("b [m]", "b ..3"), tmp_path)
    low, high = RecordedChannel("a b", low=-0.5, high=2.0), RecordedChannel("b", high=3.0)
    assert recording.channels[:2] == (low, high)


BACK = [*log()["time"][:30], *log()["time"][24:54]]
REMARKED = {
    "unsorted": (shuffled(log()), "times before the row above: sorted"),
    "a clock set back": (log(time=BACK), "6 rows at the time of another"),
    "times of two precisions": (with_cell(3, 0, "2026-03-01 00:31"), "1 times between"),
    "rows twice": (pd.concat([log(), log()]), "60 rows at the time of another"),
    "rows beside the even times": (with_cell(7, 0, "2026-03-01 01:14:00"), "1 times between"),
    **{f"{text} in a cell": (with_cell(3, 1, text), "1 cells without a finite number")
       for text in ("off", "ERR", "inf")},
    **{f"a column of {d}": (log(d=d), "column 'd' has no numbers: left out")
       for d in ("on", np.nan, 1e200, np.inf)},
    "a row without a time": (with_cell(3, 0, ""), "1 rows without a time: left out"),
    "a row with a broken time": (with_cell(3, 0, "2026-13-45"), "1 rows without a time"),
}  # fmt: skip


@pytest.mark.parametrize("name", REMARKED)
def test_what_is_changed_is_said(name: str, tmp_path: Path) -> None:
    table, remark = REMARKED[name]
    recording = read(table, tmp_path)
    assert any(remark in line for line in recording.remarks), recording.remarks
    assert recording.values.index.is_monotonic_increasing
    assert recording.interval == pd.Timedelta("10min")


CARDS: dict[str, tuple[pd.DataFrame, Callable[[ChannelCard], bool]]] = {
    "constant": (changed(lambda a: 0 * a), lambda c: c.fault == "constant"),
    "stuck": (
        changed(lambda a: np.where(np.arange(600) > 200, 1.0, a)), lambda c: c.fault == "stuck"
    ),
    "saturated": (
        changed(lambda a: np.minimum(a, 1.0)),
        lambda c: c.channel.high == 1.0 and 0.1 < c.saturated < 0.2,
    ),
    "coarse": (changed(lambda a: np.round(a * 2) / 2), lambda c: c.resolution == 0.5),
    "spikes": (
        changed(lambda a: a + 100.0 * (np.arange(600) % 200 == 100)),
        lambda c: c.spikes == 3 and not c.fault,
    ),
    "scattered gaps": (
        changed(lambda a: np.where(np.arange(600) % 10 > 0, a, np.nan)),
        lambda c: c.missing == pytest.approx(0.1) and c.every == 1,
    ),
    "another rate": (
        changed(lambda a: np.where(np.arange(600) % 5 == 0, a, np.nan)), lambda c: c.every == 5
    ),
    "sound": (changed(lambda a: a), lambda c: not c.fault and not c.spikes and not c.saturated),
}  # fmt: skip


@pytest.mark.parametrize("name", CARDS)
def test_the_card_says_what_a_channel_does(name: str, tmp_path: Path) -> None:
    table, is_said = CARDS[name]
    recording = read(table, tmp_path)
    assert is_said(card(recording, "a")), card(recording, "a")
    assert not card(recording, "b").fault


@pytest.mark.parametrize(("rows", "ties"), [(6000, 60), (200, 20)])
@pytest.mark.parametrize("end", ["low", "high"])
def test_a_limit_is_an_extreme_that_a_percent_of_the_readings_have(
    rows: int, ties: int, end: str
) -> None:
    """At least 20, of ten values or more, unless each value is as frequent."""
    sign, row = 1.0 if end == "high" else -1.0, np.arange(rows)
    values = np.random.default_rng(0).random((rows, 5))
    values[: ties - 1, 0] = values[:ties, 1] = 1.0
    values[:, 2] = np.floor(11.0 * values[:, 2])
    for place, others in ((3, 8), (4, 9)):
        values[:, place] = np.where(row % 10 > 0, 1.0, row // 10 % others / 10)
    index = pd.date_range("2026-01-01", periods=rows, freq="1min")
    table = pd.DataFrame(sign * values, index=index, columns=list("abcde"))
    cards = Recording(table, tuple(map(RecordedChannel, "abcde"))).card
    limits = [getattr(card.channel, end) * sign for card in cards]
    assert limits == [np.inf, 1.0, np.inf, np.inf, 1.0]
    assert cards[1].saturated == pytest.approx(ties / rows)


def test_the_figures_of_a_card_are_those_of_its_readings() -> None:
    values = 20.0 + 3.0 * np.random.default_rng(0).normal(size=900)
    values[::3] = np.nan
    index = pd.date_range("2026-01-01", periods=900, freq="1min")
    table = pd.DataFrame({"a": values, "b": 1.0}, index=index)
    channels = RecordedChannel("a", "K"), RecordedChannel("b", "K")
    (figures, constant), present = Recording(table, channels).card, values[np.isfinite(values)]
    assert (figures.readings, figures.channel.unit, figures.every) == (600, "K", 1.0)
    assert figures.missing == pytest.approx(1.0 / 3.0)
    assert figures.mean == pytest.approx(present.mean())
    assert figures.deviation == pytest.approx(present.std())
    assert figures.resolution == pytest.approx(np.diff(np.sort(present)).min())
    assert np.isnan(figures.agreement)
    assert (figures.saturated, figures.stuck, figures.spikes) == (0.0, 0.0, 0)
    assert (constant.resolution, constant.saturated, constant.missing) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("noise", [0.05, 3.0])
def test_a_channel_that_disagrees_with_agreeing_peers_is_faulty(
    noise: float, tmp_path: Path
) -> None:
    draw = np.random.default_rng(1)
    common = draw.normal(size=(600, 1)).cumsum(0)
    table = log(600)
    table.iloc[:, 1:] = common + 0.1 * draw.normal(size=(600, 3))
    table["d [m]"] = np.where(draw.random(600) < 0.3 * noise, 0.0, common[:, 0])
    faults = {row.channel.name: row.fault for row in read(table, tmp_path).card}
    assert faults.pop("d") == ("disagrees with its peers" if noise > 1.0 else "")
    assert not any(faults.values())


LOGGERS: dict[str, str | bytes] = {
    "a byte order mark": b"\xef\xbb\xbf" + TEXT.encode(),
    "lines of Windows": TEXT.replace("\n", "\r\n"),
    "time zones": TEXT.replace(":00,", ":00+00:00,"),
    "row numbers": log().to_csv(quoting=2),
    "lines above": "Station: x\nSerial: 7\n" + TEXT,
    "Home Assistant": log().melt("time", var_name="entity_id", value_name="state")[
        ["entity_id", "state", "time"]].rename(
            columns={"time": "last_changed"}).to_csv(index=False),
    "other heads": log().melt("time", var_name="Ort", value_name="Wert").to_csv(index=False),
    "InfluxDB": "#datatype,string,long,dateTime,double,string\n,result,table,_time,_value,_field\n"
    + "".join(f",,0,{time.replace(' ', 'T')}Z,{value!r},{name}\n"
              for time, name, value in log().melt("time").itertuples(index=False)),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", LOGGERS)
def test_loggers_write_the_same_log(name: str, tmp_path: Path) -> None:
    expected, recording = read(TEXT, tmp_path), read(LOGGERS[name], tmp_path)
    assert np.array_equal(recording.values, expected.values)
    assert recording.values.index.equals(expected.values.index)
    assert recording.channels == expected.channels


@pytest.mark.slow
def test_a_drawn_format_is_read_right_or_refused(tmp_path: Path) -> None:
    """Dates of one day, whose order no row shows, are refused."""
    right = 0
    for seed in range(100):
        drawn = draw_log(seed)
        try:
            assert drawn.verdict(read(drawn.text, tmp_path)) == "", seed
            right += 1
        except ConfigurationError:
            assert len(drawn.truth.index.normalize().unique()) == 1
    assert right >= 80


DATES = {
    "twelve days": ("%d/%m/%Y %H:%M", 288, "h", "2024-03-01", "read day first"),
    "forty days": ("%d.%m.%Y %H:%M", 960, "h", "2024-03-01", "read day first"),
    "two days": ("%d/%m/%Y %H:%M", 95, "10min", "2016-01-09 15:30", "read day first"),
    "American": ("%m/%d/%Y %I:%M %p", 288, "h", "2024-03-01", "read month first"),
    "two digits of the year": ("%d.%m.%y %H:%M", 960, "h", "2024-03-01", "read day first"),
    "names of months": ("%b %d, %Y %H:%M", 100, "h", "2024-03-01", ""),
}


@pytest.mark.parametrize("name", DATES)
def test_all_rows_decide_the_order_of_a_date(name: str, tmp_path: Path) -> None:
    form, rows, every, start, remark = DATES[name]
    table = pd.DataFrame({"time": clock(form, rows, every, start), "a": walk(rows)})
    recording = read(table, tmp_path)
    expected = pd.date_range(start, periods=rows, freq=every)
    assert (recording.values.index == expected).all()
    assert np.array_equal(recording.values["a"], walk(rows))
    assert remark in "".join(recording.remarks)
    assert len(recording.remarks) == bool(remark)


@pytest.mark.parametrize(
    ("head", "factor", "unit", "seconds"),
    [("elapsed [min]", 5.0, None, 300), ("time (h)", 0.5, None, 1800),
     ("time_ms", 40.0, None, 0.04),
     ("t", 5.0, "s", 5), ("days", 1 / 24, "excel", 3600), ("Unix time", 10.0, None, 10),
     ("time", 30.0, None, 30)],
)  # fmt: skip
def test_numeric_times_have_a_unit(
    head: str, factor: float, unit: str | None, seconds: float, tmp_path: Path
) -> None:
    zero = 1.7e9 if head in ("Unix time", "time") else 45352.0 if unit == "excel" else 0.0
    path, table = tmp_path / "log.csv", {head: zero + factor * np.arange(100), "a": walk(100)}
    pd.DataFrame(table).to_csv(path, index=False)
    recording = Recording.read(path, time_unit=unit)
    assert recording.interval == pd.Timedelta(seconds, "s")
    assert len(recording.values) == 100
    first = {"excel": "2024-03-01 00:00:00", None: "2023-11-14 22:13:20"}.get(unit if zero else "")
    assert first is None or str(recording.values.index[0]) == first


@pytest.mark.parametrize("late", [0.0, 0.04, 2.0, 5.0])
@pytest.mark.parametrize("jitter", [0.0, 1e-5, 0.2])
def test_sensors_apart_read_at_the_same_steps(late: float, jitter: float, tmp_path: Path) -> None:
    draw, even = np.random.default_rng(0), np.arange(600.0) * 10.0
    parts = [pd.DataFrame({"unix time": 1.7e9 + even + lag + jitter * draw.random(600),
                           name: walk(600, seed)})
             for name, lag, seed in (("a", 0.0, 1), ("b", late, 2))]  # fmt: skip
    recording = read(pd.concat(parts), tmp_path)
    assert recording.interval == pd.Timedelta("10s")
    for name, seed in (("a", 1), ("b", 2)):
        assert np.array_equal(recording.values[name].dropna(), walk(600, seed))
    assert len(recording.values) <= 601
    assert any(": moved by -" in line for line in recording.remarks) == (late > 0.0)


def test_merged_readings_are_counted(tmp_path: Path) -> None:
    table = log(100)
    extra = table.iloc[[50]].assign(time="2026-03-01 08:21:00")
    recording = read(pd.concat([table, extra]), tmp_path)
    assert "3 readings in the step of another: the first counts" in recording.remarks
    assert np.array_equal(recording.values, table.iloc[:, 1:])


NUMBERS: dict[str, Callable[[float], str]] = {
    "thousands": lambda x: f"{x:,.0f}",
    "thousands and decimals": lambda x: f"{x:,.1f}",
    "German": lambda x: f"{x:,.1f}".translate(str.maketrans(",.", ".,")),
    "spaces": lambda x: f"{x:,.1f}".replace(",", " "),
    "Swiss": lambda x: f"{x:,.1f}".replace(",", "'"),
    "decimal commas": lambda x: f"{x:.1f}".replace(".", ","),
    "unit": lambda x: f"{x:,.1f} °C",
    "percent": lambda x: f"{x:.1f}%",
}


@pytest.mark.parametrize("name", NUMBERS)
def test_a_column_has_one_way_to_write_numbers(name: str, tmp_path: Path) -> None:
    values = np.round(1000.0 + 3.0 * walk(200), 0 if name == "thousands" else 1)
    time = clock("%Y-%m-%d %H:%M", 200)
    recording = read(pd.DataFrame({"time": time, "a": map(NUMBERS[name], values)}), tmp_path)
    assert np.array_equal(recording.values["a"], values)
    assert recording.channels[0].unit == {"unit": "°C", "percent": "%"}.get(name, "")


@pytest.mark.parametrize("code", [-127.0, 85.0, -999.0, -9999.0, 300.0])
def test_an_error_code_is_no_reading(code: float, tmp_path: Path) -> None:
    values = np.round(20.0 + walk(4000), 2)
    hit = np.random.default_rng(1).permutation(4000)[:20]
    wrong = values.copy()
    wrong[hit] = code
    recording = read(pd.DataFrame({"time": clock("%Y-%m-%d %H:%M", 4000), "a": wrong}), tmp_path)
    assert np.array_equal(np.flatnonzero(recording.values["a"].isna()), np.sort(hit))
    assert recording.remarks == (f"a: 20 readings of {code:g} are an error code: no reading",)


def test_a_limit_is_no_error_code_and_a_given_code_is(tmp_path: Path) -> None:
    values = np.round(np.minimum(20.0 + 5.0 * walk(4000), 35.0), 2)
    values[7] = -1.25
    read(pd.DataFrame({"time": clock("%Y-%m-%d %H:%M", 4000), "a": values}), tmp_path)
    recording = Recording.read(tmp_path / "log.csv", error_codes=[-1.25, 77.0])
    hit = "a: 1 readings of -1.25 are an error code: no reading"
    assert recording.remarks == (hit, "no reading is the error code 77")
    assert (recording.values["a"] == 35.0).sum() > 100


FAULTS: dict[str, tuple[Callable[[np.ndarray], np.ndarray], str]] = {
    "direction": (lambda a: (355.0 + 20.0 * a) % 360.0, "wraps around"),
    "record number": (lambda a: 7.0 + np.arange(len(a)), "counts"),
    "energy": (lambda a: np.cumsum(np.abs(a)), "counts"),
    "copy": (lambda a: walk(600, 1), "repeats b"),
    "other unit": (lambda a: 1.8 * walk(600, 1) + 32.0, "repeats b"),
    "sum": (lambda a: walk(600, 1) + walk(600, 2), "a sum of b, c"),
    "late": (lambda a: a * (np.arange(len(a)) >= 300), "constant in the fitted part"),
    "sound": (lambda a: a, ""),
    "switch": (lambda a: 100.0 * (a > 1.0), ""),
}  # fmt: skip


@pytest.mark.parametrize("name", FAULTS)
def test_a_faulty_channel_is_named_and_left_out(name: str) -> None:
    values, fault = FAULTS[name]
    columns = {"b": walk(600, 1), "c": walk(600, 2), "a": values(walk(600))}
    table = pd.DataFrame(columns, pd.date_range("2026-01-01", periods=600, freq="1min"))
    chosen = Recording(table, tuple(map(RecordedChannel, columns))).select(share=0.5)
    assert list(chosen.values) == ["b", "c"] + ["a"] * (not fault)
    assert [line for line in chosen.remarks if line.startswith("a: ") and "left out" in line] == (
        [f"a: {fault}, left out"] if fault else []
    )


def test_a_fit_repeats_the_warnings_of_the_card(tmp_path: Path) -> None:
    row = np.arange(2000)
    read(changed(lambda a: a + 100.0 * (row % 700 == 7), 2000).assign(d=1.0), tmp_path)
    words = [str(tmp_path / "log.csv"), "--exact", "--output", str(tmp_path / "plant.yaml")]
    lines = succeed("fit", words).err.splitlines()
    assert "warning: d: constant, left out" in lines
    assert "warning: a: 3 spikes" in lines


def on_change(factor: float, size: float, rows: int = 6000) -> Recording:
    """A path that is recorded where it is ``size`` away from the last reading."""
    path, last = walk(rows, 3, factor), np.inf
    for row, value in enumerate(path.copy()):
        path[row] = last = value if abs(value - last) >= size else last
    path[1:][np.diff(path) == 0.0] = np.nan
    index = pd.date_range("2026-01-01", periods=rows, freq="1min")
    return Recording(pd.DataFrame({"a": path}, index), (RecordedChannel("a"),))


@pytest.mark.parametrize("size", [0.5, 1.0])
def test_silence_of_a_log_on_change_is_no_missing_reading(size: float, tmp_path: Path) -> None:
    recording = on_change(0.63, size)
    recording.values.dropna().to_csv(tmp_path / "log.csv", index_label="time")
    recording = Recording.read(tmp_path / "log.csv")
    assert recording.interval == pd.Timedelta("1min")
    assert recording.card[0].change == pytest.approx(size, rel=0.1)
    refused(lambda: fit(recording.select()), "recorded on change", "--on-change")
    held = recording.select().hold()
    assert fit(held, order=1).transition.item() == pytest.approx(0.63, abs=0.05)
    assert "the last reading" in held.remarks[-1]
    printed = succeed("info", [str(tmp_path / "log.csv")]).out
    assert f"a: recorded on change by {recording.card[0].change:g}" in printed


@pytest.mark.parametrize("sizes", [(1.0, 1.0), (0.7, 1.4), (2.0, 4.0, 2.0), (1.5, 1.5, 1.5, 1.5)])
def test_rows_of_all_channels_where_one_changes_are_on_change(
    sizes: tuple[float, ...], tmp_path: Path
) -> None:
    """Rows at random times of the same channels are not."""
    path = np.transpose([walk(4000, seed, 0.8) for seed in range(len(sizes))])
    rows = [0]
    for row, values in enumerate(path):
        if (np.abs(values - path[rows[-1]]) >= sizes).any():
            rows.append(row)
    index = pd.date_range("2026-01-01", periods=4000, freq="1min", name="time")
    table = pd.DataFrame(path, index, [f"c{place}" for place in range(len(sizes))])
    table.iloc[rows].to_csv(tmp_path / "log.csv")
    recording = Recording.read(tmp_path / "log.csv")
    assert recording.interval == pd.Timedelta("1min")
    assert [row.change for row in recording.card] == pytest.approx(sizes, rel=0.4)
    refused(lambda: fit(recording.select()), "recorded on change", "--on-change")
    share = np.random.default_rng(0).random(4000) < min(len(rows) / 4000, 0.7)
    table[share].to_csv(tmp_path / "log.csv")
    assert not any(row.change for row in Recording.read(tmp_path / "log.csv").card)


def test_changes_as_large_as_the_deviation_are_refused() -> None:
    refused(on_change(0.8, 2.0).hold, "on_change = True", "hides the plant")


@pytest.mark.parametrize("digits", [1, 8])
def test_a_log_with_random_gaps_is_not_on_change(digits: int) -> None:
    path = np.where(np.random.default_rng(0).random(2000) < 0.3, np.nan, walk(2000).round(digits))
    index = pd.date_range("2026-01-01", periods=2000, freq="1min")
    recording = Recording(pd.DataFrame({"a": path}, index), (RecordedChannel("a"),))
    assert recording.card[0].change == 0.0


@pytest.mark.parametrize(("factor", "size"), [(0.9, 1.0), (0.9, 2.0), (0.97, 2.0)])
@pytest.mark.parametrize("jitter", [0, 3])
def test_long_silences_do_not_hide_a_log_on_change(
    factor: float, size: float, jitter: int, tmp_path: Path
) -> None:
    """Sizes in stationary deviations, and times of whole seconds late by at most ``jitter``."""
    size /= np.sqrt(1.0 - factor**2)
    rows = on_change(factor, size).values.dropna()
    late = np.random.default_rng(0).integers(0, jitter + 1, len(rows))
    rows.index += pd.to_timedelta(late, unit="s")
    rows.to_csv(tmp_path / "log.csv", index_label="time")
    recording = Recording.read(tmp_path / "log.csv")
    assert recording.interval == pytest.approx(pd.Timedelta("1min"), rel=1e-3) or jitter
    assert recording.values.count().sum() == len(rows)
    assert recording.card[0].change == pytest.approx(size, rel=0.1)
    refused(lambda: fit(recording.select()), "recorded on change", "--on-change")


@pytest.mark.parametrize("jitter", [0, 3])
@pytest.mark.parametrize("slow", [False, True])
def test_a_log_with_blocks_of_silence_is_not_on_change(
    slow: bool, jitter: int, tmp_path: Path
) -> None:
    """Nor is a quantised one that repeats its readings."""
    draw = np.random.default_rng(0)
    path = walk(3000, 0, 0.99).round(-1) if slow else walk(3000).round(1)
    silent = np.repeat(draw.random(300) < 0.3, 10) if not slow else draw.random(3000) < 0.3
    index = pd.date_range("2026-01-01", periods=3000, freq="1min", name="time")
    index += pd.to_timedelta(draw.integers(0, jitter + 1, 3000), unit="s")
    pd.DataFrame({"a": path}, index)[~silent].to_csv(tmp_path / "log.csv")
    recording = Recording.read(tmp_path / "log.csv")
    assert recording.card[0].change == 0.0
    fit(recording.select(), exact=True)


@pytest.mark.slow
def test_a_written_log_is_read_without_options(mast: Recording, tmp_path: Path) -> None:
    for recording in (Recording.read("tanks"), replace(mast, values=mast.values[:2000])):
        recording.write(tmp_path / "log.csv")
        again = Recording.read(tmp_path / "log.csv")
        assert again.values.equals(recording.values)
        assert again.channels == recording.channels


def test_times_of_two_zones_are_one_clock(tmp_path: Path) -> None:
    """A log over the end of summer time, whose offset changes."""
    table = log()
    zones = np.where(np.arange(60) < 30, "+02:00", "+01:00")
    local = pd.to_datetime(table["time"]) + pd.to_timedelta(np.where(zones == "+02:00", 2, 1), "h")
    recording = read(table.assign(time=local.astype(str) + zones), tmp_path)
    assert recording.interval == pd.Timedelta("10min")
    assert str(recording.values.index[0]) == "2026-03-01 00:00:00"
    assert len(recording.values) == 60


def test_a_wrong_time_is_named(tmp_path: Path) -> None:
    times = log()["time"].where(np.arange(60) < 59, "2926-01-01 00:00:00")
    refused(lambda: read(log(time=times), tmp_path), "2926-01-01 00:00:00", "for its 60 rows")
    refused(lambda: Recording.read(3), "it must be the path of a CSV file")  # type: ignore[arg-type]


@pytest.mark.parametrize("beside", [False, True])
def test_the_first_reading_at_a_time_counts(beside: bool, tmp_path: Path) -> None:
    """In the order of the file: beside each other, or where the times begin anew."""
    table = log(600)
    twice = pd.concat([table, table.assign(**{f"{name} [m]": 9.0 for name in "abc"})])
    twice = twice.sort_index(kind="stable") if beside else twice
    assert np.array_equal(read(twice, tmp_path).values, table.iloc[:, 1:])


def test_a_gap_leaves_steps_without_readings(tmp_path: Path) -> None:
    recording = read(log().drop(index=range(20, 30)), tmp_path)
    assert len(recording.values) == 60
    assert recording.gaps == (1, pd.Timedelta("100min"))


@pytest.mark.slow
def test_the_mast_has_one_faulty_anemometer(mast: Recording) -> None:
    """As other measures have it: correlation .76 with the median of its peers."""
    faults = {row.channel.name: row.fault for row in mast.card if row.fault}
    assert faults == {"Spd80mS": "disagrees with its peers"}
    assert card(mast, "Spd80mS").agreement == pytest.approx(0.76, abs=0.005)
    assert mast.gaps[1] == pytest.approx(pd.Timedelta("19.68 days"), abs=pd.Timedelta("15min"))
    names = [channel.name for channel in mast.select().channels]
    assert names == ["Spd80mN", "Spd60mN", "Spd60mS", "Spd40mN", "Spd40mS", "T2m"]


def test_selected_channels_have_no_readings_at_their_limits() -> None:
    recording = Recording.read("tanks")
    assert (recording.values["middle"] == 54.0).any()
    chosen = recording.select(["middle"])
    assert chosen.values["middle"].max() < 54.0
    refused(lambda: recording.select(["lake"]), "channels = ", "'lake'", "must be some of inflow")


def test_info_prints_the_card_and_draws_it(tmp_path: Path) -> None:
    picture = tmp_path / "card.png"
    printed = succeed("info", ["tanks", "--picture", str(picture)]).out
    assert "6,000 steps of 0 days 00:01:00" in printed
    assert "middle [cm]" in printed
    assert picture.stat().st_size > 10_000
    error = refusal("info", ["LinearFusion", "--picture", str(picture)])
    assert "it must be left out with a name that is no log" in error
    assert "log = " in refusal("info", [str(tmp_path / "absent.csv")])
