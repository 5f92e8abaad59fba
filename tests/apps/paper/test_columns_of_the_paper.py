"""Real bodies that have the base parameters that the paper prints, or the nearest that do."""

from __future__ import annotations

import numpy as np
import pytest

from asbuilt.apps.paper.reproduction import read_paper
from asbuilt.description import load_robot
from asbuilt.description.plausibility import find_inconsistencies
from asbuilt.dynamics import find_base_parameters
from asbuilt.identification.bodies.standard_parameters import find_standard_parameters


def test_cad_column_of_the_paper():
    model = load_robot("kuka-iiwa7-r800")
    base = find_base_parameters(model)
    found = find_standard_parameters(model, base, read_paper().cad)
    assert found.exact
    assert found.part > 0.9
    assert found.smallest_eigenvalue == pytest.approx(8.4e-4, abs=2e-5)


def test_robot_column_of_the_paper_and_the_nearest_real_robot():
    """No real bodies have it.

    The nearest predict torques that differ by 0.14 N m RMS over random motion, against 26 N m.
    """
    model = load_robot("kuka-iiwa7-r800")
    base = find_base_parameters(model)
    robot = read_paper().robot
    kept = find_standard_parameters(model, base, robot)
    assert not kept.consistent
    np.testing.assert_allclose(base.values(kept.parameters), robot, atol=1e-11)
    assert "NOT physically consistent" in kept.verdict
    nearest = find_standard_parameters(model, base, robot, nearest=True)
    assert nearest.consistent
    assert not nearest.exact
    assert np.sqrt(np.mean(nearest.torque_rms**2)) == pytest.approx(0.14, abs=0.015)
    assert np.sqrt(np.mean(nearest.torque_rms_of_motion**2)) == pytest.approx(26.0, abs=1.0)
    assert nearest.part >= 4e-4
    assert not find_inconsistencies(model.with_parameters(nearest.parameters))
    assert "0.15 N m RMS away" in nearest.verdict
