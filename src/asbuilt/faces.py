"""The public face of a package, from its stub, without apps that are not installed."""

from __future__ import annotations

import ast
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lazy_loader

Face = tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]
"""`__getattr__`, `__dir__` and `__all__` of a package."""


def attach_face(package: str, file: str) -> Face:
    """Return the face of a package whose names are imported when they are first used.

    The stub next to `file` names them, as `lazy_loader.attach_stub` reads it; lines of an app whose
    folder is missing are passed over.
    """
    stub = Path(file).with_suffix(".pyi")
    names: dict[str, list[str]] = {}
    for node in ast.parse(stub.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom) and _is_installed(stub.parent, str(node.module)):
            names.setdefault(str(node.module), []).extend(alias.name for alias in node.names)
    face: Face = lazy_loader.attach(package, submod_attrs=names)
    return face


def _is_installed(folder: Path, module: str) -> bool:
    """Return whether a module belongs to no app, or to one that is there."""
    first, *below = module.split(".")
    return first != "apps" or (folder / first / below[0]).is_dir()
