"""Tables of rollouts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from asbuilt.description.model import RobotModel
from asbuilt.findings import Cure, Finding
from asbuilt.tables import Cell, Column, Shown, Table, significant, wrapped
from asbuilt.validation.comparison.comparison import recording_name
from asbuilt.validation.rollout.errors import RolloutErrors, mean_errors
from asbuilt.validation.rollout.rollout import Rollout, rollout_findings
from asbuilt.workflow.simulation.refinement import Refined

TITLE = "Rollout: position error of the simulation from the measured state, driven by the {}"


def with_rollouts(document: dict[str, Any], rollouts: Sequence[Rollout]) -> dict[str, Any]:
    """Return a document of a command with its rollouts, if there are any."""
    return document | ({"rollout": [each.as_dict() for each in rollouts]} if rollouts else {})


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
    parts = [rollout_table(model, rollouts)]
    if full:
        parts += [joint_table(model, each) for each in rollouts]
        parts += [motion_table(model, each) for each in rollouts if len(each.by_recording) > 1]
    said = (
        []
        if cure_text is None
        else [wrapped(_advised(each, cure_text)) for each in rollout_findings(rollouts)]
    )
    return "\n" + "\n".join([*(part.as_text(full) for part in parts), *said])


def _advised(finding: Finding, cure_text: Callable[[Cure], str]) -> str:
    """Return a finding with its cure in the words of `cure_text`, as sentences."""
    advice = cure_text(finding.cure) if finding.cure else ""
    return f"{finding.message}." + (f" {advice[:1].upper()}{advice[1:]}." if advice else "")


def refined_text(refined: Refined) -> str:
    """Return a sentence that says what a refinement by trajectories changed."""
    said = (
        f"Refined by trajectories of {refined.horizon:g} s in {refined.iterations} steps"
        f" ({refined.seconds:.3g} s)"
    )
    if refined.before is not None and refined.after is not None:
        before, after = (1e3 * each.rms_all for each in (refined.before, refined.after))
        said += f": rollout error {before:.3g} before, {after:.3g} after [mrad or mm]"
    said += "" if refined.kept else ", which is not followed"
    return wrapped(said + ".") + "\n"


def rollout_table(model: RobotModel, rollouts: Sequence[Rollout]) -> Table:
    """Return one row of errors per horizon."""
    unit = position_unit(model)
    rows: list[tuple[Cell, ...]] = []
    for each in rollouts:
        shown = each.as_built or each.cad
        rows.append(
            (
                each.horizon,
                each.n_windows,
                *(
                    _shown(errors)
                    for errors in (each.cad, each.as_built, each.no_physics, each.floor)
                ),
                _tool(each.cad),
                _tool(each.as_built),
                "-" if shown is None else _worst(model, shown),
            )
        )
    columns = (
        Column("horizon", "s", "decimal", ".3g"),
        Column("windows", align="right"),
        Column("CAD", unit, "decimal"),
        Column("as built", unit, "decimal"),
        Column("command", unit, "decimal"),
        Column("repeat", unit, "decimal"),
        Column("tool, CAD", "mm", "decimal"),
        Column("tool, as built", "mm", "decimal"),
        Column("worst joint", width=16),
    )
    return _filled(columns, rows, TITLE.format(rollouts[0].driven_by))


def joint_table(model: RobotModel, rollout: Rollout) -> Table:
    """Return the errors of every joint for one horizon."""
    names = ("CAD", "as built", "command", "repeat")
    errors = (rollout.cad, rollout.as_built, rollout.no_physics, rollout.floor)
    rows: list[tuple[Cell, ...]] = []
    for k, name in enumerate(model.joint_names):
        values = [None if each is None else float(each.rms[k]) for each in errors]
        ends = [None if each is None else float(each.final[k]) for each in errors[:2]]
        rows.append((name, *(_milli(x) for x in values), *(_milli(x) for x in ends)))
    unit = position_unit(model)
    columns = (
        Column("joint", width=20),
        *(Column(name, unit, "decimal") for name in names),
        Column("end, CAD", unit, "decimal"),
        Column("end, as built", unit, "decimal"),
    )
    return _filled(columns, rows, f"Rollouts of {rollout.horizon:g} s by joint")


def motion_table(model: RobotModel, rollout: Rollout) -> Table:
    """Return the errors of every recording for one horizon."""
    unit = position_unit(model)
    columns = (
        Column("recording", width=24),
        Column("windows", align="right"),
        Column("CAD", unit, "decimal"),
        Column("as built", unit, "decimal"),
        Column("command", unit, "decimal"),
        Column("without outlying", unit, "decimal"),
    )
    rows: list[tuple[Cell, ...]] = [
        (
            recording_name(each.source),
            each.n_windows,
            *(_shown(errors) for errors in each.errors().values()),
        )
        for each in rollout.by_recording
    ]
    means = mean_errors(rollout.by_recording)
    rows.append(("mean of recordings", rollout.n_windows, *map(_milli, means.values())))
    return _filled(columns, rows, f"Rollouts of {rollout.horizon:g} s by recording")


def _filled(columns: Sequence[Column], rows: Sequence[tuple[Cell, ...]], title: str) -> Table:
    """Return a table without the columns that no row fills."""
    kept = [k for k in range(len(columns)) if any(row[k] is not None for row in rows)]
    return Table(
        tuple(columns[k] for k in kept),
        tuple(tuple(row[k] for k in kept) for row in rows),
        title=title,
    )


def position_unit(model: RobotModel) -> str:
    """Return the unit of a thousandth of the joints' positions."""
    kinds = {joint.is_revolute for joint in model.joints}
    return "mrad or mm" if len(kinds) > 1 else "mrad" if kinds == {True} else "mm"


def error_text(errors: RolloutErrors, unit: str) -> str:
    """Return the error of all joints in a unit of `position_unit`, or that it diverges."""
    return "diverges" if errors.diverged else f"{1e3 * errors.rms_all:.3g} {unit}"


def _shown(errors: RolloutErrors | None) -> Cell:
    return None if errors is None else _milli(errors.rms_all)


def _tool(errors: RolloutErrors | None) -> Cell:
    return None if errors is None or errors.tool is None else _milli(errors.tool)


def _milli(value: float | None) -> Cell:
    if value is None:
        return None
    if not np.isfinite(value):
        return Shown(None, "diverged")
    return Shown(1e3 * value, significant(1e3 * value))


def _worst(model: RobotModel, errors: RolloutErrors) -> str:
    rms = errors.rms_until
    return model.joint_names[int(np.argmax(rms))] if np.all(np.isfinite(rms)) else "-"
