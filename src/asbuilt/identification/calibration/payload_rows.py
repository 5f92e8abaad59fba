"""What a payload rests on: rows of recordings under load, and the uncertainty of torque gains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array, Indices
from asbuilt.dynamics import BaseParameters
from asbuilt.dynamics.regressor import observation_matrix
from asbuilt.errors import UsageError
from asbuilt.experiment.recording import TorqueSource
from asbuilt.experiment.signal.samples import Samples
from asbuilt.identification.information.random_states import draw_positions
from asbuilt.identification.information.square_root_information import (
    SquareRootInformation,
    accumulate_stream,
)
from asbuilt.identification.information.triangular import widen_factor
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.identification.result.torque_prediction import set_link_parameters
from asbuilt.scaled import Scaled


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
    ) -> PayloadRows:
        """Reduce samples; `x` is the current arm and payload, for load-dependent friction.

        Columns of parameters that the result dropped are zero.
        """
        p = result.n_base
        weights = result.weights
        kept: Array = np.append(~result.dropped, np.ones(11))
        columns, *maps = map_to_payload(result.base, link, shift)
        bare_map, carried_map = (each * kept for each in maps)
        arm = set_link_parameters(result.model, result.base, x[:p])
        chi = arm.parameters.copy()
        chi[10 * link : 10 * link + 10] += shift @ x[p:]

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

        under = accumulate_stream(
            arm.with_parameters(chi), replace(result.base, columns=columns), loaded
        )
        blocks, joints = rows_of(under, carried_map)
        if unloaded:
            bare = accumulate_stream(arm, result.base, unloaded)
            further, of_bare = rows_of(bare, bare_map)
            blocks += further
            joints = [np.vstack(both) for both in zip(joints, of_bare, strict=True)]
        return cls(blocks, joints, under.n_samples, under.n_blocks)


def map_to_payload(base: BaseParameters, link: int, shift: Array) -> tuple[Indices, Array, Array]:
    """Return columns of arm and payload, and what makes `[W | P | tau]` of rows.

    With a body whose parameters are `shift @ pi` (10,) on a link, the rows are `[columns | tau] M`,
    and `[W | tau] M_bare` without it, of the p base columns alone.
    """
    p = base.n_base
    of_link = np.arange(10 * link, 10 * link + 10)
    columns = np.union1d(base.columns, of_link)
    bare = np.zeros((p + 1, p + 11))
    bare[np.arange(p + 1), [*range(p), -1]] = 1.0
    carried = np.zeros((len(columns) + 1, p + 11))
    carried[[*np.searchsorted(columns, base.columns), -1]] = bare
    carried[np.searchsorted(columns, of_link), p:-1] = shift
    return columns, bare, carried


def solve_without_blocks(blocks: Sequence[Array], held: Array | None = None) -> Array:
    """Return what rows `[A | y]` determine without each of the blocks, (blocks, m).

    Rows that are `held`, as of a prior, stay.
    """
    grams = [block.T @ block for block in blocks]
    total = np.asarray(sum(grams if held is None else [held.T @ held, *grams]))
    rests = (total - gram for gram in grams)
    return np.array([Scaled(rest[:-1, :-1]).solve(rest[:-1, -1]) for rest in rests])


def gravity_scales(result: IdentificationResult) -> Array:
    """Return each joint's gravity torque as a multiple of CAD's, (n,), NaN if it has none.

    The least-squares factor from CAD's torque to the torque of the result, in random static poses
    within the limits. Offsets that share base parameters with masses count to neither.
    """
    n = result.model.n_joints
    scales = np.full(n, np.nan)
    links = np.asarray(result.base.columns) < 10 * result.model.n_links
    design = np.array([parameter.cad for parameter in result.parameters], dtype=np.float64)
    if not result.model.has_every_mass or not np.all(np.isfinite(design[links])):
        return scales
    q = draw_positions(result.model, np.random.default_rng(0))
    still = np.zeros_like(q)
    rows = observation_matrix(
        result.model, q, still, still, drive=result.base.drive, columns=result.base.columns
    )[:, links]
    cad, built = (
        (rows @ values[links]).reshape(len(q), n) for values in (design, result.estimates)
    )
    size, own = (np.sqrt(np.mean(each**2, axis=0)) for each in (cad, built))
    product = np.mean(cad * built, axis=0)
    # Gravity torque, relative to the largest, below which a joint does not show its scale.
    # 0.8: correlation with CAD's gravity torque below which something other than the scale differs.
    clear = (size > 0.05 * size.max(initial=0.0)) & (product > 0.8 * size * own)
    scales[clear] = product[clear] / size[clear] ** 2
    return scales


def derive_gain_doubt(scales: Array) -> Array:
    """Return the part of a gain's error (n,) that CAD does not explain; 0 where scales are unknown.

    If a logged gravity torque is s times CAD's since the gain is off, the true torque is 1 / s of
    the one logged: `|1 / s - 1|`, beyond the tolerance of CAD.
    """
    away = np.abs(1.0 / np.nan_to_num(scales, nan=1.0) - 1.0)
    # Error of CAD's gravity torques that is usual: its masses are accurate to a fifth at best.
    return np.maximum(away - 0.2, 0.0)


USUAL_UNCERTAINTY: dict[TorqueSource, float] = {
    "sensor": 0.0,
    "unknown": 0.0,
    "motor": 0.05,
    "current": 0.07,
}
"""Default standard deviation of a joint's gain, as a fraction.

Currents: data sheets usually state the torque constant to +-10 % (limits: 5.8 % as a standard
deviation), and neodymium magnets lose about 0.1 % of their field per kelvin, 4 % over 40 K of
warming; together 7 %. Torques that a controller computes from currents have been calibrated once,
and warm up too: 5 %, if gravity torques show that the calibration holds (`derive_gain_errors`).
Joint torque sensors are calibrated at the joint. These are assumptions: the published gains of a
UR10e are 3 to 11 % high.
"""
UNCALIBRATED = 0.1
"""Standard deviation of the gain of a motor's torque of which nothing shows that it is calibrated.
"""
COMMON = 1.0 / 3.0
"""Part of the variance common to all joints, which warm up together (4 of 7 %, squared)."""
MOST = 0.5
"""Largest valid fraction that is stated."""


def _check_stated_errors(stated: ArrayLike, n_joints: int) -> Array:
    """Return stated standard deviations of gains as fractions (n,), given one for all or one each.

    Raises `UsageError` for another number of values, or values outside 0 to 0.5.
    """
    values = np.atleast_1d(np.asarray(stated, dtype=np.float64))
    if values.ndim != 1 or values.size not in (1, n_joints):
        raise UsageError(
            f"gain uncertainty has {values.size} values; expected 1 or {n_joints}, one per joint"
        )
    if not np.all((values >= 0.0) & (values <= MOST)):
        raise UsageError(
            f"gain uncertainty is {values.tolist()}; expected fractions from 0 to {MOST:g}, such as"
            " 5% or 0.05"
        )
    return np.broadcast_to(values, (n_joints,)).copy()


def derive_gain_errors(
    result: IdentificationResult, source: TorqueSource, stated: ArrayLike | None = None
) -> Array:
    """Return the standard deviation of each joint's gain as fractions, (n,), by all that is known.

    Without `stated` values, the usual ones of the torque source count, wider by what the gravity
    torques of the result differ from CAD's beyond its tolerance. Torques of motors count as
    calibrated, to 5 %, if the gravity torques agree with CAD's; otherwise 10 %, as all torques
    but a sensor's do where the description has no masses. Torques of unknown source are as good as
    a sensor's until gravity contradicts them.
    """
    n = result.model.n_joints
    if stated is not None:
        return _check_stated_errors(stated, n)
    usual: Array = np.full(n, USUAL_UNCERTAINTY[source])
    if source == "sensor":
        return usual
    if not result.model.has_every_mass:
        return np.maximum(usual, UNCALIBRATED)
    scales = gravity_scales(result)
    doubted = derive_gain_doubt(scales)
    if source == "unknown" and not np.any(doubted > 0.0):
        return usual
    if source != "current" and (np.all(np.isnan(scales)) or np.any(doubted > 0.0)):
        usual = np.maximum(usual, UNCALIBRATED)
    return np.hypot(usual, doubted)


def name_doubtful_gains(result: IdentificationResult, source: TorqueSource) -> tuple[str, ...]:
    """Return the joints whose gravity torque differs from CAD's beyond its tolerance.

    All of them where the description has no masses, so that nothing shows the scale of torques
    that no sensor measured.
    """
    if source == "sensor":
        return ()
    if not result.model.has_every_mass:
        return result.model.joint_names
    doubted = derive_gain_doubt(gravity_scales(result))
    return tuple(result.model.joint_names[k] for k in np.flatnonzero(doubted > 0.0))


def gain_covariance(uncertainty: Array) -> Array:
    """Return the covariance (n, n) of gains, a third of the variance common to all joints."""
    n = len(uncertainty)
    return np.outer(uncertainty, uncertainty) * ((1.0 - COMMON) * np.eye(n) + COMMON)


def parse_gain_uncertainty(text: str | None) -> list[float] | None:
    """Read `7%`, `0.07` or one of these per joint, separated by commas; None without text."""
    if text is None:
        return None
    try:
        return [
            float(part.rstrip("%")) / (100.0 if part.endswith("%") else 1.0)
            for part in (each.strip() for each in text.split(","))
        ]
    except ValueError:
        raise UsageError(
            f"gain uncertainty is {text!r}; expected a fraction for all joints or one for each,"
            " such as 7% or 0.05,0.03,..."
        ) from None


def split_by_joint(
    result: IdentificationResult, stand_in: Sequence[Array], weights: Array
) -> Array:
    """Return the contribution of each joint's torque to the arm's base parameters, (p, n).

    `beta = (sum_j w_j^2 W_j^T W_j)^-1 sum_k w_k^2 W_k^T tau_k`: if joint k's torque is a fraction
    larger, beta changes by that fraction of column k. W and tau are taken from the cause data of
    the result (held-out data included if they are part of the recordings used), or else from
    `stand_in`, weighted rows `[W_k | ...]` of other motion with the torque that the result
    predicts. Dropped parameters stay zero.
    """
    p = result.n_base
    beta = result.estimates
    if result.cause_data is not None:
        cause_data = result.cause_data
        places = np.append(cause_data.places(result.base.names), -1)
        parts = [cause_data.whole(cause_data.fitted)]
        if cause_data.n_fitted < result.n_samples:
            parts.append(cause_data.whole(cause_data.judged))
        factors = [
            weight * np.vstack(joint)[:, places]
            for weight, joint in zip(weights, zip(*parts, strict=True), strict=True)
        ]
    else:
        factors = [np.column_stack([rows[:, :p], rows[:, :p] @ beta]) for rows in stand_in]
    factors = [factor * np.append(~result.dropped, True) for factor in factors]
    matrix = sum((factor[:, :-1].T @ factor[:, :-1] for factor in factors), start=np.zeros((p, p)))
    sides = np.column_stack([factor[:, :-1].T @ factor[:, -1] for factor in factors])
    return Scaled(matrix).solve(sides)
