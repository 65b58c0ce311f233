"""What the figure of a setting shows: its panels, made of the results."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fusion_gym.evaluation.envelope import EnvelopePoint, height, lower_hull

from ..output import palette, pareto_figure
from ..output.pareto_figure import Differences, Limits, Panel, Series
from .envelope_table import at_least
from .setting_results import SettingResults

FINE = 80  # rates of a curved line
LEFT = 0.04  # of the rate that always transmitting gets: where the figure begins
# Where every measurement's arrival bounds the error, and the figure still reaches so far down.
DEEPEST = 0.3
WIDEST = 0.4  # of the relative differences that are drawn
MIXED = "found before"  # no family of one rule
HEARS = {"none": "hear nothing", "estimate": "hear estimate", "packets": "hear packets"}


def draw_layers(folder: Path, value: SettingResults) -> None:
    """The setting's figure, into its folder, as PNG and as SVG."""
    main, small = panels_of(value)
    paths = [folder / f"pareto.{suffix}" for suffix in ("png", "svg")]
    pareto_figure.draw_pareto(
        paths, value.verdict["title"], main, small, limits_of(value, [main, *small])
    )


def panels_of(results: SettingResults) -> tuple[Panel, list[Panel]]:
    """The schedulers' panel, and one for the centre, for sensors alone, and for estimates."""
    grouped: dict[tuple[str, str, str], list[str]] = {}
    for name, content in figure_of(results).items():
        grouped.setdefault(_kind(content), []).append(name)
    scheduler = grouped.pop(("sensors", "", "measurement"), [])
    rates = _fine(results)
    bound = [(r, at_least(results.bound, r)) for r in rates] if results.bound else []
    series = list(_series(results, scheduler, results.ahead))
    if results.rollout:
        points = [(point.rate, point.mse) for point in results.rollout]
        label = f"improved by simulation\n({results.rollout_episodes} episodes)"
        style = palette.ROLLOUT._replace(label=label)
        series.append(Series(style, [], points))
    genie = results.baselines.get("genie")
    level = ("everything arrives", float(genie["mse"]["mean"])) if genie and not bound else None
    main = Panel(
        "scheduler",
        series,
        _single(results, scheduler),
        bound,
        level,
        list(_differences(results, scheduler)),
    )
    small = [
        Panel(
            _title(*key),
            list(_series(results, names, results.known if key[0] == "centre" else [])),
            _single(results, names),
            bound,
            differences=list(_differences(results, names)),
        )
        for key, names in grouped.items()
    ]
    return main, small


def limits_of(results: SettingResults, panels: Sequence[Panel]) -> Limits:
    """From 4 % of what always transmitting gets, and from the least error that is drawn there."""
    always = results.verdict["always"]
    left, right = LEFT * always, 1.12 * always
    every = [
        error
        for panel in panels
        for series in panel.series
        for rate, error in (*series.marks, *series.line)
        if left <= rate <= right and error > 0.0
    ]
    lows = [error for panel in panels for rate, error in panel.bound if error > 0.0]
    least, most = (min(every), max(every)) if every else (0.5, 2.0)
    level = panels[0].level
    if level and DEEPEST * least <= level[1]:
        lows.append(level[1])
    ends = [
        end
        for panel in panels
        for difference in panel.differences
        for rate, _, low, high in difference.points
        if left <= rate <= right
        for end in (low, high)
    ]
    apart = (max(min([-0.05, *ends]), -WIDEST) - 0.02, min(max([0.05, *ends]), WIDEST) + 0.02)
    return Limits((left, right), (0.88 * min([least, *lows]), 1.15 * most), apart)


def figure_of(results: SettingResults) -> dict[str, Any]:
    """The classes that have agents, and committed ones where no class of the same kind has any."""
    committed = results.envelopes.get("classes", {})
    there = {_kind(content) for content in results.classes.values()}
    others = {name: item for name, item in committed.items() if _kind(item) not in there}
    every = others | results.classes
    order = [*committed, *(name for name in results.classes if name not in committed)]
    return {name: every[name] for name in order if name in every}


def _kind(content: dict[str, Any]) -> tuple[str, str, str]:
    """Who decides, what a sensor by itself hears, and what a packet holds."""
    return content["mode"], content["broadcast"] or "", _packet(content)


def _packet(content: dict[str, Any]) -> str:
    return str(content.get("packet") or content["options"].get("packet", "measurement"))


def _title(mode: str, broadcast: str, packet: str) -> str:
    if packet == "estimate":
        return "scheduler,\nsends estimate"
    return "centre,\nsees no signal" if mode == "centre" else f"sensors alone,\n{HEARS[broadcast]}"


def _series(
    results: SettingResults, names: Sequence[str], reference: Sequence[EnvelopePoint]
) -> Iterator[Series]:
    """Rules and agents of classes that differ in memory, and what computes with the model."""
    contents = figure_of(results)
    for name in sorted(names, key=lambda name: contents[name]["memory"]):
        hull, memory = results.hull(name), contents[name]["memory"]
        style = palette.RULES_MEMORY if memory else palette.RULES
        yield Series(style, list(_along(hull, _fine(results))), [(p.rate, p.mse) for p in hull])
    if reference:
        hull = lower_hull(reference)
        yield Series(
            _reference_style(results, reference),
            list(_along(hull, [r for r in _fine(results) if r <= hull[-1].rate])),
            [(point.rate, point.mse) for point in hull],
        )
    for name in sorted(names, key=lambda name: contents[name]["memory"]):
        if name in results.classes:
            style = palette.AGENTS_MEMORY if contents[name]["memory"] else palette.AGENTS
            points = results.classes[name]["points"]
            marks = [(point["rate"], point["mse"]) for point in points]
            yield Series(style, marks, marks, list(_band(results, name, marks)))


def _differences(results: SettingResults, names: Sequence[str]) -> Iterator[Differences]:
    """What agents do relative to the rules of their class, by rate."""
    for name in names:
        if name in results.classes:
            content = results.classes[name]
            points = [
                (point["rate"], *(point["difference"][end] for end in ("mean", "low", "high")))
                for point in content["points"]
                if "difference" in point
            ]
            yield Differences(
                palette.AGENTS_MEMORY if content["memory"] else palette.AGENTS, sorted(points)
            )


def _reference_style(results: SettingResults, reference: Sequence[EnvelopePoint]) -> palette.Style:
    style = palette.SCHEDULES if reference is results.known else palette.REFERENCE
    return style._replace(label=reference_label(results, reference))


def reference_label(results: SettingResults, reference: Sequence[EnvelopePoint]) -> str:
    """What computes with the model, in a word."""
    if reference is results.known:
        return "best periodic schedules"
    return "optimum" if results.optimal else "lookahead with the model"


def _band(
    results: SettingResults, name: str, marks: Sequence[tuple[float, float]]
) -> Iterator[tuple[float, float, float]]:
    """The least and the greatest error of training seeds at each price."""
    columns = results.seeds.get(name, ())
    if len(columns) > 1:
        for place, (rate, _) in sorted(enumerate(marks), key=lambda item: item[1]):
            errors = [column[place][1] for column in columns]
            yield rate, min(errors), max(errors)


def _along(hull: Sequence[EnvelopePoint], rates: Sequence[float]) -> Iterator[tuple[float, float]]:
    """The line of an envelope, which bends on logarithmic axes."""
    for rate in rates:
        error = height(hull, rate)
        if error is not None:
            yield rate, error


def _single(results: SettingResults, names: Sequence[str]) -> list[list[tuple[float, float]]]:
    """Each family's tuned rules, on the tuning seeds, in the classes of a panel.

    They are drawn down to the envelope on the test seeds: what was best on the seeds that it was
    tuned on lies lower there, by luck.
    """
    hulls = [results.hull(name) for name in names]
    classes = results.envelopes.get("classes", {})
    own = [classes[name] for name in names if name in classes]
    families = {family for content in own for family in content["families"]}
    options = [{}, *(content["options"] for content in own)]
    return [
        [
            (point["rate"], max(point["mse"], _least(hulls, point["rate"])))
            for point in curve["points"]
        ]
        for curve in results.envelopes.get("curves", ())
        if curve["family"] in families - {MIXED}
        and curve["options"] in options
        and len(curve["points"]) > 1
    ]


def _least(hulls: Sequence[Sequence[EnvelopePoint]], rate: float) -> float:
    """The least error of these envelopes at a rate; zero left of them."""
    heights = [height(hull, rate) for hull in hulls if hull]
    return min([item for item in heights if item is not None], default=0.0)


def _fine(results: SettingResults) -> list[float]:
    always = results.verdict["always"]
    return np.geomspace(LEFT * always, always, FINE).tolist()
