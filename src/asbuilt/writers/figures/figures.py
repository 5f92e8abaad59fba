"""Figures for papers and reports, drawn with matplotlib's objects, without a global figure."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.experiment.virtual.free_motion import FreeMotion
from asbuilt.tables import plus_minus, shortened, significant
from asbuilt.validation.residuals import ResidualAnalysis, VelocityCurve
from asbuilt.writers.figures.figure_style import (
    AS_BUILT,
    BLUE,
    CAD,
    GREEN,
    INK,
    MEASURED,
    ORANGE,
    QUIET,
    VERMILION,
    blank_figure,
    broken,
    headline,
    styled,
)
from asbuilt.writers.figures.thinning import thinned

POINTS = 4000
"""About how many points a curve is drawn with."""


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
    """Draw measured and predicted torque and their difference, a row per joint, in the manner of
    the paper's Figures 3 and 4.

    `t` (N,) [s], torques (N, n); `label` says which parameters predicted; `cad` adds the error of
    the CAD prediction. Gaps in `t` stay gaps; long recordings are thinned by minimum and maximum,
    so peaks stay. Source: Hayat, Abhishek and Saha (2015), Figures 3 and 4.
    """
    n = measured.shape[1]
    names, kinds = _joint_labels(joint_names, n), list(units) or ["N m"] * n
    with styled():
        figure = blank_figure(10.5, 1.25 * n + 0.95)
        axes = figure.subplots(n, 2, sharex=True, squeeze=False, width_ratios=(3, 2))
        for k in range(n):
            left, right = axes[k]
            curves = [measured[:, k], predicted[:, k]] + ([] if cad is None else [cad[:, k]])
            instants, *thin = thinned(t, *curves, points=POINTS)
            left.plot(instants, thin[0], color=MEASURED, linewidth=1.5, label="measured")
            left.plot(
                instants,
                thin[1],
                color=AS_BUILT,
                linewidth=0.9,
                linestyle=(0, (4, 1.6)),
                label=f"predicted, {label}",
            )
            left.set_ylabel(f"{broken(names[k], 14)}\n[{kinds[k]}]")
            differences = [measured[:, k] - curve for curve in curves[1:]]
            instants, *thin = thinned(t, *differences, points=POINTS)
            if cad is not None:
                right.plot(
                    instants,
                    thin[1],
                    color=CAD,
                    linewidth=0.8,
                    label=f"CAD, RMS {_rms(differences[1])}",
                )
            right.plot(
                instants,
                thin[0],
                color=GREEN,
                linewidth=0.9,
                label=f"{label}, RMS {_rms(differences[0])}",
            )
            right.axhline(0.0, color=INK, linewidth=0.5)
            _head_room(right, 0.45)
            right.legend(
                loc="upper left",
                ncols=2,
                handlelength=1.2,
                columnspacing=1.2,
                borderaxespad=0.1,
                fontsize=7.5,
            )
            for axis in (left, right):
                axis.yaxis.set_major_locator(MaxNLocator(4))
                axis.margins(x=0.01)
        axes[0, 0].set_title("Torque")
        axes[0, 1].set_title("Error (measured - predicted)")
        axes[0, 0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, borderaxespad=0.2)
        for axis in axes[-1]:
            axis.set_xlabel("time [s]")
        figure.align_ylabels(axes[:, 0])
        headline(figure, title)
    return figure


def parameter_figure(
    names: Sequence[str],
    estimate: Array,
    std_error: Array,
    cad: Array,
    *,
    units: Sequence[str] = (),
    ids: Sequence[int] = (),
    title: str = "",
) -> Figure:
    """Draw every parameter's CAD value and as-built value with its 95 % interval, each row scaled
    to its own largest magnitude.

    Arrays have shape (p,); `cad` is NaN where the description is silent. The value stands at the
    right of its row.
    """
    p = len(names)
    half = 1.96 * np.where(np.isfinite(std_error), std_error, 0.0)
    scale = np.fmax(np.abs(estimate), np.fmax(np.abs(np.nan_to_num(cad)), 0.8 * half))
    scale[scale == 0] = 1.0
    split = 1 if p <= 24 else 2
    rows = -(-p // split)
    with styled():
        figure = blank_figure(4.4 * split + 1.2, 0.19 * rows + 1.1)
        axes = figure.subplots(1, split, squeeze=False)[0]
        for part, axis in enumerate(axes):
            members = list(range(part * rows, min(p, (part + 1) * rows)))
            place = np.arange(len(members))
            axis.axvline(0.0, color="#9AA0A6", linewidth=0.7)
            axis.hlines(
                place,
                np.nan_to_num(cad[members] / scale[members]),
                estimate[members] / scale[members],
                color="#D5D9DE",
                linewidth=0.8,
            )
            axis.plot(
                cad[members] / scale[members],
                place,
                "o",
                color="white",
                markeredgecolor=INK,
                markersize=4.2,
                label="CAD",
                zorder=3,
            )
            axis.errorbar(
                estimate[members] / scale[members],
                place,
                xerr=half[members] / scale[members],
                fmt="o",
                color=AS_BUILT,
                markersize=3.4,
                elinewidth=1.1,
                capsize=2.0,
                label="as built, 95 % interval",
                zorder=4,
            )
            labels = [
                f"{ids[i]}  {shortened(names[i], 30)}" if len(ids) else shortened(names[i], 30)
                for i in members
            ]
            axis.set_yticks(place, labels, fontsize=7)
            axis.set_ylim(rows - 0.4, -0.6)
            axis.set_xlim(-1.35, 1.35)
            axis.set_xticks([-1, -0.5, 0, 0.5, 1])
            axis.grid(axis="y", visible=False)
            axis.tick_params(axis="y", length=0)
            for row, i in zip(place, members, strict=True):
                unit = f" {units[i].replace('^2', '²')}" if len(units) else ""
                text = f"{plus_minus(float(estimate[i]), float(std_error[i]))}{unit}"
                axis.text(
                    1.02,
                    float(row),
                    text,
                    transform=axis.get_yaxis_transform(),
                    fontsize=6.5,
                    va="center",
                    color=QUIET,
                )
            axis.set_xlabel("value / largest magnitude of the row")
        _legend_above(axes[0])
        headline(figure, title)
    return figure


def singular_value_figure(
    singular_values: Array, *, rank: int | None = None, title: str = ""
) -> Figure:
    """Draw singular values (p,), largest first, on a logarithmic axis.

    Those beyond `rank` are marked as lost.
    """
    s = np.asarray(singular_values, dtype=np.float64)
    kept = len(s) if rank is None else rank
    floor = np.max(s, initial=1.0) * 1e-17
    number = np.arange(1, len(s) + 1)
    with styled():
        figure = blank_figure(6.0, 3.0)
        axis = figure.subplots()
        axis.semilogy(
            number[:kept],
            np.fmax(s[:kept], floor),
            "o",
            color=BLUE,
            markersize=4,
            label=f"determined ({kept})",
        )
        if kept < len(s):
            axis.semilogy(
                number[kept:],
                np.fmax(s[kept:], floor),
                "x",
                color=AS_BUILT,
                markersize=5,
                label=f"not determined ({len(s) - kept})",
            )
        if kept:
            axis.text(
                0.99,
                0.96,
                f"largest / smallest = {significant(s[0] / s[kept - 1])}",
                transform=axis.transAxes,
                ha="right",
                va="top",
            )
        axis.set_xlabel("number")
        axis.set_ylabel("singular value")
        axis.xaxis.set_major_locator(MaxNLocator(integer=True))
        _plain_log(axis.yaxis)
        axis.legend(loc="lower left")
        headline(figure, title)
    return figure


def residual_figure(
    residual: Array, analysis: ResidualAnalysis, *, units: Sequence[str] = (), title: str = ""
) -> Figure:
    """Draw each joint's torque error (N, n).

    Histogram beside the normal curve of equal mean and RMS, autocorrelation, spectrum.
    """
    n = residual.shape[1]
    kinds = list(units) or ["N m"] * n
    names = _joint_labels(analysis.joint_names, n)
    band = 1.96 / np.sqrt(analysis.n_samples)
    with styled():
        figure = blank_figure(10.5, 1.45 * n + 0.9)
        axes = figure.subplots(n, 3, squeeze=False, sharex="col")
        for k in range(n):
            histogram, correlation, spectrum = axes[k]
            mean, spread = float(analysis.mean[k]), float(np.std(residual[:, k])) or 1.0
            z = (residual[:, k] - mean) / spread
            histogram.hist(
                np.clip(z, -5, 5),
                bins=np.linspace(-5, 5, 61),
                density=True,
                color="#9CC7E3",
                linewidth=0,
            )
            grid = np.linspace(-5, 5, 201)
            histogram.plot(
                grid, np.exp(-0.5 * grid**2) / np.sqrt(2 * np.pi), color=INK, linewidth=0.9
            )
            histogram.set_yticks([])
            histogram.set_ylabel(broken(names[k], 14))
            note = f"{significant(mean, 2)} +/- {significant(spread, 2)} {kinds[k]}"
            histogram.text(
                0.99, 0.97, note, transform=histogram.transAxes, ha="right", va="top", fontsize=7.5
            )
            correlation.fill_between(analysis.lags, -band, band, color="#E4E7EB", linewidth=0)
            correlation.plot(analysis.lags, analysis.autocorrelation[:, k], color=BLUE)
            correlation.axhline(0.0, color=INK, linewidth=0.5)
            correlation.set_ylim(-0.6, 1.05)
            worth = (
                f"worth {significant(analysis.effective_samples[k])} of {analysis.n_samples}"
                " samples"
            )
            correlation.text(
                0.99,
                0.97,
                worth,
                transform=correlation.transAxes,
                ha="right",
                va="top",
                fontsize=7.5,
            )
            density = analysis.spectrum[1:, k]
            if np.any(density > 0):
                spectrum.loglog(
                    analysis.frequencies[1:], np.sqrt(density), color=BLUE, linewidth=0.8
                )
            _plain_log(spectrum.xaxis)
            _plain_log(spectrum.yaxis)
            spectrum.set_ylabel(f"{kinds[k]} / √Hz")
        for axis, head, below in zip(
            axes[0],
            ("Distribution", "Autocorrelation", "Spectrum"),
            ("error / standard deviation", "lag [s]", "frequency [Hz]"),
            strict=True,
        ):
            axis.set_title(head)
            axes[-1, list(axes[0]).index(axis)].set_xlabel(below)
        headline(figure, title)
    return figure


def friction_figure(
    qd: Array,
    torque: Array,
    curves: Sequence[VelocityCurve],
    *,
    model: Array | None = None,
    joint_names: Sequence[str] = (),
    units: Sequence[str] = (),
    velocity_units: Sequence[str] = (),
    title: str = "",
) -> Figure:
    """Draw what the drive takes against joint velocity.

    Samples, median and quartiles per velocity bin, the identified law.

    `qd`, `torque` and `model` have shape (N, n): velocity, measured torque less rigid-body torque,
    and the identified drive torque.
    """
    n = torque.shape[1]
    names, kinds = _joint_labels(joint_names, n), list(units) or ["N m"] * n
    speeds = list(velocity_units) or ["rad/s"] * n
    wide = min(n, 4)
    high = -(-n // wide)
    with styled():
        figure = blank_figure(2.75 * wide + 0.3, 2.35 * high + 0.75)
        axes = figure.subplots(high, wide, squeeze=False)
        for k, axis in enumerate(axes.flat):
            if k >= n:
                axis.set_visible(False)
                continue
            keep = slice(None, None, max(1, len(qd) // 3000))
            axis.plot(
                qd[keep, k],
                torque[keep, k],
                ".",
                color="#B9D7EA",
                markersize=1.4,
                rasterized=True,
                label="samples",
            )
            curve = curves[k]
            for side in (curve.velocity < 0, curve.velocity > 0):
                axis.fill_between(
                    curve.velocity[side],
                    curve.lower[side],
                    curve.upper[side],
                    color=BLUE,
                    alpha=0.3,
                    linewidth=0,
                    zorder=3,
                )
                axis.plot(
                    curve.velocity[side],
                    curve.median[side],
                    color=BLUE,
                    linewidth=1.4,
                    label="median, quartiles" if side[-1] else None,
                )
            if model is not None:
                order = np.argsort(qd[:, k])
                speed, law = qd[order, k], model[order, k].copy()
                for sign in (speed < 0, speed > 0):
                    pick = np.unique(np.linspace(0, max(int(sign.sum()) - 1, 0), 200).astype(int))
                    if sign.any():
                        label = "identified" if sign[-1] else None
                        axis.plot(
                            speed[sign][pick],
                            law[sign][pick],
                            color=AS_BUILT,
                            linewidth=1.3,
                            linestyle=(0, (5, 1.5)),
                            label=label,
                        )
            low, high_torque = np.percentile(torque[:, k], [0.5, 99.5])
            room = 0.35 * (high_torque - low) or 1.0
            axis.set_ylim(low - room, high_torque + room)
            axis.axhline(0.0, color="#9AA0A6", linewidth=0.6)
            axis.set_title(f"{shortened(names[k], 22)} [{kinds[k]}]")
            axis.set_xlabel(f"velocity [{speeds[k]}]")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper right", ncols=3, markerscale=5)
        headline(figure, title)
    return figure


def energy_figure(motion: FreeMotion, *, title: str = "") -> Figure:
    """Draw a free motion: joint positions, and kinetic, potential and total energy with what the
    drives put in and friction takes out.
    """
    model, t = motion.model, motion.t
    turning = [joint.is_revolute for joint in model.joints]
    with styled():
        figure = blank_figure(8.5, 5.2)
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2, 3))
        colours = mpl.colormaps["viridis"](np.linspace(0.0, 0.9, model.n_joints))
        for name, positions, colour in zip(
            model.joint_names, (motion.q - motion.q[0]).T, colours, strict=True
        ):
            above.plot(
                *thinned(t, positions, points=POINTS), color=colour, label=shortened(name, 20)
            )
        above.set_ylabel(
            f"moved [{'rad' if all(turning) else 'm' if not any(turning) else 'rad, m'}]"
        )
        above.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), handlelength=1.2)
        curves = [
            (motion.kinetic, BLUE, "-", "kinetic"),
            (motion.potential, GREEN, "-", "potential, 0 at the start"),
            (motion.total, INK, "-", "kinetic + potential"),
            (
                motion.total[0] + motion.work - motion.dissipated,
                ORANGE,
                (0, (3, 2)),
                "start + work - friction",
            ),
            (motion.dissipated, VERMILION, "-", "taken by friction"),
        ]
        for values, colour, style, label in curves:
            wide = 1.8 if label == "kinetic + potential" else 1.2
            below.plot(
                *thinned(t, values, points=POINTS),
                color=colour,
                linestyle=style,
                linewidth=wide,
                label=label,
            )
        below.set_ylabel("energy [J]")
        below.set_xlabel("time [s]")
        below.margins(x=0.01)
        legend = below.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), handlelength=1.6)
        legend.set_title(f"energy balance to {motion.imbalance:.0e}", prop={"size": 8})
        legend.set_alignment("left")
        headline(figure, title or f"{model.name}: {motion.release}")
    return figure


def _joint_labels(joint_names: Sequence[str], n: int) -> list[str]:
    return list(joint_names) or [f"joint {k + 1}" for k in range(n)]


def _rms(error: ArrayLike) -> str:
    return significant(float(np.sqrt(np.mean(np.square(error)))))


def _plain_log(axis: Axis) -> None:
    axis.set_major_locator(LogLocator(numticks=6))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _head_room(axis: Axes, fraction: float) -> None:
    low, high = axis.get_ylim()
    axis.set_ylim(low, high + fraction * (high - low))


def _legend_above(axis: Axes) -> None:
    axis.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, borderaxespad=0.2)
