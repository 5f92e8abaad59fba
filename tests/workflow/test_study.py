"""The whole of an identification on virtual robots, and on recordings of real ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

from asbuilt.description import load_robot
from asbuilt.dynamics import DriveSet
from asbuilt.errors import RecordingError, ResultError, UsageError
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Recording, SensorNoise, VirtualRobot, read_recordings
from asbuilt.validation import attribute
from asbuilt.workflow import Study, StudyOptions, identify

UR10E_SHEET = """
header = false
torque_source = "current"
gains = [14.87, 13.26, 11.13, 10.62, 11.03, 11.47]
[columns]
time = 1
position = "2-7"
velocity = "8-13"
torque = "14-19"
"""


@pytest.fixture(scope="module")
def recordings() -> list[Recording]:
    model = load_robot("scara")
    robot = VirtualRobot.typical(model, rng=5)
    return [
        robot.record(random_fourier(model, rng=seed, duration=10.0), rate=200.0, rng=seed).recording
        for seed in (1, 2)
    ]


def test_drive_terms_follow_the_torque_source() -> None:
    assert DriveSet.default("sensor").keys == ("viscous", "coulomb", "offset")
    assert "armature" in DriveSet.default("current").keys
    assert "armature" in DriveSet.default("motor").keys


def test_held_out_blocks_come_before_other_recordings(recordings: list[Recording]) -> None:
    options = StudyOptions(holdout="blocks:1s:3")
    study = identify(
        load_robot("scara"), recordings[:1], validation=recordings[1:], options=options
    )
    assert len(study.validations) == len(study.result.validation) == 2
    assert "held out" in study.validations[0].source
    assert np.array_equal(study.result.cad.rms, study.validations[0].metrics_cad.rms)
    assert len(study.checks) == 2
    assert (
        study.result.validation[1].relative_error
        < 0.5 * study.validations[1].metrics_cad.relative_error
    )


@pytest.mark.study
def test_without_held_out_data_the_result_says_so(recordings: list[Recording]) -> None:
    study = identify(load_robot("scara"), recordings, options=StudyOptions(holdout=None))
    assert "nothing_held_out" in {warning.code for warning in study.findings}
    assert study.result.validation == ()


def test_a_motion_too_poor_for_its_parameters_is_called_so(recordings: list[Recording]) -> None:
    short = [
        replace(
            recordings[0],
            **{name: getattr(recordings[0], name)[:250] for name in ("t", "q", "tau")},
        )
    ]
    study = identify(
        load_robot("scara"), short, validation=recordings[1:], options=StudyOptions(checked=False)
    )
    assert "does_not_generalise" in {warning.code for warning in study.findings}


@pytest.mark.study
def test_a_recording_too_short_to_tell_causes_says_so(recordings: list[Recording]) -> None:
    """One block of time can be fitted or judged by, not both."""
    brief = replace(
        recordings[0], **{name: getattr(recordings[0], name)[:400] for name in ("t", "q", "tau")}
    )
    study = identify(load_robot("scara"), [brief], options=StudyOptions(checked=False))
    said = {warning.code: warning.text for warning in study.findings}
    assert study.result.cause_data is None
    assert "0 held out" in said["causes_undetermined"]
    whole = identify(load_robot("scara"), recordings[:1])
    assert "causes_undetermined" not in {warning.code for warning in whole.findings}
    with pytest.raises(ResultError, match="recordings of at least some seconds"):
        attribute(study.result)


def test_nothing_to_learn_from_is_refused() -> None:
    with pytest.raises(UsageError, match="no recording"):
        identify(load_robot("scara"), [])


def test_what_has_no_name_is_refused_with_the_way_to_name_it() -> None:
    q = np.zeros((10, 4))
    with pytest.raises(UsageError, match=r"(?s)an array of shape \(10,\) that has no name.*'tau'"):
        identify(load_robot("scara"), (q[:, 0], q, q))
    with pytest.raises(UsageError, match="a str came third"):
        identify(load_robot("scara"), "one.csv", "two.csv")


@pytest.mark.study
def test_a_recording_with_errors_is_refused_unless_unchecked(recordings: list[Recording]) -> None:
    with pytest.raises(RecordingError, match="flip"):
        identify(load_robot("scara"), [recordings[0].flipped()])
    identify(load_robot("scara"), [recordings[0].flipped()], options=StudyOptions(checked=False))


@pytest.mark.study
def test_options_are_keywords_too(recordings: list[Recording]) -> None:
    """The same numbers as by the option class, texts as on the command line, and near names."""
    model, log = load_robot("scara"), recordings[0]
    one = identify(model, log, method="wls", mounting="cad", drive="viscous,coulomb")
    drive = DriveSet.parse("viscous,coulomb")
    other = identify(model, log, options=StudyOptions(method="wls", drive=drive))
    assert np.array_equal(one.result.estimates, other.result.estimates)
    assert one.result.to_json() == other.result.to_json()
    with pytest.raises(UsageError, match="no option 'metod'; did you mean 'method'"):
        identify(model, log, metod="wls")
    with pytest.raises(UsageError, match="read already, so that flip_torque would have no effect"):
        identify(model, log, flip_torque=True)
    assert str(one.summary()) == one.summary().as_text()
    axes = one.plot("residuals")
    assert axes.size == model.n_joints
    assert plt.fignum_exists(axes[0].figure.number)  # a script's plt.show() shows it
    plt.close(axes[0].figure)
    for name in ("params", "bse", "tvalues"):
        assert np.array_equal(getattr(one, name), getattr(one.result, name), equal_nan=True)
    assert np.array_equal(one.conf_int(alpha=0.1), one.result.conf_int(0.1), equal_nan=True)
    assert one.to_frame().height == len(one.names)
    states = np.zeros((3, model.n_joints))
    assert np.array_equal(one.predict(states, states, states), one.result.torque(*[states] * 3))
    stored = Study.from_json(one.to_json())
    with pytest.raises(UsageError, match="none is given"):
        stored.plot("torque")
    (axis, *_) = stored.plot("torque", of=log)
    plt.close(axis.figure)


def study_of(
    shared: Path,
    robot: str,
    logs: list[str],
    options: StudyOptions,
    *,
    validation: list[str] | None = None,
    **reading: object,
) -> Study:
    model = load_robot(shared / "models" / robot)
    read = [
        read_recordings([shared / "data" / log for log in names], model=model, **reading)
        for names in (logs, validation or [])
    ]  # type: ignore[arg-type]
    return identify(model, read[0], validation=read[1], options=options)


def recorded_rms(study: Study) -> list[np.ndarray]:
    return [validation.metrics_recorded.rms for validation in study.validations]


@pytest.mark.study
def test_med7_beats_the_manufacturers_model(shared: Path) -> None:
    """Its own controller predicts these held-out blocks to 0.72 1.01 0.43 0.78 0.26 0.22 0.27 N m
    (tau - tau_ext of the file).
    """
    options = StudyOptions(
        drive=DriveSet.parse("viscous,coulomb,offset"), holdout="blocks:5s:3", method="wls"
    )
    study = study_of(
        shared,
        "lbrstack_med7.urdf",
        ["lbr_med7/measurements_with_ext_tau_1_dgr.csv"],
        options,
        rate=100.0,
        flip_torque=True,
    )
    assert np.all(
        study.validations[0].metrics_as_built.rms < [0.72, 1.01, 0.43, 0.78, 0.26, 0.22, 0.27]
    )


def test_med7_with_flipped_torque_is_refused(shared: Path) -> None:
    with pytest.raises(RecordingError) as refused:
        study_of(
            shared,
            "lbrstack_med7.urdf",
            ["lbr_med7/measurements_with_ext_tau_1_dgr.csv"],
            StudyOptions(holdout="last:0.3", method="wls"),
            rate=100.0,
        )
    assert refused.value.cure.settings == {"flip_torque": True}


@pytest.mark.study
def test_short_med7_recording_is_said_not_to_generalise(shared: Path) -> None:
    study = study_of(
        shared,
        "lbrstack_med7.urdf",
        ["lbr_med7/measurements.csv"],
        StudyOptions(holdout="last:0.3", method="wls"),
        rate=100.0,
        flip_torque=True,
    )
    assert "does_not_generalise" in {warning.code for warning in study.findings}


@pytest.mark.study
def test_lwr4_beats_plain_least_squares(shared: Path) -> None:
    study = study_of(
        shared,
        "kuka_lwr4.urdf",
        ["kuka_lwr4/measurements_1.npz"],
        StudyOptions(method="wls"),
        validation=["kuka_lwr4/measurements_2.npz"],
    )
    assert np.all(
        study.validations[0].metrics_as_built.rms <= [0.31, 0.27, 0.28, 0.185, 0.25, 0.2, 0.19]
    )


@pytest.mark.study
def test_ur10e_from_currents(shared: Path, tmp_path: Path) -> None:
    sheet = tmp_path / "ur10e.toml"
    sheet.write_text(UR10E_SHEET)
    study = study_of(
        shared,
        "ur10e.urdf",
        ["ur10e/ur-20_02_10-30sec_12harm.csv"],
        StudyOptions(method="wls", effects="none"),
        validation=["ur10e/ur-20_02_12-40sec_12harm.csv", "ur10e/ur-20_01_17-ptp_10_points.csv"],
        sheet=sheet,
    )
    assert study.result.base.drive.keys == ("armature", "viscous", "coulomb", "offset")
    for validation in study.validations:
        assert validation.metrics_as_built.relative_error < 0.06
        assert np.all(validation.metrics_as_built.rms < validation.metrics_cad.rms)
    said = {warning.code: warning.text for warning in study.findings}
    assert "wrist_2_joint" in said["error_at_standstill"]
    assert "wrist_2_joint" not in said.get(
        "does_not_generalise", ""
    )  # what static friction explains is no fault of the recording


@pytest.mark.parametrize(("roll", "said"), [(0.0, False), (0.02, True)])
@pytest.mark.study
def test_a_robot_that_stands_askew_is_suspected(roll: float, said: bool) -> None:
    model, drive = load_robot("kuka-iiwa7-r800"), DriveSet.parse("viscous,coulomb,offset")
    robot = (
        VirtualRobot.ideal(model).with_drive(drive, np.tile([0.5, 0.8, 0.1], 7)).tilted(roll, 0.0)
    )
    recording = robot.record(
        random_fourier(model, rng=1, duration=20.0, n_harmonics=8), rate=200.0
    ).recording
    study = identify(
        model, [recording], options=StudyOptions(drive=drive, holdout="blocks:2s:3", checked=False)
    )
    assert ("tilt" in {each.effect for each in study.effects}) is said


@pytest.mark.study
def test_real_bodies_that_fit_badly_are_traced_to_the_mounting() -> None:
    model, drive = load_robot("kuka-iiwa7-r800"), DriveSet.parse("viscous,coulomb,offset")
    tilt = 0.05
    robot = (
        VirtualRobot.ideal(model)
        .with_drive(drive, np.tile([0.5, 0.8, 0.1], 7))
        .with_noise(SensorNoise(torque_noise=0.02))
        .tilted(tilt, 0.0)
    )
    recording = robot.record(
        random_fourier(model, rng=1, duration=30.0, n_harmonics=8), rate=100.0, rng=1
    ).recording
    options = StudyOptions(method="auto", drive=drive, checked=False)
    badly = identify(model, [recording], options=replace(options, effects="none"))
    codes = {finding.code for finding in badly.findings}
    assert {"consistent_fit_costly", "consistent_fit_rejected"} & codes
    for mended in (
        identify(model, [recording], options=options),
        identify(model, [recording], options=replace(options, effects="none", mounting="estimate")),
    ):
        assert mended.result.physically_consistent
        left = {warning.code for warning in mended.findings}
        assert not {"consistent_fit_costly", "consistent_fit_rejected", "effect_found"} & left
    (found,) = (
        each for each in identify(model, [recording], options=options).effects if each.in_model
    )
    assert found.effect == "tilt"
    assert found.estimate == pytest.approx(np.rad2deg(tilt), abs=0.15)
