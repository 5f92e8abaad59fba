"""Sizes of errors of a log: what a robot in use can have, and what matters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.validation.log_errors.error_columns import Kind

NORMAL_95 = 1.959964
"""Standard errors on either side of a 95 % interval."""


@dataclass(frozen=True, slots=True)
class Bounds:
    """Say between which values an error is plausible, and from which size on it matters."""

    lowest: float
    highest: float
    matters: float

    def hold(self, value: float, std_error: float) -> bool:
        """Return whether the 95 % interval of a value is plausible.

        One that reaches beyond is that of a column which resembles something else that the model
        lacks.

        >>> BOUNDS["zero"].hold(-0.1, 0.04), BOUNDS["zero"].hold(-0.3, 0.04)
        (True, False)
        """
        reach = NORMAL_95 * std_error
        return bool(self.lowest <= value - reach and value + reach <= self.highest)


BOUNDS: dict[Kind, Bounds] = {
    "clock": Bounds(-0.4, 0.6, 0.01),
    "zero": Bounds(-np.deg2rad(20.0), np.deg2rad(20.0), np.deg2rad(0.3)),
    "scale": Bounds(-1.15, 1.0, 0.03),
    "nonlinear": Bounds(-0.8, 0.0, 0.05),
    "drift": Bounds(-np.inf, np.inf, 0.02),
    "warming": Bounds(-1.5, 1.5, 0.05),
    "spring": Bounds(0.0, np.inf, 0.02),
}
"""Own choices: what a robot in use can have; `drift` and `spring` in largest torques of a joint."""
CLOCK_FACTORS = (0.1, 0.125, 0.2, 0.25, 0.4, 0.5, 2.0, 2.5, 4.0, 5.0, 8.0, 10.0)
"""Factors by which clocks are wrong beyond these bounds: ratios of usual rates (1000, 500, 400,
250, 200, 125, 100 Hz), samples left out, another unit."""
ABOUT = 1.06
"""Factor within which a clock is off by one of them; errors of single gains imitate others."""
IN_TORQUES = ("drift", "spring")
NAMED = 0.05
"""Share of the squared residual from which on an error is named."""
PRISMATIC_ZERO = Bounds(-0.05, 0.05, 1e-3)
