"""Figures of the causes of the CAD error, and of the differences with the most torque."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from asbuilt.tables import significant
from asbuilt.validation.attribution.attribution import Attribution
from asbuilt.validation.attribution.causes import CAUSES
from asbuilt.validation.comparison.comparison import Comparison
from asbuilt.writers.figures.figure_style import (
    AS_BUILT,
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    QUIET,
    blank_figure,
    broken,
    headline,
    styled,
)

CAUSE_COLOURS: dict[str, str] = {
    "offset": "#F0E442",
    "friction": BLUE,
    "richer friction": "#56B4E9",
    "armature": "#CC79A7",
    "payload": AS_BUILT,
    "mounting": GREEN,
    "gain": ORANGE,
    "links": "#7A6A53",
}
"""One colour per cause, after Okabe and Ito (2008)."""
UNEXPLAINED = "#D5D9DE"
LABELLED = 0.035
"""Smallest share that is labelled with its number, as a part of the axis."""
CUT = 3.0
"""Share at which the axis ends: at a joint with almost no error the causes cancel, and their shares
have no bound."""


def attribution_figure(attribution: Attribution, *, title: str = "") -> Figure:
    """Draw the shares of the causes in the squared CAD error of each joint, stacked."""
    n = len(attribution.joint_names)
    with styled():
        figure = blank_figure(1.05 * n + 3.2, 4.2)
        axis = figure.subplots()
        place = np.arange(n)
        above, below = np.zeros(n), np.zeros(n)
        low, high = _span(attribution)
        for each in attribution.shares:
            up, down = np.maximum(each.share, 0.0), np.minimum(each.share, 0.0)
            axis.bar(
                place,
                100 * up,
                bottom=100 * above,
                width=0.68,
                color=CAUSE_COLOURS[each.cause],
                edgecolor="white",
                linewidth=0.6,
                label=CAUSES[each.cause],
            )
            axis.bar(
                place,
                100 * down,
                bottom=100 * below,
                width=0.68,
                color=CAUSE_COLOURS[each.cause],
                edgecolor="white",
                linewidth=0.6,
            )
            dark = each.cause in ("friction", "payload", "links", "mounting")
            for k, part in enumerate(each.share):
                foot = above[k] if part > 0 else below[k]
                ends = np.clip([foot, foot + part], low, high)
                if abs(ends[1] - ends[0]) >= LABELLED * (high - low):
                    axis.text(
                        k,
                        50 * ends.sum(),
                        f"{100 * part:.0f}",
                        ha="center",
                        va="center",
                        fontsize=7.5,
                        color="white" if dark else INK,
                    )
            above, below = above + up, below + down
        axis.bar(
            place,
            100 * attribution.unexplained,
            bottom=100 * above,
            width=0.68,
            color=UNEXPLAINED,
            edgecolor="white",
            linewidth=0.6,
            label="unexplained",
        )
        top = above + attribution.unexplained
        gap = 0.015 * (high - low)
        for k in range(n):
            axis.text(
                k,
                100 * (min(top[k], high) + gap),
                f"{significant(float(attribution.rms_cad[k]))} {attribution.units[k]}",
                ha="center",
                va="bottom",
                fontsize=7.5,
            )
            for end, whole, mark in ((high, top[k], "\u25b2"), (low, below[k], "\u25bc")):
                if abs(whole) > abs(end):
                    axis.text(
                        k,
                        100 * (end - np.sign(end) * gap),
                        f"{mark} {100 * whole:.0f} %",
                        ha="center",
                        va="top" if end > 0.0 else "bottom",
                        fontsize=7.5,
                        color="white",
                        fontweight="bold",
                    )
        if below.min() < -0.02:
            axis.axhline(100.0, color=INK, linewidth=0.6, linestyle=":")
            figure.supxlabel(
                "A negative share works against the others; the shares of a joint add up to 100 %.",
                fontsize=7.5,
                color=QUIET,
            )
        axis.axhline(0.0, color=INK, linewidth=0.6)
        axis.set_xticks(
            place,
            [broken(name, 14) for name in attribution.joint_names],
            rotation=0 if n <= 8 else 30,
        )
        ends = (1.15 * low if low > -CUT else low, 1.1 * high if high < CUT else high)
        axis.set_ylim(100 * ends[0], 100 * ends[1])
        axis.set_ylabel("share of the squared CAD error [%]")
        axis.grid(axis="x", visible=False)
        figure.legend(loc="outside right upper", reverse=True)
        headline(
            figure,
            title or f"{attribution.robot}: causes of the torque error of CAD (RMS on top)",
        )
    return figure


def _span(attribution: Attribution) -> tuple[float, float]:
    """Return the lowest and the highest share that is drawn, within `CUT`."""
    shares = np.array([each.share for each in attribution.shares])
    lowest = float(np.minimum(shares, 0.0).sum(axis=0).min(initial=0.0))
    highest = float((np.maximum(shares, 0.0).sum(axis=0) + attribution.unexplained).max())
    return max(-CUT, lowest), min(CUT, highest)


def difference_figure(comparison: Comparison, *, most: int = 20, title: str = "") -> Figure:
    """Draw the parameters whose difference has the most torque, with the part that is their own.

    Those below a fiftieth of the largest are left out.
    """
    largest = max((each.torque_total or 0.0 for each in comparison.parameters), default=0.0)
    shown = [
        each
        for each in comparison.ranked
        if each.torque_total and each.torque_total >= 0.02 * largest
    ][:most]
    with styled():
        figure = blank_figure(7.6, 0.24 * max(len(shown), 1) + 1.2)
        axis = figure.subplots()
        place = np.arange(len(shown))
        total = np.array([each.torque_total or 0.0 for each in shown])
        own = np.array([each.torque_own or 0.0 for each in shown])
        differs = [each.verdict == "differs" for each in shown]
        axis.barh(
            place,
            total,
            height=0.7,
            color=[AS_BUILT if each else GREY for each in differs],
            alpha=0.35,
        )
        axis.barh(place, own, height=0.7, color=[AS_BUILT if each else GREY for each in differs])
        for k, each in enumerate(shown):
            felt = f"joint {1 + int(np.argmax(each.torque))}" if each.torque else ""
            remark = (
                f", shared with {' and '.join(each.shared_with)}"
                if each.shared_with
                else ""
                if each.matters
                else ", small"
            )
            axis.text(
                total[k] + 0.01 * total.max(),
                k,
                f"{felt}{remark}",
                va="center",
                fontsize=7,
                color=QUIET,
            )
        axis.set_yticks(place, [f"{each.name}  ({each.words})" for each in shown], fontsize=7)
        axis.set_ylim(len(shown) - 0.4, -0.6)
        axis.set_xlim(0, 1.22 * float(total.max(initial=1e-12)))
        axis.set_xlabel("torque of the difference, RMS over all joints [N m]")
        axis.grid(axis="y", visible=False)
        for colour, label in ((AS_BUILT, "differs"), (GREY, "within standard errors")):
            axis.bar([0], [0], color=colour, label=label)
        axis.legend(
            loc="lower right", title="pale: part that others could make up for", title_fontsize=8
        )
        headline(figure, title or f"{comparison.robot}: differences from CAD and their torque")
    return figure
