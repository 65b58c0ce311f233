"""A step of N runs as a loop in machine code: LLVM compiles JAX's trace of one run.

The code is kept in ``~/.cache/fusion-gym/compiled``, so that only the first start needs JAX.
"""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import functools
import hashlib
import io
import os
import pickle
import warnings
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array
from fusion_gym.core.memory import Memory
from fusion_gym.core.observation import ObservationLayout
from fusion_gym.core.rows import RowStep
from fusion_gym.core.task import Task
from fusion_gym.errors import ConfigurationError
from fusion_gym.importing import require
from fusion_gym.lowering import Buffer, LoweringError, assembly

require("backend='compiled'", "compiled", "llvmlite")
import llvmlite.binding as llvm  # noqa: E402

_FOLDER = Path.home() / ".cache" / "fusion-gym" / "compiled"
_PACKAGE = Path(__file__).parent.parent
_LOADED: dict[str, tuple[Any, int]] = {}  # engines and addresses


def make_step(task: Task, memory: Memory, layout: ObservationLayout) -> CompiledStep | None:
    """Return the compiled step, or ``None`` with a warning for a task that NumPy alone runs."""
    try:
        task.refuse_jax()
        if memory.parts:
            raise LoweringError("it has beliefs")
        return CompiledStep(task, memory, layout)
    except (ConfigurationError, LoweringError) as error:
        warnings.warn(f"backend='compiled' runs under NumPy here: {error}", stacklevel=2)
        return None


class CompiledStep(RowStep):
    """A step in machine code.

    Args:
        task: The task.
        memory: A memory without states.
        layout: The layout of the observation.

    Raises:
        LoweringError: The step has a primitive that is not lowered, or too many instructions.
        ConfigurationError: JAX is absent, and the code is not in the cache.
    """

    def __init__(self, task: Task, memory: Memory, layout: ObservationLayout) -> None:
        super().__init__(task, memory, layout)
        self._last: tuple[Any, int] = None, 0  # rows and their address
        self._functions: dict[str, Any] = {}
        for kind in ("start", "assign" if task.network.rule.by_channel else "request"):
            self._function(kind)

    def begin(self, start: Array, noise: Array, price: Array, limit: NDArray[np.int64]) -> Array:
        """Return rows of new episodes.

        Args:
            start: Standard normals (channels, N) of the starts of plant and network.
            noise: Standard normals (channels, N) of the first sensing.
            price: Price of a token (N,).
            limit: Step at which the episode ends (N,).
        """
        inputs = [np.ascontiguousarray(part) for part in (start, noise, price, limit)]
        rows = np.empty((len(price), self.width))
        self._function("start")(len(rows), *(part.ctypes.data for part in (*inputs, rows)))
        return rows

    def __call__(self, rows: Array, requests: NDArray[Any], noise: Array) -> Array:
        """Return the rows after a step with requests (sensors, N) and noise (channels, N)."""
        flags = requests.dtype == np.bool_
        requests = np.ascontiguousarray(requests, np.bool_ if flags else np.int64)
        noise, after = np.ascontiguousarray(noise), np.empty(rows.shape)
        last, address = self._last
        before = address if rows is last else rows.ctypes.data
        self._last = after, after.ctypes.data
        self._function("request" if flags else "assign")(
            len(after), before, requests.ctypes.data, noise.ctypes.data, self._last[1]
        )
        return after

    def _function(self, kind: str) -> Any:
        """Return the machine code of a start, or of a step with requests or assigned channels."""
        if kind not in self._functions:
            key = self.runs[0], self.runs[1].owner, kind
            address = _machine_code(key, functools.partial(self._text, kind))
            pointers = [ctypes.c_void_p] * (5 if kind == "start" else 4)
            self._functions[kind] = ctypes.CFUNCTYPE(None, ctypes.c_int64, *pointers)(address)
        return self._functions[kind]

    def _text(self, kind: str) -> str:
        """Return the assembly of a start or step."""
        require("the first start of backend='compiled'", "compiled", "jax")
        from fusion_gym.core import jitted

        whole = np.dtype(np.int64)
        if kind == "start":
            inputs: Any = self.start_noise, self.noise, np.zeros(1), np.zeros(1, whole)
            sources = [Buffer(array.dtype, [array]) for array in inputs]
            function: Any = jitted.start_arrays
        else:
            requests = np.zeros((self.runs[0].sensors, 1), whole if kind == "assign" else np.bool_)
            inputs = self.moved, requests, self.noise
            kinds = whole if kind == "assign" else np.dtype(np.int8), self.noise.dtype
            sources = [Buffer(self.noise.dtype, self.moved, self.width)]
            sources += [Buffer(k, [x]) for k, x in zip(kinds, inputs[1:], strict=True)]
            function = jitted.step_arrays
        try:
            closed = jitted.jax.make_jaxpr(functools.partial(function, self))(*inputs)
        except Exception as error:  # of a user's plant or estimator
            text = " ".join(f"{type(error).__name__}: {error}".split())
            raise LoweringError(f"JAX cannot trace it ({text[:200]})") from error
        return assembly(closed, sources, [Buffer(self.noise.dtype, self.arrays, self.width)])


# --- code -----------------------------------------------------------------------------------------


def _machine_code(task: Any, source: Callable[[], str]) -> int:
    """Return the address of code from this process, from the cache, or compiled of its assembly."""
    key = _fingerprint(task)
    if key in _LOADED:
        return _LOADED[key][1]
    code = None if key is None else _read(key)
    if key is None or code is None:
        text = source()
        key = key or hashlib.sha256(f"{_surroundings()}{text}".encode()).hexdigest()
        code = _read(key) or _compile(text)
        with contextlib.suppress(OSError):
            _FOLDER.mkdir(parents=True, exist_ok=True)
            part = _FOLDER / f"{key}.{os.getpid()}"
            part.write_bytes(hashlib.sha256(code).digest() + code)
            part.replace(_FOLDER / key)
    if key not in _LOADED:
        engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine(jit=True))
        engine.add_object_file(llvm.ObjectFileRef.from_data(code))
        engine.finalize_object()
        _LOADED[key] = engine, engine.get_function_address("step")
    return _LOADED[key][1]


def _read(key: str) -> bytes | None:
    """Return the whole code of a file, or ``None``."""
    with contextlib.suppress(OSError):
        content = (_FOLDER / key).read_bytes()
        if hashlib.sha256(content[32:]).digest() == content[:32]:
            return content[32:]
    return None


def _compile(text: str) -> bytes:
    """Return the object code of a module in assembly."""
    machine, module = _machine(), llvm.parse_assembly(text)
    builder = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=2))
    builder.getModulePassManager().run(module, builder)
    code: bytes = machine.emit_object(module)
    return code


def _machine(jit: bool = False) -> Any:
    """Return LLVM's machine for this processor."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    target, features = llvm.Target.from_default_triple(), llvm.get_host_cpu_features().flatten()
    return target.create_target_machine(llvm.get_host_cpu_name(), features, opt=2, jit=jit)


@functools.cache
def _surroundings() -> str:
    """Return what the code depends on besides the task: versions, sources and processor."""
    files = sorted(_PACKAGE.rglob("*.py"))
    sources = [(str(file), file.stat().st_mtime_ns, file.stat().st_size) for file in files]
    libraries = [version(name) for name in ("numpy", "llvmlite")]
    processor = llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()
    return repr((sources, libraries, processor))


class _Parts(pickle.Pickler):
    """A pickler of dataclasses by their fields, without what they have cached."""

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file)
        self.fast = True  # independent of which objects are the same
        self.modules: set[str] = set()

    def reducer_override(self, part: Any) -> Any:
        """Note the module of a class or function, and reduce a dataclass to its fields."""
        self.modules.add(getattr(part, "__module__", None) or type(part).__module__)
        if isinstance(part, type) or not dataclasses.is_dataclass(part):
            return NotImplemented
        return type(part), tuple(getattr(part, own.name) for own in dataclasses.fields(part))


def _fingerprint(task: Any) -> str | None:
    """Return a hash of a task, or ``None`` if code outside of this package determines it."""
    pickler = _Parts(file := io.BytesIO())
    try:
        pickler.dump(task)
    except Exception:  # a part cannot be pickled
        return None
    if any(
        name.partition(".")[0]
        not in ("fusion_gym", "numpy", "builtins", "types", "functools", "copyreg", "collections")
        for name in pickler.modules
    ):
        return None
    return hashlib.sha256(_surroundings().encode() + file.getvalue()).hexdigest()
