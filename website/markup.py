"""Small changes between the repository's Markdown and the site's HTML."""

import html
import re
import warnings
from functools import cache

with warnings.catch_warnings():  # of how ziamath 0.13 finds its own font
    warnings.simplefilter("ignore", DeprecationWarning)
    import ziafont
    import ziamath

_ITEM = re.compile(r"([-*]|\d+\.) ")
_FORMULA = re.compile(
    r'<(?P<tag>div|span) class="arithmatex">\\[\[(](?P<latex>.*?)\\[\])]</(?P=tag)>', re.DOTALL
)
_FIGURE = re.compile(
    r'<p>(?P<image><img alt="(?P<text>[^"]*)"[^>]*?/?>)</p>'
    r"(?:\s*<p>(?P<caption><em>(?:(?!</p>).)*)</p>)?",
    re.DOTALL,
)
_TAG = re.compile(r"<[^>]+>")
_SIZE = 17.0  # pixels, of the text of an equation
ziamath.config.svg2 = False  # whole paths: symbols of one page must not share names
ziafont.config.svg2 = False


def separated(text: str) -> str:
    """A blank line before each list, which the repository's Markdown does without."""
    result: list[str] = []
    fenced = in_list = False
    for line in text.split("\n"):
        if line.startswith("```"):
            fenced = not fenced
        item = bool(_ITEM.match(line))
        if item and not fenced and not in_list and result and result[-1].strip():
            result.append("")
        in_list = item or (in_list and (line.startswith(" ") or bool(line.strip())))
        result.append(line)
    return "\n".join(result)


def drawn(page: str) -> str:
    """The HTML with its equations as pictures, which need neither scripts nor the network."""

    def svg(match: re.Match[str]) -> str:
        latex = html.unescape(match["latex"]).strip()
        picture, drop = _picture(latex, match["tag"] == "span")
        label = html.escape(" ".join(latex.split()), quote=True)
        marks = f'role="img" aria-label="{label}" '
        marks += f'style="vertical-align:{drop:.2f}px" ' if match["tag"] == "span" else ""
        picture = picture.replace("<svg ", f"<svg {marks}")
        return f'<{match["tag"]} class="formula">{picture}</{match["tag"]}>'

    return _FORMULA.sub(svg, page)


@cache
def _picture(latex: str, inline: bool) -> tuple[str, float]:
    """An equation as SVG in the text's colour, and how far it reaches below the line (<= 0)."""
    drawing = ziamath.Latex(latex, size=_SIZE, color="currentColor", inline=inline)
    return drawing.svg(), drawing.getyofst()


def captioned(page: str) -> str:
    """Pictures that stand alone become figures.

    The caption is the paragraph behind it that begins in italics, or else the picture's own text.
    """

    def figure(match: re.Match[str]) -> str:
        caption = match["caption"] or match["text"]
        text = match["text"] or html.escape(html.unescape(_TAG.sub("", caption)), quote=True)
        image = match["image"].replace(f'alt="{match["text"]}"', f'loading="lazy" alt="{text}"', 1)
        if caption.count("<em>") == 1 and caption.endswith("</em>"):
            caption = caption[len("<em>") : -len("</em>")]
        return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"

    return _FIGURE.sub(figure, page)
