"""Base parameters with every set of drive terms.

Structure against singular values, on random trees, balancers and coupled wrists included.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from asbuilt.description import DHRow, robot_from_dh
from asbuilt.dynamics import DriveSet, available_terms, find_base_parameters, observation_matrix

from .test_base_parameters_random import assert_regroups, first_independent, robots, stacked

KEYS = sorted(key for key, term in available_terms().items() if not term.needs_load)
TYPICAL = {"smooth_coulomb": "smooth_coulomb:width=1.5", "stribeck": "stribeck:velocity=2.0"}


@st.composite
def drives(draw: st.DrawFn) -> DriveSet:
    return DriveSet.parse(
        [
            TYPICAL.get(key, key)
            for key in draw(st.sets(st.sampled_from(KEYS), min_size=1, max_size=6))
        ]
    )


@pytest.mark.slow
@settings(max_examples=120, deadline=None, suppress_health_check=list(HealthCheck))
@given(robots(most=5), drives(), st.data())
def test_structure_agrees_with_singular_values(model, drive, data):
    n = model.n_joints
    if n > 1 and data.draw(st.booleans()):
        coupling = np.eye(n)
        row = data.draw(st.integers(0, n - 1))
        for column in data.draw(st.sets(st.integers(0, n - 1), min_size=1, max_size=2)):
            coupling[row, column] = (
                1.0 if row == column else data.draw(st.sampled_from([1.0, -0.5]))
            )
        model = replace(model, motor_coupling=coupling)
    Y = stacked(model, drive, samples=60)
    base = find_base_parameters(model, drive)
    assert base.columns.tolist() == first_independent(Y)
    assert_regroups(base, Y)


def planar(gravity=(0.0, -9.81, 0.0)):
    return replace(
        robot_from_dh([DHRow(a=0.5), DHRow(a=0.4)], name="planar"), gravity=np.array(gravity)
    )


def test_a_balancer_on_a_level_axis_acts_as_a_first_moment_and_one_behind_it_does_not():
    base = find_base_parameters(planar(), DriveSet.parse("balancer"))
    status = {parameter.name: parameter.status for parameter in base.standard}
    assert status["Bs1"] == status["Bc1"] == "grouped"
    assert status["Bs2"] == status["Bc2"] == "identifiable"
    expression = dict(zip(base.names, base.expressions, strict=True))
    assert any("9.81" in text or "0.1019" in text for text in expression.values())


def test_a_motor_that_turns_with_parallel_joints_acts_as_an_inertia():
    coupled = replace(planar(), motor_coupling=np.array([[1.0, 0.0], [1.0, 1.0]]))
    base = find_base_parameters(coupled, DriveSet.parse("motor_armature"))
    status = {parameter.name: parameter.status for parameter in base.standard}
    assert status["Iam2"] == "grouped", "it turns with q1 + q2, as link 2 does"
    assert status["Iam1"] == "unidentifiable", (
        "motor 1 turns with joint 1 alone, where armature says it"
    )


def test_asymmetric_coulomb_beside_coulomb_shows_only_in_sums():
    base = find_base_parameters(planar(), DriveSet.parse("coulomb,asymmetric_coulomb,offset"))
    assert [name for name in base.names if name.endswith("1") and name.startswith("F")] == [
        "Fc1",
        "Fcp1",
    ]
    Y = observation_matrix(
        planar(), *np.random.default_rng(1).normal(size=(3, 30, 2)), drive=base.drive
    )
    assert_regroups(base, Y)


@pytest.mark.parametrize("key", sorted(available_terms()))
def test_every_term_alone_and_beside_the_defaults(key):
    robot = robot_from_dh([DHRow(b=0.3, alpha=np.pi / 2), DHRow(a=0.4), DHRow(a=0.3)], name="elbow")
    coupled = replace(robot, motor_coupling=np.array([[1.0, 0, 0], [0, 1, 0], [0, 1, 1]]))
    defaults = DriveSet.default("motor")
    term = available_terms()[key].typical()
    for model in (robot, coupled):
        loaded = model.with_parameters(np.random.default_rng(8).uniform(0.5, 1.5, 30))
        for drive in (DriveSet((term,)), defaults.with_term(term)):
            Y = stacked(loaded, drive, samples=400 if term.needs_load else 60)
            base = find_base_parameters(loaded, drive)
            assert base.columns.tolist() == sorted([*first_independent(Y), *scale_of_links(base)])
            assert_regroups(base, Y)


def scale_of_links(base):
    """The column that only the values of the links make dependent.

    The differences `Flm - Fle` of all joints together are the rigid-body torque, which links that
    are larger by a common factor have too.
    """
    names = list(base.standard_names)
    return [names.index("Fle3")] if "Fle3" in names and "Flms3" not in names else []


def test_a_term_at_some_joints_leaves_the_others_without_it():
    base = find_base_parameters(planar(), DriveSet.parse("viscous,spring:joints=2"))
    assert "Ks2" in base.names
    assert "Ks1" not in base.names
    assert_regroups(base, stacked(planar(), base.drive))
