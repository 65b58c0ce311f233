"""The benchmark's page, figures and tables."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from rich.table import Table

from agents.benchmark.evidence import (
    Evidence,
    case_rows,
    choice_rows,
    class_rows,
    point_rows,
    policy_rows,
)
from agents.benchmark.settings import CLASSES, Suite
from agents.benchmark.tables import ChoiceRow, ClassRow, PointRow, TestRow, write_rows
from fusion_gym.docstrings import table
from fusion_gym.output import tables
from fusion_gym.output.figures import save_figure
from fusion_gym.output.files import write_text
from fusion_gym.output.palette import READABLE
from fusion_gym.version import __version__

ERROR = "error a step, in the reward's weights"
HEADLINE = "tobit_oscillator", "scheduler"  # the class of README's figure
GAIN = 0.01  # a difference that the sentences name
README = Path("README.md")
TITLES = {"centre": "fusion centre", "local": "local sensors", "scheduler": "centralised scheduler"}
LINES = {  # kind: label, colour, marker
    "trigger": ("own trigger, scaled", "tab:gray", "v"),
    "threshold": ("best rule with one threshold", "tab:blue", "o"),
    "rule": ("searched rule", "black", "s"),
    "agent": ("agents", "tab:orange", "^"),
    "optimum": ("optimum", "tab:green", "*"),
    "bound": ("proven bound", "tab:red", "_"),
}


def write_results(suite: Suite, classes: Sequence[Evidence], folder: Path) -> None:
    """Write all tables, a figure per setting, the page, and README's table."""
    folder.mkdir(parents=True, exist_ok=True)
    policies, points = policy_rows(suite, classes), point_rows(suite, classes)
    means, choices = class_rows(classes), choice_rows(classes)
    cases = case_rows([item for item in classes if item.name == "scheduler"])
    for rows in (policies, points, means, choices, cases):
        write_rows(folder, rows)
    for setting in suite.settings:
        own = [row for row in policies if row.setting == setting.name]
        draw_setting(own, setting.title, folder / f"{setting.name}.png")
    for item in classes:
        if (item.setting.name, item.name) == HEADLINE:
            draw_headline(policies, item, folder / "readme.png")
    titles = {setting.name: setting.title for setting in suite.settings}
    headline = headline_text(titles, means)
    page = [
        "# Benchmark",
        f"Results of `make benchmark` in version {__version__}: {suite.episodes:,} test episodes, "
        f"{suite.training_seeds} training seeds. [Method](../docs/benchmark.md).",
        headline,
        "\n".join(f"- {text}" for text in sentences(means, points)),
        "## Classes",
        "Mean over five prices of the cost over the searched rule's cost; negative: cheaper.",
        class_table(titles, means, choices),
        "## Searched rules",
        table(
            ("setting", "class", "policy"),
            ((titles[row.setting], TITLES[row.name], f"`{row.rule}`") for row in choices),
        ),
        "## Wrong models",
        "The scheduler's searched rule and the best agent in validation, at the three middle "
        "prices: the rule's cost over its cost with a true model, and the agent's cost over the "
        "rule's.",
        table(
            ("setting", "case", "rule", "agent"),
            ((titles[r.setting], r.case, f"{r.rule:+.0%}", relative_text(r)) for r in cases),
        ),
        *(
            f"## {title}\n\n![Error against tokens a step, by class]({name}.png)"
            for name, title in titles.items()
        ),
    ]
    write_text(folder / "README.md", "\n\n".join(page) + "\n")
    if folder == Path("results"):
        text = README.read_text(encoding="utf-8")
        part = f"<!-- results: headline -->\n{headline}\n<!-- end -->"
        pattern = r"<!-- results: headline -->.*?<!-- end -->"
        write_text(README, re.sub(pattern, lambda _: part, text, flags=re.DOTALL))


def relative_text(row: ClassRow | PointRow | ChoiceRow | object) -> str:
    """Return a difference with its interval, in per cent."""
    mean, low, high = (100.0 * getattr(row, name) for name in ("difference", "low", "high"))
    interval = "" if low == high else f" [{low:+.1f}, {high:+.1f}]"
    return f"{mean:+.1f}{interval}".replace("-", "−")


def headline_text(titles: dict[str, str], rows: Sequence[ClassRow]) -> str:
    """Return the table of agents relative to searched rules, settings by classes."""
    agents = {(row.setting, row.name): relative_text(row) for row in rows if row.kind == "agent"}
    cells = (
        (title, *(agents.get((name, column), "–") for column in CLASSES))
        for name, title in titles.items()
    )
    head = ("cost of agents over the searched rule's, %", *TITLES.values())
    medians = {
        kind: np.median([row.difference for row in rows if row.kind == kind] or [np.nan])
        for kind in ("trigger", "threshold", "agent")
    }
    text = (
        "Negative: the agent is better. In the median class the setting's own trigger, scaled, "
        f"costs {medians['trigger']:+.1%} over the searched rule, the best rule with one threshold "
        f"{medians['threshold']:+.1%}, and an agent {medians['agent']:+.1%}."
    )
    return f"{table(head, cells)}\n\n{text.replace('-', '−')}"


def class_table(
    titles: dict[str, str], rows: Sequence[ClassRow], choices: Sequence[ChoiceRow]
) -> str:
    """Return the table of every kind of policy relative to the searched rule."""
    by_kind = {(row.setting, row.name, row.kind): relative_text(row) for row in rows}
    kinds = [kind for kind in LINES if kind != "rule"]
    lines = []
    for row in choices:
        cells = [by_kind.get((row.setting, row.name, kind), "–") for kind in kinds]
        memory = "–" if np.isnan(row.memory) else f"{row.memory:+.1%}".replace("-", "−")
        best = f"{row.choice} {relative_text(row)}" if row.choice != "rule" else "rule"
        lines.append((titles[row.setting], TITLES[row.name], *cells, best, memory))
    heads = (LINES[kind][0] for kind in kinds)
    return table(("setting", "class", *heads, "validation chooses", "without memory"), lines)


def sentences(rows: Sequence[ClassRow], points: Sequence[PointRow]) -> list[str]:
    """Return the sentences on the gains of the search and of agents."""

    def mean(kind: str) -> str:
        values = [row.difference for row in rows if row.kind == kind]
        over = f"{np.mean(values):+.1%} in the mean over {len(values)} classes"
        ends = f"{min(values):+.1%} to {max(values):+.1%}"
        return f"{over} (median {np.median(values):+.1%}, {ends})".replace("-", "−")

    def places(sign: int) -> str:
        """Return the classes where agents differ by more than the gain, with a whole interval."""
        count = [
            f"{row.setting.replace('_', ' ')} ({TITLES[row.name]})"
            for row in rows
            if row.kind == "agent"
            and sign * row.difference >= GAIN
            and min(sign * row.low, sign * row.high) > 0.0
        ]
        return ", ".join(count) or "none"

    counted = [point for point in points if point.kind == "agent" and point.discovery]
    fewer = sum(point.difference < 0 for point in counted)
    return [
        "The settings' own triggers (the papers', and what devices run), scaled by one number, "
        f"cost {mean('trigger')} more than the searched rule.",
        f"The best rule with one threshold, tuned at each price, costs {mean('threshold')} more.",
        f"Agents cost {mean('agent')} more; they are cheaper at {fewer} points and dearer at "
        f"{len(counted) - fewer}, with a false discovery rate of 5 %.",
        f"Agents gain at least {GAIN:.0%}, with a whole interval, in: {places(-1)}.",
        f"Agents lose at least {GAIN:.0%}, with a whole interval, in: {places(1)}.",
    ]


def draw_setting(rows: Sequence[TestRow], title: str, path: Path) -> None:
    """Draw error against tokens per step, one panel per class."""
    plt.rcParams.update(READABLE)
    names = list(dict.fromkeys(row.name for row in rows))
    figure, panels = plt.subplots(1, len(names), figsize=(4.2 * len(names), 3.6), squeeze=False)
    for panel, name in zip(panels[0], names, strict=True):
        draw_class(panel, [row for row in rows if row.name == name])
        panel.set(title=TITLES[name])
    panels[0][0].set_ylabel(ERROR)
    figure.suptitle(title)
    figure.tight_layout(rect=(0.0, 0.08, 1.0, 1.0))
    figure.legend(*panels[0][-1].get_legend_handles_labels(), loc="lower center", ncols=5)
    save_figure(figure, path)


def draw_headline(rows: Sequence[TestRow], item: Evidence, path: Path) -> None:
    """Draw one class and its proven bound: error >= max over prices of (bound - price · tokens)."""
    plt.rcParams.update(READABLE)
    figure, panel = plt.subplots(figsize=(7.0, 4.4))
    draw_class(
        panel, [row for row in rows if (row.setting, row.name) == (item.setting.name, item.name)]
    )
    if item.bounds:
        label, colour, _ = LINES["bound"]
        tokens = np.geomspace(*panel.get_xlim(), 200)
        errors = np.max(np.array(item.bounds) - np.multiply.outer(tokens, item.prices), axis=1)
        panel.plot(tokens[errors > 0], errors[errors > 0], "--", color=colour, label=label)
    panel.set(ylabel=ERROR, title=f"{item.setting.title}, {TITLES[item.name]}")
    panel.legend()
    figure.tight_layout()
    save_figure(figure, path)


def draw_class(panel: Axes, rows: Sequence[TestRow]) -> None:
    """Draw error against tokens per step in one class, a line for each policy and seed."""
    for kind, (label, colour, marker) in LINES.items():
        own = [row for row in rows if row.kind == kind]
        for seed in sorted({row.seed for row in own}):
            line = [row for row in own if row.seed == seed]
            panel.plot(
                [row.tokens for row in line], [row.error for row in line], color=colour,
                marker=marker, markersize=5, linewidth=1, label=label if seed == 0 else None,
            )  # fmt: skip
    panel.set(xscale="log", yscale="log", xlabel="tokens a step")
    if any(row.tokens == 0.0 for row in rows):  # at a tick of its own, left of the others
        least = min(row.tokens for row in rows if row.tokens > 0.0)
        panel.set_xscale("symlog", linthresh=least, linscale=0.3)
        ends = -0.2 * least, panel.get_xlim()[1]
        decades = 10.0 ** np.arange(np.ceil(np.log10(least)), np.log10(ends[1]))
        panel.set(xticks=[0.0, *decades], xlim=ends)
    panel.xaxis.set_minor_formatter("")


def print_classes(rows: Sequence[ClassRow], points: Sequence[PointRow]) -> None:
    """Print the mean differences to the searched rule, and the difference at each price."""
    shares = sorted({point.share for point in points}, reverse=True)
    heads = ("setting", "class", "kind", "all prices", *(f"{share:.0%}" for share in shares))
    result = Table(*heads, title="cost over the searched rule's, %; negative: cheaper")
    for row in rows:
        own = {
            p.share: p
            for p in points
            if (p.setting, p.name, p.kind) == (row.setting, row.name, row.kind)
        }
        result.add_row(
            row.setting, row.name, row.kind, relative_text(row),
            *(f"{100 * own[share].difference:+.1f}" if own else "–" for share in shares),
        )  # fmt: skip
    tables.console().print(result)
