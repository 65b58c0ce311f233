"""Environments that have the wheel, chosen extras of it with all that these need, and nothing else.

The packages are links to those of the interpreter that runs this, so that nothing is loaded twice.
"""

import csv
import functools
import importlib.metadata
import os
import subprocess
import sys
import sysconfig
import threading
import venv
import zipfile
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import Distribution
from pathlib import Path, PurePosixPath

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

OWN = "fusion-gym"
_ALONE = threading.Lock()
_SCRIPT = """#!{python}
import sys
from {module} import {first}
sys.exit({call}())
"""


class Absent(Exception):
    """A package that an extra needs is not installed here."""


@dataclass(frozen=True)
class Environment:
    """A folder with a Python of its own."""

    folder: Path

    @property
    def programs(self) -> Path:
        """Where ``python`` and ``fusion-gym`` are."""
        return self.folder / ("Scripts" if os.name == "nt" else "bin")

    @property
    def packages(self) -> Path:
        """Where its packages are."""
        return Path(sysconfig.get_path("purelib", "venv", vars={"base": str(self.folder)}))


@dataclass(frozen=True)
class Wheel:
    """A built wheel, and the environments that are made of it, below a folder."""

    file: Path
    folder: Path

    @functools.cached_property
    def metadata(self) -> Mapping[str, list[str]]:
        """Its fields, each with all of its values."""
        with zipfile.ZipFile(self.file) as packed:
            (name,) = (item for item in packed.namelist() if item.endswith(".dist-info/METADATA"))
            result = defaultdict(list)
            for line in packed.read(name).decode().partition("\n\n")[0].splitlines():
                key, _, value = line.partition(": ")
                result[key].append(value)
        return result

    @property
    def extras(self) -> list[str]:
        """Names of its extras."""
        return self.metadata["Provides-Extra"]

    def environment(self, extras: frozenset[str]) -> Environment:
        """The environment with these extras, which one thread makes once.

        Raises:
            Absent: something that they need is not installed here.
        """
        with _ALONE:
            return self._environment(extras)

    @functools.cache  # noqa: B019 - one wheel a run
    def _environment(self, extras: frozenset[str]) -> Environment:
        needed = closure(map(Requirement, self.metadata["Requires-Dist"]), extras)
        environment = Environment(self.folder / "_".join(["wheel", *sorted(extras)]))
        venv.create(environment.folder, with_pip=False)
        _link(needed, environment.packages)
        with zipfile.ZipFile(self.file) as packed:
            packed.extractall(environment.packages)
        own = Distribution.at(next(environment.packages.glob("fusion_gym-*.dist-info")))
        for item in (own, *needed.values()):
            _scripts(item, environment)
        return environment


def closure(expected: Iterable[Requirement], extras: Iterable[str]) -> dict[str, Distribution]:
    """The installed packages that these need, by name.

    Raises:
        Absent: one is not installed.
    """
    result: dict[str, Distribution] = {}
    own = [*expected]
    left = [(item, tuple(extras)) for item in own]
    visited = set()
    while left:
        requirement, selection = left.pop()
        worlds = [{"extra": extra} for extra in ("", *selection)]
        if requirement.marker and not any(map(requirement.marker.evaluate, worlds)):
            continue
        name = canonicalize_name(requirement.name)
        key = (name, frozenset(requirement.extras))
        if key in visited:
            continue
        visited.add(key)
        if name == OWN:  # an extra that consists of others
            left += [(item, tuple(requirement.extras)) for item in own]
            continue
        try:
            result[name] = importlib.metadata.distribution(name)
        except importlib.metadata.PackageNotFoundError:
            raise Absent(name) from None
        more = result[name].requires or []
        left += [(Requirement(text), tuple(requirement.extras)) for text in more]
    return result


@functools.cache
def _owners() -> dict[PurePosixPath, set[str]]:
    """Of every file and folder of the installed packages, the packages that it belongs to."""
    owners: dict[PurePosixPath, set[str]] = defaultdict(set)
    for distribution in importlib.metadata.distributions():
        name = canonicalize_name(distribution.metadata["Name"])
        for file, *_ in csv.reader((distribution.read_text("RECORD") or "").splitlines()):
            path = PurePosixPath(file)
            if ".." not in path.parts and not path.is_absolute():
                for part in (path, *path.parents[:-1]):
                    owners[part].add(name)
    return owners


def _link(needed: Mapping[str, Distribution], folder: Path) -> None:
    """Link what belongs to these packages alone; folders that others share are made anew."""
    owners = _owners()
    children = defaultdict(list)
    for path in owners:
        children[path.parent].append(path)
    left = list(children[PurePosixPath(".")])
    while left:
        path = left.pop()
        if not owners[path] & needed.keys() or path.name == "__pycache__":
            continue
        (name, *_) = owners[path] & needed.keys()
        target = Path(str(needed[name].locate_file(str(path))))
        if owners[path] <= needed.keys() or target.is_file():
            if target.exists():
                (folder / path).symlink_to(target)
        else:
            (folder / path).mkdir()
            left += children[path]


def _scripts(entry: Distribution, world: Environment) -> None:
    """The programs of a package."""
    for point in entry.entry_points.select(group="console_scripts"):
        script = world.programs / point.name
        first = point.attr.partition(".")[0]
        script.write_text(
            _SCRIPT.format(
                python=world.programs / "python", module=point.module, first=first, call=point.attr
            )
        )
        script.chmod(0o755)


def build(source: Path, folder: Path) -> Path:
    """The wheel of a source tree."""
    words = [sys.executable, "-m", "build", "--wheel", "--outdir", str(folder), str(source)]
    done = subprocess.run(words, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stdout + done.stderr)
    (wheel,) = folder.glob("*.whl")
    return wheel
