"""Test the core alone: in a copy of the tree without any app, with the arguments of pytest.

    python tests/without_apps.py -m "not study" tests/cli

Compiled code is copied too, so that nothing is compiled again.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1]
BESIDE = (
    *("tests", "docs", "examples", "benchmarks", "pyproject.toml", "mkdocs.yml", "README.md"),
    *("CONTRIBUTING.md", "CHANGELOG.md", "CITATION.cff", "Makefile"),
)
"""What tests read besides the package."""


def list_apps() -> list[str]:
    """Return the names of the apps."""
    folder = PROJECT / "src" / "asbuilt" / "apps"
    return sorted(path.parent.name for path in folder.glob("*/__init__.py"))


def copy_source(target: Path, without: Iterable[str]) -> dict[str, str]:
    """Copy the package without some apps; return an environment in which Python finds it."""
    left_out = {PROJECT / "src" / "asbuilt" / "apps" / app for app in without}

    def ignore(folder: str, names: list[str]) -> list[str]:
        return [name for name in names if Path(folder, name) in left_out]

    shutil.copytree(PROJECT / "src", target / "src", ignore=ignore)
    return os.environ | {"PYTHONPATH": str(target / "src")}


def copy_core(target: Path) -> dict[str, str]:
    """Copy the tree without apps and their tests; return an environment that has it."""
    environment = copy_source(target, list_apps())
    shutil.rmtree(target / "src" / "asbuilt" / "apps")
    for name in BESIDE:
        source = PROJECT / name
        if source.is_dir():
            hidden = shutil.ignore_patterns("__pycache__", "built", *(["apps"] * (name == "tests")))
            shutil.copytree(source, target / name, ignore=hidden)
        elif source.is_file():
            shutil.copy(source, target / name)
    return environment


def main(arguments: list[str]) -> int:
    """Run pytest on a copy; return its exit status."""
    with tempfile.TemporaryDirectory(prefix="asbuilt-core-") as folder:
        target = Path(folder).resolve() / "asbuilt"
        environment = copy_core(target)
        command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *arguments]
        return subprocess.run(command, cwd=target, env=environment, check=False).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
