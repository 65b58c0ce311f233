"""Files of a run that are damaged: the command says what is wrong or goes on, and loses nothing."""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from command_runs import call, succeed
from hostile_folder import contents
from small_runs import arguments, meaning

DAMAGES: dict[str, Callable[[bytes, bytes], bytes]] = {
    "cut short": lambda content, other: content[: len(content) * 2 // 3],
    "empty": lambda content, other: b"",
    "text": lambda content, other: "an answer, not a file: ±\n".encode(),
    "another run's": lambda content, other: other,
    "a changed byte": lambda content, other: (
        content[: len(content) // 2]
        + bytes([content[len(content) // 2] ^ 0xFF])
        + content[len(content) // 2 + 1 :]
    ),
}
# The files without which a command cannot go on.
READ: dict[str, tuple[str, ...]] = {
    "train": ("run/latest.zip",),
    "evaluate": ("result.json",),
    "search": ("search/generations.json",),
}
# Those that it writes anew.
WRITTEN = {
    "train": (
        *("run/config.yaml", "run/best_model.zip", "run/final_model.zip"),
        *("run/validation.jsonl", "run/summary.json"),
    ),
    "evaluate": (),
    "search": ("search/search.json",),
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, int], Path]:
    """Folders of finished runs by command and seed, made when they are asked for."""
    jobs: dict[tuple[str, int], Path] = {}

    def find(command: str, seed: int) -> Path:
        if (command, seed) not in jobs:
            jobs[command, seed] = folder = tmp_path_factory.mktemp(command)
            succeed(command, arguments(command, folder, seed))
        return jobs[command, seed]

    return find


def cases() -> Iterator[Any]:
    """Every file with every damage; in the short form the damages take turns."""
    kinds, turn = list(DAMAGES), 0
    for command, read in READ.items():
        for file in (*read, *WRITTEN[command]):
            for kind in kinds:
                quick = kind == kinds[turn % len(kinds)]
                marks = () if quick else (pytest.mark.slow,)
                yield pytest.param(command, file, kind, marks=marks, id=f"{command}-{file}-{kind}")
            turn += 1


@pytest.mark.parametrize(("command", "file", "kind"), list(cases()))
def test_a_damaged_file_is_reported_or_mended(
    runs: Callable[[str, int], Path], tmp_path: Path, command: str, file: str, kind: str
) -> None:
    folder = tmp_path / "run"
    shutil.copytree(runs(command, 0), folder)
    other = runs(command, 1) / file if kind == "another run's" else folder / file
    words = arguments(command, folder)
    damaged = folder / file
    damaged.write_bytes(DAMAGES[kind](damaged.read_bytes(), other.read_bytes()))
    before = files(folder)
    ended = call(command, [*words, "--resume"])
    assert ended.trace == ""
    if ended.status == 0:
        assert file not in READ[command] or kind == "a changed byte", "it went unnoticed"
        assert meaning(folder) == meaning(runs(command, 0))
        return
    assert file in READ[command], ended.err
    assert ended.err.splitlines()[-1].startswith("error: ")
    assert files(folder) == before, "the rest is untouched"


def files(folder: Path) -> dict[str, bytes | None]:
    """Return all that is in the folder, but for locks."""
    return {name: raw for name, raw in contents(folder).items() if not name.endswith(".lock")}
