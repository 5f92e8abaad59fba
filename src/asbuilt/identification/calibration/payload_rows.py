"""Recordings under load reduced to rows of arm, payload and torque, and fits to such rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.experiment.signal.samples import Samples
from asbuilt.identification.information.square_root_information import (
    SquareRootInformation,
    accumulate_stream,
)
from asbuilt.identification.information.triangular import widen_factor
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.identification.result.torque_prediction import set_link_parameters


@dataclass(frozen=True, slots=True, eq=False)
class PayloadRows:
    """Hold triangular factors of weighted rows `[W | P | tau]` of arm, payload and torque.

    `blocks` have all joints of a time block, `joints` all blocks of a joint; P is zero for the bare
    arm. The first `n_loaded` of the blocks are under load.
    """

    blocks: list[Array]
    joints: list[Array]
    n_samples: int
    n_loaded: int

    @classmethod
    def of(
        cls,
        result: IdentificationResult,
        loaded: Sequence[Samples],
        unloaded: Sequence[Samples],
        link: int,
        shift: Array,
        x: Array,
        block_seconds: float | None,
    ) -> PayloadRows:
        """Reduce samples; `x` is the current arm and payload, for load-dependent friction.

        Columns of parameters that the result dropped are zero.
        """
        p = result.n_base
        weights = result.weights
        kept = ~result.dropped
        of_link = np.arange(10 * link, 10 * link + 10)
        columns = np.union1d(result.base.columns, of_link)
        own, carried = (np.searchsorted(columns, each) for each in (result.base.columns, of_link))
        arm = set_link_parameters(result.model, result.base, x[:p])
        chi = arm.parameters.copy()
        chi[of_link] += shift @ x[p:]

        def rows_of(
            information: SquareRootInformation, L: Array
        ) -> tuple[list[Array], list[Array]]:
            """Return the rows of blocks and of joints, `[W | P | tau] = [columns | tau] L`."""
            wide = information.base.n_base
            joints = zip(weights, information.support, information.joint_factors, strict=True)
            return (
                [information.stacked(weights, b) @ L for b in range(information.n_blocks)],
                [
                    weight * widen_factor(factor, support, wide) @ L
                    for weight, support, factor in joints
                ],
            )

        bare_map = np.zeros((p + 1, p + 11))
        bare_map[:p, :p] = np.diag(kept)
        bare_map[-1, -1] = 1.0
        carried_map = np.zeros((len(columns) + 1, p + 11))
        carried_map[[*own, -1]] = bare_map
        carried_map[carried, p:-1] = shift

        under = accumulate_stream(
            arm.with_parameters(chi),
            replace(result.base, columns=columns),
            loaded,
            block_seconds=block_seconds,
        )
        blocks, joints = rows_of(under, carried_map)
        if unloaded:
            bare = accumulate_stream(arm, result.base, unloaded, block_seconds=block_seconds)
            further, of_bare = rows_of(bare, bare_map)
            blocks += further
            joints = [np.vstack(both) for both in zip(joints, of_bare, strict=True)]
        return cls(blocks, joints, under.n_samples, under.n_blocks)


def jackknife_covariance(found: Array) -> Array:
    """Return the covariance (m, m) of values, found (n, m) without one time block at a time."""
    apart = found - found.mean(axis=0)
    return np.asarray((len(found) - 1) / len(found) * apart.T @ apart)
