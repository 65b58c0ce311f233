"""A paper as simulated pieces, the numbers of its page, and its figures."""

import importlib
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from agents.cache import Cache
from agents.papers.claims import Claim
from fusion_gym.entries import Plain
from fusion_gym.validation import ConfigurationError, choice

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

    ``simulate(episodes, seed, settings)`` returns numbers, texts, lists and arrays by name.
    ``summarise`` takes them and returns additional entries
    of the page, its ``tables`` as lists of numbers by name. ``weight`` is about the seconds of one
    core for ``usual`` episodes.
    """

    name: str
    simulate: Callable[..., Data]
    summarise: Callable[[Data], Data]
    weight: float
    usual: int = 1000


class PieceData(dict[str, Any]):
    """Data by name, also as attributes."""

    def __getattr__(self, name: str) -> Any:
        if name not in self:
            raise AttributeError(name)
        return PieceData(self[name]) if isinstance(self[name], dict) else self[name]


class PieceJob(NamedTuple):
    """A piece with episodes, seed and settings."""

    piece: Piece
    episodes: int
    seed: int
    settings: Data

    @property
    def counts(self) -> dict[str, int]:
        """Return episodes and seed by name."""
        return {"episodes": self.episodes, "seed": self.seed}

    @property
    def key(self) -> tuple[Callable[..., Data], Data]:
        """Return the function and all inputs of the data."""
        return self.piece.simulate, self.counts | {"settings": self.settings}

    @property
    def weight(self) -> float:
        """About the seconds of one core."""
        return self.piece.weight * self.episodes / self.piece.usual

    def simulate(self, cache: Cache) -> Data:
        """Return the data of the piece, from the cache or simulated."""
        return cache.call(*self.key, self.episodes, self.seed, self.settings)


class PaperFigure(NamedTuple):
    """A figure: ``draw(figure, data)`` draws the data of a piece into an empty matplotlib Figure.

    ``size`` is in inches.
    """

    piece: str
    draw: Callable[[Any, Data], None]
    size: tuple[float, float] = (7.2, 4.2)

    def draw_data(self, data: Data) -> Figure:
        """Return the drawn figure."""
        result = Figure(figsize=self.size, layout="constrained")
        self.draw(result, data)
        return result


class Paper(NamedTuple):
    """A paper: its pieces in the order of its page, its figures by name, and its parameters.

    ``readings`` assign what the text leaves open to parameters and to options of the environment,
    the environment's first. ``texts`` returns more tables of the page, by name, from the data of
    the pieces by reading.
    """

    name: str
    pieces: Sequence[Piece]
    figures: Mapping[str, PaperFigure]
    parameters: Settings = NOTHING
    readings: Mapping[str, Settings] = MappingProxyType({"": NOTHING})
    claims: Sequence[Claim] = ()
    texts: Callable[[Mapping[str, Mapping[str, PieceData]]], Mapping[str, str]] = lambda runs: {}

    def settings(self, changes: Settings) -> Data:
        """Return the changed parameters, and changed options as ``options``."""
        own = {name: changes.get(name, value) for name, value in self.parameters.items()}
        return own | {"options": {n: value for n, value in changes.items() if n not in own}}


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
