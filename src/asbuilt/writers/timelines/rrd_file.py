"""Timelines for rerun: the moving robot, its torques and events."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.appearance import link_solids
from asbuilt.description.model import ROOT
from asbuilt.dynamics.kinematics import link_poses
from asbuilt.errors import MissingExtraError
from asbuilt.findings import Severity
from asbuilt.writers.files import atomic_write
from asbuilt.writers.pictures.skeleton import round_mesh
from asbuilt.writers.timelines.timeline import Timeline

TIME = "time"
LEVELS: dict[Severity, str] = {"info": "INFO", "warning": "WARN", "error": "ERROR"}
COLOURS: dict[str, tuple[int, int, int]] = {
    "measured": (0, 114, 178),
    "as_built": (213, 94, 0),
    "cad": (125, 131, 140),
    "error": (0, 158, 115),
    "external": (0, 158, 115),
    "threshold": (179, 38, 30),
}
"""Colours of the report."""
ROD, HOUSING = (205, 208, 213), (226, 122, 32)


def write_rrd(path: str | os.PathLike[str], timelines: Sequence[Timeline]) -> Path:
    """Write timelines as one file of rerun; several recordings have folders of their own.

    Raises
    ------
    MissingExtraError
        If rerun is not installed.
    """
    try:
        import rerun  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise MissingExtraError("rerun-sdk", "rerun", f"writing {path}") from error
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "timeline.rrd"
        stream = rerun.RecordingStream("asbuilt", recording_id="asbuilt")
        stream.save(file)
        for timeline in timelines:
            name = "".join(c if c.isalnum() else "_" for c in timeline.name)
            _write(rerun, stream, timeline, [name] if len(timelines) > 1 else [])
        stream.flush()
        stream.disconnect()
        return atomic_write(path, file.read_bytes())


def _write(rerun: Any, stream: Any, timeline: Timeline, above: list[str]) -> None:
    _write_robot(rerun, stream, timeline, [*above, "robot"])
    for k, joint in enumerate(timeline.model.joint_names):
        for track in timeline.tracks:
            place = [*above, "torque", joint, track.name]
            t, torque = track.joint(k)
            valid = np.isfinite(torque)
            lines = rerun.SeriesLines(colors=COLOURS[track.name], names=track.name)
            stream.log(place, lines, static=True)
            columns = rerun.Scalars.columns(scalars=torque[valid])
            stream.send_columns(rerun.new_entity_path(place), [_times(rerun, t[valid])], columns)
    if timeline.marks:
        texts = rerun.TextLog.columns(
            text=[mark.text for mark in timeline.marks],
            level=[LEVELS[mark.severity] for mark in timeline.marks],
        )
        times = np.array([mark.time for mark in timeline.marks])
        stream.send_columns(
            rerun.new_entity_path([*above, "events"]), [_times(rerun, times)], texts
        )


def _write_robot(rerun: Any, stream: Any, timeline: Timeline, place: list[str]) -> None:
    """Write the bodies of the links once, and their poses over time."""
    model = timeline.model
    links = [[*place, f"{k + 1} {link.name}"] for k, link in enumerate(model.links)]
    for number, solid in enumerate(link_solids(model)):
        parent = place if solid.link == ROOT else links[solid.link]
        vertices, faces = round_mesh(solid)
        colour = ROD if solid.kind == "rod" else HOUSING
        mesh = rerun.Mesh3D(vertex_positions=vertices, triangle_indices=faces, albedo_factor=colour)
        stream.log([*parent, f"{solid.kind} {number}"], mesh, static=True)
    if not len(timeline.t):
        return
    poses = link_poses(model, timeline.q)
    for k, link in enumerate(links):
        columns = rerun.Transform3D.columns(
            translation=poses[:, k, :3, 3], mat3x3=poses[:, k, :3, :3]
        )
        stream.send_columns(rerun.new_entity_path(link), [_times(rerun, timeline.t)], columns)


def _times(rerun: Any, t: Array) -> Any:
    return rerun.TimeColumn(TIME, duration=t)
