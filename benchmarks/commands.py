"""Rollouts of robots identified from their commands: a Go2 that hangs in the air, and an SO-101.

    python benchmarks/commands.py [go2|so101|halves ...]

`go2`: windows of 2 s that were held out, and the CPU time of the fit without and with the rollout.
`so101`: trained on four motions, windows of 0.5 s of ten others; the delayed command, the robot as
described, the linear fit, the refined one, and the last without outlying windows. `halves`: the
parameters of the SO-101 from odd and even motions, linear and refined, their difference in its
standard error.
Recordings are those of `../shared`; without them nothing is measured. Errors are in mrad.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from asbuilt.description.load import load_robot
from asbuilt.experiment.logs.readers import read_recordings
from asbuilt.experiment.logs.reading_options import ReadingOptions
from asbuilt.experiment.logs.recordings import read_fitted_recordings
from asbuilt.validation.rollout.rollout import Rollout
from asbuilt.workflow.study import Study, identify
from asbuilt.workflow.study_options import StudyOptions
from drive_terms import SHARED

TRAINED = ("multisine", "chirp_sweep", "random_waypoints", "friction_gravity")
OTHERS = (
    "coupled_joints",
    "fast_transitions",
    "hold_under_gravity",
    "large_amplitude",
    "pick_place",
    "prbs_excitation",
    "staircase_motion",
    "static_holding",
    "step_response",
    "velocity_ramp",
)
JOINTS = {
    "Rotation": "shoulder_pan",
    "Pitch": "shoulder_lift",
    "Elbow": "elbow_flex",
    "Wrist_Pitch": "wrist_flex",
    "Wrist_Roll": "wrist_roll",
    "Jaw": "gripper",
}
KINDS = {"Ia": "armature", "Fv": "damping", "Fc": "friction loss"}


def go2() -> dict[str, float]:
    """Return the errors of the Go2 under its own values and as built, and CPU times [s]."""
    model = load_robot(SHARED / "models" / "go2" / "go2.xml", fixed_base=True)
    log = SHARED / "data" / "go2_hung" / "traj_0.pt"
    recordings = read_recordings([log], model=model, torque_source="command", kp=(20.0,), kd=(1.5,))
    options = StudyOptions(holdout="blocks:2s:2")
    found = {}
    for name, each in (
        ("linear fit [s]", options),
        ("with rollout [s]", replace(options, rollout=(2.0,))),
        ("refined, with rollout [s]", replace(options, rollout=(2.0,), refine="rollout")),
    ):
        began = time.process_time()
        study = identify(model, recordings, options=each)
        found[name] = time.process_time() - began
        for rollout in study.rollouts:
            kind = "refined" if each.refine else "linear"
            found |= {f"{kind}, CAD": _all(rollout, "cad"), kind: _all(rollout, "as_built")}
    return found


def so101() -> dict[str, dict[str, float]]:
    """Return the errors [mrad] on the ten motions and their mean, by what is simulated."""
    found: dict[str, dict[str, float]] = {}
    for name, refine in (("linear", None), ("refined", "rollout")):
        began = time.process_time()
        study = _fitted(TRAINED, OTHERS, refine)
        seconds = time.process_time() - began
        (rollout,) = study.rollouts
        kinds = {"command": "no_physics", "CAD": "cad", name: "as_built", f"{name}*": "regular"}
        for kind, field in kinds.items():
            each = {}
            for recording in rollout.by_recording:
                errors = getattr(recording, field)
                label = Path(recording.source).name
                each[label] = np.nan if errors is None else 1e3 * errors.rms_all
            found[kind] = each | {"mean": float(np.nanmean(list(each.values())))}
        found[name]["CPU [s]"] = seconds
        found[name]["outlying windows"] = float(len(rollout.outlying))
        servo, errors = study.result.servo, study.result.servo_errors
        if servo is not None and errors is not None:
            found[name] |= {"kp": servo.kp[0], "kp error": errors.kp[0]}
            found[name] |= {"delay [ms]": 1e3 * (servo.delay or 0.0)}
    return found


def halves() -> dict[str, float]:
    """Return the RMS of differences between odd and even motions, in their standard errors."""
    found = _differences("linear", None)
    return found | _differences("refined", "rollout")


def _differences(fit: str, refine: str | None) -> dict[str, float]:
    names = sorted((*TRAINED, *OTHERS))
    one, other = (_fitted(part, (), refine).result for part in (names[::2], names[1::2]))
    found = {}
    both = {each.name: each for each in other.parameters}
    for kind, label in KINDS.items():
        z = [
            (each.estimate - both[each.name].estimate)
            / np.hypot(each.std_error, both[each.name].std_error)
            for each in one.parameters
            if each.name.startswith(kind) and each.name in both
        ]
        found[f"{fit}, {label}, RMS z"] = float(np.sqrt(np.mean(np.square(z))))
        found[f"{fit}, {label}, largest z"] = float(np.max(np.abs(z)))
    return found


def _fitted(trained: Sequence[str], others: Sequence[str], refine: str | None) -> Study:
    """Return the study of the SO-101 from some motions, its jaw held, rolled out on others."""
    folder = SHARED / "data" / "so101_sage"
    model, (training, validation) = read_fitted_recordings(
        load_robot(SHARED / "models" / "so101" / "so101_new_calib.xml"),
        ([folder / each for each in trained], [folder / each for each in others]),
        options=ReadingOptions(torque_source="command", sheet={"joints": JOINTS}, lock="gripper=0"),
    )
    options = StudyOptions(
        same_servos=True, holdout=None, rollout=(0.5,) if others else (), refine=refine
    )
    return identify(model, training, validation=validation, options=options)


def _all(rollout: Rollout, name: str) -> float:
    errors = getattr(rollout, name)
    return float("nan") if errors is None else 1e3 * errors.rms_all


if __name__ == "__main__":
    asked = sys.argv[1:] or ["go2", "so101", "halves"]
    if not (SHARED / "data").is_dir():
        sys.exit(f"no recordings in {SHARED / 'data'}")
    for part in asked:
        print(part)
        if part == "so101":
            table = so101()
            rows = list(dict.fromkeys(row for each in table.values() for row in each))
            print(f"{'':<22}" + "".join(f"{name:>10}" for name in table))
            for row in rows:
                cells = (table[name].get(row) for name in table)
                line = "".join(f"{'' if x is None else format(x, '.3g'):>10}" for x in cells)
                print(f"{row:<22}{line}")
        else:
            for name, value in (go2() if part == "go2" else halves()).items():
                print(f"{name:<34} {value:8.3g}")
