"""Figures that results draw by name: parameters, and torque and its residuals joint by joint."""

from __future__ import annotations

from functools import partial
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from asbuilt.errors import UsageError
from asbuilt.findings import Cure
from asbuilt.identification.result.result import FIGURES, IdentificationResult
from asbuilt.identification.result.torque_prediction import Prediction
from asbuilt.writers.figures.figure_style import (
    AS_BUILT,
    GREY,
    INK,
    add_headline,
    apply_style,
)
from asbuilt.writers.figures.study_figures import draw_errors, draw_torque, label_torque_axis

Axes = NDArray[np.object_]


def _make_axes(axes: Any, count: int, width: float, height: float) -> Axes:
    """Return `count` axes as a vector, if none are given in a column of a new figure [inch].

    Raises `UsageError` for another number of axes.
    """
    if axes is None:
        # By pyplot, so that a notebook shows the figure and a script's `plt.show()` does.
        figure = plt.figure(figsize=(width, height), layout="constrained", facecolor="white")
        axes = figure.subplots(count, 1, sharex=True, squeeze=False)
    given: Axes = np.atleast_1d(np.asarray(axes, dtype=object)).ravel()
    if given.size != count:
        raise UsageError(
            f"this figure needs {count} axes, got {given.size}", value=given.size, expected=count
        )
    return given


def draw_parameters(result: IdentificationResult, prediction: Prediction | None, axes: Any) -> Axes:
    """Draw each parameter less its CAD value (0 where unknown) in units of its standard error.

    The 95 % interval is about 2 wide to either side; parameters that the recording does not
    determine are grey. `prediction` is not used.
    """
    cad = np.nan_to_num(result.cad_values, nan=0.0)
    errors = np.where(result.std_errors > 0.0, result.std_errors, np.nan)
    difference = (result.estimates - cad) / errors
    low, high = ((result.conf_int().T - cad) / errors).reshape(2, -1)
    rows = np.arange(len(difference))
    determined = np.array([parameter.determined for parameter in result.parameters])
    with apply_style():
        # 0.17: height of a parameter's row [inch].
        (axis,) = own = _make_axes(axes, 1, 7.0, 0.17 * len(rows) + 1.0)
        for chosen, color, label in (
            (determined, AS_BUILT, "as built, with its interval"),
            (~determined, GREY, "undetermined"),
        ):
            if chosen.any():
                axis.errorbar(
                    difference[chosen],
                    rows[chosen],
                    xerr=(difference[chosen] - low[chosen], high[chosen] - difference[chosen]),
                    fmt="o",
                    markersize=3,
                    linewidth=0.9,
                    color=color,
                    label=label,
                )
        axis.axvline(0.0, color=INK, linewidth=0.7)
        axis.set_xscale("symlog", linthresh=10.0)
        axis.xaxis.set_major_formatter("{x:g}")
        axis.set_yticks(rows, result.names)
        axis.set_ylim(len(rows) - 0.5, -0.5)
        axis.set_xlabel("as built less CAD [standard errors]")
        axis.legend(loc="lower right")
        if axes is None:
            add_headline(axis.figure, f"{result.robot}: parameters")
    return own


def draw_joints(
    kind: str, result: IdentificationResult, shown: Prediction | None, axes: Any
) -> Axes:
    """Draw measured and predicted torque of a recording, or for `"residuals"` their difference.

    Raises `UsageError` if there is no prediction.
    """
    if shown is None:
        raise UsageError(
            f"a figure of {kind} shows a recording, and none is given",
            cure=Cure("give a recording or its prediction, or draw the figure of the study"),
        )
    joints = result.model.joints
    residuals = kind == "residuals"
    with apply_style():
        # 1.25: height of a joint's axis [inch].
        own = _make_axes(axes, len(joints), 8.0, 1.25 * len(joints) + 0.7)
        for k, (axis, joint) in enumerate(zip(own, joints, strict=True)):
            torques = shown.t, shown.measured[:, k], shown.predicted[:, k]
            (draw_errors if residuals else draw_torque)(axis, *torques)
            axis.set_ylabel(label_torque_axis(joint.name, joint.torque_unit))
        for axis in own if residuals else own[:1]:
            axis.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, borderaxespad=0.2)
        own[-1].set_xlabel("time [s]")
        if axes is None:
            add_headline(own[0].figure, f"{result.robot}: {shown.source}")
    return own


FIGURES.register("parameters", draw_parameters)
FIGURES.register("torque", partial(draw_joints, "torque"))
FIGURES.register("residuals", partial(draw_joints, "residuals"))
