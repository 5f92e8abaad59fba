"""Joints whose log follows another convention than the description: named, or not.

In each recording one joint at a time is changed: position flipped, position and torque flipped, or
zero shifted by 90 or 180 degrees. Counted are changes that `check` names by joint and kind, those
that it explains by another convention that fits as well, those of which an error or a warning on
torques stands in their place, and those without a word. A joint counts if its torque varies by at
least 2 % of the largest, since other joints decide nothing; as logged nothing must be found.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from asbuilt.description.load import bundled_robot, load_robot
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.excitation.motions.fourier import random_fourier
from asbuilt.experiment.logs.readers import read_recordings
from asbuilt.experiment.quality.checks import check_recording
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.virtual.simulation import simulate_recording
from drive_terms import SHARED, UR10E_SHEET
from recorded_robots import USUAL

VIRTUAL = ("kuka-iiwa7-r800", "ur10e", "franka-panda", "puma-560", "scara", "g1-arms")
CODE = "joint_convention"
TORQUE = ("torque_uncorrelated", "joints_swapped", "gravity_direction", "torque_flipped", CODE)
CHANGES = {
    "flipped": (-1.0, 1.0, 0.0),
    "turned": (-1.0, -1.0, 0.0),
    "zero 90": (1.0, 1.0, 0.5 * np.pi),
    "zero 180": (1.0, 1.0, np.pi),
}


def logs(data: Path, scratch: Path) -> Iterator[tuple[str, RobotModel, Recording]]:
    """Yield real recordings, where they are, and recordings of virtual robots."""
    for name, robot in USUAL.items() if (data / "data").is_dir() else ():
        model = load_robot(str(data / "models" / robot.description))
        options = dict(robot.options)
        folder = data / "data" / robot.folder
        if "gain" in options:
            options["sheet"] = scratch / "ur10e_sheet.toml"
            options["sheet"].write_text(UR10E_SHEET)
        elif "sheet" in options:
            options["sheet"] = folder / options["sheet"]
        for each in robot.recordings:
            yield name, model, read_recordings([folder / each], model=model, **options)[0]
    for name in VIRTUAL:
        model = bundled_robot(name)
        for seed in range(2):
            yield (
                name,
                model,
                simulate_recording(model, random_fourier(model, rng=seed), rate=100.0),
            )


def changed(recording: Recording, k: int, position: float, torque: float, zero: float) -> Recording:
    """Return a recording whose joint k is logged in another convention."""
    q, tau = np.array(recording.q), np.array(recording.tau)
    q[:, k] = position * q[:, k] + zero
    tau[:, k] *= torque
    qd = None if recording.qd is None else np.array(recording.qd)
    if qd is not None:
        qd[:, k] *= position
    return replace(recording, q=q, tau=tau, qd=qd, qdd=None)


def verdict(model: RobotModel, recording: Recording, k: int, kind: str) -> str:
    """Return what `check` says of a changed joint."""
    found = {each.code: each for each in check_recording(model, recording).findings}
    if CODE in found:
        said, name = found[CODE].message, model.joint_names[k]
        words = {
            "flipped": f"{name} has the opposite sign of position",
            "turned": f"{name} turns the other way",
            "zero 90": f"{name} reads 90 deg",
            "zero 180": f"{name} reads 180 deg",
        }
        first, _, rest = said.partition("as likely")
        return "named" if words[kind] in first else "as likely" if words[kind] in rest else "other"
    return "torque finding" if any(code in found for code in TORQUE) else "silent"


def report(data: Path, scratch: Path) -> None:
    """Print what is found as logged and changed, by recording."""
    scratch.mkdir(exist_ok=True)
    for name, model, recording in logs(data, scratch):
        as_logged = check_recording(model, recording)
        alarm = next((each.message for each in as_logged.findings if each.code == CODE), "")
        rows = slice(None, None, max(1, recording.n_samples // 400))
        q = recording.q[rows]
        size = np.std(inverse_dynamics(model, q, 0.0 * q, 0.0 * q), axis=0)
        counts: Counter[str] = Counter()
        for k in np.flatnonzero(size > 0.02 * np.max(size)).tolist():
            for kind, change in CHANGES.items():
                said = verdict(model, changed(recording, k, *change), k, kind)
                counts[said] += 1
                if said in ("silent", "other"):
                    print(f"    {said}: {kind} {model.joint_names[k]}")
        told = ", ".join(f"{n} {what}" for what, n in counts.most_common())
        print(f"{name:16} {recording.source[-34:]:34} {told} {alarm}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=SHARED)
    report(parser.parse_args().data, Path("out"))
