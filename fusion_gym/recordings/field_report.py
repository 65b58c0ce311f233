"""Data cards of recordings, and the report of a field study: tables, pages, pictures, settings.

Sources of the devices' fields: Zigbee Cluster Library, Configure Reporting command and the clusters
of Measurement and Sensing; ANSI/ASHRAE 135 (BACnet), COV_Increment and SubscribeCOV; ESPHome,
Sensor Filters.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import yaml
from markdown_it import MarkdownIt
from matplotlib.ticker import LogLocator
from rich.table import Table

from fusion_gym.arrays import Array
from fusion_gym.docstrings import table
from fusion_gym.errors import refusal
from fusion_gym.output.figures import save_figure
from fusion_gym.output.files import write_text
from fusion_gym.output.palette import BLUE, READABLE, VERMILLION
from fusion_gym.output.tables import table_tables
from fusion_gym.recordings import ChannelCard, Criticism, DeviceName, Recording, field_study
from fusion_gym.recordings.field_study import HELD, METHODS, MethodPoint, MethodResult
from fusion_gym.version import __version__

COLUMNS = (
    "channel", "readings", "missing", "every", "mean", "deviation", "resolution", "saturated",
    "stuck", "spikes", "agreement", "fault",
)  # fmt: skip
RATIOS = "packets per sensor and step", "real error", "plant's error", "ratio", "NEES"
CAPTION = (
    "every: steps between two readings · stuck: readings in long runs of one value · agreement: "
    "correlation with the median of the channels of its unit"
)


def card_table(recording: Recording) -> Table:
    """Return the table of the channels."""
    return table_tables("channels", COLUMNS, map(card_row, recording.card), CAPTION)


def criticism_rows(criticism: Sequence[Criticism]) -> list[tuple[str, ...]]:
    """Return the rows of ``RATIOS``."""
    return [
        (f"{r.rate:g}", f"{r.real:.4f}", f"{r.model:.4f}", f"{r.ratio:.2f}", f"{r.nees:.2f}")
        for r in criticism
    ]


def card_lines(recording: Recording) -> list[str]:
    """Return the lines about the whole recording."""
    index, (gaps, longest) = recording.values.index, recording.gaps
    return [
        f"from {index[0]} to {index[-1]}: {len(index):,} steps of {recording.interval}",
        f"gaps of all channels: {gaps}, the longest {longest}",
        *(f"{card.channel.name}: recorded on change by {card.change:g}; silence is no missing "
          "reading (--on-change)" for card in recording.card if card.change),
        *recording.remarks,
    ]  # fmt: skip


def draw_card(recording: Recording, path: Path) -> None:
    """Draw the readings of every channel, red where the channel saturates."""
    cards, values = recording.card, recording.values
    size = 10.0, 1.2 + 1.1 * len(cards)
    figure, panels = plt.subplots(len(cards), 1, figsize=size, sharex=True, squeeze=False)
    for panel, card in zip(panels[:, 0], cards, strict=True):
        channel, readings = card.channel, values[card.channel.name]
        edge = (readings <= channel.low) | (readings >= channel.high)
        panel.plot(values.index, readings.where(~edge), ".", ms=1, color=BLUE, rasterized=True)
        panel.plot(values.index, readings.where(edge), ".", ms=1, color=VERMILLION, rasterized=True)
        title = f"{channel.name} [{channel.unit}]" if channel.unit else channel.name
        panel.set_title(f"{title}: {card.fault}" if card.fault else title, loc="left")
    panels[-1, 0].set_xlabel("time (UTC)")
    figure.tight_layout()
    save_figure(figure, path)


def card_row(card: ChannelCard) -> tuple[str, ...]:
    """Return the cells of a channel."""
    channel = card.channel
    limits = [f"{end:g}" for end in (channel.low, channel.high) if np.isfinite(end)]
    saturated = f"{card.saturated:.1%} at {' and '.join(limits)}" if limits else "–"
    return (
        f"{channel.name} [{channel.unit}]" if channel.unit else channel.name,
        f"{card.readings:,}", f"{card.missing:.1%}", f"{card.every:g}", f"{card.mean:.4g}",
        f"{card.deviation:.3g}", f"{card.resolution:.2g}", saturated, f"{card.stuck:.1%}",
        str(card.spikes), "–" if np.isnan(card.agreement) else f"{card.agreement:.3f}", card.fault,
    )  # fmt: skip


# Shortest and longest interval in seconds, and the meaning of the fields with its source.
DEVICES: dict[str, tuple[float, float, str]] = {
    "zigbee": (1.0, 65_534.0, "whole seconds, and steps of the attribute MeasuredValue "
               "(Zigbee Cluster Library, Configure Reporting)"),
    "bacnet": (1.0, 4_294_967_295.0, "COV_Increment in the object's unit, and seconds after which "
               "the centre subscribes again (ANSI/ASHRAE 135, SubscribeCOV)"),
    "esphome": (0.001, 4_294_967.0, "filters of the sensor; a delta must be exceeded "
                "(ESPHome, Sensor Filters)"),
}  # fmt: skip
_TEMPERATURE = "Temperature Measurement 0x0402", 0.01, 32_767
_HUMIDITY = "Relative Humidity 0x0405", 0.01, 65_535
# Cluster, step in the unit and most steps of MeasuredValue, by unit.
ATTRIBUTES = {
    "°C": _TEMPERATURE, "C": _TEMPERATURE, "degC": _TEMPERATURE, "K": _TEMPERATURE,
    "°F": ("Temperature Measurement 0x0402", 0.018, 32_767), "%": _HUMIDITY,
    "Pa": ("Pressure Measurement 0x0403", 100.0, 32_767),
    "kPa": ("Pressure Measurement 0x0403", 0.1, 32_767),
    "hPa": ("Pressure Measurement 0x0403", 1.0, 32_767),
    "mbar": ("Pressure Measurement 0x0403", 1.0, 32_767),
    "m³/h": ("Flow Measurement 0x0404", 0.1, 65_535),
}  # fmt: skip


def longest_interval(device: DeviceName | None, seconds: float) -> float:
    """Return the most steps between two reports that a device holds, or that each device holds.

    Args:
        device: kind of the device.
        seconds: length of a step.

    Raises:
        ConfigurationError: the device cannot hold one step.
    """
    if device is None:
        return min((high // seconds for low, high, _ in DEVICES.values() if low <= seconds <= high),
                   default=np.inf)  # fmt: skip
    low, high, _ = DEVICES[device]
    if not low <= seconds <= high:
        allowed = f"a device with an interval of {seconds:g} s, not from {low:g} to {high:g} s"
        raise refusal("device", device, allowed)
    return high // seconds


def step_of(device: DeviceName | None, unit: str) -> tuple[float, float]:
    """Return step and largest value of a device's reportable change in a unit; 0 for no step."""
    _, step, most = ATTRIBUTES.get(unit if device == "zigbee" else "", ("", 0.0, np.inf))
    return step, most * step if step else most


def fields_of(
    device: DeviceName, unit: str, change: float, least: float, most: float
) -> dict[str, Any]:
    """Return the fields of a device and their values.

    Args:
        device: kind of the device.
        unit: unit of the readings.
        change: reportable change, in this unit.
        least: minimum interval, in seconds.
        most: maximum interval, in seconds.
    """
    if device == "bacnet":
        return {"COV_Increment": change, "lifetime": int(most)}
    if device == "esphome":
        either = [{"heartbeat": f"{most:g}s"}, {"delta": change}]
        return {"filters": [{"throttle": f"{least:g}s"}, {"or": either}]}
    cluster, step, _ = ATTRIBUTES.get(unit, ("unknown", 0.0, 0))
    steps = round(change / step) if step else f"{change:g} in unknown steps"
    intervals = {"minimum_reporting_interval": int(least), "maximum_reporting_interval": int(most)}
    return {"cluster": cluster, "reportable_change": steps, **intervals}


_CHANGE = "Sensors report on change"
MEANINGS = {
    HELD: f"{_CHANGE}, with one scale of all thresholds; the centre holds the last reading.",
    "held values, one per sensor": f"{_CHANGE}, each with its own threshold; the centre holds the "
    "last reading.",
    "silence ignored, one per sensor": f"{_CHANGE}, each with its own threshold; the centre has a "
    "Kalman filter.",
    "silence used": f"{_CHANGE}, with one scale of all thresholds; the centre uses silence.",
    "silence used, one per sensor": f"{_CHANGE}, each with its own threshold; the centre uses "
    "silence.",
    "centralised": "Value of information: a scheduler sees all readings.",
    "agent": "Counterfactual PPO: a scheduler sees all readings.",
}
_STYLE = "body{font-family:sans-serif;max-width:60em;margin:2em auto;padding:0 1em}td,th{\
padding:.2em .7em;border-bottom:1px solid #ccc;text-align:left}img{max-width:100%}\
pre{background:#f4f4f4;padding:1em;overflow:auto}table{border-collapse:collapse}"


@dataclass(frozen=True)
class FieldReport:
    """What a report shows."""

    name: str
    whole: Recording
    recording: Recording
    study: field_study.FieldStudy
    rows: int
    criticism: Sequence[Criticism]
    warnings: Sequence[str]
    points: Mapping[str, Sequence[MethodPoint]]
    results: Sequence[MethodResult]
    device: DeviceName | None = None

    @property
    def best(self) -> str:
        """The method without a downlink that has the least error, or packets in the tolerance."""
        local = [name for name in METHODS if name != "centralised"]
        if self.study.tolerance:
            return min(local, key=lambda name: self.point(name).order)
        errors = {row.name: row.error for row in self.results}
        return min(local, key=errors.__getitem__)

    def point(self, name: str) -> MethodPoint:
        """Return a method's point at the target."""
        return next(point for point in self.points[name] if point.packets)

    def packets_a_day(self, name: str) -> Array:
        """Return the packets per day of each sensor (sensors,)."""
        steps = 86_400.0 / self.recording.interval.total_seconds()
        result: Array = steps * np.array(self.point(name).packets)
        return result


def write_report(report: FieldReport, folder: Path) -> str:
    """Write report.md, report.html and devices.yaml, and return the results and settings."""
    study, whole = report.study, report.whole
    best, windows = report.best, len(report.points[HELD][0].errors)
    seconds, settings = report.recording.interval.total_seconds(), _settings(report)
    devices = yaml.safe_dump(settings, sort_keys=False, allow_unicode=True)
    filter_name = METHODS[best][0]
    thresholds = [row["reportable_change"] for row in settings.values()]
    trigger = f' trigger="report_on_change", trigger_threshold={thresholds},'
    trigger = trigger if filter_name == "truncated" else ""
    target = "the tolerance" if study.tolerance else f"{study.rate:g} packets per sensor and step"
    summary = [
        f"## At {target}",
        f"Settings, packets and errors of a sensor are those of {study.lengths[1]:,} steps in one "
        f"piece, which were not fitted; curves are means of {windows} windows. Errors are those of "
        "the channels without measurement noise.",
        *(_tolerance_lines(report) if study.tolerance else _rate_lines(report)),
        device_table(report),
        *([] if report.device is None else [f"{report.device}: {DEVICES[report.device][2]}"]),
        f"Intervals are in seconds; a step is {seconds:g} s. `devices.yaml`:",
        f"```yaml\n{devices}```",
        "A simulation of the centre:",
        f"```python\nimport fusion_gym\n\ntask = fusion_gym.make_task(\n"
        '    "fusion_gym/LinearFusion-v2", system="plant.yaml", tokens="unlimited",\n'
        f'    filter="{filter_name}",{trigger}\n)\n```',
    ]
    text = [
        f"# {report.name}",
        f"By fusion-gym {__version__}.",
        *summary,
        "![Error over packets](curves.png)",
        "## Methods",
        table(("method", "meaning"), [(name, MEANINGS[name]) for name in report.points]),
        "## The plant",
        f"A vector autoregression of the first {report.rows:,} steps without level and daily "
        "cycle, and its errors on the others under a periodic schedule.",
        table(RATIOS, criticism_rows(report.criticism)),
        "\n".join(f"- Warning: {line}." for line in report.warnings) or "No warning.",
        "## The log",
        "\n".join(f"- {line}" for line in card_lines(whole)),
        table(COLUMNS, [card_row(card) for card in whole.card]),
        "![Readings of all channels](card.png)",
    ]
    markdown = "\n\n".join(text) + "\n"
    page = MarkdownIt("commonmark").enable("table").render(markdown)
    write_text(folder / "report.md", markdown)
    head = f"<!doctype html><meta charset='utf-8'><title>{report.name}</title>"
    write_text(folder / "report.html", f"{head}<style>{_STYLE}</style>\n{page}")
    write_text(folder / "devices.yaml", devices)
    return "\n\n".join(summary)


def _rate_lines(report: FieldReport) -> list[str]:
    """Return the results and the recommendation at equal packets."""
    best = next(row for row in report.results if row.name == report.best)
    return [
        "Errors are shares of the channels' variance. The difference is to held values, which "
        "devices and centres use today, at equal packets, with a 95 % block-bootstrap interval.",
        results_table(report.results),
        "## Recommendation",
        f"{MEANINGS[best.name]} No other method without a downlink has a smaller error. It is "
        f"{-best.relative.mean:.0%} lower than with held values at equal packets "
        f"({-best.relative.high:.0%} to {-best.relative.low:.0%}). For the same error it takes "
        f"{best.packets:.0%} of the packets.",
    ]


def _tolerance_lines(report: FieldReport) -> list[str]:
    """Return the packets in the tolerance and the recommendation."""
    study, rows = report.study, []
    pairs = zip(report.recording.channels, study.tolerance, strict=True)
    listed = ", ".join(f"{c.name} {value:g} {c.unit}".strip() for c, value in pairs)
    for name in report.points:
        excess = study.excess(report.point(name).deviations)
        fitted, packets = report.point(name).order[0], f"{report.packets_a_day(name).sum():.1f}"
        packets = packets if fitted <= 1.0 else "not reached"
        rows.append((name, packets, f"{fitted:.2f}", f"{excess:.2f}"))
    best = report.point(report.best)
    answer = "No other method without a downlink keeps the tolerance there with fewer packets."
    if best.order[0] > 1.0:
        answer = "**No setting keeps the tolerance**; the errors below are the least."
    elif study.excess(best.deviations) > 1.0:
        answer += (
            " **On the other part it exceeds the tolerance**, because that part differs. Give a "
            "smaller one, or a longer log."
        )
    return [
        f"Root mean square errors that are allowed: {listed}. The fitted part selects the "
        "settings. Packets are those of all sensors on the other part.",
        table(
            ("method", "packets per day", "error over its tolerance, fitted part", "other part"),
            rows,
        ),
        "## Recommendation",
        f"{MEANINGS[report.best]} {answer}",
    ]


def results_table(results: Sequence[MethodResult]) -> str:
    """Return the table of the methods."""
    heads = ("method", "error", "difference to held values", "packets for the same error",
             "real over simulated error")  # fmt: skip
    rows = []
    for result in results:
        low, high = result.relative.low, result.relative.high
        difference = f"{result.relative.mean:+.1%} [{low:+.1%}, {high:+.1%}]".replace("-", "−")
        own = result.name != HELD
        rows.append((result.name, f"{result.error:.4f}", difference if own else "–",
                     f"{result.packets:.0%}" if own else "–", f"{result.ratio:.2f}"))  # fmt: skip
    return table(heads, rows)


def device_table(report: FieldReport) -> str:
    """Return the table of the recommended settings, beside the thresholds of held values."""
    point, held = report.point(report.best), report.point(HELD)
    day, rows = report.packets_a_day(report.best), []
    heads = ("sensor", "reportable_change", "min_interval", "max_interval", "packets per day",
             "error (rms)", "reportable_change of held values",
             *([f"{report.device} fields"] if report.device else []))  # fmt: skip
    for place, (name, row) in enumerate(_settings(report).items()):
        unit = f" {report.recording.channels[place].unit}".rstrip()
        rows.append((
            name, f"{row['reportable_change']:.4g}{unit}", f"{row['min_interval']:g} s",
            f"{row['max_interval']:g} s", f"{day[place]:.1f}",
            f"{point.deviations[place]:.3g}{unit}", f"{held.thresholds[place]:.4g}{unit}",
            *([json.dumps(row[report.device], ensure_ascii=False)] if report.device else []),
        ))  # fmt: skip
    return table(heads, rows)


def curve_of(points: Sequence[MethodPoint]) -> tuple[Array, Array]:
    """Return rising rates and their errors; rates of equal two digits have one mean, zero none."""
    table = pd.DataFrame([(np.mean(p.rates), np.mean(p.errors)) for p in points]).astype(float)
    table = table[table[0] > 0.0]
    digits = table[0].map("{:.2g}".format).to_numpy()
    rate, error = table.groupby(digits).mean().sort_values(0).to_numpy().T
    return rate, error


def draw_curves(
    study: field_study.FieldStudy, points: Mapping[str, Sequence[MethodPoint]], path: Path
) -> None:
    """Draw error over packets of every method on the held-out part."""
    plt.rcParams.update(READABLE)
    figure, panel = plt.subplots(figsize=(7.5, 4.8))
    for place, (name, own) in enumerate(points.items()):
        rate, error = curve_of(own)
        style: dict[str, Any] = {"marker": "os^vDP*"[place % 7], "ms": 6, "mfc": "none"}
        style |= {} if name in METHODS else {"ls": "--", "color": "black", "zorder": 3}
        panel.loglog(rate, error, label=name + " (no packets)" * (not rate.size), **style)
    if not study.tolerance:
        panel.axvline(study.rate, color="grey", lw=1, ls=":")
    panel.set(xlabel="packets per sensor and step", ylabel="error, as a share of the variance")
    for axis in (panel.xaxis, panel.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("")
    panel.legend(fontsize=8)
    figure.tight_layout()
    save_figure(figure, path)


def _settings(report: FieldReport) -> dict[str, dict[str, Any]]:
    """Return the settings of each sensor in its unit and in seconds, and the device's fields."""
    result: dict[str, dict[str, Any]] = {}
    least = report.recording.interval.total_seconds()
    most = report.study.max_interval * least
    thresholds = report.point(report.best).thresholds
    for channel, change in zip(report.recording.channels, thresholds, strict=True):
        row = {"reportable_change": change, "min_interval": least, "max_interval": most}
        result[channel.name] = row
        if report.device:
            row[report.device] = fields_of(report.device, channel.unit, change, least, most)
    return result
