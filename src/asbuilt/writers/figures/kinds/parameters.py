"""Figure of the parameters: as built less CAD, with confidence intervals."""

from __future__ import annotations

from typing import Any

import numpy as np

from asbuilt.identification.result.result import FIGURES, IdentificationResult
from asbuilt.identification.result.torque_prediction import Prediction
from asbuilt.writers.figures.figure_style import AS_BUILT, GREY, INK, headline, styled
from asbuilt.writers.figures.kinds.axes import Axes, axes_in


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
    determined = np.array([each.determined for each in result.parameters])
    with styled():
        # 0.17: height of a parameter's row [inch].
        (axis,) = own = axes_in(axes, 1, 7.0, 0.17 * len(rows) + 1.0)
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
            headline(axis.figure, f"{result.robot}: parameters")
    return own


FIGURES.register("parameters", draw_parameters)
