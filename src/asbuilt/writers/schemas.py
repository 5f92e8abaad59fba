"""JSON Schemas of the files that people write, for editors that check and complete them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from asbuilt.codec import format_json
from asbuilt.description.toml_tables import RobotFile
from asbuilt.experiment.logs.sheet import RecordingSheet
from asbuilt.registry import check_known
from asbuilt.writing import atomic_write

SCHEMAS: dict[str, type[BaseModel]] = {"robot": RobotFile, "sheet": RecordingSheet}
"""What has a schema: the robot file and the recording sheet."""


def json_schema(kind: str) -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of a kind of file, `"robot"` or `"sheet"`.

    Raises
    ------
    UsageError
        If there is no such kind.
    """
    check_known("schema", kind, SCHEMAS)
    schema: dict[str, Any] = _drop_infinite_defaults(SCHEMAS[kind].model_json_schema())
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def write_schema(kind: str, path: Path) -> Path:
    """Write the JSON Schema of a kind of file."""
    return atomic_write(path, format_json(json_schema(kind)))


def _drop_infinite_defaults(part: Any) -> Any:
    """Return a part of a schema without infinite defaults, which JSON cannot say."""
    if isinstance(part, dict):
        return {
            name: _drop_infinite_defaults(value)
            for name, value in part.items()
            if not isinstance(value, float) or math.isfinite(value)
        }
    return [_drop_infinite_defaults(item) for item in part] if isinstance(part, list) else part
