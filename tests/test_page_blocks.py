"""What is taken for a block of a page, what it needs, and what its environment has."""

from __future__ import annotations

from pathlib import Path

import pytest
from packaging.requirements import Requirement
from page_blocks import blocks_of, stray_commands
from wheel_environments import Absent, closure

PAGE = """
Text with `make demo` in a line.

```python
import numpy
```

<!-- needs: agents, render -->
```sh
fusion-gym watch --policy a \\
    --save b.gif    # a film
# nothing
OMP_NUM_THREADS=1 fusion-gym --help
```

```yaml
# plant.yaml
horizon: 3
```

```python exec="true" session="one"
x = 1
from website import show  # markdown-exec: hide
```

Between.

- listed:

    ```python session="one"
    print(x)
    ```

```
make demo
```

    fusion-gym evaluate
"""


def installs(module: str) -> str | None:
    return {"numpy": "", "stable_baselines3": "agents"}.get(module)


def test_blocks_of_a_page_in_their_order() -> None:
    python, shell, yaml, session = blocks_of(Path("page.md"), PAGE)
    assert (python.place, python.text) == ("page.md:4", "import numpy\n")
    assert [words for _, words in shell.commands()] == [
        ["fusion-gym", "watch", "--policy", "a", "--save", "b.gif"],
        ["OMP_NUM_THREADS=1", "fusion-gym", "--help"],
    ]
    assert (yaml.language, yaml.file) == ("yaml", "plant.yaml")
    assert (session.text, session.line) == ("x = 1\nprint(x)\n", 21)


def test_what_a_block_needs_is_named_or_told_from_what_it_imports() -> None:
    python, shell, yaml, _ = blocks_of(Path("page.md"), PAGE)
    assert python.needs(installs) == yaml.needs(installs) == frozenset()
    assert shell.needs(installs) == {"agents", "render"}
    text = "```python\nimport stable_baselines3, foreign.part\n```\n```bash\nfusion-gym\n```\n"
    foreign, command = blocks_of(Path("page.md"), text)
    assert foreign.needs(installs) == {"agents", "foreign.part"}
    assert command.needs(installs) == {"agents"}


def test_commands_that_nothing_runs_are_found() -> None:
    assert stray_commands(Path("page.md"), PAGE) == [
        "page.md:35: make demo", "page.md:38:     fusion-gym evaluate",
    ]  # fmt: skip


def test_an_environment_has_what_the_wheel_and_its_extras_need() -> None:
    wanted = [
        Requirement("numpy>=2"),
        Requirement("pyyaml; extra == 'agents'"),
        Requirement("hypothesis; extra == 'test'"),
        Requirement("absent-from-everywhere; extra == 'more'"),
        Requirement("pandas; python_version < '3'"),
    ]
    assert closure(wanted, []).keys() == {"numpy"}
    assert closure(wanted, ["agents"]).keys() == {"numpy", "pyyaml"}
    assert {"hypothesis", "sortedcontainers"} <= closure(wanted, ["test"]).keys()
    with pytest.raises(Absent, match="absent-from-everywhere"):
        closure(wanted, ["more"])
