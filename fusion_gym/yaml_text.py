"""A YAML reader with plain values, unique keys and limits of size."""

import re
from collections.abc import Hashable
from pathlib import Path
from typing import Any

from fusion_gym.errors import ConfigurationError, refusal
from fusion_gym.importing import refuse_code, require
from fusion_gym.validation import CONTROL, LONGEST_YAML, MOST_ENTRIES, nested, read_text

require("a file of options", "agents", "yaml")
import yaml  # noqa: E402

_CONTROL = re.compile(rf"(?![\t\n]){CONTROL}")  # line breaks and tabs are allowed
_NUMBERS = {  # YAML 1.2: without sexagesimal 1:30 and octal 010, with 1e-3
    "int": r"[-+]?(0|[1-9][\d_]*|0x[\da-fA-F_]+|0b[01_]+)$",
    "float": r"[-+]?((\d[\d_]*\.[\d_]*|\.\d[\d_]*)([eE][-+]?\d+)?|\d+[eE][-+]?\d+)$"
    r"|[-+]?\.(inf|Inf|INF)$|\.(nan|NaN|NAN)$",
}


class _Loader(yaml.SafeLoader):
    """YAML with unique keys and the numbers of YAML 1.2."""

    yaml_implicit_resolvers = {  # noqa: RUF012
        first: [row for row in rows if row[0].rpartition(":")[2] not in _NUMBERS]
        for first, rows in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Merge the mappings of ``<<``, up to ``MOST_ENTRIES`` entries."""
        super().flatten_mapping(node)
        if len(node.value) > MOST_ENTRIES:
            raise _problem("it merges too many entries", node)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Return a mapping, or raise a ``ConstructorError`` for a duplicate key."""
        visited = set()
        for key_node, _ in node.value:
            if key_node.tag == "tag:yaml.org,2002:merge":
                continue
            key = self.construct_object(key_node, deep=True)
            if isinstance(key, Hashable) and key in visited:
                raise _problem(f"the key {key!r} appears twice", key_node)
            visited.add(key)
        return super().construct_mapping(node, deep)


def _problem(text: str, node: yaml.Node) -> yaml.YAMLError:
    return yaml.constructor.ConstructorError(None, None, text, node.start_mark)


for _kind, _pattern in _NUMBERS.items():
    _Loader.add_implicit_resolver(
        f"tag:yaml.org,2002:{_kind}", re.compile(_pattern), list("-+.0123456789")
    )


def parsed(text: str, source: str) -> Any:
    """Return the content of a YAML text; ``source`` is its name in an error message."""
    try:
        if len(text) > LONGEST_YAML:
            raise ValueError(f"it has more than {LONGEST_YAML:,} characters")
        result = yaml.load(text, _Loader)  # a safe loader
    # PyYAML's types raise other errors, such as for a date of 31 February.
    except (yaml.YAMLError, ValueError, AttributeError, TypeError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise ConfigurationError(f"{source} is not YAML: {reason}") from None
    for key, part in nested(source, result):
        if isinstance(part, str) and _CONTROL.search(key + part):
            raise refusal(f"{source}: {key}", part, "text without control characters")
    refuse_code(result, source)
    return result


def load_yaml(field: str, path: Path) -> Any:
    """Return the content of a YAML file."""
    return parsed(read_text(field, path), f"{field} = {str(path)!r}")
