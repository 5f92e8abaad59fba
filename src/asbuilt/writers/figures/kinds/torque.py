"""Figures of measured and predicted torque, and of their difference, an axis per joint."""

from __future__ import annotations

from typing import Any

from asbuilt.identification.result.result import FIGURES, IdentificationResult
from asbuilt.identification.result.torque_prediction import Prediction
from asbuilt.writers.figures.figure_style import headline, styled
from asbuilt.writers.figures.kinds.axes import Axes, axes_in, required
from asbuilt.writers.figures.torque_figure import draw_errors, draw_torque, torque_label


def draw_torques(result: IdentificationResult, prediction: Prediction | None, axes: Any) -> Axes:
    """Draw measured and predicted torque of a recording."""
    return _by_joint(result, required(prediction, "torque"), axes, residuals=False)


def draw_residuals(result: IdentificationResult, prediction: Prediction | None, axes: Any) -> Axes:
    """Draw measured less predicted torque of a recording."""
    return _by_joint(result, required(prediction, "residuals"), axes, residuals=True)


def _by_joint(
    result: IdentificationResult, shown: Prediction, axes: Any, *, residuals: bool
) -> Axes:
    joints = result.model.joints
    with styled():
        # 1.25: height of a joint's axis [inch].
        own = axes_in(axes, len(joints), 8.0, 1.25 * len(joints) + 0.7)
        for k, (axis, joint) in enumerate(zip(own, joints, strict=True)):
            torques = shown.t, shown.measured[:, k], shown.predicted[:, k]
            (draw_errors if residuals else draw_torque)(axis, *torques)
            axis.set_ylabel(torque_label(joint.name, "N m" if joint.is_revolute else "N"))
        for axis in own if residuals else own[:1]:
            axis.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, borderaxespad=0.2)
        own[-1].set_xlabel("time [s]")
        if axes is None:
            headline(own[0].figure, f"{result.robot}: {shown.source}")
    return own


FIGURES.register("torque", draw_torques)
FIGURES.register("residuals", draw_residuals)
