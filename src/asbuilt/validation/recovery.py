"""Comparison of a result with the truth of a virtual robot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array
from asbuilt.dynamics.regressor import observation_matrix
from asbuilt.errors import ResultError
from asbuilt.experiment.virtual.virtual_robot import SimulatedRecording
from asbuilt.identification.result.feasible import (
    FeasibleInterval,
    evaluate_quantities,
    feasible_intervals,
)
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.tables import Column, Table, round_significant


@dataclass(frozen=True, slots=True, eq=False)
class Recovery:
    """Hold estimates with the truth.

    `truth`, `estimate` and `std_error` (p,) are of the base parameters `names`; `of_links` (p,)
    says which are of links, not of drives. `torque_error` is the torque error that the parameter
    errors make along a motion, `|W (estimate - truth)| / |W truth|`; `cad_error` is CAD's.
    `intervals` are the feasible intervals of masses, centres and armatures, `true_values` the truth
    by quantity.
    """

    robot: str
    names: tuple[str, ...]
    truth: Array
    estimate: Array
    std_error: Array
    of_links: NDArray[np.bool_]
    torque_error: float
    cad_error: float
    intervals: tuple[FeasibleInterval, ...] = ()
    true_values: Mapping[str, float] = field(default_factory=dict)

    @property
    def held(self) -> int:
        """How many feasible intervals hold the true value of their quantity."""
        return sum(
            interval.holds(self.true_values[interval.quantity]) for interval in self.intervals
        )

    def interval_table(self) -> Table:
        """Return the feasible intervals next to the truth."""
        return Table.of(
            self.intervals,
            (
                Column("quantity", width=30, of="quantity"),
                Column("CAD", align="right", of=lambda row: round_significant(row.cad)),
                Column("feasible (95 %)", of="text"),
                Column("chosen", align="right", of=lambda row: round_significant(row.chosen)),
                Column("truth", align="right", of=self._show_truth),
            ),
            "Feasible intervals and the truth",
        )

    def _show_truth(self, interval: FeasibleInterval) -> str:
        truth = self.true_values[interval.quantity]
        return round_significant(truth) + ("" if interval.holds(truth) else " (outside)")

    @property
    def deviations(self) -> Array:
        """`(estimate - truth) / std_error`, shape (p,); NaN for dropped parameters."""
        return (self.estimate - self.truth) / self.std_error

    def within(self, sigmas: float, *, of_links: bool | None = None) -> float:
        """Return the share of parameters within so many standard errors of the truth.

        Of all that have an error, of links, or of drives (`of_links` False).
        """
        # Dropped parameters have no error to be within.
        chosen = np.isfinite(self.std_error) & (
            True if of_links is None else self.of_links == of_links
        )
        return float(np.mean(np.abs(self.deviations[chosen]) <= sigmas))


def compare_with_truth(result: IdentificationResult, simulated: SimulatedRecording) -> Recovery:
    """Compare a result with the truth of a simulated recording, and predict its torque from both.

    The recording must have velocities and accelerations, and truth and result the same drive terms.
    A base tilt of the virtual robot is part of its truth.

    Raises
    ------
    ResultError
        If the joints or drive terms differ, or the recording has no velocities and accelerations.
    """
    base = result.base
    recording = simulated.recording
    if simulated.model.joint_names != result.model.joint_names or simulated.drive != base.drive:
        raise ResultError(
            f"the result has the joints {', '.join(result.model.joint_names)} and drive terms"
            f" {base.drive}, the truth {', '.join(simulated.model.joint_names)} and"
            f" {simulated.drive}"
        )
    if recording.qd is None or recording.qdd is None:
        raise ResultError(
            f"{recording.source} has no velocities and accelerations; record with"
            " DataLogger(accelerations=True)"
        )
    truth = base.values(simulated.truth)
    W = observation_matrix(
        result.model,
        recording.q,
        recording.qd,
        recording.qdd,
        drive=base.drive,
        columns=base.columns,
    )
    # Relative to the torque of the truth along the motion.
    size = float(np.linalg.norm(W @ truth))
    links = [link.name for link in result.model.links if not link.negligible]
    # Armatures only where the drive has them.
    rotors = ["armature"] * ("armature" in base.drive.keys)
    names = ("mass", *(f"mass:{name}" for name in links), "com", *rotors)
    return Recovery(
        robot=result.model.name,
        names=base.names,
        truth=truth,
        estimate=result.estimates,
        std_error=result.std_errors,
        of_links=base.columns < 10 * result.model.n_links,
        torque_error=float(np.linalg.norm(W @ (result.estimates - truth))) / size,
        cad_error=float(np.linalg.norm(W @ (np.nan_to_num(result.cad_values) - truth))) / size,
        intervals=feasible_intervals(result, names),
        true_values=evaluate_quantities(result, names, simulated.truth),
    )
