"""The tables of results, ``RESULTS/SETTING/TABLE.csv``: read, checked and written.

``columns.csv`` beside this module lists all columns with their kind and meaning. Numbers are
written to their last digit and read back bit for bit; an empty cell says that there is nothing. A
column of the kind ``interval`` stands for three: the mean NAME, ``NAME_low`` and ``NAME_high``, the
ends of its 95 % interval.
"""

import csv
import functools
import io
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import pandas as pd
import pydantic

from fusion_gym.errors import display
from fusion_gym.output.files import replacing
from fusion_gym.training.checked import checked
from fusion_gym.validation import ConfigurationError, read_text

Row = dict[str, Any]
VERDICT = "verdict"  # the table of a setting that is written last
# Whoever writes these has a row for them.
_NEVER_EMPTY = (
    *("setting", "classes", "vertices", "runs", "policies", VERDICT, "bounds", "rollout"),
    *("robustness", "robustness_points"),
)
_ENDS = {"mean": "", "low": "_low", "high": "_high"}  # of an interval's columns


class CellInterval(pydantic.BaseModel):
    """A mean with the ends of its interval."""

    mean: pydantic.FiniteFloat
    low: pydantic.FiniteFloat
    high: pydantic.FiniteFloat


KINDS: dict[str, Any] = {
    "text": str,
    "number": pydantic.FiniteFloat,
    "count": int,
    "flag": bool,
    "json": pydantic.Json,
    "interval": CellInterval,
}


class Column(NamedTuple):
    """What a column holds; ``empty`` where a cell may hold nothing, ``allowed`` the words."""

    kind: str
    empty: bool
    allowed: tuple[str, ...]

    @property
    def field(self) -> Any:
        """The type of its cells, and its default."""
        words: Any = Literal
        kind = words[self.allowed] if self.allowed else KINDS[self.kind]
        return (kind, None) if self.empty else (kind, ...)


def _read_columns() -> dict[str, dict[str, Column]]:
    """Return the columns of every table, from the list beside this module."""
    result: dict[str, dict[str, Column]] = {}
    rows = pd.read_csv(Path(__file__).with_name("columns.csv"), dtype=str, keep_default_na=False)
    for table, name, kind, empty, allowed, _ in rows.itertuples(index=False):
        column = Column(kind, empty == "yes", tuple(allowed.split()))
        result.setdefault(table, {})[name] = column
    return result


TABLES = _read_columns()


def header_of(table: str) -> list[str]:
    """Return the columns of a table's file: an interval has three."""
    return [
        f"{name}{end}"
        for name, column in TABLES[table].items()
        for end in (_ENDS.values() if column.kind == "interval" else ("",))
    ]


@functools.cache
def _shape_of(table: str) -> Any:
    fields: dict[str, Any] = {name: column.field for name, column in TABLES[table].items()}
    row: Any = pydantic.create_model(table, **fields)
    return list[row]


def write_rows(folder: Path, table: str, rows: Iterable[Mapping[str, Any]]) -> None:
    """Replace a table in one move; what is no column of it is left out."""
    flat = []
    for row in rows:
        cells = dict(row)
        for name, column in TABLES[table].items():
            if column.kind == "interval" and name in cells:
                cells |= {f"{name}{end}": row[name][key] for key, end in _ENDS.items()}
            elif column.kind == "json" and name in cells:
                cells[name] = json.dumps(cells[name], default=list)
        flat.append(cells)
    frame = pd.DataFrame(flat, columns=header_of(table), dtype=object)
    with replacing(folder / f"{table}.csv") as partial:
        frame.to_csv(partial, index=False, lineterminator="\n")


def read_rows(folder: Path, table: str, option: str = "results") -> list[Row]:
    """Return a table's rows, intervals and JSON as values, without what is empty.

    Raises:
        ConfigurationError: it cannot be read, has no rows where it needs some, or a column or cell
            is not what the table has; names ``option``, the file, the column and the cell.
    """
    path, columns = folder / f"{table}.csv", TABLES[table]
    source = f"{option} = {str(path)!r}"
    try:
        lines = list(csv.reader(io.StringIO(read_text(option, path), newline=""), strict=True))
    except csv.Error as error:
        raise ConfigurationError(f"{source} cannot be read: {error}") from None
    header, *cells = [line for line in lines if line] or [[]]
    expected = header_of(table)
    if header != expected or any(len(line) != len(header) for line in cells):
        differing = sorted(set(expected) ^ set(header)) or ["another order"]
        raise ConfigurationError(
            f"{source} has other columns than the table {table!r}: {display(differing[0])}"
        )
    if table in _NEVER_EMPTY and not cells:
        raise ConfigurationError(f"{source} has no rows: it must have at least one below its head")
    rows = []
    for line in cells:
        filled = {name: cell for name, cell in zip(header, line, strict=True) if cell}
        row: Row = {name: filled[name] for name in columns if name in filled}
        for name, column in columns.items():
            ends = {key: f"{name}{end}" for key, end in _ENDS.items()}
            if column.kind == "interval" and any(end in filled for end in ends.values()):
                row[name] = {key: filled[end] for key, end in ends.items() if end in filled}
        rows.append(row)
    return [row.model_dump(exclude_unset=True) for row in checked(_shape_of(table), rows, source)]


def group_by(rows: Iterable[Row], name: str) -> dict[str, list[Row]]:
    """Return the rows by one of their columns, without it."""
    result: dict[str, list[Row]] = {}
    for row in rows:
        result.setdefault(row.pop(name), []).append(row)
    return result
