"""A page each for the rules, the fusion rules and the filters, and a table of each kind."""

import re

from fusion_gym.docstrings import table
from website.docstrings import markdown
from website.papers import citations
from website.parts import KIND_NAMES, Part, example_of, parameters, parts

_INTROS = {
    "rules": "Every policy by name. A *rule* looks at signals alone; a *reference* takes the task "
    "and its model. [Policies](../policies.md) has how they are named and evaluated, and the saved "
    "agents besides.",
    "fusion": "How the centre joins the nodes' estimates: the option `fusion` of the environments. "
    "A rule whose assumption does not hold in an environment is refused there, with the reason. "
    "Estimates xᵢ with covariances Pᵢ, i = 1…l, are joined to x̂ with P.",
    "filters": "What nodes or centre make of the measurements that arrive: the option `filter` of "
    "the environments. All equations are of one step, after the prediction x̂ ← A x̂, "
    "P ← A P Aᵀ + W; x̂⁺, P⁺ are what follows a delivery, C is the measurement matrix, R the noise.",
}


def pages(folder: str) -> dict[str, str]:
    """The pages of a folder by their places."""
    every = parts(folder)
    rows = [(f"[`{_name(folder, part)}`]({part.name}.md)", part.meaning) for part in every]
    overview = f"# {KIND_NAMES[folder]}\n\n{_INTROS[folder]}\n\n{table(('', ''), rows)}\n"
    return {f"{folder}/index.md": overview} | {
        f"{folder}/{part.name}.md": _page(folder, part) for part in every
    }


def _name(folder: str, part: Part) -> str:
    return str(part.owner.__name__) if folder == "filters" else part.name


def _page(folder: str, part: Part) -> str:
    text, labelled = part.docstring.text, part.docstring.labelled
    place = f"{part.owner.__module__}.{part.owner.__qualname__}"
    code = ("in code", f"[`{part.owner.__name__}`][{place}]")
    result = [f"# `{_name(folder, part)}`"]
    if folder == "fusion":
        result.append(part.meaning)
    result += [markdown(text), table(("", ""), (*part.rows, code))]
    result += ["## Equation", markdown(labelled["Equation"])]
    result += ["## What it assumes", _sentence(markdown(labelled["Assumes"]))]
    source = markdown(labelled["Source"])
    result += ["## Source", _sentence(source), *citations(source)]
    if folder == "rules" and (rows := parameters(part)):
        result += ["## Parameters", table(("parameter", "default", "allowed", "meaning"), rows)]
    if folder == "rules":
        spec, _ = example_of(part)
        result += [
            f"In a command: `--policies {spec}`; in Python: "
            f'`fusion_gym.make_policy("{spec}", task)`.'
        ]
    return "\n\n".join(result) + "\n"


def _sentence(text: str) -> str:
    """With a capital, unless it begins with a symbol or the word for a paper."""
    first = re.match(r"(?:a|[a-z]{2,})(?![\w*\\])", text)
    return text[:1].upper() + text[1:] if first else text
