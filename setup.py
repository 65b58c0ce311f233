"""Which folders are installed and under which names; all else is in pyproject.toml."""

from setuptools import find_packages, setup

inside = find_packages(include=["agents*", "configs*"])  # no top-level names of their own

setup(
    packages=[
        *find_packages(include=["fusion_gym*"]),
        *(f"fusion_gym.{name}" for name in (*inside, "results")),
    ],
    package_dir={f"fusion_gym.{name}": name for name in ("agents", "configs", "results")},
)
