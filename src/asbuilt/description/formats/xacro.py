"""Robots from xacro, expanded to URDF by the package xacro in a process with limits."""

from __future__ import annotations

import os
import re
import signal
import subprocess
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

from asbuilt.children import STILL, Watch
from asbuilt.description.formats.description_format import DESCRIPTION_FORMATS, DescriptionFormat
from asbuilt.description.formats.expansion import SECONDS
from asbuilt.description.formats.urdf import read_urdf
from asbuilt.description.formats.xml import LARGEST_DESCRIPTION
from asbuilt.description.model import RobotModel
from asbuilt.description.structure.parts import BaseKind
from asbuilt.errors import DescriptionError, MissingExtraError
from asbuilt.findings import Cure
from asbuilt.isolation import build_isolated_command, build_isolated_environment
from asbuilt.untrusted import (
    is_xacro_trusted,
    list_xacro_arguments,
    name_file_in_errors,
    read_bytes,
    shorten_line,
)

PROGRAM = (
    "from asbuilt.description.formats.expansion import expand;"
    " expand({path!r}, {largest}, trusted={trusted}, arguments={arguments!r})"
)


def read_xacro(
    path: str | Path, *, fixed_base: bool = False, base: BaseKind = "fixed"
) -> RobotModel:
    """Expand a xacro file with its arguments, those given or its defaults, and read the URDF.

    Expressions are arithmetic, comparisons, properties, indices and functions of `math`; includes
    and `load_yaml` read descriptions in the folder of the file, or of the package around it, which
    `$(find NAME)` names. Inside `allow_xacro_python` they may be anything that xacro takes, which
    is any Python, with the environment of this process. `fixed_base` and `base` are those of
    `read_urdf`.

    Raises
    ------
    MissingExtraError
        If xacro is not installed.
    DescriptionError
        If it cannot be expanded, or the URDF makes no sense.
    """
    file = Path(path)
    trusted = is_xacro_trusted()
    read_bytes(file, "description", DescriptionError, LARGEST_DESCRIPTION)
    if find_spec("xacro") is None:
        raise MissingExtraError("xacro", "robots", f"reading {path}")
    program = PROGRAM.format(
        path=str(file.resolve()),
        largest=LARGEST_DESCRIPTION,
        trusted=trusted,
        arguments=list_xacro_arguments(),
    )
    process = subprocess.Popen(
        build_isolated_command(program),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=dict(os.environ) if trusted else build_isolated_environment({}),
    )
    with Watch(process, SECONDS) as watch:
        output, errors = process.communicate()
    if watch.stopped:
        raise DescriptionError(
            f"{path}: xacro was stopped after {STILL:.0f} s without progress", file=str(path)
        )
    if -process.returncode == getattr(signal, "SIGXCPU", None):
        raise DescriptionError(
            f"{path}: xacro takes more than {SECONDS} s of computing to expand it", file=str(path)
        )
    if process.returncode:
        message = errors.decode("utf-8", "replace").strip() or "no reason given"
        if name := _find_missing_argument(message):
            raise DescriptionError(
                f"{path}: xacro needs a value of its argument {name!r}, which has no default",
                cure=Cure("give it", settings={"xacro": f"{name}=VALUE"}),
                file=str(path),
            )
        raise DescriptionError(
            f"{path}: xacro cannot expand it ({shorten_line(message)})",
            cure=Cure(
                "expand it where its packages are installed, and give the URDF"
                + ("" if trusted else "; or let it run any Python, if you trust whom it is from"),
                settings={} if trusted else {"trust_xacro": True},
            ),
            file=str(path),
        )
    with name_file_in_errors(path):
        robot = read_urdf(output, fixed_base=fixed_base, base=base)
    return replace(robot, source=str(path))


def _find_missing_argument(message: str) -> str:
    """Return the argument of which xacro says that it has none, by its name; empty for others."""
    found = re.fullmatch(r"'([A-Za-z_][\w-]*)'(?: when evaluating expression '(.*)')?", message)
    if found is None:
        return ""
    # Keys that a dictionary lacks are told alike.
    of_argument = found[2] is None or f"$(arg {found[1]})" in found[2]
    return found[1] if of_argument else ""


DESCRIPTION_FORMATS.register(
    "xacro", DescriptionFormat("xacro", (".xacro",), read_xacro, on_bases=True)
)
