"""Figures that results draw by name: what their curves hold, and which axes they take."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from asbuilt.errors import UsageError
from asbuilt.validation import validate_samples


def test_residuals_of_a_recording_are_measured_less_predicted(example: Any) -> None:
    shown = validate_samples(example.result, example.held_out)
    for of in (example.held_out, shown):
        axes = example.result.plot("residuals", of)
        for k, axis in enumerate(axes):
            drawn = axis.lines[0].get_ydata()
            assert np.nanmax(drawn) == pytest.approx(
                np.max(shown.measured[:, k] - shown.predicted[:, k])
            )
            assert axis.get_ylabel().endswith(f"[{shown.units[k]}]")


def test_torque_is_drawn_on_the_axes_given(example: Any) -> None:
    n = example.result.model.n_joints
    mine = Figure().subplots(n, 1)
    drawn = example.result.plot("torque", example.held_out, mine)
    assert [*drawn] == [*mine]
    assert [line.get_label() for line in mine[0].lines] == ["measured", "predicted, as built"]
    with pytest.raises(UsageError, match=f"needs {n} axes, got 1"):
        example.result.plot("torque", example.held_out, mine[0])


def test_parameters_are_drawn_in_standard_errors_from_cad(example: Any) -> None:
    result = example.result
    (axis,) = result.plot()
    assert [each.get_text() for each in axis.get_yticklabels()] == list(result.names)
    determined = np.array([each.determined for each in result.parameters])
    cad = np.nan_to_num(result.cad_values)
    points = axis.containers[0].lines[0].get_xdata()
    expected = ((result.estimates - cad) / result.std_errors)[determined]
    np.testing.assert_allclose(points, expected)


def test_wrong_figures_are_refused(example: Any) -> None:
    with pytest.raises(UsageError, match="unknown figure 'residual'; did you mean 'residuals'"):
        example.result.plot("residual")
    with pytest.raises(UsageError, match="a figure of torque shows a recording"):
        example.result.plot("torque")
