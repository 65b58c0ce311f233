"""What the site adds to an environment's page: an overview, and what ``help`` says."""

import re

import fusion_gym
from fusion_gym.docstrings import table
from fusion_gym.envs.pages import page
from fusion_gym.envs.registration import ENVIRONMENTS, options_of
from fusion_gym.envs.views import make_view
from website.papers import paper_of
from website.places import DOCS, pages_of

SECTIONS = ("Action space", "Reward", "Episode end", "Info")


def of_page(name: str) -> list[str]:
    """Ids of the environments that a page tells of."""
    return [env_id for env_id in ENVIRONMENTS if pages_of().get(env_id) == name]


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
    links = [
        f"[`{name or owner.__name__}`](filters/{owner.__name__}.md)"
        for name, owner in kind.filters.items()
    ]
    if links:
        rows.append(("filters", ", ".join(links)))
    if kind.structure is not None:
        names = kind.structure.offered
        rows.append(("fusion", ", ".join(f"[`{name}`](fusion/{name}.md)" for name in names)))
    paper = paper_of(env_id)
    if (DOCS / "reproduction" / f"{paper}.md").exists():
        rows.append(("reproduced", f"[the paper's figures and claims](reproduction/{paper}.md)"))
    return table(("", env_id.split("/")[1]), rows)


def sections(env_id: str) -> str:
    """Actions, reward, end and info: the sections of the page that ``help`` shows."""
    name = env_id.split("/")[1]
    result = re.findall(r"^## (.+)\n((?:(?!## ).*\n)+)", page(env_id), re.MULTILINE)
    return "\n\n".join(
        f"### {head} of {name}\n\n{text.strip()}" for head, text in result if head in SECTIONS
    )


def with_tables(text: str, name: str) -> str:
    """A page of environments with an overview of each before it, and ``help`` of each behind it."""
    every = of_page(name)
    head, mark, body = text.partition("\n## ")
    overview = "\n\n".join(at_a_glance(env_id) for env_id in every)
    tail = "\n\n".join(["## From the code", *(sections(env_id) for env_id in every)])
    return f"{head.strip()}\n\n{overview}\n{mark}{body.strip()}\n\n{tail}\n"
