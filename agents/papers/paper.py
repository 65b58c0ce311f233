"""A paper as simulated pieces, the numbers of its page, and its figures."""

import importlib
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import fusion_gym
from agents.cache import Cache
from fusion_gym.entries import Plain
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError, choice, keys

NAMES = (
    "tobit_token_bucket",
    "adaptive_innovation",
    "markov_jump",
    "unknown_input",
    "round_robin_tobit",
)
Data = Plain  # with arrays
Settings = Mapping[str, Any]
NOTHING: Settings = MappingProxyType({})


class Piece(NamedTuple):
    """A part of a simulation section.

    ``simulate(episodes, seed, settings)`` returns numbers, texts, lists and arrays by name; the
    restriction of a figure adds keywords. ``summarise`` takes them and returns additional entries
    of the page, its ``tables`` as lists of numbers by name. ``weight`` is about the seconds of one
    core for ``usual`` episodes.
    """

    name: str
    simulate: Callable[..., Data]
    summarise: Callable[[Data], Data]
    weight: float
    usual: int = 1000


class PieceJob(NamedTuple):
    """A piece with episodes, seed, settings, and a figure's keywords."""

    piece: Piece
    episodes: int
    seed: int
    settings: Data
    restriction: Data

    @property
    def counts(self) -> dict[str, int]:
        """Return episodes and seed by name."""
        return {"episodes": self.episodes, "seed": self.seed}

    @property
    def key(self) -> tuple[Callable[..., Data], Data]:
        """Return the function and all inputs of the data."""
        inputs = self.counts | {"settings": self.settings, "restriction": self.restriction}
        return self.piece.simulate, inputs

    @property
    def weight(self) -> float:
        """About the seconds of one core."""
        return self.piece.weight * self.episodes / self.piece.usual

    def simulate(self, cache: Cache) -> Data:
        """Return the data of the piece, from the cache or simulated."""
        return cache.call(*self.key, self.episodes, self.seed, self.settings, **self.restriction)


class PaperFigure(NamedTuple):
    """A figure: ``draw(figure, data)`` draws the data of a piece into an empty matplotlib Figure.

    ``size`` is in inches. ``restriction`` has the keywords of ``simulate`` that omit unused data,
    ``without`` the paper's parameters without effect.
    """

    piece: str
    draw: Callable[[Any, Data], None]
    size: tuple[float, float] = (7.2, 4.2)
    restriction: Settings = NOTHING
    without: Sequence[str] = ()


class Parameter(NamedTuple):
    """A parameter of figures: ``check(name, value)`` returns the value or refuses it."""

    default: Any
    check: Callable[[str, Any], Any]


class Paper(NamedTuple):
    """A paper: its pieces in the order of its page, its figures by name, and its parameters.

    ``options`` names the options of ``environment`` that a figure may change as well.
    ``readings`` assign what the text leaves open to parameters and options, the environment's
    first.
    """

    name: str
    pieces: Sequence[Piece]
    figures: Mapping[str, PaperFigure]
    environment: str
    parameters: Mapping[str, Parameter] = NOTHING
    options: Sequence[str] = ()
    readings: Mapping[str, Settings] = MappingProxyType({"": NOTHING})

    def settings(self, changes: Settings, without: Sequence[str] = ()) -> Data:
        """Return the changed parameters, and changed options as ``options``, except ``without``."""
        known = [name for name in (*self.parameters, *self.options) if name not in without]
        keys("option", changes, known)
        settings = {
            name: parameter.check(name, changes.get(name, parameter.default))
            for name, parameter in self.parameters.items()
        }
        options = {name: value for name, value in changes.items() if name in self.options}
        task = fusion_gym.make_task(self.environment, **options)
        for policy in [settings.get("policy", "always"), *settings.get("policies", ())]:
            make_policy(policy, task)
        return settings | {"options": options}

    def figure(self, name: str) -> tuple[str, PaperFigure]:
        """Return a figure with its full name, by its name or number."""
        full = name if name in self.figures else f"figure_{name}"
        if full not in self.figures:
            choice("figure", name, [known.removeprefix("figure_") for known in self.figures])
        return full, self.figures[full]

    def piece(self, name: str) -> Piece:
        """Return a piece by its name."""
        return next(piece for piece in self.pieces if piece.name == name)


def load_paper(name: str) -> Paper:
    """Return a paper from its module."""
    module = importlib.import_module(f"agents.papers.{choice('paper', name, NAMES)}")
    paper: Paper = module.PAPER
    return paper


def load_papers(names: Sequence[str]) -> list[Paper]:
    """Return some papers, each once; ``all`` stands for all of them."""
    if not names:
        raise ConfigurationError(f"papers = () is not allowed: name some of {[*NAMES, 'all']}")
    for name in names:
        choice("paper", name, (*NAMES, "all"))
    return [load_paper(name) for name in (NAMES if "all" in names else dict.fromkeys(names))]
