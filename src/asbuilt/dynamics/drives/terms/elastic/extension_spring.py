"""Spring between a point of the link and one of its parent."""

from __future__ import annotations

from asbuilt.dynamics.drives.term import (
    DriveTerm,
    NonlinearParameter,
    NonlinearValue,
    drive_term,
)


@drive_term
class ExtensionSpring(DriveTerm):
    """Add `Ke (1 - length / l) inner outer sin(q + angle)`, l being the length of the spring.

    Its ends are at the distances `inner` and `outer` from the joint axis and at the angle `q +
    angle` to each other: `l^2 = inner^2 + outer^2 - 2 inner outer cos(q + angle)`. With the free
    length `length` and the stiffness Ke its energy is `Ke (l - length)^2 / 2`, whose derivative by
    q is the term. State all four lengths and angles that the geometry gives.
    """

    inner: NonlinearValue = None
    outer: NonlinearValue = None
    angle: NonlinearValue = None
    length: NonlinearValue = None

    key = "extension_spring"
    position = 72
    symbols = ("Ke",)
    columns = (
        "inner*outer*sin(q+angle)"
        "*(1-length/sqrt(inner*inner+outer*outer-2*inner*outer*cos(q+angle)))",
    )
    formula = "Ke (1 - length/l) inner outer sin(q + angle)"
    revolute_units = ("N/m",)
    prismatic_units = ("N/m",)
    nonlinear = (
        NonlinearParameter(
            "inner", 0.01, 1e-4, 10.0, "m", fitted=False, of_geometry=True, typical=0.01
        ),
        NonlinearParameter(
            "outer", 0.1, 1e-4, 10.0, "m", fitted=False, of_geometry=True, typical=0.1
        ),
        NonlinearParameter(
            "angle", 0.0, -7.0, 7.0, "rad", fitted=False, of_geometry=True, typical=0.4
        ),
        NonlinearParameter(
            "length", 0.05, 0.0, 10.0, "m", fitted=False, of_geometry=True, typical=0.06
        ),
    )
    by_construction = True
    ratio_powers = (2.0,)
