"""The examples in the help texts of the commands run."""

import re
import sys
from pathlib import Path

import pytest
from command_runs import succeed
from hostile_commands import load
from page_blocks import Block
from training_configs import small_config
from wheel_blocks import LISTED

from fusion_gym.commands.__main__ import COMMANDS
from fusion_gym.commands.command_line import check_options, read_command

LINEAR = "fusion_gym/LinearFusion-v2"
# The wheel's tests shorten the same commands of the pages, which show demo with another option.
SHORTER = {item.begins: item.instead for item in LISTED if item.instead}
SHORTER["fusion-gym demo "] = "--episodes 4 --timesteps 1024"
# Its tuning takes minutes and no option shortens it: its options are read and checked.
READ = {"field"}


def examples(command: str) -> list[tuple[str, list[str]]]:
    """The lines, and the words of each example in the help text of a command."""
    text = sys.modules[load(command).__module__].__doc__ or ""
    indented = re.findall(r"(?m)^    .*$", text)
    lines = Block(Path(command), 0, "shell", "\n".join(indented)).commands()
    return [(line, words[1:]) for line, words in lines if words[0] == "fusion-gym"]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the files that examples name: a plant, and a training at drawn prices."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "plant.yaml").write_text("transition: [[1.0, 0.1], [0.0, 0.9]]\n")
    front = {"cost_weight": "random", "price_range": [0.05, 2.0], "horizon": 20}
    environment = {"id": LINEAR, "options": front}
    config = small_config(tmp_path, environment=environment, output="runs/front")
    succeed("train", ["--config", str(config)])
    return tmp_path


@pytest.mark.slow
@pytest.mark.usefixtures("here")
@pytest.mark.parametrize("command", COMMANDS)
def test_the_examples_of_a_help_text_run(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every help text has an example; those of ``READ`` are read and checked."""
    every = examples(command)
    assert every
    for line, (name, *words) in every:
        if name in READ:
            monkeypatch.setattr(sys, "argv", ["fusion-gym", *words])
            check_options(read_command(load(name)))
        else:
            more = [text for begins, text in SHORTER.items() if line.strip().startswith(begins)]
            succeed(name, [*words, *" ".join(more).split()])
