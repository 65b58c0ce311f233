"""Entries by name whose names are open."""

from typing import Any

Options = dict[str, Any]  # of an environment, as a user gives them
Arguments = dict[str, Any]  # of a call
Plain = dict[str, Any]  # numbers, texts, lists and tables, as JSON and YAML hold them
State = dict[str, Any]  # of an object, as a file or another process keeps it
