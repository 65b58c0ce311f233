"""The reference: a page a public module of the library, made of its docstrings."""

from typing import Any

from website.places import ROOT

_INDEX = """\
# Reference

Every public module of the library, from its docstrings. Shapes have the batch axis N last. What
most people need is imported by `import fusion_gym` alone:

::: fusion_gym
    options: {summary: {modules: true}, skip_local_inventory: true}
"""


def modules() -> list[str]:
    """The dotted names of the public modules."""
    paths = sorted((ROOT / "fusion_gym").rglob("*.py"))
    names = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in paths]
    public = (
        name.removesuffix(".__init__")
        for name in names
        if "._" not in name.removesuffix(".__init__")
    )
    return [name for name in public if name != "fusion_gym"]


def pages() -> dict[str, str]:
    """All pages by their places."""
    return {"api/index.md": _INDEX} | {
        f"api/{n}.md": f"# `{n}` {{ #{n} }}\n\n::: {n}\n" for n in modules()
    }


def navigation() -> list[Any]:
    """The pages by the packages of the library."""
    groups: dict[str, list[dict[str, str]]] = {}
    for name in modules():
        _, package, *inner = name.split(".")
        groups.setdefault(package, []).append({".".join(inner) or package: f"api/{name}.md"})
    return ["api/index.md", *({package: pages} for package, pages in groups.items())]
