"""Earlier names of values, accepted until the next minor version."""

import warnings
from typing import Any

# Classes of knowledge and owners of memory; what a sensor receives of an observation block.
VALUES = {
    "coordinator": "scheduler",
    "coordinator_memory": "scheduler_memory",
    "told": "broadcast",
}


def current(field: str, value: Any) -> Any:
    """Return the present name of a value, with a ``DeprecationWarning`` for an earlier one."""
    present = replace_value(value)
    if present != value:
        warnings.warn(
            f"{field} = {value!r} is deprecated: use {present!r}", DeprecationWarning, stacklevel=3
        )
    return present


def replace_value(value: Any) -> Any:
    """Return the present name of a value from a file, without a warning."""
    return VALUES.get(value, value) if isinstance(value, str) else value
