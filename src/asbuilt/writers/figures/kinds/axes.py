"""Axes of a figure of a result: those given, or those of a new figure."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from asbuilt.errors import UsageError
from asbuilt.findings import Cure
from asbuilt.identification.result.torque_prediction import Prediction
from asbuilt.writers.figures.figure_style import blank_figure

Axes = NDArray[np.object_]


def axes_in(axes: Any, count: int, width: float, height: float) -> Axes:
    """Return `count` axes as a vector, if none are given in a column of a new figure [inch].

    Raises `UsageError` for another number of axes.
    """
    if axes is None:
        axes = blank_figure(width, height).subplots(count, 1, sharex=True, squeeze=False)
    given: Axes = np.atleast_1d(np.asarray(axes, dtype=object)).ravel()
    if given.size != count:
        raise UsageError(
            f"this figure needs {count} axes, got {given.size}", value=given.size, expected=count
        )
    return given


def required(prediction: Prediction | None, kind: str) -> Prediction:
    """Return the prediction; raises `UsageError` if there is none."""
    if prediction is None:
        raise UsageError(
            f"a figure of {kind} shows a recording, and none is given",
            cure=Cure("give a recording or its prediction, or draw the figure of the study"),
        )
    return prediction
