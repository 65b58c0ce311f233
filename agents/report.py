"""Tables and figures of the benchmark's results, as Markdown and as one self-contained page.

    fusion-gym report [--results results] [--pages README.md docs/biased.md …]

Reads the tables in the results folder and writes ``README.md``, figures of all settings together
and of each, and ``report.html`` with the figures inside. What a table says is text there, no
markup.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import quote

from .command_line import Command
from .input.files import read_text
from .input.options import OutputFolder
from .output.files import write_text
from .output.markup import code, page_of, plain_text, ranged, table_markup
from .suite import overview, report_layers
from .suite.committed import FOLDER
from .suite.report_pages import update_pages
from .suite.report_tables import classes_table, rates_table, worth_table
from .suite.report_words import caption, sentences
from .suite.setting_results import SettingResults, read_results
from .suite.verdict import RATES

TITLE = "Results of the benchmark"


@dataclass(frozen=True)
class Report(Command):
    """Tables and figures of the benchmark's results, as Markdown and as one HTML page."""

    results: Annotated[Path, OutputFolder()] = Path("results")
    """Folder of the benchmark's tables, and for what is made of them."""
    pages: tuple[Path, ...] = ()
    """Other pages, as README.md, whose marked parts are made anew."""

    def run(self) -> None:
        """Draw the figures, write README.md and report.html."""
        value = read_results(self.results)
        pages = {
            path: update_pages(read_text("pages", path), value, self.results) for path in self.pages
        }
        quick = " --quick" if self.results.name == "quick" else ""
        text = text_of(value, f"fusion-gym benchmark{quick}", "fusion-gym report")
        overview.draw_overview(self.results, value)
        for name, item in value.items():
            report_layers.draw_layers(self.results / name, item)
        page, readme = self.results / "report.html", self.results / "README.md"
        write_text(readme, text)
        write_text(page, page_of(text, self.results, TITLE))
        for path, content in pages.items():
            write_text(path, content)
        print(f"wrote {', '.join(map(str, (readme, page, *pages)))}")


def text_of(
    value: dict[str, SettingResults], command: str, second: str = "fusion-gym report"
) -> str:
    """The report in Markdown, made by these two commands."""
    lines = [
        f"# {TITLE}",
        "",
        f"Made by `{command}` and `{second}` from the tables of the settings beside this file.",
        "",
        *how_to_read(value),
        *overview_section(value),
        *above_section(value),
    ]
    for item in value.values():
        lines += setting_section(item)
    return "\n".join(lines)


def how_to_read(settings: dict[str, SettingResults]) -> list[str]:
    """The report's first section."""
    first = next(iter(settings.values())).baselines
    last = first["seed"] + first["episodes"] - 1
    agents = [front["seeds"] for setting in settings.values() for front in setting.classes.values()]
    tuned = [item.envelopes["inputs"]["tuning"] for item in settings.values() if item.envelopes]
    validated = [setting.validation for setting in settings.values() if setting.validation]
    seeds = [f"Test: {first['seed']:,} to {last:,}, the same noise for all."]
    if tuned:
        seeds.append(
            f"Tuning: {_of(tuned, 'seeds')} searches of {_of(tuned, 'episodes')} episodes each, "
            f"from {_of(tuned, 'seed')} on."
        )
    if validated:
        seeds.append(
            f"Validation, which chooses the moment of a training that is kept: "
            f"{_of(validated, 'episodes')} episodes from {_of(validated, 'seed')} on."
        )
    number = f"{ranged(agents)} training seeds" if agents else "none so far"
    seeds.append(f"Agents of a class: {number}.")
    text = Path(overview.__file__).with_name("report_intro.md").read_text(encoding="utf-8")
    text = text.format(folder=FOLDER, seeds=" ".join(seeds), rates=RATES)
    return text.split("\n")


def _of(every: Sequence[Mapping[str, Any]], key: str) -> str:
    return ranged([item[key] for item in every])


def overview_section(settings: dict[str, SettingResults]) -> list[str]:
    """All settings beside each other."""
    text = Path(overview.__file__).with_suffix(".md").read_text(encoding="utf-8")
    return [
        *text.splitlines(),
        *overview.knowing_table(settings),
        "What learning is worth, agents against the rules of the same class:",
        "",
        *overview.learning_table(settings),
    ]


def above_section(settings: dict[str, SettingResults]) -> list[str]:
    """The points at which agents are worse than rules."""
    rows = overview.above_rows(settings)
    count = overview.headline_count(settings)
    return [
        "## Where agents are worse than rules",
        "",
        f"{count[0].upper()}{count[1:]}{':' if rows else '.'}",
        "",
        *table_markup(["setting", "class", "price", "rate", "difference"], rows),
    ]


def setting_section(value: SettingResults) -> list[str]:
    """A setting's figure, what was found, and its tables."""
    title = (
        f"{plain_text(value.verdict['title'])}: {code(value.baselines['env'])}, {code(value.name)}."
    )
    panels = [" ".join(p.title.split()) for p in report_layers.panels_of(value)[1]]
    lines = [f"## {plain_text(value.label)}", "", title, ""]
    lines += [f"- {sentence}" for sentence in sentences(value)]
    lines += [
        "",
        f"![Errors against rates: {plain_text(value.label)}]({quote(value.name)}/pareto.png)",
    ]
    lines += ["", caption(value, panels), ""]
    if value.baselines.get("genie"):
        genie = value.baselines["genie"]
        lines += [f"Genie: MSE {genie['mse']['mean']:.4g}; {plain_text(genie['assumes'])}.", ""]
    for head, rows in (
        ("Agents by class:", classes_table(value)),
        ("Mean squared error at 5, 10, 20 and 40 % of the rate of always transmitting:",
         rates_table(value)),
        ("What knowing more is worth:", worth_table(value)),
    ):  # fmt: skip
        lines += [head, "", *rows] if rows else []
    return lines
