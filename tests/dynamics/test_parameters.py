"""Names, units and values of the standard parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pinocchio_oracle import random_robot

from asbuilt.description import DriveValues
from asbuilt.dynamics import DriveSet, parameter_names, parameter_units, parameter_values
from asbuilt.dynamics.parameters import parameter_count


def test_links_come_first_then_drives_joint_by_joint():
    model = random_robot(np.random.default_rng(0), 3)
    drive = DriveSet.parse("offset,viscous")
    names = parameter_names(model, drive)
    assert names[:10] == ("Ixx1", "Ixy1", "Ixz1", "Iyy1", "Iyz1", "Izz1", "mx1", "my1", "mz1", "m1")
    assert names[20] == "Ixx3"
    assert names[30:] == ("Fv1", "Fo1", "Fv2", "Fo2", "Fv3", "Fo3")
    assert len(names) == parameter_count(model, drive) == 36


def test_units_and_values_follow_the_joints():
    model = random_robot(np.random.default_rng(0), 2)
    kinds = ("revolute", "prismatic")
    drives = (DriveValues(viscous=0.5), DriveValues(armature=1.5))
    joints = tuple(
        replace(joint, kind=kind, drive=value)
        for joint, kind, value in zip(model.joints, kinds, drives, strict=True)
    )
    model, drive = replace(model, joints=joints), DriveSet.parse("armature,viscous")
    assert parameter_units(model, drive)[5:10] == ("kg m^2", "kg m", "kg m", "kg m", "kg")
    assert parameter_units(model, drive)[20:] == ("kg m^2", "N m s/rad", "kg", "N s/m")
    values = parameter_values(model, drive)
    np.testing.assert_array_equal(values[:20], model.parameters)
    np.testing.assert_array_equal(values[20:], [np.nan, 0.5, 1.5, np.nan])
