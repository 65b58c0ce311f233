"""Rows of the benchmark's tables from their files."""

import csv
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

import pydantic

from agents.benchmark.report import Results

Row = TypeVar("Row")
KINDS = {get_args(rows)[0]: name for name, rows in get_type_hints(Results).items()}


def read_rows(folder: Path, kind: type[Row]) -> list[Row]:
    """Return the rows of a kind."""
    adapter = pydantic.TypeAdapter(list[kind])  # type: ignore[valid-type]
    with (folder / f"{KINDS[kind]}.csv").open(newline="") as file:
        return adapter.validate_python(list(csv.DictReader(file)))


def read_results(folder: Path) -> Results:
    """Return all rows of the benchmark."""
    rows: list[Any] = [read_rows(folder, kind) for kind in KINDS]
    return Results(*rows)
