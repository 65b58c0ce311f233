"""How commands are called: options, help, errors in one line, configs by their name."""

from __future__ import annotations

import dataclasses
import importlib
import subprocess
import sys
import typing
from pathlib import Path

import pytest
import tyro
from small_results import small_results

from fusion_gym.agents import __main__ as everything
from fusion_gym.agents import command_line, report
from fusion_gym.agents.benchmark import Benchmark
from fusion_gym.agents.suite.found import read_results
from fusion_gym.agents.training.algorithms import TABLE
from fusion_gym.agents.training.checked import config_path, load, parse
from fusion_gym.agents.training.config import Experiment
from fusion_gym.policies.model import ALGORITHMS
from fusion_gym.validation import ConfigurationError

ROOT = Path(__file__).parent.parent


@pytest.mark.parametrize("name", everything.COMMANDS)
def test_help_shows_every_option_with_a_sentence_and_its_default(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    module = importlib.import_module(f"fusion_gym.agents.{name}")
    monkeypatch.setattr(sys, "argv", ["program", "--help"])
    with pytest.raises(SystemExit) as caught:
        module.main()
    assert caught.value.code == 0
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert shown.startswith(f"usage: fusion-gym {name} ")
    kind = getattr(module, name.capitalize())
    options = {field.name: field for field in dataclasses.fields(kind)}
    for own, option in (("options", "set"), ("of", "class")):
        if own in options:
            options[option] = options.pop(own)
    listed = shown.partition("--help")[2]  # the usage above it may name options as well
    hints = typing.get_type_hints(kind, include_extras=True)
    for option, field in options.items():
        if tyro.conf.Positional[int].__metadata__[0] in getattr(
            hints[field.name], "__metadata__", ()
        ):
            continue  # stands in the usage
        entry = listed.split(f"--{option.replace('_', '-')} ")[1].split(" --")[0]
        assert len(entry.split()) > 3, option
        repeatable = "tuple" in str(typing.get_type_hints(kind, include_extras=True)[field.name])
        told = "(required)" if field.default is dataclasses.MISSING else "(default: "
        assert told in entry or (repeatable and "(repeatable)" in entry), option


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "--config"),
        (["--config"], "--config"),
        (["--config", "x", "--stepstime", "3"], "--stepstime"),
        (["--config", "x", "--timesteps", "many"], "--timesteps: "),
        (["--config", "x", "stray"], "stray"),
        (["--config", "x", "--no-resume"], "--no-resume"),
    ],
)
def test_options_that_are_not_understood_are_told_in_one_line(
    arguments: list[str],
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from agents import train

    monkeypatch.setattr(sys, "argv", ["program", *arguments])
    with pytest.raises(SystemExit) as caught:
        train.main()
    assert caught.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ")
    assert message in said
    assert len(said.splitlines()) == 1


def test_lists_flags_and_negative_numbers_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    words = "--envs a b --seeds -3 --quick --classes local_none --work deep/er --resume"
    monkeypatch.setattr(sys, "argv", ["program", *words.split()])
    given = command_line.read(Benchmark)
    assert (given.envs, given.classes, given.seeds) == (("a", "b"), ("local_none",), -3)
    assert (given.quick, given.resume, given.work) == (True, True, Path("deep/er"))
    assert (given.config, given.results, given.workers) == ("benchmark", None, 2)


def test_all_commands_under_one_name() -> None:
    def run(*words: str) -> subprocess.CompletedProcess[str]:
        line = [sys.executable, "-m", "fusion_gym.agents", *words]
        return subprocess.run(line, cwd=ROOT, capture_output=True, text=True)

    listed = run().stdout
    assert all(f"\n  {name} " in listed for name in everything.COMMANDS)
    unknown = run("trian")
    assert unknown.returncode == 2
    assert "did you mean 'train'?" in unknown.stderr
    assert len(unknown.stderr.splitlines()) == 1
    absent = run("report", "--results", "absent")
    assert absent.returncode == 1
    assert absent.stderr.startswith("error: results = 'absent'")


def test_a_missing_extra_is_told_in_one_line() -> None:
    code = (
        "import sys; sys.modules['tyro'] = None; sys.argv = ['fusion-gym', 'report']; "
        "from fusion_gym.agents.__main__ import main; main()"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr == "error: tyro is missing: pip install 'fusion-gym[agents]'\n"


def test_what_is_to_be_typed_next_is_said_as_the_user_types(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "argv", ["program", "--envs", "a b", "--resume"])
    assert Benchmark().interrupted().endswith("fusion-gym benchmark --envs 'a b' --resume")


def test_configs_go_by_path_or_by_shipped_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = ROOT / "configs" / "tobit_oscillator_ppo.yaml"
    monkeypatch.chdir(tmp_path)
    assert load(Experiment, "tobit_oscillator_ppo") == load(Experiment, path)
    Path("benchmark").mkdir()
    assert config_path("benchmark").samefile(ROOT / "configs" / "benchmark.yaml")
    Path("own").write_text("a: 1")
    assert config_path("own") == Path("own")
    with pytest.raises(ConfigurationError, match="did you mean 'tobit_oscillator_ppo'"):
        config_path("tobit_oscilator_ppo")


def test_every_algorithm_can_be_loaded_by_its_name() -> None:
    for name, row in TABLE.items():
        # What is privileged in training saves models of the algorithm that it changes.
        kind = ALGORITHMS[name.removeprefix("counterfactual_")]
        assert issubclass(row.model, kind)
        assert row.privileged == (row.model is not kind)
        plain = {
            "environment": {"id": "fusion_gym/TobitOscillator-v0"},
            "algorithm": {"name": name},
            "training": {"timesteps": 1},
            "output": "unused",
        }
        experiment = parse(Experiment, plain, "test")
        assert type(experiment.algorithm) is row.config
        assert parse(Experiment, experiment.model_dump(), "test") == experiment


def test_a_report_names_the_commands_that_made_it(tmp_path: Path) -> None:
    found = read_results(small_results(tmp_path).parent)
    assert "Made by `a b` and `c d` from" in report.text_of(found, "a b", "c d")
