"""A log watched for external torque, contact and fault."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from asbuilt.apps.watch import Observed, Observer, Thresholds, set_thresholds
from asbuilt.apps.watch.events import Event, find_events, join_events
from asbuilt.apps.watch.observation import (
    check_joints,
    cut_held_out_part,
    estimate_doubtful_speed,
    observe_parts,
    require_logged,
    uses_logged_velocities,
)
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
from asbuilt.description import refuse_free_base
from asbuilt.errors import RecordingError, ResultError, UsageError
from asbuilt.experiment import (
    TOO_LITTLE,
    Recording,
    RecordingLike,
    RecordingStream,
    as_recordings,
    check_recording,
    head_of,
)
from asbuilt.findings import Cure, Finding, rank_findings
from asbuilt.identification import IdentificationResult, choose_payload_frame
from asbuilt.validation import torque_units
from asbuilt.workflow import Progress, Study, is_trained_on


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
    result = result.result if isinstance(result, Study) else result
    refuse_free_base(
        result.robot,
        result.model.n_floating,
        "forces that its feet exert count as external torque; watching one is not possible yet",
    )
    choose_payload_frame(result.model, options.frame)
    log = require_logged(as_recordings(result.model, [recording])[0])
    quiet = [
        require_logged(recording) for recording in as_recordings(result.model, calibrate or [])
    ]
    if thresholds is None:
        _check_covariance(result)
    for each in (log, *quiet):
        check_joints(result, each)
    if options.checked:
        report("check", 0.0)
        for each in (log, *quiet):
            check_recording(result.model, head_of(each)).raise_errors(but=TOO_LITTLE)
    robot = result if options.model == "as_built" else result.model
    measured = (
        all(map(uses_logged_velocities, (log, *quiet)))
        if thresholds is None
        else not thresholds.filtered
    )
    _check_velocities(log, needed=measured)
    findings = report_velocities(log, measured=measured)
    if thresholds is None:
        report("thresholds", 0.0)
        error = estimate_doubtful_speed(quiet or [log], options.bandwidth, measured=measured)
        observer = Observer(robot, bandwidth=options.bandwidth, velocity_error=error)
        thresholds, of_thresholds = _choose_thresholds(
            result, observer, log, quiet, options, measured=measured
        )
        findings += of_thresholds
    observer = Observer(robot, thresholds=thresholds)
    return _watch_log(result, observer, thresholds, log, options, findings, measured, report)


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
    refuse_free_base(
        result.robot,
        result.model.n_floating,
        "forces that its feet exert count as external torque; watching one is not possible yet",
    )
    robot = result if options.model == "as_built" else result.model
    if thresholds is not None:
        return Observer(robot, thresholds=thresholds)
    quiet = [
        require_logged(recording) for recording in as_recordings(result.model, calibrate or [])
    ]
    if not quiet:
        raise UsageError(
            "a stream has no quieter half that could set thresholds",
            cure=Cure("give recordings without contact", {"calibrate": "LOG"}),
        )
    _check_covariance(result)
    for each in quiet:
        check_joints(result, each)
        if options.checked:
            check_recording(result.model, head_of(each)).raise_errors(but=TOO_LITTLE)
    measured = all(map(uses_logged_velocities, quiet))
    error = estimate_doubtful_speed(quiet, options.bandwidth, measured=measured)
    observer = Observer(robot, bandwidth=options.bandwidth, velocity_error=error)
    found, _ = _choose_thresholds(result, observer, quiet[0], quiet, options, measured=measured)
    return Observer(robot, thresholds=found)


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
    observer: Observer,
    log: Recording | RecordingStream,
    quiet: Sequence[Recording | RecordingStream],
    options: WatchOptions,
    *,
    measured: bool,
) -> tuple[Thresholds, list[Finding]]:
    parts: list[Observed] = []
    findings: list[Finding] = []
    for each in quiet or [log]:
        trained = is_trained_on(result, each)
        whole = list(observe_parts(observer, each, velocities=measured))
        if trained and quiet and result.holdout is not None and result.trained is None:
            whole = [cut_held_out_part(part, result.holdout) for part in whole]
        elif trained:
            findings.append(
                Finding(
                    "thresholds_on_training_data",
                    "warning",
                    f"{each.source} was used to identify the model, so its residuals are smaller"
                    " than in other motions and false alarms will be more frequent",
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
    thresholds: Thresholds,
    log: Recording | RecordingStream,
    options: WatchOptions,
    findings: list[Finding],
    measured: bool,
    report: Callable[[str, float], None],
) -> WatchedLog:
    name, link, placement = choose_payload_frame(observer.model, options.frame)
    events: list[Event] = []
    traces: list[Trace] = []
    tally = Tally(observer.model.joint_names, (link, placement), thresholds.filtered)
    report("observe", 0.0)
    for observed in observe_parts(observer, log, velocities=measured):
        scale, limit = thresholds.of_log(observed, observer.model_error)
        events += find_events(
            observer,
            observed,
            scale,
            limit,
            thresholds,
            tally.tool,
            apart=thresholds.block_seconds,
        )
        times = np.broadcast_to(observed.t[:, None], limit.shape)
        traces.append(Trace(times, observed.residual, limit).thinned(POINTS))
        tally.add(observer, observed, scale, limit)
    if tally.seconds <= 0.0:
        raise RecordingError(f"{log.source}: no two samples are close enough in time to watch")
    found = join_events(events, thresholds.block_seconds)
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
