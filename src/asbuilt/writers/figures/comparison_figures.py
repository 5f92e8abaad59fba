"""Figures of comparisons: causes of the CAD error, differences, changes, and claims of drives."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from asbuilt.identification.effects.effect import name_group
from asbuilt.tables import round_significant
from asbuilt.validation import Attribution, Claim, Comparison, Drift, Review
from asbuilt.validation.prediction import name_torque_unit
from asbuilt.writers.figures.figure_style import (
    AS_BUILT,
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    QUIET,
    VERMILION,
    break_name,
    label_once,
    open_figure,
)

CAUSE_COLOURS: dict[str, str] = {
    "offset": "#F0E442",
    "friction": BLUE,
    "armature": "#CC79A7",
    "payload": AS_BUILT,
    "spring": GREEN,
    "links": "#7A6A53",
}
"""One colour per effect that is common, after Okabe and Ito (2008)."""
FURTHER = (ORANGE, "#56B4E9")
"""Colours of other effects, in turn."""
PALE = "#D5D9DE"
"""Colour of what no cause explains, and of a change expected by chance."""
CUT = 3.0
"""Share at which the axis ends: at a joint with almost no error the causes cancel, and their shares
have no bound."""


def draw_attribution(attribution: Attribution) -> Figure:
    """Draw the shares of the causes in the squared CAD error of each joint, stacked."""
    n = len(attribution.joint_names)
    place = np.arange(n)
    shares = np.array([share.share for share in attribution.shares])
    ups = np.maximum(shares, 0.0)
    downs = np.minimum(shares, 0.0)
    top = ups.sum(axis=0) + attribution.unexplained
    bottom = downs.sum(axis=0)
    low = max(-CUT, float(bottom.min(initial=0.0)))
    high = min(CUT, float(top.max()))
    gap = 0.015 * (high - low)
    bar: dict[str, Any] = {"width": 0.68, "edgecolor": "white", "linewidth": 0.6}
    small: dict[str, Any] = {"ha": "center", "fontsize": 7.5}
    title = f"{attribution.robot}: causes of the torque error of CAD (RMS on top)"
    with open_figure(1.05 * n + 3.2, 4.2, title) as (figure, (axis,)):
        above = np.zeros(n)
        below = np.zeros(n)
        for number, (each, up, down) in enumerate(zip(attribution.shares, ups, downs, strict=True)):
            colour = CAUSE_COLOURS.get(each.effect, FURTHER[number % len(FURTHER)])
            name = name_group(each.effect)
            ink = "white" if each.effect in ("friction", "payload", "links", "spring") else INK
            axis.bar(place, 100 * up, bottom=100 * above, color=colour, label=name, **bar)
            axis.bar(place, 100 * down, bottom=100 * below, color=colour, **bar)
            for k, part in enumerate(each.share):
                foot = above[k] if part > 0 else below[k]
                ends = np.clip([foot, foot + part], low, high)
                # Smallest share that has its number, as a part of the axis.
                if abs(ends[1] - ends[0]) >= 0.035 * (high - low):
                    axis.text(
                        k, 50 * ends.sum(), f"{100 * part:.0f}", va="center", color=ink, **small
                    )
            above = above + up
            below = below + down
        axis.bar(
            place,
            100 * attribution.unexplained,
            bottom=100 * above,
            color=PALE,
            label="unexplained",
            **bar,
        )
        for k, (rms, unit) in enumerate(zip(attribution.rms_cad, attribution.units, strict=True)):
            error = f"{round_significant(float(rms))} {unit}"
            axis.text(k, 100 * (min(top[k], high) + gap), error, va="bottom", **small)
            for end, whole, mark in ((high, top[k], "\u25b2"), (low, bottom[k], "\u25bc")):
                if abs(whole) > abs(end):
                    axis.text(
                        k,
                        100 * (end - np.sign(end) * gap),
                        f"{mark} {100 * whole:.0f} %",
                        va="top" if end > 0.0 else "bottom",
                        color="white",
                        fontweight="bold",
                        **small,
                    )
        if bottom.min() < -0.02:
            axis.axhline(100.0, color=INK, linewidth=0.6, linestyle=":")
            figure.supxlabel(
                "A negative share works against the others; the shares of a joint add up to 100 %.",
                fontsize=7.5,
                color=QUIET,
            )
        axis.axhline(0.0, color=INK, linewidth=0.6)
        names = [break_name(name, 14) for name in attribution.joint_names]
        axis.set_xticks(place, names, rotation=0 if n <= 8 else 30)
        axis.set(
            ylim=(
                100 * (1.15 * low if low > -CUT else low),
                100 * (1.1 * high if high < CUT else high),
            ),
            ylabel="share of the squared CAD error [%]",
        )
        axis.grid(axis="x", visible=False)
        figure.legend(loc="outside right upper", reverse=True)
    return figure


def draw_differences(comparison: Comparison) -> Figure:
    """Draw the parameters whose difference has the most torque, with the part that is their own.

    Those below a fiftieth of the largest are left out.
    """
    largest = max(
        (parameter.torque_total or 0.0 for parameter in comparison.parameters), default=0.0
    )
    # Most parameters in the figure.
    shown = [
        parameter
        for parameter in comparison.ranked
        if parameter.torque_total and parameter.torque_total >= 0.02 * largest
    ][:20]
    place = np.arange(len(shown))
    total = np.array([parameter.torque_total or 0.0 for parameter in shown])
    own = [parameter.torque_own or 0.0 for parameter in shown]
    colours = [AS_BUILT if parameter.verdict == "differs" else GREY for parameter in shown]
    title = f"{comparison.robot}: differences from CAD and their torque"
    unit = name_torque_unit(comparison.units)
    with open_figure(7.6, 0.24 * max(len(shown), 1) + 1.2, title) as (figure, (axis,)):
        axis.barh(place, total, height=0.7, color=colours, alpha=0.35)
        axis.barh(place, own, height=0.7, color=colours)
        for k, parameter in enumerate(shown):
            felt = "" if parameter.felt_at is None else f"joint {parameter.felt_at}"
            shared = (
                f", shared with {' and '.join(parameter.shared_with)}"
                if parameter.shared_with
                else ""
            )
            remark = shared or ("" if parameter.matters else ", small")
            axis.text(
                total[k] + 0.01 * total.max(),
                k,
                f"{felt}{remark}",
                va="center",
                fontsize=7,
                color=QUIET,
            )
        axis.set_yticks(
            place, [f"{parameter.name}  ({parameter.words})" for parameter in shown], fontsize=7
        )
        axis.set(
            xlabel=f"torque of the difference, RMS over all joints [{unit}]",
            xlim=(0, 1.22 * float(total.max(initial=1e-12))),
            ylim=(len(shown) - 0.4, -0.6),
        )
        axis.grid(axis="y", visible=False)
        for colour, label in ((AS_BUILT, "differs"), (GREY, "within standard errors")):
            axis.bar([0], [0], color=colour, label=label)
        axis.legend(
            loc="lower right", title="pale: part that others could make up for", title_fontsize=8
        )
    return figure


def draw_drift(drift: Drift) -> Figure:
    """Draw the RMS torque of all changes at each joint, and what standard errors explain below."""
    change = "difference" if drift.of_models else "change"
    joints = drift.joints
    place = np.arange(len(drift.joints))
    sure = np.array([joint.holm <= drift.level for joint in joints])
    torque = np.array([joint.torque for joint in joints])
    by_chance = np.array([joint.by_chance for joint in joints])
    longest = max(torque.max(initial=0.0), by_chance.max(initial=0.0)) or 1.0
    units = name_torque_unit(joint.unit for joint in joints)
    title = f"{drift.robot}: {change} of torque, and what standard errors explain"
    with open_figure(7.6, 0.46 * len(joints) + 1.3, title) as (figure, (axis,)):
        for label, shift, height, colour, lengths, shown in (
            (f"{change}, significant", -0.2, 0.38, AS_BUILT, torque, sure),
            (f"{change}, within errors", -0.2, 0.38, GREY, torque, ~sure),
            ("expected from standard errors", 0.17, 0.28, PALE, by_chance, sure | ~sure),
        ):
            if not shown.any():
                continue
            axis.barh(
                place + shift,
                np.where(shown, lengths, 0.0),
                height=height,
                color=colour,
                label=label,
            )
            for k in np.flatnonzero(shown):
                axis.text(
                    lengths[k] + 0.008 * longest,
                    k + shift,
                    f"{round_significant(lengths[k])} {joints[k].unit}",
                    va="center",
                    fontsize=7.5 if height > 0.3 else 6.5,
                    color=QUIET,
                )
        axis.set_yticks(place, [break_name(joint.joint, 20) for joint in joints])
        axis.set(
            xlabel=f"RMS on the same motion [{units}]",
            xlim=(0.0, 1.12 * longest),
            ylim=(len(joints) - 0.4, -0.6),
        )
        axis.grid(axis="y", visible=False)
        figure.legend(loc="outside lower right", ncols=3)
    return figure


SHOWN = ("armature", "damping", "damping + kv", "friction loss", "kp", "forcerange")
"""Kinds of numbers in the figure."""
COLOURS = {"contradicted": VERMILION, "supported": BLUE, "undetermined": GREY}


def review_figure(review: Review) -> Figure:
    """Draw each number of the drives with its error bar, next to its claim, joint by joint."""
    kinds = [kind for kind in SHOWN if any(_is_drawn(claim, kind) for claim in review.claims)]
    joints = list(review.result.joint_names)
    columns = max(1, min(3, len(kinds)))
    rows = max(1, -(-len(kinds) // columns))
    width = 2.9 * columns + 0.6
    height = rows * (0.24 * len(joints) + 0.9) + 0.5
    title = f"{review.robot}: numbers of its drives against the log"
    with open_figure(width, height, title, rows=rows, columns=columns, sharey=True) as (
        figure,
        axes,
    ):
        for axis in axes[len(kinds) :]:
            axis.set_visible(False)
        for axis, kind in zip(axes, kinds, strict=False):
            claims = [claim for claim in review.claims if _is_drawn(claim, kind)]
            _draw(axis, claims, joints)
            axis.set_yticks(range(len(joints)), [break_name(name, 16) for name in joints])
            axis.set(title=f"{kind} [{claims[0].unit}]", ylim=(len(joints) - 0.5, -0.5))
        label_once(figure, axes, loc="outside lower left", ncols=4)
    return figure


def _is_drawn(claim: Claim, kind: str) -> bool:
    return claim.what == kind and claim.estimate is not None and claim.std_error is not None


def _draw(axis: Axes, claims: list[Claim], joints: list[str]) -> None:
    """Draw the claims of one kind."""
    size = max(max(abs(claim.claimed), abs(claim.estimate or 0.0)) for claim in claims)
    for claim in claims:
        place = joints.index(claim.joint)
        # Two standard errors; a bar longer than 4 times the largest number of its kind is cut.
        bar = min(2.0 * (claim.std_error or 0.0), 4.0 * size)
        axis.errorbar(
            claim.estimate or 0.0,
            place,
            xerr=bar,
            fmt="o",
            markersize=3.5,
            color=COLOURS[claim.verdict],
            elinewidth=1.2,
            label=claim.verdict,
        )
        axis.plot(
            [claim.claimed] * 2,
            [place - 0.35, place + 0.35],
            color=INK,
            linewidth=1.4,
            label="claim",
        )
    axis.axvline(0.0, color=GREY, linewidth=0.5)
