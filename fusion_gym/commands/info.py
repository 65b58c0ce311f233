"""Show the page of an environment, rule, filter, signal, agent or config, or a log's data card.

    fusion-gym info fusion_gym/LinearFusion-v2
    fusion-gym info value_of_information
    fusion-gym info mast

``fusion-gym list`` shows all names. The path of a CSV file, ``mast`` and ``tanks`` are logs. The
data card of a log has rates, gaps, saturation and faults of the channels.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import tyro
from pylatexenc.latex2text import LatexNodes2Text, MacroTextSpec, get_default_latex_context_db
from rich.console import Console, ConsoleOptions, RenderResult
from rich.markdown import Markdown, TableElement
from rich.table import Table

from fusion_gym.commands.command_line import Command, OutputFile
from fusion_gym.commands.fit import LogOptions
from fusion_gym.commands.list import catalogue
from fusion_gym.docstrings import plain_marks
from fusion_gym.envs.registration import base_of, present_id
from fusion_gym.output.progress import writing
from fusion_gym.output.tables import console
from fusion_gym.validation import nearest, refusal


@dataclass(frozen=True)
class Info(LogOptions, Command):
    """Show the page of an environment, rule, filter, signal, agent or config, or a log's card."""

    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]
    """A name of fusion-gym list, or the CSV file of a log; an environment's name may omit
    fusion_gym/ and the version, and module:id imports the module first."""
    picture: Annotated[Path | None, OutputFile(".png", ".pdf", ".svg")] = None
    """File for a picture of the log."""

    def run(self) -> None:
        """Print the page of every entry of this name, or the card of the log."""
        is_own = re.fullmatch(r"[\w.]+:[\w/-]+", self.name)
        name, registered = base_of(self.name) if is_own else (present_id(self.name), {})
        entries = catalogue()
        names = [entry for named in entries.values() for entry in named]
        is_log = name in ("mast", "tanks") or ".csv" in Path(name).suffixes
        if name not in names and (is_log or Path(name).is_file()):
            self.show_log()
            return
        picture = None if self.picture is None else str(self.picture)
        for option, value in {"picture": picture, **self.reading}.items():
            if value:
                raise refusal(option, value, "left out with a name that is no log")
        if name not in names:
            hint = f"; did you mean {nearest(name, names)!r}?" if nearest(name, names) else ""
            raise refusal("name", name, f"a CSV file or a name of fusion-gym list{hint}")
        for kind, named in entries.items():
            if name in named:
                print(plain_text(f"# {name} ({kind})\n\n{named[name].page()}", console()))
        if registered:
            print(f"{self.name} is {name} with {registered}")

    def show_log(self) -> None:
        """Print the data card of a log, and draw its readings if there is a file for them."""
        from fusion_gym.recordings import Recording, field_report

        recording = Recording.read(self.name, **self.reading)
        print("\n".join(field_report.card_lines(recording)))
        console().print(field_report.card_table(recording))
        if self.picture is not None:
            writing(("picture", self.picture))
            field_report.draw_card(recording, self.picture)


_WORDS = {r"\\mathsf\s+T": "T", r"\\iff": " ⇔ ", r"\\(arg|det)": r"\1 ", r"\\Pr": "Pr"}
_LOW = str.maketrans("0123456789+-=ijkmst", "₀₁₂₃₄₅₆₇₈₉₊₋₌ᵢⱼₖₘₛₜ", "{}")
_HIGH = str.maketrans("0123456789+-Tkmh", "⁰¹²³⁴⁵⁶⁷⁸⁹⁺⁻ᵀᵏᵐʰ", "{}")
_SUBSCRIPT = re.compile(r"_([\dijkmst]|{[\d+\-=ijkmst]+})")
_SUPERSCRIPT = re.compile(r"\^([\dTkmh]|{[\d+\-Tkmh]+})")


def plain_text(page: str, terminal: Console) -> str:
    """Return a page of Markdown as console text, without ticks, roles and LaTeX."""
    text = re.sub(r"\s*\$\$(.*?)\$\$", lambda formula: _line(formula[1]), page, flags=re.DOTALL)
    text = re.sub(r"(?m)^    .*", lambda line: line[0].replace("`", ""), plain_marks(text))
    text = re.sub(r"(?m)^    (\w+: .* = .*)\n        (.*)", r"- \1\n\n  \2", text)
    text = re.sub(r"\[\w+\]\((\w+\.md)\)", r"docs/\1", text)
    with terminal.capture() as output:
        terminal.print(_Page(text), width=min(terminal.width, 100))
    return re.sub(r"(?m) +$", "", output.get())


class _Table(TableElement):
    """A table that folds long names."""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for result in super().__rich_console__(console, options):
            assert isinstance(result, Table)
            for column in result.columns:
                column.overflow = "fold"
            yield result


class _Page(Markdown):
    elements: ClassVar = Markdown.elements | {"table_open": _Table}


class _Formula(LatexNodes2Text):
    """A formula as text, with brackets around a group that is more than a name."""

    def group_node_to_text(self, node: Any) -> str:
        text = self.nodelist_to_text(node.nodelist).strip()
        return text if re.fullmatch(r"[\w\u0304\u0302]*", text) else f"({text})"


def _line(formula: str) -> str:
    """Return a formula as an indented line of Markdown."""
    for pattern, word in _WORDS.items():
        formula = re.sub(pattern, word, formula)
    formula = _SUBSCRIPT.sub(lambda low: "{}" + low[1].translate(_LOW), formula)
    formula = _SUPERSCRIPT.sub(lambda high: "{}" + high[1].translate(_HIGH), formula)
    text = re.sub(r"([=≥><⇒←≡])", r" \1 ", _CONVERTER.latex_to_text(formula))
    return f"\n\n    {re.sub(r' (?=[,)])', '', ' '.join(text.split()))}\n"


def _fraction(node: Any, l2tobj: LatexNodes2Text) -> str:
    return "/".join(l2tobj.nodelist_to_text([part]) for part in node.nodeargs) + " "


_CONTEXT = get_default_latex_context_db()
_CONTEXT.add_context_category("formulas", macros=[MacroTextSpec("frac", _fraction)], prepend=True)
_CONVERTER = _Formula(_CONTEXT)
