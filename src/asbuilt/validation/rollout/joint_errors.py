"""Errors of simulated positions, joint by joint."""

from __future__ import annotations

import numpy as np

from asbuilt.description.model import RobotModel
from asbuilt.tables import Cell, Column, Shown, Table, round_significant
from asbuilt.validation.rollout.errors import position_unit
from asbuilt.validation.rollout.rollout import Rollout


def tabulate_joint_errors(model: RobotModel, rollout: Rollout) -> Table:
    """Return the errors of every joint for one horizon."""
    unit = "mrad or mm" if model.n_floating else position_unit(model)
    cad, built = rollout.cad, rollout.as_built
    errors = {"as built": built, "CAD": cad, "command": rollout.no_physics, "repeat": rollout.floor}
    ends = {"end, as built": built, "end, CAD": cad}
    values = {
        **{name: None if each is None else each.rms for name, each in errors.items()},
        **{name: None if each is None else each.final for name, each in ends.items()},
    }
    rows = tuple(
        (
            name,
            *(
                None if each is None else format_in_milli(float(each[k]))
                for each in values.values()
            ),
        )
        for k, name in enumerate(model.joint_names)
    )
    columns = (
        Column("joint", width=20),
        *(Column(name, unit, "decimal", detail=name in ends) for name in values),
    )
    title = f"Position error of rollouts of {rollout.horizon:g} s, held out"
    return Table(columns, rows, title).filled()


def format_in_milli(value: float | None) -> Cell:
    """Return a length or angle in thousandths of its unit, as a cell."""
    if value is None:
        return None
    if not np.isfinite(value):
        return Shown(None, "diverged")
    return Shown(1e3 * value, round_significant(1e3 * value))
