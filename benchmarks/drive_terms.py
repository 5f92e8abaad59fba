"""Held-out torque errors of real robots with every set of drive terms, per joint.

The table goes to out/drive_terms.csv.

Recordings are read from ../shared; where it is absent nothing is measured.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from asbuilt.description.load import load_robot
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.experiment.logs.readers import read_recordings
from asbuilt.experiment.signal.preparation import prepare_samples, resolve_chain
from asbuilt.experiment.signal.samples import hold_out
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.identification.drives.drive_choice import settle_drive
from asbuilt.identification.identify import identify_samples
from asbuilt.validation.prediction import validate_samples

SHARED = Path(__file__).resolve().parents[2] / "shared"
PLAIN = "viscous,coulomb,offset"
SETS = {
    "viscous": "viscous,offset",
    "defaults": PLAIN,
    "asymmetric viscous": "asymmetric_viscous,coulomb,offset",
    "asymmetric Coulomb": "viscous,asymmetric_coulomb",
    "smooth Coulomb": "viscous,smooth_coulomb,offset",
    "Stribeck": f"{PLAIN},stribeck",
    "power": f"{PLAIN},power",
    "cubic": f"{PLAIN},cubic",
    "load": f"{PLAIN},load_friction",
    "spring": f"{PLAIN},spring",
    "balancer": f"{PLAIN},balancer",
    "smooth, Stribeck, load": "viscous,smooth_coulomb,stribeck,load_friction,offset",
    "auto": "auto",
}
UR10E_SHEET = (
    'header = false\ntorque_source = "current"\n[columns]\ntime = 1\nposition = "2-7"\nvelocity ='
    ' "8-13"\ntorque = "14-19"\n'
)


class Case(NamedTuple):
    """A recording to learn from and what to judge by: other recordings, or blocks held out."""

    robot: str
    train: tuple[str, ...]
    judged: tuple[str, ...] = ()
    holdout: str | None = None
    options: Mapping[str, Any] = MappingProxyType({})
    motor: bool = False


CASES = {
    "LBR Med 7": Case(
        "lbrstack_med7.urdf",
        ("lbr_med7/measurements_with_ext_tau_1_dgr.csv",),
        holdout="blocks:5s:3",
        options={"rate": 100.0, "flip_torque": True},
    ),
    "LBR Med 7, short": Case(
        "lbrstack_med7.urdf",
        ("lbr_med7/measurements.csv",),
        holdout="last:0.3",
        options={"rate": 100.0, "flip_torque": True},
    ),
    "LWR4+": Case(
        "kuka_lwr4.urdf", ("kuka_lwr4/measurements_1.npz",), ("kuka_lwr4/measurements_2.npz",)
    ),
    "UR10e": Case(
        "ur10e.urdf",
        ("ur10e/ur-20_02_10-30sec_12harm.csv",),
        ("ur10e/ur-20_02_12-40sec_12harm.csv", "ur10e/ur-20_01_17-ptp_10_points.csv"),
        options={"gain": [14.87, 13.26, 11.13, 10.62, 11.03, 11.47]},
        motor=True,
    ),
    "UR10": Case(
        "ur10.urdf",
        ("ur10_rosbag2/ur10_exciting_trajectory.db3",),
        holdout="blocks:2s:3",
        options={"torque_source": "motor"},
        motor=True,
    ),
}


def measure(data: Path = SHARED) -> dict[str, float | str]:
    """Return the geometric mean over joints of the held-out RMS error [N m], per recording and set
    of terms.
    """
    if not (data / "data").is_dir():
        return {"skipped": "no recordings beside the repository"}
    out = Path("out")
    out.mkdir(exist_ok=True)
    sheet = out / "ur10e_sheet.toml"
    sheet.write_text(UR10E_SHEET)
    numbers: dict[str, float | str] = {}
    lines = ["recording,drive,judged by,relative error,RMS of joint 1 ..."]
    for name, case in CASES.items():
        model = load_robot(str(data / "models" / case.robot))
        options = dict(case.options) | ({"sheet": sheet} if "gain" in case.options else {})
        logs = [
            read_recordings([data / "data" / path], model=model, **options)[0]
            for path in (*case.train, *case.judged)
        ]
        chain = resolve_chain(SignalChain(), *logs[: len(case.train)])
        samples = [prepare_samples(log, chain) for log in logs]
        train, judged = samples[: len(case.train)], samples[len(case.train) :]
        if case.holdout is not None:
            parts = [hold_out(each, case.holdout) for each in train]
            train, judged = [part for part, _ in parts], [held for _, held in parts]
        for label, text in SETS.items():
            drive = (
                "auto"
                if text == "auto"
                else DriveSet.parse(f"armature,{text}" if case.motor else text)
            )
            result = identify_samples(model, train, drive=settle_drive(model, train, drive).drive)
            for each in judged:
                metrics = validate_samples(result, each).metrics_as_built
                where = Path(each.source).name
                numbers[f"{name}: {label}, {where}"] = float(np.exp(np.mean(np.log(metrics.rms))))
                lines.append(
                    ",".join(
                        [
                            name,
                            f'"{label}"',
                            where,
                            f"{metrics.relative_error:.4f}",
                            *(f"{value:.3f}" for value in metrics.rms),
                        ]
                    )
                )
    (out / "drive_terms.csv").write_text("\n".join(lines) + "\n")
    return numbers
