"""Where long commands say they are: bars, lines, silence, and the command line that goes on."""

import dataclasses
import itertools
import json
import shlex
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from command_runs import call
from hostile_commands import BASES, EVERY, line, load

from fusion_gym.commands import command_line, evaluate
from fusion_gym.commands.command_line import Long
from fusion_gym.output import progress
from fusion_gym.output.progress import progress_bar

EVALUATE = [
    *("--env", "fusion_gym/TobitOscillator-v1", "--set", "horizon=20"),
    *("--policies", "always", "never", "--episodes", "3"),
]
LONG = [name for name in EVERY if issubclass(load(name), Long)]


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Seconds that pass when they are told to."""
    clock = SimpleNamespace(now=1000.0)
    monkeypatch.setattr(progress.time, "monotonic", lambda: clock.now)
    return clock


def test_what_remains_is_reported_by_the_mean_speed_and_waits(clock: Any) -> None:
    def left() -> str:
        return bar.line().rpartition(", ")[2]

    with progress_bar(1000, "training", initial=200, quiet=True) as bar:
        assert left() == "? left"
        clock.now += 10.0
        bar.update(200)  # 20 steps per second, and 600 are left
        assert left() == "0:00:30 left"
        clock.now += 112.0
        assert left() == "0:00:30 left"
        bar.reach(300)
        assert bar.task.completed == 400
        bar.reach(5000)
        assert bar.line() == "training: 1,000/1,000 steps, 0:02:02"
    with progress_bar(0, "nothing", quiet=True) as bar:
        bar.update()
        assert bar.line() == "nothing: 0/0 steps, 0:00:00"


def test_where_nobody_watches_a_line_is_printed_now_and_then(
    clock: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    received = []
    with progress_bar(10_000, "evaluating") as bar:
        bar.say("always")
        for _ in range(10_000):
            clock.now += 1.0
            bar.update()
            output = capsys.readouterr().err
            if output:
                received.append((clock.now - 1000.0, output))
    assert received[0] == (20.0, "evaluating: 20/10,000 steps, 0:00:20, 2:46:20 left, always\n")
    gaps = [later - earlier for (earlier, _), (later, _) in itertools.pairwise(received)]
    assert all(20.0 <= gap <= 600.0 for gap in gaps)
    assert gaps == sorted(gaps)
    assert len(received) < 70
    assert capsys.readouterr() == ("", "evaluating: 10,000/10,000 steps, 2:46:40, always\n")


def test_every_long_command_can_be_quiet() -> None:
    assert set(EVERY) - set(LONG) <= {"export", "papers", "list", "info", "fit"}


@pytest.mark.parametrize("name", LONG)
def test_the_command_that_goes_on_is_one(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is read as the command that was interrupted, to be resumed where it can be."""
    words = [*line(name, BASES[name]), "--quiet"]
    kind = load(name)
    monkeypatch.setattr(sys, "argv", [f"agents/{name}.py", *words])
    command = command_line.read_command(kind)
    program = command_line.program_of(kind)
    assert command.again().startswith(f"{program} ")
    again = shlex.split(command.again().removeprefix(program))
    resumes = "resume" in {field.name for field in dataclasses.fields(kind)}
    assert again == [*words, *(["--resume"] if resumes else [])]
    monkeypatch.setattr(sys, "argv", [f"agents/{name}.py", *again])
    read = command_line.read_command(kind)
    assert read == (dataclasses.replace(command, resume=True) if resumes else command)
    assert read.again() == command.again()


def test_an_interrupted_evaluation_says_how_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, ran = tmp_path / "evaluation.json", []

    def run_several(task: Any, policies: Any, *value: Any) -> Any:
        ran.extend(policies)
        if len(ran) == 2:
            raise KeyboardInterrupt
        return whole(task, policies, *value)

    whole = evaluate.run_several
    monkeypatch.setattr(evaluate, "run_several", run_several)
    monkeypatch.setattr(evaluate, "BATCH", 1)
    ended = call("evaluate", [*EVALUATE, "--json", str(file)])
    assert (ended.status, ended.trace) == (130, "")
    assert ended.err.splitlines()[0] == f"writing the results of each policy into {file}"
    message, again = ended.err.splitlines()[-1].split(": ", 1)
    assert message == "interrupted; continue with"
    assert list(json.loads(file.read_text())["policies"]) == ["always"]
    program, name, *words = shlex.split(again)
    assert (program, name) == ("fusion-gym", "evaluate")
    assert call(name, words).status == 0
    assert len(ran) == 3  # always once
    assert list(json.loads(file.read_text())["policies"]) == ["always", "never"]


def test_an_interrupt_that_loses_all_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def run_several(*_: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(evaluate, "run_several", run_several)
    ended = call("evaluate", EVALUATE)
    assert (ended.status, ended.err.splitlines()[-1]) == (
        130, "interrupted: nothing is saved (--json FILE saves finished policies)",
    )  # fmt: skip
    absent = call("train", ["--config", "tobit_oscillator_ppo", "--output", "absent", "--resume"])
    assert absent.err == "error: output = 'absent' holds no training: nothing to resume\n"
