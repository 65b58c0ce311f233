"""What the site adds to an environment's page: an overview and tables, made from the code."""

from __future__ import annotations

from collections.abc import Sequence

import fusion_gym
from fusion_gym.core.options import CommonOptions
from fusion_gym.core.task import Task
from fusion_gym.docstrings import table
from fusion_gym.envs.option_text import options_in, short
from fusion_gym.envs.registration import ENVIRONMENTS, options_of
from fusion_gym.envs.vector import reset_infos
from fusion_gym.envs.views import make_view
from fusion_gym.fusion.table import offered
from website.papers import paper_of
from website.parts import filter_slug
from website.places import DOCS, pages_of

MEANINGS = {
    "cost": "tokens spent in the step, never negative (the convention of constrained learning)",
    "cost_tokens": "the same, by its name",
    "reward_error": "the error's term of the reward",
    "reward_cost": "the tokens' term of the reward",
    "granted": "which requests the network granted",
    "denied": "which requests it denied",
    "squared_error": "squared error of the fused estimate, a number a state",
    "diverged": "whether a squared error is above 100 times its open-loop mean, or not finite",
}


def of_page(page: str) -> list[str]:
    """Ids of the environments that a page tells of."""
    return [env_id for env_id in ENVIRONMENTS if pages_of().get(env_id) == page]


def at_a_glance(env_id: str) -> str:
    """A table of what the environment is, made from the code."""
    task = fusion_gym.make_task(env_id)
    view = make_view(task)
    rows = [
        ("id", f"`{env_id}`"),
        ("options", f"[`{options_of(env_id).__name__}`][{_place(options_of(env_id))}]"),
        ("sensors", str(task.sensors)),
        ("states", ", ".join(f"`{name}`" for name in task.system.state_names)),
        ("observation", f"{len(view.names)} float32 numbers"),
        ("action", f"`{view.actions}`"),
        ("steps of an episode", str(task.horizon)),
    ]
    kind = options_of(env_id)
    links = [
        f"[`{name or owner.__name__}`](filters/{filter_slug(owner)}.md)"
        for name, owner in kind.filters.items()
    ]
    if links:
        rows.append(("filters", ", ".join(links)))
    if kind.structure is not None:
        names = offered(kind.structure)
        rows.append(("fusion", ", ".join(f"[`{name}`](fusion/{name}.md)" for name in names)))
    paper = paper_of(env_id)
    if (DOCS / "reproduction" / f"{paper}.md").exists():
        rows.append(("made anew", f"[the paper's figures and claims](reproduction/{paper}.md)"))
    return table(("", env_id.split("/")[1]), rows)


def tables(env_id: str) -> str:
    """Actions, reward, info and options, made from the code."""
    task = fusion_gym.make_task(env_id)
    name = env_id.split("/")[1]
    parts = [
        f"### Actions of {name}",
        table(("with", "action space", "meaning"), _actions(env_id)),
        f"### Reward of {name}",
        table(("", "by default"), _reward(task)),
        f"### Info of {name}",
        table(("entry", "type", "shape", "meaning"), _infos(task)),
        f"### Options of {name}",
        table(("option", "type", "default"), _options(options_of(env_id))),
    ]
    return "\n\n".join(parts)


def with_tables(text: str, page: str) -> str:
    """An environment's page with an overview before its sections, and tables at its end."""
    every = of_page(page)
    head, mark, sections = text.partition("\n## ")
    overview = "\n\n".join(at_a_glance(env_id) for env_id in every)
    tail = "\n\n".join(["## From the code", *(tables(env_id) for env_id in every)])
    return f"{head.strip()}\n\n{overview}\n{mark}{sections.strip()}\n\n{tail}\n"


def _place(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"


def _actions(env_id: str) -> Sequence[tuple[str, ...]]:
    rows = []
    for words, options, meaning in (
        ("the defaults", {}, "a flag a sensor: 1 requests a transmission"),
        (
            '`action="discrete"`',
            {"action": "discrete"},
            "the flags as one number, sensor 0 the lowest",
        ),
        ('`access="single"`', {"access": "single"}, "0 for nobody, m for sensor m - 1"),
    ):
        space = make_view(fusion_gym.make_task(env_id, **options)).actions
        if space.__class__.__name__ == "Discrete" and not options:
            meaning = "0 for nobody, m for sensor m - 1"
        rows.append((words, f"`{space}`", meaning))
    alone = fusion_gym.parallel_env(env_id)
    space = alone.action_space(alone.possible_agents[0])
    rows.append(("a sensor by itself", f"`{space}`", "1 requests a transmission"))
    return rows


def _reward(task: Task) -> list[tuple[str, ...]]:
    weights = task.reward.state_weights[:, 0]
    open_loop = float(weights @ task.system.open_loop(task.horizon))
    names = task.system.state_names
    shown = ", ".join(f"`{n}` {w:.4g}" for n, w in zip(names, weights, strict=True))
    return [
        ("reward", "-(`error_weight` · Σ wᵢ eᵢ² + `cost_weight` · tokens spent)"),
        ("weights w of the states", shown),
        ("`error_weight`", f"{task.reward.error_weight:g}"),
        ("`cost_weight`", short(task.reward.price.fixed)),
        (
            "error's term if nothing is ever sent",
            f"about -{open_loop * task.reward.error_weight:.3g} a step",
        ),
    ]


def _infos(task: Task) -> Sequence[tuple[str, ...]]:
    found = []
    for key, value in reset_infos(task, 1).items():
        if not key.startswith("_"):
            shape = "number" if value.ndim == 1 else f"({', '.join(map(str, value.shape[1:]))},)"
            found.append((f"`{key}`", str(value.dtype), shape, MEANINGS[key]))
    return found


def _options(kind: type[CommonOptions]) -> Sequence[tuple[str, ...]]:
    return [
        (f"`{name}`", _words(option.type), f"`{_cut(short(option.default))}`")
        for name, option in options_in(kind).items()
    ]


def _words(annotation: str) -> str:
    known = {"ArrayLike": "number or array", "str": "word", "float": "number"}
    known["int"] = "whole number"
    return " or ".join(known.get(part, part) for part in annotation.split(" | "))


def _cut(text: str) -> str:
    return text if len(text) <= 60 else f"{text[:57]}…"
