"""YAML as it is read here: plain values alone, and no key given twice."""

import re
from collections.abc import Hashable
from typing import Any

import yaml

from fusion_gym.errors import ConfigurationError


class _Loader(yaml.SafeLoader):
    """YAML whose keys are given once, and whose ``1e-3`` is a number, as in YAML 1.2."""

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
            if isinstance(key, Hashable) and key in visited:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key!r} is given twice", key_node.start_mark
                )
            visited.add(key)
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"), "-+.0123456789"
)


def parsed(text: str, source: str) -> Any:
    """What a text in YAML holds; ``source`` says in an error where it is from.

    Raises:
        ConfigurationError: it is no YAML.
    """
    try:
        return yaml.load(text, _Loader)  # a safe loader
    # PyYAML lets through what its types raise: a date of 31 February, tags without a value.
    except (yaml.YAMLError, ValueError, AttributeError, TypeError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise ConfigurationError(f"{source} is no YAML: {reason}") from None
