"""Results on disk, each under a hash of its inputs and its code."""

import ast
import contextlib
import functools
import hashlib
import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from joblib import Memory

import fusion_gym
from fusion_gym.output.files import fingerprint
from fusion_gym.validation import ConfigurationError

Function = Callable[..., Any]
Inputs = Mapping[str, Any]
_ROOT = Path(fusion_gym.__file__).parents[1]


@dataclass(frozen=True)
class Cache:
    """Results of functions in a folder, by :class:`joblib.Memory`.

    A result's key is the function's qualified name, its plain inputs, and the code of its module
    and its imports. An unreadable entry counts as absent. Several processes may use a folder at
    once; a killed process leaves no readable entry.

    Args:
        folder: Where the results are; only results of a trusted origin, for they are pickles.
    """

    folder: Path

    def holds(self, function: Function, inputs: Inputs) -> bool:
        """Return whether the result exists and is readable."""
        try:
            self.read(function, inputs)
        except FileNotFoundError:
            return False
        return True

    def call(self, function: Function, inputs: Inputs, *arguments: Any, **keywords: Any) -> Any:
        """Return the stored result, or compute and store ``function(*arguments, **keywords)``.

        Args:
            function: A function of a module.
            inputs: All inputs of the result except the code, as plain data.
            *arguments: The function's arguments.
            **keywords: The function's keywords.

        Raises:
            ConfigurationError: the result cannot be written.
        """
        try:
            return self.read(function, inputs)
        except FileNotFoundError:
            evaluation = functools.partial(function, *arguments, **keywords)
        with warnings.catch_warnings():
            warnings.filterwarnings("error", message="Unable to cache to disk")
            try:
                return self._memorized(evaluation, _key(function, inputs))
            except Warning as warning:  # joblib's, in the place of the error
                reason = " ".join(str(warning).split())
                raise ConfigurationError(
                    f"folder = {str(self.folder)!r} cannot be written: {reason}"
                ) from None

    def read(self, function: Function, inputs: Inputs) -> Any:
        """Return an existing result."""
        entry = self._entry(function, inputs)
        try:
            return entry.get()
        except Exception:  # a damaged pickle raises errors of any class
            entry.clear()
            return _refuse()

    def drop(self, function: Function, inputs: Inputs) -> None:
        """Remove the result, if it exists."""
        with contextlib.suppress(FileNotFoundError):
            self._entry(function, inputs).clear()

    def _entry(self, function: Function, inputs: Inputs) -> Any:
        return self._memorized.call_and_shelve(_refuse, _key(function, inputs))

    @property
    def _memorized(self) -> Any:
        # Of a module's function joblib notes the code in the first folder of a process alone, and
        # another process would then not trust the results in the second.
        def evaluate(evaluation: Callable[[], Any], key: str) -> Any:
            return evaluation()

        return Memory(self.folder, verbose=0, compress=True).cache(evaluate, ignore=["evaluation"])


def _refuse() -> None:
    raise FileNotFoundError("the result is absent")


def _key(function: Function, inputs: Inputs) -> str:
    name = f"{function.__module__}.{function.__qualname__}"
    return fingerprint({"name": name, "inputs": inputs, "code": code_of(function.__module__)})


@functools.cache
def code_of(module: str) -> str:
    """Return a hash of the code of a module and of the project's modules that it imports.

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
    first, *_ = parts = name.split(".")
    folder = _ROOT.joinpath(*parts)
    paths = (folder.with_suffix(".py"), folder / "__init__.py")
    own = first in ("agents", "fusion_gym")
    return next((path for path in paths if own and path.is_file()), None)


@functools.cache
def read_module(name: str, path: Path) -> tuple[str, list[str]]:
    """Return a hash of a module's code, and the names of its possible imports."""
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
