"""Options of the commands that write timelines."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from asbuilt.cli.arguments.options import writable_file

if TYPE_CHECKING:
    from asbuilt.description.model import RobotModel
    from asbuilt.experiment.logs.recordings import Recorded
    from asbuilt.findings import Finding
    from asbuilt.validation.prediction import Validation
    from asbuilt.writers.timelines.timeline import Timeline


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

    def write(self, timelines: Callable[[], Sequence[Timeline]]) -> dict[str, Path]:
        """Write the files that are asked for, and return their paths by kind."""
        if self.mcap is None and self.rrd is None:
            return {}
        from asbuilt.writers.timelines.timeline_files import write_mcap, write_rrd

        writers = {"mcap": (self.mcap, write_mcap), "rrd": (self.rrd, write_rrd)}
        asked = {kind: each for kind, each in writers.items() if each[0] is not None}
        made = timelines()
        return {kind: write(path, made) for kind, (path, write) in asked.items() if path}

    def write_validations(
        self,
        model: RobotModel,
        validations: Sequence[Validation],
        recordings: Sequence[Recorded],
        findings: Sequence[Finding] = (),
    ) -> dict[str, Path]:
        """Write the predictions of recordings if files are asked for."""

        def timelines() -> Sequence[Timeline]:
            from asbuilt.writers.timelines.timeline import timelines_of_validations

            return timelines_of_validations(model, validations, recordings, findings)

        return self.write(timelines)
