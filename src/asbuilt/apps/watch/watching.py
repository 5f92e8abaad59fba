"""A log watched for external torque, contact and fault."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from asbuilt.apps.watch import Observed, Observer, Thresholds, set_thresholds
from asbuilt.apps.watch.causal_filter import choose_pole, largest_velocity_error
from asbuilt.apps.watch.events import Event, find_events, join_events
from asbuilt.apps.watch.options import WatchOptions
from asbuilt.apps.watch.watch_findings import (
    Tally,
    predict_error_size,
    report_calibration,
    report_log,
    report_model,
    report_velocities,
)
from asbuilt.apps.watch.watched_log import POINTS, Trace, WatchedLog
from asbuilt.arrays import Array, Mask, find_finite_rows
from asbuilt.description import RobotModel
from asbuilt.errors import RecordingError, ResultError, UsageError
from asbuilt.experiment import (
    TOO_LITTLE,
    Blocks,
    Recorded,
    Recording,
    RecordingLike,
    RecordingStream,
    Samples,
    SignalChain,
    as_recordings,
    check_recording,
    find_advancing_rows,
    head_of,
    join_recordings,
    parse_rule,
    plan_uniform_grid,
    resolve_chain,
    validate_velocities,
)
from asbuilt.findings import Cure, Finding, rank_findings
from asbuilt.identification import IdentificationResult, choose_payload_frame
from asbuilt.validation import torque_units
from asbuilt.workflow import Progress, Study, is_trained_on

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
    if head.has_computed_torque:
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
    """Yield what the observer makes of a log, in one part or, for a stream, in several.

    A part of a stream whose rows are all left out has no samples.
    """
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


def cut_held_out_parts(parts: Sequence[Observed], rule: str) -> list[Observed]:
    """Return what a rule of `hold_out` holds out of a log, which is observed in one or more parts.

    Time counts from the beginning of the log, not of each part.
    """
    begin = parts[0].t[0]
    chosen = parse_rule(rule)
    held_out = []
    for part in parts:
        since = part.t - begin
        if isinstance(chosen, Blocks):
            block = np.floor(since / chosen.seconds + 1e-9).astype(int)
            held = block % chosen.every == chosen.every - 1
        else:
            held = since >= (1.0 - chosen.share) * (parts[-1].t[-1] - begin)
        if np.count_nonzero(held) >= FEWEST:
            held_out.append(part.select(held))
    return held_out


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
    rates = recording.qd if velocities else None
    finite = find_finite_rows(recording.t, recording.q, recording.tau, rates)
    return find_advancing_rows(recording.t, finite)


def watch(
    result: IdentificationResult | Study,
    recording: RecordingLike,
    *,
    calibrate: RecordingLike | Sequence[RecordingLike] | None = None,
    thresholds: Thresholds | None = None,
    options: WatchOptions | None = None,
    progress: Progress | None = None,
) -> WatchedLog:
    """Watch a log for external torque, contact and fault, with a stated false-alarm rate.

    A momentum observer (`Observer`) estimates the external torque of every joint; times at which it
    exceeds thresholds are events. Thresholds are set on recordings without contact; of one that the
    result was identified from, only what was held out counts, if anything was.

    Parameters
    ----------
    result
        The result, or its study.
    recording
        The log, as for `identify`; a long one is read in chunks.
    calibrate
        Recordings without contact that set the thresholds. If neither these nor `thresholds` are
        given, the quieter half of the log itself does, which promises less.
    thresholds
        Thresholds set earlier.
    options
        How to watch; None: the defaults.
    progress
        Called with the name of a step and the fraction done.

    Returns
    -------
    WatchedLog
        Events, thresholds and findings.

    Raises
    ------
    RecordingError
        If a check finds an error in a recording, or it is too short.
    ResultError
        If the result has no covariance, and thresholds are to be set.
    """
    options = options or WatchOptions()
    report = progress or (lambda what, fraction: None)
    result = result.result
    _check_options(thresholds, options)
    _refuse_free_base(result)
    choose_payload_frame(result.model, options.frame)
    log = require_logged(as_recordings(result.model, [recording])[0])
    quiet = list(map(require_logged, as_recordings(result.model, calibrate or [])))
    if thresholds is None:
        _check_covariance(result)
    report("check", 0.0)
    _check_logs(result, (log, *quiet), options)
    measured = (
        all(map(uses_logged_velocities, (log, *quiet)))
        if thresholds is None
        else not thresholds.filtered
    )
    _check_velocities(log, needed=measured)
    findings = report_velocities(log, measured=measured)
    if thresholds is None:
        report("thresholds", 0.0)
        thresholds, of_thresholds = _choose_thresholds(
            result, log, quiet, options, measured=measured
        )
        findings += of_thresholds
    observer = Observer(_choose_robot(result, options), thresholds=thresholds)
    return _watch_log(result, observer, log, options, findings, report)


def make_stream_observer(
    result: IdentificationResult,
    *,
    calibrate: Sequence[RecordingLike] | None = None,
    thresholds: Thresholds | None = None,
    options: WatchOptions | None = None,
) -> Observer:
    """Return the observer of a stream, with thresholds that are given or set on quiet recordings.

    Raises
    ------
    UsageError
        If there are neither: a stream cannot set its own, since what comes is not known.
    """
    options = options or WatchOptions()
    _check_options(thresholds, options)
    _refuse_free_base(result)
    if thresholds is None:
        quiet = list(map(require_logged, as_recordings(result.model, calibrate or [])))
        if not quiet:
            raise UsageError(
                "a stream has no quieter half that could set thresholds",
                cure=Cure("give recordings without contact", {"calibrate": "LOG"}),
            )
        _check_covariance(result)
        _check_logs(result, quiet, options)
        measured = all(map(uses_logged_velocities, quiet))
        thresholds, _ = _choose_thresholds(result, quiet[0], quiet, options, measured=measured)
    return Observer(_choose_robot(result, options), thresholds=thresholds)


def _check_options(thresholds: Thresholds | None, options: WatchOptions) -> None:
    """Raise `UsageError` if other thresholds are asked for than those given."""
    if thresholds is None:
        return
    usual = WatchOptions()
    for name, what in (("bandwidth", "bandwidth [Hz]"), ("false_alarms_per_hour", "rate [1/h]")):
        asked = getattr(options, name)
        known = getattr(thresholds, name)
        if asked not in (known, getattr(usual, name)):
            raise UsageError(
                f"the thresholds were set for the {what} {known:g}, not {asked:g}",
                cure=Cure("leave it out, or set the thresholds again", {"calibrate": "LOG"}),
                value=asked,
                expected=known,
            )


def _choose_robot(
    result: IdentificationResult, options: WatchOptions
) -> IdentificationResult | RobotModel:
    return result if options.model == "as_built" else result.model


def _refuse_free_base(result: IdentificationResult) -> None:
    result.model.require_root(
        "forces that its feet exert count as external torque; watching one is not possible yet"
    )


def _check_logs(
    result: IdentificationResult,
    logs: Sequence[Recording | RecordingStream],
    options: WatchOptions,
) -> None:
    """Raise `RecordingError` for a log of other joints or, if they are checked, with errors."""
    for log in logs:
        check_joints(result, log)
    if options.checked:
        for log in logs:
            check_recording(result.model, head_of(log)).raise_errors(but=TOO_LITTLE)


def _check_covariance(result: IdentificationResult) -> None:
    if not np.any(np.diag(result.covariance) > 0.0):
        raise ResultError(
            f"the result of {result.robot} has no covariance, so thresholds cannot follow the"
            " uncertainty of its model",
            cure=Cure("identify again"),
        )


def _check_velocities(log: Recording | RecordingStream, *, needed: bool) -> None:
    if needed and head_of(log).qd is None:
        raise RecordingError(
            f"{log.source} has no velocities, but the thresholds were set with logged ones",
            cure=Cure("log velocities, or set the thresholds again", {"calibrate": "LOG"}),
            file=log.source,
        )


def _choose_thresholds(
    result: IdentificationResult,
    log: Recording | RecordingStream,
    quiet: Sequence[Recording | RecordingStream],
    options: WatchOptions,
    *,
    measured: bool,
) -> tuple[Thresholds, list[Finding]]:
    """Return thresholds set on quiet recordings or, without any, on the log itself."""
    error = estimate_doubtful_speed(quiet or [log], options.bandwidth, measured=measured)
    observer = Observer(
        _choose_robot(result, options), bandwidth=options.bandwidth, velocity_error=error
    )
    parts: list[Observed] = []
    findings: list[Finding] = []
    for recording in quiet or [log]:
        trained = is_trained_on(result, recording)
        observed = observe_parts(observer, recording, velocities=measured)
        whole = [part for part in observed if len(part.t)]
        if trained and quiet and result.holdout is not None and result.trained is None:
            whole = cut_held_out_parts(whole, result.holdout)
        elif trained:
            findings.append(
                Finding(
                    "thresholds_on_training_data",
                    "warning",
                    f"{recording.source} was used to identify the model, so its residuals are"
                    " smaller than in other motions and false alarms will be more frequent",
                    Cure("give a recording of another motion without contact"),
                )
            )
        parts += whole
    if not quiet:
        findings.append(
            Finding(
                "thresholds_from_the_log",
                "warning",
                "the thresholds follow from the quieter half of this log, so the rate of false"
                " alarms is not verified",
                Cure("give a recording without contact", {"calibrate": "LOG"}),
            )
        )
    found = set_thresholds(
        parts,
        observer.model_error,
        observer.model.joint_names,
        bandwidth=observer.bandwidth,
        velocity_error=observer.velocity_error,
        false_alarms_per_hour=options.false_alarms_per_hour,
        held_out=bool(quiet),
        filtered=not measured,
    )
    return found, [*findings, *report_calibration(found)]


def _watch_log(
    result: IdentificationResult,
    observer: Observer,
    log: Recording | RecordingStream,
    options: WatchOptions,
    findings: list[Finding],
    report: Callable[[str, float], None],
) -> WatchedLog:
    thresholds = observer.limits
    name, link, placement = choose_payload_frame(observer.model, options.frame)
    events: list[Event] = []
    traces: list[Trace] = []
    tally = Tally(observer.model.joint_names, (link, placement), thresholds.filtered)
    report("observe", 0.0)
    for observed in observe_parts(observer, log, velocities=not thresholds.filtered):
        if not len(observed.t):
            tally.left_out += observed.left_out
            continue
        scale, limit = thresholds.of_log(observed, observer.model_error)
        events += find_events(observer, observed, scale, limit, tally.tool)
        times = np.broadcast_to(observed.t[:, None], limit.shape)
        traces.append(Trace(times, observed.residual, limit).thinned(POINTS))
        tally.add(observer, observed, scale, limit)
    if tally.seconds <= 0.0:
        raise RecordingError(f"{log.source}: no two samples are close enough in time to watch")
    found = join_events(events, thresholds)
    units = torque_units(observer.model)
    of_log = [
        *report_log(thresholds, tally),
        *report_model(tally, predict_error_size(result, options.model), units, name, found),
    ]
    return WatchedLog(
        robot=result.robot,
        source=log.source,
        model=options.model,
        frame=name,
        joint_names=observer.model.joint_names,
        n_samples=tally.n_samples,
        seconds=tally.seconds,
        thresholds=thresholds,
        events=found,
        findings=rank_findings([*findings, *of_log]),
        trace=Trace.joined(traces),
        units=units,
        smallest_force=tally.smallest_force,
    )
