"""Drive terms: columns, canonical order, names, units, selection."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from asbuilt.description import DriveValues
from asbuilt.dynamics import (
    DriveSet,
    DriveTerm,
    NonlinearParameter,
    available_terms,
    drive_columns,
    drive_torque,
)
from asbuilt.dynamics.drives.drive_set import NO_DRIVE
from asbuilt.errors import UsageError


@dataclass(frozen=True, slots=True)
class LoadFriction(DriveTerm):
    """Two columns, one of them dependent on the load, with a smooth sign of stated width."""

    width: float = 0.1
    key = "load"
    position = 35
    symbols = ("Fl", "Fq")
    revolute_units = ("1", "N m s^2/rad^2")
    prismatic_units = ("1", "N s^2/m^2")
    nonlinear = (NonlinearParameter("width", 0.1, 0.0, 1.0, ""),)
    columns = ("abs(load)*tanh(qd/width)", "qd*abs(qd)")


def test_every_term_is_found_in_canonical_order():
    assert tuple(term.position for term in available_terms().values()) == tuple(
        sorted(term.position for term in available_terms().values())
    )
    assert DriveSet.default("motor").keys == ("armature", "viscous", "coulomb", "offset")
    assert DriveSet.default("sensor").keys == ("viscous", "coulomb", "offset")


@pytest.mark.parametrize(
    "text", ["offset,armature,coulomb,viscous", " Viscous , offset,COULOMB,armature"]
)
def test_order_and_case_given_do_not_matter(text):
    drive = DriveSet.parse(text)
    assert drive.keys == ("armature", "viscous", "coulomb", "offset")
    assert drive.names(3) == ("Ia3", "Fv3", "Fc3", "Fo3")
    assert drive.columns_per_joint == 4
    assert DriveSet.parse(drive.keys) == drive == DriveSet.parse(str(drive))
    assert hash(DriveSet.parse(text)) == hash(drive)


@pytest.mark.parametrize("text", ["none", "", "NONE", []])
def test_none_is_no_term(text):
    assert DriveSet.parse(text) == NO_DRIVE == DriveSet()
    assert not NO_DRIVE
    assert str(NO_DRIVE) == "none"
    assert NO_DRIVE.evaluate(*np.zeros((3, 5))).shape == (0, 5)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("viscos", r"'viscos'; did you mean 'viscous'\?.*armature, .*, viscous"),
        ("viscous,none", "'none' excludes other drive terms"),
        ("viscous,viscous", "'viscous' is given 2 times"),
        ("wzrgl", "unknown drive term 'wzrgl'; available"),
        (
            "spring:joints=inf",
            r"joints of drive term 'spring' are numbers from 1, such as joints=2/5, got 'inf'",
        ),
        ("spring:joints=2/nan", r"are numbers from 1, such as joints=2/5, got '2/nan'"),
        ("spring:joints=1.5", r"are numbers from 1, such as joints=2/5, got '1\.5'"),
    ],
)
def test_wrong_selections_say_what_exists(text, said):
    with pytest.raises(UsageError, match=said):
        DriveSet.parse(text)


def test_columns_are_acceleration_velocity_sign_and_one():
    q, qd, qdd = np.array([0.3, 0.1, 0.2]), np.array([-2.0, 0.0, 0.5]), np.array([1.0, 2.0, 3.0])
    columns = DriveSet.parse("armature,viscous,coulomb,offset").evaluate(q, qd, qdd)
    np.testing.assert_array_equal(
        columns, [[1.0, 2.0, 3.0], [-2.0, 0.0, 0.5], [-1.0, 0.0, 1.0], [1.0, 1.0, 1.0]]
    )


def test_units_depend_on_the_kind_of_joint():
    drive = DriveSet.parse("armature,viscous,coulomb,offset")
    assert (
        drive.units("revolute")
        == drive.units("continuous")
        == ("kg m^2", "N m s/rad", "N m", "N m")
    )
    assert drive.units("prismatic") == ("kg", "N s/m", "N", "N")


def test_values_come_from_the_description():
    assert DriveSet.parse("viscous,offset").values(DriveValues(viscous=0.4, coulomb=2.0)) == (
        0.4,
        None,
    )


def test_a_new_term_brings_columns_parameters_and_load():
    drive = DriveSet((LoadFriction(width=0.2), *DriveSet.parse("viscous,offset").terms))
    assert drive.names(2) == ("Fv2", "Fl2", "Fq2", "Fo2")
    assert drive.values(DriveValues()) == (None,) * 4
    qd, load = np.array([0.1, -3.0]), np.array([-5.0, 2.0])
    columns = drive.evaluate(qd, qd, qd, load=load)
    np.testing.assert_allclose(columns[1:3], [np.abs(load) * np.tanh(qd / 0.2), [0.01, -9.0]])
    with pytest.raises(UsageError, match="'load' needs the rigid-body torque"):
        drive.evaluate(qd, qd, qd)


def _has_speed(term, key):
    return key in ("balancer", "extension_spring", "cylinder") or any(
        parameter.speed for parameter in term.nonlinear
    )


@pytest.mark.parametrize(
    "key",
    sorted(key for key, term in available_terms().items() if not _has_speed(term, key)),
)
def test_what_a_gear_does_to_a_parameter_is_what_it_does_to_speed_and_torque(key):
    """`f(q) = N^(1 - p) f(N q)` for a term whose parameter is divided by N^p.

    Nonlinear parameters in units of speed and position are those of the joint.
    """
    term, ratio = available_terms()[key], 50.0
    q, qd, qdd, load = np.random.default_rng(4).normal(size=(4, 30))
    at_joint, at_motor = np.zeros((2, len(term.symbols), 30))
    term.evaluate(q, qd, qdd, load, at_joint)
    term.evaluate(ratio * q, ratio * qd, ratio * qdd, load / ratio, at_motor)
    powers = np.array(term.powers_of_ratio())[:, None]
    np.testing.assert_allclose(at_joint, ratio ** (1.0 - powers) * at_motor, atol=1e-12)


def test_torque_is_the_sum_of_the_columns_of_each_joint():
    drive = DriveSet.parse("armature,viscous:joints=2,coulomb")
    q, qd, qdd, load = np.random.default_rng(4).normal(size=(4, 50, 3))
    drive = drive.with_term(LoadFriction())
    values = np.arange(1.0, 1.0 + 3 * drive.columns_per_joint)
    columns = [drive_columns(drive, k, q, qd, qdd, load=load) for k in range(3)]
    expected = np.column_stack(
        [own @ each for own, each in zip(values.reshape(3, -1), columns, strict=True)]
    )
    found = drive_torque(drive, values, q, qd, qdd, load=load)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    several = drive.with_term(LoadFriction(width=(0.1, 0.1, 0.1)))
    found = drive_torque(several, values, q, qd, qdd, load=load)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
