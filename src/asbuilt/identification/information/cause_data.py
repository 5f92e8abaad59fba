"""Data of a recording for effects that CAD lacks, as one triangular factor per joint."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.codec import stored
from asbuilt.description.model import PLAIN_TERMS, RobotModel
from asbuilt.description.rotation import axes_across
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.drives.selection import DriveSet, available_terms
from asbuilt.dynamics.drives.term import DriveTerm
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.dynamics.newton_euler import gravity_torque
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.errors import IdentifiabilityError, ResultError
from asbuilt.identification.information.rows import JointFactors, SampleBlock, sample_blocks
from asbuilt.identification.information.triangular import (
    packed_triangle,
    unpacked_triangle,
    widened,
)

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples


RICHER_TERMS = ("load_friction", "quadratic", "stribeck")
"""Further friction terms that are linear, or linear with their default nonlinear parameter."""
TILTS = ("tilt 1", "tilt 2")
HELD_BACK = 3
"""Without held-out recordings every so many blocks of the data used are held out."""
TRIANGLES = stored(
    encode=lambda factors: [packed_triangle(factor) for factor in factors],
    decode=lambda texts: tuple(unpacked_triangle(text) for text in texts),
)
"""Factors are stored as upper triangles, row by row, as base64 of little-endian doubles."""


@dataclass(frozen=True, eq=False)
class CauseData:
    """Hold the triangular factors of `[A_k | tau_k]` of every joint k, of fitted and held-out data.

    The named columns A are the base parameters of the links, plain and some further drive terms,
    and two angles [rad] of base tilt about `tilt_axes` (2, 3) of the root frame: the torque of the
    links by design under gravity `g x axis`. Joint k has the columns `support[k]`; `fitted[k]` and
    `judged[k]` (held out) have shape (p_k + 1, p_k + 1). A change x of the parameters changes the
    torque by `A x`, so payload, gains, friction and other CAD values are linear here.
    """

    drive: DriveSet = field(
        metadata=stored(encode=lambda drive: list(drive.specifications), decode=DriveSet.parse)
    )
    joint_names: tuple[str, ...] = field(metadata=stored(key="joints"))
    names: tuple[str, ...] = field(metadata=stored(key="columns"))
    support: tuple[Indices, ...]
    fitted: tuple[Array, ...] = field(metadata=TRIANGLES)
    judged: tuple[Array, ...] = field(metadata=TRIANGLES)
    n_fitted: int
    n_judged: int
    judged_by: str
    tilt_axes: Array

    def __post_init__(self) -> None:
        for support, *factors in zip(self.support, self.fitted, self.judged, strict=True):
            for factor in factors:
                if factor.shape != (len(support) + 1, len(support) + 1):
                    raise ResultError(
                        f"a factor of {len(support)} columns and the torque has shape"
                        f" {factor.shape}; identify again"
                    )
                factor.setflags(write=False)
        self.tilt_axes.setflags(write=False)

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    def places(self, names: Iterable[str]) -> Indices:
        """Return the column of each name; raises `ResultError` for an unknown one."""
        index = {name: j for j, name in enumerate(self.names)}
        missing = [name for name in names if name not in index]
        if missing:
            raise ResultError(
                f"the cause data have no column {missing[0]!r}; identify again with this version"
            )
        return np.array([index[name] for name in names], dtype=np.int64)

    def whole(self, factors: tuple[Array, ...]) -> tuple[Array, ...]:
        """Return factors (p_k + 1, p + 1) with a column for every name and the torque last."""
        return tuple(
            widened(factor, support, len(self.names))
            for support, factor in zip(self.support, factors, strict=True)
        )

    def error_of(self, names: Iterable[str], values: Array) -> Array:
        """Return the RMS torque error (n,) on held-out data of named parameters, others zero."""
        places = self.places(names)
        errors = [factor[:, -1] - factor[:, places] @ values for factor in self.whole(self.judged)]
        return np.asarray(
            [float(np.linalg.norm(error)) for error in errors] / np.sqrt(self.n_judged)
        )


def usual_terms() -> tuple[DriveTerm, ...]:
    """Return the plain and some richer drive terms, at every joint."""
    known = available_terms()
    return tuple(known[key] for key in (*PLAIN_TERMS, *RICHER_TERMS) if key in known)


def gather_cause_data(
    model: RobotModel,
    base: BaseParameters,
    fitted: Iterable[Samples],
    judged: Iterable[Samples] = (),
    *,
    block_seconds: float | None = None,
) -> CauseData:
    """Reduce samples to cause data in one pass.

    Parameters
    ----------
    model, base
        The robot as designed and the base parameters of a result.
    fitted
        Samples of the fit.
    judged
        Held-out samples; by default every third time block of the others is held out.
    block_seconds
        Length of a time block [s].

    Raises
    ------
    IdentifiabilityError
        If no samples are left to fit, or none to hold out.
    """
    drive = base.drive
    for term in usual_terms():
        if term.key not in drive.keys or term.key in PLAIN_TERMS:
            drive = drive.with_term(term)  # at every joint, though the result has it at some
    links = 10 * model.n_links
    columns = np.concatenate(
        [
            base.columns[base.columns < links],
            links + np.arange(model.n_joints * drive.columns_per_joint),
        ]
    )
    names = [base.standard_names[j] for j in base.columns if j < links]
    names += [name for k in range(model.n_joints) for name in drive.names(k + 1)]
    plan = RegressorPlan.of(model, drive, columns, spare_rows=len(TILTS) + 1)
    axes = axes_across(model.gravity)
    tilted = [model.with_gravity(np.cross(model.gravity, axis)) for axis in axes]
    two = JointFactors(plan), JointFactors(plan)

    def turned(part: SampleBlock) -> Callable[[slice], list[Array]]:
        q = part.samples.q
        return lambda span: [gravity_torque(robot, q[span]) for robot in tilted]

    sources: dict[str, None] = {}
    with one_blas_thread():
        for part in sample_blocks(model, judged, block_seconds):
            sources[part.samples.source] = None
            two[1].add(part, turned(part))
        for number, part in enumerate(sample_blocks(model, fitted, block_seconds)):
            two[1 if not sources and number % HELD_BACK == HELD_BACK - 1 else 0].add(
                part, turned(part)
            )
        factors = [reduction.factors() for reduction in two]
    if not two[0].n_samples or not two[1].n_samples:
        raise IdentifiabilityError(
            f"too few samples of {model.name} to compare causes: {two[0].n_samples} to fit,"
            f" {two[1].n_samples} held out"
        )
    tilts = np.arange(len(names), len(names) + len(TILTS))
    return CauseData(
        drive=drive,
        joint_names=model.joint_names,
        names=(*names, *TILTS),
        support=tuple(np.concatenate([places, tilts]) for places in plan.support),
        fitted=factors[0],
        judged=factors[1],
        n_fitted=two[0].n_samples,
        n_judged=two[1].n_samples,
        judged_by=", ".join(sources) or f"every {HELD_BACK}rd block of the data used",
        tilt_axes=axes,
    )
