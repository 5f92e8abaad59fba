"""Factors of fitted and held-out data, by which a study asks for causes of a difference."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.codec import store_as
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import BaseParameters, gravity_torque
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.errors import IdentifiabilityError, ResultError
from asbuilt.experiment.signal.samples import Samples
from asbuilt.identification.information.rows import SampleBlock, divide_into_blocks
from asbuilt.identification.information.triangular import (
    GrowingFactor,
    pack_triangle,
    unpack_triangle,
    widen_factor,
)

TILT = "tilt"
"""Column of the torque that a tilt which was found adds to the weight of the links by design."""
HELD_BACK = 3
"""Without held-out recordings every so many blocks of the data used are held out."""
TRIANGLES = store_as(
    encode=lambda factors: [pack_triangle(factor) for factor in factors],
    decode=lambda texts: tuple(unpack_triangle(text) for text in texts),
)
"""Factors are stored as upper triangles, row by row, as base64 of little-endian doubles."""


@dataclass(frozen=True, eq=False)
class CauseData:
    """Hold the triangular factors of `[A_k | tau_k]` of every joint k, of fitted and held-out data.

    The named columns A belong to the base parameters of a result, and to `TILT` where a tilt was
    found. Joint k has the columns `support[k]`; `fitted[k]` and `judged[k]` (held out) have shape
    (p_k + 1, p_k + 1). A change x of the parameters changes the torque by `A x`.
    """

    joint_names: tuple[str, ...] = field(metadata=store_as(key="joints"))
    names: tuple[str, ...] = field(metadata=store_as(key="columns"))
    support: tuple[Indices, ...]
    fitted: tuple[Array, ...] = field(metadata=TRIANGLES)
    judged: tuple[Array, ...] = field(metadata=TRIANGLES)
    n_fitted: int
    n_judged: int
    judged_by: str

    def __post_init__(self) -> None:
        for support, *factors in zip(self.support, self.fitted, self.judged, strict=True):
            for factor in factors:
                if factor.shape != (len(support) + 1, len(support) + 1):
                    raise ResultError(
                        f"a factor of {len(support)} columns and the torque has shape"
                        f" {factor.shape}; identify again"
                    )
                factor.setflags(write=False)

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
            widen_factor(factor, support, len(self.names))
            for support, factor in zip(self.support, factors, strict=True)
        )

    def error_of(self, names: Iterable[str], values: Array) -> Array:
        """Return the RMS torque error (n,) on held-out data of named parameters, others zero."""
        places = self.places(names)
        errors = [factor[:, -1] - factor[:, places] @ values for factor in self.whole(self.judged)]
        return np.asarray([np.linalg.norm(error) for error in errors] / np.sqrt(self.n_judged))


@use_one_blas_thread()
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
    # Gravity that a tilt has changed: the torque of the difference is the tilt's column.
    tilts = () if model.described_gravity is None else (TILT,)
    turning = model.with_gravity(model.gravity - model.as_described.gravity)
    plan = RegressorPlan.of(model, base.drive, base.columns, spare_rows=len(tilts) + 1)
    growing = [
        [GrowingFactor(len(own) + plan.spare_rows) for own in plan.support] for _ in range(2)
    ]
    counts = [0, 0]
    sources = dict[str, None]()

    def add(place: int, part: SampleBlock) -> None:
        q = part.samples.q
        counts[place] += part.n_outputs
        for chunk in part.chunks(
            plan, lambda span: [gravity_torque(turning, q[span]) for _ in tilts]
        ):
            # Place 0 is fitted, 1 is held out; both share plan and columns.
            for own, rows in zip(growing[place], chunk, strict=True):
                own.append(rows)

    for part in divide_into_blocks(model, judged, block_seconds):
        sources[part.samples.source] = None
        add(1, part)
    for number, part in enumerate(divide_into_blocks(model, fitted, block_seconds)):
        # The last of every three, so that the first block is fitted.
        add(int(not sources and number % HELD_BACK == HELD_BACK - 1), part)
    of_fitted, of_judged = (tuple(own.factor() for own in each) for each in growing)
    if not all(counts):
        raise IdentifiabilityError(
            f"too few samples of {model.name} to compare causes: {counts[0]} to fit,"
            f" {counts[1]} held out"
        )
    return CauseData(
        joint_names=model.joint_names,
        names=(*base.names, *tilts),
        support=tuple(np.append(own, base.n_base + np.arange(len(tilts))) for own in plan.support),
        fitted=of_fitted,
        judged=of_judged,
        n_fitted=counts[0],
        n_judged=counts[1],
        judged_by=", ".join(sources) or f"every {HELD_BACK}rd block of the data used",
    )
