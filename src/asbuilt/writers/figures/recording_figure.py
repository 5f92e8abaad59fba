"""Figure of a recording as it was read: positions, torques, and what is wrong where."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from asbuilt.experiment.quality.checks import RecordingCheck
from asbuilt.experiment.recording import Recording
from asbuilt.writers.figures.figure_style import (
    BLUE,
    GREY,
    INK,
    ORANGE,
    POINTS,
    VERMILION,
    blank_figure,
    broken,
    styled,
)
from asbuilt.writers.figures.thinning import thinned

MARKS = {"error": VERMILION, "warning": ORANGE, "info": GREY}
"""Colours of findings by severity."""


def recording_figure(recording: Recording, check: RecordingCheck) -> Figure:
    """Draw position and torque of every joint over time.

    Joints that a finding names have their name in its colour, with a line where it begins.
    """
    n = len(recording.joint_names)
    with styled():
        figure = blank_figure(8.6, 0.9 * n + 0.8)
        axes = figure.subplots(n, 2, sharex=True, squeeze=False)
        for k, (name, row) in enumerate(zip(recording.joint_names, axes, strict=True)):
            said = [each for each in check.findings if each.joint == name]
            colour = MARKS[said[0].severity] if said else INK
            for axis, values in zip(row, (recording.q, recording.tau), strict=True):
                shown = np.isfinite(values[:, k])
                if np.any(shown):
                    drawn = thinned(recording.t[shown], values[shown, k], points=POINTS)
                    axis.plot(*drawn, color=BLUE, linewidth=0.8)
                for each in check.findings:
                    if each.time is not None and each.joint in (None, name):
                        axis.axvline(each.time, color=MARKS[each.severity], linewidth=1.0)
            row[0].set_ylabel(broken(name, 14), color=colour, rotation=0, ha="right", va="center")
        for axis, title in zip(axes[0], ("position [rad or m]", "torque as logged"), strict=True):
            axis.set_title(title)
        for axis in axes[-1]:
            axis.set_xlabel("time [s]")
    return figure
