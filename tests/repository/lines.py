"""Count code lines: without blanks, comments and docstrings (``make lines``).

The lines of a Jinja template are those with tags.

The string below an option of an environment is the option's docstring (PEP 257)."""

import ast
import io
import itertools
import re
import subprocess
import tokenize
from collections import Counter
from pathlib import Path

NO_CODE = {
    *(tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT),
    tokenize.ENDMARKER,
}
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
NOT_COUNTED = {"integrations", "examples"}


def code_lines(source: str) -> int:
    """Return the number of lines that hold code."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in NO_CODE:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node) is not None:
            lines -= _lines_of(node.body[0])
        if isinstance(node, ast.ClassDef) and node.name.endswith("Options"):
            for field, below in itertools.pairwise(node.body):
                match field, below:
                    case ast.AnnAssign(), ast.Expr(value=ast.Constant(value=str())):
                        lines -= _lines_of(below)
    return len(lines)


def _lines_of(node: ast.stmt) -> set[int]:
    return set(range(node.lineno, (node.end_lineno or 0) + 1))


def main() -> None:
    """Print the lines of each top-level folder, of all code outside tests, and of the tests."""
    tracked = subprocess.run(["git", "ls-files", "*.py"], capture_output=True, text=True)
    counts: Counter[str] = Counter()
    for name in tracked.stdout.split():
        if Path(name).exists():
            counts[Path(name).parts[0]] += code_lines(Path(name).read_text(encoding="utf-8"))
    for path in Path("agents").rglob("*.md"):
        counts["agents"] += len(re.findall(r"^.*\{[{%#].*$", path.read_text("utf-8"), re.MULTILINE))
    for folder, count in sorted(counts.items()):
        print(f"{folder:<14}{count:>7,}")
    code = sum(counts[folder] for folder in counts.keys() - NOT_COUNTED - {"tests"})
    print(f"{'all but tests':<14}{code:>7,}")


if __name__ == "__main__":
    main()
