"""The import law: a room imports itself, the rooms that sort before it, and the leaf modules; root modules may import anything."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

SOURCE = Path(__file__).resolve().parents[1] / "src" / "asbuilt"
ROOMS = ("description", "dynamics", "excitation", "experiment", "identification", "validation", "writers")
LEAVES = ("errors", "tables")
HEAVY = ("numba", "scipy", "polars", "matplotlib", "plotly", "clarabel", "trimesh", "mujoco", "pydantic", "lxml")


def imported_modules(path: Path) -> list[str]:
    """Names below `asbuilt.` that a file imports, anywhere in it."""
    names: list[str] = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names += [f"{node.module}.{alias.name}" if node.module == "asbuilt" else str(node.module) for alias in node.names]
    return [name.removeprefix("asbuilt.") for name in names if name == "asbuilt" or name.startswith("asbuilt.")]


def test_rooms_are_what_the_law_knows() -> None:
    folders = sorted(p.name for p in SOURCE.iterdir() if p.is_dir() and p.name != "__pycache__")
    assert tuple(folders) == ROOMS == tuple(sorted(ROOMS))


@pytest.mark.parametrize("room", ROOMS)
def test_room_imports_only_itself_earlier_rooms_and_leaves(room: str) -> None:
    allowed = {*LEAVES, *ROOMS[: ROOMS.index(room) + 1]}
    for path in (SOURCE / room).rglob("*.py"):
        for name in imported_modules(path):
            assert name.split(".")[0] in allowed, f"{path.relative_to(SOURCE)} imports asbuilt.{name}"


@pytest.mark.parametrize("leaf", LEAVES)
def test_leaf_imports_no_room(leaf: str) -> None:
    assert set(imported_modules(SOURCE / f"{leaf}.py")) <= {"errors"}


@pytest.mark.parametrize("statement", ["import asbuilt", "import asbuilt.cli; asbuilt.cli.main(['--help'])"])
def test_start_up_loads_nothing_heavy(statement: str) -> None:
    code = f"import sys\ntry:\n    {statement}\nexcept SystemExit:\n    pass\nprint(*[m for m in {HEAVY!r} if m in sys.modules], file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == ""
