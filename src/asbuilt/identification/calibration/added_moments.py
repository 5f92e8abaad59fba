"""First moments of a weight on any link, where no motion determines its mass alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.inertia import shift_matrix
from asbuilt.errors import IdentifiabilityError
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Cure
from asbuilt.identification.calibration.payload import (
    FEWEST_BLOCKS,
    LARGEST_ERROR,
    choose_payload_frame,
)
from asbuilt.identification.calibration.payload_rows import PayloadRows, solve_without_blocks
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.scaled import Scaled
from asbuilt.statistics import jackknife_covariance

NAMES = ("mx", "my", "mz", "m")
"""First moments [kg m] in the axes of the frame, and mass [kg]."""


@dataclass(frozen=True, slots=True, eq=False)
class AddedMoments:
    """Hold what a weight fixed to a link adds to its first moments and mass.

    Parameters
    ----------
    robot, frame
        Robot, and the frame in whose axes the moments are.
    values, std_errors
        First moments [kg m] and mass [kg] in the order of `names`, with standard errors by time
        blocks and by the covariance of the bare arm; NaN for what has no torque.
    determined, not_determined
        Names with and without a standard error below `LARGEST_ERROR` of the value.
    n_samples
        Of the loaded recordings.
    """

    robot: str
    frame: str
    values: Array
    std_errors: Array
    n_samples: int
    names: tuple[str, ...] = NAMES

    @property
    def determined(self) -> tuple[str, ...]:
        """Names of well determined values."""
        sure = self.std_errors <= LARGEST_ERROR * np.abs(self.values)
        return tuple(name for name, well in zip(self.names, sure, strict=True) if well)

    @property
    def not_determined(self) -> tuple[str, ...]:
        """Names of values that the recording does not determine."""
        return tuple(name for name in self.names if name not in self.determined)


def identify_added_moments(
    result: IdentificationResult,
    loaded: Sequence[Samples],
    *,
    unloaded: Sequence[Samples] = (),
    frame: str | None = None,
) -> AddedMoments:
    """Identify first moments and mass that a weight adds to the link of a frame.

    `tau = W beta + Y_link [h m] + offsets`: the weight is a point somewhere on the link, without an
    inertia of its own; offsets of the drives, which drift from day to day, may have changed. What
    has no torque stays at zero and is named as not determined.

    The arm is the result's, with its covariance. With `unloaded` recordings it is estimated
    again with the weight, and time blocks are left out in pairs: errors of the model that both
    recordings of one motion have in common then cancel.

    Raises
    ------
    IdentifiabilityError
        If there are too few time blocks, or the weight has no torque in any joint.
    """
    name, link, placement = choose_payload_frame(result.model, frame)
    p = result.n_base
    start = np.concatenate([result.estimates, np.zeros(10)])
    rows = PayloadRows.of(result, loaded, unloaded, link, shift_matrix(placement), start)
    groups = _group_blocks(rows)
    if len(groups) < FEWEST_BLOCKS:
        raise IdentifiabilityError(
            f"{len(groups)} time blocks are too few for errors, {FEWEST_BLOCKS} are needed",
            cure=Cure("record longer"),
        )
    offsets = [k for k, name in enumerate(result.base.names) if name.startswith("Fo")]
    chosen = [*range(p + 6, p + 10), *offsets]
    blocks = [
        _build_columns(result, rows.blocks, of, chosen, again=bool(unloaded)) for of in groups
    ]
    total = np.asarray(sum(block.T @ block for block in blocks))
    columns = Scaled(total[:-1, :-1])
    seen = columns.determined[:4]
    if not seen.any():
        raise IdentifiabilityError(
            f"a weight at {name} has no torque in this recording, so none of its moments is"
            " determined",
            cure=Cure("name the frame that carries it, or move the joints that lift it"),
        )
    covariance = jackknife_covariance(solve_without_blocks(blocks))
    covariance = covariance * np.outer(columns.present, columns.present)
    covariance = covariance[: len(chosen), : len(chosen)]
    if not unloaded:
        covariance = covariance + _propagate_arm_covariance(result, rows, chosen, columns)
    errors = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return AddedMoments(
        robot=result.robot,
        frame=name,
        values=np.where(seen, columns.solve(total[:-1, -1])[:4], np.nan),
        std_errors=np.where(seen, errors[:4], np.nan),
        n_samples=rows.n_samples,
    )


Group = tuple[tuple[int, bool], ...]
"""Time blocks that are left out together, each with whether it is loaded."""


def _group_blocks(rows: PayloadRows) -> list[Group]:
    """Return the blocks by pairs, of one number in loaded and bare recordings alike."""
    n = rows.n_loaded
    own = [(k, True) for k in range(n)]
    bare = [(k, False) for k in range(n, len(rows.blocks))]
    pairs = [(*own[k : k + 1], *bare[k : k + 1]) for k in range(n)]
    return [*pairs, *((each,) for each in bare[n:])]


def _build_columns(
    result: IdentificationResult,
    blocks: Sequence[Array],
    group: Group,
    chosen: Sequence[int],
    *,
    again: bool,
) -> Array:
    """Return rows of weight, arm where it is estimated again, and the torque that is left."""
    p = result.n_base
    found = []
    for k, is_loaded in group:
        block = blocks[k]
        left = block[:, -1] - block[:, :p] @ result.estimates
        arm = [block[:, :p]] if again else []
        found.append(np.column_stack([block[:, chosen] * is_loaded, *arm, left]))
    return np.vstack(found)


def _propagate_arm_covariance(
    result: IdentificationResult, rows: PayloadRows, chosen: Sequence[int], columns: Scaled
) -> Array:
    """Return the covariance that the bare arm's covariance causes, along the present motion."""
    p = result.n_base
    slope = columns.pseudo_inverse @ sum(block[:, chosen].T @ block[:, :p] for block in rows.blocks)
    return slope @ result.covariance @ slope.T
