"""Smooth curve of torque over position, as of a cable that a joint bends and coils."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping

from asbuilt.dynamics.drives.term import (
    DriveTerm,
    NonlinearParameter,
    NonlinearValue,
    drive_term,
)

HIGHEST = 7
"""Powers of position: the order of Wang et al. (RA-L 4, 2019) for the cable of a master arm."""
CURVE = tuple(
    "*".join([f"minimum(maximum(order-{k - 1},0),1)", *[f"(q/{math.pi})"] * k])
    for k in range(1, HIGHEST + 1)
)
"""Powers of position over half a turn; those above the order are zero."""
ORDER = NonlinearParameter("order", float(HIGHEST), 1.0, float(HIGHEST), "", fitted=False)


def of_curve(order: float, *, own: str = "") -> tuple[Mapping[Hashable, float], ...]:
    """Return each column as elementary functions, powers of q; none above the order."""
    return tuple(
        {(own, "q", k) if own or k > 1 else "q": math.pi**-k} if k <= order else {}
        for k in range(1, HIGHEST + 1)
    )


@drive_term
class Cable(DriveTerm):
    """Add `sum_k Cq_k (q / pi)^k` up to the `order`, 7 unless stated; the offset is its constant.

    Lower orders extrapolate better: choose the least whose held-out error is that of the best.
    """

    order: NonlinearValue = None

    key = "cable"
    position = 74
    symbols = tuple(f"C{k}q" for k in range(1, HIGHEST + 1))
    columns = CURVE
    formula = "sum_k Ckq (q/pi)^k, k <= order"
    revolute_units = ("N m",) * HIGHEST
    prismatic_units = ("N",) * HIGHEST
    nonlinear = (ORDER,)
    by_construction = True

    def powers_of_ratio(self) -> tuple[float, ...]:
        """Return 1 + k for the power k of position."""
        return tuple(1.0 + k for k in range(1, HIGHEST + 1))

    def functions(self) -> tuple[Mapping[Hashable, float], ...]:
        """Return the powers; the first is that of a spring."""
        return of_curve(self.value("order"))
