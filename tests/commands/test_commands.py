"""How commands are called: options, help, errors in one line, configs by their name."""

import dataclasses
import os
import re
import shlex
import subprocess
import sys
import typing
from pathlib import Path

import pytest
import tyro
from command_runs import call
from hostile_commands import EVERY, load
from paths import ROOT
from refusals import refused
from rich.console import Console

import fusion_gym
from agents.benchmark.command import Benchmark
from fusion_gym.commands import __main__ as everything
from fusion_gym.commands import command_line, info
from fusion_gym.commands.list import catalogue
from fusion_gym.commands.train import Train
from fusion_gym.envs.registration import ENVIRONMENTS, options_of
from fusion_gym.output.plain_text import plain_text
from fusion_gym.policies.registry import policy_names
from fusion_gym.policies.saved import ALGORITHMS
from fusion_gym.training.config import TABLE, Experiment, checked, config_path, load_checked

PROGRAMS = {command_line.program_of(kind): kind for kind in map(load, EVERY)}


@pytest.mark.parametrize("name", EVERY)
def test_help_shows_every_option(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["program", "--help"])
    with pytest.raises(SystemExit) as caught:
        load(name).main()
    assert caught.value.code == 0
    printed = capsys.readouterr().out
    assert not [line for line in printed.splitlines() if len(line) > 80 and " " in line.strip()]
    text = " ".join(printed.split())
    assert "(default: )" not in text
    assert "(default: None)" not in text
    assert "tyro" not in text
    program = command_line.program_of(load(name))
    assert text.startswith(f"usage: {program} ")
    assert f" {program} " in text[10:], "no example"
    assert "{None}" not in text
    kind = load(name)
    options = {field.name: field for field in dataclasses.fields(kind)}
    for own, option in (("options", "set"), ("class_name", "class")):
        if own in options:
            options[option] = options.pop(own)
    listed = text.partition("--help")[2]  # the usage above it may name options as well
    hints = typing.get_type_hints(kind, include_extras=True)
    for option in options:
        marks = getattr(hints.get(option), "__metadata__", ())
        if tyro.conf.Positional[int].__metadata__[0] not in marks:
            assert f"--{option.replace('_', '-')} " in listed, option
    examples = re.findall(r"(?m)^    \S(?:.*\\\n)*.*", printed.partition("\n -----")[0])
    assert examples
    for example in (example.replace("\\\n", "") for example in examples):
        assert "\\" not in example
        owner = max(filter(example.lstrip().startswith, PROGRAMS), key=len)
        words = shlex.split(example)[len(owner.split()) :]
        monkeypatch.setattr(sys, "argv", ["program", *words])
        command_line.read_command(PROGRAMS[owner])


def test_a_script_of_completions_keeps_its_lines() -> None:
    words = [sys.executable, "-m", "fusion_gym.commands", "list", "--tyro-print-completion", "bash"]
    script = subprocess.run(words, capture_output=True, text=True, check=True, cwd=ROOT).stdout
    assert "complete" in script
    assert subprocess.run(["bash", "-n"], input=script, text=True, check=False).returncode == 0
    assert max(map(len, script.splitlines())) > 80


def test_info_takes_every_spelling_of_the_pages() -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    text = "".join(page.read_text() for page in pages)
    rules = "|".join(policy_names("rule"))
    spellings = re.findall(
        rf"`((?:fusion_gym/)?\w+-v\d|zoo:[a-z]\w+|configs/\w+\.yaml|(?:{rules}):[^`\n]*)`", text
    )
    assert len(set(spellings)) > 30
    names = {info.spelling(name) for named in catalogue().values() for name in named}
    assert not {each for each in spellings if info.spelling(each) not in names}
    assert "fusion_gym/LinearFusion-v2" in call("info", ["linear_fusion"]).out
    assert "whittle (" in call("info", ["whittle:price=2"]).out


def test_lists_and_flags_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    words = "--settings a b --quick --class local --policy always --work deep/er"
    monkeypatch.setattr(sys, "argv", ["program", *words.split()])
    command = command_line.read_command(Benchmark)
    assert (command.settings, command.class_name, command.policy) == (("a", "b"), "local", "always")
    assert (command.quick, command.work) == (True, Path("deep/er"))
    assert (command.results, command.workers) == (None, 2)


@pytest.mark.slow
def test_all_commands_under_one_name() -> None:
    def run(*words: str) -> subprocess.CompletedProcess[str]:
        line = [sys.executable, "-m", "fusion_gym.commands", *words]
        return subprocess.run(line, cwd=ROOT, capture_output=True, text=True)

    assert run("--version").stdout == f"{fusion_gym.__version__}\n"
    listed = run().stdout
    assert all(f"\n  {name} " in listed for name in everything.COMMANDS)
    unknown = run("trian")
    assert unknown.returncode == 2
    assert "did you mean 'train'?" in unknown.stderr
    assert len(unknown.stderr.splitlines()) == 1
    absent = run("info", "absent")
    assert absent.returncode == 1
    assert absent.stderr.startswith("error: name = 'absent'")


def test_list_shows_every_kind_and_every_entry() -> None:
    entries = catalogue()
    overview = call("list", []).out
    assert len(overview.splitlines()) <= 60
    assert all(name in overview for name in (*entries, *entries["environments"], "whittle"))
    for kind, named in entries.items():
        assert named, kind
        listed = call("list", [kind]).out.split()
        assert not [name for name in named if name not in listed], kind
    assert call("list", ["zoo"]).out.split()[:2] == ["zoo", "biased_oscillator_centre"]
    assert "'agent': known are algorithms" in call("list", ["agent"]).err


# What no page may show: ticks, formulas and commands of LaTeX, roles of Sphinx, links, headings,
# tables of Markdown, names that are cut off.
MARKUP = re.compile(r"`|\$|\\[a-zA-Z]|:\w+:`|\]\(|\*\*|^ *#+ |\|--|\w…", re.MULTILINE)


def test_info_shows_every_entry_as_plain_text() -> None:
    terminal = Console(width=100)
    for kind, named in catalogue().items():
        for name, entry in named.items():
            assert len(entry.meaning) > 5, name
            text = plain_text(f"# {name} ({kind})\n\n{entry.page()}", terminal)
            assert len(text) > 50, name
            shown = text if kind != "configs" else re.sub(r"(?m)^ *#.*", "", text)
            assert not MARKUP.findall(shown), (kind, name)
    assert "whittle:price=5" in call("info", ["whittle"]).out
    page = call("info", ["LinearFusion"]).out
    assert "\nObservation space\n" in page
    assert "variance_reduction" in page
    assert call("info", ["whitle"]).err.endswith("fusion-gym list; did you mean 'whittle'?\n")


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_a_page_speaks_of_the_defaults_of_its_environment(env_id: str) -> None:
    page = catalogue()["environments"][env_id].page()
    options = options_of(env_id)()
    assert ("sensors share limited tokens in turns" in page) == (options.sharing == "turns")
    assert ("0 is no request, m requests" in page) == (options.access == "single")


FORMULAS = {
    r"\frac{a+b}{2}\,\theta_i^{2}": "(a+b)/2 θᵢ²",
    r"P^{+}=P-K S K^{\mathsf T}": "P⁺ = P-K S Kᵀ",
    r"\hat x_{k+1}\iff\det P_{s,t}>0": "x̂ₖ₊₁ ⇔ det P_(s,t) > 0",
    r"\sum_{m=1}^{h}\sqrt{x}": "∑ₘ₌₁ʰ√(x)",
}


@pytest.mark.parametrize("formula", FORMULAS)
def test_a_formula_is_a_line_of_text(formula: str) -> None:
    page = f"before\n\n$$\n{formula}\n$$\n\nafter"
    assert FORMULAS[formula] in plain_text(page, Console(width=100))


def test_a_training_needs_no_config(monkeypatch: pytest.MonkeyPatch) -> None:
    words = "train --env fusion_gym/LinearFusion-v2 --set horizon=9 --timesteps 64 --seed 3"
    monkeypatch.setattr(sys, "argv", words.split())
    experiment = command_line.read_command(Train).experiment()
    assert experiment.environment.options == {"horizon": 9}
    assert (experiment.algorithm.name, experiment.output) == ("ppo", "runs/linearfusion_v2_ppo")
    assert (experiment.training.timesteps, experiment.training.seed) == (64, 3)
    for more in ([], ["--env", "fusion_gym/LinearFusion-v2", "--config", "tobit_oscillator_ppo"]):
        assert "give one of them" in call("train", more).err
    given = ["--config", "tobit_oscillator_ppo", "--algorithm", "dqn"]
    assert "the config names the algorithm" in call("train", given).err


def test_configs_go_by_path_or_by_shipped_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = ROOT / "configs" / "tobit_oscillator_ppo.yaml"
    monkeypatch.chdir(tmp_path)
    assert load_checked(Experiment, "tobit_oscillator_ppo") == load_checked(Experiment, path)
    Path("many_sensors").mkdir()
    shipped = (ROOT / "configs" / "many_sensors.yaml").read_text()
    assert config_path("many_sensors").read_text() == shipped
    Path("own").write_text("a: 1")
    assert config_path("own") == Path("own")
    refused(lambda: config_path("tobit_oscilator_ppo"), "did you mean 'tobit_oscillator_ppo'")


def test_every_algorithm_can_be_loaded_by_its_name() -> None:
    for name, row in TABLE.items():
        # What is privileged in training saves models of the algorithm that it changes.
        kind = ALGORITHMS[re.sub("^(counterfactual|branching)_", "", name)]
        assert issubclass(row.model, kind)
        assert row.privileged == (row.model is not kind)
        plain = {
            "environment": {"id": "fusion_gym/TobitOscillator-v1"},
            "algorithm": {"name": name},
            "training": {"timesteps": 1},
            "output": "unused",
        }
        experiment = checked(Experiment, plain, "config 'test'")
        assert type(experiment.algorithm) is row.config
        assert checked(Experiment, experiment.model_dump(), "config 'test'") == experiment


def test_help_list_and_info_load_no_heavy_package(tmp_path: Path) -> None:
    """Help takes half a second of processor time, the list a second and a page 1.5."""
    lines = """
import sys
from fusion_gym.commands import __main__ as commands

def run(*words):
    sys.argv = ["fusion-gym", *words]
    try:
        commands.main()
    except SystemExit as end:
        assert not end.code, words

heavy = {"jax", "joblib", "llvmlite", "matplotlib", "pandas", "stable_baselines3", "statsmodels"}
heavy |= {"scipy.stats", "torch"}
for name in commands.COMMANDS:
    run(name, "--help")
    own = {"pydantic", "pylatexenc", "rich.markdown", "scipy.linalg", "scipy.special", "yaml"}
    assert not (heavy | own) & sys.modules.keys(), name
for words in (["list"], ["info", "fusion_gym/LinearFusion-v2"]):
    run(*words)
    assert not heavy & sys.modules.keys(), words
"""
    home = os.environ | {"HOME": str(tmp_path)}
    for part in ("import fusion_gym.commands.list as own; own.catalogue()", lines):
        subprocess.run([sys.executable, "-c", part], env=home, check=True, stdout=subprocess.PIPE)
