"""Gas or hydraulic cylinder between a point of the link and one of its parent."""

from __future__ import annotations

from dataclasses import replace

from asbuilt.dynamics.drives.term import (
    DriveTerm,
    NonlinearParameter,
    NonlinearValue,
    drive_term,
)
from asbuilt.dynamics.drives.terms.elastic.extension_spring import ARM, GEOMETRY, LENGTH

ELSEWHERE = (0.02, 0.15, 1.0, 0.1, 0.0)
"""Another place than that of springs, since two terms of one geometry have common parts."""


@drive_term
class Cylinder(DriveTerm):
    """Add `-Pc (1 + rate (length - l)) dl/dq`: a cylinder that pushes its ends apart.

    Its force is Pc [N] where its length l is `length`, and grows by the share `rate` [1/m] as it is
    pushed in: gas springs and accumulators to first order in the stroke. The ends are placed as
    those of an `extension_spring`.
    """

    inner: NonlinearValue = None
    outer: NonlinearValue = None
    angle: NonlinearValue = None
    length: NonlinearValue = None
    axial: NonlinearValue = None
    rate: NonlinearValue = None

    key = "cylinder"
    position = 73
    symbols = ("Pc",)
    columns = (f"-{ARM}*(1+rate*(length-{LENGTH}))/{LENGTH}",)
    formula = "-Pc (1 + rate (length - l)) inner outer sin(q + angle)/l"
    revolute_units = ("N",)
    prismatic_units = ("N",)
    nonlinear = (
        *(
            replace(each, default=at, typical=at)
            for each, at in zip(GEOMETRY, ELSEWHERE, strict=True)
        ),
        NonlinearParameter("rate", 0.0, 0.0, 1e3, "1/m", fitted=False),
    )
    by_construction = True
