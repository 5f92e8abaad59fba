"""Torque by the position of the joint alone, from springs, cables and counterweights."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping
from dataclasses import replace
from typing import ClassVar

from asbuilt.dynamics.drives.term import DriveTerm, NonlinearParameter, NonlinearValue, drive_term

HIGHEST = 7
"""Powers of position: the order of Wang et al. (RA-L 4, 2019) for the cable of a master arm."""
LENGTH = "sqrt(inner*inner+outer*outer+axial*axial-2*inner*outer*cos(q+angle))"
ARM = "inner*outer*sin(q+angle)"
"""Distance of the ends, and its derivative by q times itself."""
STRETCH = f"{ARM}*(1-length/{LENGTH})"
"""Derivative by q of half the square of what the distance exceeds `length` by."""
GEOMETRY = (
    NonlinearParameter(
        "inner", 0.01, 1e-4, 10.0, "m", fitted=False, of_geometry=True, typical=0.01
    ),
    NonlinearParameter("outer", 0.1, 1e-4, 10.0, "m", fitted=False, of_geometry=True, typical=0.1),
    NonlinearParameter("angle", 0.0, -7.0, 7.0, "rad", fitted=False, of_geometry=True, typical=0.4),
    NonlinearParameter(
        "length", 0.05, 0.0, 10.0, "m", fitted=False, of_geometry=True, typical=0.06
    ),
    NonlinearParameter("axial", 0.0, 0.0, 10.0, "m", fitted=False),
)
"""Where the ends are about the joint axis, and the free length."""
ELSEWHERE = (0.02, 0.15, 1.0, 0.1, 0.0)
"""A place other than the springs', since two terms of one geometry have common parts."""


HARMONICS = NonlinearParameter("harmonics", 1.0, 1.0, 2.0, "", fitted=False)


@drive_term
class Balancer(DriveTerm):
    """Add `Bs sin(q) + Bc cos(q)`; with two `harmonics` also `B2s sin(2 q) + B2c cos(2 q)`.

    One is the torque of a weight, or of a spring without free length. The torque of any force
    between a point of the link and one of its parent is an odd function of the angle between both,
    whose second harmonic is about `inner outer / (inner^2 + outer^2)` of the first, the third the
    square of this part.

    If gravity has a fixed direction in the parent link, the first harmonic is dependent on the
    first moment of the link.
    """

    harmonics: NonlinearValue = None

    key = "balancer"
    position = 80
    symbols = ("Bs", "Bc", "B2s", "B2c")
    columns = ("sin(q)", "cos(q)", "(harmonics-1)*sin(2*q)", "(harmonics-1)*cos(2*q)")
    formula = "Bs sin(q) + Bc cos(q) + B2s sin(2 q) + B2c cos(2 q), the latter for harmonics = 2"
    nonlinear = (HARMONICS,)
    by_construction = True
    turns_over = True

    def functions(self) -> tuple[Mapping[Hashable, float], ...]:
        """Return the harmonics, none above the highest; links imitate the first."""
        second = self.value("harmonics") > 1.0
        return (
            {"sin(q)": 1.0},
            {"cos(q)": 1.0},
            {"sin(2*q)": 1.0} if second else {},
            {"cos(2*q)": 1.0} if second else {},
        )


@drive_term
class Spring(DriveTerm):
    """Add `Ks (q - rest)`; with an offset, the spring is at rest at `q = rest - Fo / Ks`.

    Cables that coil about an axis have this effect. No link has: the potential energy of gravity
    has no term quadratic in a position.
    """

    rest: NonlinearValue = None

    key = "spring"
    position = 70
    symbols = ("Ks",)
    columns = ("q-rest",)
    formula = "Ks (q - rest)"
    revolute_units = ("N m/rad",)
    nonlinear = (NonlinearParameter("rest", 0.0, -1e3, 1e3, "rad or m", fitted=False),)
    by_construction = True
    ratio_powers = (2.0,)

    def functions(self) -> tuple[Mapping[Hashable, float], ...]:
        """Return the position, and a constant where the spring is at rest elsewhere than at 0."""
        rest = self.value("rest")
        found: Mapping[Hashable, float] = {"q": 1.0, "1": -rest} if rest else {"q": 1.0}
        return (found,)


CURVE = tuple(
    "*".join([f"minimum(maximum(order-{k - 1},0),1)", *[f"(q/{math.pi})"] * k])
    for k in range(1, HIGHEST + 1)
)
"""Powers of position over half a turn; those above the order are zero."""
ORDER = NonlinearParameter("order", float(HIGHEST), 1.0, float(HIGHEST), "", fitted=False)


@drive_term
class Cable(DriveTerm):
    """Add `sum_k Cq_k (q / pi)^k` up to the `order`, 7 unless stated; the offset is its constant.

    Lower orders extrapolate better: choose the least whose held-out error is as low as the best.
    """

    order: NonlinearValue = None

    key = "cable"
    position = 74
    symbols = tuple(f"C{k}q" for k in range(1, HIGHEST + 1))
    columns = CURVE
    formula = "sum_k Ckq (q/pi)^k, k <= order"
    nonlinear = (ORDER,)
    by_construction = True
    ratio_powers = tuple(1.0 + k for k in range(1, HIGHEST + 1))

    def functions(self) -> tuple[Mapping[Hashable, float], ...]:
        """Return the powers of q, none above the order; the first is the term of a spring.

        Nothing else has the powers of the far side of a drive.
        """
        own = self.key if self.of_motor else ""
        order = self.value("order")
        return tuple(
            {(own, "q", k) if own or k > 1 else "q": math.pi**-k} if k <= order else {}
            for k in range(1, HIGHEST + 1)
        )


@drive_term
class ExtensionSpring(DriveTerm):
    """Add `Ke (1 - length / l) inner outer sin(q + angle)`, l being the length of the spring.

    Its ends are at the distances `inner` and `outer` from the joint axis, at the angle `q + angle`
    to each other and `axial` apart along it: `l^2 = inner^2 + outer^2 + axial^2 - 2 inner outer
    cos(q + angle)`. With the free length `length` and the stiffness Ke its energy is
    `Ke (l - length)^2 / 2`, whose derivative by q is the term. State all lengths and angles that
    the geometry gives, or the points of both ends in `[[springs]]` of a robot file.
    """

    inner: NonlinearValue = None
    outer: NonlinearValue = None
    angle: NonlinearValue = None
    length: NonlinearValue = None
    axial: NonlinearValue = None

    key = "extension_spring"
    position = 72
    symbols = ("Ke",)
    columns = (STRETCH,)
    formula = "Ke (1 - length/l) inner outer sin(q + angle)"
    revolute_units = ("N/m",)
    nonlinear: ClassVar[tuple[NonlinearParameter, ...]] = GEOMETRY
    by_construction = True
    ratio_powers: ClassVar[tuple[float, ...]] = (2.0,)


@drive_term
class Cylinder(ExtensionSpring):
    """Add `-Pc (1 + rate (length - l)) dl/dq`: a cylinder that pushes its ends apart.

    Its force is Pc [N] where its length l is `length`, and grows by the share `rate` [1/m] as it is
    pushed in: gas springs and accumulators to first order in the stroke. The ends are placed as
    in an `extension_spring`.
    """

    rate: NonlinearValue = None

    key = "cylinder"
    position = 73
    symbols = ("Pc",)
    columns = (f"-{ARM}*(1+rate*(length-{LENGTH}))/{LENGTH}",)
    formula = "-Pc (1 + rate (length - l)) inner outer sin(q + angle)/l"
    revolute_units = ("N",)
    nonlinear = (
        *(
            replace(each, default=at, typical=at)
            for each, at in zip(GEOMETRY, ELSEWHERE, strict=True)
        ),
        NonlinearParameter("rate", 0.0, 0.0, 1e3, "1/m", fitted=False),
    )
    ratio_powers = ()
