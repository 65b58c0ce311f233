"""Every policy by its name: rules, references that know the model, saved agents.

A policy is asked for as ``NAME`` or ``NAME:key=value,key=value``, a saved agent as ``model:PATH``
or ``zoo:NAME`` with settings behind a comma, one of your own as ``package.module:Class`` or
``package.module:Class:key=value``.
"""

import importlib
import inspect
import re
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, TypedDict, get_args

import numpy as np

from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.system import KNOWLEDGE, SignalError
from fusion_gym.core.task import Task
from fusion_gym.docstrings import plain_marks, read, table
from fusion_gym.importing import TRUST, import_named
from fusion_gym.policies.base import Policy, owner_of, refused_signals
from fusion_gym.policies.settings import parse_settings
from fusion_gym.validation import ConfigurationError, boolean, choice, keys, refusal

Kind = Literal["rule", "reference", "agent"]
Maker = Callable[..., Policy]


class Context(TypedDict):
    """What whoever asks for a policy gives to its maker, and its text never does."""

    task: Task
    trust: bool


class PolicyRow(NamedTuple):
    """A policy's maker: a callable, or where to import it, as "module:attribute"; and its kind.

    The maker takes the policy's parameters by name, the task if it has a parameter ``task``, and
    whether files may run code if it has a parameter ``trust``. Its docstring declares the policy.
    An attribute ``rest`` names the parameter that takes all the text behind it, for it may hold
    colons and commas. ``None`` is the kind of the maker: a function makes an agent, whose first
    parameter is the text behind its name; a class with a parameter ``task`` is a reference, which
    takes the task and its model; another is a rule, which looks at signals alone.
    """

    maker: Maker | str
    kind: Kind | None = None


_ROWS: dict[str, PolicyRow] = {
    name: PolicyRow(f"fusion_gym.policies.{place}")
    for name, place in {
        "adaptive_innovation": "rules.adaptive_innovation:AdaptiveInnovation",
        "adaptive_threshold": "rules.adaptive_threshold:AdaptiveThreshold",
        "always": "rules.constant:Always",
        "centre_variance": "rules.centre_variance:CentreVariance",
        "dynamic_event": "rules.dynamic_event:DynamicEvent",
        "estimate_difference": "rules.estimate_difference:EstimateDifference",
        "information_gain": "rules.information_gain:InformationGain",
        "innovation_threshold": "rules.innovation_threshold:InnovationThreshold",
        "kullback_leibler": "rules.kullback_leibler:KullbackLeibler",
        "local_variance": "rules.local_variance:LocalVariance",
        "lookahead": "lookahead:Lookahead",
        "model": "saved:saved_agent",
        "never": "rules.constant:Never",
        "optimal": "optimal:OptimalPolicy",
        "paced": "rules.paced:Paced",
        "periodic": "rules.periodic:Periodic",
        "periodic_optimum": "periodic_optimum:PeriodicOptimum",
        "priced_threshold": "rules.priced_threshold:PricedThreshold",
        "random": "rules.random:Random",
        "rollout": "rollout:Rollout",
        "round_robin": "rules.periodic:RoundRobin",
        "send_on_delta": "rules.send_on_delta:SendOnDelta",
        "stochastic_event": "rules.stochastic_event:StochasticEvent",
        "value_of_information": "rules.value_of_information:ValueOfInformation",
        "variance_threshold": "rules.variance_threshold:VarianceThreshold",
        "whittle": "whittle:WhittleIndex",
        "zoo": "saved:zoo_agent",
    }.items()
}


def register_policy(name: str, maker: Maker, kind: Kind = "rule") -> None:
    """Make a policy of your own known by a name, wherever policies are named.

    ``maker(**parameters)`` returns the policy, for example a class derived from
    :class:`fusion_gym.policies.base.Rule`; if it has a parameter ``task`` it is given the task,
    and with a parameter ``trust`` what :func:`make_policy` is given. Its other parameters are those
    that ``name:key=value`` may set.

    Raises:
        ConfigurationError: a name that exists or cannot be written, or no callable.
    """
    if not isinstance(name, str) or not name.isidentifier():
        raise refusal("name", name, "a word of letters, digits and '_'")
    if name in _ROWS:
        raise ConfigurationError(f"name = {name!r} is not allowed: there is a policy of that name")
    choice("kind", kind, get_args(Kind))
    _parameters(name, maker)
    _ROWS[name] = PolicyRow(maker, kind)


def policy_names(kind: Kind | None = None) -> list[str]:
    """Names of all policies, or of those of a kind: "rule", "reference" or "agent".

    Raises:
        ConfigurationError: an unknown kind.
    """
    if kind is not None:
        choice("kind", kind, get_args(Kind))
    return sorted(name for name, row in _ROWS.items() if kind in (None, _kind(row)))


def policy_maker(name: str) -> Maker:
    """Return what makes the policy of this name; its docstring declares the policy.

    Raises:
        ConfigurationError: an unknown name.
    """
    keys("policy", [name], _ROWS)
    return _maker(_ROWS[name])


def policy_parameters(name: str) -> dict[str, inspect.Parameter]:
    """Return the parameters that a text may set, in the maker's order.

    Raises:
        ConfigurationError: an unknown name.
    """
    return _parameters(name, policy_maker(name))


def policy_table(kind: Kind) -> str:
    """Return the policies of a kind as a Markdown table, from their declarations."""
    rows = []
    for name in policy_names(kind):
        value = list(policy_parameters(name))
        text = f"`{name}:{value.pop(0).upper()}`" if kind == "agent" else f"`{name}`"
        summary = plain_marks(read(policy_maker(name)).summary)
        rows.append((text, summary, ", ".join(f"`{key}`" for key in value)))
    return table(("policy", "meaning", "parameters"), rows)


def make_policy(spec: str, task: Task, *, trust: bool = False) -> Policy:
    """The policy that ``NAME`` or ``NAME:key=value,…`` names, tried out on one run of the task.

    Parameters that the text does not set are the task's own (``task.policy_defaults``) or the
    maker's. ``trust`` lets ``model:PATH`` run code that the file holds: without it a file is data.

    Raises:
        ConfigurationError: an unknown policy or parameter, a value that is not allowed, a model
            that cannot be read or was trained for another observation layout, or a policy that
            looks at signals which the task withholds.
    """
    context: Context = {"task": task, "trust": boolean("trust", trust) or TRUST.get()}
    policy = _make(spec, task.policy_defaults, context)
    if _kind(_asked(spec)[1]) != "agent":  # loading it has checked all that it sees
        _try_out(spec, policy, task)
    return policy


def _make(spec: str, defaults: dict[str, dict[str, Any]], context: Context) -> Policy:
    name, row, text = _asked(spec)
    maker = _maker(row)
    known = _parameters(name, maker)
    arguments: dict[str, Any] = {}
    if _kind(row) == "agent":
        key, (value, *entries) = next(iter(known)), text.split(",")
        arguments[key] = value.removeprefix(f"{key}=")
    else:
        text, arguments = _split_rest(text, getattr(maker, "rest", None))
        entries = text.split(",") if text else []
    settings = parse_settings(f"parameter of policy {name!r}", entries)
    keys(f"parameter of policy {name!r}", settings, known.keys() - arguments.keys())
    arguments |= defaults.get(name, {}) | settings
    missing = [key for key, value in known.items() if value.default is value.empty]
    for key in missing:
        if key not in arguments:
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
            f"policy {spec!r} has knowledge = {declared!r}: it must declare who knows what it "
            f"looks at, one of {', '.join(map(repr, KNOWLEDGE))}"
        )
    return policy


def _split_rest(text: str, rest: str | None) -> tuple[str, dict[str, Any]]:
    """The settings before the parameter that takes the rest of the text, and that one."""
    if rest is not None and (result := re.search(rf"(^|,)\s*{rest}=", text)):
        return text[: result.start()], {rest: text[result.end() :]}
    return text, {}


def _asked(spec: str) -> tuple[str, PolicyRow, str]:
    """The name of a policy, its row, and the text behind its name.

    Raises:
        ConfigurationError: an unknown name, or a class that cannot be imported or is no policy.
    """
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
            "__call__, as one derived from fusion_gym.policies.base.Rule"
        )
    return name, PolicyRow(result), behind


def _maker(row: PolicyRow) -> Maker:
    maker = row.maker
    if isinstance(maker, str):
        module, _, attribute = maker.partition(":")
        member: Maker = getattr(importlib.import_module(module), attribute)
        return member
    return maker


def _kind(row: PolicyRow) -> Kind:
    maker = _maker(row)
    if row.kind is not None:
        return row.kind
    if not isinstance(maker, type):
        return "agent"
    return "reference" if "task" in inspect.signature(maker).parameters else "rule"


def _parameters(name: str, maker: Maker) -> dict[str, inspect.Parameter]:
    """All but the task and the trust, in the maker's order.

    Raises:
        ConfigurationError: no callable whose parameters have names.
    """
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
    """One call on one run, so that a misfit is told before anything long begins."""
    batch = EpisodeBatch(task, 1, owner_of(policy))
    batch.reset()
    policy.reset(1)
    try:
        requests = policy(batch.signals().limit(refused_signals(policy, task)))
    except (SignalError, ConfigurationError) as error:
        raise ConfigurationError(f"policy {spec!r}: {error.args[0]}") from None
    policy.reset(1)
    shape, kind = np.shape(requests), np.asarray(requests).dtype
    if shape != (task.sensors, 1) or kind != np.bool_:
        raise ConfigurationError(
            f"policy {spec!r} requests with an array of {kind} {shape}: it must be bool "
            f"({task.sensors}, 1), sensors and runs"
        )
