"""The recording sheet that belongs to the log of a program."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import tomli_w

from asbuilt.writers.programs.naming import plain_text
from asbuilt.writers.programs.preamble import commented, wrapped
from asbuilt.writers.programs.request import ProgramRequest

GAINS_TO_FILL_IN = (
    "fill in the N m per ampere of your robot's joints and take away the mark; `asbuilt gains`"
    " finds them from a payload of known mass"
)


def sheet_text(
    request: ProgramRequest,
    comments: Sequence[str],
    fields: Mapping[str, Any],
    *,
    gains: str | None = None,
) -> str:
    """Return a recording sheet (TOML) for the log of the program, with comments above.

    `gains` says what belongs into the line of gains that waits to be filled in.
    """
    title = f"Recording sheet for the log of motion {request.name} on {request.model.name}."
    lines = [line for comment in (title, *comments) for line in wrapped(plain_text(comment))]
    scalars = {key: value for key, value in fields.items() if not isinstance(value, Mapping)}
    tables = {key: value for key, value in fields.items() if isinstance(value, Mapping)}
    text = tomli_w.dumps(scalars)
    if gains is not None:
        places = ", ".join(f"g{k}" for k in range(1, request.model.n_joints + 1))
        text += commented([*wrapped(plain_text(gains)), f"gains = [{places}]"], "#") + "\n"
    parts = [commented(lines, "#") + "\n", text, *([tomli_w.dumps(tables)] if tables else [])]
    return "\n".join(parts)
