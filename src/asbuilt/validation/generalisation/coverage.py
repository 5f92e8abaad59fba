"""How much of a robot's range and speed a motion covers, without which other motion is untested."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asbuilt.description.model import RobotModel
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Cure, Finding, join_names, undesigned
from asbuilt.tables import format_share

WIDER = Cure("validate on a wider and faster motion", call="design_motion")


@dataclass(frozen=True, slots=True)
class Coverage:
    """Say how much of range and speed a motion covers that stands for others.

    Settled on recordings of a UR10e and an LWR4+: fits to half the range at 35 % of the top speed
    predict other motion with 1.3 times the error of blocks held out, fits to 20 % of the top speed
    with 2 to 4 times that.

    Parameters
    ----------
    position
        Share of the range, at most a turn, that every joint passes through.
    speed
        Share of the speed limit that half of the joints reach.
    percentile
        Of speed [%], which single samples do not decide.
    """

    position: float = 0.25
    speed: float = 0.25
    percentile: float = 99.0


COVERAGE = Coverage()


def check_coverage(model: RobotModel, training: Sequence[Samples]) -> Iterator[Finding]:
    """Yield what of range and speed the training motion leaves out.

    Joints without limits do not count, nor do the coordinates of a base that floats.

    Parameters
    ----------
    model
        The robot.
    training
        The samples of the fit.
    """
    limits = [joint.limits for joint in model.joints]
    turn = np.array([2.0 * np.pi if joint.is_revolute else np.inf for joint in model.joints])
    span = np.minimum([limit.upper - limit.lower for limit in limits], turn)
    speed = np.array([limit.velocity for limit in limits])
    span[: model.n_floating] = speed[: model.n_floating] = np.inf
    low, high = (
        np.array([edge(samples.in_segments(samples.q), axis=0) for samples in training])
        for edge in (np.min, np.max)
    )
    speeds = (np.abs(samples.in_segments(samples.qd)) for samples in training)
    fast = np.max([np.percentile(each, COVERAGE.percentile, axis=0) for each in speeds], axis=0)
    wider = undesigned(WIDER) if model.n_floating else WIDER
    covered = _measure_range_share(high.max(axis=0) - low.min(axis=0), span)
    reached = _measure_range_share(fast, speed)
    narrow = np.flatnonzero(covered < COVERAGE.position)
    if narrow.size:
        listed = join_names(
            [
                f"{format_share(covered[k], 0)} of its range at {model.joint_names[k]}"
                for k in narrow
            ],
            3,
        )
        yield Finding("motion_narrow", "info", f"The motion covers {listed}", wider)
    if np.any(np.isfinite(reached)) and np.nanmedian(reached) < COVERAGE.speed:
        typical = format_share(float(np.nanmedian(reached)), 0)
        yield Finding(
            "motion_slow",
            "info",
            f"Joints reach {typical} of their speed limits (median): faster motion is untested",
            wider,
        )


def _measure_range_share(
    values: NDArray[np.float64], limits: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return values in their limits (n,), NaN without a finite one."""
    known = np.isfinite(limits) & (limits > 0.0)
    return np.where(known, values / np.where(known, limits, 1.0), np.nan)
