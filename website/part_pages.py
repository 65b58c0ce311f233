"""A page each for the rules, the fusion rules and the filters, and a table of each kind."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import NamedTuple

from fusion_gym.fusion.table import REASONS
from website.papers import citations
from website.parts import KIND_NAMES, Part, equations, filters, fusions, policies

_KINDS = {
    "rule": "a rule: it looks at signals alone",
    "reference": "a reference: it takes the task and its model, without the truth",
}
_ASSUMED = {
    "nothing": "nothing of the correlations",
    "common information": "common information and nothing else in common; offered without it too, "
    "and then no bound",
    "independence": "independent errors",
    "information shares": "a prior that was shared out among the nodes",
    "joint covariance": "a known joint covariance",
    "tracked weights": "nothing of the correlations",
}


class Kind(NamedTuple):
    """A folder of pages: how its parts are found, and what stands above their table."""

    parts: Callable[[], list[Part]]
    intro: str


KINDS = {
    "rules": Kind(
        policies,
        "Every policy by name. A *rule* looks at signals alone; a *reference* takes the task and "
        "its model. [Policies](../policies.md) has how they are named and evaluated, and the saved "
        "agents besides. A page has the equation, what it assumes, its source, its parameters and "
        "one episode.",
    ),
    "fusion": Kind(
        fusions,
        "How the centre joins the nodes' estimates: the option `fusion` of the environments. A "
        "rule whose assumption does not hold in an environment is refused there, with the reason.",
    ),
    "filters": Kind(
        filters,
        "What nodes or centre make of the measurements that arrive: the option `filter` of the "
        "environments. All equations are of one step, after the prediction x̂ ← A x̂, "
        "P ← A P Aᵀ + W.",
    ),
}


def pages(folder: str, figures: dict[str, str]) -> dict[str, str]:
    """The pages of a folder by their places; ``figures`` are captions by a part's slug."""
    kind = KINDS[folder]
    parts = kind.parts()
    found = {f"{folder}/index.md": _overview(folder, kind.intro, parts)}
    for part in parts:
        found[f"{folder}/{part.slug}.md"] = _page(folder, part, figures.get(part.slug))
    return found


def _overview(folder: str, intro: str, parts: list[Part]) -> str:
    lines = [f"# {KIND_NAMES[folder]}", "", intro, "", "| | |", "|---|---|"]
    lines += [
        f"| [{_name(folder, part)}]({part.slug}.md) | {_cell(part.summary)} |" for part in parts
    ]
    return "\n".join(lines) + "\n"


def _name(folder: str, part: Part) -> str:
    return part.title if folder == "filters" else f"`{part.title}`"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _page(folder: str, part: Part, caption: str | None) -> str:
    told, name = part.told, part.owner.__name__
    place = f"{part.owner.__module__}.{part.owner.__qualname__}"
    rows = {
        "rules": [("kind", _KINDS.get(part.kind, "")), ("who knows what it looks at", part.used)],
        "fusion": [
            ("assumes", _ASSUMED.get(part.kind, "")),
            ("offered in", part.used or "no environment of the library: their errors share noise"),
        ],
        "filters": [("offered in", part.used)],
    }[folder]
    rows.append(("in code", f"[`{name}`][{place}]"))
    if part.also is not None:
        rows[-1] = ("in code", f"{rows[-1][1]}, [`{part.also.__name__}`][{_place(part.also)}]")
    parts = [f"# {_name(folder, part)}", part.told.text, _table(rows)]
    parts += ["## Equation", equations(folder)[part.slug]]
    if caption is not None:
        parts += ["## One episode" if folder == "rules" else "## In two dimensions"]
        parts += [f"![{caption}]({part.slug}.svg)"]
    parts += ["## What it assumes", _sentence(told.assumes)]
    if folder == "fusion" and part.kind in REASONS:
        reason = REASONS[part.kind].format(common="…")
        parts += [f"Where that does not hold it is refused: “{reason}”."]
    parts += ["## Source", _sentence(told.source), *citations(told.source)]
    if part.also is not None:
        turn = part.also_told
        parts += ["## In turn", turn.text, f"Source: {turn.source}"]
    if part.parameters:
        parts += ["## Parameters", _parameters(part), _use(part)]
    return "\n\n".join(parts) + "\n"


def _place(owner: object) -> str:
    return f"{owner.__module__}.{owner.__qualname__}"  # type: ignore[attr-defined]


def _sentence(text: str) -> str:
    """With a capital, unless it begins with a symbol or the word for a paper."""
    first = re.match(r"(?:a|[a-z]{2,})(?![\w*\\])", text)
    return text[:1].upper() + text[1:] if first else text


def _table(rows: list[tuple[str, str]]) -> str:
    return "\n".join(
        ["| | |", "|---|---|", *(f"| {head} | {_cell(text)} |" for head, text in rows)]
    )


def _parameters(part: Part) -> str:
    lines = ["| parameter | default | allowed |", "|---|---|---|"]
    return "\n".join([*lines, *(f"| `{k}` | {v} | {kind} |" for k, v, kind in part.parameters)])


def _use(part: Part) -> str:
    name, default, _ = part.parameters[0]
    value = default if default not in ("None", "required") else "…"
    return (
        f"In a command: `--policies {part.slug}:{name}={value}`; in Python: "
        f'`fusion_gym.make_policy("{part.slug}:{name}={value}", task)`.'
    )
