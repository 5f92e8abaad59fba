"""Gas or hydraulic cylinder between a point of the link and one of its parent."""

from __future__ import annotations

from asbuilt.dynamics.drives.term import DriveTerm, NonlinearValue, drive_term
from asbuilt.dynamics.drives.terms.elastic.extension_spring import ARM, GEOMETRY, LENGTH, STRETCH


@drive_term
class Cylinder(DriveTerm):
    """Add `-(Pc + Kc (length - l)) dl/dq`: a cylinder that pushes its ends apart.

    Its force is Pc [N] where its length l is `length`, and grows by Kc [N/m] as it is pushed in:
    gas springs and accumulators to first order in the stroke. The ends are placed as those of an
    `extension_spring`, and the column of Kc is that of its stiffness.
    """

    inner: NonlinearValue = None
    outer: NonlinearValue = None
    angle: NonlinearValue = None
    length: NonlinearValue = None
    axial: NonlinearValue = None

    key = "cylinder"
    position = 73
    symbols = ("Pc", "Kc")
    columns = (f"-{ARM}/{LENGTH}", STRETCH)
    formula = "-(Pc + Kc (length - l)) inner outer sin(q + angle)/l"
    revolute_units = ("N", "N/m")
    prismatic_units = ("N", "N/m")
    nonlinear = GEOMETRY
    by_construction = True
    ratio_powers = (1.0, 2.0)
