"""Relative torque error on whole recordings, from short windows in which a joint hardly moves.

The friction of that joint is undetermined; a drive parameter without evidence must not predict
torque of other motions. Prints the errors [%] by estimator, and the RMS torque error of the joint.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from asbuilt.description.load import load_robot
from asbuilt.dynamics.drives.torque import choose_usual_drive
from asbuilt.experiment.logs.readers import read_recording
from asbuilt.experiment.signal.preparation import prepare_samples, resolve_chain
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.identification.identify import identify_samples
from asbuilt.validation.prediction import validate_samples
from drive_terms import SHARED, UR10E_SHEET
from recorded_robots import USUAL, Robot

PLAIN_CUTOFF = 5.0
"""Cutoff [Hz] of a plain fit."""

METHODS = ("auto", "consistent", "ridge")
BAXTER = Robot(
    "baxter/baxter_left.urdf",
    "baxter",
    ("Test_circle_XY_T2_r10.csv", "Training_Random.csv"),
    options={"rate": 100.0},
)
WINDOWS = (
    ("UR10e", 2, 13.0, 23.0),
    ("UR10e", 0, 0.0, 8.0),
    ("AIRBOT", 0, 12.5, 16.0),
    ("AIRBOT", 1, 17.8, 21.2),
    ("AIRBOT", 2, 0.0, 3.2),
    ("LBR Med 7", 0, 36.0, 44.0),
    ("LBR Med 7", 0, 71.0, 76.0),
    ("Baxter", 0, 0.0, 30.0),
    ("Baxter", 1, 43.0, 52.0),
)
"""Robot, recording, and seconds from which to which a joint moves least."""


def measure(data: Path = SHARED) -> dict[str, float | str]:
    """Return the median relative error [%] of each method on whole recordings."""
    if not (data / "data").is_dir():
        return {"skipped": "no recordings beside the repository"}
    found = report(data)
    return {f"{method}_percent": float(np.median(errors)) for method, errors in found.items()}


def report(data: Path) -> dict[str, list[float]]:
    """Print the table, and return the errors [%] by method."""
    every: dict[str, list[float]] = {method: [] for method in METHODS}
    scratch = Path("out")
    scratch.mkdir(exist_ok=True)
    for name, place, start, stop in WINDOWS:
        robot = BAXTER if name == "Baxter" else USUAL[name]
        model = load_robot(str(data / "models" / robot.description))
        options, folder = dict(robot.options), data / "data" / robot.folder
        if "gain" in options:
            options["sheet"] = scratch / "ur10e_sheet.toml"
            options["sheet"].write_text(UR10E_SHEET)
        elif "sheet" in options:
            options["sheet"] = folder / options["sheet"]
        logs = [read_recording(folder / each, model=model, **options) for each in robot.recordings]
        train = logs[place].between(logs[place].t[0] + start, logs[place].t[0] + stop)
        chain = resolve_chain(SignalChain(cutoff=PLAIN_CUTOFF), train)
        held = [prepare_samples(each, chain) for each in logs]
        still = int(np.argmin(np.ptp(train.q, axis=0)))
        span = float(np.ptp(train.q[:, still]))
        print(
            f"{name} {robot.recordings[place]} {start:g}-{stop:g} s, joint {still + 1} {span:.4f}"
        )
        for method in METHODS:
            result = identify_samples(
                model,
                prepare_samples(train, chain),
                drive=choose_usual_drive(model, train.torque_source),
                method=method,
            )
            found = [validate_samples(result, each).metrics_as_built for each in held]
            every[method] += [100 * each.relative_error for each in found]
            errors = " ".join(f"{100 * each.relative_error:8.1f}" for each in found)
            worst = max(float(each.rms[still]) for each in found)
            print(f"    {method:<12}{errors}   joint {still + 1}: {worst:.3g}", flush=True)
    return every


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=SHARED)
    report(parser.parse_args().data)
