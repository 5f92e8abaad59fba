"""Figures over time: a recording, a free simulation, torque predicted, and a sweep of the cutoff.

The figure of torque is after Figures 3 and 4 of the 2015 paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator, ScalarFormatter

from asbuilt.arrays import Array
from asbuilt.experiment import FreeMotion, Recording, RecordingCheck
from asbuilt.tables import round_significant, shorten_text
from asbuilt.workflow.cutoff_sweep import CutoffSweep
from asbuilt.writers.figures.figure_style import (
    AS_BUILT,
    BLUE,
    CAD,
    GREEN,
    GREY,
    INK,
    MEASURED,
    ORANGE,
    POINTS,
    VERMILION,
    break_name,
    open_figure,
    thin_curves,
)


def torque_figure(
    t: Array,
    measured: Array,
    predicted: Array,
    *,
    cad: Array | None = None,
    label: str = "as built",
    joint_names: Sequence[str] = (),
    units: Sequence[str] = (),
    title: str = "",
) -> Figure:
    """Draw measured and predicted torque and their difference, a row per joint.

    Long recordings are thinned by minimum and maximum; gaps in time stay gaps.

    Parameters
    ----------
    t
        Time [s], shape (N,).
    measured, predicted
        Torques [N m or N], shape (N, n).
    cad
        Prediction by CAD, whose error is drawn too.
    label
        Name of the parameters that predicted.
    joint_names, units
        Names and torque units of the joints.
    title
        Headline.
    """
    n = measured.shape[1]
    names = list(joint_names) or [f"joint {k + 1}" for k in range(n)]
    kinds = list(units) or ["N m"] * n
    shape = {"rows": n, "columns": 2, "sharex": True, "width_ratios": (3, 2)}
    legend_place = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.2}
    narrow = {"handlelength": 1.2, "columnspacing": 1.2, "borderaxespad": 0.1, "fontsize": 7.5}
    with open_figure(10.5, 1.25 * n + 0.95, title, **shape) as (figure, axes):
        lefts = axes[::2]
        rights = axes[1::2]
        for k, (left, right) in enumerate(zip(lefts, rights, strict=True)):
            by_cad = None if cad is None else cad[:, k]
            draw_torque(left, t, measured[:, k], predicted[:, k], label, cad=by_cad)
            left.set_ylabel(label_torque_axis(names[k], kinds[k]))
            draw_errors(right, t, measured[:, k], predicted[:, k], label, cad=by_cad)
            low, high = right.get_ylim()
            right.set_ylim(low, high + 0.45 * (high - low))
            right.legend(loc="upper left", ncols=2, **narrow)
        for axis in axes:
            axis.yaxis.set_major_locator(MaxNLocator(4))
            axis.margins(x=0.01)
        for column, name in ((lefts, "Torque"), (rights, "Error (measured - predicted)")):
            column[0].set_title(name)
            column[-1].set_xlabel("time [s]")
        lefts[0].legend(ncols=2, **legend_place)
        figure.align_ylabels(lefts)
    return figure


def draw_torque(
    axis: Axes,
    t: Array,
    measured: Array,
    predicted: Array,
    label: str = "as built",
    *,
    cad: Array | None = None,
) -> None:
    """Draw measured and predicted torque (N,), thinned as the prediction by `cad` is."""
    others = () if cad is None else (cad,)
    instants, torque, modelled, *_ = thin_curves(t, measured, predicted, *others, points=POINTS)
    axis.plot(instants, torque, color=MEASURED, linewidth=1.5, label="measured")
    dashed: dict[str, Any] = {"linewidth": 0.9, "linestyle": (0, (4, 1.6))}
    axis.plot(instants, modelled, color=AS_BUILT, label=f"predicted, {label}", **dashed)


def draw_errors(
    axis: Axes,
    t: Array,
    measured: Array,
    predicted: Array,
    label: str = "as built",
    *,
    cad: Array | None = None,
) -> None:
    """Draw measured less predicted torque (N,), with CAD's error behind it."""
    shown = [
        (name, measured - curve, colour, width)
        for name, curve, colour, width in (
            ("CAD", cad, CAD, 0.8),
            (label, predicted, GREEN, 0.9),
        )
        if curve is not None
    ]
    instants, *thin = thin_curves(t, *(error for _, error, *_ in shown), points=POINTS)
    for (name, error, colour, width), curve in zip(shown, thin, strict=True):
        rms = f"RMS {round_significant(float(np.sqrt(np.mean(np.square(error)))))}"
        axis.plot(instants, curve, color=colour, linewidth=width, label=f"{name}, {rms}")
    axis.axhline(0.0, color=INK, linewidth=0.5)


def label_torque_axis(joint: str, unit: str) -> str:
    """Return the label of a joint's axis."""
    return f"{break_name(joint, 14)}\n[{unit}]"


def cutoff_figure(sweep: CutoffSweep, *, title: str = "") -> Figure:
    """Draw held-out error and the whiteness of the residual against the cutoff."""
    cutoffs = [trial.cutoff for trial in sweep.trials]
    with open_figure(7.0, 4.6, title, rows=2, sharex=True, height_ratios=(3, 2)) as opened:
        figure, (upper, lower) = opened
        right = lower.twinx()
        for axis, name, factor, colour, mark, size, style, label in (
            (upper, "score", 1, VERMILION, "o", 4, "-", "against unfiltered torque"),
            (upper, "in_band", 1, GREY, "o", 3, "--", "against filtered torque"),
            (lower, "durbin_watson", 1, BLUE, "o", 4, "-", ""),
            (right, "effective_share", 100, GREEN, "s", 3, "-", ""),
        ):
            values = [factor * getattr(trial, name) for trial in sweep.trials]
            axis.plot(
                cutoffs,
                values,
                label=label,
                color=colour,
                marker=mark,
                markersize=size,
                linestyle=style,
            )
        upper.set_ylabel("held-out error,\nrelative to the best")
        upper.legend(loc="best")
        # Held-out error, relative to the best, above which the axis is logarithmic.
        if max(trial.score for trial in sweep.trials) > 4.0:
            upper.set_yscale("log")
            upper.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            upper.yaxis.set_major_formatter(ScalarFormatter())
            upper.yaxis.set_minor_locator(NullLocator())
        right.set_ylabel("independent samples\n[% of white]", color=GREEN)
        right.set_ylim(bottom=0.0)
        right.grid(visible=False)
        lower.set_ylabel("Durbin-Watson\n(white: 2)", color=BLUE)
        lower.set_ylim(bottom=0.0)
        lower.set(xscale="log", xlabel="cutoff [Hz]")
        lower.set_xticks(cutoffs, [round_significant(cutoff, 2) for cutoff in cutoffs])
        lower.minorticks_off()
        for axis in (upper, lower):
            axis.axvline(sweep.chosen, color=VERMILION, linewidth=0.8, linestyle=":")
    return figure


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
