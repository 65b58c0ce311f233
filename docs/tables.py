"""Write the tables of the pages: ``python -m docs.tables``; ``--check`` refuses old tables.

``TABLES`` has the kinds. A table stands between ``<!-- table: KIND TEXT -->`` and ``<!-- end -->``.
"""

import inspect
import pydoc
import re
import statistics
import sys
import warnings
from collections import ChainMap
from pathlib import Path
from typing import Any, cast

from fusion_gym.core.access import ACCESS
from fusion_gym.core.knowledge import MEANING
from fusion_gym.core.task import Task
from fusion_gym.docstrings import plain_marks, read, table
from fusion_gym.envs import pages
from fusion_gym.envs.option_text import FOR_ALL, options_in, short
from fusion_gym.envs.registration import ENVIRONMENTS, make_task, options_of
from fusion_gym.envs.returns import returns_of, reward_threshold, share_text
from fusion_gym.envs.views import make_view
from fusion_gym.errors import ConfigurationError
from fusion_gym.evaluation.metrics import metric_table
from fusion_gym.fusion.table import RULES
from fusion_gym.policies import registry
from fusion_gym.policies.registry import parse_settings
from fusion_gym.systems.tobit.system import FeedbackOptions
from fusion_gym.training.config import algorithm_table

# Interfaces by letter: a further option, and a policy that runs there.
_INTERFACES = {
    "N": ("backend=numpy", "always"),
    "J": ("", "always"),
    "R": ("memory=true", "rollout:base=never"),
    "P": ("", "periodic_optimum:packets=1,period=1"),
    "S": ("", "optimal"),
}
ENVIRONMENT_PAGE = Path(__file__).with_name("environments.md")
_PAPERS = {
    "tobit_oscillator.md": (1, "tobit_token_bucket"),
    "correlated_tracking.md": (2, "adaptive_innovation"),
    "markov_jump.md": (3, "markov_jump"),
    "biased.md": (4, "round_robin_tobit"),
    "unknown_input.md": (5, "unknown_input"),
}  # by the page of an environment
_LEGEND = "Only sensors know an entry with a star ([who knows what](concepts.md#who-knows-what))."
# Options that several environments share, by the class that declares them, bases first.
_COMMON = {
    kind.__name__: {k: v for k, v in options_in(kind).items() if k in kind.__annotations__}
    for kind in FeedbackOptions.__mro__[-3::-1]  # without OptionGroup and object
} | {"FOR_ALL": FOR_ALL}


def fact_table(env_id: str) -> str:
    """Return what a registered environment is."""
    view = make_view(task := make_task(env_id))
    rows = [
        ("sensors", str(task.sensors)),
        ("states", ", ".join(f"`{name}`" for name in task.plant.state_names)),
        ("observation", f"{len(view.names)} float32 numbers"),
        ("action", f"`{view.action.space}`"),
        ("steps of an episode", str(task.horizon)),
    ]
    return table(("id", f"`{env_id}`"), rows)


def observation_table(text: str) -> str:
    """Return the blocks of an observation below their legend.

    Args:
        text: ``ID name=value …``; after a semicolon other options, whose additional blocks the
            table marks.
    """
    first, *others = text.split("; ")
    rest = [(f"`{other}`", task_of(f"{first.split()[0]} {other}")) for other in others]
    return f"{_LEGEND}\n\n{pages.observation_table(task_of(first), *rest)}"


def option_table(text: str) -> str:
    """Return the options of a group, or what environments add to the common ones and change.

    Args:
        text: A group of ``_COMMON``; or ids of environments with the same options, and after
            ``beyond`` the id of one whose options they extend.
    """
    ids, _, other = text.partition(" beyond ")
    every = [_COMMON.get(name) or options_in(options_of(name)) for name in ids.split()]
    known = [options_in(options_of(other))] if other else []
    common = ChainMap(*known, *({} if text in _COMMON else _COMMON).values())
    rows, changed = [], []
    for name, option in every[0].items():
        defaults = dict.fromkeys(short(options[name].default) for options in every)
        if name in common and common[name].meaning == option.meaning:
            if {*defaults} != {short(common[name].default)}:
                changed.append(f"`{name}={' or '.join(defaults)}`".replace("'", '"'))
            continue
        types = " or ".join(f"`{part}`" for part in option.type.split(" | "))
        usual = " or ".join(f"`{default}`" if len(default) < 60 else "…" for default in defaults)
        cells = types.replace("'", '"'), usual.replace("'", '"'), plain_marks(option.meaning)
        rows.append((f"`{name}`", *cells))
    result = table(("option", "type", "default", "meaning"), rows)
    if changed:
        result += f"\n\nOther defaults of [common options](options.md): {', '.join(changed)}."
    return result


def network_table(text: str) -> str:
    """Return where sets of options run, ``name=value … ; …``, by the letters of ``_INTERFACES``."""
    ids = {env_id: env_id.partition("/")[2].partition("-")[0] for env_id in ENVIRONMENTS}
    rows = []
    for options in " ".join(text.split()).split("; "):
        cells = [
            "".join(
                k for k, own in _INTERFACES.items() if _runs(f"{env_id} {options}", *own, k == "J")
            )
            or "–"
            for env_id in ids
        ]
        rows.append((f"`{options}`", *cells))
    return table(("options", *ids.values()), rows)


def rule_table(text: str) -> str:
    """Return which rules run with sets of options in one of some environments at least.

    Args:
        text: ``ID ID …; name=value …; …``; in an option RULE is the rule's name.
    """
    ids, *columns = " ".join(text.split()).split("; ")
    rows = []
    for rule in registry.policy_names("rule"):
        own = [options.replace("RULE", rule) for options in columns]
        runs = [any(_runs(env_id, more, rule) for env_id in ids.split()) for more in own]
        rows.append((f"`{rule}`", *("✓" if each else "–" for each in runs)))
    return table(("rule", *(f"`{options}`" for options in columns)), rows)


def _runs(text: str, more: str, policy: str, compiled: bool = False) -> bool:
    try:
        with warnings.catch_warnings(action="ignore"):
            task = task_of(f"{text} {more}")
            registry.make_policy(policy, task)
            if compiled:
                task.refuse_numpy_only()
    except ConfigurationError:
        return False
    return True


def task_of(text: str) -> Task:
    """Return the task of the text ``ID name=value …``."""
    env_id, *options = text.split()
    return make_task(env_id, **parse_settings("option", options))


def filter_table(env_id: str) -> str:
    """Return the values of an environment's option ``filter``."""
    rows = (
        (f'`"{name}"`' if name else "–", _link(owner), _meaning(owner))
        for name, owner in options_of(env_id).filters.items()
    )
    return table(("`filter`", "class", "meaning"), rows)


def fusion_table(text: str) -> str:
    """Return the values of the option ``fusion`` of an environment, or of ``all``."""
    rows = (
        (f'`"{name}"`', _link(type(row.make())), row.assumes, plain_marks(row.meaning))
        for name, row in RULES.items()
        if text == "all" or name in getattr(options_of(text).structure, "offered", ())
    )
    return table(("`fusion`", "class", "assumes", "meaning"), rows)


def access_table(_: str) -> str:
    """Return the rules of medium access."""
    rows = ((f'`"{name}"`', plain_marks(row.meaning)) for name, row in ACCESS.items())
    return table(("`access`", "meaning"), rows)


def policy_table(text: str) -> str:
    """Return the policies of a kind: the columns that the text names after the kind."""
    kind, *columns = text.split()
    rows = []
    for name in registry.policy_names(cast(registry.Kind, kind)):
        maker, parameters = registry.policy_maker(name), list(registry.policy_parameters(name))
        knowledge = getattr(maker, "knowledge", None)
        cells = {
            "policy": f"`{name}:{parameters.pop(0).upper()}`" if kind == "agent" else f"`{name}`",
            "class": _link(maker),
            "meaning": _meaning(maker),
            "knowledge": MEANING[knowledge] if knowledge in MEANING else _meaning(knowledge),
            "parameters": ", ".join(f"`{key}`" for key in parameters),
        }
        rows.append(tuple(cells[column] for column in columns))
    return table(tuple(columns), rows)


def name_table(text: str) -> str:
    """Return the names of names.rst that a regular expression matches."""
    lines = Path(__file__).with_name("names.rst").read_text(encoding="utf-8").split()
    owners = {line: pydoc.locate(line) for line in lines if re.fullmatch(text, line)}
    rows = ((_link(owner, name), _meaning(owner)) for name, owner in owners.items())
    return table(("name", "meaning"), rows)


def return_table(text: str) -> str:
    """Return the environments with their papers, sensors and returns.

    Args:
        text: the kinds of policies, separated by semicolons; ``tuned rule`` is the better one.
    """
    kinds = [kind.strip() for kind in text.split(";")]
    pages_of = dict(re.findall(r"\[`(\w+-v\d)`\]\((\w+\.md)\)", ENVIRONMENT_PAGE.read_text()))
    rows = []
    for env_id in ENVIRONMENTS:
        name, task = env_id.rpartition("/")[2], make_task(env_id)
        paper, bucket = _PAPERS.get(pages_of[name]), task.network.bucket
        means = {kind: statistics.median(own) for kind, own in returns_of(env_id).items()}
        means["tuned rule"] = reward_threshold(env_id) or 0.0
        cells = (f"{means[kind]:.4g}".replace("-", "−") if kind in means else "–" for kind in kinds)
        rows.append((
            f"[`{name}`](docs/{pages_of[name]})",
            f"[{paper[0]}](docs/reproduction/{paper[1]}.md)" if paper else "–",
            f"`{make_view(task).action.space}`",
            "unlimited" if bucket.unlimited else f"{bucket.rate:g} per step",
            *cells,
        ))  # fmt: skip
    return table(("environment", "paper", "action", "tokens", *kinds), rows)


def share_table(text: str) -> str:
    """Return which share of the gap to the best threshold learners close in each environment.

    Args:
        text: the kinds of learners, separated by semicolons.
    """
    kinds = [kind.strip() for kind in text.split(";")]
    rows = (
        (f"`{env_id.rpartition('/')[2]}`", *(share_text(env_id, kind) for kind in kinds))
        for env_id in ENVIRONMENTS
    )
    return table(("environment", *kinds), rows)


TABLES = {
    "access": access_table, "algorithms": algorithm_table, "facts": fact_table,
    "filters": filter_table, "fusion": fusion_table, "metrics": metric_table, "names": name_table,
    "networks": network_table,
    "observation": observation_table, "options": option_table, "policies": policy_table,
    "returns": return_table, "rules": rule_table, "shares": share_table,
}  # fmt: skip
PART = re.compile(r"(?ms)^(<!-- table: (\w+)\s([^>]+?)\s-->\n).*?^(<!-- end -->)$")


def written(text: str) -> str:
    """Return a page with its tables as the code has them now."""
    return PART.sub(lambda part: f"{part[1]}\n{TABLES[part[2]](part[3])}\n\n{part[4]}", text)


def _link(owner: Any, text: str = "") -> str:
    """Return a name as a link to its source; the site leads it to the name's own page."""
    path = Path(inspect.getsourcefile(owner) or "").relative_to(Path(pages.__file__).parents[2])
    return f"[`{text or owner.__name__}`](../{path.as_posix()})"


def _meaning(owner: Any) -> str:
    return plain_marks(read(owner).summary)


if __name__ == "__main__":
    folder = Path(__file__).parent
    for path in (folder.parent / "README.md", *sorted(folder.rglob("*.md"))):
        text = path.read_text(encoding="utf-8")
        if (new := written(text)) != text:
            if "--check" in sys.argv:
                sys.exit(f"old tables in {path}: make pages")
            path.write_text(new, encoding="utf-8")
