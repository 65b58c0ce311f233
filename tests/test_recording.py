"""Logs of sensors: what a data card says, and what is refused."""

import gzip
import io
import lzma
import os
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from fusion_gym.recordings import ChannelCard, RecordedChannel, Recording
from fusion_gym.validation import ConfigurationError
from tests.command_runs import refusal, succeed


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
REFUSED = {
    "an empty file": ("", "it must be a CSV file"),
    "a picture": (b"\x89PNG\r\n\x1a\n" + bytes(range(256)), "it must be a CSV file"),
    "rows of different lengths": (TEXT + "2026-03-02,1,2,3,4,5,6\n", "it must be a CSV file"),
    "heads without rows": (TEXT.splitlines()[0], "0 of its 0 rows begin with a time"),
    "one row": (log(1), "1 of its 1 rows begin with a time, and at least 20"),
    "nineteen rows": (log(19), "19 of its 19 rows begin with a time"),
    "no channel": (log()[["time"]], "its channels are []"),
    "no column of times": (log().drop(columns="time"), "0 of its 60 rows begin with a time"),
    "times in words": (log(time="yesterday"), "0 of its 60 rows begin with a time"),
    "years beyond pandas": (log(time=1e15), "0 of its 60 rows begin with a time"),
    "half the times lost": (
        log(time=["2026-01-01", *["?"] * 59]),
        "1 of its 60 rows begin with a time",
    ),
    "one time for all": (log(time="2026-01-01 10:00"), "all its rows have the same time"),
    "a clock that jumps to 1970": (with_cell(0, 0, "1970-01-01 00:00:00"), "look for a wrong time"),
    "a clock that jumps to 2199": (with_cell(59, 0, "2199-01-01 00:00:00"), "look for a wrong"),
    "two channels of one name": (
        TEXT.replace("b [m]", "a [K]"),
        "its channels are ['a', 'a', 'c']",
    ),
    "a channel of text": (log(d="on"), "its channel 'd' has no number"),
    "a channel of gaps": (log(d=np.nan), "its channel 'd' has no number"),
    "a channel of infinities": (log(d=np.inf), "its channel 'd' has no number"),
    "an open bracket": (TEXT.replace("b [m]", "b [m"), "the head 'b [m' must be a name"),
    "limits in reverse": (TEXT.replace("b [m]", "b 5..1"), "a unit and rising limits"),
    "equal limits": (TEXT.replace("b [m]", "b [m] .5..0.5"), "the head 'b [m] .5..0.5' must be"),
    "no number in a limit": (TEXT.replace("b [m]", "b [m] ..."), "the head 'b [m] ...' must be"),
    "a limit of two points": (TEXT.replace("b [m]", "b 1.2.3..4"), "the head 'b 1.2.3..4' must be"),
    "many columns": ("t" + ",x" * 101, "or 100 channels"),
    "a line without an end": ("x" * 200_000, "field larger than field limit"),
    "a channel of huge numbers": (log(d=1e200), "its channel 'd' has no number up to 1e+15"),
    "limits in words": (TEXT.replace("b [m]", "b [m] ..high"), "the head 'b [m] ..high' must be"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_log_that_is_none_is_refused_in_one_line(name: str, tmp_path: Path) -> None:
    table, message = REFUSED[name]
    with pytest.raises(ConfigurationError, match=r"^log = ") as error:
        read(table, tmp_path)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


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
    monkeypatch.setattr("fusion_gym.recordings.recording.LONGEST_TEXT", len(TEXT) - 1)
    with pytest.raises(ConfigurationError, match=f"above {len(TEXT) - 1:,} bytes"):
        read(TEXT, tmp_path)


UNFIT = {
    "a constant": (lambda a: np.where(np.arange(600) < 599, 3.0, 4.0), "deviation of a = "),
    "tiny numbers": (lambda a: 1e-200 * a, "deviation of a = 0.0 is not allowed"),
    "a copy": (lambda a: log(600)["b [m]"].to_numpy(), "some that do not determine each other"),
    "late": (lambda a: np.where(np.arange(600) < 550, np.nan, a), "readings of a in the fitted"),
}  # fmt: skip


@pytest.mark.parametrize("name", UNFIT)
def test_a_log_without_a_plant_is_refused_in_one_line(name: str, tmp_path: Path) -> None:
    values, message = UNFIT[name]
    for exact in ([], ["--exact"]):
        read(changed(values), tmp_path)
        words = ["--share=0.9", "--output", str(tmp_path / "made.yaml"), "--channels", "a", "b"]
        assert message in refusal("fit", [str(tmp_path / "log.csv"), *words, *exact])
        assert not (tmp_path / "made.yaml").exists()
    assert "channels = () is not allowed" in refusal("fit", ["tanks", "--channels"])


def test_a_head_without_a_unit_has_limits(tmp_path: Path) -> None:
    recording = read(TEXT.replace("a [m]", "a b -.5..2").replace("b [m]", "b ..3"), tmp_path)
    assert recording.channels[:2] == (
        RecordedChannel("a b", low=-0.5, high=2.0),
        RecordedChannel("b", high=3.0),
    )


REMARKED = {
    "unsorted": (shuffled(log()), "times before the row above: sorted"),
    "a clock set back": (
        log(time=pd.concat([log()["time"][:30], log()["time"][24:54]]).to_list()),
        "6 rows at the time of another",
    ),
    "times of two precisions": (with_cell(3, 0, "2026-03-01 00:31"), "1 times between"),
    "a word for no reading": (with_cell(3, 1, "off"), "1 cells without a finite number"),
    "rows twice": (pd.concat([log(), log()]), "60 rows at the time of another"),
    "rows beside the even times": (with_cell(7, 0, "2026-03-01 01:14:00"), "1 times between"),
    "text in a cell": (with_cell(3, 1, "ERR"), "1 cells without a finite number"),
    "infinity in a cell": (with_cell(3, 1, "inf"), "1 cells without a finite number"),
    "a row without a time": (with_cell(3, 0, ""), "1 rows without a time: left out"),
    "a row with a broken time": (with_cell(3, 0, "2026-13-45"), "1 rows without a time"),
}


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


FORMATS: dict[str, Callable[[str], str | bytes]] = {
    "semicolons and decimal commas": lambda text: text.replace(",", ";").replace(".", ","),
    "tabs": lambda text: text.replace(",", "\t"),
    "a byte order mark": lambda text: b"\xef\xbb\xbf" + text.encode(),
    "lines of Windows": lambda text: text.replace("\n", "\r\n"),
    "time zones": lambda text: text.replace(":00,", ":00+02:00,"),
}


@pytest.mark.parametrize("name", FORMATS)
def test_formats_of_the_same_log_have_the_same_values(name: str, tmp_path: Path) -> None:
    expected = read(TEXT, tmp_path)
    recording = read(FORMATS[name](TEXT), tmp_path)
    assert np.array_equal(recording.values, expected.values)
    assert recording.channels == expected.channels


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
    with pytest.raises(ConfigurationError, match=r"2926-01-01 00:00:00.* too many for its 60 rows"):
        read(log(time=times), tmp_path)
    with pytest.raises(ConfigurationError, match="it must be the path of a CSV file"):
        Recording.read(3)  # type: ignore[arg-type]


def test_seconds_are_times(tmp_path: Path) -> None:
    recording = read(log(time=np.arange(60) * 30 + 1.7e9), tmp_path)
    assert recording.interval == pd.Timedelta("30s")
    assert str(recording.values.index[0]) == "2023-11-14 22:13:20"


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


def test_the_mast_has_one_faulty_anemometer() -> None:
    """As other measures have it: correlation .76 with the median of its peers."""
    recording = Recording.read("mast")
    faults = {row.channel.name: row.fault for row in recording.card if row.fault}
    assert faults == {"Spd80mS": "disagrees with its peers"}
    assert card(recording, "Spd80mS").agreement == pytest.approx(0.76, abs=0.005)
    assert recording.gaps[1] == pytest.approx(pd.Timedelta("19.68 days"), abs=pd.Timedelta("15min"))
    names = [channel.name for channel in recording.select().channels]
    assert names == ["Spd80mN", "Spd60mN", "Spd60mS", "Spd40mN", "Spd40mS", "T2m"]


def test_selected_channels_have_no_readings_at_their_limits() -> None:
    recording = Recording.read("tanks")
    assert (recording.values["middle"] == 54.0).any()
    chosen = recording.select(["middle"])
    assert chosen.values["middle"].max() < 54.0
    with pytest.raises(
        ConfigurationError, match=r"channels = .*'lake'.* it must be some of inflow"
    ):
        recording.select(["lake"])


def test_info_prints_the_card_and_draws_it(tmp_path: Path) -> None:
    picture = tmp_path / "card.png"
    printed = succeed("info", ["tanks", "--picture", str(picture)]).out
    assert "6,000 steps of 0 days 00:01:00" in printed
    assert "middle [cm]" in printed
    assert picture.stat().st_size > 10_000
    error = refusal("info", ["LinearFusion", "--picture", str(picture)])
    assert "it must be left out with a name that is no log" in error
    assert "log = " in refusal("info", [str(tmp_path / "absent.csv")])
