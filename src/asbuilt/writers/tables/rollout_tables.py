"""Tables of rollouts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from asbuilt.description.model import RobotModel
from asbuilt.findings import Cure
from asbuilt.tables import Cell, Column, Table, wrap_text
from asbuilt.validation import Rollout, recording_name, rollout_findings
from asbuilt.validation.rollout.position_errors import RolloutErrors, average_errors, position_unit
from asbuilt.validation.rollout.rollout import format_in_milli, tabulate_joint_errors

if TYPE_CHECKING:
    from asbuilt.workflow.refinement import Refined


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
            Column("CAD", unit, "decimal", of=lambda each: _show_error(each.cad)),
            Column("as built", unit, "decimal", of=lambda each: _show_error(each.as_built)),
            Column("command", unit, "decimal", of=lambda each: _show_error(each.no_physics)),
            Column("repeat", unit, "decimal", of=lambda each: _show_error(each.floor)),
            Column("tool, CAD", "mm", "decimal", of=lambda each: _show_tool_error(each.cad)),
            Column(
                "tool, as built", "mm", "decimal", of=lambda each: _show_tool_error(each.as_built)
            ),
            *(
                Column(f"{what}, {name}", unit, "decimal", of=partial(_show_base_error, robot, k))
                for k, (what, unit) in enumerate((("base", "mm"), ("tilt", "mrad")))
                for name, robot in (("CAD", "cad"), ("as built", "as_built"))
            ),
            Column(
                "worst joint",
                width=16,
                of=lambda each: _name_worst_joint(model, each.as_built or each.cad),
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
            (recording_name(run.source), run.n_windows, *map(_show_error, run.errors().values()))
            for run in runs
        ),
        ("mean of recordings", rollout.n_windows, *means),
    )
    return Table(columns, rows, f"Rollouts of {rollout.horizon:g} s by recording").filled()


def _show_error(errors: RolloutErrors | None) -> Cell:
    return None if errors is None else format_in_milli(errors.rms_all)


def _show_tool_error(errors: RolloutErrors | None) -> Cell:
    return None if errors is None or errors.tool is None else format_in_milli(errors.tool)


def _show_base_error(robot: str, k: int, rollout: Rollout) -> Cell:
    errors: RolloutErrors | None = getattr(rollout, robot)
    return None if errors is None or errors.base is None else format_in_milli(errors.base[k])


def _name_worst_joint(model: RobotModel, errors: RolloutErrors | None) -> str:
    rms = np.array(np.nan) if errors is None else errors.rms_until
    return model.joint_names[int(np.argmax(rms))] if np.all(np.isfinite(rms)) else "-"
