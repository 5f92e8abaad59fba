"""Recordings that are spoilt: every command that takes one says so, in place of numbers."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from asbuilt.cli import main
from asbuilt.description import LinkInertia, bundled_robot
from asbuilt.dynamics import inverse_dynamics
from asbuilt.excitation import random_fourier
from command_line import call, document

ROBOT = "ur10e"
MASS = 4.0


def write(path: Path, table: np.ndarray) -> Path:
    header = ",".join(["t", *(f"q_{k}" for k in range(6)), *(f"tau_{k}" for k in range(6))])
    np.savetxt(path, table, delimiter=",", header=header, comments="")
    return path


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """Return a folder with the logs of an arm without and with a payload, `bare.csv` and
    `loaded.csv`, and the motors' beside the first.
    """
    folder = tmp_path_factory.mktemp("logs")
    model = bundled_robot(ROBOT)
    ball = LinkInertia.from_com(MASS, [0.02, 0.0, 0.1], 0.01 * np.eye(3))
    heavy = model.with_parameters(
        model.parameters + np.concatenate([np.zeros(50), ball.parameters])
    )
    for name, seed, robot in (("bare", 1, model), ("loaded", 2, heavy)):
        motion = random_fourier(model, seed, duration=25.0).sample(100.0)
        tau = (
            inverse_dynamics(robot, motion.q, motion.qd, motion.qdd)
            + 2.0 * motion.qd
            + 1.0 * np.sign(motion.qd)
        )
        write(folder / f"{name}.csv", np.column_stack([motion.t, motion.q, tau]))
        write(
            folder / f"{name}_motor.csv",
            np.column_stack([motion.t, motion.q, tau + 3.0 * motion.qd + 0.2 * motion.qdd]),
        )
    return folder / "bare.csv", folder / "loaded.csv", folder / "bare_motor.csv"


@pytest.fixture(scope="module")
def result(logs: tuple[Path, Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("result")
    with pytest.raises(SystemExit):
        main(
            [
                "identify",
                ROBOT,
                str(logs[0]),
                "--torque-source",
                "sensor",
                "--method",
                "wls",
                "--out",
                str(folder),
            ]
        )
    return folder / "result.json"


def degrees(table: np.ndarray) -> None:
    table[:, 1:7] = np.degrees(table[:, 1:7])


def swapped(table: np.ndarray) -> None:
    table[:, [8, 9]] = table[:, [9, 8]]


def missing(table: np.ndarray) -> None:
    table[500:510, 8] = np.nan


def without_torque(table: np.ndarray) -> None:
    table[:, 7:] = 0.0


def one_flipped(table: np.ndarray) -> None:
    table[:, 9] *= -1.0


FAULTS = [
    (degrees, "look like degrees"),
    (swapped, "look swapped"),
    (missing, "missing (NaN)"),
    (without_torque, "torques are constant"),
    (one_flipped, "opposite sign"),
]


@pytest.mark.study
@pytest.mark.parametrize(("fault", "said"), FAULTS)
def test_spoilt_recordings_give_no_numbers(
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    logs: tuple[Path, Path, Path],
    result: Path,
    fault: Callable[[np.ndarray], None],
    said: str,
) -> None:
    bare, loaded, motor = logs
    bad = {}
    every = fault is degrees  # the others are told by the same checks
    for log in (bare, loaded, motor) if every else (loaded,):
        table = np.loadtxt(log, delimiter=",", skiprows=1)
        fault(table)
        bad[log] = write(tmp_path / log.name, table)
    commands = [("payload", result, bad[loaded]), ("validate", ROBOT, bad[loaded])]
    if every:
        commands += [
            ("payload", result, loaded, "--unloaded", bad[bare]),
            ("validate", result, bad[loaded]),
            ("channels", ROBOT, bare, "--motor", bad[motor]),
            ("identify", ROBOT, bare, "--payload", bad[loaded]),
        ]
    if fault is not one_flipped:  # of gains that are looked for, signs are unknown
        commands.append(("gains", ROBOT, bare, "--loaded", bad[loaded], "--mass", MASS))
    for command in commands:
        status, out, err = call(capsys, *command)
        assert status == 1, command
        assert said in err, command
        assert not out, command


@pytest.mark.study
def test_a_payload_is_weighed_whatever_the_checks_say(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, logs: tuple[Path, Path, Path], result: Path
) -> None:
    table = np.loadtxt(logs[1], delimiter=",", skiprows=1)
    missing(table)
    bad = write(tmp_path / "loaded.csv", table)
    for log, *asked in ((bad, "--unchecked"), (logs[1],)):
        weighed = document(capsys, "payload", result, log, "--torque-source", "sensor", *asked)
        assert weighed["mass"]["estimate"] == pytest.approx(MASS, rel=0.02)


@pytest.mark.study
def test_the_payload_found_along_with_the_arm_is_among_the_files(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, logs: tuple[Path, Path, Path]
) -> None:
    bare, loaded, _ = logs
    found = document(
        capsys,
        "identify",
        ROBOT,
        bare,
        "--torque-source",
        "sensor",
        "--payload",
        loaded,
        "--out",
        tmp_path / "out",
    )
    written = json.loads(Path(found["files"]["payload"]).read_text())
    assert written["mass"] == found["payload"]["mass"]
    assert written["mass"]["estimate"] == pytest.approx(MASS, rel=0.02)


@pytest.mark.study
@pytest.mark.parametrize(
    ("columns", "signs", "said"),
    [
        ((12, 11), (1, 1), "wrist_2_joint and wrist_3_joint look swapped"),
        ((11, 12), (1, -1), "wrist_3_joint alone has the opposite sign"),
    ],
)
def test_wrists_that_only_the_known_arm_tells_apart_are_put_right(
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    logs: tuple[Path, Path, Path],
    result: Path,
    columns: tuple[int, int],
    signs: tuple[int, int],
    said: str,
) -> None:
    """Friction of a wrist is as large as what CAD knows of its torque.

    With the arm identified any body at the flange leaves the wrong order unexplained.
    """
    table = np.loadtxt(logs[1], delimiter=",", skiprows=1)
    table[:, [11, 12]] = table[:, list(columns)] * signs
    bad = write(tmp_path / "bad.csv", table)
    status, out, err = call(capsys, "payload", result, bad, "--torque-source", "sensor")
    assert status == 1
    assert said in err
    assert not out
    assert call(capsys, "payload", result, bad, "--torque-source", "sensor", "--unchecked")[0] == 0
