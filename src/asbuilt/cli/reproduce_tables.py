"""The reproduction of the 2015 paper in print: its tables and figures, ours beside what it says."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.cli.reproduce import Reproduction
from asbuilt.tables import Cell, Column, Table
from asbuilt.validation.prediction import Validation
from asbuilt.writers.figures.figure_style import save_figure
from asbuilt.writers.figures.figures import torque_figure
from asbuilt.writers.files import atomic_write, path_texts

SOURCE = (
    "A. A. Hayat, V. Abhishek and S. K. Saha, Dynamic Identification of Manipulator: Comparison"
    " between CAD and Actual Parameters, iNaCoMM 2015-94"
)
FIGURE_JOINTS = slice(0, 4)
VISIBLE = 5e-7
"""Difference of a CAD value [SI] from which it is mentioned."""


def table_1(redone: Reproduction) -> Table:
    """Return the kinematic parameters and masses of Table 1 as bundled, and where that is not what
    the paper prints.
    """
    rows = []
    for k, (joint, link) in enumerate(zip(redone.model.joints, redone.model.links, strict=True)):
        com = " ".join(f"{value:.6g}" for value in link.inertia.com + 0.0)
        alpha = float(np.rad2deg(np.arctan2(joint.after[2, 1], joint.after[2, 2])))
        remark = (
            f"paper prints {redone.paper.alpha_7_printed:g}"
            if k == redone.model.n_joints - 1
            else ""
        )
        rows.append(
            (
                k + 1,
                redone.model.lengths.get(f"b{k + 1}", 0.0),
                0.0,
                alpha,
                link.inertia.mass,
                com,
                remark,
            )
        )
    columns = (
        Column("link", align="right"),
        Column("b", "m", "decimal"),
        Column("a", "m", "decimal"),
        Column("alpha", "deg", "decimal"),
        Column("mass", "kg", "decimal"),
        Column("centre of mass", "m"),
        Column("remark"),
    )
    note = (
        f"With alpha_7 = {redone.paper.alpha_7_printed:g} deg as printed,"
        f" {redone.mismatches_with_printed_alpha} of {len(redone.parameters)} rows of Table 2 would"
        " differ; with 0 all agree."
    )
    return Table(
        columns, tuple(rows), title="Table 1. KUKA LBR iiwa 7 R800 from CAD", notes=(note,)
    )


def table_2(redone: Reproduction) -> Table:
    """Return Table 2: id, expression, the paper's CAD value, ours, what least squares on simulated
    motion gives, the paper's robot value.
    """
    rows = tuple(
        (
            k,
            row.id,
            row.ours,
            "yes" if row.same_expression else "NO",
            row.cad_printed,
            row.cad_ours,
            "yes" if row.same_value else "NO",
            row.simulated,
            row.robot,
        )
        for k, row in enumerate(redone.parameters, start=1)
    )
    columns = (
        Column("row", align="right"),
        Column("id", align="right"),
        Column("base parameter", width=72),
        Column("same"),
        Column("CAD, paper", align="decimal", style=".9f"),
        Column("CAD, ours", align="decimal", style=".9f"),
        Column("same"),
        Column("simulated", align="decimal", style=".9f"),
        Column("robot, paper", align="decimal", style=".9f"),
    )
    misprints = [
        str(k) for k, row in enumerate(redone.parameters, start=1) if row.printed != row.corrected
    ]
    rounded = [
        str(k)
        for k, row in enumerate(redone.parameters, start=1)
        if abs(row.cad_ours - row.cad_printed) > VISIBLE
    ]
    notes = (
        (
            f"{redone.ids_equal} of {len(rows)} ids, {redone.n_same_expressions} of {len(rows)}"
            f" expressions and {redone.n_same_values} of {len(rows)} CAD values are the paper's."
            f" Expressions: as corrected in row{'s' if len(misprints) > 1 else ''}"
            f" {', '.join(misprints)}, which the paper misprints."
        ),
        (
            f"Values agree within what the rounding of Table 1 allows; rows {', '.join(rounded)}"
            f" differ visibly, by at most {redone.largest_difference:.1e}."
        ),
        (
            "'simulated': quintic motions, noise-free torque, least squares, as in section 3.1 of"
            " the paper."
        ),
        (
            "Physical consistency: best attainable smallest eigenvalue of the links'"
            f" pseudo-inertias {redone.cad_margin:.3g} for the CAD column and"
            f" {redone.robot_margin:.3g} for the robot column, so"
            f" {'NO real bodies have' if redone.robot_margin < 0 else 'real bodies can have'} the"
            " paper's robot column."
        ),
    )
    return Table(columns, rows, title="Table 2. Base parameters", notes=notes)


def table_3(redone: Reproduction) -> Table:
    """Return Table 3: RMS torque error on the test motion, the paper's robot beside the virtual
    one.
    """
    joints = redone.paper.table3_joints
    rigid, full = redone.rigid.validations[0], redone.full.validations[0]
    pick = np.array(joints) - 1
    rows: tuple[tuple[Cell, ...], ...] = (
        ("paper, its robot", "CAD", *redone.paper.table3_cad),
        ("paper, its robot", "identified", *redone.paper.table3_robot),
        ("virtual robot", "CAD", *rigid.metrics_cad.rms[pick].tolist()),
        ("virtual robot", "identified as in the paper", *rigid.metrics_as_built.rms[pick].tolist()),
        ("virtual robot", "identified with friction", *full.metrics_as_built.rms[pick].tolist()),
    )
    columns = (
        Column("robot"),
        Column("parameters"),
        *(Column(f"joint {k}", "N m", "decimal", ".4f") for k in joints),
    )
    notes = (
        (
            "The recordings behind the paper's Table 3 and Figures 3 and 4 are not public. They"
            " cannot be reproduced, only repeated: here on a virtual installed robot, the iiwa of"
            f" Table 1 with {'; '.join(redone.installed)}, none of which its CAD model knows."
        ),
        (
            f"Spline and point-to-point motion, {redone.n_logged} samples at 1 kHz (the paper:"
            f" {redone.paper.samples}), its signal chain (Butterworth of order 2 at 7 Hz both ways,"
            " central differences, decimation by 10), least squares; judged on another"
            " point-to-point motion."
        ),
        (
            "'with friction': the same recordings through the default chain, weighted least"
            " squares, viscous, Coulomb and offset terms."
        ),
    )
    return Table(columns, rows, title="Table 3. RMS torque error on the test motion", notes=notes)


def reproduction_text(redone: Reproduction) -> str:
    """Return what `asbuilt reproduce` prints."""
    tables = "\n".join(
        table.as_text() for table in (table_1(redone), table_2(redone), table_3(redone))
    )
    return (
        f"{SOURCE}\n\n{tables}\nFigures 3 and 4: torque of joints 1 to 4 on the test motion, CAD"
        " and identified; --out DIR draws them.\n"
    )


def write_reproduction(folder: Path, redone: Reproduction) -> dict[str, Path]:
    """Write the tables as text and CSV, and Figures 3 and 4 as PNG."""
    files = {"text": atomic_write(folder / "reproduction.txt", reproduction_text(redone))}
    for number, table in enumerate((table_1(redone), table_2(redone), table_3(redone)), start=1):
        files[f"table{number}"] = atomic_write(folder / f"table{number}.csv", table.as_csv())
    validation = redone.rigid.validations[0]
    titles = {
        "figure3": "Figure 3, repeated: measured on the virtual robot and predicted from CAD",
        "figure4": "Figure 4, repeated: measured on the virtual robot and predicted as identified",
    }
    predictions = ((validation.predicted_cad, "CAD"), (validation.predicted, "identified"))
    for (kind, title), (predicted, label) in zip(titles.items(), predictions, strict=True):
        files[kind] = save_figure(
            _figure(validation, predicted, title, label), folder / f"{kind}.png"
        )
    return files


def reproduction_document(redone: Reproduction, files: Mapping[str, Path]) -> dict[str, Any]:
    """Return what `asbuilt reproduce --json` prints."""
    rigid, full = redone.rigid.validations[0], redone.full.validations[0]
    return {
        "source": SOURCE,
        "robot": redone.model.name,
        "table1": {
            "alpha_7_printed": redone.paper.alpha_7_printed,
            "rows_missed_as_printed": redone.mismatches_with_printed_alpha,
        },
        "table2": {
            "ids_equal": redone.ids_equal,
            "expressions_equal": redone.n_same_expressions,
            "cad_values_within_rounding": redone.n_same_values,
            "largest_difference": redone.largest_difference,
            "cad_margin": redone.cad_margin,
            "robot_margin": redone.robot_margin,
            "parameters": [
                {
                    "id": row.id,
                    "printed": row.printed,
                    "corrected": row.corrected,
                    "ours": row.ours,
                    "cad_printed": row.cad_printed,
                    "cad_ours": row.cad_ours,
                    "tolerance": row.tolerance,
                    "simulated": row.simulated,
                    "robot": row.robot,
                }
                for row in redone.parameters
            ],
        },
        "table3": {
            "joints": list(redone.paper.table3_joints),
            "paper": {
                "cad": list(redone.paper.table3_cad),
                "robot": list(redone.paper.table3_robot),
            },
            "virtual": {
                "installed": list(redone.installed),
                "n_samples": redone.n_logged,
                "cad": rigid.metrics_cad.as_dict(),
                "identified": rigid.metrics_as_built.as_dict(),
                "identified_with_friction": full.metrics_as_built.as_dict(),
            },
        },
        "files": path_texts(files),
    }


def _figure(validation: Validation, predicted: Any, title: str, label: str) -> Any:
    return torque_figure(
        validation.t,
        validation.measured[:, FIGURE_JOINTS],
        predicted[:, FIGURE_JOINTS],
        joint_names=validation.joint_names[FIGURE_JOINTS],
        units=validation.units[FIGURE_JOINTS],
        title=title,
        label=label,
    )
