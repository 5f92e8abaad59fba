"""Logs as the observer takes them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from asbuilt.apps.watch import Observed, Observer
from asbuilt.apps.watch.causal_filter import choose_pole, largest_velocity_error
from asbuilt.arrays import Array, Mask
from asbuilt.errors import RecordingError, UsageError
from asbuilt.experiment import (
    Blocks,
    Recorded,
    Recording,
    RecordingStream,
    Samples,
    SignalChain,
    find_advancing_rows,
    head_of,
    join_recordings,
    parse_rule,
    plan_uniform_grid,
    resolve_chain,
    validate_velocities,
)
from asbuilt.findings import Cure
from asbuilt.identification import IdentificationResult

FEWEST = 10
"""Samples of the shortest log."""


def require_logged(recorded: Recorded) -> Recording | RecordingStream:
    """Return a recording as logged; raises `UsageError` for samples, which are filtered."""
    if isinstance(recorded, Samples):
        raise UsageError(
            "the observer needs a recording as logged; samples are filtered with zero phase",
            cure=Cure("give the recording that the samples were made from"),
        )
    return recorded


def check_joints(result: IdentificationResult, recorded: Recording | RecordingStream) -> None:
    """Raise `RecordingError` for a log of other joints, or without measured torque."""
    head = head_of(recorded)
    names = result.model.joint_names
    if head.joint_names != names:
        raise RecordingError(
            f"{recorded.source} has the joints {', '.join(head.joint_names)}; the result is of"
            f" {result.robot} with {', '.join(names)}",
            cure=Cure("give a log of the robot that was identified"),
            file=recorded.source,
            value=list(head.joint_names),
            expected=list(names),
        )
    if head.torque_source == "command":
        raise RecordingError(
            f"{recorded.source} has no measured torque, only commands of a position servo, from"
            " which external torque does not follow",
            cure=Cure("give a log with torque or current"),
            file=recorded.source,
        )
    if not head.has_torque.all():
        missing = [name for name, has in zip(names, head.has_torque, strict=True) if not has]
        raise RecordingError(
            f"{recorded.source} has no usable torque of {', '.join(missing)}; the observer needs"
            " the torque of every joint",
            cure=Cure("log it, or name its column in a recording sheet: [columns] torque = [...]"),
            file=recorded.source,
            value=missing,
        )


def uses_logged_velocities(recorded: Recording | RecordingStream) -> bool:
    """Whether velocities are logged and agree with the derivative of positions.

    They do where the robot is at rest and rows repeat, so that no lag can show.
    """
    head = head_of(recorded)
    if head.qd is None:
        return False
    if not np.nanmax(np.ptp(head.q, axis=0)) > 0.0:
        return True
    cutoff = resolve_chain(SignalChain(), head).cutoff or 0.0
    grid = plan_uniform_grid(head)
    verdict = validate_velocities(grid.uniform(), grid.rate, cutoff)
    return verdict is not None and verdict.helps


def estimate_doubtful_speed(
    logs: Sequence[Recording | RecordingStream], bandwidth: float, *, measured: bool
) -> Array:
    """Return the speeds (n,) [rad/s or m/s] below which the direction of motion is unknown.

    `measured` says whether logged velocities are used, or positions behind the causal filter of an
    observer of `bandwidth` [Hz].
    """
    heads = [head_of(log) for log in logs]
    steps = np.concatenate([np.diff(head.t) for head in heads])
    pole = None if measured else choose_pole(steps, bandwidth)
    return largest_velocity_error([(head.t, head.q, head.qd) for head in heads], pole)


def observe_parts(
    observer: Observer, recorded: Recording | RecordingStream, *, velocities: bool
) -> Iterator[Observed]:
    """Yield what the observer makes of a log, in one part or, for a stream, in several."""
    if isinstance(recorded, Recording):
        yield _observe_recording(observer, recorded, velocities=velocities)
        return
    seen = 0
    end = -np.inf
    tail = None
    for chunk in recorded:
        whole = chunk if tail is None else join_recordings([tail, chunk])
        found = _observe_recording(observer, whole, velocities=velocities)
        new = found if tail is None else found.select(found.t > end)
        yield replace(new, left_out=max(found.left_out - seen, 0))
        end = float(np.nanmax(chunk.t))
        # Seconds that chunks of a stream share, so that the observer has forgotten its start.
        tail = whole.taken(whole.t > end - 1.0)
        seen = int(np.sum(~_find_valid_rows(tail, velocities=velocities)))


def cut_held_out_part(observed: Observed, rule: str) -> Observed:
    """Return what a rule of `hold_out` holds out of a log."""
    since = observed.t - observed.t[0]
    chosen = parse_rule(rule)
    if isinstance(chosen, Blocks):
        block = np.floor(since / chosen.seconds + 1e-9).astype(int)
        return observed.select(block % chosen.every == chosen.every - 1)
    return observed.select(since >= (1.0 - chosen.share) * since[-1])


def _observe_recording(observer: Observer, recording: Recording, *, velocities: bool) -> Observed:
    """Observe a recording without rows that are not finite or whose time does not advance."""
    kept = _find_valid_rows(recording, velocities=velocities)
    if kept.sum() < FEWEST:
        raise RecordingError(
            f"{recording.source}: {int(kept.sum())} valid samples are too few to watch; at least"
            f" {FEWEST} are needed",
            file=recording.source,
            value=int(kept.sum()),
            expected=FEWEST,
        )
    qd = recording.qd[kept] if velocities and recording.qd is not None else None
    found = observer.observe(recording.t[kept], recording.q[kept], recording.tau[kept], qd)
    return replace(found, left_out=int(np.sum(~kept)))


def _find_valid_rows(recording: Recording, *, velocities: bool) -> Mask:
    """Return which rows (N,) are finite and later than all before them."""
    columns = [recording.t[:, None], recording.q, recording.tau]
    if velocities and recording.qd is not None:
        columns.append(recording.qd)
    return find_advancing_rows(recording.t, np.all(np.isfinite(np.hstack(columns)), axis=1))
