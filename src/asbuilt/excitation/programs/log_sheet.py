"""The recording sheet that belongs to the log of a program."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import tomli_w

from asbuilt.excitation.programs.naming import plain_text
from asbuilt.excitation.programs.preamble import commented, wrapped
from asbuilt.excitation.programs.request import ProgramRequest


def sheet_text(request: ProgramRequest, comments: Sequence[str], fields: Mapping[str, Any]) -> str:
    """Return a recording sheet (TOML) for the log of the program, with comments above."""
    title = f"Recording sheet for the log of motion {request.name} on {request.model.name}."
    lines = [line for comment in (title, *comments) for line in wrapped(plain_text(comment))]
    return commented(lines, "#") + "\n\n" + tomli_w.dumps(fields)
