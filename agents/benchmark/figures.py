"""What the figures of the results show: panels of each setting, and all settings in a row."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from agents.benchmark import overview_figure, pareto_figure
from agents.benchmark.envelopes import at_least, rollout_of
from agents.benchmark.markup import page_of
from agents.benchmark.overview_figure import Dot, OverviewRow
from agents.benchmark.pareto_figure import Differences, Limits, Panel, Series
from agents.benchmark.report import (
    KNOWING,
    SettingResults,
    envelopes_text,
    kind_of,
    read_results,
    robustness_text,
    text_of,
    update_pages,
)
from agents.benchmark.verdict import read_cases
from fusion_gym.evaluation.envelope import EnvelopePoint, height, lower_hull
from fusion_gym.output import palette
from fusion_gym.output.files import write_text

FINE = 80  # rates of a curved line
LEFT = 0.04  # of the rate that always transmitting gets: where the figure begins
# Where every measurement's arrival bounds the error, and the figure still reaches so far down.
DEEPEST = 0.3
WIDEST = 0.4  # of the relative differences that are drawn
MIXED = "found before"  # no family of one rule
BROADCAST_LABELS = {"none": "hear nothing", "estimate": "hear estimate", "packets": "hear packets"}


def write_report(results: Path, titles: Mapping[str, str], pages: Mapping[Path, str]) -> None:
    """Write the pages and figures of all tables in the folder, and the marked parts of ``pages``.

    ``titles`` has the title of each of the benchmark's settings.

    Raises:
        ConfigurationError: there are no tables, or one that cannot be read.
    """
    texts: dict[Path, str] = {}
    if any(results.glob("*/classes.csv")):
        texts[results / "envelopes"] = envelopes_text(results)
    if cases := read_cases(results, list(titles)):
        texts[results / "robustness"] = robustness_text(cases, titles)
    if pages or not texts or any(results.glob("*/verdict.*")):
        settings = read_results(results)
        updated = {
            path: update_pages(text, settings, results, titles) for path, text in pages.items()
        }
        texts[results] = report_text(settings)
        draw_overview(results, settings)
        for name, item in settings.items():
            draw_setting(results / name, item)
        html = page_of(texts[results], results, "Results of the benchmark")
        write_text(results / "report.html", html)
        for path, text in updated.items():
            write_text(path, text)
    for folder, text in texts.items():
        write_text(folder / "README.md", text)


def report_text(settings: Mapping[str, SettingResults]) -> str:
    """Return the report, which names the panels of every figure."""
    panels = {
        name: [" ".join(panel.title.split()) for panel in panels_of(results)[1]]
        for name, results in settings.items()
    }
    return text_of(list(settings.values()), panels)


def draw_setting(folder: Path, results: SettingResults) -> None:
    """Draw a setting's figure into its folder, as PNG and as SVG."""
    main, small = panels_of(results)
    paths = [folder / f"pareto.{suffix}" for suffix in ("png", "svg")]
    limits = limits_of(results.always, [main, *small])
    pareto_figure.draw_pareto(paths, results.verdict["title"], main, small, limits)


def panels_of(results: SettingResults) -> tuple[Panel, list[Panel]]:
    """Return the schedulers' panel, and one each for the centre, sensors alone and estimates."""
    grouped: dict[tuple[str, str, str], list[str]] = {}
    for name, content in results.known_classes.items():
        grouped.setdefault(kind_of(content), []).append(name)
    fine = fine_rates(results.always)
    bound = [(rate, at_least(results.bound, rate)) for rate in fine] if results.bound else []

    def panel(title: str, names: list[str], known: Sequence[EnvelopePoint]) -> Panel:
        names = sorted(names, key=lambda name: results.known_classes[name]["memory"])
        series, single = list(_series(results, names, known)), _single(results, names)
        return Panel(title, series, single, bound, None, list(_differences(results, names)))

    main = panel("scheduler", grouped.pop(("sensors", "", "measurement"), []), results.ahead)
    rollout, episodes = rollout_of(results.folder)
    if rollout:
        label = f"improved by simulation\n({episodes} episodes)"
        points = [(point.rate, point.mse) for point in rollout]
        style = palette.ROLLOUT._replace(label=label)
        main = main._replace(series=[*main.series, Series(style, [], points)])
    if results.genie and not bound:
        main = main._replace(level=("everything arrives", float(results.genie["mse"]["mean"])))
    return main, [
        panel(_title(*kind), names, results.known if kind[0] == "centre" else [])
        for kind, names in grouped.items()
    ]


def _title(mode: str, broadcast: str, packet: str) -> str:
    if packet == "estimate":
        return "scheduler,\nsends estimate"
    return (
        "centre,\nsees no signal"
        if mode == "centre"
        else f"sensors alone,\n{BROADCAST_LABELS[broadcast]}"
    )


def limits_of(always: float, panels: Sequence[Panel]) -> Limits:
    """Return limits from 4 % of always transmitting and from the least error that is drawn."""
    left, right = LEFT * always, 1.12 * always
    every = [
        error
        for panel in panels
        for series in panel.series
        for rate, error in (*series.marks, *series.line)
        if left <= rate <= right and error > 0.0
    ]
    least, most = (min(every), max(every)) if every else (0.5, 2.0)
    lows = [least, *(error for panel in panels for _, error in panel.bound if error > 0.0)]
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
    return Limits((left, right), (0.88 * min(lows), 1.15 * most), apart)


def _series(
    results: SettingResults, names: Sequence[str], reference: Sequence[EnvelopePoint]
) -> Iterator[Series]:
    """Yield rules and agents of classes that differ in memory, and what computes with the model."""
    fine = fine_rates(results.always)
    for name in names:
        memory = results.known_classes[name]["memory"]
        style = palette.RULES_MEMORY if memory else palette.RULES
        yield envelope_series(style, results.hull(name), fine)
    if reference:
        hull = lower_hull(reference)
        style, label = palette.SCHEDULES, "best periodic schedules"
        if reference is not results.known:
            style = palette.REFERENCE
            label = "optimum" if results.optimal else "lookahead with the model"
        within = [rate for rate in fine if rate <= hull[-1].rate]
        yield envelope_series(style._replace(label=label), hull, within)
    for name in names:
        if name in results.classes:
            front = results.classes[name]
            style = palette.AGENTS_MEMORY if front["memory"] else palette.AGENTS
            marks = [(point["rate"], point["mse"]) for point in front["points"]]
            yield Series(style, marks, marks, list(_band(results, name, marks)))


def envelope_series(
    style: palette.Style, hull: Sequence[EnvelopePoint], rates: Sequence[float]
) -> Series:
    """Return the line of an envelope, which bends on logarithmic axes, with its vertices."""
    heights = ((rate, height(hull, rate)) for rate in rates)
    line = [(rate, error) for rate, error in heights if error is not None]
    return Series(style, line, [(point.rate, point.mse) for point in hull])


def _band(
    results: SettingResults, name: str, marks: Sequence[tuple[float, float]]
) -> Iterator[tuple[float, float, float]]:
    """Yield the least and the greatest error of training seeds at each price."""
    columns = results.seeds.get(name, ())
    if len(columns) > 1:
        for place, (rate, _) in sorted(enumerate(marks), key=lambda item: item[1]):
            errors = [column[place][1] for column in columns]
            yield rate, min(errors), max(errors)


def _differences(results: SettingResults, names: Sequence[str]) -> Iterator[Differences]:
    """Yield what agents do relative to the rules of their class, by rate."""
    for front in (results.classes[name] for name in names if name in results.classes):
        points = [
            (point["rate"], *(point["difference"][end] for end in ("mean", "low", "high")))
            for point in front["points"]
            if "difference" in point
        ]
        style = palette.AGENTS_MEMORY if front["memory"] else palette.AGENTS
        yield Differences(style, sorted(points))


def _single(results: SettingResults, names: Sequence[str]) -> list[list[tuple[float, float]]]:
    """Return each family's tuned rules, on the tuning seeds, in the classes of a panel.

    They are drawn down to the envelope on the test seeds: what was best on the seeds that it was
    tuned on lies lower there, by luck.
    """
    hulls = [hull for hull in map(results.hull, names) if hull]
    classes = results.envelopes.get("classes", {})
    own = [classes[name] for name in names if name in classes]
    families = {family for content in own for family in content["families"]} - {MIXED}
    options = [{}, *(content["options"] for content in own)]

    def least(rate: float) -> float:
        heights = (height(hull, rate) for hull in hulls)
        return min((error for error in heights if error is not None), default=0.0)

    curves: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for row in results.envelopes.get("curves", ()):
        if row["family"] in families and row["options"] in options:
            point = row["rate"], max(row["mse"], least(row["rate"]))
            curves.setdefault((row["family"], str(row["options"])), []).append(point)
    return [points for points in curves.values() if len(points) > 1]


def fine_rates(always: float) -> list[float]:
    """Return rates for a curve, from 4 % of always transmitting."""
    return np.geomspace(LEFT * always, always, FINE).tolist()


def draw_overview(folder: Path, settings: Mapping[str, SettingResults]) -> None:
    """Draw the overview into the folder, as PNG and as SVG."""
    columns = {
        head: (kind, [_knowing(item, kind) for item in settings.values()])
        for kind, head in KNOWING.items()
    }
    columns["learning"] = ("learning", [_learning(item) for item in settings.values()])
    paths = [folder / f"overview.{suffix}" for suffix in ("png", "svg")]
    labels = [item.label for item in settings.values()]
    overview_figure.draw_overview_figure(paths, labels, columns)


def _knowing(results: SettingResults, kind: str) -> OverviewRow:
    worth = results.worth(kind)
    dots = [Dot(who, worth[who]) for who in ("rules", "agents") if who in worth]
    return OverviewRow(dots, "" if dots else results.reason(kind))


def _learning(results: SettingResults) -> OverviewRow:
    alone = f"local_{results.broadcast}"
    dots = []
    for who, names in (
        ("scheduler", ("sensors_memory", "sensors")),
        ("alone", (f"{alone}_memory", alone)),
        ("centre", ("centre",)),
    ):
        there = [results.classes[name] for name in names if name in results.classes]
        dots += [Dot(who, front["middle"]) for front in there[:1] if "middle" in front]
    return OverviewRow(dots, "" if dots else "no agents")
