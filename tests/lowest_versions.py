"""The lowest versions that pyproject.toml allows, as constraints for pip.

    python tests/lowest_versions.py > constraints-lowest.txt

torch alone has the version of constraints.txt: its oldest wheels bring gigabytes of GPU libraries.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parent.parent


def lowest() -> dict[str, str]:
    """The lowest version of every package that the project and its extras name.

    Raises:
        ValueError: a requirement that is not ``NAME>=VERSION``.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    requirements = [*project["dependencies"], *sum(project["optional-dependencies"].values(), [])]
    found = {}
    for requirement in requirements:
        named = re.fullmatch(r"([\w-]+)>=([\d.]+)", requirement)
        if named is None:
            raise ValueError(f"requirement {requirement!r} is not allowed: write NAME>=VERSION")
        found[named[1]] = named[2]
    pinned = dict(
        line.split("==")
        for line in (ROOT / "constraints.txt").read_text().split("\n")
        if "==" in line
    )
    return found | {"torch": pinned["torch"]}


if __name__ == "__main__":
    print("\n".join(f"{name}=={version}" for name, version in lowest().items()))
