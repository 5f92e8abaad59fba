"""Tables of the reproduction: our values compared with the paper's."""

from __future__ import annotations

import numpy as np

from asbuilt.apps.paper.reproduction import ReproducedParameter, Reproduction
from asbuilt.apps.paper.virtual_robot import DIFFERENCES
from asbuilt.tables import Cell, Column, Table, format_share

INERTIA = (("Ixx", 0, 0), ("Iyy", 1, 1), ("Izz", 2, 2), ("Ixy", 0, 1), ("Iyz", 1, 2), ("Izx", 0, 2))


def tabulate_links(redone: Reproduction) -> Table:
    """Return Table 1: kinematic parameters and mass properties of every link."""
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (
            k,
            redone.model.lengths.get(f"b{k}", 0.0),
            0.0,
            float(np.rad2deg(np.arctan2(joint.after[2, 1], joint.after[2, 2]))),
            link.inertia.mass,
            *link.inertia.com.tolist(),
            *(float(link.inertia.inertia_about_com[i, j]) for _, i, j in INERTIA),
        )
        for k, (joint, link) in enumerate(
            zip(redone.model.joints, redone.model.links, strict=True), start=1
        )
    )
    columns = (
        Column("link", align="right"),
        Column("b", "m", "decimal"),
        Column("a", "m", "decimal"),
        Column("alpha", "deg", "decimal"),
        Column("mass", "kg", "decimal"),
        *(Column(name, "m", "decimal") for name in ("rx", "ry", "rz")),
        *(Column(name, "kg m2", "decimal", detail=True) for name, _, _ in INERTIA),
    )
    note = (
        f"The paper prints alpha_7 = {redone.paper.alpha_7_printed:g} deg; then"
        f" {redone.mismatches_with_printed_alpha} of {len(redone.parameters)} rows of Table 2"
        " would differ. With 0 deg all agree."
    )
    return Table(columns, rows, "Table 1. KUKA LBR iiwa 7 R800 from CAD", notes=(note,))


def tabulate_base_parameters(redone: Reproduction) -> Table:
    """Return Table 2: expressions, CAD values and estimates of all base parameters."""
    columns = (
        Column("row", align="right", of=lambda row: redone.parameters.index(row) + 1),
        Column("id", align="right", of="id"),
        Column("base parameter", width=40, of="ours"),
        Column("same", detail=True, of=lambda row: "yes" if row.same_expression else "NO"),
        Column("CAD, paper", align="decimal", style=".9f", detail=True, of="cad"),
        Column("CAD, ours", align="decimal", style=".6f", of="cad_ours"),
        Column("same", detail=True, of=lambda row: "yes" if row.same_value else "NO"),
        Column("simulated", align="decimal", style=".9f", detail=True, of="simulated"),
        Column("robot, paper", align="decimal", style=".9f", detail=True, of="robot"),
        Column("virtual robot", align="decimal", style=".6f", detail=True, of="virtual_robot"),
    )
    rows = list(enumerate(redone.parameters, start=1))
    misprints = [str(k) for k, row in rows if row.printed]
    # Difference of a CAD value [SI] from which it is mentioned.
    rounded = [str(k) for k, row in rows if row.difference > 5e-7]
    return Table.of(
        redone.parameters,
        columns,
        "Table 2. Base parameters (SI)",
        notes=(
            f"{describe_agreement(redone)} The paper misprints the expressions of rows"
            f" {' and '.join(misprints)}.",
            f"Rows {', '.join(rounded)} differ by at most {redone.largest_difference:.1e}, which"
            " the rounding of Table 1 allows.",
            describe_consistency(redone),
        ),
        details=(
            "'simulated': quintic motion, noise-free torque, least squares (section 3.1).",
            "'virtual robot': the method of the paper on the recording behind Table 3.",
        ),
        important=redone.paper.highlighted,
    )


def describe_agreement(redone: Reproduction) -> str:
    """Return how many ids, expressions and CAD values equal the paper's."""
    total = len(redone.parameters)
    return (
        f"{redone.ids_equal} of {total} ids, {redone.n_same_expressions} of {total} expressions"
        f" and {redone.n_same_values} of {total} CAD values agree with the paper."
    )


def describe_consistency(redone: Reproduction) -> str:
    """Return whether the two columns of Table 2 are physically consistent."""
    cad = redone.cad_margin
    robot = redone.robot_margin
    return (
        f"The CAD column is {'' if cad > 0 else 'NOT '}physically consistent (best attainable"
        f" smallest eigenvalue of the pseudo-inertias {cad:.2g}); the robot column is"
        f" {'physically consistent' if robot > 0 else 'PHYSICALLY INCONSISTENT'} ({robot:.2g})."
    )


def tabulate_highlighted(redone: Reproduction) -> Table:
    """Return the gray rows of Table 2: the difference of the robot from CAD, relative to CAD."""
    parameters = redone.parameters
    columns = (
        Column("row", align="right", of=lambda row: parameters.index(row) + 1),
        Column("base parameter", width=24, of="ours"),
        Column("CAD", align="decimal", style=".3f", of="cad_ours"),
        Column("robot", align="decimal", style=".3f", of="robot"),
        Column(
            "difference",
            "",
            "decimal",
            format_share,
            of=lambda row: _measure_difference(row, row.robot),
        ),
        Column("virtual", align="decimal", style=".3f", of="virtual_robot"),
        Column(
            "difference",
            "",
            "decimal",
            format_share,
            of=lambda row: _measure_difference(row, row.virtual_robot),
        ),
    )
    note = (
        "The text of the paper does not list its gray rows; these have CAD values above 1."
        f" {describe_highlighted(redone)}"
    )
    gray = [parameters[k] for k in redone.paper.highlighted]
    return Table.of(gray, columns, "Gray rows of Table 2", notes=(note,))


def describe_highlighted(redone: Reproduction) -> str:
    """Return the median differences of gray and other rows, for the paper and the virtual robot."""
    gray = set(redone.paper.highlighted)
    medians = {
        (who, is_gray): float(
            np.median(
                [
                    _measure_difference(row, getattr(row, who))
                    for k, row in enumerate(redone.parameters)
                    if (k in gray) is is_gray and row.cad_ours != 0.0
                ]
            )
        )
        for who in ("robot", "virtual_robot")
        for is_gray in (True, False)
    }
    return (
        f"Median difference from CAD of gray rows {format_share(medians['robot', True], 0)}, of"
        " others"
        f" {format_share(medians['robot', False], 0)} (virtual robot:"
        f" {format_share(medians['virtual_robot', True], 0)},"
        f" {format_share(medians['virtual_robot', False], 0)})."
    )


def _measure_difference(row: ReproducedParameter, value: float) -> float:
    return abs(value - row.cad_ours) / abs(row.cad_ours)


def tabulate_torque_errors(redone: Reproduction) -> Table:
    """Return Table 3: RMS torque error on the test motion, of the paper and the virtual robot."""
    joints = redone.paper.table3_joints
    rigid = redone.rigid_validation
    full = redone.full_validation
    pick = np.array(joints) - 1
    rows: tuple[tuple[Cell, ...], ...] = (
        ("paper", "CAD", *redone.paper.table3_cad),
        ("paper", "identified", *redone.paper.table3_robot),
        ("virtual robot", "CAD", *rigid.metrics_cad.rms[pick].tolist()),
        ("virtual robot", "identified", *rigid.metrics_as_built.rms[pick].tolist()),
        ("virtual robot", "with friction", *full.metrics_as_built.rms[pick].tolist()),
    )
    columns = (
        Column("robot"),
        Column("parameters"),
        *(Column(f"joint {k}", "N m", "decimal", ".4f") for k in joints),
    )
    notes = (
        "The recordings of the paper are not public. The virtual robot is the iiwa of Table 1 with"
        f" {'; '.join(DIFFERENCES)}.",
        "'with friction': the same recordings, default signal chain, weighted least squares and"
        " viscous, Coulomb and offset terms.",
    )
    detail = (
        f"Spline and point-to-point motion, {redone.n_logged} samples at 1 kHz (the paper:"
        f" {redone.paper.samples}). 'identified': Butterworth of order 2 at 7 Hz both ways, central"
        " differences, decimation by 10, least squares."
    )
    return Table(
        columns,
        rows,
        "Table 3. RMS torque error on the test motion",
        notes=notes,
        details=(detail,),
    )


def tabulate_simulated_torque(redone: Reproduction) -> Table:
    """Return the errors against simulated torque along the test motion (section 4)."""
    simulated = redone.simulated_torque
    rows = (
        ("torque", *np.sqrt(np.mean(simulated.simulated**2, axis=0)).tolist()),
        ("error, CAD column of Table 2", *simulated.rms(simulated.from_cad).tolist()),
        ("error, identified in simulation", *simulated.rms(simulated.from_identified).tolist()),
    )
    columns = (
        Column("RMS"),
        *(
            Column(name, "N m", "decimal", ".2g", detail=k >= len(redone.paper.table3_joints))
            for k, name in enumerate(redone.model.joint_names)
        ),
    )
    note = (
        "Errors of the CAD column come from its printed digits. The text of the paper says that"
        " Figure 3 shows this validation, its caption that it shows measured torque."
    )
    return Table(columns, rows, "Validation with simulated torque (section 4)", notes=(note,))


def build_all_tables(redone: Reproduction) -> dict[str, Table]:
    """Return every table by the name of its file."""
    return {
        "table1": tabulate_links(redone),
        "table2": tabulate_base_parameters(redone),
        "gray_rows": tabulate_highlighted(redone),
        "simulated_torque": tabulate_simulated_torque(redone),
        "table3": tabulate_torque_errors(redone),
    }
