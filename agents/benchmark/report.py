"""The benchmark's page, figures and tables."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from agents.benchmark import evidence
from agents.benchmark.evidence import CALIBRATED
from agents.benchmark.settings import CLASSES, Setting, Suite
from fusion_gym.arrays import Array
from fusion_gym.docstrings import table
from fusion_gym.output.figures import plain_tick, save_figure
from fusion_gym.output.files import replacing, write_text
from fusion_gym.output.palette import READABLE
from fusion_gym.version import __version__

Groups = dict[tuple[str, str, str], list[evidence.TrainingRow]]
GAIN = 0.01  # a difference that the sentences name, and between a mean and a median
README = Path("README.md")
TITLES = {"centre": "fusion centre", "local": "local sensors", "scheduler": "centralised scheduler"}
KNOWLEDGE = {
    "centre": "what it received, before it requests a measurement",
    "local": "each sensor by its own measurements and what the centre broadcasts",
    "scheduler": "the measurements of all sensors and what the centre received",
}


class Style(NamedTuple):
    """Label, colour and marker of a kind of policy."""

    label: str
    colour: str
    marker: str


STYLES = {
    "printed": Style("trigger as printed", "tab:gray", "v"),
    "trigger": Style("tuned trigger", "tab:gray", "v"),
    "threshold": Style("one threshold", "tab:blue", "o"),
    "thresholds": Style("a threshold per sensor", "tab:blue", "D"),
    "rule": Style("searched rule", "black", "s"),
    "informed": Style("searched rule of a scheduler", "black", "o"),
    "learned": Style("learned policy", "tab:orange", "^"),
    "optimum": Style("optimum", "tab:green", "*"),
    "bound": Style("proven bound", "tab:red", "_"),
}


class Results(NamedTuple):
    """All rows of the benchmark."""

    policies: list[evidence.TestRow]
    points: list[evidence.PointRow]
    classes: list[evidence.ClassRow]
    savings: list[evidence.SavingRow]
    trainings: list[evidence.TrainingRow]
    cases: list[evidence.CaseRow]


def write_results(suite: Suite, classes: Sequence[evidence.Evidence], folder: Path) -> None:
    """Write all tables, a figure per setting, the page, and README's table."""
    folder.mkdir(parents=True, exist_ok=True)
    results = Results(
        evidence.policy_rows(suite, classes),
        evidence.point_rows(suite, classes),
        evidence.class_rows(classes),
        evidence.saving_rows(classes),
        evidence.training_rows(classes),
        evidence.case_rows([item for item in classes if item.name == "scheduler"]),
    )
    for name, rows in results._asdict().items():
        with replacing(folder / f"{name}.csv") as partial:
            pd.DataFrame(rows).to_csv(
                partial, index=False, float_format="%.6g", na_rep="nan", lineterminator="\n"
            )
    titles = {setting.name: setting.title for setting in suite.settings}
    for name, title in titles.items():
        draw_setting([row for row in results.policies if row.setting == name], title, folder)
    headline = headline_text(suite.settings, results)
    others = any(row.kind == "other" for row in results.trainings)
    named = {kind for setting in suite.settings for kind in setting.named_rules}
    page = [
        f"# {suite.title}",
        f"Results of `{suite.command}` in version {__version__}: {suite.episodes:,} test episodes, "
        f"{suite.training_seeds} trainings of an agent by each algorithm. "
        f"[Method]({'../' * len(folder.parts)}docs/benchmark.md).",
        headline,
        "## Against the best rule",
        "Cost relative to the tuned rule that costs least in tuning at the same price, %; a "
        "negative number is cheaper. Each entry is the mean over five prices, seeds and episodes. "
        "A knowledge class says what decides, and by what:",
        "\n".join(f"- **{TITLES[name]}**: {KNOWLEDGE[name]}." for name in CLASSES),
        class_table(titles, results),
        "\n".join(f"- {text}" for text in sentences(results)),
        "## Two algorithms" if others else "",
        "Where two algorithms train, their agents alone and calibrated with the searched rule: "
        "processor seconds of one training, and cost relative to the best rule, %."
        if others
        else "",
        comparison_table(titles, results) if others else "",
        "## Rules of the literature" if named else "",
        table(
            ("task", "rule with one tuned threshold", "cost relative to the best rule, %"),
            ((titles[r.setting], r.kind, mean_text(r)) for r in results.classes if r.kind in named),
        )
        if named
        else "",
        "## Searched rules",
        table(
            ("task", "knowledge class", "policy"),
            ((i.setting.title, TITLES[i.name], f"`{i.priced_rule}`") for i in classes),
        ),
        "## Wrong models",
        "The scheduler's best rule and learned policy run in plants that differ from the model, at "
        "the three middle prices: cost of the rule relative to its cost with a true model, and of "
        "the learned policy relative to the rule, %.",
        table(
            ("task", "case", "rule", "learned policy"),
            (
                (titles[r.setting], r.case, signed_percent(r.rule, 0), interval(r, r.difference))
                for r in results.cases
            ),
        ),
        *(
            f"## {title}\n\n![Error against tokens per step, by knowledge class]({name}.png)"
            for name, title in titles.items()
        ),
    ]
    write_text(folder / "README.md", "\n\n".join(filter(None, page)) + "\n")
    if folder == Path("results"):
        text = README.read_text(encoding="utf-8")
        part = f"<!-- results: headline -->\n{headline}\n<!-- end -->"
        pattern = r"<!-- results: headline -->.*?<!-- end -->"
        write_text(README, re.sub(pattern, lambda _: part, text, flags=re.DOTALL))


def signed_percent(value: float, digits: int = 1) -> str:
    """Return a share in per cent, with its sign."""
    return f"{round(100.0 * value, digits) + 0.0:+.{digits}f}".replace("-", "−")


def interval(
    row: evidence.PointRow | evidence.ClassRow | evidence.SavingRow | evidence.CaseRow, value: float
) -> str:
    """Return a value in per cent with half the width of its row's interval."""
    half = 50.0 * (row.high - row.low)
    return signed_percent(value) + (f" ± {half:.1f}" if half > 0.0 else "")


def headline_text(settings: Sequence[Setting], results: Results) -> str:
    """Return the table of what tuning, knowledge and learning save, a row for each setting."""
    kinds = "printed", "thresholds", "rule", "informed", "learned", "bound"
    shares = len({row.share for row in results.policies})
    by_kind = {(row.setting, row.kind): row for row in results.savings}
    every = [row for row in results.trainings if row.best]
    cells = []
    for setting in settings:
        own = [by_kind.get((setting.name, kind)) for kind in kinds]
        savings = [interval(row, row.saving).removeprefix("+") if row else "–" for row in own]
        place = setting.name, setting.headline
        points = [row.rule_points for row in every if (row.setting, row.name) == place]
        knows = f"{setting.trigger_title}, {TITLES[setting.headline]}"
        cells.append((setting.title, knows, *savings, f"{np.mean(points):.1f}"))
    medians = (
        100.0 * float(np.median([r.saving for r in results.savings if r.kind == kind] or [np.nan]))
        for kind in kinds[:4]
    )
    printed, thresholds, rule, informed = medians
    published = f"the parameters as printed cost {-printed:.0f} % more than tuned ones, "
    scheduled = "; if a scheduler sees the measurements of all sensors, the rule saves "
    gains = [-row.difference for row in results.classes if row.kind == "learned"]
    text = (
        "Cost that a policy saves against the task's trigger, whose parameters are tuned with as "
        "many episodes as the searched rule: %, with a 95 % bootstrap interval over seeds and "
        "episodes. Each entry is the mean over five prices, at equal knowledge.\n\n"
        f"In the median task, {'' if math.isnan(printed) else published}one threshold per sensor "
        f"saves {thresholds:.0f} % of the tuned trigger's cost, and the searched rule {rule:.0f} %"
        f"{'' if math.isnan(informed) else f'{scheduled}{informed:.0f} %'}. A learned policy costs "
        f"{100.0 * float(np.median(gains or [np.nan])) + 0.0:.1f} % less than the best tuned rule "
        f"in the median of {len(gains)} combinations of task and knowledge class, and at most "
        f"{100.0 * max(gains, default=np.nan) + 0.0:.1f} % less. At "
        f"{sum(row.rule_points for row in every)} of {len(every) * shares} points it is that rule, "
        "because no agent was clearly cheaper in tuning."
    )
    labels = [STYLES[kind].label for kind in kinds[:-1]]
    heads: Sequence[str] = ("task", "tuned trigger, its knowledge class", *labels)
    heads = *heads, "no policy saves more than", "prices at which it is a rule"
    return f"{table(heads, cells)}\n\n{text}"


def class_table(titles: dict[str, str], results: Results) -> str:
    """Return the table of every kind of policy relative to the best tuned rules."""
    by_kind = {(row.setting, row.name, row.kind): row for row in results.classes}
    shares = len({row.share for row in results.policies})
    lines = []
    for place in dict.fromkeys((row.setting, row.name) for row in results.classes):
        cells = [
            mean_text(by_kind.get((*place, kind)))
            for kind in ("learned", "agent", "rule", "threshold", "thresholds", "trigger")
        ]
        best = by_kind.get((*place, "optimum")) or by_kind.get((*place, "bound"))
        limit = f"{best.kind} {mean_text(best)}" if best else "–"
        trainings = [row for row in results.trainings if (row.setting, row.name) == place]
        own = [row for row in trainings if row.best]
        algorithms = ", ".join(dict.fromkeys(row.algorithm for row in trainings))
        rule = f"{sum(row.rule_points for row in own)} of {len(own) * shares}"
        lines.append((titles[place[0]], TITLES[place[1]], algorithms, *cells, limit, rule))
    heads = (
        "task, knowledge class, trained by, learned policy, agents alone, searched rule, "
        "one threshold, a threshold per sensor, tuned trigger, optimum or bound, points with a rule"
    )
    return table(tuple(heads.split(", ")), lines)


def mean_text(row: evidence.ClassRow | None) -> str:
    """Return a mean with its interval, and with the median where an outlier moves the mean."""
    if row is None:
        return "–"
    moved = abs(row.difference - row.median) >= GAIN
    return interval(row, row.difference) + (
        f" (median {signed_percent(row.median)})" if moved else ""
    )


def comparison_table(titles: dict[str, str], results: Results) -> str:
    """Return the table of both algorithms in the classes where there are two."""
    by_kind = {(row.setting, row.name, row.kind): row for row in results.classes}
    trainings = grouped(results.trainings)
    lines = [
        (
            *(titles[setting], TITLES[name], own[0].algorithm),
            f"{np.mean([row.seconds for row in own]):.0f}",
            *(mean_text(by_kind[setting, name, item]) for item in (kind, CALIBRATED[kind])),
        )
        for (setting, name, kind), own in trainings.items()
        if (setting, name, "other") in trainings
    ]
    heads = "task", "knowledge class", "algorithm", "seconds", "agents alone", "calibrated"
    return table(heads, lines)


def grouped(rows: Sequence[evidence.TrainingRow]) -> Groups:
    """Return the trainings of each setting, class and kind."""
    result: Groups = {}
    for row in rows:
        result.setdefault((row.setting, row.name, row.kind), []).append(row)
    return result


def sentences(results: Results) -> list[str]:
    """Return the sentences on the gains of learned policies."""
    rows = {kind: [r for r in results.classes if r.kind == kind] for kind in ("learned", "agent")}

    def mean(kind: str) -> str:
        values = [row.difference for row in rows[kind]]
        ends = f"{signed_percent(min(values))} to {signed_percent(max(values))}"
        middle = signed_percent(float(np.median(values)))
        return f"{signed_percent(float(np.mean(values)))} % (median {middle} %, {ends} %)"

    def places(sign: int) -> str:
        """Return the classes whose difference exceeds the gain, with a whole interval."""
        count = [
            f"{row.setting.replace('_', ' ')} ({TITLES[row.name]})"
            for row in rows["learned"]
            if sign * row.difference >= GAIN and min(sign * row.low, sign * row.high) > 0.0
        ]
        return ", ".join(count) or "none"

    points = [point for point in results.points if point.kind == "learned"]
    fewer = sum(point.discovery and point.difference < 0.0 for point in points)
    more = sum(point.discovery and point.difference > 0.0 for point in points)
    best = pd.DataFrame([row for row in results.trainings if row.best])
    costs = best.groupby(["setting", "name"]).learned.apply(list).tolist()
    near = sum(max(own) - min(own) <= 0.02 for own in costs)
    return [
        f"The mean over {len(costs)} rows is {mean('learned')} for learned policies and "
        f"{mean('agent')} for agents alone.",
        f"Learned policies are cheaper at {fewer} of {len(points)} points and dearer at {more}, "
        "with a false discovery rate of 5 %.",
        f"They gain at least {100 * GAIN:.0f} %, with a whole interval, in: {places(-1)}.",
        f"They lose at least {100 * GAIN:.0f} %, with a whole interval, in: {places(1)}.",
        f"Trainings of one row differ by at most 2 points in {near} of {len(costs)} rows.",
    ]


def mean_line(rows: Sequence[evidence.TestRow], kind: str) -> Array:
    """Return price, cost, error and tokens (4, prices) of a kind, as means over seeds."""
    own = [(row.price, row.cost, row.error, row.tokens) for row in rows if row.kind == kind]
    prices = sorted({item[0] for item in own})
    line = [np.mean([item for item in own if item[0] == price], axis=0) for price in prices]
    return np.array(line).reshape(-1, 4).T


def draw_setting(rows: Sequence[evidence.TestRow], title: str, folder: Path) -> None:
    """Draw error against tokens per step, one panel per class."""
    plt.rcParams.update(READABLE)
    names = list(dict.fromkeys(row.name for row in rows))
    figure, panels = plt.subplots(1, len(names), figsize=(4.2 * len(names), 3.6), squeeze=False)
    labels: dict[str, Line2D] = {}
    for panel, name in zip(panels[0], names, strict=True):
        labels |= draw_class(panel, [row for row in rows if row.name == name])
        panel.set(title=TITLES[name])
    panels[0][0].set_ylabel("error per step")
    figure.suptitle(title)
    figure.tight_layout(rect=(0.0, 0.08, 1.0, 1.0))
    figure.legend(list(labels.values()), list(labels), loc="lower center", ncols=5)
    save_figure(figure, folder / f"{rows[0].setting}.png")


def draw_class(panel: Axes, rows: Sequence[evidence.TestRow]) -> dict[str, Line2D]:
    """Draw error against tokens in one class, and return the lines by label."""
    labels = {}
    for kind in ("trigger", "rule", "learned", "optimum"):
        label, colour, marker = STYLES[kind]
        _, _, error, tokens = mean_line(rows, kind)
        if len(error):
            line = np.array([tokens, error])[:, np.argsort(tokens)]
            (labels[label],) = panel.plot(*line, color=colour, marker=marker, lw=1, ms=5)
    least = min(row.tokens for row in rows if row.tokens > 0.0)
    panel.set_xscale("symlog", linthresh=10.0 ** math.floor(math.log10(least)), linscale=0.5)
    panel.set(yscale="log", xlabel="tokens per step", xlim=(0.0, None))
    panel.xaxis.set_major_formatter("{x:g}")
    panel.yaxis.set(major_formatter=plain_tick, minor_formatter=plain_tick)
    return labels


def print_classes(rows: Sequence[evidence.ClassRow], points: Sequence[evidence.PointRow]) -> None:
    """Print the mean differences to the best rule, and the difference at each price."""
    places = ["setting", "name", "kind"]
    each = pd.DataFrame(points).pivot(index=places, columns="share", values="difference")
    each = each[each.columns[::-1]].map(signed_percent).rename(columns="{:.0%}".format)
    means = {(row.setting, row.name, row.kind): mean_text(row) for row in rows}
    result = pd.Series(means, name="all prices").rename_axis(places).to_frame().join(each)
    print("cost relative to the best rule, %; negative: cheaper")
    print(result.fillna("–").to_string())
