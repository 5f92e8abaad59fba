"""The tools of the open benchmark: one adapter each, in an environment of its own."""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from task import HERE

ENVIRONMENTS = HERE / ".envs"


@dataclass(frozen=True)
class Tool:
    """An adapter, and what its environment needs: packages, and a version of Python if not this."""

    name: str
    path: Path
    title: str
    address: str
    package: str
    requires: tuple[str, ...]
    cannot: dict[str, str]
    interpreter: str = ""

    @property
    def python(self) -> Path:
        """Interpreter of its environment."""
        if not self.requires:
            return Path(sys.executable)
        return ENVIRONMENTS / self.name / "bin" / "python"

    @property
    def lines(self) -> int:
        """Lines of code of the adapter: what a user of the tool writes, comments aside."""
        tree = ast.parse(self.path.read_text())
        return len({node.lineno for node in ast.walk(tree) if isinstance(node, ast.stmt)})

    def install(self) -> None:
        """Make its environment."""
        folder = ENVIRONMENTS / self.name
        if not (folder / "bin" / "python").exists():
            own = interpreter(self.interpreter) if self.interpreter else sys.executable
            if own is None:
                print(f"{self.name} needs python{self.interpreter}, which is not here")
                return
            subprocess.run([own, "-m", "venv", str(folder)], check=True)
        subprocess.run([self.python, "-m", "pip", "install", "-q", *self.requires], check=True)


def interpreter(version: str) -> str | None:
    """Return the first Python of a version on the path that runs: a shim may know none."""
    name = f"python{version}"
    for folder in os.get_exec_path():
        found = shutil.which(name, path=folder)
        if (
            found
            and not subprocess.run([found, "-c", ""], capture_output=True, check=False).returncode
        ):
            return found
    return None


@cache
def tools() -> dict[str, Tool]:
    """Return the tools by name, asbuilt first."""
    found = [_tool(path) for path in sorted((HERE / "adapters").glob("*.py"))]
    return {each.name: each for each in sorted(found, key=lambda each: each.name != "asbuilt")}


def _tool(path: Path) -> Tool:
    """Read the constants of an adapter without importing it."""
    values: dict[str, Any] = {"CANNOT": {}}
    for node in ast.parse(path.read_text()).body:
        target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
        if isinstance(target, ast.Name) and target.id.isupper():
            try:
                values[target.id] = ast.literal_eval(node.value)  # type: ignore[union-attr]
            except (ValueError, TypeError):
                continue
    return Tool(
        path.stem.replace("_", "-"),
        path,
        values["TITLE"],
        values["ADDRESS"],
        values["PACKAGE"],
        tuple(values["REQUIRES"]),
        values["CANNOT"],
        values.get("PYTHON", ""),
    )
