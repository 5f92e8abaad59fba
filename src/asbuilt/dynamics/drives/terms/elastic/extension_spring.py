"""Spring between a point of the link and one of its parent."""

from __future__ import annotations

from asbuilt.dynamics.drives.term import (
    DriveTerm,
    NonlinearParameter,
    NonlinearValue,
    drive_term,
)

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
    prismatic_units = ("N/m",)
    nonlinear = GEOMETRY
    by_construction = True
    ratio_powers = (2.0,)
