"""The registry of policies: rules, references and saved agents by name.

The text ``NAME`` or ``NAME:key=value,key=value`` names a policy. ``model:PATH`` or ``zoo:NAME``
names a saved agent, with settings after a comma. ``package.module:Class`` or
``package.module:Class:key=value`` names a class of the user.
"""

import ast
import contextlib
import dataclasses
import inspect
import pkgutil
import re
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypedDict, get_args, overload

import numpy as np

from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.knowledge import KNOWLEDGE, SignalError
from fusion_gym.core.task import Task
from fusion_gym.entries import Arguments
from fusion_gym.importing import TRUST, import_named
from fusion_gym.policies.base import Policy, SearchRange, guard, owner_of
from fusion_gym.validation import ConfigurationError, boolean, choice, keys, refusal

if TYPE_CHECKING:
    from fusion_gym.policies.agent import PolicyAgent


def parse_value(text: str) -> Any:
    """Return the number, keyword, list or ``0.1/0.2/0.3`` of a text, or else the text."""
    plain = {"true": True, "false": False, "none": None, "null": None}
    if text.strip().lower() in plain:
        return plain[text.strip().lower()]
    if "/" in text:
        parts = tuple(parse_value(part) for part in text.split("/"))
        if all(isinstance(part, (int, float)) for part in parts):
            return parts
    for read in (ast.literal_eval, float):
        # {[]: 1} raises a TypeError, too many brackets the last two.
        with contextlib.suppress(ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
            return read(text)
    return text


def parse_settings(kind: str, entries: Iterable[str]) -> Arguments:
    """Return ``["key=value", …]`` as a dictionary, with :func:`parse_value`."""
    result: Arguments = {}
    for entry in entries:
        key, equals, value = entry.partition("=")
        key = key.strip()
        if not equals or not key:
            raise ConfigurationError(f"{kind} {entry!r} is not allowed: write key=value")
        if key in result:
            raise ConfigurationError(f"{kind} {key!r} appears twice")
        result[key] = parse_value(value)
    return result


Kind = Literal["rule", "reference", "agent"]
Maker = Callable[..., Policy]


class Context(TypedDict):
    """The arguments of a maker that the text of a policy cannot set."""

    task: Task
    trust: bool


class PolicyRow(NamedTuple):
    """The maker of a policy, as a callable or as "module:attribute", and its kind.

    The maker takes the parameters of the policy by name. A parameter ``task`` receives the task,
    and a parameter ``trust`` whether files may run code. Its docstring declares the policy. An
    attribute ``rest`` names the parameter that takes the rest of the text, which may contain colons
    and commas.

    An agent takes the text after its name as its first parameter.
    """

    maker: Maker | str
    kind: Kind


_SHIPPED: dict[Kind, dict[str, str]] = {
    "rule": {
        "adaptive_innovation": "rules:AdaptiveInnovation",
        "adaptive_threshold": "rules:AdaptiveThreshold",
        "always": "rules:Always",
        "centre_variance": "rules:CentreVariance",
        "dynamic_event": "rules:DynamicEvent",
        "information_gain": "rules:InformationGain",
        "innovation_threshold": "rules:InnovationThreshold",
        "local_variance": "rules:LocalVariance",
        "maximum_age": "rules:MaximumAge",
        "never": "rules:Never",
        "paced": "rules:Paced",
        "periodic": "rules:Periodic",
        "random": "rules:Random",
        "report_on_change": "rules:ReportOnChange",
        "round_robin": "rules:RoundRobin",
        "send_on_delta": "rules:SendOnDelta",
        "stochastic_event": "rules:StochasticEvent",
        "variance_threshold": "rules:VarianceThreshold",
    },
    "reference": {
        "age_index": "optimal:AgeIndex",
        "age_optimum": "optimal:AgeOptimum",
        "estimate_difference": "rules:EstimateDifference",
        "kullback_leibler": "rules:KullbackLeibler",
        "optimal": "optimal:OptimalPolicy",
        "periodic_optimum": "periodic_optimum:PeriodicOptimum",
        "priced_threshold": "rules:PricedThreshold",
        "rollout": "rollout:Rollout",
        "value_of_information": "rules:ValueOfInformation",
        "whittle": "optimal:WhittleIndex",
    },
    "agent": {"model": "saved:saved_agent", "zoo": "saved:zoo_agent"},
}
_ROWS = {
    name: PolicyRow(f"fusion_gym.policies.{place}", kind)
    for kind, places in _SHIPPED.items()
    for name, place in places.items()
}


def register_policy(name: str, maker: Maker, kind: Kind = "rule") -> None:
    """Register a policy under a name for texts, commands and configs.

    Args:
        name: name of the policy, a word of letters, digits and ``_``.
        maker: callable that returns the policy, for example a subclass of
            :class:`fusion_gym.policies.base.Rule`. A text may set its parameters, except ``task``
            and ``trust``, which receive the arguments of :func:`make_policy`.
        kind: ``"rule"``, ``"reference"`` or ``"agent"``.

    Raises:
        ConfigurationError: a name that exists or is not allowed, an unknown kind, or a maker that
            is no callable with named parameters.

    Example:
        >>> from fusion_gym import policy_names, register_policy
        >>> from fusion_gym.policies.rules import Periodic
        >>> register_policy("clocked", Periodic)
        >>> "clocked" in policy_names("rule")
        True
    """
    if not isinstance(name, str) or not name.isidentifier():
        raise refusal("name", name, "a word of letters, digits and '_'")
    if name in _ROWS:
        raise ConfigurationError(f"name = {name!r} is not allowed: a policy has this name")
    choice("kind", kind, get_args(Kind))
    _parameters(name, maker)
    _ROWS[name] = PolicyRow(maker, kind)


def policy_names(kind: Kind | None = None) -> list[str]:
    """Return the names of all policies, or of the policies of one kind.

    Args:
        kind: ``"rule"``, ``"reference"`` or ``"agent"``; None for all.

    Returns:
        The names in alphabetical order.

    Raises:
        ConfigurationError: an unknown kind.

    Example:
        >>> from fusion_gym import policy_names
        >>> policy_names("agent")
        ['model', 'zoo']
    """
    if kind is not None:
        choice("kind", kind, get_args(Kind))
    return sorted(name for name, row in _ROWS.items() if kind in (None, row.kind))


def policy_maker(name: str) -> Maker:
    """Return the maker of the policy of this name."""
    keys("policy", [name], _ROWS)
    return _maker(_ROWS[name])


def policy_parameters(name: str) -> dict[str, inspect.Parameter]:
    """Return the parameters that a text may set, in the maker's order."""
    return _parameters(name, policy_maker(name))


def search_ranges(spec: str) -> dict[str, SearchRange]:
    """Return the ranges of the parameters that the text of a rule leaves, its own ones first."""
    _, row, text = _parse_policy(spec)
    if row.kind == "agent":
        return {}
    maker: Any = _maker(row)
    ranges: dict[str, SearchRange] = dict(getattr(maker, "search", {}))
    if dataclasses.is_dataclass(maker):
        own = sorted(dataclasses.fields(maker), key=lambda field: bool(field.kw_only))
        ranges |= {field.name: field.metadata["search"] for field in own if field.metadata}
    settings = parse_settings("parameter", text.split(",") if text else [])
    return {name: own for name, own in ranges.items() if own and name not in settings}


def with_settings(spec: str, settings: Mapping[str, Any], digits: int = 5) -> str:
    """Return the text of a policy with further settings: texts, or numbers with so many digits."""
    texts = {
        name: value
        if isinstance(value, str)
        else "/".join(f"{entry:.{digits}g}" for entry in np.ravel(value).tolist())
        for name, value in settings.items()
    }
    joined = ",".join(f"{name}={text}" for name, text in texts.items())
    return f"{spec}{',' if _parse_policy(spec)[2] else ':'}{joined}" if joined else spec


@overload
def make_policy(spec: str, env: Task, *, trust: bool = False, trial: bool = True) -> Policy: ...


@overload
def make_policy(
    spec: str, env: Any, *, trust: bool = False, trial: bool = True
) -> "PolicyAgent": ...


def make_policy(spec: str, env: Any, *, trust: bool = False, trial: bool = True) -> Any:
    """Return the policy that a text names, for an environment as an agent with ``predict``.

    Parameters that the text does not set have the task's defaults (``task.policy_defaults``) or the
    maker's defaults.

    Args:
        spec: text of the policy, ``NAME`` or ``NAME:key=value,…``.
        env: the task, for example of :func:`~fusion_gym.make_task`; or an environment of
            ``gym.make``, ``gym.make_vec``, :func:`~fusion_gym.make_sb3_vec_env`,
            Stable-Baselines3's ``DummyVecEnv`` or :func:`~fusion_gym.parallel_env`, through its
            wrappers.
        trust: whether ``model:PATH`` may run code of the file; otherwise the file is read as data.
        trial: whether to call the policy once, which reports errors before long work begins.

    Returns:
        For a task the policy, a function from signals to requests; for an environment a
        :class:`~fusion_gym.policies.agent.PolicyAgent` with Stable-Baselines3's ``predict``.

    Raises:
        ConfigurationError: an unknown policy or parameter, a value that is not allowed, a model
            that cannot be read or has another observation layout, a policy that uses signals
            which the task withholds, or an environment of another library or process.

    Example:
        >>> from fusion_gym import make_policy, make_task
        >>> task = make_task("fusion_gym/TobitOscillator-v1")
        >>> make_policy("send_on_delta:threshold=2", task).threshold
        2
    """
    if not isinstance(env, Task):
        from fusion_gym.policies.agent import PolicyAgent

        return PolicyAgent(env, lambda task: make_policy(spec, task, trust=trust, trial=trial))
    task: Task = env
    context: Context = {"task": task, "trust": boolean("trust", trust) or TRUST.get()}
    policy = _make(spec, task.policy_defaults, context)
    if task.required_policy is not None:
        required = _make(task.required_policy, task.policy_defaults, context)
        _check_required(spec, policy, task, required)
    if trial and _parse_policy(spec)[1].kind != "agent":  # the loader has checked its observation
        _try_out(spec, policy, task)
    return policy


def _make(spec: str, defaults: dict[str, Arguments], context: Context) -> Policy:
    name, row, text = _parse_policy(spec)
    maker = _maker(row)
    known = _parameters(name, maker)
    arguments: Arguments = {}
    if row.kind == "agent":
        key, (first, *entries) = next(iter(known)), text.split(",")
        arguments[key] = first.removeprefix(f"{key}=")
    else:
        rest = getattr(maker, "rest", None)
        if rest and (found := re.search(rf"(^|,)\s*{rest}=", text)):
            text, arguments = text[: found.start()], {rest: text[found.end() :]}
        entries = text.split(",") if text else []
    settings = parse_settings(f"parameter of policy {name!r}", entries)
    keys(f"parameter of policy {name!r}", settings, known.keys() - arguments.keys())
    arguments |= defaults.get(name, {}) | settings
    for key, value in known.items():
        if value.default is value.empty and key not in arguments:
            raise ConfigurationError(f"policy {spec!r} needs a parameter {key!r}: write {key}=…")
    parameters = inspect.signature(maker).parameters
    arguments |= {key: value for key, value in context.items() if key in parameters}
    try:
        policy = maker(**arguments)
    except ConfigurationError as error:
        raise ConfigurationError(f"policy {spec!r}: {error}") from None
    declared = getattr(policy, "knowledge", None)
    if declared not in KNOWLEDGE:
        raise ConfigurationError(
            f"policy {spec!r} has knowledge = {declared!r}: it must be one of "
            f"{', '.join(map(repr, KNOWLEDGE))}"
        )
    return policy


def _check_required(spec: str, policy: Any, task: Task, required: Any) -> None:
    """Refuse a policy whose silence another filter would read."""
    thresholds = task.policy_defaults[str(task.required_policy)]
    names = {field.name for field in dataclasses.fields(required)} - {"max_interval"}
    if type(policy) is type(required) and all(
        np.array_equal(policy.column(name, task.sensors), required.column(name, task.sensors))
        if name in thresholds
        else getattr(policy, name) == getattr(required, name)
        for name in names
    ):
        return
    allowed = f"{required!r}, whose silence the filter reads; only max_interval may differ"
    raise refusal("policy", spec, allowed, "with filter='truncated'")


def _parse_policy(spec: str) -> tuple[str, PolicyRow, str]:
    """Return the name of a policy, its row, and the text after its name."""
    if not isinstance(spec, str):
        raise refusal("policy", spec, "the text that names a policy")
    name, _, text = spec.partition(":")
    own, _, behind = text.partition(":")
    if name in _ROWS or not own.isidentifier():
        keys("policy", [name], _ROWS)
        return name, _ROWS[name], text
    name = f"{name}:{own}"
    result = import_named("policy", name)
    lacks = [part for part in ("knowledge", "reset", "__call__") if not hasattr(result, part)]
    if not isinstance(result, type) or lacks:
        raise ConfigurationError(
            f"policy = {name!r} is not allowed: it must be a class with knowledge, reset and "
            "__call__, such as a subclass of fusion_gym.policies.base.Rule"
        )
    return name, PolicyRow(result, "rule"), behind


def _maker(row: PolicyRow) -> Maker:
    return pkgutil.resolve_name(row.maker) if isinstance(row.maker, str) else row.maker


def _parameters(name: str, maker: Maker) -> dict[str, inspect.Parameter]:
    """Return all parameters but the task and the trust, in the maker's order."""
    try:
        names = inspect.signature(maker).parameters
    except (TypeError, ValueError):
        names = None
    if names is None or any(
        p.kind not in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY) for p in names.values()
    ):
        raise ConfigurationError(
            f"maker = {maker!r} of policy {name!r} is not allowed: it must be a callable with "
            "named parameters that returns a policy"
        )
    return {
        key: parameter for key, parameter in names.items() if key not in Context.__annotations__
    }


def _try_out(spec: str, policy: Policy, task: Task) -> None:
    """Call the policy once on one run, to report errors before long work begins."""
    batch = EpisodeBatch(task, 1, owner_of(policy))
    batch.reset()
    policy.reset(1)
    try:
        requests = guard(policy, task)(batch.signals())
    except (SignalError, ConfigurationError) as error:
        raise ConfigurationError(f"policy {spec!r}: {error.args[0]}") from None
    policy.reset(1)
    shape, kind = np.shape(requests), np.asarray(requests).dtype
    numbers = task.network.rule.by_channel and kind == np.int64
    if shape != (task.sensors, 1) or not (kind == np.bool_ or numbers):
        raise ConfigurationError(
            f"policy {spec!r} returns an array of {kind} {shape}: it must be bool "
            f"({task.sensors}, 1), sensors and runs"
        )
