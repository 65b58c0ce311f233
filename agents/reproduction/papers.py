"""The papers that can be reproduced, by name."""

import importlib

from fusion_gym.validation import ConfigurationError, choice

from .paper import Paper

NAMES = (
    "tobit_token_bucket",
    "adaptive_innovation",
    "markov_jump",
    "unknown_input",
    "round_robin_tobit",
)


def paper(name: str) -> Paper:
    """A paper, from its module.

    Raises:
        ConfigurationError: there is none of this name.
    """
    module = importlib.import_module(f".{choice('paper', name, NAMES)}.pieces", __package__)
    return module.PAPER


def papers(names: tuple[str, ...]) -> list[Paper]:
    """Some papers, each once; ``all`` stands for all of them.

    Raises:
        ConfigurationError: no name, or there is none of a name.
    """
    if not names:
        raise ConfigurationError(f"papers = () is not allowed: name some of {[*NAMES, 'all']}")
    for name in names:
        choice("paper", name, (*NAMES, "all"))
    selection = NAMES if "all" in names else tuple(dict.fromkeys(names))
    return [paper(name) for name in selection]
