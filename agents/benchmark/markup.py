"""Text of the reports: Markdown in which no mark is there by chance, and one HTML page."""

import base64
import html
import re
import string
from collections.abc import Mapping, Sequence
from pathlib import Path
from urllib.parse import quote

import markdown

NONE = "–"


def plain_text(text: str) -> str:
    """Free text in one line, no part of which Markdown or HTML takes for a mark."""
    escaped = html.escape(" ".join(text.split()), quote=False)
    return re.sub(r"[\\`*\[\]|]|(?<!\w)_|_(?!\w)", lambda mark: f"\\{mark[0]}", escaped)


def code(text: str) -> str:
    """Text as a span of code, also in a table."""
    line = " ".join(text.split()).replace("|", "\\|")
    fence = "`" * (1 + max(map(len, re.findall("`+", line)), default=0))
    return f"{fence}{line}{fence}" if len(fence) == 1 else f"{fence} {line} {fence}"


def share(interval: Mapping[str, float] | None) -> str:
    """A relative difference with its interval, in per cent."""
    if interval is None:
        return NONE
    return f"{interval['mean']:+.1%} [{interval['low']:+.1%}, {interval['high']:+.1%}]"


def markup_number(interval: Mapping[str, float] | None) -> str:
    """A quantity with its interval."""
    if interval is None:
        return NONE
    return f"{interval['mean']:.4g} [{interval['low']:.3g}, {interval['high']:.3g}]"


def ranged(values: Sequence[int]) -> str:
    """One number, or the least and the greatest."""
    low, high = min(values), max(values)
    return f"{low:,}" if low == high else f"{low:,} to {high:,}"


def page_of(text: str, folder: Path, title: str) -> str:
    """The Markdown as one HTML page with the folder's figures inside; HTML in it is text."""
    renderer = markdown.Markdown(extensions=["tables", "toc"])
    renderer.preprocessors.deregister("html_block")
    renderer.inlinePatterns.deregister("html")
    body = renderer.convert(text)
    for path in (*folder.glob("*.png"), *folder.glob("*/pareto.png")):
        place = "/".join(quote(part) for part in path.relative_to(folder).parts)
        data = base64.b64encode(path.read_bytes()).decode()
        body = body.replace(f'src="{place}"', f'src="data:image/png;base64,{data}"')
    text = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
    return string.Template(text).substitute(title=html.escape(title), body=body)
