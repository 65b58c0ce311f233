"""Files are replaced in one move: what was there stays until all of what is new is written."""

import os
import shutil
from pathlib import Path

import pytest
from refusals import refused

import fusion_gym
from fusion_gym.output.files import read_json, remove_partials, replacing, write, write_text
from fusion_gym.policies.registry import make_policy


def test_a_file_is_replaced_as_a_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "result.json"
    write(path, {"a": 1})
    assert read_json(path, "result") == {"a": 1}
    with replacing(path) as partial:
        partial.write_text('{"a": 2}')
        assert partial.suffix == ".json"
        assert str(os.getpid()) in partial.name
        assert read_json(path, "result") == {"a": 1}
    assert read_json(path, "result") == {"a": 2}
    with pytest.raises(TypeError, match="not JSON serializable"):
        write(path, {"a": object()})
    with pytest.raises(ZeroDivisionError):
        fail_within(path)
    assert read_json(path, "result") == {"a": 2}
    assert list(path.parent.iterdir()) == [path]


def fail_within(path: Path) -> None:
    with replacing(path) as partial:
        partial.write_text("half of")
        raise ZeroDivisionError


def test_a_link_stays_a_link_and_a_device_a_device(tmp_path: Path) -> None:
    link, target = tmp_path / "link.json", tmp_path / "target.json"
    target.write_text("{}")
    link.symlink_to(target)
    write(link, {"a": 1})
    assert link.is_symlink()
    assert read_json(target, "result") == {"a": 1}
    write(Path(os.devnull), {"a": 1})
    assert Path(os.devnull).is_char_device()


def test_what_killed_processes_left_is_removed_and_nothing_else(tmp_path: Path) -> None:
    names = [tmp_path / name for name in ("a.part.json", "a.1.partly", "part", "1.part of.zip")]
    for path in (*names, tmp_path / "model.123.part.zip", tmp_path / "study.7.part"):
        path.write_text("x")
    remove_partials(tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted(names)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "holds no JSON: "),
        (b'{"a": 1', "holds no JSON: "),
        (b"\xff\xfe", "is not UTF-8 text: "),
        (b"[1]", "holds no JSON object"),
        (None, "cannot be read: No such file or directory"),
    ],
)
def test_json_that_cannot_be_read_is_reported_in_one_line(
    tmp_path: Path, content: bytes | None, message: str
) -> None:
    path = tmp_path / "x.json"
    if content is not None:
        path.write_bytes(content)
    error = refused(lambda: read_json(path, "results"), message)
    assert error.startswith(f"results = {str(path)!r} ")


def test_text_is_written_as_utf_8(tmp_path: Path) -> None:
    write_text(tmp_path / "a.md", "± λ")
    assert (tmp_path / "a.md").read_bytes().decode("utf-8") == "± λ"


def test_a_file_of_the_zoo_is_the_one_that_its_card_describes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = "biased_oscillator_local"
    for suffix in ("zip", "json"):
        source = Path(fusion_gym.zoo.__file__).with_name(f"{name}.{suffix}")
        shutil.copyfile(source, tmp_path / source.name)
    monkeypatch.setattr(fusion_gym.zoo, "_FOLDER", tmp_path)
    card = fusion_gym.zoo.card(name)
    task = fusion_gym.make_task(card["env"], **card["options"])
    make_policy(f"zoo:{name}", task)
    content = bytearray((tmp_path / f"{name}.zip").read_bytes())
    content[-1] ^= 1
    (tmp_path / f"{name}.zip").write_bytes(content)
    refused(lambda: make_policy(f"zoo:{name}", task), f"zoo = '{name}' ", "SHA-256")
