"""What the estimated delay of a position servo adds to the errors of the robot's parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.identification.errors.delay_errors import DelayErrors
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.information.square_root_information import SquareRootInformation
from asbuilt.identification.servo.servo_rows import ServoRows


@dataclass(frozen=True, slots=True, eq=False)
class DelaySlopes:
    """Hold `sum of W_k du/dt` of each joint's rows by parameter name, per sample.

    The torque `kp (u(t - d) - q)` falls by `kp du/dt` per delay.
    """

    names: tuple[tuple[str, ...], ...]
    means: tuple[Array, ...]

    @classmethod
    def of(cls, rows: ServoRows, base: BaseParameters, counted: Sequence[bool]) -> DelaySlopes:
        """Return the slopes of rows whose time blocks count."""
        weight = np.array(counted, dtype=np.float64)
        names, means = [], []
        count = float(weight @ [block.n_samples for block in rows.times])
        for k, support in enumerate(rows.support):
            gram = rows.total(k, weight)
            names.append(tuple(base.names[j] for j in support))
            means.append(gram[: support.size, support.size + 1] / max(count, 1.0))
        return cls(tuple(names), tuple(means))


def servo_delay_errors(
    information: SquareRootInformation,
    estimate: Estimate,
    slopes: DelaySlopes,
    kp: Sequence[float],
    delay: float,
    std_error: float,
) -> DelayErrors | None:
    """Return what a delay with this standard error [s] adds; None if it is known.

    Parameters follow the delay by `-(W^T W)^-1 sum_k w_k^2 kp_k W_k^T du/dt`, with the information
    of the estimate, that of CAD included.
    """
    if not 0.0 < std_error < np.inf:
        return None
    base = information.base
    place = {name: j for j, name in enumerate(base.names)}
    side = np.zeros(base.n_base)
    for names, mean, stiffness, weight in zip(
        slopes.names, slopes.means, kp, estimate.weights, strict=True
    ):
        for name, value in zip(names, mean, strict=True):
            if name in place:
                side[place[name]] += weight**2 * stiffness * value * information.n_samples
    root = estimate.solution.inverse_root
    follows = -root @ (root.T @ side)
    return DelayErrors(np.outer(follows, follows) * std_error**2, -follows * delay)
