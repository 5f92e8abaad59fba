"""Tables of rollouts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from asbuilt.description.model import RobotModel
from asbuilt.findings import Cure
from asbuilt.tables import Cell, Column, Table, wrap_text
from asbuilt.validation import Rollout, recording_name, rollout_findings
from asbuilt.validation.rollout.position_errors import (
    BY_RECORDING,
    RecordingErrors,
    RolloutErrors,
    average_errors,
    position_unit,
)
from asbuilt.validation.rollout.rollout import format_in_milli, tabulate_joint_errors

if TYPE_CHECKING:
    from asbuilt.workflow.refinement import Refined


ROBOTS = (("CAD", "cad"), ("as built", "as_built"))
"""Names of the simulated robots, in tables and of a rollout's errors."""


def with_rollouts(document: dict[str, Any], rollouts: Sequence[Rollout]) -> dict[str, Any]:
    """Return a document of a command with its rollouts, if there are any."""
    return document | ({"rollout": [rollout.as_dict() for rollout in rollouts]} if rollouts else {})


def rollout_text(
    model: RobotModel,
    rollouts: Sequence[Rollout],
    *,
    full: bool = False,
    cure_text: Callable[[Cure], str] | None = None,
) -> str:
    """Return the tables of rollouts: their errors, with `full` joint by joint and by recording.

    `cure_text` writes cures; without it their findings are left out.
    """
    if not rollouts:
        return ""
    parts = [tabulate_rollouts(model, rollouts)]
    if full:
        parts += [tabulate_joint_errors(model, rollout) for rollout in rollouts]
        parts += [
            tabulate_recording_errors(model, rollout)
            for rollout in rollouts
            if len(rollout.by_recording) > 1
        ]
    notes = (
        []
        if cure_text is None
        else [wrap_text(finding.advised(cure_text)) for finding in rollout_findings(rollouts)]
    )
    return "\n" + "\n".join([*(part.as_text(full) for part in parts), *notes])


def describe_refinement(refined: Refined) -> str:
    """Return a sentence that says what a refinement by trajectories changed."""
    text = (
        f"Refined by trajectories of {refined.horizon:g} s in {refined.iterations} steps"
        f" ({refined.seconds:.3g} s)"
    )
    if refined.before is not None and refined.after is not None:
        text += f": rollout error {refined.before.text} before, {refined.after.text} after"
    return wrap_text(text + ("." if refined.kept else ", which is not followed.")) + "\n"


def tabulate_rollouts(model: RobotModel, rollouts: Sequence[Rollout]) -> Table:
    """Return one row of errors per horizon."""
    unit = position_unit(model)
    return Table.of(
        rollouts,
        (
            Column("horizon", "s", "decimal", ".3g", of="horizon"),
            Column("windows", align="right", of="n_windows"),
            *(
                Column(
                    name, unit, "decimal", of=partial(_show_error, errors, attrgetter("rms_all"))
                )
                for name, errors in (*ROBOTS, ("command", "no_physics"), ("repeat", "floor"))
            ),
            *(
                Column(f"{what}, {name}", unit, "decimal", of=partial(_show_error, robot, measure))
                for what, unit, measure in (
                    ("tool", "mm", attrgetter("tool")),
                    ("base", "mm", lambda errors: errors.base and errors.base[0]),
                    ("tilt", "mrad", lambda errors: errors.base and errors.base[1]),
                )
                for name, robot in ROBOTS
            ),
            Column(
                "worst joint",
                width=16,
                of=lambda rollout: _name_worst_joint(model, rollout.as_built or rollout.cad),
            ),
        ),
        "Rollout: position error of the simulation from the measured state, driven by the"
        f" {rollouts[0].driven_by}",
    ).filled()


def tabulate_recording_errors(model: RobotModel, rollout: Rollout) -> Table:
    """Return the errors of every recording for one horizon."""
    unit = position_unit(model)
    runs = rollout.by_recording
    columns = (
        Column("recording", width=24),
        Column("windows", align="right"),
        *(
            Column(name, unit, "decimal")
            for name in ("CAD", "as built", "command", "without outlying")
        ),
    )
    means = map(format_in_milli, average_errors(runs).values())
    rows = (
        *(
            (
                recording_name(run.source),
                run.n_windows,
                *(_show_error(name, attrgetter("rms_all"), run) for name in BY_RECORDING),
            )
            for run in runs
        ),
        ("mean of recordings", rollout.n_windows, *means),
    )
    return Table(columns, rows, f"Rollouts of {rollout.horizon:g} s by recording").filled()


def _show_error(
    name: str, measure: Callable[[RolloutErrors], float | None], rollout: Rollout | RecordingErrors
) -> Cell:
    """Return a measure of the errors that a rollout has by this name, in thousandths."""
    errors: RolloutErrors | None = getattr(rollout, name)
    return None if errors is None else format_in_milli(measure(errors))


def _name_worst_joint(model: RobotModel, errors: RolloutErrors | None) -> str:
    rms = np.array(np.nan) if errors is None else errors.rms_until
    return model.joint_names[int(np.argmax(rms))] if np.all(np.isfinite(rms)) else "-"
