"""Which folders are installed and under which names, and the text of the package's page."""

import re
from pathlib import Path

from setuptools import find_packages, setup

_FILES = "https://github.com/fusion-gym/fusion-gym/blob/main/"
_PICTURES = "https://raw.githubusercontent.com/fusion-gym/fusion-gym/main/"


def described() -> str:
    """The README with absolute links, for a package index has none of the files beside it."""
    text = (Path(__file__).parent / "README.md").read_text(encoding="utf-8")
    text = re.sub(r"(!\[[^]]*\]\()(?!\w+:)", rf"\g<1>{_PICTURES}", text)
    return re.sub(r"(?<!!)(\[[^]]*\]\()(?!\w+:|#)", rf"\g<1>{_FILES}", text)


inside = find_packages(include=["agents*", "configs*"])  # no top-level names of their own

setup(
    packages=[
        *find_packages(include=["fusion_gym*"]),
        *(f"fusion_gym.{name}" for name in (*inside, "results")),
    ],
    package_dir={f"fusion_gym.{name}": name for name in ("agents", "configs", "results")},
    long_description=described(),
    long_description_content_type="text/markdown",
)
