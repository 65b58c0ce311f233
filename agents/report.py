"""Tables and figures of the benchmark's results, as Markdown and as one self-contained page.

    fusion-gym report [--results results] [--pages README.md docs/biased.md …]

Reads the tables in the results folder and writes ``README.md``, figures of all settings together
and of each, and ``report.html`` with the figures inside. What a table says is text there, no
markup.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from fusion_gym.validation import read_text

from .command_line import Command
from .experiments.figures import draw_overview, draw_setting, report_text
from .experiments.report import read_results, update_pages
from .input.options import OutputFolder
from .output.files import write_text
from .output.markup import page_of

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
        text = report_text(value, f"fusion-gym benchmark{quick}")
        draw_overview(self.results, value)
        for name, item in value.items():
            draw_setting(self.results / name, item)
        page, readme = self.results / "report.html", self.results / "README.md"
        write_text(readme, text)
        write_text(page, page_of(text, self.results, TITLE))
        for path, content in pages.items():
            write_text(path, content)
        print(f"wrote {', '.join(map(str, (readme, page, *pages)))}")
