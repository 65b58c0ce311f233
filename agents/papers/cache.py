"""Simulated pieces in the work folder, each with a hash of all that it is made from."""

import ast
import functools
import hashlib
import json
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import fusion_gym
from fusion_gym.validation import ConfigurationError

from ..output.files import DAMAGED, replacing
from ..output.folders import fingerprint
from .paper import Data, Piece, load_paper

_PLAIN = "plain"  # the entry that holds all that is no array, as JSON
_ROOT = Path(fusion_gym.__file__).parent


class PieceJob(NamedTuple):
    """A piece of a paper with its episodes, seed and settings, and its work folder.

    ``restriction`` has the keywords of a figure that shows a part of the piece.
    """

    paper: str
    piece: str
    episodes: int
    seed: int
    settings: Data
    restriction: Data
    work: Path

    @property
    def path(self) -> Path:
        """The file of the result."""
        return self.work / self.paper / f"{self.piece}.npz"

    @property
    def made_from(self) -> str:
        """A hash of the inputs and of the code."""
        code = code_of(self.find().simulate.__module__)
        return fingerprint(self._asdict() | {"work": "", "code": code})

    def find(self) -> Piece:
        """Return the piece itself."""
        return load_paper(self.paper).piece(self.piece)

    def finished(self) -> bool:
        """Return whether the result is there, made from the same."""
        try:
            self.read()
        except (ConfigurationError, FileNotFoundError):
            return False
        return True

    def read(self) -> Data:
        """Return the result of the simulation.

        Raises:
            FileNotFoundError: it is not there.
            ConfigurationError: it cannot be read, or was made from something else.
        """
        if not self.path.exists():
            raise FileNotFoundError(str(self.path))
        try:
            with np.load(self.path, allow_pickle=False) as arrays:
                if str(arrays["made_from"]) != self.made_from:
                    raise ValueError("it was made from something else")
                content: Data = json.loads(str(arrays[_PLAIN]))
                names = [name for name in arrays.files if name.startswith("/")]
                return content | {name[1:]: arrays[name] for name in names}
        except (*DAMAGED, zipfile.BadZipFile) as error:
            raise ConfigurationError(
                f"work = {str(self.path)!r} cannot be read: {' '.join(str(error).split())}"
            ) from None


def simulate_piece(job: PieceJob) -> None:
    """Simulate a piece and keep its result."""
    result = job.find().simulate(job.episodes, job.seed, job.settings, **job.restriction)
    arrays = {f"/{name}": value for name, value in result.items() if isinstance(value, np.ndarray)}
    plain = {name: value for name, value in result.items() if not isinstance(value, np.ndarray)}
    with replacing(job.path) as partial:
        data: dict[str, Any] = arrays | {_PLAIN: np.array(json.dumps(plain))}
        np.savez_compressed(partial, made_from=np.array(job.made_from), **data)


@functools.cache
def code_of(module: str) -> str:
    """Return a hash of the code of a module and of all modules of the project that it imports.

    Comments and docstrings do not count.
    """
    modules: dict[str, str] = {}
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name not in modules and (path := _source(name)):
            modules[name], imports = read_module(name, path)
            waiting += imports
    return fingerprint(modules)


def _source(name: str) -> Path | None:
    first, *rest = name.split(".")
    folder = _ROOT.joinpath(*rest)
    paths = (folder.with_suffix(".py"), folder / "__init__.py")
    return next((path for path in paths if first == "fusion_gym" and path.is_file()), None)


@functools.cache
def read_module(name: str, path: Path) -> tuple[str, list[str]]:
    """Return a hash of a module's code, and the names of what it may import."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(body := getattr(node, "body", None), list):
            body[:] = [item for item in body if not _is_text(item)]
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    code = hashlib.sha256(ast.dump(tree).encode()).hexdigest()
    return code, list(_imports(tree, package))


def _is_text(node: ast.AST) -> bool:
    value = getattr(node, "value", None) if isinstance(node, ast.Expr) else None
    return isinstance(value, ast.Constant) and isinstance(value.value, str)


def _imports(tree: ast.Module, package: str) -> Iterator[str]:
    """Yield imported names, also of registries, where a text "module:name" names a module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) + 1 - node.level]
            base = ".".join([*parents, node.module or ""] if node.level else [node.module or ""])
            base = base.rstrip(".")
            yield from (base, *(f"{base}.{alias.name}" for alias in node.names))
        elif match := re.fullmatch(r"([\w.]+):\w+", str(getattr(node, "value", ""))):
            yield from (match[1], f"{package}.{match[1]}")
