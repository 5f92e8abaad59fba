"""Recordings under load reduced to rows of arm, payload and torque."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

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
        p, weights = result.n_base, result.weights
        link_columns = np.arange(10 * link, 10 * link + 10)
        columns = np.union1d(result.base.columns, link_columns)
        own, carried = (
            np.searchsorted(columns, result.base.columns),
            np.searchsorted(columns, link_columns),
        )
        kept = ~result.dropped
        arm_model = set_link_parameters(result.model, result.base, x[:p])
        chi = arm_model.parameters.copy()
        chi[link_columns] += shift @ x[p:]
        under = accumulate_stream(
            arm_model.with_parameters(chi),
            replace(result.base, columns=columns),
            loaded,
            block_seconds=block_seconds,
        )

        def with_payload(factor: Array) -> Array:
            return np.column_stack(
                [factor[:, own] * kept, factor[:, carried] @ shift, factor[:, -1]]
            )

        blocks = [with_payload(under.stacked(weights, b)) for b in range(under.n_blocks)]
        joints = [
            with_payload(weight * factor)
            for weight, factor in zip(weights, _widen_factors(under), strict=True)
        ]
        if unloaded:
            bare = accumulate_stream(arm_model, result.base, unloaded, block_seconds=block_seconds)
            blocks += [
                _insert_payload_columns(bare.stacked(weights, b), kept)
                for b in range(bare.n_blocks)
            ]
            joints = [
                np.vstack([rows, _insert_payload_columns(weight * factor, kept)])
                for rows, weight, factor in zip(joints, weights, _widen_factors(bare), strict=True)
            ]
        return cls(blocks, joints, under.n_samples, under.n_blocks)


def _widen_factors(information: SquareRootInformation) -> list[Array]:
    """Return the factor of each joint with a column for every base parameter and the torque."""
    return [
        widen_factor(factor, support, information.base.n_base)
        for support, factor in zip(information.support, information.joint_factors, strict=True)
    ]


def _insert_payload_columns(factor: Array, kept: NDArray[np.bool_]) -> Array:
    """Return a factor of the bare arm with ten zero columns of the payload, others if `kept`."""
    return np.concatenate(
        [factor[:, :-1] * kept, np.zeros((len(factor), 10)), factor[:, -1:]], axis=1
    )
