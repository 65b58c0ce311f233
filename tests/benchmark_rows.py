"""Rows of the benchmark's tables from their files."""

import csv
from pathlib import Path
from typing import TypeVar

import pydantic

from agents.benchmark.tables import KINDS

Row = TypeVar("Row")


def read_rows(folder: Path, kind: type[Row]) -> list[Row]:
    """Return the rows of a kind."""
    adapter = pydantic.TypeAdapter(list[kind])  # type: ignore[valid-type]
    with (folder / f"{KINDS[kind]}.csv").open(newline="") as file:
        return adapter.validate_python(list(csv.DictReader(file)))
