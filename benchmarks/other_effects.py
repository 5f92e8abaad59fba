"""Relative torque error on another motion: without effects, with all found, with the best one.

    python benchmarks/other_effects.py [ROBOT ...]

Effects are found on the recordings trained on alone. `best single` is the least error with one of
them in the model. Masses are those of the exported robot in masses of CAD, link by link.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.drives.torque import choose_usual_drive
from asbuilt.errors import AsbuiltError
from asbuilt.experiment.logs.readers import read_recordings
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.preparation import prepare_samples, resolve_chain
from asbuilt.experiment.signal.samples import Samples
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.identification.effects.search import find_effects
from asbuilt.identification.identify import identify_samples
from asbuilt.validation.prediction import validate_samples
from asbuilt.workflow.delays import settle_delays
from asbuilt.workflow.prepare import digest_recording
from asbuilt.writers.tables.mass_tables import exported_masses
from drive_terms import SHARED, UR10E_SHEET
from other_motions import ROBOTS, Robot

KR300 = """torque_source = "motor"
gains = [256.857143, 267.428571, 252.333333, 221, 239.619048, 154.323134]
zero = [0, 1.5707963, -1.5707963, 0, 0, 0]
units.position = "deg"
[columns]
time = 1
position = "2-7"
torque = "20-25"
"""
BAXTER = tuple(
    f"{name}.csv"
    for name in (
        "Training_Random",
        "Training_sin_XYZ_10s_T2_5_Tz_4T_r15",
        "Training_sin_XYZ_10s_T2_Tz_5T_r10",
        "Training_sin_XYZ_15s_T2_5_Tz_6T_r18",
        "Training_sin_XYZ_8s_T2_Tz_4T_r5",
        "Test_circle_XY_T2_r10",
        "Test_sin_XYZ_12_5s_T2_5_Tz_5T_r18",
    )
)
FURTHER = {
    "Baxter": Robot(
        "baxter/baxter_left.urdf", "baxter", BAXTER, ((0, 1, 2, 3, 4),), options={"rate": 100.0}
    ),
    "KR300": Robot("kuka_kr300.toml", "kr300", ("A.csv", "B.csv"), options={"text": KR300}),
    "Kinova": Robot(
        "kinova/gen3.urdf",
        "kinova",
        ("opti_traj_testing1.csv", "opti_traj_testing2.csv"),
        options={"sheet": "sheet4.toml"},
    ),
    "Schunk": Robot(
        "schunk/schunk_lwa4p.urdf",
        "schunk",
        tuple(f"m{number}.csv" for number in range(1, 13)),
        ((0, 1, 2, 3), (4, 5, 6, 7), (8, 9, 10, 11), (0, 1, 2, 3, 4, 5, 6, 7)),
    ),
}
ONLY_SETS = ("Baxter", "Schunk")
"""Robots whose single recordings are not trained on."""


class Case(NamedTuple):
    """Samples of one robot to train on and to predict."""

    robot: str
    train: str
    model: RobotModel
    used: list[Samples]
    others: list[Samples]


def recorded_robots(
    names: Sequence[str], data: Path = SHARED
) -> Iterator[tuple[str, Robot, RobotModel, list[Recording]]]:
    """Yield each robot with its name, model and recordings; all robots without names."""
    for name, robot in (ROBOTS | FURTHER).items():
        if names and name not in names:
            continue
        model, options = load_robot(str(data / "models" / robot.description)), dict(robot.options)
        folder = data / "data" / robot.folder
        options["sheet"] = sheet_of(options, folder)
        logs = [
            read_recordings([folder / each], model=model, **options)[0] for each in robot.recordings
        ]
        yield name, robot, model, logs


def cases(names: Sequence[str], data: Path = SHARED) -> Iterator[Case]:
    """Yield every set of recordings with the others of the same robot."""
    for name, robot, model, logs in recorded_robots(names, data):
        single = () if name in ONLY_SETS else tuple((k,) for k in range(len(logs)))
        for train in (*single, *robot.sets):
            heads = [logs[k] for k in train]
            chain = resolve_chain(SignalChain(), *heads)
            late = settle_delays(
                model, heads, [digest_recording(head) for head in heads], chain, None
            )
            samples = [
                prepare_samples(each, late.chain_of(digest_recording(each))) for each in logs
            ]
            label = "+".join(Path(logs[k].source).stem for k in train)
            others = [samples[k] for k in range(len(logs)) if k not in train]
            yield Case(name, label, model, [samples[k] for k in train], others)


def sheet_of(options: dict[str, Any], folder: Path) -> Path | None:
    """Return the recording sheet of a robot's options; None without one."""
    scratch = Path("out/sheet.toml")
    scratch.parent.mkdir(exist_ok=True)
    if "sheet" in options:
        return folder / options.pop("sheet")
    text = UR10E_SHEET if "gain" in options else options.pop("text", "")
    if not text:
        return None
    scratch.write_text(text)
    return scratch


def errors(case: Case, model: RobotModel, drive: DriveSet) -> tuple[list[float], str]:
    """Return the relative errors [%] on the other motions, and the masses."""
    base = find_base_parameters(model, drive)
    result = identify_samples(model, case.used, base=base, method="auto")
    found = [
        100 * validate_samples(result, each).metrics_as_built.relative_error for each in case.others
    ]
    masses = exported_masses(result)
    _, cad, built = ((), (), ()) if masses is None else zip(*masses.links, strict=True)
    if masses is None or not all(cad):
        return found, ""
    ratios = np.array(built) / np.array(cad, dtype=np.float64)
    return found, " ".join(f"{each:.2f}" for each in ratios)


def report(names: Sequence[str]) -> None:
    """Print the table."""
    for case in cases(names):
        drive = choose_usual_drive(case.model, case.used[0].torque_source)
        began = time.process_time()
        effects = find_effects(case.model, drive, case.used)
        seconds = time.process_time() - began
        print(f"{case.robot} from {case.train} (effects found in {seconds:.1f} s CPU)")
        for each in effects.found:
            print(f"    {'in ' if each.in_model else 'out'} {each.text}")
        rows = {"none": (case.model, drive), "auto": (effects.model, effects.drive)}
        for each in effects.found:
            if each.in_model:
                keys = {each.effect}
                single = find_effects(case.model, drive, case.used, keys=keys)
                rows[f"only {each.effect}"] = single.model, single.drive
        for label, (model, chosen) in rows.items():
            try:
                found, masses = errors(case, model, chosen)
            except AsbuiltError as problem:
                print(f"    {label:<24}{problem}")
                continue
            listed = " ".join(f"{each:7.2f}" for each in found)
            print(f"    {label:<24}{listed}   masses {masses}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robots", nargs="*", help="robots (default: all)")
    report(parser.parse_args().robots)
