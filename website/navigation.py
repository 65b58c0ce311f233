"""The site's table of contents; what is not there yet is left out."""

from collections.abc import Iterable
from typing import Any

from website import reference
from website.parts import KIND_NAMES, parts
from website.places import DOCS, pages_of

# Titles are short here, for a phone; pages that are not named stand at the end of "Use".
_USE = (
    ("Environments", "use.md"),
    ("Policies", "policies.md"),
    ("Memory and communication", "memory.md"),
    ("Training", "training.md"),
    ("Counterfactual learning", "learning.md"),
    ("Other libraries", "other_libraries.md"),
    ("A system of your own", "own_system.md"),
    ("Export", "export.md"),
    ("Where the truth differs", "robustness.md"),
    ("Speed", "speed.md"),
    ("Many machines", "cluster.md"),
    ("The demo", "demo.md"),
    ("Glossary", "glossary.md"),
    ("Versions", "versions.md"),
)
_TUTORIALS = (
    ("A first trigger of your own", "tutorials/first_trigger.md"),
    ("A plant of your own", "tutorials/own_plant.md"),
    ("A reward of your own", "tutorials/own_reward.md"),
    ("How to read a front", "tutorials/reading_a_front.md"),
    ("Many sensors, local decisions", "tutorials/many_sensors.md"),
    ("Training with other libraries", "tutorials/other_libraries.md"),
)
_BENCHMARK = (
    ("What is compared", "benchmark.md"),
    ("What no policy can undercut", "bounds.md"),
    ("What is known of the optimum", "optimality.md"),
)
_CONTRIBUTING = (("Adding a system", "add_system.md"),)


def navigation() -> list[Any]:
    """The tree of titles and pages."""
    start = [
        ("Start", "index.md"),
        ("How one step works", "step.md"),
        ("For newcomers", "newcomer.md"),
    ]
    environments = list(dict.fromkeys(f"{page}.md" for page in pages_of().values()))
    groups = (start, _USE, _BENCHMARK, _CONTRIBUTING)
    named = {page for group in groups for _, page in group} | set(environments)
    others = sorted(path.name for path in DOCS.glob("*.md") if path.name not in named)
    jobs = {
        kind: [f"{kind}/index.md", *(f"{kind}/{part.name}.md" for part in parts(kind))]
        for kind in KIND_NAMES
    }
    return [
        {"Start": _there(start)},
        {"Tutorials": _there(_TUTORIALS) + _unnamed("tutorials", _TUTORIALS)},
        {"Use": _there(_USE) + others},
        {"Environments": environments},
        {"Parts": [{KIND_NAMES[kind]: pages} for kind, pages in jobs.items()]},
        {
            "Results": [
                {"Report": "results/report.md"},
                {"Strongest rules": "results/envelopes.md"},
                {"How fast agents learn": "results/learning.md"},
                *_there(_BENCHMARK),
            ]
        },
        *_reproduction(),
        {"Reference": ["api/index.md", *_tree()]},
        {
            "Contributing": [
                *_there(_CONTRIBUTING),
                {"Contributing": "contributing.md"},
                {"Changes": "changelog.md"},
            ]
        },
    ]


def _there(pages: Iterable[tuple[str, str]]) -> list[Any]:
    return [{title: page} for title, page in pages if (DOCS / page).exists()]


def _unnamed(folder: str, named: Iterable[tuple[str, str]]) -> list[Any]:
    known = {page for _, page in named}
    every = [f"{folder}/{path.name}" for path in sorted((DOCS / folder).glob("*.md"))]
    return [page for page in every if page not in known]


def _reproduction() -> list[Any]:
    """The pages of docs/reproduction, its overview first."""
    folder = DOCS / "reproduction"
    names = sorted(path.name for path in folder.glob("*.md"))  # README.md is first: capitals
    return [{"Reproduction": [f"reproduction/{name}" for name in names]}] if names else []


def _tree() -> list[Any]:
    """Modules by the packages of the library."""
    groups: dict[str, list[Any]] = {}
    for name in reference.modules():
        package = name.split(".")[1]
        groups.setdefault(package, []).append({_short(name): reference.place(name)})
    return [pages[0] if len(pages) == 1 else {package: pages} for package, pages in groups.items()]


def _short(module: str) -> str:
    parts = module.split(".")[1:]
    return parts[-1] if len(parts) < 3 else ".".join(parts[1:])
