"""The rules, references, fusion rules and filters that have a page each, as the code has them."""

from __future__ import annotations

import importlib
import inspect
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import fusion_gym
from fusion_gym.core.system import MEANING, Knowledge
from fusion_gym.envs.registration import ENVIRONMENTS
from fusion_gym.fusion import intersection, rules, several
from fusion_gym.fusion.table import RULES
from fusion_gym.policies import registry
from fusion_gym.policies.registry import policy_names
from fusion_gym.validation import ConfigurationError
from website.docstrings import Told, markdown, told

EQUATIONS = Path(__file__).parent / "equations"
KIND_NAMES = {"rules": "Rules and references", "filters": "Filters", "fusion": "Fusion rules"}


@dataclass(frozen=True)
class Part:
    """One page: its title, the object of which it tells, where it is used, and how it is made."""

    slug: str
    title: str
    owner: Any
    used: str
    kind: str = ""
    parameters: tuple[tuple[str, str, str], ...] = ()
    also: Any = None  # a second object whose text belongs to the page

    @property
    def told(self) -> Told:
        """The owner's docstring."""
        return told(self.owner)

    @property
    def also_told(self) -> Told:
        """The second object's docstring."""
        return told(self.also)

    @property
    def summary(self) -> str:
        """Its first sentence."""
        return re.split(r"(?<=[.])\s", self.told.text.replace("\n", " "), maxsplit=1)[0]


@cache
def equations(kind: str) -> dict[str, str]:
    """The sections of an equation file by their names."""
    text = (EQUATIONS / f"{kind}.md").read_text(encoding="utf-8")
    parts = re.split(r"^## (\w+)$", text, flags=re.MULTILINE)[1:]
    return {name: body.strip() for name, body in zip(parts[::2], parts[1::2], strict=True)}


def slugs(kind: str) -> list[str]:
    """The names of a kind's pages, in their order."""
    return [
        part.slug for part in {"rules": policies, "filters": filters, "fusion": fusions}[kind]()
    ]


def policies() -> list[Part]:
    """Rules and references of the registry, rules first."""
    return [_policy(name, kind) for kind in ("rule", "reference") for name in policy_names(kind)]


def _policy(name: str, kind: str) -> Part:
    maker = registry._maker(registry._ROWS[name])
    parameters = tuple(
        (key, "required" if value.default is value.empty else _shown(value.default), _type(value))
        for key, value in registry._parameters(name, maker).items()
    )
    return Part(name, name, maker, _knows(maker), kind, parameters)


def _type(parameter: inspect.Parameter) -> str:
    words = {
        "PerSensor": "a number, or one a sensor",
        "float": "a number",
        "int": "a whole number",
        "int | None": "a whole number, or None for no limit",
        "float | None": "a number, or None",
        "bool": "True or False",
        "str": "a word",
        "str | None": "a path, or None",
    }
    return words[str(parameter.annotation)]


def _shown(value: Any) -> str:
    return "/".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _knows(maker: Any) -> str:
    """Who must decide, in words, by the class of knowledge that the policy declares."""
    declared: Any = inspect.getattr_static(maker, "knowledge", None)
    if isinstance(declared, str):
        known: Knowledge = declared  # type: ignore[assignment]
        return f"`{known}`: {MEANING[known]}"
    if isinstance(declared, property):
        return markdown(" ".join((declared.__doc__ or "").split()))
    return _DECIDED_LATER[maker.__name__]


# Of policies that declare it when they are made.
_DECIDED_LATER = {
    "Lookahead": "A coordinator, with what was never sent if the task has memory.",
    "Rollout": "A coordinator, with what was never sent if the task has memory.",
    "OptimalPolicy": "A sensor's own error; with two sources both errors.",
    "WhittleIndex": "A sensor's own error; with `at_most` all errors, for the largest is sent.",
}


def fusions() -> list[Part]:
    """The rows of the table of fusion rules."""
    owners: dict[str, tuple[Any, Any]] = {
        "federated": (rules.InformationFusion, None),
        "information": (rules.InformationFusion, None),
        "matrix": (rules.MatrixWeightedFusion, None),
        "ci": (several.covariance_intersection_many, None),
        "exact_ci": (several.covariance_intersection_many, None),
        "ici": (intersection.inverse_covariance_intersection, None),
        "sci": (intersection.covariance_intersection, intersection.SequentialIntersection),
        "sici": (
            intersection.inverse_covariance_intersection,
            intersection.SequentialIntersection,
        ),
    }
    return [
        Part(name, name, owners[name][0], _where("fusion", name), row.assumes, also=owners[name][1])
        for name, row in RULES.items()
    ]


@cache
def offered(option: str) -> dict[str, list[str]]:
    """The values that each environment offers for an option, as its refusal of others says."""
    result: dict[str, list[str]] = {}
    for env_id in ENVIRONMENTS:
        try:
            fusion_gym.make_task(env_id, **{option: "?"})
        except (ConfigurationError, TypeError) as error:
            allowed = str(error).partition("one of ")[2]
            result[env_id] = re.findall(r"'(\w+)'", allowed.split(", for ")[0])
    return result


def _where(option: str, value: str) -> str:
    found = [env_id for env_id, values in offered(option).items() if value in values]
    return ", ".join(environment_link(env_id) for env_id in found)


PAGES_OF = {
    "fusion_gym/TobitOscillator-v0": "tobit_oscillator",
    "fusion_gym/CorrelatedTracking-v0": "correlated_tracking",
    "fusion_gym/MarkovJumpTracking-v0": "markov_jump",
    "fusion_gym/UnknownInput-v0": "unknown_input",
    "fusion_gym/RemoteEstimation-v0": "remote_estimation",
    "fusion_gym/BiasedOscillator-v0": "biased",
    "fusion_gym/BiasedTracking-v0": "biased",
    "fusion_gym/LinearFusion-v0": "linear_fusion",
}


def environment_link(env_id: str) -> str:
    """An environment's name with a link to its page, from a page one folder down."""
    name = env_id.split("/")[1]
    return f"[{name}](../{PAGES_OF[env_id]}.md)" if env_id in PAGES_OF else name


_TOBIT = tuple(
    f"fusion_gym/{name}-v0"
    for name in ("TobitOscillator", "BiasedOscillator", "BiasedTracking", "LinearFusion")
)
_SYSTEMS = "fusion_gym.systems"
# slug: title, class, the option's value (None: no choice), and the environments where it means that
FILTERS: dict[str, tuple[str, str, str | None, tuple[str, ...]]] = {
    "kalman": ("Kalman filter", "tobit.filters:KalmanFilter", "kalman", _TOBIT),
    "joint": ("Joint Kalman filter", "tobit.joint:JointCentre", "joint", _TOBIT[3:]),
    "tobit": (
        "Tobit Kalman filter",
        "tobit.tobit_filter:TobitKalmanFilter",
        "tobit",
        (_TOBIT[0], _TOBIT[3]),
    ),
    "tobit_bound": (
        "Tobit Kalman filter of the paper",
        "tobit.bound_filter:BoundTobitFilter",
        "paper",
        _TOBIT[:1],
    ),
    "assumed_density": (
        "Assumed-density filter",
        "tobit.tobit_filter:AssumedDensityFilter",
        "adf",
        _TOBIT,
    ),
    "stochastic": (
        "Filter that reads silence",
        "tobit.filters:StochasticEventFilter",
        "stochastic",
        _TOBIT,
    ),
    "robust": (
        "Robust Kalman filter",
        "correlated.filters:RobustKalmanFilter",
        None,
        ("fusion_gym/CorrelatedTracking-v0",),
    ),
    "local": (
        "Local linear-minimum-variance filters",
        "markov_jump.linear_minimum_variance:LocalFilters",
        "local",
        ("fusion_gym/MarkovJumpTracking-v0",),
    ),
    "centralised": (
        "Centralised linear-minimum-variance filter",
        "markov_jump.centralised_linear:CentralisedLinearFilter",
        "centralised",
        ("fusion_gym/MarkovJumpTracking-v0",),
    ),
    "imm": (
        "Interacting multiple models",
        "markov_jump.interacting_models:InteractingModels",
        "imm",
        ("fusion_gym/MarkovJumpTracking-v0",),
    ),
    "input_bound": (
        "Joint input-state filter of the paper",
        "unknown_input.bound_filter:BoundTables",
        "paper",
        ("fusion_gym/UnknownInput-v0",),
    ),
    "input_state": (
        "Exact joint input-state filter",
        "unknown_input.filters:ExactInputStateFilter",
        "predict",
        ("fusion_gym/UnknownInput-v0",),
    ),
    "random_walk": (
        "Kalman filter with a random-walk input",
        "unknown_input.filters:RandomWalkInputFilter",
        "random_walk",
        ("fusion_gym/UnknownInput-v0",),
    ),
}
# The biased environments' default is the Tobit Kalman filter too, under the name of their paper.
ALSO = {("paper", env_id): "tobit" for env_id in _TOBIT[1:3]}


def filters() -> list[Part]:
    """The filters, one page a class."""
    found = []
    for slug, (title, place, value, environments) in FILTERS.items():
        module, _, name = place.partition(":")
        owner = getattr(importlib.import_module(f"{_SYSTEMS}.{module}"), name)
        lines = [f'{environment_link(one)} (`filter="{value}"`)' for one in environments]
        if value is None:
            lines = [environment_link(one) for one in environments]
        lines += [
            f'{environment_link(one)} (`filter="{word}"`, on state and bias)'
            for (word, one), target in ALSO.items()
            if target == slug
        ]
        found.append(Part(slug, title, owner, ", ".join(lines)))
    return found
