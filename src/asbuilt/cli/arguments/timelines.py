"""Options of the commands that write timelines."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from asbuilt import writers
from asbuilt.cli.arguments.options import writable_file


@dataclass(frozen=True)
class TimelineFiles:
    """The files in which a viewer shows measured and predicted torques over time."""

    mcap: Annotated[
        Path | None,
        typer.Option(
            "--mcap",
            metavar="FILE",
            help="measured and predicted torques and events, for Foxglove and PlotJuggler",
            callback=writable_file,
        ),
    ] = None
    rrd: Annotated[
        Path | None,
        typer.Option(
            "--rrd",
            metavar="FILE",
            help="the same with the moving robot, for rerun",
            callback=writable_file,
        ),
    ] = None

    def write(self, timelines: Callable[[], Sequence[writers.Timeline]]) -> dict[str, Path]:
        """Write the files that are asked for, and return their paths by kind."""
        kinds = {"mcap": (self.mcap, writers.write_mcap), "rrd": (self.rrd, writers.write_rrd)}
        asked = {kind: each for kind, each in kinds.items() if each[0] is not None}
        made = timelines() if asked else ()
        return {kind: write(path, made) for kind, (path, write) in asked.items() if path}
