"""Delays of a study's recordings, which the torque decides.

Study-level: the numerics are in `identification/calibration/delay.py` and
`identification/uncertainty/delay_errors.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import DriveSet
from asbuilt.dynamics.drives.torque import choose_usual_drive
from asbuilt.errors import AsbuiltError
from asbuilt.experiment import Recording, Samples, hold_out
from asbuilt.experiment.signal.preparation import MotionFilters
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.findings import Cure, Finding
from asbuilt.identification.calibration.delay import DelayEstimate, find_delays
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.identification.uncertainty.delay_errors import (
    JointDelay,
    RecordingDelay,
    state_delay,
)

FRICTION = DriveSet.parse("viscous,coulomb,offset")
"""Drive terms without which friction passes for a delay."""


@dataclass(frozen=True, slots=True)
class Delays:
    """Hold the delays of recordings; other recordings take their mean.

    `chain` has that mean as its delay, which stays open if none was to be estimated.
    """

    chain: SignalChain
    recordings: tuple[RecordingDelay, ...] = ()

    def of(self, digest: str) -> RecordingDelay | None:
        """Return the delay of the recording with this fingerprint; None if it is another one."""
        return next(
            (recording for recording in self.recordings if recording.digest == digest), None
        )

    def applied(self, samples: Samples, digest: str) -> Samples:
        """Return samples of a recording with the standard errors of their delay."""
        delay = self.of(digest)
        return replace(samples, delay_errors=delay.errors) if delay and delay.errors else samples

    def chain_of(self, digest: str) -> SignalChain:
        """Return the signal chain of a recording."""
        delay = self.of(digest)
        return replace(self.chain, delay=delay.delays or None) if delay else self.chain


def settle_delays(
    model: RobotModel,
    heads: Sequence[Recording],
    digests: Sequence[str],
    chain: SignalChain,
    holdout: str | None,
    filters: MotionFilters | None = None,
) -> Delays:
    """Return the delays of recordings: those that the chain states, or estimates.

    Parameters
    ----------
    model
        The robot.
    heads, digests
        The recordings, or the beginnings of long ones, and their fingerprints.
    chain
        The signal chain, its other choices settled.
    holdout
        The rule by which part of them is held out, which the estimate does not use.
    filters
        What filters their motions, once for all who share it; None: of its own.
    """
    if chain.delay == "auto" and model.mixes_joints:
        chain = replace(chain, delay=None)
    # Stated delays are exact: nothing is estimated, and nothing added to errors.
    if chain.delay != "auto" or not heads:
        stated = tuple(
            state_delay(head, digest, chain.delays)
            for head, digest in zip(heads, digests, strict=True)
        )
        return Delays(chain, stated)

    def prepared(delays: Array) -> list[Samples]:
        shifted = [
            motion.samples(tuple(delay.tolist()))
            for motion, delay in zip(motions, delays, strict=True)
        ]
        return (
            shifted if holdout is None else [hold_out(samples, holdout)[0] for samples in shifted]
        )

    try:
        filters = filters or MotionFilters()
        motions = [filters.prepare(head, chain) for head in heads]
        usual = choose_usual_drive(model, heads[0].torque_source)
        # Friction missing from the fit looks like a torque that is late.
        drive = DriveSet((*usual.terms, *FRICTION.without(*usual.keys).terms))
        found = find_delays(model, prepared, drive=drive, count=len(heads))
    # Without a delay the torque is taken as logged, as before there was an estimate.
    except (AsbuiltError, np.linalg.LinAlgError):
        return Delays(replace(chain, delay=None))
    recordings = tuple(
        _make_recording_delay(head, digests[r], found, r) for r, head in enumerate(heads)
    )
    return Delays(replace(chain, delay=_average_delays(recordings)), recordings)


def _make_recording_delay(
    head: Recording, digest: str, found: DelayEstimate, place: int
) -> RecordingDelay:
    joints: tuple[JointDelay, ...] = ()
    estimate = float(found.estimates[place])
    error = float(found.std_errors[place])
    applied = estimate if found.applied[place] else 0.0
    if found.joint_estimates is not None and found.joint_errors is not None:
        values = found.joint_estimates[place].tolist()
        errors = found.joint_errors[place].tolist()
        joints = tuple(
            JointDelay(name, x, dx, x if np.isfinite(dx) else 0.0)
            for name, x, dx in zip(head.joint_names, values, errors, strict=True)
        )
        applied = float(np.mean([joint.applied for joint in joints]))
    return RecordingDelay(head.source, digest, estimate, error, applied, joints)


def _average_delays(recordings: Sequence[RecordingDelay]) -> float | tuple[float, ...] | None:
    """Return the mean of applied delays, weighted by their errors; None if none was applied."""
    if not any(recording.delays for recording in recordings):
        return None
    n = max(len(recording.delays) for recording in recordings)
    values = np.array(
        [np.broadcast_to(recording.delays or (0.0,), (n,)) for recording in recordings]
    )
    # A delay that is known to the microsecond counts as exact.
    weight = (
        1.0 / np.maximum(np.array([recording.std_error for recording in recordings]), 1e-6) ** 2
    )
    weight = weight if weight.sum() > 0.0 else np.ones(len(recordings))
    mean = (weight @ values / weight.sum()).tolist()
    return mean[0] if n == 1 else tuple(mean)


def report_delays(
    result: IdentificationResult, recordings: Sequence[RecordingDelay], moved: Array | None
) -> tuple[Finding, ...]:
    """Return a finding if torques are late; `moved` (p,) is what that does to parameters."""
    late = [
        recording
        for recording in recordings
        if recording.delays and not np.isnan(recording.estimate)
    ]
    if not late:
        return ()
    is_early = all(recording.estimate < 0.0 for recording in late)
    texts = [recording.text.removeprefix("-" if is_early else "") for recording in late]
    listed = texts[0]
    # What all recordings share needs no name.
    if len(late) < len(recordings) or len(set(texts)) > 1:
        names = [recording.source.rpartition("/")[2] for recording in late]
        listed = ", ".join(f"{text} in {name}" for text, name in zip(texts, names, strict=True))
    shift = np.zeros(1) if moved is None else moved
    errors = np.nan_to_num(result.std_errors, nan=np.inf)
    # A parameter without an error has no bias in errors.
    ratio = np.divide(np.abs(shift), errors, out=np.zeros_like(errors), where=errors > 0)
    worst = int(np.argmax(ratio))
    cost = (
        f"; without the correction {result.base.names[worst]} would move by"
        f" {ratio[worst]:.2g} standard errors"
        if ratio[worst] > 1.0
        else ""
    )
    joints = " (joints differ)" if any(recording.joints for recording in late) else ""
    # Standard errors that a delay must exceed for a warning: of fault-free recordings 5 % exceed 2.
    sure = any(
        recording.joints or abs(recording.estimate) > 3.0 * recording.std_error
        for recording in late
    )
    return (
        Finding(
            "torque_delayed",
            "warning" if cost and sure else "info",
            f"Torques {'are' if sure else 'may be'} {'early' if is_early else 'late'} against"
            f" positions by {listed}{joints};"
            f" they were shifted {'on' if is_early else 'back'}{cost}",
            Cure(
                "log both at the same instants, or state the delay", settings={"delay": "SECONDS"}
            ),
        ),
    )
