"""What a motion shows of others: the range and speed that it covers, and states that it repeats."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Cure, Finding, join_names
from asbuilt.tables import format_share
from asbuilt.validation.comparison.comparison import recording_name

WIDER = Cure("validate on a wider and faster motion", call="design_motion")


# Say how much of range and speed a motion covers that stands for others.
#
# Settled on recordings of a UR10e and an LWR4+: fits to half the range at 35 % of the top speed
# predict other motion with 1.3 times the error of blocks held out, fits to 20 % of the top speed
# with 2 to 4 times that.

COVERAGE_POSITION = 0.25  # Share of the range, at most a turn, that every joint passes through
COVERAGE_SPEED = 0.25  # Share of the speed limit that half of the joints reach
COVERAGE_PERCENTILE = 99.0  # Of speed [%], which single samples do not decide


def check_coverage(model: RobotModel, training: Sequence[Samples]) -> Iterator[Finding]:
    """Yield what of range and speed the training motion leaves out.

    Joints without limits do not count, nor do those without a drive.

    Parameters
    ----------
    model
        The robot.
    training
        The samples of the fit.
    """
    limits = [joint.limits for joint in model.joints]
    turn = np.array([2.0 * np.pi if joint.is_revolute else np.inf for joint in model.joints])
    # A joint that turns for ever covers a turn at most.
    span = np.minimum([limit.upper - limit.lower for limit in limits], turn)
    speed = np.array([limit.velocity for limit in limits])
    driven = np.isin(np.arange(model.n_joints), model.driven_joints)
    span[~driven] = speed[~driven] = np.inf
    # Percentiles, as single samples are noise; joint by joint, as a recording may be long.
    fast = np.max(
        [
            [np.percentile(np.abs(one.in_segments(qd)), COVERAGE_PERCENTILE) for qd in one.qd.T]
            for one in training
        ],
        axis=0,
    )
    # Over all recordings together: each may cover a part.
    least, greatest = _find_extremes(training)
    covered = _measure_range_share((greatest - least)[: model.n_joints], span)
    reached = _measure_range_share(fast, speed)
    narrow = np.flatnonzero(covered < COVERAGE_POSITION)
    if narrow.size:
        listed = join_names(
            [
                f"{format_share(covered[k], 0)} of its range at {model.joint_names[k]}"
                for k in narrow
            ],
            3,
        )
        yield Finding("motion_narrow", "info", f"The motion covers {listed}", WIDER)
    # The median joint: some joints are seldom fast.
    if np.any(np.isfinite(reached)) and np.nanmedian(reached) < COVERAGE_SPEED:
        typical = format_share(float(np.nanmedian(reached)), 0)
        yield Finding(
            "motion_slow",
            "info",
            f"Joints reach {typical} of their speed limits (median): faster motion is untested",
            WIDER,
        )


def _measure_range_share(values: Array, limits: Array) -> Array:
    """Return values in their limits (n,), NaN without a finite one."""
    known = np.isfinite(limits) & (limits > 0.0)
    return np.where(known, values / np.where(known, limits, 1.0), np.nan)


# Say when two states of a robot are near each other; own choices, tested on real robots. Each joint
# must be within `NEAR_POSITION` of its range and `NEAR_VELOCITY` of its top speed in the training
# motion at once.

NEAR_POSITION = 0.03
NEAR_VELOCITY = 0.1
MOST_STATES = 20_000
"""States of either motion that are looked at, evenly spread."""
FEWEST_JOINTS = 3
"""Joints with fewer than which different motions pass near each other anyway."""
REPEATED = 0.6
"""Share of its states to which a motion comes near that it repeats: 0 to 0.2 for other motions, 0.5
for 2 s blocks of a slow one."""


def measure_repeated_share(fitted: Sequence[Samples], held_out: Samples) -> float:
    """Return the share of held-out states (q, qd) that the training motion came near to.

    All joints must be near at the same time; 0 for robots of one or two joints.
    """
    if held_out.q.shape[1] < FEWEST_JOINTS:
        return 0.0
    joints = held_out.q.shape[1]
    least, greatest = _find_extremes(fitted)
    fastest = np.maximum(greatest, -least)[joints:]
    size = np.concatenate([NEAR_POSITION * (greatest - least)[:joints], NEAR_VELOCITY * fastest])
    moving = size > 0.0
    # Too few joints move: other motions pass near by chance.
    if not moving[:joints].sum() >= FEWEST_JOINTS:
        return 0.0
    before = _thin_states(fitted)
    after = _thin_states([held_out])
    from scipy.spatial import KDTree  # noqa: PLC0415 - light start

    tree = KDTree((before / np.where(moving, size, 1.0))[:, moving])
    distance, _ = tree.query(
        (after / np.where(moving, size, 1.0))[:, moving],
        # The largest difference of any joint must be small: all are near at once.
        p=np.inf,
        distance_upper_bound=1.0,
    )
    return float(np.mean(np.isfinite(distance)))


def repeats(one: Samples, other: Samples) -> bool:
    """Return whether two recordings are of one motion: one comes near most states of the other."""
    # Either way: a short recording may lie within a long one.
    shares = (measure_repeated_share([a], b) for a, b in ((one, other), (other, one)))
    return any(share > REPEATED for share in shares)


def _find_extremes(samples: Sequence[Samples]) -> tuple[Array, Array]:
    """Return the least and greatest of all positions and velocities, (2 n,) each."""
    states = [(recording, span) for recording in samples for span in recording.spans()]
    # Span by span: states of a long recording are many.
    least, greatest = (
        np.array([np.append(end(s.q[span], axis=0), end(s.qd[span], axis=0)) for s, span in states])
        for end in (np.min, np.max)
    )
    return least.min(axis=0), greatest.max(axis=0)


def _thin_states(samples: Sequence[Samples]) -> Array:
    """Return states (q, qd) of all recordings together, evenly spread."""
    places = [np.concatenate([np.arange(a, b) for a, b in s.segments]) for s in samples]
    step = max(1, sum(map(len, places)) // MOST_STATES)
    parts = []
    passed = 0
    for each, own in zip(samples, places, strict=True):
        taken = own[-passed % step :: step]
        parts.append(np.hstack([each.q[taken], each.qd[taken]]))
        passed += len(own)
    return np.concatenate(parts)


def check_left_out(
    recordings: Sequence[Samples], motions: Sequence[Sequence[int]]
) -> tuple[Finding, ...]:
    """Return a finding for each recording that those of all other motions repeat together."""
    found: list[Finding] = []
    for motion in motions:
        others = [recording for k, recording in enumerate(recordings) if k not in motion]
        found += check_repetitions(others, [recordings[k] for k in motion])
    return tuple(found)


def check_repetitions(
    training: Sequence[Samples], validation: Sequence[Samples]
) -> tuple[Finding, ...]:
    """Return a finding for each validation recording that repeats the training motion."""
    return tuple(
        Finding(
            "held_out_repeats",
            "warning",
            f"{recording_name(samples.source)} repeats the training motion in {100 * share:.0f} %"
            " of its states, so other motion has other errors",
            Cure("validate on another motion"),
        )
        for samples in validation
        if (share := measure_repeated_share(training, samples)) > REPEATED
    )
