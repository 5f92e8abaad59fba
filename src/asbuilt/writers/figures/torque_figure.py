"""Figure of measured and predicted torque, after Figures 3 and 4 of the 2015 paper."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
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


def _rms(error: ArrayLike) -> str:
    return significant(float(np.sqrt(np.mean(np.square(error)))))
