"""YAML as it is read here: plain values alone, no key given twice, and limits of size."""

import itertools
import re
from collections.abc import Hashable, Iterable
from typing import Any

import yaml

from fusion_gym.errors import ConfigurationError
from fusion_gym.importing import refuse_code
from fusion_gym.validation import CONTROL, DEEPEST, MOST_ENTRIES

_CONTROL = re.compile(rf"(?![\t\n]){CONTROL}")  # texts have lines
_NUMBERS = {  # without YAML 1.1's sexagesimal 1:30 and octal 010, and with 1e-3, as in YAML 1.2
    "int": r"[-+]?(0|[1-9][\d_]*|0x[\da-fA-F_]+|0b[01_]+)$",
    "float": r"[-+]?((\d[\d_]*\.[\d_]*|\.\d[\d_]*)([eE][-+]?\d+)?|\d+[eE][-+]?\d+)$"
    r"|[-+]?\.(inf|Inf|INF)$|\.(nan|NaN|NAN)$",
}


class _Loader(yaml.SafeLoader):
    """YAML whose keys are given once, and whose depth and size, aliases expanded, are limited."""

    yaml_implicit_resolvers = {  # noqa: RUF012
        first: [row for row in rows if row[0].rpartition(":")[2] not in _NUMBERS]
        for first, rows in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = 0
        self._sizes: dict[yaml.Node, int] = {}

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose a node.

        Raises:
            ConstructorError: too deep, too large, within itself, or control characters.
        """
        self._depth += 1
        alias = self.check_event(yaml.AliasEvent)
        parts: Iterable[yaml.Node] = ()
        self._require(self._depth <= DEEPEST, f"it is nested more than {DEEPEST} times")
        node = super().compose_node(parent, index)
        assert node is not None
        self._depth -= 1
        if alias:
            self._require(node in self._sizes, "an alias stands within its own anchor")
        else:
            match node:
                case yaml.ScalarNode():
                    self._require(not _CONTROL.search(node.value), "it holds a control character")
                case yaml.MappingNode():
                    parts = itertools.chain.from_iterable(node.value)
                case _:
                    parts = node.value
            self._sizes[node] = 1 + sum(self._sizes[part] for part in parts)
        self._require(
            self._sizes[node] <= MOST_ENTRIES, f"it has more than {MOST_ENTRIES:,} entries"
        )
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """A mapping.

        Raises:
            ConstructorError: a key that is given twice.
        """
        visited = set()
        for key_node, _ in node.value:
            if key_node.tag == "tag:yaml.org,2002:merge":
                continue
            key = self.construct_object(key_node, deep=True)
            repeats = isinstance(key, Hashable) and key in visited
            self._require(not repeats, f"the key {key!r} is given twice", key_node)
            visited.add(key)
        return super().construct_mapping(node, deep)

    def _require(self, allowed: bool, problem: str, node: yaml.Node | None = None) -> None:
        if not allowed:
            mark = self.get_mark() if node is None else node.start_mark
            raise yaml.constructor.ConstructorError(None, None, problem, mark)


for _kind, _pattern in _NUMBERS.items():
    _Loader.add_implicit_resolver(
        f"tag:yaml.org,2002:{_kind}", re.compile(_pattern), list("-+.0123456789")
    )


def parsed(text: str, source: str) -> Any:
    """What a text in YAML holds; ``source`` says in an error where it is from.

    Raises:
        ConfigurationError: it is no YAML, or names code.
    """
    try:
        result = yaml.load(text, _Loader)  # a safe loader
    # PyYAML lets through what its types raise: a date of 31 February, tags without a value.
    except (yaml.YAMLError, ValueError, AttributeError, TypeError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise ConfigurationError(f"{source} is no YAML: {reason}") from None
    refuse_code(result, source)
    return result
