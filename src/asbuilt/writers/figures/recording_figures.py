"""Figures over time: a recording as it was read, a watched log, a free simulation."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from asbuilt.experiment import FreeMotion, Recording, RecordingCheck
from asbuilt.tables import shorten_text
from asbuilt.workflow.watching.watched_log import WatchedLog, format_torque_unit
from asbuilt.writers.figures.figure_style import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    POINTS,
    VERMILION,
    break_name,
    label_once,
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
            findings = [each for each in check.findings if each.joint == name]
            colour = MARKS[findings[0].severity] if findings else INK
            for axis, values in zip(own, (recording.q, recording.tau), strict=True):
                shown = np.isfinite(values[:, k])
                if np.any(shown):
                    thin = thin_curves(recording.t[shown], values[shown, k], points=POINTS)
                    axis.plot(*thin, color=BLUE, linewidth=0.8)
                for each in check.findings:
                    if each.time is not None and each.joint in (None, name):
                        axis.axvline(each.time, color=MARKS[each.severity], linewidth=1.0)
            own[0].set_ylabel(
                break_name(name, 14), color=colour, rotation=0, ha="right", va="center"
            )
        for axis, last, title in zip(
            axes, axes[-2:], ("position [rad or m]", "torque as logged"), strict=False
        ):
            axis.set_title(title)
            last.set_xlabel("time [s]")
    return figure


COLOURS = {"contact": VERMILION, "fault": ORANGE, "payload": "#009E73"}


def watch_figure(watched: WatchedLog, *, narrow: bool = False) -> Figure:
    """Draw the residual of every joint in its thresholds, with the events marked.

    A narrow figure is for screens as wide as a telephone's.
    """
    # 600: bins of a narrow figure.
    trace, n = watched.trace.thinned(600) if narrow else watched.trace, len(watched.joint_names)
    start, last = float(trace.t.min()), float(trace.t.max())
    subject = f"external torque [{format_torque_unit(watched.units)}] and its thresholds"
    title = subject if narrow else f"{watched.robot}: {subject}"
    mixed, width = len(set(watched.units)) > 1, 3.9 if narrow else 8.6
    with open_figure(width, 0.95 * n + 0.9, title, rows=n, sharex=True) as (figure, axes):
        for j, (axis, name) in enumerate(zip(axes, watched.joint_names, strict=True)):
            t, limit, residual = trace.t[:, j], trace.limit[:, j], trace.residual[:, j]
            axis.fill_between(
                t, -limit, limit, color="#E9ECEF", linewidth=0.0, label="within threshold"
            )
            axis.plot(t, np.stack([limit, -limit], axis=1), color=GREY, linewidth=0.5)
            axis.plot(t, residual, color=BLUE, linewidth=0.8, label="external torque")
            for event in watched.events:
                if name in event.joints:
                    # Least width of an event, per length of the log.
                    end = event.start + max(event.duration, 0.004 * (last - start))
                    axis.axvspan(
                        event.start,
                        end,
                        label=event.kind,
                        color=COLOURS[event.kind],
                        alpha=0.3,
                        linewidth=0.0,
                    )
            tallest = 1.25 * float(max(np.abs(residual).max(), np.quantile(limit, 0.5)))
            label = f"{name} [{watched.units[j]}]" if mixed else name
            axis.set(ylim=(-tallest, tallest), ylabel=break_name(label, 12))
        axes[-1].set(xlabel="time [s]", xlim=(start, last))
        label_once(figure, axes, loc="outside lower right", ncols=2 if narrow else 5)
    return figure


def energy_figure(motion: FreeMotion, *, title: str = "") -> Figure:
    """Draw positions and energies of a free simulation.

    Kinetic, potential and total energy, with the work of the drives and the loss to friction.
    """
    model, t = motion.model, motion.t
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
