"""All commands under one name: ``fusion-gym COMMAND``."""

import ast
import importlib
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fusion_gym.validation import ConfigurationError, choice
from fusion_gym.version import __version__

from . import missing_extra
from .output.ending import report_errors


def _modules(folder: Path) -> dict[str, Path]:
    """The commands of a folder by name."""
    return {path.stem: path for path in sorted(folder.glob("[a-z]*.py")) if path.stem != LIBRARY}


LIBRARY = "command_line"  # the module beside the commands that is none
COMMANDS = _modules(Path(__file__).parent)
MAINTENANCE = _modules(Path(__file__).parent / "maintenance")


def usage(commands: Mapping[str, Path]) -> str:
    """Return every command with the first sentence of its module."""
    program = "fusion-gym" if commands is COMMANDS else "python -m fusion_gym.agents.maintenance"
    lines = [f"usage: {program} COMMAND [OPTIONS]", ""]
    for name, path in commands.items():
        sentence = (ast.get_docstring(ast.parse(path.read_text("utf-8"))) or "").splitlines()[0]
        lines.append(f"  {name:<10} {sentence}")
    return "\n".join([*lines, "", f"{program} COMMAND --help shows the options of a command."])


def main(commands: Mapping[str, Path] = COMMANDS) -> None:
    """Run the command line of ``fusion-gym``, which needs the packages of the extra ``agents``.

    Raises:
        SystemExit: as :func:`report_errors`; an unknown command (2).
    """
    name = sys.argv[1] if sys.argv[1:] else "--help"
    with report_errors():
        if name in ("-h", "--help", "--version"):
            print(__version__ if name == "--version" else usage(commands))
            return
        command = load(name, commands)
        del sys.argv[1]
        command.main()


def load(name: str, commands: Mapping[str, Path] = COMMANDS | MAINTENANCE) -> Any:
    """Return the class of a command.

    Raises:
        SystemExit: no such command (2), or a package that it needs is not installed (1).
    """
    try:
        folder = ".maintenance" if choice("command", name, commands) in MAINTENANCE else ""
        module = importlib.import_module(f"{folder}.{name}", __package__)
        return getattr(module, name.capitalize())
    except ConfigurationError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except ModuleNotFoundError as error:
        if missing_extra(error) is None:
            raise
        sys.exit(missing_extra(error))


if __name__ == "__main__":
    main()
