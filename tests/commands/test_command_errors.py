"""What a command cannot do it says in one line, before it does anything; and how it ends."""

import collections
import errno
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from command_runs import call, flaw, refusal
from hostile_commands import BASES, EVERY, Try, line, options, tries
from hostile_folder import contents, scratch
from paths import ROOT

from fusion_gym.commands.command_line import Command
from fusion_gym.output.ending import report_errors
from fusion_gym.policies.registry import parse_value
from fusion_gym.validation import ConfigurationError

PER_OPTION = 2  # of the tries that run each time


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of the tries, which others may enter (they may not enter pytest's)."""
    with tempfile.TemporaryDirectory() as folder:
        scratch(Path(folder))
        monkeypatch.chdir(folder)
        yield Path(folder)


def selected() -> list[Try]:
    """A few tries of each option, other values for each."""
    result = collections.defaultdict(list)
    for tried in tries():
        result[tried.command, tried.option].append(tried)
    return [
        values[(place * PER_OPTION + turn) % len(values)]
        for place, values in enumerate(result.values())
        for turn in range(min(PER_OPTION, len(values)))
    ]


def test_every_option_of_every_command_is_tried() -> None:
    assert BASES.keys() == set(EVERY)
    tried = {(item.command, item.option) for item in tries()}
    for name in BASES:
        for option, kind in options(name).items():
            assert (name, option) in tried or kind is bool, option
    assert len(list(tries())) > 500


@pytest.mark.slow
def test_what_is_not_allowed_is_reported_in_one_line(here: Path) -> None:
    assert {str(item): message for item in selected() if (message := flaw(item, here))} == {}


@pytest.mark.slow
def test_all_that_is_not_allowed_is_reported_in_one_line(here: Path) -> None:
    assert {str(item): message for item in tries() if (message := flaw(item, here))} == {}


def test_no_output_replaces_an_input(here: Path) -> None:
    config = "id: fusion_gym/RemoteEstimation-v1\n"
    for name, message in (
        ("config.yaml", "it must be a file that ends with .json"),
        ("config.json", "it must be another file than config"),
    ):
        Path(name).write_text(config)
        error = refusal("evaluate", ["--config", name, "--policies", "always", "--json", name])
        assert error == f"error: json = {name!r} is not allowed: {message}"
        assert Path(name).read_text() == config
    assert "ends with .onnx" in refusal("export", ["zoo:nobody", "--onnx", "config.yaml"])


def test_a_full_disk_in_a_training_is_reported(here: Path) -> None:
    """The config fits, the first model does not."""
    error = refusal("train", line("train", BASES["train"]), limit=2_000)
    assert f"made/best_model.zip': {os.strerror(errno.EFBIG)}" in error
    assert not [name for name in contents(here) if ".part" in name]
    assert call("train", [*line("train", BASES["train"]), "--resume"]).status == 0


def test_a_full_disk_is_reported_and_leaves_nothing_half_written(here: Path) -> None:
    """Files of no byte, and of a few: once in the trial and once in the work."""
    words = line("evaluate", BASES["evaluate"])
    before = contents(here)
    for limit, part in ((0, "is not allowed: it must be a f"), (16, os.strerror(errno.EFBIG))):
        last = refusal("evaluate", words, limit=limit)
        assert part in last
        assert "made" in last or "results" in last
        assert {name for name, content in contents(here).items() if content is not None} == {
            name for name, value in before.items() if value is not None
        }
    assert call("evaluate", words).status == 0


def test_an_error_of_the_programs_own_keeps_its_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    @dataclass(frozen=True)
    class Wrong(Command):
        """A command with a bug."""

        kind: str

        def run(self) -> None:
            """Fail."""
            raise {"value": ValueError, "key": KeyError, "type": TypeError}[self.kind](self.kind)

    for kind, error in (("value", ValueError), ("key", KeyError), ("type", TypeError)):
        monkeypatch.setattr(sys, "argv", ["wrong", "--kind", kind])
        with pytest.raises(error):
            Wrong.main()


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (ConfigurationError("two\nlines"), "error: two lines"),
        (OSError(errno.EROFS, "Read-only file system", "/a"), "error: '/a': Read-only file system"),
        (OSError(errno.ENOSPC, "No space left on device"), "error: No space left on device"),
        (MemoryError("Unable to allocate 1 TiB"), "error: there is not enough memory. Unable"),
        (KeyboardInterrupt(), 130),
        (BrokenPipeError(errno.EPIPE, "Broken pipe"), 141),
    ],
    ids=lambda value: type(value).__name__,
)
def test_what_the_machine_refuses_is_reported(error: BaseException, status: int | str) -> None:
    with pytest.raises(SystemExit) as caught, report_errors():
        raise error
    assert str(caught.value.code).startswith(str(status))


def run(command: str) -> subprocess.CompletedProcess[str]:
    """A line of the shell in the repository."""
    env = os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    env.pop("PYTHONUNBUFFERED", None)
    line = ["bash", "-c", command]
    return subprocess.run(line, cwd=ROOT, env=env, capture_output=True, text=True)


def test_output_that_nobody_reads_or_takes() -> None:
    gone = run("python -m fusion_gym.commands | true; echo ${PIPESTATUS[0]}")
    assert (gone.stdout, gone.stderr) == ("141\n", "")
    full = run("python -m fusion_gym.commands > /dev/full; echo $?")
    assert (full.stdout, full.stderr) == ("1\n", "error: No space left on device\n")


@pytest.mark.parametrize("text", ["{[]: 1}", "(" * 5000, "9" * 5000 + "x", "\0"])
def test_what_is_no_literal_stays_text(text: str) -> None:
    assert parse_value(text) == text


@pytest.mark.parametrize("option", ["--error-code", "--error_code", "--channels"])
def test_an_option_without_a_value_is_refused(option: str, here: Path) -> None:
    message = refusal("fit", ["tanks", "--output", "plant.yaml", option])
    assert message.startswith(f"error: {option[2:].replace('-', '_')} = () is not allowed")
