"""Friction that grows with a power of speed."""

from __future__ import annotations

from collections.abc import Hashable, Mapping

from asbuilt.dynamics.drives.term import (
    ALL_SOURCES,
    DriveTerm,
    NonlinearParameter,
    NonlinearValue,
    drive_term,
)


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
    prismatic_units = ("N (s/m)^a",)
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
