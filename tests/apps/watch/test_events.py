"""Contacts, faults and payloads that were put into recordings."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from watched_robot import RATE, WatchedRobot, recorded

from asbuilt import Observer, WatchOptions, watch
from asbuilt.apps.watch import Observed, WatchedLog
from asbuilt.apps.watch.causal_filter import choose_pole
from asbuilt.apps.watch.events import (
    excess_response,
    find_smallest_forces,
    frame_jacobian,
    join_events,
)
from asbuilt.description import LinkInertia
from asbuilt.errors import RecordingError, ResultError, UsageError
from asbuilt.experiment import Recording, RecordingStream, VirtualRobot
from asbuilt.writers import write_recording
from studied_cases import first_of

UNCHECKED = WatchOptions(checked=False)


def found(watched: WatchedRobot, log: Recording) -> WatchedLog:
    return watch(watched.result, log, thresholds=watched.thresholds, options=UNCHECKED)


def joined_recordings(logs: tuple[Recording, ...]) -> Recording:
    """Return recordings one after another, 2 s apart."""
    t = np.concatenate([log.t + 17.0 * k for k, log in enumerate(logs)])
    columns = {
        name: np.concatenate([getattr(log, name) for log in logs]) for name in ("q", "tau", "qd")
    }
    return replace(logs[0], t=t, **columns)


def test_a_quiet_recording_has_no_events(watched: WatchedRobot) -> None:
    assert found(watched, watched.record(21, 15.0)).events == ()


def test_a_push_is_a_contact_at_its_link(watched: WatchedRobot) -> None:
    """60 N on the fourth link for 0.3 s; joints beyond it feel nothing."""
    log = watched.record(22, 10.0)
    k = slice(1000, 1060)
    external = np.zeros(log.q.shape)
    for s in range(k.start, k.stop):
        jacobian = frame_jacobian(watched.model, log.q[s], 3, np.eye(4))
        lever = np.array([0.0, 60.0, 40.0])
        external[s] = jacobian[3:].T @ lever + jacobian[:3].T @ np.array([4.0, 0.0, 6.0])
    event, *more = found(watched, watched.record(22, 10.0, external)).events
    assert not more
    assert event.kind == "contact"
    assert abs(event.start - 5.0) < 0.05
    assert event.link in {f"link_{j + 1}" for j in range(4)}
    assert set(event.joints) <= set(watched.model.joint_names[:4])


def test_a_force_at_the_tool_is_measured(watched: WatchedRobot) -> None:
    log, force = watched.record(23, 6.0), np.array([30.0, -20.0, 40.0])
    external = np.zeros(log.q.shape)
    for s in range(600, 700):
        external[s] = frame_jacobian(watched.model, log.q[s], 6, np.eye(4))[3:].T @ force
    watched_log = watch(
        watched.result,
        watched.record(23, 6.0, external),
        thresholds=watched.thresholds,
        options=WatchOptions(frame="link_7", checked=False),
    )
    (event,) = watched_log.events
    assert np.all(np.abs(event.contact.force - force) < 5.0 * event.contact.force_error + 2.0)
    assert event.contact.p_value > 1e-3


def test_covariance_is_that_of_residuals_without_contact(watched: WatchedRobot) -> None:
    """Squares of whitened residuals of another motion are 1 on average."""
    observer, log = (
        Observer(watched.result, thresholds=watched.thresholds),
        watched.record(27, 15.0),
    )
    seen = observer.observe(log.t, log.q, log.tau, log.qd)
    scale = watched.thresholds.of_log(seen, observer.model_error)[0]
    squares = []
    for k in range(50, len(seen.t), 50):
        part, r = slice(k, k + 1), seen.residual[k]
        covariance = watched.thresholds.covariance(
            seen.part(part), scale[part], observer.model_error
        )
        squares.append(r @ np.linalg.solve(covariance, r) / r.size)
    assert 0.5 < np.mean(squares) < 2.0


def test_a_lasting_offset_of_one_joint_is_a_fault(watched: WatchedRobot) -> None:
    external = np.zeros(watched.record(24, 10.0).q.shape)
    external[800:, 2] = 12.0
    (event,) = found(watched, watched.record(24, 10.0, external)).events
    assert event.kind == "fault"
    assert event.joints == (watched.model.joint_names[2],)


def test_a_body_on_the_flange_is_a_payload(watched: WatchedRobot) -> None:
    body = LinkInertia.from_com(3.0, [0.0, 0.02, 0.08], 0.01 * np.eye(3))
    loaded = recorded(watched.robot.with_tool(body), 25, 15.0)
    payloads = [event for event in found(watched, loaded).events if event.kind == "payload"]
    assert payloads
    for event in payloads:
        assert event.mass is not None
        assert event.mass_error is not None
        assert abs(event.mass - 3.0) < 0.3


def test_events_across_chunks_are_one(watched: WatchedRobot) -> None:
    external = np.zeros(watched.record(24, 10.0).q.shape)
    external[800:900, 1] = 40.0
    (event,) = found(watched, watched.record(24, 10.0, external)).events
    last, first = watched.model.joint_names[-1], watched.model.joint_names[0]
    event = replace(event, joints=(last,))
    later = replace(event, start=event.end + 0.1, end=event.end + 0.4, joints=(first,))
    (joined,) = join_events((event, later), watched.thresholds)
    assert (joined.start, joined.end) == (event.start, later.end)
    assert joined.joints == (first, last)
    after = replace(later, start=event.end + 2.0)
    assert len(join_events((event, after), watched.thresholds)) == 2


@pytest.mark.study
def test_thresholds_come_from_quiet_recordings_or_are_said_not_to(watched: WatchedRobot) -> None:
    quiet = watch(
        watched.result, watched.record(26, 15.0), calibrate=watched.quiet, options=UNCHECKED
    )
    assert quiet.thresholds.held_out
    assert {each.code for each in quiet.findings} == {"calibration_short"}
    own = watch(watched.result, joined_recordings(watched.quiet), options=UNCHECKED)
    assert {each.code for each in own.findings} == {"thresholds_from_the_log"}
    assert own.as_document()["rate_verified"] is False
    trained = watch(
        watched.result,
        watched.record(26, 15.0),
        calibrate=[watched.trained, *watched.quiet],
        options=UNCHECKED,
    )
    assert "thresholds_on_training_data" in {each.code for each in trained.findings}


@pytest.mark.study
def test_higher_rates_give_lower_thresholds(watched: WatchedRobot) -> None:
    rare, often = (
        watch(
            watched.result,
            watched.record(26, 15.0),
            calibrate=watched.quiet,
            options=WatchOptions(false_alarms_per_hour=rate, checked=False),
        ).thresholds.level
        for rate in (0.1, 10.0)
    )
    assert np.all(rare > often)


def test_a_log_faster_than_the_thresholds_is_named(watched: WatchedRobot) -> None:
    log = watched.record(27, 10.0)
    assert log.qd is not None
    fast = replace(log, t=log.t / 2.0, qd=2.0 * log.qd)
    codes = {each.code for each in found(watched, fast).findings}
    assert "faster_than_thresholds" in codes


def test_rows_left_out_and_another_rate_are_named(watched: WatchedRobot) -> None:
    log = watched.record(27, 10.0)
    q = log.q.copy()
    q[[300, 301, 900], 2] = np.nan
    seen = found(watched, replace(log, q=q))
    (finding,) = seen.findings
    assert finding.code == "rows_left_out"
    assert finding.message.startswith("3 rows")
    (finding,) = found(watched, log.taken(slice(None, None, 2))).findings
    assert finding.code == "rate_of_thresholds"
    assert "100 samples per second" in finding.message


def test_a_log_of_a_robot_on_a_wall_is_named(watched: WatchedRobot) -> None:
    """Its own thresholds would hide it: they follow from the errors of the wrong model."""
    robot = VirtualRobot.ideal(replace(watched.model, gravity=np.array([9.81, 0.0, 0.0])))
    other = joined_recordings((recorded(robot, 21, 15.0), recorded(robot, 22, 15.0)))
    for thresholds in (None, watched.thresholds):
        seen = watch(watched.result, other, thresholds=thresholds, options=UNCHECKED)
        assert "model_disagrees" in {each.code for each in seen.findings}


def test_a_payload_in_the_whole_log_is_no_contact(watched: WatchedRobot) -> None:
    body = LinkInertia.from_com(3.0, [0.0, 0.02, 0.08], 0.01 * np.eye(3))
    seen = found(watched, recorded(watched.robot.with_tool(body), 25, 15.0))
    (finding,) = [each for each in seen.findings if each.code == "payload_in_log"]
    mass, error = map(float, re.findall(r"([0-9.]+) \+/- ([0-9.]+) kg", finding.message)[0])
    assert abs(mass - 3.0) < 4.0 * error < 0.6


@pytest.mark.parametrize("noise", first_of(1, [0.0, 1e-3]))
def test_a_robot_at_rest_is_watched(watched: WatchedRobot, noise: float) -> None:
    """Nothing moves, and a sensor may repeat itself; a push of 20 N m is seen, nothing else."""
    n, rows = watched.model.n_joints, 12000
    rng, q = np.random.default_rng(3), np.linspace(0.2, 1.0, n)
    log = Recording(
        t=np.arange(rows) / RATE,
        q=np.tile(q, (rows, 1)),
        qd=np.zeros((rows, n)),
        tau=watched.result.gravity(q) + 0.3 + noise * rng.normal(size=(rows, n)),
        joint_names=watched.model.joint_names,
        torque_source="motor",
    )
    tau = log.tau.copy()
    tau[6000:6100, 2] -= 20.0
    seen = watch(watched.result, replace(log, tau=tau), calibrate=[log], options=UNCHECKED)
    (event,) = seen.events
    assert abs(event.start - 30.0) < 0.05
    assert np.all(event.threshold > 0.0)
    assert np.isfinite(seen.smallest_force)


@pytest.mark.parametrize("filtered", [False, pytest.param(True, marks=pytest.mark.study)])
def test_smallest_force_is_seen_within_20_ms_and_smaller_ones_are_not(
    watched: WatchedRobot, filtered: bool
) -> None:
    """Torques with the force of a pose, which the observer takes as a ramp over one sample.

    Steps of the contact and of noise may have opposite signs, which the rule does not count on.
    """
    log, tool = watched.quiet[0], (6, np.eye(4))
    observer = Observer(watched.result)

    def observed(tau: np.ndarray) -> Observed:
        return observer.observe(log.t, log.q, tau, None if filtered else log.qd)

    seen = observed(log.tau)
    limit = watched.thresholds.of_log(seen, observer.model_error)[1]
    forces = find_smallest_forces(observer, seen, limit, tool, filtered=filtered)
    rng = np.random.default_rng(0)
    places = np.unique(np.linspace(0.1, 0.9, len(forces)) * (len(seen.t) - 1)).astype(int)
    late = round(0.02 * RATE)
    pole = choose_pole(np.diff(seen.t), observer.bandwidth) if filtered else None
    mean = 0.02 - 0.5 / RATE
    wanted, made = (excess_response(observer, t, 1 / RATE, pole) for t in (0.02, mean))
    for k, force in list(zip(places, forces, strict=True))[:8]:
        along = rng.normal(size=3)
        torque = frame_jacobian(watched.model, seen.q[k], *tool)[3:].T @ along
        torque *= force * wanted / made / np.linalg.norm(along)
        tau = log.tau.copy()
        tau[k - late + 1 :] -= torque
        pushed = observed(tau)
        raised = watched.thresholds.of_log(pushed, observer.model_error)[1]
        assert abs(np.max(np.abs(pushed.residual[k]) / raised[k]) - 1.0) < 0.15


def test_what_cannot_be_watched_is_refused(watched: WatchedRobot) -> None:
    log, result = watched.record(28, 5.0), watched.result
    bare = replace(result, covariance=np.zeros_like(result.covariance))
    with pytest.raises(ResultError, match="no covariance"):
        watch(bare, log)
    other = replace(log, joint_names=tuple("abcdefg"))
    with pytest.raises(RecordingError, match="joint"):
        watch(result, other)
    with pytest.raises(RecordingError, match="too few"):
        watch(result, log.taken(slice(0, 5)), options=UNCHECKED, thresholds=watched.thresholds)
    with pytest.raises(UsageError, match="false_alarms_per_hour is 0; it must be a number"):
        watch(result, log, options=WatchOptions(false_alarms_per_hour=0.0))
    with pytest.raises(UsageError, match="it must be a number from"):
        watch(result, log, options=WatchOptions(false_alarms_per_hour=1e6, checked=False))
    for changes in (
        {"false_alarms_per_hour": np.nan},
        {"hours": 0.0},
        {"slow_speed": np.zeros(7)},
        {"level": np.full(7, np.inf)},
        {"floor": np.ones(6)},
    ):
        with pytest.raises(UsageError, match="of thresholds must be"):
            replace(watched.thresholds, **changes)
    clock = log.t.copy()
    clock[200:] -= 0.5
    with pytest.raises(RecordingError, match="time"):
        watch(result, replace(log, t=clock))


def test_gaps_and_lost_rows_do_no_harm(watched: WatchedRobot) -> None:
    """Rows that are not finite and a gap of a second: the observer starts anew, no alarm."""
    log = watched.record(29, 10.0)
    q, kept = log.q.copy(), np.ones(log.n_samples, dtype=bool)
    q[300, 2] = np.nan
    kept[round(4 * RATE) : round(5 * RATE)] = False
    seen = found(watched, replace(log, q=q).taken(kept))
    assert seen.events == ()
    assert seen.n_samples == kept.sum() - 1
    assert abs(seen.seconds - 9.0) < 0.1


def test_a_stream_is_watched_like_a_recording(watched: WatchedRobot, tmp_path: Path) -> None:
    external = np.zeros(watched.record(24, 10.0).q.shape)
    external[780:900, 1] = 40.0
    log = watched.record(24, 10.0, external)
    path = write_recording(tmp_path / "log.parquet", log)
    stream = RecordingStream(Path(path), watched.model, chunk_samples=400)
    whole, parts = (
        watch(watched.result, each, thresholds=watched.thresholds, options=UNCHECKED)
        for each in (log, stream)
    )
    assert parts.n_samples == whole.n_samples
    (one,), (other,) = whole.events, parts.events
    assert (one.start, one.end, one.kind) == (other.start, other.end, other.kind)
    assert np.allclose(one.residual, other.residual, rtol=0, atol=1e-6)


def test_a_stream_that_ends_in_lost_rows_is_watched_to_their_begin(
    watched: WatchedRobot, tmp_path: Path
) -> None:
    """The last chunk has no row that is finite."""
    log = watched.record(24, 10.0)
    q = log.q.copy()
    q[2 * len(q) // 3 :, 2] = np.nan
    log = replace(log, q=q)
    path = write_recording(tmp_path / "log.parquet", log)
    stream = RecordingStream(Path(path), watched.model, chunk_samples=len(q) // 3)
    whole, parts = (
        watch(watched.result, each, thresholds=watched.thresholds, options=UNCHECKED)
        for each in (log, stream)
    )
    assert parts.n_samples == whole.n_samples
    assert [finding.text for finding in parts.findings] == [
        finding.text for finding in whole.findings
    ]
