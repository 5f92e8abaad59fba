"""A study with rollouts and refinement: from Python, and from the command line."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.identification.trajectories.arms import SERVO, recorded_by_mujoco, servo_arm
from typer.testing import CliRunner

from asbuilt import (
    StudyOptions,
    identify,
    roll_out_result,
    roll_out_robot,
    simulate_recording,
    validate_robot,
)
from asbuilt.dynamics import PositionServo
from asbuilt.errors import UsageError
from asbuilt.excitation import random_fourier
from asbuilt.executor import Workers, open_workers
from asbuilt.experiment import SignalChain
from asbuilt.workflow.study_options import parse_horizons

pytest.importorskip("mujoco")


@pytest.fixture(scope="module")
def study():
    truth = servo_arm()
    recording = replace(recorded_by_mujoco(truth, SERVO, duration=20.0, noise=1e-4), qd=None)
    recording = replace(recording, servo=replace(SERVO, delay=None))
    cad = truth.with_parameters(truth.parameters / 1.2)
    options = StudyOptions(
        holdout="blocks:2s:2",
        rollout=(0.5, 1.0),
        refine="rollout",
        method="entropic",
        chain=SignalChain(cutoff=14.0, parallel_cutoff=14.0),
        checked=False,
    )
    return identify(cad, recording, options=options), recording


@pytest.mark.study
def test_refined_study_beats_the_linear_one_on_what_was_held_out(study) -> None:
    found, _ = study
    assert found.refined is not None
    assert found.refined.after.rms_all < 0.7 * found.refined.before.rms_all
    assert [each.horizon for each in found.rollouts] == [0.5, 1.0]
    for each in found.rollouts:
        assert each.as_built.rms_all < 0.2 * each.cad.rms_all
    assert any("Refined by trajectories" in line for line in found.result.provenance)


@pytest.mark.study
def test_result_simulates_what_was_held_out_of_its_own_recording(study) -> None:
    found, recording = study
    (again,) = roll_out_result(found.result, recording, [0.5])
    assert again.n_windows == found.rollouts[0].n_windows
    assert again.as_built.rms_all == pytest.approx(found.rollouts[0].as_built.rms_all, rel=1e-9)


@pytest.mark.study
def test_a_rollout_needs_data_that_were_not_fitted(study) -> None:
    with pytest.raises(UsageError, match="not fitted to"):
        identify(servo_arm(), study[1], options=StudyOptions(rollout=(0.5,), holdout=None))


@pytest.mark.study
def test_workers_simulate_what_was_held_out_to_the_same_bits(monkeypatch) -> None:
    model, shared, run = servo_arm(), [], Workers.run
    log = simulate_recording(model, random_fourier(model, rng=1, duration=8.0), rng=1)
    options = StudyOptions(rollout=(0.1,), holdout="last:0.3", method="wls", checked=False)
    alone = identify(model, log, options=options)
    monkeypatch.setattr(Workers, "run", lambda *given: shared.append(given) or run(*given))
    with open_workers(0) as workers:
        (found,) = identify(model, log, options=options, workers=workers).rollouts
    assert len(shared) == 1
    assert found.as_built.rms_all == alone.rollouts[0].as_built.rms_all


@pytest.mark.parametrize("text", ["0", "a,b", "-1", "nan", ""])
def test_lengths_of_rollouts_are_positive(text: str) -> None:
    with pytest.raises(UsageError, match="lengths of rollouts are numbers from"):
        parse_horizons(text)


def test_command_line_prints_rollouts_of_a_robot_as_described(tmp_path: Path) -> None:
    from asbuilt import write_recording
    from asbuilt.cli.app import app

    model = servo_arm()
    log = simulate_recording(model, random_fourier(model, rng=1, duration=6.0), rng=1)
    path = tmp_path / "log.csv"
    write_recording(path, log)
    ran = CliRunner().invoke(app, ["validate", "two-link", str(path), "--rollout", "0.1", "--json"])
    (only,) = json.loads(ran.stdout)["rollout"]
    assert only["driven_by"] == "torque"
    assert only["as_built"] is None
    assert len(only["cad"]["rms"]) == 2
    assert np.isfinite(only["cad"]["rms_all"])


def test_a_described_robot_follows_commands_by_its_own_actuators() -> None:
    """MuJoCo moves the arm by the gains of the description; the log states none."""
    gains = zip(servo_arm().joints, SERVO.kp, SERVO.kd, SERVO.torque_limit, strict=True)
    model = replace(
        servo_arm(),
        joints=tuple(
            replace(
                joint,
                drive=replace(joint.drive, kp=kp, kd=kd),
                limits=replace(joint.limits, torque=limit),
            )
            for joint, kp, kd, limit in gains
        ),
    )
    at_once, unknown = replace(SERVO, delay=0.0), (np.nan, np.nan)
    log = recorded_by_mujoco(model, at_once, duration=4.0)
    (stated,) = roll_out_robot(model, log, (0.5,))
    log = replace(log, servo=PositionServo(kp=unknown, kd=unknown))
    (found,) = roll_out_robot(model, log, (0.5,))
    assert found.cad is not None
    assert stated.cad is not None
    assert found.cad.rms_all == stated.cad.rms_all
    assert found.cad.rms_all < 0.01 * np.std(log.q - log.command)
    with pytest.raises(UsageError, match="no torque to compare with"):
        validate_robot(model, log)
    with pytest.raises(UsageError, match="stated neither for the recording nor by two-link"):
        roll_out_robot(servo_arm(), log, (0.5,))
