"""Springs that the description lacks, such as cables, hoses and counterbalances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.drives.terms.spring import Spring
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.identification.bodies.body_bounds import generous_bounds
from asbuilt.identification.bodies.cad_prior import cad_prior
from asbuilt.identification.bodies.conic_fit import ConicProblem
from asbuilt.identification.drives.drive_choice import (
    CERTAIN,
    CERTAIN_TOGETHER,
    FEWEST_BLOCKS,
    Gain,
    surely_positive,
)
from asbuilt.identification.estimators.consistent_fit import fit_consistent
from asbuilt.identification.information.held_out import held_out_errors
from asbuilt.identification.information.square_root_information import accumulate_stream

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples


WORTH = 0.2
"""Least fraction by which a suspected spring lowers its joint's torque error."""
PROMISING = 0.5 * WORTH
"""Least such fraction, with the links as they are or free, from which a spring is tried."""


@dataclass(frozen=True, slots=True)
class SuspectedSpring:
    """Hold a suspected spring at a joint (from 0): stiffness and RMS torque errors.

    The stiffness is in N m/rad or N/m, the errors on held-out time blocks without and with it.
    """

    joint: int
    joint_name: str
    stiffness: float
    unit: str
    error_without: float
    error_with: float

    def __str__(self) -> str:
        return (
            f"{self.joint_name} {self.stiffness:.2g} {self.unit} (torque error on held-out time"
            f" blocks {self.error_without:.3g} -> {self.error_with:.3g})"
        )


def suspected_springs(
    model: RobotModel,
    samples: Sequence[Samples],
    drive: DriveSet,
    *,
    block_seconds: float | None = None,
) -> tuple[SuspectedSpring, ...]:
    """Return the springs that lower the torque error on held-out blocks, best first.

    `drive` has the terms of the robot with all described springs. Each other joint is tried alone:
    the error must fall by a fifth at the joint, by two standard errors over folds there and by one
    over all joints, and the stiffness must be positive by two jackknife standard errors. Physical
    consistency is imposed, since negative inertias imitate springs. Too few time blocks give none.
    """
    plain = _HeldOut.of(model, samples, drive, None, block_seconds)
    if len(plain.errors) < FEWEST_BLOCKS:
        return ()
    described = next((term for term in drive.terms if term.key == Spring.key), None)
    promising = _promising(model, samples, drive, plain, block_seconds)
    found = []
    for joint, place in enumerate(model.joints):
        if not promising[joint] or (described is not None and described.is_at(joint)):
            continue
        sprung = {joint + 1} if described is None else {joint + 1, *(described.joints or ())}
        tried = _HeldOut.of(
            model,
            samples,
            drive.with_term(Spring(joints=tuple(sorted(sprung)))),
            plain.weights,
            block_seconds,
        )
        own = Gain.between(plain.errors[:, joint], tried.errors[:, joint])
        together = Gain.between(plain.errors * plain.weights**2, tried.errors * plain.weights**2)
        stiffness = tried.parameters[:, [tried.names.index(f"{Spring.symbols[0]}{joint + 1}")]]
        if (
            own.fraction > WORTH
            and own.exceeds(CERTAIN)
            and together.exceeds(CERTAIN_TOGETHER)
            and bool(surely_positive(stiffness)[0])
        ):
            unit = (Spring.revolute_units if place.is_revolute else Spring.prismatic_units)[0]
            without, with_it = (
                float(np.sqrt(each.errors[:, joint].mean())) for each in (plain, tried)
            )
            found.append(
                (
                    together.log,
                    SuspectedSpring(
                        joint, place.name, float(stiffness.mean()), unit, without, with_it
                    ),
                )
            )
    return tuple(spring for _, spring in sorted(found, key=lambda each: -each[0]))


def _promising(
    model: RobotModel,
    samples: Sequence[Samples],
    drive: DriveSet,
    plain: _HeldOut,
    block_seconds: float | None,
) -> list[bool]:
    """Return for each joint whether a spring could lower its torque error noticeably.

    The residual of the fits without springs is projected on the spring, without what the joint's
    other drive terms can do, and without what all its parameters can do if they are free.
    """
    base = find_base_parameters(model, drive.with_term(Spring()))
    information = accumulate_stream(model, base, samples, block_seconds=block_seconds)
    known = dict(zip(plain.names, plain.parameters.mean(axis=0), strict=True))
    beta = np.array([known.get(name, 0.0) for name in base.names])
    drives = base.columns >= 10 * model.n_links
    found = []
    for k, (support, factor) in enumerate(
        zip(information.support, information.joint_factors, strict=True)
    ):
        own = np.array([base.names[j] == f"{Spring.symbols[0]}{k + 1}" for j in support])
        residual = factor[:, -1] - factor[:, :-1] @ beta[support]
        energy = float(residual @ residual)
        gains = [
            _gain(factor[:, :-1][:, own], factor[:, :-1][:, others & ~own], residual)
            for others in (drives[support], np.ones(support.size, dtype=np.bool_))
        ]
        found.append(not np.any(own) or max(gains) > PROMISING * energy)
    return found


def _gain(column: Array, others: Array, residual: Array) -> float:
    """Return by how much a column (m, 1) without its part in others lowers the squares."""
    x = column - others @ np.linalg.lstsq(others, column, rcond=None)[0]
    size = float(np.sum(x**2))
    return float(np.sum(x[:, 0] @ residual)) ** 2 / size if size > 0.0 and x.size else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class _HeldOut:
    """Hold held-out errors (folds, n) and parameters (folds, p) of consistent fits."""

    errors: Array
    parameters: Array
    names: tuple[str, ...]
    weights: Array

    @classmethod
    def of(
        cls,
        model: RobotModel,
        samples: Sequence[Samples],
        drive: DriveSet,
        weights: Array | None,
        block_seconds: float | None,
    ) -> _HeldOut:
        base, prior = find_base_parameters(model, drive), cad_prior(model, drive)
        information = accumulate_stream(model, base, samples, block_seconds=block_seconds)
        chosen = fit_consistent(information, prior).weights if weights is None else weights
        with one_blas_thread():
            problem = ConicProblem.of(prior, base.regrouping, generous_bounds(prior))
            errors, betas = held_out_errors(
                information,
                lambda part: base.regrouping @ problem.fit(part.stacked(chosen), rough=True).chi,
            )
        return cls(errors, betas, tuple(base.names), chosen)
