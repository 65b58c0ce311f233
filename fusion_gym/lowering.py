"""Lower a jaxpr to LLVM's assembly, with one number for each entry of each array.

An array is an object array of constants and of names of LLVM's values, so that reshaping, slicing
and the like cost nothing at run time. A value is a vector with a lane for each of four runs. The
numbers of a run do not depend on the other lanes.
"""

from __future__ import annotations

import contextlib
import itertools
from collections import ChainMap
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial, reduce
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Values = NDArray[Any]  # constants and names
LANES = 4  # runs of a vector
_FEW = 8  # a choice among more numbers reads them from memory
_BOOL, _WHOLE = np.dtype(np.bool_), np.dtype(np.int64)


class LoweringError(Exception):
    """A program that this module does not lower."""


# --- primitives -----------------------------------------------------------------------------------

# Instructions for real and for whole numbers, and NumPy's function for constants.
ARITHMETIC: dict[str, tuple[str, str, Any]] = {
    "add": ("fadd", "add", np.add),
    "sub": ("fsub", "sub", np.subtract),
    "mul": ("fmul", "mul", np.multiply),
    "div": ("fdiv", "sdiv", np.divide),
    "rem": ("frem", "srem", np.fmod),
    "and": ("", "and", np.bitwise_and),
    "or": ("", "or", np.bitwise_or),
    "xor": ("", "xor", np.bitwise_xor),
    "shift_right_arithmetic": ("", "ashr", np.right_shift),
}
COMPARISONS: dict[str, tuple[str, str, Any]] = {
    "eq": ("oeq", "eq", np.equal),
    "ne": ("une", "ne", np.not_equal),
    "lt": ("olt", "lt", np.less),
    "le": ("ole", "le", np.less_equal),
    "gt": ("ogt", "gt", np.greater),
    "ge": ("oge", "ge", np.greater_equal),
}
# Functions of real numbers, of LLVM or of the C library.
_SAME = (
    "exp exp2 log log1p expm1 sin cos tan sinh cosh tanh asin asinh acos atan atan2 erf erfc pow"
)
FUNCTIONS = {name: name for name in _SAME.split()}
FUNCTIONS |= {name: f"llvm.{name}" for name in ("sqrt", "floor", "ceil")}
# Other functions of numbers: of the program, the type, the parameters and the numbers.
NUMBERS: dict[str, Callable[..., Any]] = {
    "neg": lambda code, kind, _, a: code.do("mul", kind, a, -1),
    "abs": lambda code, kind, _, a: code.call("llvm.fabs", kind, a),
    "max": lambda code, kind, _, a, b: code.extreme("gt", kind, a, b),
    "min": lambda code, kind, _, a, b: code.extreme("lt", kind, a, b),
    "not": lambda code, kind, _, a: code.do("xor", kind, a, True if kind == _BOOL else -1),
    "square": lambda code, kind, _, a: code.do("mul", kind, a, a),
    "integer_pow": lambda code, kind, params, a: code.power(kind, a, params["y"]),
    "convert_element_type": lambda code, kind, params, a: code.convert(kind, _new(params), a),
    "bitcast_convert_type": lambda code, kind, params, a: code.bits(kind, _new(params), a),
}
# Functions of arrays that only move entries: of the parameters and the arrays.
MOVES: dict[str, Callable[..., Any]] = {
    "copy": lambda _, x: x,
    "reshape": lambda params, x: x.reshape(params["new_sizes"]),
    "squeeze": lambda params, x: x.squeeze(params["dimensions"]),
    "transpose": lambda params, x: x.transpose(params["permutation"]),
    "rev": lambda params, x: np.flip(x, params["dimensions"]),
    "concatenate": lambda params, *x: np.concatenate(x, params["dimension"]),
    "stack": lambda params, *x: np.stack(x, params["axis"]),
    "split": lambda params, x: np.split(x, np.cumsum(params["sizes"])[:-1], params["axis"]),
    "slice": lambda params, x: _sliced(x, **params),
    "broadcast_in_dim": lambda params, x: _broadcast(x, **params),
    "tile": lambda params, x: np.tile(x, params["reps"]),
    "iota": lambda params: _counted(**params),
    "pad": lambda params, x, value: _padded(x, value, params["padding_config"]),
}


class Program:
    """The lines of a function in LLVM's assembly, at most so many."""

    def __init__(self, most: int) -> None:
        self.most, self.lines = most, list[str]()
        self.first: list[str] = []  # of the entry block
        self.outside: dict[str, str] = {}  # names of declarations and tables
        self.label = "entry"
        self._names = itertools.count()
        self._known: ChainMap[str, str] = ChainMap()  # values that dominate the present block

    def name(self, prefix: str = "%v") -> str:
        """Return a new name."""
        return f"{prefix}{next(self._names)}"

    def emit(self, text: str) -> str:
        """Return the value of an instruction; equal instructions have one value."""
        if text not in self._known:
            self._known[text] = name = self.name()
            self.lines.append(f"{name} = {text}")
            if len(self.lines) > self.most:
                raise LoweringError(f"it has more than {self.most:,} instructions")
        return self._known[text]

    def lane(self, kind: Any, value: Any, lane: int) -> Any:
        """Return the number of one lane of a value."""
        if not isinstance(value, str):
            return value
        return self.emit(f"extractelement {_vector(kind)} {value}, i64 {lane}")

    def join(self, kind: Any, numbers: Iterable[str]) -> str:
        """Return the value of the numbers of all lanes."""
        value = "poison"
        for lane, number in enumerate(numbers):
            pair = f"{_vector(kind)} {value}, {_type(kind)} {number}"
            value = self.emit(f"insertelement {pair}, i64 {lane}")
        return value

    def transpose(self, kind: Any, rows: Sequence[Any]) -> list[str]:
        """Return the columns of as many values as lanes."""
        texts = [f"{_vector(kind)} {_value(row, kind)}" for row in rows]

        def shuffle(left: str, right: str, places: tuple[int, ...]) -> str:
            mask = ", ".join(f"i32 {place}" for place in places)
            return self.emit(f"shufflevector {left}, {right}, <{LANES} x i32> <{mask}>")

        pairs = [f"{_vector(kind)} {shuffle(texts[low], texts[low + 1], mask)}"
                 for low in (0, 2) for mask in ((0, 4, 2, 6), (1, 5, 3, 7))]  # fmt: skip
        return [shuffle(pairs[own], pairs[own + 2], mask)
                for mask in ((0, 1, 4, 5), (2, 3, 6, 7)) for own in (0, 1)]  # fmt: skip

    def any(self, test: Any) -> str:
        """Return whether a test holds in any lane."""
        name, kind = f"@llvm.vector.reduce.or.v{LANES}i1", _vector(_BOOL)
        self.outside[f"declare i1 {name}({kind})"] = ""
        return self.emit(f"call i1 {name}({kind} {_value(test, _BOOL)})")

    def block(self, label: str) -> None:
        """Begin a block."""
        self.lines.append(f"{label}:")
        self.label = label

    @contextlib.contextmanager
    def scope(self) -> Iterator[None]:
        """Forget the values of this context after it: they do not dominate what follows."""
        self._known = self._known.new_child()
        yield
        self._known = self._known.parents

    def run(self, closed: Any, arguments: Iterable[Values]) -> list[Values]:
        """Return the results of a jaxpr."""
        jaxpr = closed.jaxpr
        values = dict(zip(jaxpr.constvars, map(_objects, closed.consts), strict=True))
        values |= zip(jaxpr.invars, arguments, strict=True)

        def read(atom: Any) -> Values:
            return _objects(atom.val) if hasattr(atom, "val") else values[atom]

        for equation in jaxpr.eqns:
            inputs, name = [read(atom) for atom in equation.invars], equation.primitive.name
            if name in MOVES:
                result = MOVES[name](equation.params, *inputs)
            elif name in ARRAYS:
                result = ARRAYS[name](self, equation, *inputs)
            else:
                function = partial(self.do, name, _kind(equation), params=equation.params)
                result = _each(function, *inputs)
            results = result if equation.primitive.multiple_results else [result]
            arrays = (np.asarray(result, dtype=object) for result in results)
            values |= zip(equation.outvars, arrays, strict=True)
        return [read(atom) for atom in jaxpr.outvars]

    # --- numbers --------------------------------------------------------------------------------

    def do(self, name: str, kind: Any, *values: Any, params: Any = None) -> Any:
        """Return the value of a primitive of numbers of one type."""
        real = kind.kind == "f"
        if name in NUMBERS:
            return NUMBERS[name](self, kind, params, *values)
        if name in FUNCTIONS and real:
            return self.call(FUNCTIONS[name], kind, *values)
        if name in ARITHMETIC:
            *choice, fold = ARITHMETIC[name]
            out, instruction = kind, choice[not real]
        elif name in COMPARISONS:
            *choice, fold = COMPARISONS[name]
            sign = "" if name in ("eq", "ne") else "s" if kind.kind == "i" else "u"
            out, instruction = _BOOL, f"fcmp {choice[0]}" if real else f"icmp {sign}{choice[1]}"
        else:
            raise LoweringError(f"it has the primitive {name!r}")
        if not any(isinstance(value, str) for value in values):
            with np.errstate(all="ignore"):
                return out.type(fold(*(kind.type(value) for value in values)))
        operands = ", ".join(_value(value, kind) for value in values)
        return self.emit(f"{instruction} {_vector(kind)} {operands}")

    def call(self, function: str, kind: Any, *values: Any) -> str:
        """Return the value of a function of real numbers."""
        if kind != np.float64:
            raise LoweringError(f"it has {function!r} of {kind}")
        if function == "pow" and not isinstance(values[1], str) and values[1] == 0.5:
            root = self.call("llvm.fabs", kind, self.call("llvm.sqrt", kind, values[0]))
            return self.select(kind, self.do("eq", kind, values[0], -np.inf), np.inf, root)
        vector = "." in function  # LLVM's own have all lanes at once
        text, literal = (_vector(kind), _value) if vector else (_type(kind), _literal)
        name, types = f"@{function}{f'.v{LANES}f64' * vector}", ", ".join([text] * len(values))
        self.outside[f"declare {text} {name}({types}) nounwind willreturn memory(none)"] = ""

        def result(values: Iterable[Any]) -> str:
            operands = ", ".join(f"{text} {literal(value, kind)}" for value in values)
            return self.emit(f"call {text} {name}({operands})")

        if vector:
            return result(values)
        each = ([self.lane(kind, value, lane) for value in values] for lane in range(LANES))
        return self.join(kind, [result(numbers) for numbers in each])

    def select(self, kind: Any, test: Any, yes: Any, no: Any) -> Any:
        """Return one of two numbers."""
        if not isinstance(test, str):
            return yes if test else no
        pair = ", ".join(f"{_vector(kind)} {_value(value, kind)}" for value in (yes, no))
        return self.emit(f"select {_vector(_BOOL)} {test}, {pair}")

    def minus(self, kind: Any, value: Any, a: Any, b: Any) -> Any:
        """Return value - a · b."""
        return self.do("sub", kind, value, self.do("mul", kind, a, b))

    def extreme(self, comparison: str, kind: Any, a: Any, b: Any) -> Any:
        """Return the larger or smaller of two numbers, or NaN if one is NaN."""
        test = self.do(comparison, kind, a, b)
        if kind.kind == "f":
            test = self.do("or", _BOOL, test, self.do("ne", kind, a, a))
        return self.select(kind, test, a, b)

    def clamp(self, kind: Any, low: Any, value: Any, high: Any) -> Any:
        """Return the nearest number within limits."""
        return self.extreme("lt", kind, self.extreme("gt", kind, value, low), high)

    def power(self, kind: Any, value: Any, exponent: int) -> Any:
        """Return a power of whole exponent."""
        if exponent < 0:
            return self.do("div", kind, 1, self.power(kind, value, -exponent))
        return reduce(partial(self.do, "mul", kind), [value] * exponent, kind.type(1))

    def convert(self, kind: Any, out: Any, value: Any) -> Any:
        """Return a number as another type."""
        if not isinstance(value, str):
            return out.type(kind.type(value))
        if out == _BOOL and kind != out:
            return self.do("ne", kind, value, 0)
        wider, signed = out.itemsize > kind.itemsize, kind.kind == "i"
        if kind.kind == "f":
            how = ("fpext" if wider else "fptrunc") if out.kind == "f" else "fptosi"
        elif out.kind == "f":
            how = "sitofp" if signed else "uitofp"
        elif wider or kind == _BOOL:
            how = "sext" if signed else "zext"
        else:
            how = "trunc"
        before, after = _vector(kind), _vector(out)
        return value if before == after else self.emit(f"{how} {before} {value} to {after}")

    def bits(self, kind: Any, out: Any, value: Any) -> Any:
        """Return the bits of a number as another type of the same size."""
        if not isinstance(value, str):
            return np.asarray(value, dtype=kind).view(out)[()]
        return self.emit(f"bitcast {_vector(kind)} {value} to {_vector(out)}")

    def pick(self, kind: Any, values: Values, place: Any) -> Any:
        """Return the entry of a vector at a place."""
        if not isinstance(place, str):
            return values[place]
        if len(values) <= _FEW:
            result = values[0]
            for number, value in enumerate(values[1:], 1):
                result = self.select(kind, self.do("eq", _WHOLE, place, number), value, result)
            return result
        text, apart = _type(kind), 1
        if any(isinstance(value, str) for value in values):
            apart, memory = LANES, self.name("%memory")
            self.first.append(f"{memory} = alloca [{len(values)} x {_vector(kind)}]")
            for number, value in enumerate(values):
                into = self.emit(f"getelementptr {_vector(kind)}, ptr {memory}, i64 {number}")
                self.lines.append(f"store {_vector(kind)} {_value(value, kind)}, ptr {into}")
        else:
            entries = ", ".join(f"{text} {_literal(value, kind)}" for value in values)
            table = f" = private unnamed_addr constant [{len(values)} x {text}] [{entries}]"
            memory = self.outside.setdefault(table, self.name("@table"))
        numbers = []
        for lane in range(LANES):
            at = self.emit(f"mul i64 {self.lane(_WHOLE, place, lane)}, {apart}")
            at = self.emit(f"add i64 {at}, {lane if apart > 1 else 0}")
            address = self.emit(f"getelementptr {text}, ptr {memory}, i64 {at}")
            numbers.append(self.emit(f"load {text}, ptr {address}"))
        return self.join(kind, numbers)

    # --- arrays ---------------------------------------------------------------------------------

    def reduced(self, equation: Any, values: Values, *, operation: str) -> Values:
        """Return the sum or the like over axes."""
        axes = equation.params["axes"]
        rows = np.moveaxis(values, axes, range(len(axes)))
        join = partial(_each, partial(self.do, operation, _kind(equation)))
        return np.asarray(reduce(join, rows.reshape(-1, *rows.shape[len(axes) :])))

    def accumulated(self, equation: Any, values: Values) -> Values:
        """Return the sums of the entries up to each place of an axis."""
        axis, turn = equation.params["axis"], -1 if equation.params["reverse"] else 1
        add = partial(_each, partial(self.do, "add", _kind(equation)))
        sums = [*itertools.accumulate([*np.moveaxis(values, axis, 0)][::turn], add)][::turn]
        return np.stack([np.asarray(row, dtype=object) for row in sums], axis)

    def place(self, equation: Any, values: Values, *, comparison: str) -> Values:
        """Return the place of the first extreme, or of the first NaN, along an axis."""
        kind, out = _kind(equation), np.dtype(equation.params["index_dtype"])
        (axis,) = equation.params["axes"]

        def better(new: Any, old: Any) -> Any:
            test = self.do(comparison, kind, new, old)
            if kind.kind == "f":
                pair = self.do("ne", kind, new, new), self.do("eq", kind, old, old)
                test = self.do("or", _BOOL, test, self.do("and", _BOOL, *pair))
            return test

        best, *rows = np.moveaxis(values, axis, 0)
        place = np.full(np.shape(best), 0, dtype=object)
        for number, row in enumerate(rows, 1):
            test = _each(better, row, best)
            best = _each(partial(self.select, kind), test, row, best)
            place = _each(partial(self.select, out), test, number, place)
        return place

    def selected(self, equation: Any, test: Values, *cases: Values) -> Values:
        """Return the entries of the cases that ``test`` numbers."""
        result, of_test, kind = cases[0], _kind(equation), _kind(equation, 1)
        for number, case in enumerate(cases[1:], 1):
            same = _each(partial(self.do, "eq", of_test), test, number) if len(cases) > 2 else test
            result = _each(partial(self.select, kind), same, case, result)
        return result

    def sort(self, equation: Any, *arrays: Values) -> list[Values]:
        """Return arrays in the stable order of the first ones along an axis."""
        axis, kinds = equation.params["dimension"], [atom.aval.dtype for atom in equation.invars]
        count = equation.params["num_keys"]

        def after(*keys: Any) -> Any:
            result: Any = False
            for kind, *pair in [*zip(kinds[:count], keys[:count], keys[count:], strict=True)][::-1]:
                tie = self.do("and", _BOOL, self.do("eq", kind, *pair), result)
                result = self.do("or", _BOOL, self.do("gt", kind, *pair), tie)
            return result

        rows = [[*np.moveaxis(x, axis, 0)] for x in arrays]
        for end in range(len(rows[0]) - 1, 0, -1):
            for low in range(end):
                keys = [own[place] for place in (low, low + 1) for own in rows[:count]]
                swap = _each(after, *keys)
                for kind, own in zip(kinds, rows, strict=True):
                    choose, pair = partial(self.select, kind), own[low : low + 2]
                    own[low : low + 2] = (_each(choose, swap, *p) for p in (pair[::-1], pair))
        return [np.stack([np.asarray(r, dtype=object) for r in own], axis) for own in rows]

    def cholesky(self, equation: Any, matrices: Values) -> Values:
        """Return the lower factors of matrices (…, n, n)."""
        kind, result = _kind(equation), np.full_like(matrices, 0.0)
        for batch in np.ndindex(matrices.shape[:-2]):
            own = result[batch]
            for j, i in itertools.combinations_with_replacement(range(len(own)), 2):
                value = matrices[batch][i, j]
                for k in range(j):
                    value = self.minus(kind, value, own[i, k], own[j, k])
                words = ("sqrt", kind, value) if i == j else ("div", kind, value, own[j, j])
                own[i, j] = self.do(*words)
        return result

    def solve(self, equation: Any, matrices: Values, right: Values) -> Values:
        """Return the solutions X (…, n, m) of triangular systems A X = B."""
        params, kind = equation.params, _kind(equation)
        if not params["left_side"] or params["transpose_a"] or params["unit_diagonal"]:
            raise LoweringError("it solves a triangular system in another form than A X = B")
        result, minus = right.copy(), partial(self.minus, kind)
        order = range(matrices.shape[-1])[:: 1 if params["lower"] else -1]
        for batch in np.ndindex(matrices.shape[:-2]):
            matrix, own = matrices[batch], result[batch]
            for place, i in enumerate(order):
                for k in order[:place]:
                    own[i] = _each(minus, own[i], matrix[i, k], own[k])
                own[i] = _each(partial(self.do, "div", kind), own[i], matrix[i, i])
        return result

    def gather(self, equation: Any, operand: Values, indices: Values) -> Values:
        """Return windows of an array at places that the indices name."""
        params, kind, shape = equation.params, _kind(equation), equation.outvars[0].aval.shape
        numbers, fill = params["dimension_numbers"], params["fill_value"]
        outer = [axis for axis in range(len(shape)) if axis not in numbers.offset_dims]
        fixed = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
        window = [axis for axis in range(operand.ndim) if axis not in fixed]
        batches = numbers.operand_batching_dims, numbers.start_indices_batching_dims
        moving, result = [*numbers.start_index_map], np.empty(shape, dtype=object)
        for place in np.ndindex(*shape):
            batch = tuple(place[axis] for axis in outer)
            start = {axis: batch[own] for axis, own in zip(*batches, strict=True)}
            start |= zip(window, (place[own] for own in numbers.offset_dims), strict=True)
            at, within = 0, True
            for axis, own in zip(moving, indices[batch], strict=True):
                index = self.convert(_kind(equation, 1), _WHOLE, own)
                most = operand.shape[axis] - params["slice_sizes"][axis]
                safe = self.clamp(_WHOLE, 0, index, most)
                within = self.do("and", _BOOL, within, self.do("eq", _WHOLE, safe, index))
                row = self.do("add", _WHOLE, safe, start.pop(axis, 0))
                at = self.do("add", _WHOLE, self.do("mul", _WHOLE, at, operand.shape[axis]), row)
            part = operand[tuple(start.get(axis, slice(None)) for axis in range(operand.ndim))]
            part = part.transpose([sorted(moving).index(axis) for axis in moving])
            value = self.pick(kind, part.reshape(-1), at)
            result[place] = value if fill is None else self.select(kind, within, value, fill)
        return result

    # --- control --------------------------------------------------------------------------------

    def inline(self, equation: Any, *inputs: Values) -> list[Values]:
        """Return the results of a called function."""
        return self.run(equation.params.get("jaxpr", equation.params.get("call_jaxpr")), inputs)

    def branch(self, equation: Any, index: Values, *inputs: Values) -> list[Values]:
        """Return the results of the branch that is executed."""
        branches, test, kind = equation.params["branches"], index[()], _kind(equation)
        if not isinstance(test, str):
            return self.run(branches[int(test)], inputs)
        if len(branches) != 2:
            raise LoweringError(f"it has a choice among {len(branches)} branches")
        taken = self.do("ne", kind, test, 0)
        masks = self.do("not", _BOOL, taken), taken
        each = [
            self._where_any(equation, inputs, *own) for own in zip(branches, masks, strict=True)
        ]
        kinds = (out.aval.dtype for out in equation.outvars)
        return [_each(partial(self.select, kind, taken), yes, no)
                for kind, no, yes in zip(kinds, *each, strict=True)]  # fmt: skip

    def _where_any(
        self, equation: Any, inputs: Sequence[Values], branch: Any, mask: Any
    ) -> list[Values]:
        """Return the results of a branch where any lane takes it, and otherwise zeros."""
        own, after, before = self.name("branch"), self.name("after"), self.label
        self.lines.append(f"br i1 {self.any(mask)}, label %{own}, label %{after}")
        self.block(own)
        with self.scope():
            results = self.run(branch, inputs)
        end = self.label
        self.lines.append(f"br label %{after}")
        self.block(after)

        def either(kind: Any, value: Any) -> str:
            edges = f"[ {_value(value, kind)}, %{end} ], [ zeroinitializer, %{before} ]"
            return self.emit(f"phi {_vector(kind)} {edges}")

        pairs = zip(equation.outvars, results, strict=True)
        return [_each(partial(either, out.aval.dtype), result) for out, result in pairs]

    def loop(self, equation: Any, *inputs: Values) -> list[Values]:
        """Return the results of a loop; a lane that has ended keeps its state."""
        params, kinds = equation.params, [out.aval.dtype for out in equation.outvars]
        of_test, of_body, start = _parts(inputs, params["cond_nconsts"], params["body_nconsts"])
        head, body, after = (self.name(label) for label in ("head", "body", "after"))
        before, place = self.label, len(self.lines) + 2
        self.lines.append(f"br label %{head}")
        self.block(head)
        state = [_each(lambda _: self.name(), x) for x in start]
        with self.scope():
            (test,) = self.run(params["cond_jaxpr"], (*of_test, *state))
            choice = self.any(test[()])
            self.lines.append(f"br i1 {choice}, label %{body}, label %{after}")
            self.block(body)
            moved = self.run(params["body_jaxpr"], (*of_body, *state))
            moved = [_each(partial(self.select, kind, test[()]), new, old)
                     for kind, new, old in zip(kinds, moved, state, strict=True)]  # fmt: skip
            self.lines.append(f"br label %{head}")
        self.lines[place:place] = [
            f"{name} = phi {_vector(kind)} [ {_value(a, kind)}, %{before} ], "
            f"[ {_value(b, kind)}, %{self.label} ]"
            for kind, *parts in zip(kinds, state, start, moved, strict=True)
            for name, a, b in zip(*(x.ravel() for x in parts), strict=True)
        ]
        self.block(after)
        return state

    def unrolled(self, equation: Any, *inputs: Values) -> list[Values]:
        """Return the results of a loop of known length."""
        params, results = equation.params, []
        fixed, carry, rows = _parts(inputs, params["num_consts"], params["num_carry"])
        turn = -1 if params["reverse"] else 1
        for step in range(params["length"])[::turn]:
            values = self.run(params["jaxpr"], (*fixed, *carry, *(x[step] for x in rows)))
            carry, result = values[: len(carry)], values[len(carry) :]
            results.append(result)
        return [*carry, *(np.stack(row) for row in zip(*results[::turn], strict=True))]


# Functions of arrays: of the program, the equation and the arrays.
ARRAYS: dict[str, Callable[..., Any]] = {
    "reduce_sum": partial(Program.reduced, operation="add"),
    "reduce_max": partial(Program.reduced, operation="max"),
    "reduce_min": partial(Program.reduced, operation="min"),
    "reduce_and": partial(Program.reduced, operation="and"),
    "reduce_or": partial(Program.reduced, operation="or"),
    "argmax": partial(Program.place, comparison="gt"),
    "argmin": partial(Program.place, comparison="lt"),
    "cumsum": Program.accumulated,
    "select_n": Program.selected,
    "sort": Program.sort,
    "cholesky": Program.cholesky,
    "triangular_solve": Program.solve,
    "gather": Program.gather,
    "cond": Program.branch,
    "while": Program.loop,
    "scan": Program.unrolled,
    "jit": Program.inline,
    "custom_jvp_call": Program.inline,
}


class Buffer(NamedTuple):
    """The memory of arrays (…, 1): (entries, runs), or with a ``length`` rows (runs, length)."""

    kind: Any
    arrays: Sequence[Any]
    length: int | None = None

    def load(self, code: Program, pointer: str) -> list[Values]:
        """Return the arrays."""
        kinds = self._kinds()
        values: Values = np.empty(len(kinds), dtype=object)
        for place, text, pointers in self._groups(code, pointer, len(kinds)):
            loads = [code.emit(f"load {text}, ptr {own}, align 1") for own in pointers]
            if text == _vector(self.kind):
                values[place : place + LANES] = code.transpose(self.kind, loads)
            else:
                values[place] = code.join(self.kind, loads)
        for place, kind in enumerate(kinds):
            values[place] = code.convert(self.kind, kind, values[place])
        parts = np.split(values, np.cumsum([array.size for array in self.arrays])[:-1])
        return [part.reshape(own.shape) for part, own in zip(parts, self.arrays, strict=True)]

    def store(self, code: Program, pointer: str, arrays: Iterable[Values]) -> None:
        """Store the arrays."""
        kinds, kind = self._kinds(), self.kind
        entries = (value for array in arrays for value in array.ravel())
        values = [code.convert(own, kind, value) for own, value in zip(kinds, entries, strict=True)]
        for place, text, pointers in self._groups(code, pointer, len(kinds)):
            if text == _vector(kind):
                parts = code.transpose(kind, values[place : place + LANES])
            else:
                each = (code.lane(kind, values[place], lane) for lane in range(LANES))
                parts = [_literal(number, kind) for number in each]
            pairs = zip(parts, pointers, strict=True)
            code.lines += [f"store {text} {part}, ptr {own}, align 1" for part, own in pairs]

    def _kinds(self) -> list[Any]:
        return [array.dtype for array in self.arrays for _ in range(array.size)]

    def _groups(
        self, code: Program, pointer: str, count: int
    ) -> Iterator[tuple[int, str, list[str]]]:
        """Yield place, type and each lane's pointer of an entry, or of four neighbours in a row.

        The last four of a row may repeat some.
        """
        text, size = _type(self.kind), LANES if self.length and count >= LANES else 1
        for place in (min(first, count - size) for first in range(0, count, size)):
            far = place if self.length else code.emit(f"mul i64 %runs, {place}")
            pointers = []
            for lane in range(LANES):
                first = code.emit(f"mul i64 %run{lane}, {self.length or 1}")
                row = code.emit(f"getelementptr {text}, ptr {pointer}, i64 {first}")
                pointers.append(code.emit(f"getelementptr {text}, ptr {row}, i64 {far}"))
            yield place, text if size == 1 else _vector(self.kind), pointers


def assembly(closed: Any, sources: Sequence[Buffer], sinks: Sequence[Buffer], most: int) -> str:
    """Return the function ``step(runs, sources, sinks)`` of a jaxpr of one run.

    Args:
        closed: The jaxpr; its arguments and results are the arrays of the buffers in turn.
        sources: Memory of the arguments.
        sinks: Memory of the results.
        most: Number of instructions that is allowed.

    Raises:
        LoweringError: A primitive is unknown, or the program is too long.
    """
    code, inputs, pointers = Program(most), [], []
    code.block("each")
    for number, buffer in enumerate(sources):
        pointers.append(f"%source{number}")
        inputs += buffer.load(code, pointers[-1])
    results = iter(code.run(closed, inputs))
    for number, buffer in enumerate(sinks):
        pointers.append(f"%sink{number}")
        buffer.store(code, pointers[-1], itertools.islice(results, len(buffer.arrays)))
    runs = [  # the lanes behind the last run repeat it
        f"%own{lane} = add i64 %run, {lane}\n"
        f"%late{lane} = icmp sgt i64 %own{lane}, %last\n"
        f"%run{lane} = select i1 %late{lane}, i64 %last, i64 %own{lane}"
        for lane in range(LANES)
    ]
    return "\n".join(
        (
            *(f"{name}{text}" for text, name in code.outside.items()),
            f"define void @step(i64 %runs, ptr noalias {', ptr noalias '.join(pointers)}) {{",
            "entry:",
            *code.first,
            "%last = sub i64 %runs, 1",
            "br label %each",
            f"each:\n%run = phi i64 [ 0, %entry ], [ %next, %{code.label} ]",
            *runs,
            *code.lines[1:],
            f"%next = add i64 %run, {LANES}",
            "%more = icmp slt i64 %next, %runs",
            "br i1 %more, label %each, label %done",
            "done:\nret void\n}\n",
        )
    )


def _kind(equation: Any, place: int = 0) -> Any:
    return equation.invars[place].aval.dtype


def _new(params: Any) -> Any:
    return np.dtype(params["new_dtype"])


def _type(kind: Any) -> str:
    """Return LLVM's name of a type."""
    if kind.kind == "f":
        return "float" if kind.itemsize == 4 else "double"
    return "i1" if kind == _BOOL else f"i{8 * kind.itemsize}"


def _vector(kind: Any) -> str:
    """Return LLVM's name of the type of a value."""
    return f"<{LANES} x {_type(kind)}>"


def _value(value: Any, kind: Any) -> str:
    """Return the text of a value, of all lanes."""
    text = _literal(value, kind)
    return text if isinstance(value, str) else f"splat ({_type(kind)} {text})"


def _literal(value: Any, kind: Any) -> str:
    """Return the text of a constant or name."""
    if isinstance(value, str):
        return value
    if kind.kind == "f":  # LLVM writes both sizes as the bits of the larger one
        return f"0x{np.float64(kind.type(value)).view(np.uint64):016X}"
    return str(bool(value)).lower() if kind == _BOOL else str(int(value))


def _each(function: Callable[..., Any], *arrays: Any) -> Values:
    """Return a function of the entries of arrays."""
    return np.asarray(np.frompyfunc(function, len(arrays), 1)(*arrays), dtype=object)


def _objects(value: Any) -> Values:
    return np.asarray(value).astype(object)


def _parts(inputs: Sequence[Values], *sizes: int) -> tuple[Sequence[Values], ...]:
    """Return groups of two sizes and the rest."""
    first, second = np.cumsum(sizes)
    return inputs[:first], inputs[first:second], inputs[second:]


def _sliced(x: Values, start_indices: Any, limit_indices: Any, strides: Any) -> Values:
    spans = zip(start_indices, limit_indices, strides or [1] * x.ndim, strict=True)
    return x[tuple(slice(*span) for span in spans)]


def _broadcast(x: Values, shape: Any, broadcast_dimensions: Any, **_: Any) -> Values:
    own = dict(zip(broadcast_dimensions, x.shape, strict=True))
    return np.broadcast_to(x.reshape([own.get(axis, 1) for axis in range(len(shape))]), shape)


def _counted(shape: Any, dimension: int, **_: Any) -> Values:
    return _broadcast(_objects(np.arange(shape[dimension])), shape, [dimension])


def _padded(x: Values, value: Values, config: Any) -> Values:
    if any(low < 0 or high < 0 or inner for low, high, inner in config):
        raise LoweringError("it pads between entries, or by less than nothing")
    return np.pad(x, [span[:2] for span in config], constant_values=value[()])
