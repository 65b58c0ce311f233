"""What the figure of a setting shows: its panels, made of the results."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fusion_gym.evaluation.envelope import EnvelopePoint, height, lower_hull

from ..output import palette, pareto_figure
from ..output.pareto_figure import Differences, Limits, Panel, Series
from .envelope_table import at_least
from .found import Found

FINE = 80  # rates of a curved line
LEFT = 0.04  # of the rate that always transmitting gets: where the figure begins
# Where every measurement's arrival bounds the error, and the figure still reaches so far down.
DEEPEST = 0.3
WIDEST = 0.4  # of the relative differences that are drawn
MIXED = "found before"  # no family of one rule
HEARS = {"none": "hear nothing", "estimate": "hear estimate", "packets": "hear packets"}


def draw(folder: Path, found: Found) -> None:
    """The setting's figure, into its folder, as PNG and as SVG."""
    main, small = panels_of(found)
    paths = [folder / f"pareto.{suffix}" for suffix in ("png", "svg")]
    pareto_figure.draw(paths, found.verdict["title"], main, small, limits_of(found, [main, *small]))


def panels_of(found: Found) -> tuple[Panel, list[Panel]]:
    """The coordinators' panel, and one for the centre, for sensors alone, and for estimates."""
    grouped: dict[tuple[str, str, str], list[str]] = {}
    for name, content in shown(found).items():
        grouped.setdefault(_kind(content), []).append(name)
    coordinator = grouped.pop(("sensors", "", "measurement"), [])
    rates = _fine(found)
    bound = [(r, at_least(found.bound, r)) for r in rates] if found.bound else []
    series = list(_series(found, coordinator, found.ahead))
    if found.rollout:
        points = [(point.rate, point.mse) for point in found.rollout]
        label = f"improved by simulation\n({found.rollout_episodes} episodes)"
        style = palette.ROLLOUT._replace(label=label)
        series.append(Series(style, [], points))
    genie = found.baselines.get("genie")
    level = ("everything arrives", float(genie["mse"]["mean"])) if genie and not bound else None
    main = Panel(
        "coordinator",
        series,
        _single(found, coordinator),
        bound,
        level,
        list(_differences(found, coordinator)),
    )
    small = [
        Panel(
            _title(*key),
            list(_series(found, names, found.known if key[0] == "centre" else [])),
            _single(found, names),
            bound,
            differences=list(_differences(found, names)),
        )
        for key, names in grouped.items()
    ]
    return main, small


def limits_of(found: Found, panels: Sequence[Panel]) -> Limits:
    """From 4 % of what always transmitting gets, and from the least error that is drawn there."""
    always = found.verdict["always"]
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
        for one in panel.differences
        for rate, _, low, high in one.points
        if left <= rate <= right
        for end in (low, high)
    ]
    apart = (max(min([-0.05, *ends]), -WIDEST) - 0.02, min(max([0.05, *ends]), WIDEST) + 0.02)
    return Limits((left, right), (0.88 * min([least, *lows]), 1.15 * most), apart)


def shown(found: Found) -> dict[str, Any]:
    """The classes that have agents, and committed ones where no class of the same kind has any."""
    committed = found.envelopes.get("classes", {})
    there = {_kind(content) for content in found.classes.values()}
    others = {name: one for name, one in committed.items() if _kind(one) not in there}
    every = others | found.classes
    order = [*committed, *(name for name in found.classes if name not in committed)]
    return {name: every[name] for name in order if name in every}


def _kind(content: dict[str, Any]) -> tuple[str, str, str]:
    """Who decides, what a sensor by itself hears, and what a packet holds."""
    return content["mode"], content["broadcast"] or "", _packet(content)


def _packet(content: dict[str, Any]) -> str:
    return str(content.get("packet") or content["options"].get("packet", "measurement"))


def _title(mode: str, broadcast: str, packet: str) -> str:
    if packet == "estimate":
        return "coordinator,\nsends estimate"
    return "centre,\nsees no signal" if mode == "centre" else f"sensors alone,\n{HEARS[broadcast]}"


def _series(
    found: Found, names: Sequence[str], reference: Sequence[EnvelopePoint]
) -> Iterator[Series]:
    """Rules and agents of classes that differ in memory, and what computes with the model."""
    contents = shown(found)
    for name in sorted(names, key=lambda name: contents[name]["memory"]):
        hull, memory = found.hull(name), contents[name]["memory"]
        style = palette.RULES_MEMORY if memory else palette.RULES
        yield Series(style, list(_along(hull, _fine(found))), [(p.rate, p.mse) for p in hull])
    if reference:
        hull = lower_hull(reference)
        yield Series(
            _reference_style(found, reference),
            list(_along(hull, [r for r in _fine(found) if r <= hull[-1].rate])),
            [(point.rate, point.mse) for point in hull],
        )
    for name in sorted(names, key=lambda name: contents[name]["memory"]):
        if name in found.classes:
            style = palette.AGENTS_MEMORY if contents[name]["memory"] else palette.AGENTS
            points = found.classes[name]["points"]
            marks = [(point["rate"], point["mse"]) for point in points]
            yield Series(style, marks, marks, list(_band(found, name, marks)))


def _differences(found: Found, names: Sequence[str]) -> Iterator[Differences]:
    """What agents do relative to the rules of their class, by rate."""
    for name in names:
        if name in found.classes:
            content = found.classes[name]
            points = [
                (point["rate"], *(point["difference"][end] for end in ("mean", "low", "high")))
                for point in content["points"]
                if "difference" in point
            ]
            yield Differences(
                palette.AGENTS_MEMORY if content["memory"] else palette.AGENTS, sorted(points)
            )


def _reference_style(found: Found, reference: Sequence[EnvelopePoint]) -> palette.Style:
    style = palette.SCHEDULES if reference is found.known else palette.REFERENCE
    return style._replace(label=reference_label(found, reference))


def reference_label(found: Found, reference: Sequence[EnvelopePoint]) -> str:
    """What computes with the model, in a word."""
    if reference is found.known:
        return "best periodic schedules"
    return "optimum" if found.optimal else "lookahead with the model"


def _band(
    found: Found, name: str, marks: Sequence[tuple[float, float]]
) -> Iterator[tuple[float, float, float]]:
    """The least and the greatest error of training seeds at each price."""
    columns = found.seeds.get(name, ())
    if len(columns) > 1:
        for place, (rate, _) in sorted(enumerate(marks), key=lambda one: one[1]):
            errors = [column[place][1] for column in columns]
            yield rate, min(errors), max(errors)


def _along(hull: Sequence[EnvelopePoint], rates: Sequence[float]) -> Iterator[tuple[float, float]]:
    """The line of an envelope, which bends on logarithmic axes."""
    for rate in rates:
        error = height(hull, rate)
        if error is not None:
            yield rate, error


def _single(found: Found, names: Sequence[str]) -> list[list[tuple[float, float]]]:
    """Each family's tuned rules, on the tuning seeds, in the classes of a panel.

    They are drawn down to the envelope on the test seeds: what was best on the seeds that it was
    tuned on lies lower there, by luck.
    """
    hulls = [found.hull(name) for name in names]
    classes = found.envelopes.get("classes", {})
    own = [classes[name] for name in names if name in classes]
    families = {family for content in own for family in content["families"]}
    options = [{}, *(content["options"] for content in own)]
    return [
        [
            (point["rate"], max(point["mse"], _least(hulls, point["rate"])))
            for point in curve["points"]
        ]
        for curve in found.envelopes.get("curves", ())
        if curve["family"] in families - {MIXED}
        and curve["options"] in options
        and len(curve["points"]) > 1
    ]


def _least(hulls: Sequence[Sequence[EnvelopePoint]], rate: float) -> float:
    """The least error of these envelopes at a rate; zero left of them."""
    heights = [height(hull, rate) for hull in hulls if hull]
    return min([one for one in heights if one is not None], default=0.0)


def _fine(found: Found) -> list[float]:
    always = found.verdict["always"]
    return np.geomspace(LEFT * always, always, FINE).tolist()
