"""A page each for the policies, fusion rules and filters, and an overview of each kind.

A page is the docstring that declares the part, with who knows what or where it is offered above.
"""

import inspect
from dataclasses import dataclass
from typing import Any

from fusion_gym.core.system import MEANING
from fusion_gym.docstrings import read, table
from fusion_gym.envs.registration import ENVIRONMENTS, options_of
from fusion_gym.fusion.table import REASONS, RULES
from fusion_gym.policies.registry import Kind, policy_maker, policy_names
from website.docstrings import markdown
from website.papers import citations
from website.places import pages_of

KIND_NAMES = {"rules": "Rules and references", "fusion": "Fusion rules", "filters": "Filters"}
_KINDS: dict[Kind, str] = {
    "rule": "a rule: it looks at signals alone",
    "reference": "a reference: it takes the task and its model, without the truth",
}
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


@dataclass(frozen=True)
class Part:
    """One page: its name, the object that declares it, a line and the rows of its first table."""

    name: str
    owner: Any
    meaning: str
    rows: tuple[tuple[str, str], ...]

    @property
    def page(self) -> str:
        """The page's Markdown; the reference is where links to the object lead."""
        place = f"{self.owner.__module__}.{self.owner.__qualname__}"
        code = ("in code", f"[`{self.owner.__name__}`][{place}]")
        declared = f"::: {place}\n    options: {{members: false, skip_local_inventory: true}}"
        source = markdown(read(self.owner).labelled["Source"])
        first = [f"# `{self.name}`", table(("", ""), (*self.rows, code)), declared]
        return "\n\n".join([*first, *citations(source)]) + "\n"


def parts(kind: str) -> list[Part]:
    """The parts of a kind, in the order of their pages."""
    return {"rules": policies, "fusion": fusions, "filters": filters}[kind]()


def pages(kind: str) -> dict[str, str]:
    """The pages of a kind by their places, its overview first."""
    every = parts(kind)
    rows = [(f"[`{part.name}`]({part.name}.md)", part.meaning) for part in every]
    overview = f"# {KIND_NAMES[kind]}\n\n{_INTROS[kind]}\n\n{table(('', ''), rows)}\n"
    return {f"{kind}/index.md": overview} | {f"{kind}/{part.name}.md": part.page for part in every}


def policies() -> list[Part]:
    """Rules and references of the registry, rules first."""
    makers = {
        name: (policy_maker(name), text)
        for kind, text in _KINDS.items()
        for name in policy_names(kind)
    }
    return [
        Part(
            name,
            maker,
            _summary(maker),
            (("kind", text), ("who knows what it looks at", _knows(maker))),
        )
        for name, (maker, text) in makers.items()
    ]


def fusions() -> list[Part]:
    """The rows of the table of fusion rules."""
    result = []
    for name, row in RULES.items():
        structures = {env_id: options_of(env_id).structure for env_id in ENVIRONMENTS}
        where = [item for item, known in structures.items() if known and name in known.offered]
        none = "no environment of the library: their errors share noise"
        rows = [("offered in", ", ".join(map(environment_link, where)) or none)]
        if row.assumes in REASONS:
            rows.append(("refused elsewhere", f"“{REASONS[row.assumes].format(common='…')}”"))
        owner = row.make().__class__
        result.append(Part(name, owner, row.meaning, (("assumes", row.assumes), *rows)))
    return result


def filters() -> list[Part]:
    """The filters, one page a class."""
    places: dict[type, list[str]] = {}
    for env_id in ENVIRONMENTS:
        for value, owner in options_of(env_id).filters.items():
            option = f' (`filter="{value}"`)' if value else ""
            places.setdefault(owner, []).append(environment_link(env_id) + option)
    return [
        Part(owner.__name__, owner, _summary(owner), (("offered in", ", ".join(lines)),))
        for owner, lines in places.items()
    ]


def environment_link(env_id: str) -> str:
    """An environment's name with a link to its page, from a page one folder down."""
    return f"[{env_id.split('/')[1]}](../{pages_of()[env_id]}.md)"


def _summary(owner: Any) -> str:
    return markdown(read(owner).summary)


def _knows(maker: Any) -> str:
    """Who must decide, by the class of knowledge that the policy declares."""
    declared: Any = inspect.getattr_static(maker, "knowledge")
    if isinstance(declared, property):
        return markdown(" ".join((declared.__doc__ or "").split()))
    return f"`{declared}`: {MEANING[declared]}"
