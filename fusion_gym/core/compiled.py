"""A step of N runs as a loop in machine code: LLVM compiles JAX's trace of one run.

The code is kept in ``~/.cache/fusion-gym/compiled``, so that only the first start needs JAX.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import itertools
import threading
import warnings
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array, arrays_of, map_arrays
from fusion_gym.core import code_cache
from fusion_gym.core.memory import Memory, MemoryStates
from fusion_gym.core.observation import ObservationLayout
from fusion_gym.core.runs import Branch, Outcome, Position, State, advance, start_of
from fusion_gym.core.task import Task
from fusion_gym.errors import ConfigurationError
from fusion_gym.importing import require
from fusion_gym.lowering import Buffer, LoweringError, assembly
from fusion_gym.namespace import namespace

MOST_INSTRUCTIONS = 100_000  # LLVM takes about ten seconds
MOST_OF_TRAINING = 300_000  # about a minute, once


class RowStep:
    """A step between rows (N, entries), and the places of a row's arrays.

    A row has the arrays of a position and of the memory, of the outcome of the step to it and of
    the state after the delivery, and its observation.

    Args:
        task: The task.
        memory: The memory; its states are not used.
        layout: The layout of the observation.
        sizes: Sizes of further arrays of a row.
        signals: Function from runs to these arrays, each (size, N).
    """

    def __init__(
        self,
        task: Task,
        memory: Memory,
        layout: ObservationLayout,
        sizes: Sequence[int] = (),
        signals: Callable[[Branch], Sequence[Any]] | None = None,
    ) -> None:
        self.runs, plant, network = (task, memory, layout), task.plant, task.network
        self.sizes, self.signals = sizes, signals
        self.start_noise = np.zeros((plant.start_channels + network.start_channels, 1))
        self.noise = np.zeros((plant.noise_channels + network.noise_channels, 1))
        number, steps = np.zeros(1), np.zeros(1, dtype=np.int64)
        with np.errstate(all="ignore"):
            start, announcement = start_of(task, self.start_noise)
            state = advance(task, start, self.noise, steps)
            measured = (plant.measurement(part.plant) for part in (start, state))
            memory = self.begin_memory(announcement, start.control, *measured)
            self.template = Position(state, number, steps, steps), memory.states
            branch = Branch(task, memory, layout, self.template[0])
            branch.deliver(np.zeros((task.sensors, 1), np.bool_))
            self._delivered = branch.delivered
        flags: Any = np.zeros((task.sensors, 1), np.bool_)
        errors: Any = np.zeros((len(plant.state_names), 1))
        observation = np.zeros((len(layout.names), 1), np.float32)
        self.inputs = arrays_of(self.template)
        ages: Any = np.zeros((task.sensors, 1))
        outcome = [*[number] * 4, *[flags] * 3, errors, errors, *[flags[0]] * 2, ages, number]
        if state.control is not None:
            outcome += [number, state.control]
        self.results = [*outcome, *arrays_of(self._delivered)]
        further = [np.zeros((size, 1)) for size in sizes]
        self.arrays = [*self.inputs, *self.results, observation, *further]
        places, first = _places(self.arrays), len(self.inputs)
        count = first + len(self.results)
        self._places, self._entries, self.further = (
            places[:count],
            places[count],
            places[count + 1 :],
        )
        own, self._after = self._places[first : first + len(outcome)], first + len(outcome)
        self._span = slice(own[0].start, own[-1].stop)
        self._fields = [  # whether a field of the outcome is a flag, and its place
            (array.dtype == np.bool_, place if array.ndim > 1 else place.start)
            for array, place in zip(outcome, _places(outcome), strict=True)
        ]

    def __reduce__(self) -> Any:
        return type(self), (*self.runs, self.sizes, self.signals)

    def __deepcopy__(self, memo: Any) -> RowStep:
        return self  # what it has compiled fits the copy

    @property
    def width(self) -> int:
        """Number of entries of a row."""
        return sum(array.size for array in self.arrays)

    def begin_memory(self, announcement: Any, control: Any, first: Any, measurement: Any) -> Memory:
        """Return the memory of one run after announcement, input and two measurements."""
        memory = self.runs[1].with_states({})
        memory.begin(first, announcement, measurement, np.arange(1), [0], 1, control)
        return memory

    def begin_run(self, noise: Any, first: Any, price: Any, limit: Any) -> Branch:
        """Return a run at the start of an episode, from noise, price and limit of steps."""
        task, memory, layout = self.runs
        asarray, (start, announcement) = namespace(noise).asarray, start_of(task, noise)
        start, steps = map_arrays(asarray, start), asarray(np.zeros(len(price), np.int64))
        position = Position(advance(task, start, first, steps), price, steps, limit)
        position = map_arrays(asarray, position)
        measured = (task.plant.measurement(part.plant) for part in (start, position.state))
        memory = self.begin_memory(announcement, start.control, *measured)
        memory.states = map_arrays(asarray, memory.states)
        return Branch(task, memory, layout, position)

    def start_arrays(self, *inputs: Any) -> list[Any]:
        """Return the arrays of a row at the start of :meth:`begin_run`."""
        branch = self.begin_run(*inputs)
        moved = branch.position(), branch.memory.states
        return [*arrays_of(moved), *self.results, *self._observed(branch)]

    def step_arrays(self, arrays: Sequence[Any], requests: Any, noise: Any) -> list[Any]:
        """Return the arrays of a row after a step, from a position's arrays, requests and noise."""
        values, (task, memory, layout) = iter(arrays), self.runs
        position, states = map_arrays(lambda _: next(values), self.template)
        branch = Branch(task, memory.with_states(states), layout, position)
        outcome = branch.step(requests, noise)
        moved = branch.position(), branch.memory.states
        after = arrays_of(outcome), arrays_of(branch.delivered)
        return [*arrays_of(moved), *after[0], *after[1], *self._observed(branch)]

    def _observed(self, branch: Branch) -> list[Any]:
        return [branch.observe(), *(self.signals(branch) if self.signals else ())]

    def pack(self, position: Position, memory: MemoryStates) -> Array:
        """Return the rows of a position and of the memory's states."""
        rows = np.zeros((len(position.steps), self.width))
        for place, array in zip(self._places, arrays_of((position, memory)), strict=False):
            rows[:, place] = array.reshape(-1, len(rows)).T
        return rows

    def moved(self, rows: Array) -> tuple[Position, MemoryStates]:
        """Return the position and the memory's states of rows."""
        moved: tuple[Position, MemoryStates] = self._unpack(rows, self.template, 0)
        return moved

    def delivered(self, rows: Array) -> State:
        """Return the states after the delivery of rows."""
        state: State = self._unpack(rows, self._delivered, self._after)
        return state

    def _unpack(self, rows: Array, template: Any, first: int) -> Any:
        values, places = rows.T, iter(self._places[first:])

        def part(array: NDArray[Any]) -> NDArray[Any]:
            own = values[next(places)].reshape(*array.shape[:-1], -1)
            return own.astype(array.dtype) if array.dtype != own.dtype else own

        return map_arrays(part, template)

    def outcome(self, rows: Array, run: int | None = None) -> Outcome:
        """Return the outcome of the step to rows, or to one row without the batch axis."""
        row = slice(None) if run is None else run
        numbers = rows[row, self._span].T.copy()  # or a stored reward would keep the rows
        flags: Any = numbers.astype(np.bool_)
        values: Any = ((flags if flag else numbers)[at] for flag, at in self._fields)
        return Outcome(*values)

    def observation(self, rows: Array) -> NDArray[np.float32]:
        """Return new observations (N, entries) of rows."""
        return rows[:, self._entries].astype(np.float32)


def _places(arrays: Sequence[NDArray[Any]]) -> list[slice]:
    """Return the place of each array (…, 1) in a row."""
    ends = itertools.accumulate((array.size for array in arrays), initial=0)
    return [slice(*span) for span in itertools.pairwise(ends)]


require("backend='compiled'", "compiled", "llvmlite")
import llvmlite.binding as llvm  # noqa: E402

_LOADED: WeakValueDictionary[str, Any] = WeakValueDictionary()  # engines in use
_RECENT: deque[Any] = deque(maxlen=64)  # engines that may be used again
_LOCK = threading.RLock()  # of the threads that compile


def make_step(task: Task, *parts: Any) -> CompiledStep | None:
    """Return the compiled step, or ``None`` with a warning for a task that NumPy alone runs."""
    try:
        task.refuse_numpy_only()
        return CompiledStep(task, *parts)
    except (ConfigurationError, LoweringError) as error:
        warnings.warn(f"backend='compiled' runs under NumPy here: {error}", stacklevel=2)
        return None


class CompiledStep(RowStep):
    """A step in machine code, with the arguments of :class:`RowStep`.

    Raises:
        LoweringError: The step has a primitive that is not lowered, or too many instructions.
        ConfigurationError: JAX is absent, and the code is not in the cache.
    """

    def __init__(self, task: Task, *parts: Any) -> None:
        super().__init__(task, *parts)
        self._last: tuple[Any, int] = None, 0  # rows and their address
        self._functions: dict[str, Any] = {}
        self._sensors = task.sensors
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
        self._function("start")(len(rows), *map(_address, (*inputs, rows)))
        return rows

    def __call__(self, rows: Array, requests: NDArray[Any], noise: Array) -> Array:
        """Return the rows after a step with requests (sensors, N) and noise (channels, N)."""
        flags, shape = requests.dtype == np.bool_, (self._sensors, len(rows))
        if requests.shape != shape:
            requests = np.broadcast_to(requests, shape)
        requests = np.ascontiguousarray(requests, np.bool_ if flags else np.int64)
        noise, after = np.ascontiguousarray(noise), np.empty(rows.shape)
        last, address = self._last
        inputs = address if rows is last else _address(rows), _address(requests), _address(noise)
        address = _address(after)
        self._last = after, address
        self._function("request" if flags else "assign")(len(after), *inputs, address)
        return after

    def move(
        self, rows: Array, requests: NDArray[np.bool_], noise: Array, after: Array, threads: int
    ) -> None:
        """Write the rows after a step into ``after``, by several threads."""
        function, ends = self._function("request"), np.linspace(0, len(rows), threads + 1)

        def part(first: int, end: int) -> None:
            inputs = (np.ascontiguousarray(own[:, first:end]) for own in (requests, noise))
            parts = rows[first:end], *inputs, after[first:end]
            function(end - first, *map(_address, parts))

        whole = ends.astype(np.int64).tolist()
        list(_pool(threads).map(part, whole[:-1], whole[1:]))

    def _function(self, kind: str) -> Any:
        """Return the machine code of a start, or of a step with requests or assigned channels."""
        if kind not in self._functions:
            whole, real = np.dtype(np.int64), self.noise.dtype
            if kind == "start":
                inputs: Any = self.start_noise, self.noise, np.zeros(1), np.zeros(1, whole)
                sources = [Buffer(array.dtype, [array]) for array in inputs]
            else:
                flags = kind == "request"
                requests = np.zeros((self._sensors, 1), np.bool_ if flags else whole)
                sources = [Buffer(real, self.inputs, self.width), Buffer(real, [self.noise])]
                sources.insert(1, Buffer(np.dtype(np.int8) if flags else whole, [requests]))
            self._functions[kind] = compile_function(
                (self.runs[0], self.runs[1].owner, kind, self.sizes, self.signals),
                self.start_arrays if kind == "start" else self.step_arrays,
                sources,
                [Buffer(real, self.arrays, self.width)],
                MOST_INSTRUCTIONS if self.signals is None else MOST_OF_TRAINING,
            )
        return self._functions[kind]


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads)


def _address(array: Any) -> int:
    """Return the address of a contiguous array, by the fastest way that the array allows."""
    try:
        return ctypes.addressof(ctypes.c_char.from_buffer(array))
    except (TypeError, ValueError):  # read-only or empty
        return int(array.ctypes.data)


# --- code -----------------------------------------------------------------------------------------


def compile_function(
    key: Any,
    function: Callable[..., list[Any]],
    sources: Sequence[Buffer],
    sinks: Sequence[Buffer],
    most: int = MOST_INSTRUCTIONS,
) -> Any:
    """Return a function ``(runs, sources, sinks)`` in machine code.

    Args:
        key: What determines the function, for the cache.
        function: A function of the arrays of one run.
        sources: Memory of these arrays, each alone or all of a row.
        sinks: Memory of the results.
        most: Number of instructions that is allowed.

    Raises:
        LoweringError: JAX cannot trace it, or it is not lowered.
        ConfigurationError: JAX is absent, and the code is not in the cache.
    """
    inputs = [buffer.arrays if buffer.length else buffer.arrays[0] for buffer in sources]

    def source() -> str:
        require("the first start of backend='compiled'", "compiled", "jax")
        from fusion_gym.core.jax_setup import jax

        try:
            closed = jax.make_jaxpr(lambda *values: function(*values))(*inputs)
        except Exception as error:  # of a user's plant, estimator or rule
            text = " ".join(f"{type(error).__name__}: {error}".split())
            raise LoweringError(f"JAX cannot trace it ({text[:200]})") from error
        return assembly(closed, sources, sinks, most)

    pointers = [ctypes.c_void_p] * (len(sources) + len(sinks))
    with _LOCK:
        engine = _machine_code(key, source)
    address = engine.get_function_address("step")
    result: Any = ctypes.CFUNCTYPE(None, ctypes.c_int64, *pointers)(address)
    result.engine = engine  # whose code LLVM frees with it
    return result


def _machine_code(task: Any, source: Callable[[], str]) -> Any:
    """Return the engine of code from this process, the cache, or compiled of its assembly.

    The cache has the code of a task, and the code of an assembly, which other sources may share.
    """
    name = _fingerprint(task)
    if engine := _LOADED.get(name or ""):
        return engine
    code = name and code_cache.read_code(_folder(), name)
    if not code:
        text = source()
        key = hashlib.sha256(f"{_surroundings()}{text}".encode()).hexdigest()
        code = code_cache.read_code(_folder(), key) or _compile(text)
        for file in filter(None, (name, key)):
            code_cache.write_code(_folder(), file, code)
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine(jit=True))
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    if name:
        _LOADED[name] = engine
        _RECENT.append(engine)
    return engine


@functools.cache
def _folder() -> Path | None:
    return code_cache.folder_of("compiled")


def _compile(text: str) -> bytes:
    """Return the object code of a module in assembly."""
    machine, module = _machine(), llvm.parse_assembly(text)
    options = llvm.create_pipeline_tuning_options(speed_level=1)
    builder = llvm.create_pass_builder(machine, options)
    builder.getModulePassManager().run(module, builder)
    code: bytes = machine.emit_object(module)
    return code


def _machine(jit: bool = False) -> Any:
    """Return LLVM's machine for this processor."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    target, features = llvm.Target.from_default_triple(), llvm.get_host_cpu_features().flatten()
    return target.create_target_machine(llvm.get_host_cpu_name(), features, opt=1, jit=jit)


@functools.cache
def _surroundings() -> str:
    """Return what the code of an assembly depends on: libraries and processor."""
    libraries = [version(name) for name in ("numpy", "llvmlite")]
    return repr((libraries, llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()))


def _fingerprint(task: Any) -> str | None:
    return code_cache.key_of(task, _surroundings())
