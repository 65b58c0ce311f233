"""fusion-gym field: from a log to the settings of devices."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from command_runs import call, refusal, succeed

from fusion_gym import Reception
from fusion_gym.commands import field
from fusion_gym.recordings import Recording, field_study, fit
from fusion_gym.recordings.field_report import curve_of, fields_of, longest_interval, step_of
from fusion_gym.recordings.field_study import (
    HELD,
    METHODS,
    FieldStudy,
    MethodPoint,
    Replay,
    Trial,
    compare_with_held,
    measure,
    replay_whole,
    rule_of,
)
from fusion_gym.validation import ConfigurationError

STUDY = FieldStudy({}, rate=0.05, shape=(1.0, 1.0), horizon=50, source="normal")


def point(factor: float, error: float, spread: float = 0.0, windows: int = 40) -> MethodPoint:
    """A point at a multiple of the target rate, with errors that vary between windows."""
    draw = np.random.default_rng(0).normal(size=windows)
    draw = spread * (draw - draw.mean())
    rates = [[0.05 * factor] * 2] * windows
    return MethodPoint([1.0], error, (error * (1.0 + draw)).tolist(), rates, [])


def test_methods_are_compared_at_equal_packets_and_at_equal_error() -> None:
    """Errors that are powers of the rate: closed forms."""
    factors = (0.5, 0.7, 1.0, 1.4, 2.0)
    points = {
        HELD: [point(f, 0.4 / f) for f in factors],
        "silence used": [point(1.3 * f, 0.1 / (1.3 * f)) for f in factors],
        "centralised": [point(f, 0.3 / f, 0.2) for f in factors],
    }
    results = {result.name: result for result in compare_with_held(STUDY, points)}
    assert results["silence used"].relative.mean == pytest.approx(-0.75, abs=1e-9)
    assert results["silence used"].relative.high == pytest.approx(-0.75, abs=1e-9)
    assert results["silence used"].packets == pytest.approx(0.25, abs=1e-6)
    assert results["centralised"].relative.low < -0.25 < results["centralised"].relative.high
    assert results[HELD].packets == pytest.approx(1.0)
    assert results[HELD].ratio == pytest.approx(1.0)


def test_a_curve_rises_in_rate_without_points_that_send_nothing() -> None:
    factors = (2.0, 0.0, 0.5, 0.0, 2.01, 1.0)
    rates, errors = curve_of([point(f, 3.0 - f) for f in factors])
    np.testing.assert_allclose(rates, [0.025, 0.05, 0.10025])
    np.testing.assert_allclose(errors, [2.5, 2.0, 0.995])
    assert curve_of([point(0.0, 1.0)])[0].size == 0


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_the_interval_is_that_of_blocks_of_five_windows(level: float) -> None:
    """Errors that cancel within a block have none; errors of whole blocks have that of 16."""
    turns = np.tile([2.0, -1.0, -1.0, 1.0, -1.0], 16)
    blocks = np.repeat(np.resize([1.0, -1.0], 16), 5)
    errors = (1.0 + 0.1 * (level * blocks + (1.0 - level) * turns)).tolist()
    rates = [[0.05, 0.05]] * 80
    points = {
        HELD: [MethodPoint([1.0], 1.0, [1.0] * 80, rates, [])],
        "centralised": [MethodPoint([1.0], 1.0, errors, rates, [])],
    }
    points = {name: own * 2 for name, own in points.items()}
    relative = compare_with_held(STUDY, points)[1].relative
    expected = level * 1.96 * 0.1 / np.sqrt(16)
    assert relative.mean == pytest.approx(0.0, abs=1e-12)
    assert relative.high - relative.mean == pytest.approx(expected, rel=0.1, abs=1e-12)
    assert relative.mean - relative.low == pytest.approx(expected, rel=0.1, abs=1e-12)


def drawn_log(file: Path, seed: int, rows: int = 1500) -> str:
    """Three channels of one walk each, of two decimals, with 3 % of the readings missing."""
    draw = np.random.default_rng(seed)
    path = np.cumsum(draw.normal(size=(rows, 3)), axis=0) * [0.2, 1.0, 0.05]
    path = np.round(path - 0.01 * np.cumsum(path, axis=0) * [1, 1, 1], 2)
    path[draw.random(path.shape) < 0.03] = np.nan
    index = pd.date_range("2026-01-01", periods=rows, freq="10min", name="time")
    pd.DataFrame(path, index, list("abc")).to_csv(file)
    return str(file)


def sent_on_change(readings: Any, thresholds: Any, most: int) -> tuple[Any, Any]:
    """Which readings (T, l) after the first, known ones devices send, and the last sent ones."""
    last, age, sent, lasts = readings[0].copy(), np.zeros(readings.shape[1]), [], []
    for row in readings[1:]:
        age += 1
        change = np.abs(row - last)
        sends = (change > 0.0) & (change >= thresholds * (1 - 1e-6)) | (age >= most)
        sends &= np.isfinite(row)
        last, age = np.where(sends, row, last), np.where(sends, 0, age)
        sent.append(sends)
        lasts.append(last)
    return np.array(sent), np.array(lasts)


def estimates_of_stream(task: Any, sent: Any) -> Any:
    """Readings (T, l) that a centre expects, which predicts, observes and updates."""
    centre, noise, plant, estimates = task.estimator, task.noise, task.plant, []
    known, day = plant.start(noise.start(0, 0, plant.start_channels)[:, None])
    state = centre.start(plant.measurement(known), day)
    for step, sends in enumerate(sent):
        row = noise.steps(0, 0, step, 1, plant.noise_channels)[0][:, None]
        known = plant.sense(known, row)
        reading = plant.measurement(known)
        packets = np.where(sends[:, None, None], reading, np.nan)
        state = centre.observe(centre.predict(state), packets)
        possible = np.isfinite(reading[:, 0])
        state = centre.update(state, Reception(sends[:, None], possible))
        level = centre.level.at(state.day, np.full(1, step + 1.0))
        estimates.append((state.mean + level[:, 0])[:, 0])
    return np.array(estimates)


@pytest.mark.parametrize("log", ["tanks", "mast", 0, 1, 2])
@pytest.mark.parametrize("method", [HELD, "silence ignored, one per sensor", "silence used"])
def test_what_is_reported_is_one_replay_of_the_other_part(
    log: Any, method: str, tmp_path: Path
) -> None:
    source = log if isinstance(log, str) else drawn_log(tmp_path / "log.csv", log)
    recording = Recording.read(source).select()
    if log in ("tanks", "mast"):
        replace(recording, values=recording.values[:2400]).write(tmp_path / "log.csv")
        source = str(tmp_path / "log.csv")
        recording = Recording.read(source).select()
    plant = fit(recording, exact=True, order=1)
    rows = len(recording.values) // 2
    study = FieldStudy(
        plant.options | {"log": source}, 0.05, plant.typical_changes, 50, "normal",
        lengths=(rows, len(recording.values) - rows),
    )  # fmt: skip
    thresholds = study.quantize(3.0 * np.array(plant.typical_changes))
    filter_name, (options, rule) = METHODS[method][0], rule_of(study, method, thresholds)
    result = replay_whole(study, filter_name, options, rule)
    first = recording.values.interpolate(limit_direction="both").iloc[rows : rows + 1]
    readings = pd.concat([first, recording.values.iloc[rows + 1 : -1]]).to_numpy()
    sent, last = sent_on_change(readings, thresholds, study.max_interval)
    if filter_name == "hold":
        estimates = last
    else:
        task = study.task(filter_name, "recorded", **options, horizon=len(sent))
        estimates = estimates_of_stream(task, sent)
    errors = np.sqrt(np.nanmean((readings[1:] - estimates) ** 2, axis=0))
    assert len(result.rates) == 1
    np.testing.assert_allclose(result.rates[0], sent.mean(0), rtol=0, atol=1e-12)
    np.testing.assert_allclose(result.deviations, errors, rtol=1e-6)
    weights = np.array(plant.options["state_weights"])
    assert result.errors[0] == pytest.approx(weights @ errors**2, rel=1e-6)


@pytest.mark.parametrize("tolerance", [(), (0.5, 0.5)])
@pytest.mark.parametrize("name", ["centralised", "silence used, one per sensor"])
def test_each_simulation_advances_the_progress_to_its_total(
    name: str, tolerance: tuple[float, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By its steps; a stage that ends before its most calls counts as a whole."""

    def run_trial(study: FieldStudy, name: str, sizes: Any, source: str) -> Trial:
        return Trial(float(sizes.mean()), float(0.1 / sizes.mean()), sizes.tolist())

    def point_at(study: FieldStudy, sizes: Any, *_: Any) -> MethodPoint:
        return MethodPoint(sizes, 1.0, [1.0], [[1.0]], sizes[:1] * 2)

    def replay_whole(*_: Any) -> Replay:
        return Replay(np.ones(1), np.ones((1, 2)), np.ones(2))

    def call(self: FieldStudy, function: Any, *arguments: Any) -> Any:
        done, before = progress()[0], len(list(tmp_path.rglob("output.pkl")))
        result = original(self, function, *arguments)
        steps = work[name][function.__name__][1]
        new = len(list(tmp_path.rglob("output.pkl"))) - before
        gained, stage = progress()[0] - done, field._STAGES[function.__name__]
        assert gained == steps * new or (stage not in stages and gained >= steps)
        stages.append(stage)
        return result

    def progress() -> Any:
        return field._progress(study, {name: tmp_path / "a.json"}, work)

    for stub in (run_trial, point_at, replay_whole):
        monkeypatch.setattr(field_study, stub.__name__, stub)
    study = replace(STUDY, trials=tmp_path / "trials", lengths=(90, 70), tolerance=tolerance)
    work, stages, original = {name: field_study.work(study, name)}, list[str](), FieldStudy.call
    total = sum(calls * steps for calls, steps in work[name].values())
    assert progress() == (0, "")
    monkeypatch.setattr(FieldStudy, "call", call)
    field._measure(study, name, tmp_path / "a.json", tmp_path, 10)
    assert progress() == (total, "")
    assert list(dict.fromkeys(stages)) == ["tuning", "measurement", "replay of the whole part"]
    (tmp_path / "a.json").unlink()
    assert progress()[0] == total


ROOM = ["--exact", "--share", "0.6", "--workers", "1", "--timesteps", "10"]


@pytest.fixture
def room(small_studies: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The words of a short study of a room, whose agent is the centralised rule."""
    monkeypatch.setattr(field, "train_agent", lambda study, *_: measure(study, "centralised"))
    write_room(tmp_path / "room.csv")
    return [str(tmp_path / "room.csv"), "--output", str(tmp_path / "field"), *ROOM]


def write_room(file: Path, noise: float = 0.0, rows: int = 2400, late: float = 1.0) -> None:
    """Two channels with measurement noise; ``late`` scales the process noise of the last 40 %."""
    draw, path = np.random.default_rng(0).normal(size=(2, rows, 2)), np.zeros((rows, 2))
    for row in range(1, rows):
        change = draw[0, row] * [0.4, 2.0] * (1.0 if row < 0.6 * rows else late)
        path[row] = 0.95 * path[row - 1] + change
    path += noise * draw[1] * [0.4, 2.0] + [20.0, 50.0]
    index = pd.date_range("2026-01-01", periods=rows, freq="10min", name="time")
    pd.DataFrame(path, index, ["air [°C]", "damp [%]"]).to_csv(file, float_format="%.2f")


@pytest.mark.slow
def test_the_least_packets_keep_the_tolerance_with_what_a_device_holds(
    room: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On the fitted part; thresholds a tenth larger exceed it. The other part is replayed."""
    monkeypatch.setattr(field_study, "_CLOSE", 0.05)
    write_room(tmp_path / "room.csv", late=2.0)
    words = [*room, "--tolerance", "air=0.3", "damp=1.5", "--device", "zigbee"]
    printed = succeed("field", words).out
    settings = yaml.safe_load((tmp_path / "field" / "devices.yaml").read_text())
    assert [row["reportable_change"] * 100 for row in settings.values()] == pytest.approx(
        [row["zigbee"]["reportable_change"] for row in settings.values()]
    )
    assert all(isinstance(row["zigbee"]["reportable_change"], int) for row in settings.values())
    intervals = {row["zigbee"]["maximum_reporting_interval"] for row in settings.values()}
    assert max(intervals) == max(row["max_interval"] for row in settings.values()) <= 65_534
    for text in ("Temperature Measurement 0x0402", "Zigbee Cluster Library"):
        assert text in printed
    thresholds = np.array([row["reportable_change"] for row in settings.values()])
    code = printed.split("make_task(")[1].split(")")[0]
    plant = yaml.safe_load((tmp_path / "field" / "plant.yaml").read_text())
    options = {"log": room[0], "fit_share": 0.6} | plant
    tolerance, steps = (0.3, 1.5), max(intervals) // 600
    study = FieldStudy(options, 10.0 / steps, (1.0, 1.0), 20, "normal", tolerance,
                       lengths=(1440, 960))  # fmt: skip
    method = "silence used" if "truncated" in code else HELD
    excess = []
    for factor in (1.0, 1.1):
        own = rule_of(study, method, factor * thresholds)
        excess.append(study.excess(study.replay("fitted", METHODS[method][0], *own).deviations))
    assert excess[0] <= 1.0 < excess[1]
    whole = replay_whole(study, METHODS[method][0], *rule_of(study, method, thresholds))
    assert all(f"| {value:.1f} " in printed for value in whole.rates[0] * 144)
    assert all(f"| {value:.3g} " in printed for value in whole.deviations)
    assert ("**On the other part it exceeds" in printed) == (study.excess(whole.deviations) > 1.0)


@pytest.mark.slow
def test_a_tolerance_that_no_setting_keeps_is_said(room: list[str]) -> None:
    """A step of 1 hPa is too large."""
    log = Path(room[0])
    log.write_text(log.read_text().replace("damp [%]", "damp [hPa]"))
    printed = succeed("field", [*room, "--tolerance", "0.01", "--device", "zigbee"]).out
    assert "**No setting keeps the tolerance**" in printed


@pytest.mark.slow
def test_an_interrupted_study_continues_within_a_method(
    room: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[int] = []
    original = field_study.run_episodes

    def interrupted(*words: Any) -> Any:
        calls.append(1)
        if len(calls) == 30:
            raise KeyboardInterrupt
        return original(*words)

    monkeypatch.setattr(field_study, "run_episodes", interrupted)
    ended = call("field", room)
    assert ended.status == 130
    assert "--resume" in ended.err
    first = succeed("field", [*room, "--resume"]).out
    resumed = len(calls)
    calls[:] = [1] * 100
    assert succeed("field", [*room, "--output", f"{room[2]} again"]).out == first
    assert resumed == len(calls) - 100 + 1  # the interrupted simulation runs twice


@pytest.mark.slow
def test_a_log_on_change_with_a_date_format_is_studied(room: list[str], tmp_path: Path) -> None:
    """The plant is the plant of the held readings, and a refused study leaves no folder."""
    table = pd.read_csv(room[0], index_col=0, parse_dates=True)
    sent, last = np.ones(table.shape, bool), table.iloc[0].to_numpy()
    for row, values in enumerate(table.to_numpy()[1:], 1):
        sent[row] = np.abs(values - last) >= [0.4, 2.0]
        last = np.where(sent[row], values, last)
    held = table.where(sent)
    held.index = held.index.strftime("%d.%m.%Y %Hh%M")
    output, form = tmp_path / "field", ["--date-format", "%d.%m.%Y %Hh%M"]
    for rows, words, message in (
        (2400, form, "give --on-change"),
        (2400, ["--on-change"], "--date-format"),
        (300, [*form, "--on-change", "--share", "0.95"], "horizon = 20"),
    ):
        held[:rows].to_csv(room[0])
        assert message in refusal("field", [*room, *words])
        assert not output.exists()
    held.to_csv(room[0])
    ended = succeed("field", [*room, *form, "--on-change"])
    assert "warning: " in ended.err
    assert "steps of silence have the last reading" in ended.err
    assert set(yaml.safe_load((output / "devices.yaml").read_text())) == {"air", "damp"}
    whole = Recording.read(output / "log.csv")
    assert np.array_equal(whole.values, table.where(sent).ffill())
    plant = fit(whole.select(["air", "damp"]), 0.6, exact=True, order=1)
    made = yaml.safe_load((output / "plant.yaml").read_text())
    assert np.allclose(made["transition"], plant.transition)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--tolerance", "1", "2"], "one number, or one for each of the channels inflow, middle"),
        (["--tolerance", "inflow=1", "middle=1", "outlet=1"], "of the channels inflow, middle"),
        (["--tolerance", "0"], "tolerance = 0 is not allowed: it must be a finite number > 0"),
        (["--tolerance", "1", "--target-rate", ".1"], "--tolerance determines the rate"),
        (["--tolerance", "warm"], "tolerance = 'warm'"),
    ],
)
def test_what_is_no_tolerance_is_refused(words: list[str], message: str, tmp_path: Path) -> None:
    output = tmp_path / "field"
    assert message in refusal("field", ["tanks", "--exact", *words, "--output", str(output)])
    assert not output.exists()


def test_fields_of_devices() -> None:
    """By the Zigbee Cluster Library, BACnet's SubscribeCOV and ESPHome's filters."""
    assert longest_interval("zigbee", 600.0) == 109
    assert longest_interval("bacnet", 600.0) > 7_000_000
    with pytest.raises(ConfigurationError, match=r"device = 'zigbee' .* interval of 86400 s"):
        longest_interval("zigbee", 86_400.0)
    study = replace(STUDY, steps=(step_of("zigbee", "°C"), step_of("zigbee", "hPa")))
    assert study.quantize(np.array([0.2549, 0.2])).tolist() == [0.25, 1.0]
    assert study.quantize(np.array([1e6, 1e6])).tolist() == [327.67, 32_767.0]
    assert STUDY.quantize(np.array([0.00123456, 98765.0])).tolist() == [0.001235, 98_760.0]
    assert fields_of("zigbee", "°C", 0.25, 60.0, 6000.0) == {
        "cluster": "Temperature Measurement 0x0402", "reportable_change": 25,
        "minimum_reporting_interval": 60, "maximum_reporting_interval": 6000,
    }  # fmt: skip
    unknown = fields_of("zigbee", "m/s", 3.0, 600.0, 60_000.0)
    assert unknown["reportable_change"] == "3 in unknown steps"
    assert fields_of("bacnet", "°C", 0.25, 60.0, 6000.0) == {
        "COV_Increment": 0.25, "lifetime": 6000,
    }  # fmt: skip
    filters = fields_of("esphome", "°C", 0.25, 60.0, 6000.0)["filters"]
    assert filters == [{"throttle": "60s"}, {"or": [{"heartbeat": "6000s"}, {"delta": 0.25}]}]


@pytest.mark.slow
def test_a_log_with_noise_is_studied_without_further_options(
    room: list[str], tmp_path: Path
) -> None:
    write_room(tmp_path / "room.csv", noise=1.0)
    printed = succeed("field", [word for word in room if word != "--exact"]).out
    assert "## Recommendation" in printed
    assert (tmp_path / "field" / "devices.yaml").exists()


@pytest.mark.parametrize("method", [HELD, "silence ignored, one per sensor", "silence used"])
def test_errors_of_a_log_with_noise_are_those_of_the_quantity(method: str, tmp_path: Path) -> None:
    """Which the test knows; the noise is as large as the process noise."""
    noisy, true = tmp_path / "log.csv", tmp_path / "true.csv"
    write_room(noisy, noise=1.0, rows=6000)
    write_room(true, rows=6000)
    recording, rows = Recording.read(noisy).select(), 3000
    plant = fit(recording, order=1)
    assert plant.measurement_variance**0.5 == pytest.approx([0.4, 2.0], rel=0.15)
    study = FieldStudy(
        plant.options | {"log": str(noisy)}, 0.05, plant.typical_changes, 50, "normal",
        lengths=(rows, rows),
    )  # fmt: skip
    thresholds = study.quantize(1.5 * np.array(plant.typical_changes))
    filter_name, (options, rule) = METHODS[method][0], rule_of(study, method, thresholds)
    result = replay_whole(study, filter_name, options, rule)
    readings = recording.values.to_numpy()[rows:-1]
    truth = Recording.read(true).values.to_numpy()[rows + 1 : -1]
    sent, estimate = sent_on_change(readings, thresholds, study.max_interval)
    assert 0.02 < sent.mean() < 0.3
    if filter_name != "hold":
        task = study.task(filter_name, "recorded", **options, horizon=len(sent))
        estimate = estimates_of_stream(task, sent)
    errors = np.sqrt(((estimate - truth) ** 2).mean(0))
    np.testing.assert_allclose(result.rates[0], sent.mean(0), rtol=0, atol=1e-12)
    np.testing.assert_allclose(result.deviations, errors, rtol=0.05)
