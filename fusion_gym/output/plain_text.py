"""Pages of Markdown with LaTeX as text for a terminal."""

import re
from typing import Any, ClassVar

from pylatexenc.latex2text import LatexNodes2Text, MacroTextSpec, get_default_latex_context_db
from rich.console import Console, ConsoleOptions, RenderResult
from rich.markdown import Markdown, TableElement
from rich.table import Table

from fusion_gym.docstrings import plain_marks

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
