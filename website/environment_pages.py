"""What the site adds to an environment's page: an overview, and what ``help`` says."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Sequence

import fusion_gym
from fusion_gym.envs.pages import page
from fusion_gym.envs.registration import ENVIRONMENTS, options_of
from fusion_gym.envs.views import make_view
from website.parts import ALSO, FILTERS, PAGES_OF, offered
from website.places import DOCS

SECTIONS = ("Action space", "Reward", "Episode end", "Info")


def of_page(name: str) -> list[str]:
    """Ids of the environments that a page tells of."""
    return [env_id for env_id in ENVIRONMENTS if PAGES_OF.get(env_id) == name]


def at_a_glance(env_id: str) -> str:
    """A table of what the environment is, made from the code."""
    task = fusion_gym.make_task(env_id)
    view, kind = make_view(task), options_of(env_id)
    rows = [
        ("id", f"`{env_id}`"),
        ("options", f"[`{kind.__name__}`][{kind.__module__}.{kind.__name__}]"),
        ("sensors", str(task.sensors)),
        ("states", ", ".join(f"`{name}`" for name in task.system.state_names)),
        ("observation", f"{len(view.names)} float32 numbers"),
        ("action", f"`{view.actions}`"),
        ("steps of an episode", str(task.horizon)),
    ]
    if names := offered("filter")[env_id]:
        rows.append(("filters", ", ".join(_filter_link(env_id, name) for name in names)))
    if names := offered("fusion")[env_id]:
        rows.append(("fusion", ", ".join(f"[`{name}`](fusion/{name}.md)" for name in names)))
    paper = _paper(env_id)
    if (DOCS / "reproduction" / f"{paper}.md").exists():
        rows.append(("made anew", f"[the paper's figures and claims](reproduction/{paper}.md)"))
    return _table(("", env_id.split("/")[1]), rows)


def sections(env_id: str) -> str:
    """Actions, reward, end and info: the sections of the page that ``help`` shows."""
    name = env_id.split("/")[1]
    found = re.findall(r"^## (.+)\n((?:(?!## ).*\n)+)", page(env_id), re.MULTILINE)
    return "\n\n".join(
        f"### {head} of {name}\n\n{text.strip()}" for head, text in found if head in SECTIONS
    )


def with_tables(text: str, name: str) -> str:
    """A page of environments with an overview of each before it, and ``help`` of each behind it."""
    every = of_page(name)
    head, mark, body = text.partition("\n## ")
    overview = "\n\n".join(at_a_glance(env_id) for env_id in every)
    tail = "\n\n".join(["## From the code", *(sections(env_id) for env_id in every)])
    return f"{head.strip()}\n\n{overview}\n{mark}{body.strip()}\n\n{tail}\n"


def _filter_link(env_id: str, name: str) -> str:
    found = [
        slug for slug, (_, _, value, ids) in FILTERS.items() if value == name and env_id in ids
    ]
    slug = found[0] if found else ALSO.get((name, env_id))
    return f"[`{name}`](filters/{slug}.md)" if slug else f"`{name}`"


def _paper(env_id: str) -> str:
    """The word by which the module of the environment's options names its paper."""
    module = inspect.getdoc(sys.modules[options_of(env_id).__module__]) or ""
    found = re.search(r"^Source: (\w+)", module, re.MULTILINE)
    return found[1] if found else ""


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    lines = [head, tuple("---" for _ in head), *rows]
    return "\n".join(
        "| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in lines
    )
