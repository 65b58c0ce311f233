"""The tables of results, ``RESULTS/SETTING/TABLE.csv``: read, checked and written.

``columns.csv`` beside this module lists all columns with their kind and meaning. Numbers are
written to their last digit and read back bit for bit; an empty cell says that there is nothing. A
column of the kind ``interval`` stands for three: the mean NAME, ``NAME_low`` and ``NAME_high``, the
ends of its 95 % interval.
"""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd

from fusion_gym.errors import display
from fusion_gym.validation import ConfigurationError

from ..output.files import replacing

Row = dict[str, Any]
VERDICT = "verdict"  # the table of a setting that is written last


class Column(NamedTuple):
    """What a column holds; ``empty`` where a cell may hold nothing, ``allowed`` the words."""

    kind: Literal["text", "number", "count", "flag", "json", "interval"]
    meaning: str
    empty: bool = False
    allowed: tuple[str, ...] = ()


def _read_columns() -> dict[str, dict[str, Column]]:
    """Return the columns of every table, from the list beside this module."""
    result: dict[str, dict[str, Column]] = {}
    rows = pd.read_csv(Path(__file__).with_name("columns.csv"), dtype=str, keep_default_na=False)
    for table, name, kind, empty, allowed, meaning in rows.itertuples(index=False):
        column = Column(kind, meaning, empty == "yes", tuple(allowed.split()))
        result.setdefault(table, {})[name] = column
    return result


TABLES = _read_columns()


def columns_of(table: str) -> dict[str, Column]:
    """Return the columns of a table's file: an interval has three."""
    result: dict[str, Column] = {}
    for name, column in TABLES[table].items():
        ends = ("", "_low", "_high") if column.kind == "interval" else ("",)
        result |= {f"{name}{end}": column for end in ends}
    return result


def write_rows(folder: Path, table: str, rows: Iterable[Mapping[str, Any]]) -> None:
    """Replace a table in one move; what is no column of it is left out."""
    flat = []
    for row in rows:
        cells = dict(row)
        for name, column in TABLES[table].items():
            if column.kind == "interval" and name in cells:
                ends = cells[name]
                cells |= {name: ends["mean"], f"{name}_low": ends["low"]}
                cells[f"{name}_high"] = ends["high"]
            elif column.kind == "json" and name in cells:
                cells[name] = json.dumps(cells[name], default=list)
        flat.append(cells)
    columns = columns_of(table)
    frame = pd.DataFrame(flat, columns=list(columns), dtype=object)
    with replacing(folder / f"{table}.csv") as partial:
        frame.to_csv(partial, index=False, lineterminator="\n")


def read_frame(folder: Path, table: str, option: str = "results") -> pd.DataFrame:
    """Return a table, its cells checked.

    Raises:
        ConfigurationError: it cannot be read, or a column or cell is not what the table has; names
            ``option``, the file, the column and the cell.
    """
    path, columns = folder / f"{table}.csv", columns_of(table)
    words: dict[Any, Any] = {
        name: str for name, item in columns.items() if item.kind in ("text", "flag", "json")
    }
    try:
        frame = pd.read_csv(
            path, dtype=words, keep_default_na=False, na_values=[""], float_precision="round_trip"
        )
    except (OSError, ValueError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise ConfigurationError(f"{option} = {str(path)!r} cannot be read: {reason}") from None
    if list(frame.columns) != list(columns):
        differing = sorted(set(columns) ^ set(frame.columns)) or ["another order"]
        raise ConfigurationError(
            f"{option} = {str(path)!r} has other columns than the table {table!r}: "
            f"{display(differing[0])}"
        )
    for name, column in columns.items():
        frame[name], wrong = _check(frame[name], column)
        if column.kind == "interval":  # all of it is there, or nothing
            mean = name.removesuffix("_low").removesuffix("_high")
            wrong |= frame[name].isna() & frame[mean].notna()
        if wrong.any():
            value = frame[name][wrong].tolist()[0]
            cell = "an empty cell" if pd.isna(value) else display(value)
            raise ConfigurationError(
                f"{option} = {str(path)!r}: {name} = {cell} is not allowed: it must be "
                f"{' or '.join(map(repr, column.allowed)) or _KINDS[column.kind]}"
            )
    return frame


_KINDS = {
    "text": "text", "number": "a finite number", "count": "a whole number",
    "flag": "True or False", "json": "JSON", "interval": "a finite number",
}  # fmt: skip


def _check(values: "pd.Series[Any]", column: Column) -> "tuple[pd.Series[Any], pd.Series[bool]]":
    """Return the column as its kind has it, and which of its cells are not allowed."""
    absent = values.isna()
    wrong = absent & (not column.empty)
    if column.kind in ("number", "interval", "count"):
        numbers = pd.to_numeric(values, errors="coerce").astype(float)
        wrong |= ~absent & ~np.isfinite(numbers)
        if column.kind == "count":
            wrong |= ~absent & (numbers % 1.0 != 0.0)
        if wrong.any():
            return values, wrong
        return (numbers.astype("Int64") if column.kind == "count" else numbers), wrong
    if column.kind == "flag":
        wrong |= ~absent & ~values.isin(["True", "False"])
        flags = values.map({"True": True, "False": False}).astype(object)
        return (values if wrong.any() else flags), wrong
    if column.allowed:
        wrong |= ~absent & ~values.isin(column.allowed)
    if column.kind == "json":
        wrong |= ~absent & ~values.map(_is_json)
    return values, wrong


def _is_json(text: Any) -> bool:
    try:
        json.loads(text)
    except (TypeError, ValueError, RecursionError):
        return False
    return True


def read_rows(folder: Path, table: str, option: str = "results") -> list[Row]:
    """Return a table's rows, intervals and JSON as values, without what is empty.

    Raises:
        ConfigurationError: as :func:`read_frame`.
    """
    kinds = {name: column.kind for name, column in TABLES[table].items()}
    result = []
    for cells in read_frame(folder, table, option).to_dict("records"):
        row: Row = {}
        for name, kind in kinds.items():
            if pd.isna(cells[name]):
                continue
            value = cells[name]
            if kind == "interval":
                value = {"mean": value, "low": cells[f"{name}_low"], "high": cells[f"{name}_high"]}
            row[name] = json.loads(value) if kind == "json" else value
        result.append(row)
    return result


def group_by(rows: Iterable[Row], name: str) -> dict[str, list[Row]]:
    """Return the rows by one of their columns, without it."""
    result: dict[str, list[Row]] = {}
    for row in rows:
        result.setdefault(row.pop(name), []).append(row)
    return result
