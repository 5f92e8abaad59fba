"""Figure of external torque, thresholds and events."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from asbuilt.workflow.watching.watched_log import WatchedLog, torque_unit
from asbuilt.writers.figures.figure_style import (
    BLUE,
    GREY,
    ORANGE,
    VERMILION,
    blank_figure,
    broken,
    headline,
    styled,
)

BAND = "#E9ECEF"
COLOURS = {"contact": VERMILION, "fault": ORANGE, "payload": "#009E73"}
NARROWEST = 0.004
"""Least width of an event, per length of the log."""
MARGIN = 1.25


def watch_figure(watched: WatchedLog, *, title: str = "", narrow: bool = False) -> Figure:
    """Draw the residual of every joint in its thresholds, with the events marked.

    A narrow figure is for screens as wide as a telephone's.
    """
    # Bins of a narrow figure.
    trace, n = watched.trace.thinned(600) if narrow else watched.trace, len(watched.joint_names)
    unit = torque_unit(watched.units)
    start, last = float(trace.t.min()), float(trace.t.max())
    with styled():
        figure = blank_figure(3.9 if narrow else 8.6, 0.95 * n + 0.9)
        axes = np.atleast_1d(figure.subplots(n, 1, sharex=True))
        shown = set()
        for j, axis in enumerate(axes):
            t, limit = trace.t[:, j], trace.limit[:, j]
            first = j == 0
            axis.fill_between(
                t,
                -limit,
                limit,
                color=BAND,
                linewidth=0.0,
                label="within threshold" if first else None,
            )
            axis.plot(t, limit, color=GREY, linewidth=0.5)
            axis.plot(t, -limit, color=GREY, linewidth=0.5)
            axis.plot(
                t,
                trace.residual[:, j],
                color=BLUE,
                linewidth=0.8,
                label="external torque" if first else None,
            )
            for event in watched.events:
                took_part = watched.joint_names[j] in event.joints
                label = event.kind if event.kind not in shown and took_part else None
                shown |= {event.kind} if took_part else set()
                if took_part:
                    width = max(event.duration, NARROWEST * (last - start))
                    axis.axvspan(
                        event.start,
                        event.start + width,
                        color=COLOURS[event.kind],
                        alpha=0.3,
                        linewidth=0.0,
                        label=label,
                    )
            tallest = MARGIN * float(
                max(np.abs(trace.residual[:, j]).max(), np.quantile(limit, 0.5))
            )
            axis.set_ylim(-tallest, tallest)
            mixed = f" [{watched.units[j]}]" if len(set(watched.units)) > 1 else ""
            axis.set_ylabel(broken(watched.joint_names[j] + mixed, 12))
        axes[-1].set_xlabel("time [s]")
        axes[-1].set_xlim(start, last)
        figure.legend(loc="outside lower right", ncols=2 if narrow else 5)
        headline(
            figure,
            title
            or ("" if narrow else f"{watched.robot}: ")
            + f"external torque [{unit}] and its thresholds",
        )
    return figure
