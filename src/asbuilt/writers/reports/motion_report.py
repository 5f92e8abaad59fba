"""Page of a designed motion: joints and their limits, path of the tool, margins, information."""

from __future__ import annotations

import io
import os
from pathlib import Path

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure
from PIL import Image

from asbuilt.dynamics import described_drive, drive_torque, inverse_dynamics
from asbuilt.excitation import Design, MotionBounds, StaticDesign, design_findings
from asbuilt.excitation.information.information import complete_limits
from asbuilt.writers.figures.figure_style import encode_figure, open_figure
from asbuilt.writers.files import atomic_write, data_address
from asbuilt.writers.pictures.motion_view import MotionView
from asbuilt.writers.pictures.skeleton import draw_skeleton_frames
from asbuilt.writers.reports.page import (
    Block,
    facts_markup,
    image_markup,
    list_markup,
    render_page,
    section_markup,
    table_markup,
)
from asbuilt.writers.tables.design_tables import (
    describe_margins,
    design_facts,
    design_table,
    design_title,
    tabulate_margins,
)

POINTS = 400
"""Points of a curve; the page stays below 2 MB."""

JOINTS = """\
<div class="grid">
{% for name, image in joints %}
<figure><h3>{{ name }}</h3><img class="drawn" src="{{ image }}" alt="Position, velocity,\
 acceleration and torque of {{ name }} over time, with limits"></figure>
{% endfor %}
</div>
<p class="quiet">Dashed: limits. The torque follows the description, drive values included.</p>
"""
CURVE = "#0072b2"
LIMIT = "#b3261e"


def write_motion_report(path: str | os.PathLike[str], design: Design | StaticDesign) -> Path:
    """Write the page of a designed motion as a self-contained HTML file."""
    return atomic_write(path, render_motion(design))


def render_motion(design: Design | StaticDesign) -> str:
    """Return the page of a designed motion; it needs no network, and every name is escaped."""
    limits = design.limits
    remarks = [
        ("" if limits.is_respected else "bad", describe_margins(limits)),
        *(
            ("" if finding.severity == "info" else "bad", finding.message)
            for finding in design_findings(design)
        ),
    ]
    title = "Predicted standard errors" if isinstance(design, Design) else "Poses"
    drawn = zip(
        design.model.joint_names, map(encode_figure, draw_joint_figures(design)), strict=True
    )
    return render_page(
        design.model.name,
        design_title(design),
        [
            Block(
                "verdict",
                "Verdict",
                (
                    list_markup(remarks),
                    facts_markup(design_facts(design)),
                    table_markup(tabulate_margins(limits), "margins"),
                ),
            ),
            Block("path", "Path of the tool", (_draw_path(design),), "Path"),
            Block(
                "joints-drawn",
                "Joints and their limits",
                (section_markup(JOINTS, {"joints": drawn}),),
                "Joints",
            ),
            Block("parameters", title, (table_markup(design_table(design), "rows"),)),
        ],
        title=f"{design.model.name}: designed motion",
    )


def draw_joint_figures(design: Design | StaticDesign) -> list[Figure]:
    """Draw position, velocity, acceleration and torque of each joint against their limits."""
    model = design.model
    motion = design.motion
    bounds = MotionBounds.of(complete_limits(model)[0])
    t = np.linspace(0.0, motion.duration, POINTS)
    q, qd, qdd = motion.at(t)
    drive, values = described_drive(model)
    rigid = inverse_dynamics(model, q, qd, qdd)
    torque = rigid + drive_torque(drive, values, q, qd, qdd, load=rigid, shares=model.motor_shares)
    upper = (bounds.upper, bounds.velocity, bounds.acceleration, bounds.torque)
    lower = (bounds.lower, *(-limit for limit in upper[1:]))
    figures = []
    for j, joint in enumerate(model.joints):
        unit, of_torque = ("rad", "N m") if joint.is_revolute else ("m", "N")
        names = (
            f"position\n{unit}",
            f"velocity\n{unit}/s",
            f"acceleration\n{unit}/s\u00b2",
            f"torque\n{of_torque}",
        )
        with open_figure(4.6, 5.4, rows=4, sharex=True) as (figure, all_axes):
            curves = zip(all_axes, (q, qd, qdd, torque), lower, upper, names, strict=True)
            for axes, x, low, high, name in curves:
                axes.plot(t, x[:, j], color=CURVE, linewidth=1.1)
                for limit in (low[j], high[j]):
                    if np.isfinite(limit):
                        axes.axhline(limit, color=LIMIT, linewidth=0.9, linestyle=(0, (4, 2)))
                axes.set_ylabel(name)
                axes.margins(x=0.0)
            all_axes[-1].set_xlabel("time [s]")
            figure.align_ylabels(all_axes)
        figures.append(figure)
    return figures


def _draw_path(design: Design | StaticDesign) -> Markup:
    """Return a drawing of the skeleton at the start and the path of the tool."""
    view = MotionView.of_motion(design.model, design.motion, most=2).first()
    stream = io.BytesIO()
    Image.fromarray(next(draw_skeleton_frames(view, 900, 675))).save(stream, "PNG")
    return image_markup(
        data_address(stream.getvalue(), "image/png"),
        "The robot at the start of the motion, and the path of its tool in space",
    )
