"""What objects print fits a screen."""

from __future__ import annotations

import pytest

from asbuilt.description import bundled_robot, robot_names
from asbuilt.dynamics import DriveSet, find_base_parameters


@pytest.mark.parametrize("name", robot_names())
def test_every_object_of_a_robot_prints_on_one_screen(name: str) -> None:
    model = bundled_robot(name)
    base = find_base_parameters(model, DriveSet.parse("armature,viscous,coulomb,offset"))
    for each in (model, base, model.links[0].inertia, model.joints[0], model.geometry):
        lines = repr(each).splitlines()
        assert len(lines) <= 24
        assert max(map(len, lines)) <= 100
    left = base.n_base - 12
    assert (f"{left} more rows" in repr(base)) == (left > 0)
    for each in (model, base):
        page = each._repr_html_()
        assert page.startswith("<table")
        assert model.name in page
    assert all(joint.name in repr(model) for joint in model.joints)
