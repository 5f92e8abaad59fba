"""The figure of a watched log."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from asbuilt.apps.watch.watched_log import WatchedLog, format_torque_unit
from asbuilt.writers import (
    BLUE,
    GREY,
    ORANGE,
    VERMILION,
    break_name,
    label_once,
    open_figure,
)

COLOURS = {"contact": VERMILION, "fault": ORANGE, "payload": "#009E73"}


def watch_figure(watched: WatchedLog, *, narrow: bool = False) -> Figure:
    """Draw the residual of every joint in its thresholds, with the events marked.

    A narrow figure is for screens as wide as a telephone's.
    """
    # 600: bins of a narrow figure.
    trace = watched.trace.thinned(600) if narrow else watched.trace
    n = len(watched.joint_names)
    start = float(trace.t.min())
    last = float(trace.t.max())
    subject = f"external torque [{format_torque_unit(watched.units)}] and its thresholds"
    title = subject if narrow else f"{watched.robot}: {subject}"
    mixed = len(set(watched.units)) > 1
    width = 3.9 if narrow else 8.6
    with open_figure(width, 0.95 * n + 0.9, title, rows=n, sharex=True) as (figure, axes):
        for j, (axis, name) in enumerate(zip(axes, watched.joint_names, strict=True)):
            t = trace.t[:, j]
            limit = trace.limit[:, j]
            residual = trace.residual[:, j]
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
