"""Pieces of a reproduction: simulated once, kept in the work folder, shown again from there."""

import json
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fusion_gym.validation import ConfigurationError
from fusion_gym.version import __version__

from ..output.files import DAMAGED, replacing
from ..output.folders import fingerprint
from .paper import Paper, Piece
from .papers import paper
from .piece_result import PieceResult

_PLAIN = "plain"  # the entry that holds all that is no array, as JSON


class PieceJob(NamedTuple):
    """A piece of a paper with its episodes and seed, and where it is kept."""

    paper: str
    piece: str
    episodes: int
    seed: int
    work: Path

    @property
    def path(self) -> Path:
        """The file that keeps it."""
        return self.work / self.paper / f"{self.piece}.npz"

    @property
    def made_from(self) -> str:
        """A hash of what it is made from."""
        inputs = [self.paper, self.piece, self.episodes, self.seed, __version__]
        return fingerprint({"inputs": inputs})

    def find(self) -> Piece:
        """The piece itself."""
        return next(piece for piece in paper(self.paper).pieces if piece.name == self.piece)

    def finished(self) -> bool:
        """Whether it is there, made from the same."""
        try:
            self.read()
        except (ConfigurationError, FileNotFoundError):
            return False
        return True

    def read(self) -> dict[str, Any]:
        """What its ``compute`` returned.

        Raises:
            FileNotFoundError: it is not there.
            ConfigurationError: it cannot be read, or was made from something else.
        """
        if not self.path.exists():
            raise FileNotFoundError(str(self.path))
        try:
            with np.load(self.path, allow_pickle=False) as arrays:
                if str(arrays["made_from"]) != self.made_from:
                    raise ValueError("it was made from something else")
                content: dict[str, Any] = json.loads(str(arrays[_PLAIN]))
                names = [name for name in arrays.files if name.startswith("/")]
                return content | {name[1:]: arrays[name] for name in names}
        except (*DAMAGED, zipfile.BadZipFile) as error:
            raise ConfigurationError(
                f"work = {str(self.path)!r} cannot be read: {' '.join(str(error).split())}"
            ) from None


def compute_jobs(job: PieceJob) -> None:
    """Simulate a piece and keep it."""
    result = job.find().compute(job.episodes, job.seed)
    arrays = {f"/{name}": value for name, value in result.items() if isinstance(value, np.ndarray)}
    plain = {name: value for name, value in result.items() if not isinstance(value, np.ndarray)}
    with replacing(job.path) as partial:
        data: dict[str, Any] = arrays | {_PLAIN: np.array(json.dumps(plain))}
        np.savez_compressed(partial, made_from=np.array(job.made_from), **data)


def results_of(item: Paper, jobs: dict[str, PieceJob]) -> dict[str, PieceResult]:
    """What every piece of a paper shows, by its name.

    Raises:
        FileNotFoundError: one is not there.
        ConfigurationError: one cannot be read.
    """
    return {piece.name: piece.show(jobs[piece.name].read()) for piece in item.pieces}
