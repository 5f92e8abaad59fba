"""The reproduction as text, as files, as a page and as a document."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D

from asbuilt import LinkInertia, RobotModel
from asbuilt.apps.paper.reproduction import Reproduction
from asbuilt.apps.paper.tables import (
    build_all_tables,
    describe_agreement,
    describe_consistency,
    describe_highlighted,
    tabulate_torque_errors,
)
from asbuilt.apps.paper.virtual_robot import DIFFERENCES
from asbuilt.arrays import Array
from asbuilt.description import DHRow, robot_from_dh
from asbuilt.dynamics import link_poses
from asbuilt.tables import Table, stack_tables, wrap_text
from asbuilt.writers import (
    Block,
    add_headline,
    apply_style,
    data_address,
    image_markup,
    list_markup,
    make_blank_figure,
    path_texts,
    render_page,
    save_figure,
    table_markup,
    torque_figure,
)
from asbuilt.writing import atomic_write

SOURCE = (
    "A. A. Hayat, V. Abhishek and S. K. Saha, Dynamic Identification of Manipulator: Comparison"
    " between CAD and Actual Parameters, iNaCoMM 2015-94"
)

ORDER = (
    ("figure1", "figure2", "table1", "table2", "gray_rows"),
    ("simulated_torque", "figure3_simulated", "table3", "figure3", "figure4"),
)
"""Order of tables and figures on the page, by section."""


def describe_outcome(redone: Reproduction) -> list[str]:
    """Return what agrees with the paper and what does not, in one sentence each."""
    simulated = redone.simulated_torque
    identified = float(simulated.rms(simulated.from_identified).max())
    cad = float(simulated.rms(simulated.from_cad).max())
    return [
        f"Table 2: {describe_agreement(redone)}",
        f"Table 1: alpha_7 is a misprint ({redone.paper.alpha_7_printed:g} deg), which would change"
        f" {redone.mismatches_with_printed_alpha} rows of Table 2.",
        f"Simulated torque: predicted from CAD to {cad:.0e} N m RMS, from the parameters identified"
        f" in simulation to {identified:.0e} N m.",
        f"Consistency: {describe_consistency(redone)}",
        f"Gray rows: {describe_highlighted(redone)}",
    ]


def describe_reproduction(redone: Reproduction, full: bool = False) -> str:
    """Return what `asbuilt reproduce` prints; every table if `full`."""
    lines = [wrap_text(SOURCE), "", *map(wrap_text, describe_outcome(redone)), ""]
    tables = [*build_all_tables(redone).values()] if full else [tabulate_torque_errors(redone)]
    return "\n".join(lines) + "\n" + stack_tables(tables, full)


def write_reproduction(folder: Path, redone: Reproduction) -> dict[str, Path]:
    """Write every table as CSV, every figure as PNG, the text and a page with all of them."""
    tables = build_all_tables(redone)
    figures = draw_all_figures(redone)
    page = render_reproduction(redone, tables, figures)
    text = describe_reproduction(redone, True)
    return {
        "page": atomic_write(folder / "reproduction.html", page),
        "text": atomic_write(folder / "reproduction.txt", text),
        **{k: atomic_write(folder / f"{k}.csv", table.as_csv()) for k, table in tables.items()},
        **{k: save_figure(figure, folder / f"{k}.png") for k, figure in figures.items()},
    }


def render_reproduction(
    redone: Reproduction, tables: Mapping[str, Table], figures: Mapping[str, Figure]
) -> str:
    """Return the page with every table and figure, complete in one file."""
    shown = {name: table_markup(table, name) for name, table in tables.items()} | {
        name: image_markup(_encode_png(figure), name) for name, figure in figures.items()
    }
    blocks = (
        Block(heading.lower(), heading, [shown[name] for name in names])
        for heading, names in zip(("CAD", "Robot"), ORDER, strict=True)
    )
    return render_page(
        "The 2015 paper",
        "reproduced",
        [Block("verdict", "Verdict", (list_markup(describe_outcome(redone)),)), *blocks],
        title="The 2015 paper, reproduced",
        subtitle=SOURCE,
    )


def _encode_png(figure: Figure) -> str:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110)
    return data_address(stream.getvalue(), "image/png")


def reproduction_document(redone: Reproduction, files: Mapping[str, Path]) -> dict[str, Any]:
    """Return what `asbuilt reproduce --json` prints."""
    simulated = redone.simulated_torque
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
            "highlighted": [k + 1 for k in redone.paper.highlighted],
            "parameters": [
                {
                    "id": row.id,
                    "printed": row.printed or row.expression,
                    "corrected": row.expression,
                    "ours": row.ours,
                    "cad_printed": row.cad,
                    "cad_ours": row.cad_ours,
                    "tolerance": row.tolerance,
                    "simulated": row.simulated,
                    "robot": row.robot,
                    "virtual_robot": row.virtual_robot,
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
                "installed": list(DIFFERENCES),
                "n_samples": redone.n_logged,
                "cad": redone.rigid_validation.metrics_cad.as_dict(),
                "identified": redone.rigid_validation.metrics_as_built.as_dict(),
                "identified_with_friction": redone.full_validation.metrics_as_built.as_dict(),
            },
            "simulated_torque": {
                "cad": simulated.rms(simulated.from_cad).tolist(),
                "identified": simulated.rms(simulated.from_identified).tolist(),
            },
        },
        "files": path_texts(files),
    }


SHOWN = slice(0, 4)
"""Joints of Figures 3 and 4."""

BENT = (0.3, 0.7, 0.0, -1.3, 0.0, 0.9, 0.0)
"""Pose of Figure 2 [rad]."""

QUIET = "#5F656D"

AXES = ("#D55E00", "#009E73", "#0072B2")
"""Colours of the x, y and z axis of a frame."""


def draw_all_figures(redone: Reproduction) -> dict[str, Figure]:
    """Return every figure by the name of its file."""
    simulated = redone.simulated_torque
    measured = redone.rigid_validation
    names = redone.model.joint_names[SHOWN]

    def torques(t: Array, torque: Array, predicted: Array, label: str, title: str) -> Figure:
        return torque_figure(
            t, torque[:, SHOWN], predicted[:, SHOWN], joint_names=names, title=title, label=label
        )

    return {
        "figure1": draw_frame_figure(
            build_two_link_arm(),
            [0.5, 0.9],
            "Figure 1. Frames, d to the centres of mass and r from them",
        ),
        "figure2": draw_frame_figure(
            redone.model, BENT, "Figure 2. Kinematic model: frames and centres of mass"
        ),
        "figure3_simulated": torques(
            simulated.t,
            simulated.simulated,
            simulated.from_cad,
            "CAD",
            "Figure 3 as its text says: simulated torque, predicted from CAD",
        ),
        "figure3": torques(
            measured.t,
            measured.measured,
            measured.predicted_cad,
            "CAD",
            "Figure 3 as its caption says: virtual robot, predicted from CAD",
        ),
        "figure4": torques(
            measured.t,
            measured.measured,
            measured.predicted,
            "identified",
            "Figure 4: virtual robot, predicted as identified",
        ),
    }


def build_two_link_arm() -> RobotModel:
    """Return a spatial arm of two links for Figure 1."""
    upper = LinkInertia.from_com(2.0, [-0.12, 0.05, 0.06], 0.02 * np.eye(3))
    fore = LinkInertia.from_com(1.0, [-0.2, 0.06, 0.05], 0.01 * np.eye(3))
    rows = [DHRow(a=0.3, b=0.4, alpha=np.pi / 2, inertia=upper), DHRow(a=0.4, inertia=fore)]
    return robot_from_dh(rows, name="spatial two-link arm")


def draw_frame_figure(model: RobotModel, q: Sequence[float], title: str) -> Figure:
    """Draw link frames (x red, y green, z blue) and centres of mass of a robot in a pose."""
    poses = [np.eye(4), *link_poses(model, np.asarray(q))]
    origins = np.array([pose[:3, 3] for pose in poses])
    size = float(np.ptp(origins, axis=0).max())
    with apply_style():
        figure = make_blank_figure(5.6, 5.2)
        axes = figure.add_subplot(projection="3d")
        assert isinstance(axes, Axes3D)
        axes.plot(*origins.T, color="#8A8F98", linewidth=5, solid_capstyle="round", alpha=0.6)
        for pose in poses:
            for axis, colour in enumerate(AXES):
                arrow = 0.14 * size * pose[:3, axis]
                axes.quiver(*pose[:3, 3], *arrow, color=colour, linewidth=1.3)
        for place, names in _name_frames(origins).items():
            axes.text(*place, f"{names}   ", fontsize=8, ha="right", va="top")
        for k, (link, pose) in enumerate(zip(model.links, poses[1:], strict=True), start=1):
            centre = (pose @ np.append(link.inertia.com, 1.0))[:3]
            for start, stop, name in ((origins[k - 1], centre, "d"), (centre, origins[k], "r")):
                axes.plot(*np.stack([start, stop]).T, color=QUIET, linewidth=0.8, linestyle=":")
                if model.n_joints == 2:
                    axes.text(*((start + stop) / 2), f"{name}{k}", fontsize=8, color=QUIET)
            axes.scatter(*centre, color="#E07B20", s=12 * link.inertia.mass, depthshade=False)
            axes.text(*centre, f"   C{k}", fontsize=8, color="#A4540B")
        middle = (origins.min(axis=0) + origins.max(axis=0)) / 2
        for set_limits, centre in zip(
            (axes.set_xlim, axes.set_ylim, axes.set_zlim), middle, strict=True
        ):
            set_limits(centre - 0.55 * size, centre + 0.55 * size)
        axes.set_box_aspect((1, 1, 1), zoom=1.35)
        axes.view_init(elev=16, azim=-62)
        axes.set_axis_off()
        add_headline(figure, title)
    return figure


def _name_frames(origins: Array) -> dict[tuple[float, ...], str]:
    """Return the names of the frames at each place."""
    names: dict[tuple[float, ...], str] = {}
    for k, origin in enumerate(origins):
        place = tuple(np.round(origin, 6).tolist())
        names[place] = f"{names[place]}, O{k}" if place in names else f"O{k}"
    return names
