"""Robots from xacro, expanded to URDF by the package xacro in a process with limits."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

from asbuilt.description.formats.registry import FORMATS, DescriptionFormat
from asbuilt.description.formats.urdf import read_urdf
from asbuilt.description.model import RobotModel
from asbuilt.errors import DescriptionError, MissingExtraError
from asbuilt.findings import Cure
from asbuilt.untrusted import read_bytes

LARGEST = 20_000_000
"""Bytes of a file."""
LONGEST = 30.0
"""Seconds that an expansion may take."""
PROGRAM = """
import sys
try:
    import resource
    resource.setrlimit(resource.RLIMIT_DATA, (1_000_000_000,) * 2)
except (ImportError, ValueError, OSError):
    pass
import xacro
xacro.main()
"""
"""Expressions of a xacro file are Python, which may use any amount of memory."""


def read_xacro(path: str | Path) -> RobotModel:
    """Expand a xacro file with its default arguments and read the URDF.

    Raises
    ------
    MissingExtraError
        If xacro is not installed.
    DescriptionError
        If it cannot be expanded, or the URDF makes no sense.
    """
    file = Path(path)
    read_bytes(file, "description", DescriptionError, LARGEST)
    if find_spec("xacro") is None:
        raise MissingExtraError("xacro", "robots", f"reading {path}")
    try:
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM, str(file)],
            capture_output=True,
            timeout=LONGEST,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise DescriptionError(
            f"{path}: xacro takes longer than {LONGEST:.0f} s to expand it", file=str(path)
        ) from None
    if done.returncode:
        lines = done.stderr.decode("utf-8", "replace").strip().splitlines() or ["no reason given"]
        raise DescriptionError(
            f"{path}: xacro cannot expand it ({lines[0][:300]})",
            cure=Cure("expand it where its packages are installed, and give the URDF"),
            file=str(path),
        )
    return replace(read_urdf(done.stdout), source=str(path))


FORMATS.register("xacro", DescriptionFormat("xacro", (".xacro",), read_xacro))
