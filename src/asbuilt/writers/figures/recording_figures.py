"""Figures over time: a recording as it was read, a free simulation."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from asbuilt.experiment import FreeMotion, Recording, RecordingCheck
from asbuilt.tables import shorten_text
from asbuilt.writers.figures.figure_style import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    POINTS,
    VERMILION,
    break_name,
    open_figure,
)
from asbuilt.writers.figures.thinning import thin_curves

MARKS = {"error": VERMILION, "warning": ORANGE, "info": GREY}
"""Colours of findings by severity."""


def draw_recording(recording: Recording, check: RecordingCheck) -> Figure:
    """Draw position and torque of every joint over time.

    Joints that a finding names have their name in its colour, with a line where it begins.
    """
    n = len(recording.joint_names)
    with open_figure(8.6, 0.9 * n + 0.8, rows=n, columns=2, sharex=True) as (figure, axes):
        for k, name in enumerate(recording.joint_names):
            own = axes[2 * k : 2 * k + 2]
            findings = [finding for finding in check.findings if finding.joint == name]
            colour = MARKS[findings[0].severity] if findings else INK
            for axis, values in zip(own, (recording.q, recording.tau), strict=True):
                shown = np.isfinite(values[:, k])
                if np.any(shown):
                    thin = thin_curves(recording.t[shown], values[shown, k], points=POINTS)
                    axis.plot(*thin, color=BLUE, linewidth=0.8)
                for finding in check.findings:
                    if finding.time is not None and finding.joint in (None, name):
                        axis.axvline(finding.time, color=MARKS[finding.severity], linewidth=1.0)
            own[0].set_ylabel(
                break_name(name, 14), color=colour, rotation=0, ha="right", va="center"
            )
        for axis, last, title in zip(
            axes, axes[-2:], ("position [rad or m]", "torque as logged"), strict=False
        ):
            axis.set_title(title)
            last.set_xlabel("time [s]")
    return figure


def energy_figure(motion: FreeMotion, *, title: str = "") -> Figure:
    """Draw positions and energies of a free simulation.

    Kinetic, potential and total energy, with the work of the drives and the loss to friction.
    """
    model = motion.model
    t = motion.t
    turning = [joint.is_revolute for joint in model.joints]
    unit = "rad" if all(turning) else "m" if not any(turning) else "rad, m"
    legend_place = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.0)}
    colours = mpl.colormaps["viridis"](np.linspace(0.0, 0.9, model.n_joints))
    balance = motion.total[0] + motion.work - motion.dissipated
    curves = [
        (motion.kinetic, BLUE, "-", 1.2, "kinetic"),
        (motion.potential, GREEN, "-", 1.2, "potential, 0 at the start"),
        (motion.total, INK, "-", 1.8, "kinetic + potential"),
        (balance, ORANGE, (0, (3, 2)), 1.2, "start + work - friction"),
        (motion.dissipated, VERMILION, "-", 1.2, "dissipated by friction"),
    ]
    with open_figure(
        8.5,
        5.2,
        title or f"{model.name}: {motion.release}",
        rows=2,
        sharex=True,
        height_ratios=(2, 3),
    ) as (figure, (above, below)):
        for name, q, colour in zip(
            model.joint_names, (motion.q - motion.q[0]).T, colours, strict=True
        ):
            above.plot(
                *thin_curves(t, q, points=POINTS), color=colour, label=shorten_text(name, 20)
            )
        above.set_ylabel(f"moved [{unit}]")
        above.legend(handlelength=1.2, **legend_place)
        for values, colour, style, width, label in curves:
            below.plot(
                *thin_curves(t, values, points=POINTS),
                label=label,
                color=colour,
                linestyle=style,
                linewidth=width,
            )
        below.set(xlabel="time [s]", ylabel="energy [J]")
        below.margins(x=0.01)
        legend = below.legend(handlelength=1.6, **legend_place)
        legend.set_title(f"energy balance to {motion.imbalance:.0e}", prop={"size": 8})
        legend.set_alignment("left")
    return figure
