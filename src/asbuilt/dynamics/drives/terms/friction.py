"""Inertia and friction of a drive by the motion of its joint alone, and its constant torque."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from typing import ClassVar

from asbuilt.dynamics.drives.term import (
    ALL_SOURCES,
    MOTOR_SOURCES,
    DriveTerm,
    NonlinearParameter,
    NonlinearValue,
    drive_term,
)


@drive_term
class Armature(DriveTerm):
    """Add `Ia qdd`; gyroscopic torques of the rotor are neglected.

    A sensor between gear and joint does not measure it.
    """

    key = "armature"
    position = 10
    symbols = ("Ia",)
    columns = ("qdd",)
    formula = "Ia qdd"
    revolute_units = ("kg m^2",)
    cause = "armature"
    non_negative = True
    ratio_powers = (2.0,)
    default_for: ClassVar[tuple[str, ...]] = MOTOR_SOURCES
    tried_for: ClassVar[tuple[str, ...]] = ("unknown",)


@drive_term
class Coulomb(DriveTerm):
    """Add `Fc sign(qd)`, exactly 0 at standstill."""

    key = "coulomb"
    title = "Coulomb friction"
    position = 30
    symbols = ("Fc",)
    columns = ("sign(qd)",)
    formula = "Fc sign(qd)"
    cause = "friction"
    non_negative = True
    default_for: ClassVar[tuple[str, ...]] = ALL_SOURCES


@drive_term
class Viscous(DriveTerm):
    """Add `Fv qd`."""

    key = "viscous"
    title = "viscous friction"
    position = 20
    symbols = ("Fv",)
    columns = ("qd",)
    formula = "Fv qd"
    revolute_units = ("N m s/rad",)
    cause = "friction"
    non_negative = True
    ratio_powers = (2.0,)
    default_for: ClassVar[tuple[str, ...]] = ALL_SOURCES


@drive_term
class Offset(DriveTerm):
    """Add `Fo`."""

    key = "offset"
    title = "torque offset"
    position = 90
    symbols = ("Fo",)
    columns = ("1",)
    formula = "Fo"
    cause = "offset"
    turns_over = True
    default_for = ALL_SOURCES


@drive_term
class AsymmetricViscous(DriveTerm):
    """Add `Fvp qd` where qd > 0 and `Fvn qd` where qd < 0. It replaces `viscous`."""

    key = "asymmetric_viscous"
    title = "asymmetric viscous friction"
    position = 22
    symbols = ("Fvp", "Fvn")
    columns = ("maximum(qd, 0)", "minimum(qd, 0)")
    formula = "Fvp max(qd, 0) + Fvn min(qd, 0)"
    revolute_units = ("N m s/rad", "N m s/rad")
    tried_for = ALL_SOURCES
    stands_for = "viscous"
    non_negative = True
    ratio_powers = (2.0, 2.0)

    def functions(self) -> tuple[Mapping[Hashable, float], ...]:
        """Return halves of `qd` and `abs(qd)`, so that `viscous` is dependent on them."""
        return ({"qd": 0.5, "abs(qd)": 0.5}, {"qd": 0.5, "abs(qd)": -0.5})


@drive_term
class AsymmetricCoulomb(DriveTerm):
    """Add `Fcp` where qd > 0 and `-Fcn` where qd < 0.

    It equals Coulomb friction (Fcp + Fcn) / 2 and an offset (Fcp - Fcn) / 2 that is zero at
    standstill. It replaces `coulomb`.
    """

    key = "asymmetric_coulomb"
    title = "asymmetric Coulomb friction"
    position = 32
    symbols = ("Fcp", "Fcn")
    columns = ("maximum(sign(qd), 0)", "minimum(sign(qd), 0)")
    formula = "Fcp [qd > 0] - Fcn [qd < 0]"
    stands_for = "coulomb"
    non_negative = True

    def functions(self) -> tuple[Mapping[Hashable, float], ...]:
        """Return halves of `sign(qd)` and 1, on which `coulomb` and `offset` are dependent."""
        return ({"sign(qd)": 0.5, "1": 0.5}, {"sign(qd)": 0.5, "1": -0.5})


@drive_term
class SmoothCoulomb(DriveTerm):
    """Add `Fct tanh(qd / width)`. It replaces `coulomb`, or is added to it.

    Below the width, bristles bend before surfaces slide, and logged velocities are mostly noise. A
    fit tries widths up to a tenth of the top speed.
    """

    width: NonlinearValue = None

    key = "smooth_coulomb"
    title = "smooth Coulomb friction"
    position = 34
    symbols = ("Fct",)
    columns = ("tanh(qd/width)",)
    formula = "Fct tanh(qd / width)"
    nonlinear = (
        NonlinearParameter(
            "width", 0.02, 1e-4, 2.0, "rad/s", typical=2.0, speed=True, credible=(0.0, 0.1)
        ),
    )
    tried_for = ALL_SOURCES
    stands_for = "coulomb"
    non_negative = True


@drive_term
class Stribeck(DriveTerm):
    """Add `Fs exp(-|qd / velocity|^power) sign(qd)` to Coulomb friction.

    The velocity is that at which lubricant begins to part the surfaces: 1e-5 to 0.1 m/s of sliding.
    On a motor shaft of 2 cm radius behind a gear of 50 or more that is at most 0.1 rad/s at the
    joint; a tenth of the top speed, 0.2 to 0.3 rad/s for most arms, is a generous bound for a fit.
    What fades at higher speeds has another cause, such as grease that thins with shear.

    Source: Armstrong-Helouvry, Dupont and Canudas de Wit, Automatica 30, 1994, section 2.
    """

    velocity: NonlinearValue = None
    power: NonlinearValue = None

    key = "stribeck"
    title = "Stribeck friction"
    position = 40
    symbols = ("Fs",)
    columns = ("sign(qd)*exp(-abs(qd/velocity)**power)",)
    formula = "Fs exp(-|qd/velocity|^power) sign(qd)"
    nonlinear = (
        NonlinearParameter(
            "velocity", 0.1, 1e-3, 5.0, "rad/s", typical=2.0, speed=True, credible=(0.0, 0.1)
        ),
        NonlinearParameter("power", 2.0, 0.5, 4.0, "", fitted=False, typical=2.0),
    )
    tried_for = ALL_SOURCES


@drive_term
class Power(DriveTerm):
    """Add `Fp |qd|^exponent sign(qd)`. It replaces `viscous`.

    It describes rolling bearings and grease that thins with shear (exponent 2/3 and less) and
    churned oil (towards 2).

    Source: Palmgren, Grundlagen der Waelzlagertechnik, 1957: the torque of a lubricated bearing
    without load grows with the 2/3 power of speed.
    """

    exponent: NonlinearValue = None

    key = "power"
    title = "power-law friction"
    position = 50
    symbols = ("Fp",)
    columns = ("sign(qd)*abs(qd)**exponent",)
    formula = "Fp |qd|^exponent sign(qd)"
    revolute_units = ("N m (s/rad)^a",)
    nonlinear = (NonlinearParameter("exponent", 0.5, 0.0, 4.0, "", credible=(0.25, 2.5)),)
    tried_for = ALL_SOURCES
    stands_for = "viscous"

    def powers_of_ratio(self) -> tuple[float, ...]:
        """Return 1 + exponent."""
        return (1.0 + self.value("exponent"),)

    def functions(self) -> tuple[Mapping[Hashable, float], ...]:
        """Return the power; with exponents 0, 1, 2 and 3 it equals another term."""
        exponent = self.value("exponent")
        equal: dict[float, str] = {0.0: "sign(qd)", 1.0: "qd", 2.0: "qd*abs(qd)", 3.0: "qd*qd*qd"}
        return ({equal.get(exponent, (self.key, exponent)): 1.0},)


@drive_term
class Quadratic(DriveTerm):
    """Add `Fq qd |qd|`."""

    key = "quadratic"
    title = "quadratic friction"
    position = 52
    symbols = ("Fq",)
    columns = ("qd*abs(qd)",)
    formula = "Fq qd |qd|"
    revolute_units = ("N m s^2/rad^2",)
    tried_for = ALL_SOURCES
    ratio_powers = (3.0,)


@drive_term
class Cubic(DriveTerm):
    """Add `Fk qd^3`; negative with viscous friction that levels off at high speed."""

    key = "cubic"
    title = "cubic friction"
    position = 54
    symbols = ("Fk",)
    columns = ("qd*qd*qd",)
    formula = "Fk qd^3"
    revolute_units = ("N m s^3/rad^3",)
    ratio_powers = (4.0,)
