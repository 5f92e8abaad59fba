"""Figure of the torque of the changes between two results."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from asbuilt.tables import significant
from asbuilt.validation.comparison.drift import Drift
from asbuilt.writers.figures.figure_style import (
    AS_BUILT,
    GREY,
    QUIET,
    blank_figure,
    broken,
    headline,
    styled,
)

CHANCE = "#D5D9DE"
"""Colour of the change expected by chance."""


def drift_figure(drift: Drift, *, title: str = "") -> Figure:
    """Draw the RMS torque of all changes at each joint, and what standard errors explain below."""
    change = "difference" if drift.of_models else "change"
    joints = drift.joints
    place = np.arange(len(joints))
    bars = {
        f"{change}, significant": (
            -0.2,
            0.38,
            AS_BUILT,
            [each.torque if each.holm <= drift.level else np.nan for each in joints],
        ),
        f"{change}, within errors": (
            -0.2,
            0.38,
            GREY,
            [np.nan if each.holm <= drift.level else each.torque for each in joints],
        ),
        "expected from standard errors": (0.17, 0.28, CHANCE, [each.by_chance for each in joints]),
    }
    longest = max((max(each.torque, each.by_chance) for each in joints), default=0.0) or 1.0
    with styled():
        figure = blank_figure(7.6, 0.46 * len(joints) + 1.3)
        axis = figure.subplots()
        for label, (shift, height, colour, lengths) in bars.items():
            if np.all(np.isnan(lengths)):
                continue
            axis.barh(
                place + shift, np.nan_to_num(lengths), height=height, color=colour, label=label
            )
            for k, length in enumerate(lengths):
                if np.isfinite(length):
                    size = 7.5 if height > 0.3 else 6.5
                    text = f"{significant(length)} {joints[k].unit}"
                    axis.text(
                        length + 0.008 * longest,
                        k + shift,
                        text,
                        va="center",
                        fontsize=size,
                        color=QUIET,
                    )
        axis.set_yticks(place, [broken(each.joint, 20) for each in joints])
        axis.set_ylim(len(joints) - 0.4, -0.6)
        axis.set_xlim(0.0, 1.12 * longest)
        axis.set_xlabel(
            "RMS on the same motion"
            f" [{', '.join(sorted({each.unit for each in joints}, reverse=True))}]"
        )
        axis.grid(axis="y", visible=False)
        figure.legend(loc="outside lower right", ncols=3)
        headline(
            figure,
            title or f"{drift.robot}: {change} of torque, and what standard errors explain",
        )
    return figure
