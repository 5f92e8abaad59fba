"""Errors of rollouts, repetitions, outlying windows, and what is said of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests.identification.trajectories.arms import SERVO, recorded_by_mujoco, servo_arm
from tests.identification.trajectories.test_simulation import samples_of

from asbuilt.description import bundled_robot
from asbuilt.executor import open_workers
from asbuilt.identification.trajectories.simulated_robot import (
    DriveSignal,
    build_robot_as_described,
)
from asbuilt.identification.trajectories.windows import Windows, cut_windows
from asbuilt.validation import Rollout, rollout_findings
from asbuilt.validation.rollout.position_errors import (
    OutlyingWindow,
    delay_command,
    find_outlying_windows,
    joint_unit,
    measure_rollout_errors,
    pair_repeated_windows,
)
from asbuilt.validation.rollout.rollout import roll_out
from asbuilt.writers.pictures.rollout_animation import write_rollout_animation

pytest.importorskip("mujoco")


@pytest.fixture(scope="module")
def windows() -> Windows:
    recording = recorded_by_mujoco(servo_arm(), SERVO, duration=6.0)
    return cut_windows(recording, samples_of(recording), 0.5)


@pytest.fixture(scope="module")
def fine() -> Windows:
    """Return the same in steps of 20 us, whose own error is below that of the truth's rollout."""
    recording = recorded_by_mujoco(servo_arm(), SERVO, duration=6.0, step=2e-5)
    return replace(cut_windows(recording, samples_of(recording), 0.5), longest_step=2e-5)


def test_errors_of_known_differences() -> None:
    model = bundled_robot("two-link")
    measured = np.zeros((2, 3, 2))
    simulated = measured.copy()
    simulated[:, 1:, 0] = 0.02
    simulated[1, 2, 1] = 0.01
    found = measure_rollout_errors(model, [np.arange(3) / 100.0], [measured], [simulated])
    assert found.rms == pytest.approx([0.02, 0.005])
    assert found.final == pytest.approx([0.02, np.sqrt(0.5) * 0.01])
    assert found.rms_all == pytest.approx(np.sqrt((4 * 0.02**2 + 0.01**2) / 8))
    assert found.diverged == 0


def test_a_divergence_has_no_number_and_is_counted(windows: Windows) -> None:
    lost = windows.q.copy()
    lost[3, 5:] = np.nan
    found = measure_rollout_errors(servo_arm(), [windows.times], [windows.q], [lost])
    assert found.as_dict()["rms_all"] is None
    assert found.diverged == 1


@pytest.mark.study
def test_robots_of_which_one_diverges_are_compared_before_it(fine: Windows, tmp_path: Path) -> None:
    windows = fine
    truth = servo_arm()
    built = build_robot_as_described(truth, SERVO)
    driven = np.array([key == "viscous" for key in built.drive.keys])
    wild = replace(built, values=np.where(driven, -40.0, built.values))
    found = roll_out(truth, [windows], [wild], [built])
    assert found.cad is not None
    assert found.as_built is not None
    assert found.cad.diverged > 0
    assert found.as_built.diverged == 0
    until = found.cad.until
    assert until == found.as_built.until < windows.times[-1]
    path, early = found.motions[0].cad, windows.times < until
    assert path is not None
    assert np.nanmax(np.abs(path - windows.q)) < 2.0 * np.pi
    assert np.all(np.isfinite(path[:, early]))
    error = (path - windows.q)[:, early][:, 1:]
    assert found.cad.rms_all_until == pytest.approx(np.sqrt(np.mean(error**2)))
    assert found.as_built.rms_all_until < 1e-4 < found.cad.rms_all_until
    (finding,) = (each for each in rollout_findings([found]) if each.code == "rollout_diverged")
    assert f"the first after {until:.2g} s" in finding.message
    assert found.as_dict()["cad"]["rms_all"] is None
    # What is finite of it is drawn.
    whole = roll_out(truth, [windows], [built], [built])
    frames = [
        Image.open(write_rollout_animation(tmp_path / f"{name}.gif", truth, each)).n_frames
        for name, each in (("diverged", found), ("whole", whole))
    ]
    assert 1 < frames[0] < frames[1]


@pytest.mark.study
def test_the_truth_is_closer_than_a_wrong_description(fine: Windows) -> None:
    windows = fine
    truth = servo_arm()
    wrong = truth.with_parameters(1.4 * truth.parameters)
    found = roll_out(
        truth,
        [windows],
        [build_robot_as_described(wrong, SERVO)],
        [build_robot_as_described(truth, SERVO)],
    )
    assert found.as_built is not None
    assert found.cad is not None
    assert found.no_physics is not None
    assert found.as_built.rms_all < 2e-5
    assert found.cad.rms_all > 1e-3
    assert found.as_dict()["n_windows"] == 12
    assert found.driven_by == "command"
    assert rollout_findings([replace(found, outlying=())]) == ()
    exchanged = replace(found, as_built=replace(found.cad, rms_all=1.0), outlying=())
    assert [each.code for each in rollout_findings([exchanged])] == ["rollout_worse_than_command"]


@pytest.mark.study
def test_workers_simulate_the_same_to_the_last_bit(windows: Windows) -> None:
    truth = servo_arm()
    heavier = truth.with_parameters(1.2 * truth.parameters)
    robots = [build_robot_as_described(each, SERVO) for each in (truth, heavier)]
    recordings = [windows, windows]
    here = roll_out(truth, recordings, robots, [None, robots[0]])
    with open_workers(2) as workers:
        there = roll_out(truth, recordings, robots, [None, robots[0]], workers=workers)
    assert here.as_dict() == there.as_dict()
    for one, other in zip(here.motions, there.motions, strict=True):
        assert one.cad is not None
        assert other.cad is not None
        assert one.cad.tobytes() == other.cad.tobytes()
    assert there.motions[0].as_built is None
    last = there.motions[1].as_built
    assert last is not None
    assert last.tobytes() == here.motions[0].cad.tobytes()


def test_errors_by_recording_and_their_mean(windows: Windows) -> None:
    truth = servo_arm()
    wrong = truth.with_parameters(1.4 * truth.parameters)
    robots = [build_robot_as_described(truth, SERVO), build_robot_as_described(wrong, SERVO)]
    parts = [windows, replace(windows.some(slice(0, 4)), source="other")]
    found = roll_out(truth, parts, [None, None], robots)
    first, second = found.by_recording
    assert (first.n_windows, second.n_windows) == (12, 4)
    alone = roll_out(truth, parts[1:], [None], robots[1:])
    assert alone.as_built is not None
    assert second.as_built is not None
    assert first.as_built is not None
    assert second.as_built.rms_all == pytest.approx(alone.as_built.rms_all)
    mean = found.as_dict()["mean"]
    assert mean["as_built"] == pytest.approx(
        0.5 * (first.as_built.rms_all + second.as_built.rms_all)
    )
    assert mean["cad"] is None
    assert found.as_built is not None
    assert found.as_built.rms_all < mean["as_built"]
    assert second.no_physics is not None
    closer = replace(second, no_physics=replace(second.no_physics, rms_all=0.0))
    named = replace(found, by_recording=(first, closer), outlying=())
    (finding,) = rollout_findings([named])
    assert finding.code == "rollout_worse_than_command"
    assert "other" in finding.message


def test_repetitions_of_a_command_give_the_noise() -> None:
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 8.0, 0.01)
    u = np.sin(2 * np.pi * 0.25 * t)[:, None] * [1.0, 0.5]
    q = u + 1e-3 * rng.standard_normal(u.shape)
    cut = Windows(
        "log",
        1.0,
        100.0,
        np.arange(8.0),
        q.reshape(8, 100, 2),
        q[::100],
        np.zeros((8, 2)),
        DriveSignal("command", t, u),
    )
    pairs = pair_repeated_windows([cut])
    assert pairs is not None
    assert len(pairs[0][0]) == 4, "each of four windows comes twice"
    assert np.std(pairs[0][0] - pairs[1][0]) == pytest.approx(np.sqrt(2) * 1e-3, rel=0.1)
    shorter = replace(cut, q=cut.q[:3, :90], starts=cut.starts[:3])
    again = pair_repeated_windows([cut, shorter, cut])
    assert again is not None
    assert again[0][0].shape[1] == 100
    path = delay_command(cut)
    assert path is not None
    assert np.sqrt(np.mean((path - cut.q) ** 2)) < 2.5e-3


def test_a_window_under_contact_is_named(windows: Windows) -> None:
    touched = windows.q + 1e-3
    touched[7, 10:, 1] += 0.1
    found, usual = find_outlying_windows([windows], [touched], windows_names())
    assert [(each.start, each.joint) for each in found] == [(3.5, "joint_2")]
    assert usual[0].tolist() == [0, 1, 2, 3, 4, 5, 6, 8, 9, 10, 11]


@pytest.mark.filterwarnings("error")
def test_windows_that_all_diverge_are_not_outlying(windows: Windows) -> None:
    lost = np.full_like(windows.q, np.nan)
    found, usual = find_outlying_windows([windows], [lost], windows_names())
    assert found == ()
    assert usual[0].tolist() == list(range(12))


def test_errors_of_sliding_joints_are_said_in_their_unit() -> None:
    model = bundled_robot("scara")
    slide = next(joint for joint in model.joints if not joint.is_revolute)
    measured = np.zeros((2, 3, 4))
    errors = measure_rollout_errors(model, [np.arange(3.0)], [measured], [measured + 0.02])
    errors = replace(errors, unit=joint_unit([slide]))
    found = Rollout(
        horizon=0.5,
        driven_by="command",
        motions=(),
        cad=None,
        as_built=errors,
        floor=None,
        no_physics=replace(errors, rms_all=0.01),
        by_recording=(),
        outlying=(OutlyingWindow("a.csv", 1.0, 0.1, slide.name),),
        regular=replace(errors, rms_all=0.015),
    )
    worse, outlying = (finding.message for finding in rollout_findings([found]))
    assert "(10 against 20 mm)" in worse
    assert "Without them it is 15 mm instead of 20 mm" in outlying


def windows_names() -> tuple[str, ...]:
    return servo_arm().joint_names
