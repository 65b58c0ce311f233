"""Values that the disk keeps: the numbers of ``"auto"``."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import fusion_gym
from fusion_gym.core import code_cache, scale

LINEAR = "fusion_gym/LinearFusion-v2"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty folder of values."""
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    code_cache._value_folder.cache_clear()
    yield tmp_path / ".cache/fusion-gym/values"
    code_cache._value_folder.cache_clear()


def prices(**options: Any) -> Any:
    """The range of prices and the scale, as a new process makes them."""
    scale._STORED.clear()
    options = {"horizon": 20, "price_range": "auto", "cost_weight": "random"} | options
    task = fusion_gym.make_task(LINEAR, **options)
    return task.reward.price.span, task.settings["reward_scale"]


def never(monkeypatch: pytest.MonkeyPatch) -> None:
    """From now on a simulation fails."""

    def nominal_error(task: Any) -> Any:
        raise AssertionError(task)

    def price_range(task: Any) -> Any:
        raise AssertionError(task)

    for stub in (nominal_error, price_range):
        monkeypatch.setattr(scale, stub.__name__, stub)


def test_the_disk_holds_the_simulated_values(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(code_cache, "read_code", lambda *_: None)
        expected = prices()
    assert prices() == expected
    never(monkeypatch)
    assert prices() == expected


def test_other_options_and_sources_have_other_values(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = prices(), prices(measurement_covariances=3.0)
    assert first != second
    assert prices(token_rate=0.7) not in (first, second)
    never(monkeypatch)
    assert prices() == first
    monkeypatch.setattr(code_cache, "_sources", lambda: b"other")
    with pytest.raises(AssertionError):
        prices()


def test_a_damaged_value_is_simulated_anew(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = prices()
    for file in folder.iterdir():
        file.write_bytes(file.read_bytes()[:-1] + b"?")
    assert prices() == expected
    never(monkeypatch)
    assert prices() == expected


@pytest.mark.filterwarnings("error")
def test_without_a_folder_values_are_simulated(tmp_path: Path, folder: Path) -> None:
    expected = prices()
    code_cache._value_folder.cache_clear()
    folder.parent.chmod(0o700)
    for file in folder.iterdir():
        file.unlink()
    folder.rmdir()
    folder.write_bytes(b"no folder")
    assert prices() == expected
    assert folder.read_bytes() == b"no folder"


def test_values_of_code_outside_of_the_package_are_not_stored(folder: Path) -> None:
    assert code_cache.stored("values", (prices,), lambda: 1) == 1
    assert code_cache.stored("values", (prices,), lambda: 2) == 2
    assert code_cache.stored("values", (1.0,), lambda: 3) == 3
    assert code_cache.stored("values", (1.0,), lambda: 4) == 3
