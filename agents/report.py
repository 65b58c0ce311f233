"""Tables and figures of the benchmark's results, as Markdown and as one self-contained page.

    fusion-gym report [--results results] [--pages README.md docs/biased.md …]

Reads the JSON in the results folder and writes ``README.md``, figures of all settings together and
of each, and ``report.html`` with the figures inside. What the JSON says is text there, no markup.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import quote

from .command_line import Command, start
from .input.files import read_text
from .input.options import OutputFolder
from .output.files import write_text
from .output.markup import code, page_of, plain, ranged, table
from .suite import overview, report_layers
from .suite.committed import FOLDER
from .suite.found import Found, read_results
from .suite.report_pages import documented
from .suite.report_tables import classes_table, rates_table, worth_table
from .suite.report_words import caption, sentences
from .suite.verdict import RATES

TITLE = "Results of the benchmark"


@dataclass(frozen=True)
class Report(Command):
    """Tables and figures of the benchmark's results, as Markdown and as one HTML page."""

    results: Annotated[Path, OutputFolder()] = Path("results")
    """Folder of the benchmark's JSON, and for what is made of it."""
    pages: tuple[Path, ...] = ()
    """Other pages, as README.md, whose marked parts are made anew."""

    def run(self) -> None:
        """Draw the figures, write README.md and report.html."""
        found = read_results(self.results)
        pages = {
            path: documented(read_text("pages", path), found, self.results) for path in self.pages
        }
        quick = " --quick" if self.results.name == "quick" else ""
        text = text_of(found, f"fusion-gym benchmark{quick}", "fusion-gym report")
        overview.draw(self.results, found)
        for name, one in found.items():
            report_layers.draw(self.results / name, one)
        page, readme = self.results / "report.html", self.results / "README.md"
        write_text(readme, text)
        write_text(page, page_of(text, self.results, TITLE))
        for path, content in pages.items():
            write_text(path, content)
        print(f"wrote {', '.join(map(str, (readme, page, *pages)))}")


def text_of(found: dict[str, Found], command: str, second: str = "fusion-gym report") -> str:
    """The report in Markdown, made by these two commands."""
    lines = [
        f"# {TITLE}",
        "",
        f"Made by `{command}` and `{second}` from the JSON beside this file.",
        "",
        *how_to_read(found),
        *overview_section(found),
        *above_section(found),
    ]
    for one in found.values():
        lines += setting_section(one)
    return "\n".join(lines)


def how_to_read(found: dict[str, Found]) -> list[str]:
    """The report's first section."""
    first = next(iter(found.values())).baselines
    last = first["seed"] + first["episodes"] - 1
    agents = [front["seeds"] for one in found.values() for front in one.classes.values()]
    tuned = [one.envelopes["inputs"]["tuning"] for one in found.values() if one.envelopes]
    validated = [one.validation for one in found.values() if one.validation]
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
    return ranged([one[key] for one in every])


def overview_section(found: dict[str, Found]) -> list[str]:
    """All settings beside each other."""
    text = Path(overview.__file__).with_suffix(".md").read_text(encoding="utf-8")
    return [
        *text.splitlines(),
        *overview.knowing_table(found),
        "What learning is worth, agents against the rules of the same class:",
        "",
        *overview.learning_table(found),
    ]


def above_section(found: dict[str, Found]) -> list[str]:
    """The points at which agents are worse than rules."""
    rows = overview.above_rows(found)
    count = overview.headline_count(found)
    return [
        "## Where agents are worse than rules",
        "",
        f"{count[0].upper()}{count[1:]}{':' if rows else '.'}",
        "",
        *table(["setting", "class", "price", "rate", "difference"], rows),
    ]


def setting_section(found: Found) -> list[str]:
    """A setting's figure, what was found, and its tables."""
    title = f"{plain(found.verdict['title'])}: {code(found.baselines['env'])}, {code(found.name)}."
    panels = [" ".join(p.title.split()) for p in report_layers.panels_of(found)[1]]
    lines = [f"## {plain(found.label)}", "", title, ""]
    lines += [f"- {sentence}" for sentence in sentences(found)]
    lines += ["", f"![Errors against rates: {plain(found.label)}]({quote(found.name)}/pareto.png)"]
    lines += ["", caption(found, panels), ""]
    if found.baselines.get("genie"):
        genie = found.baselines["genie"]
        lines += [f"Genie: MSE {genie['mse']['mean']:.4g}; {plain(genie['assumes'])}.", ""]
    for head, rows in (
        ("Agents by class:", classes_table(found)),
        ("Mean squared error at 5, 10, 20 and 40 % of the rate of always transmitting:",
         rates_table(found)),
        ("What knowing more is worth:", worth_table(found)),
    ):  # fmt: skip
        lines += [head, "", *rows] if rows else []
    return lines


def main() -> None:
    """Entry point; exit status 130 after an interrupt."""
    start(Report)
