"""Figure of measured and predicted torque, after Figures 3 and 4 of the 2015 paper."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.tables import significant
from asbuilt.writers.figures.figure_style import (
    AS_BUILT,
    CAD,
    GREEN,
    INK,
    MEASURED,
    POINTS,
    blank_figure,
    broken,
    headline,
    styled,
)
from asbuilt.writers.figures.thinning import thinned


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
    with styled():
        figure = blank_figure(10.5, 1.25 * n + 0.95)
        axes = figure.subplots(n, 2, sharex=True, squeeze=False, width_ratios=(3, 2))
        for k in range(n):
            left, right = axes[k]
            by_cad = None if cad is None else cad[:, k]
            draw_torque(left, t, measured[:, k], predicted[:, k], label, beside=by_cad)
            left.set_ylabel(torque_label(names[k], kinds[k]))
            draw_errors(right, t, measured[:, k], predicted[:, k], label, cad=by_cad)
            low, high = right.get_ylim()
            right.set_ylim(low, high + 0.45 * (high - low))
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


def draw_torque(
    axis: Axes,
    t: Array,
    measured: Array,
    predicted: Array,
    label: str = "as built",
    *,
    beside: Array | None = None,
) -> None:
    """Draw measured and predicted torque (N,), thinned as a curve `beside` them."""
    curves = [measured, predicted] + ([] if beside is None else [beside])
    instants, *thin = thinned(t, *curves, points=POINTS)
    axis.plot(instants, thin[0], color=MEASURED, linewidth=1.5, label="measured")
    axis.plot(
        instants,
        thin[1],
        color=AS_BUILT,
        linewidth=0.9,
        linestyle=(0, (4, 1.6)),
        label=f"predicted, {label}",
    )


def draw_errors(
    axis: Axes,
    t: Array,
    measured: Array,
    predicted: Array,
    label: str = "as built",
    *,
    cad: Array | None = None,
) -> None:
    """Draw measured less predicted torque (N,), and that of CAD behind it."""
    differences = [measured - curve for curve in (predicted, cad) if curve is not None]
    instants, *thin = thinned(t, *differences, points=POINTS)
    if cad is not None:
        axis.plot(
            instants, thin[1], color=CAD, linewidth=0.8, label=f"CAD, RMS {_rms(differences[1])}"
        )
    axis.plot(
        instants, thin[0], color=GREEN, linewidth=0.9, label=f"{label}, RMS {_rms(differences[0])}"
    )
    axis.axhline(0.0, color=INK, linewidth=0.5)


def torque_label(joint: str, unit: str) -> str:
    """Return the label of a joint's axis."""
    return f"{broken(joint, 14)}\n[{unit}]"


def _rms(error: ArrayLike) -> str:
    return significant(float(np.sqrt(np.mean(np.square(error)))))
