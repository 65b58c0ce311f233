"""The policies, fusion rules and filters that have a page each, as their declarations have them."""

import inspect
import re
from dataclasses import dataclass
from typing import Any

from fusion_gym.core.system import MEANING
from fusion_gym.docstrings import Docstring, read
from fusion_gym.envs.registration import ENVIRONMENTS, options_of
from fusion_gym.fusion.table import REASONS, RULES
from fusion_gym.policies.registry import Kind, policy_maker, policy_names, policy_parameters
from website.docstrings import markdown
from website.places import pages_of

KIND_NAMES = {"rules": "Rules and references", "fusion": "Fusion rules", "filters": "Filters"}
_KINDS: dict[Kind, str] = {
    "rule": "a rule: it looks at signals alone",
    "reference": "a reference: it takes the task and its model, without the truth",
}
# Types of parameters in words.
_WORDS = {
    "PerSensor": "a number, or one a sensor",
    "float": "a number",
    "int": "a whole number",
    "bool": "True or False",
    "str": "a word",
    "None": "None",
}


@dataclass(frozen=True)
class Part:
    """One page: its name, the object that declares it, a line and the rows of its first table."""

    name: str
    owner: Any
    meaning: str
    rows: tuple[tuple[str, str], ...]
    kind: str = ""

    @property
    def docstring(self) -> Docstring:
        """The declaration."""
        return read(self.owner)


def parts(kind: str) -> list[Part]:
    """The parts of a kind, in the order of their pages."""
    return {"rules": policies, "fusion": fusions, "filters": filters}[kind]()


def policies() -> list[Part]:
    """Rules and references of the registry, rules first."""
    return [
        Part(
            name,
            policy_maker(name),
            _summary(policy_maker(name)),
            (("kind", text), ("who knows what it looks at", _knows(policy_maker(name)))),
            kind,
        )
        for kind, text in _KINDS.items()
        for name in policy_names(kind)
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
        Part(filter_slug(owner), owner, _summary(owner), (("offered in", ", ".join(lines)),))
        for owner, lines in places.items()
    ]


def filter_slug(owner: type) -> str:
    """The name of a filter's page."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", owner.__name__).lower()


def example_of(part: Part) -> tuple[str, str]:
    """The text of a policy's example, and its environment with options: ``ID name=value …``."""
    example = " ".join(part.docstring.labelled["Example"].split())
    spec, env = re.findall("``(.+?)``", example)
    return spec, env


def parameters(part: Part) -> list[tuple[str, str, str, str]]:
    """Name, default, allowed values and meaning of each parameter of a policy."""
    meanings = part.docstring.arguments
    return [
        (f"`{name}`", _default(value), _allowed(value), markdown(meanings[name]))
        for name, value in policy_parameters(part.name).items()
    ]


def environment_link(env_id: str) -> str:
    """An environment's name with a link to its page, from a page one folder down."""
    return f"[{env_id.split('/')[1]}](../{pages_of()[env_id]}.md)"


def _summary(owner: Any) -> str:
    return markdown(read(owner).summary)


def _default(parameter: inspect.Parameter) -> str:
    value = parameter.default
    if value is parameter.empty:
        return "required"
    return "/".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _allowed(parameter: inspect.Parameter) -> str:
    return " or ".join(_WORDS.get(word, word) for word in str(parameter.annotation).split(" | "))


def _knows(maker: Any) -> str:
    """Who must decide, by the class of knowledge that the policy declares."""
    declared: Any = inspect.getattr_static(maker, "knowledge")
    if isinstance(declared, property):
        return markdown(" ".join((declared.__doc__ or "").split()))
    return f"`{declared}`: {MEANING[declared]}"
