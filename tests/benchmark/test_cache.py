"""Results on disk: found again for the same inputs and code alone, whatever a process left."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents import cache
from agents.cache import Cache, code_of
from fusion_gym.validation import ConfigurationError

INPUTS = {"episodes": 3, "settings": {"m": [0.5]}}
PLAIN = st.dictionaries(st.text(), st.floats(allow_nan=False) | st.text() | st.lists(st.integers()))


def evaluate(start: float) -> dict[str, Any]:
    return {"sample": start + np.arange(500.0), "nested": {"pair": (1, None)}}


def refuse(start: float) -> dict[str, Any]:
    raise AssertionError("it is there already")


def entries(folder: Path) -> list[Path]:
    return list(folder.rglob("output.pkl"))


def test_a_result_is_computed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = Cache(tmp_path)
    assert not folder.holds(evaluate, INPUTS)
    with pytest.raises(FileNotFoundError):
        folder.read(evaluate, INPUTS)
    first = folder.call(evaluate, INPUTS, start=2.0)
    assert folder.holds(evaluate, INPUTS)
    monkeypatch.setattr(refuse, "__qualname__", "evaluate")
    for again in (folder.call(refuse, INPUTS, 2.0), Cache(tmp_path).read(evaluate, INPUTS)):
        assert again["sample"].tobytes() == first["sample"].tobytes()
        assert again["nested"] == first["nested"]


@pytest.mark.slow
@given(first=PLAIN, second=PLAIN)
def test_inputs_share_a_key_only_if_they_are_equal(first: dict[str, Any], second: Any) -> None:
    same = cache._key(evaluate, first) == cache._key(evaluate, second)
    assert same == (first == second)
    assert cache._key(evaluate, first) != cache._key(refuse, first)


DAMAGES: dict[str, Callable[[Path], Any]] = {
    "truncated": lambda path: path.write_bytes(path.read_bytes()[:-40]),
    "empty": lambda path: path.write_bytes(b""),
    "other": lambda path: path.write_bytes(b"PK\x03\x04" + bytes(range(256))),
    "removed": Path.unlink,
    "folder removed": lambda path: [item.unlink() for item in path.parent.iterdir()],
    "code": lambda path: (path.parents[1] / "func_code.py").write_text("# first line: 1\nhalf"),
    "half-written": lambda path: path.rename(f"{path}.0123-45-67"),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_entry_is_computed_again(
    tmp_path: Path, damage: Callable[[Path], None], capfd: pytest.CaptureFixture[str]
) -> None:
    folder = Cache(tmp_path)
    folder.call(evaluate, INPUTS, 2.0)
    damage(*entries(tmp_path))
    assert not folder.holds(evaluate, INPUTS)
    folder.call(evaluate, INPUTS, 2.0)
    assert folder.holds(evaluate, INPUTS)
    assert capfd.readouterr() == ("", "")


def test_a_result_that_cannot_be_written_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: object, **keywords: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("joblib.numpy_pickle.dump", fail)
    with pytest.raises(ConfigurationError, match=r"folder = .* No space left on device"):
        Cache(tmp_path).call(evaluate, INPUTS, 2.0)


START = "import sys; from pathlib import Path; from agents.cache import Cache\n"


def test_two_processes_at_once(tmp_path: Path) -> None:
    """Both return the result, and leave it; many keys, so that the processes meet."""
    program = START + (
        "def number(value): return value\n"
        "for value in range(100):\n"
        "    assert Cache(Path(sys.argv[1])).call(number, {'value': value}, value) == value\n"
    )
    both = [subprocess.Popen([sys.executable, "-c", program, tmp_path]) for _ in range(2)]
    assert [process.wait(60) for process in both] == [0, 0]
    assert len(entries(tmp_path)) == 100
    assert not list(tmp_path.rglob("output.pkl.*"))


def test_another_process_reads_every_folder_of_this_one(tmp_path: Path) -> None:
    program = START + "import os; print(Cache(Path(sys.argv[1])).read(os.cpu_count, {}))"
    for name in ("first", "second"):
        count = Cache(tmp_path / name).call(os.cpu_count, {})
        words = [sys.executable, "-c", program, str(tmp_path / name)]
        assert int(subprocess.run(words, capture_output=True, check=True).stdout) == count


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str], str]:
    """The hash of a module with this text, beside ``rules/b.py`` with the other."""
    package = tmp_path / "fusion_gym"
    (package / "rules").mkdir(parents=True)
    monkeypatch.setattr(cache, "_ROOT", tmp_path)

    def hash_of(text: str, other: str) -> str:
        (package / "a.py").write_text(text)
        (package / "rules/b.py").write_text(other)
        code_of.cache_clear()
        cache.read_module.cache_clear()
        return code_of("fusion_gym.a")

    return hash_of


IMPORTS = [
    "from .rules import b",
    "from fusion_gym.rules.b import x",
    "import fusion_gym.rules.b",
    'y = "rules.b:Rule"',
    "def late():\n    from .rules.b import x",
]


@pytest.mark.parametrize("text", IMPORTS)
def test_a_key_follows_the_code_that_is_imported(
    project: Callable[[str, str], str], text: str
) -> None:
    """Comments, docstrings and blank lines keep it, a constant does not."""
    code = project(text, "def f():\n    return 1")
    described = '"""Text."""\n\ndef f():  # words\n    """Return one."""\n    return 1\n'
    assert project(f'"""Text."""\n{text}  # words\n', described) == code
    assert project(text, "def f():\n    return 2") != code
    assert project("", "def f():\n    return 1") != code
