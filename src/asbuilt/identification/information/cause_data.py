"""All that a recording says of what CAD may have left out, in one triangular matrix per joint, so
that causes can be weighed later without the data.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.description.model import PLAIN_TERMS, RobotModel
from asbuilt.description.rotation import axes_across
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.drives.selection import DriveSet, available_terms
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.dynamics.newton_euler import gravity_torque
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.errors import IdentifiabilityError, ResultError
from asbuilt.identification.information.rows import SampleBlock, sample_blocks
from asbuilt.identification.information.triangular import (
    ROWS_AT_ONCE,
    GrowingFactor,
    packed_triangle,
    unpacked_triangle,
)

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples


RICHER_TERMS = ("load_friction", "quadratic", "stribeck")
"""Friction beyond the plain one whose columns need no fitted nonlinear parameter, or do with the usual one."""
TILTS = ("tilt 1", "tilt 2")
HELD_BACK = 3
"""Where no recording is held out, every so many blocks of the data used judge what the others say."""


@dataclass(frozen=True, eq=False)
class CauseData:
    """Hold the triangular factors of `[A_k | tau_k]` of every joint k, of the data fitted and of
    the data judged by.

    The columns A are named: the base parameters of the links, every plain and some richer drive
    terms, and the two tilts of the mounting, rad about `tilt_axes` (2, 3) of the root frame: the
    torque of the bodies by design under gravity `g x axis`. Joint k has the columns `support[k]`;
    `fitted[k]` and `judged[k]` have shape (p_k + 1, p_k + 1). What a change x of the columns'
    parameters does to the torque is `A x`, so payload, gains, friction and other values by design
    are all linear in what is held here.
    """

    drive: DriveSet
    joint_names: tuple[str, ...]
    names: tuple[str, ...]
    support: tuple[Indices, ...]
    fitted: tuple[Array, ...]
    judged: tuple[Array, ...]
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
        """Return the column of each name; raises `ResultError` for one that is not among them."""
        index = {name: j for j, name in enumerate(self.names)}
        missing = [name for name in names if name not in index]
        if missing:
            raise ResultError(
                f"the cause data has no column {missing[0]!r}; identify again with this version"
            )
        return np.array([index[name] for name in names], dtype=np.int64)

    def whole(self, factors: tuple[Array, ...]) -> tuple[Array, ...]:
        """Return factors with a column for every name and the torque last, zero where a joint has
        none: shape (p_k + 1, p + 1).
        """
        every = []
        for support, factor in zip(self.support, factors, strict=True):
            wide = np.zeros((len(factor), len(self.names) + 1))
            wide[:, np.append(support, len(self.names))] = factor
            every.append(wide)
        return tuple(every)

    def error_of(self, names: Iterable[str], values: Array) -> Array:
        """Return the RMS error (n,) on the data judged by of the torque that named parameters of
        these values predict, all others zero.
        """
        places = self.places(names)
        errors = [factor[:, -1] - factor[:, places] @ values for factor in self.whole(self.judged)]
        return np.asarray(
            [float(np.linalg.norm(error)) for error in errors] / np.sqrt(self.n_judged)
        )

    def as_dict(self) -> dict[str, Any]:
        """Return texts, numbers and lists, ready for JSON.

        Factors are upper triangles, row by row, as base64 of little-endian doubles.
        """
        return {
            "drive": list(self.drive.specifications),
            "joints": list(self.joint_names),
            "columns": list(self.names),
            "support": [support.tolist() for support in self.support],
            "fitted": [packed_triangle(factor) for factor in self.fitted],
            "judged": [packed_triangle(factor) for factor in self.judged],
            "n_fitted": self.n_fitted,
            "n_judged": self.n_judged,
            "judged_by": self.judged_by,
            "tilt_axes": self.tilt_axes.tolist(),
        }

    @classmethod
    def from_dict(cls, fields: Mapping[str, Any]) -> CauseData:
        """Rebuild from `as_dict`; raises `ResultError` where that is damaged."""
        try:
            support = tuple(np.array(places, dtype=np.int64) for places in fields["support"])
            sizes = [len(places) + 1 for places in support]
            return cls(
                drive=DriveSet.parse(fields["drive"]),
                joint_names=tuple(fields["joints"]),
                names=tuple(fields["columns"]),
                support=support,
                fitted=tuple(
                    unpacked_triangle(text, size)
                    for text, size in zip(fields["fitted"], sizes, strict=True)
                ),
                judged=tuple(
                    unpacked_triangle(text, size)
                    for text, size in zip(fields["judged"], sizes, strict=True)
                ),
                n_fitted=int(fields["n_fitted"]),
                n_judged=int(fields["n_judged"]),
                judged_by=str(fields["judged_by"]),
                tilt_axes=np.array(fields["tilt_axes"], dtype=np.float64),
            )
        except (KeyError, TypeError, ValueError) as problem:
            if isinstance(problem, ResultError):
                raise
            raise ResultError(
                f"the cause data is damaged ({type(problem).__name__} {problem}); identify again"
            ) from problem


def gather_cause_data(
    model: RobotModel,
    base: BaseParameters,
    fitted: Iterable[Samples],
    judged: Iterable[Samples] = (),
    *,
    block_seconds: float | None = None,
) -> CauseData:
    """Go through the samples once more and reduce them to the cause data.

    `base` are the base parameters of the result, whose drive terms are all among the columns.
    Without samples to judge by, every third time block of the others is put aside for it. Raises
    `IdentifiabilityError` where that leaves no samples to fit, or none to judge by.
    """
    drive = base.drive
    known = available_terms()
    for key in (*PLAIN_TERMS, *RICHER_TERMS):
        if key in known and (
            key not in drive.keys or key in PLAIN_TERMS
        ):  # at every joint, though the result has it at some
            drive = drive.with_term(known[key])
    links = 10 * model.n_joints
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
    two = _Reduction(plan), _Reduction(plan)
    sources: dict[str, None] = {}
    with one_blas_thread():
        for stretch in sample_blocks(model, judged, block_seconds):
            sources[stretch.samples.source] = None
            two[1].add(stretch, tilted)
        for number, stretch in enumerate(sample_blocks(model, fitted, block_seconds)):
            two[1 if not sources and number % HELD_BACK == HELD_BACK - 1 else 0].add(
                stretch, tilted
            )
        factors = [reduction.factors() for reduction in two]
    if not two[0].n_samples or not two[1].n_samples:
        raise IdentifiabilityError(
            f"too few samples of {model.name} to weigh causes: {two[0].n_samples} to fit,"
            f" {two[1].n_samples} to judge by"
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


class _Reduction:
    """Reduce rows to one factor per joint."""

    def __init__(self, plan: RegressorPlan) -> None:
        self._plan = plan
        self._growing = [
            GrowingFactor(len(support) + plan.spare_rows, ROWS_AT_ONCE) for support in plan.support
        ]
        self.n_samples = 0

    def add(self, stretch: SampleBlock, tilted: list[RobotModel]) -> None:
        self.n_samples += stretch.n_outputs
        q = stretch.samples.q
        for chunk in stretch.chunks(
            self._plan, beside=lambda span: [gravity_torque(model, q[span]) for model in tilted]
        ):
            for growing, rows in zip(self._growing, chunk, strict=True):
                growing.append(rows)

    def factors(self) -> tuple[Array, ...]:
        return tuple(growing.factor() for growing in self._growing)
