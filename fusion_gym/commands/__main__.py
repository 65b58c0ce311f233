"""All commands under one name: ``fusion-gym COMMAND``."""

import ast
import importlib
import sys
import textwrap
from pathlib import Path
from typing import Any

from fusion_gym.output.ending import report_errors
from fusion_gym.validation import ConfigurationError, choice
from fusion_gym.version import __version__

COMMANDS = (
    "calibrate", "compare", "demo", "evaluate", "export", "field", "fit", "info", "list", "search",
    "train", "watch",
)  # fmt: skip


def usage() -> str:
    """Return every command with the first line of its module's docstring."""
    lines = ["usage: fusion-gym COMMAND [OPTIONS]", ""]
    for name in COMMANDS:
        text = Path(__file__).with_name(f"{name}.py").read_text("utf-8")
        meaning = (ast.get_docstring(ast.parse(text)) or "").splitlines()[0]
        lines.append(textwrap.fill(f"  {name:<10} {meaning}", 80, subsequent_indent=" " * 13))
    return "\n".join([*lines, "", "fusion-gym COMMAND --help shows the options of a command."])


def main() -> None:
    """Run the command line of ``fusion-gym``."""
    name = sys.argv[1] if sys.argv[1:] else "--help"
    with report_errors():
        if name in ("-h", "--help", "--version"):
            print(__version__ if name == "--version" else usage())
            return
        command = load(name)
        del sys.argv[1]
        command.main()


def load(name: str) -> Any:
    """Return the class of a command."""
    try:
        module = importlib.import_module(f"fusion_gym.commands.{choice('command', name, COMMANDS)}")
        return getattr(module, name.capitalize())
    except ConfigurationError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except ModuleNotFoundError as error:
        missing = error.name or str(error)
        if missing.partition(".")[0] == "fusion_gym":
            raise
        sys.exit(f"error: {missing} is missing: install fusion-gym with its extra 'agents'")


if __name__ == "__main__":
    main()
