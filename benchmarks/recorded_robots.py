"""Recordings of real robots in ../shared: how each is read, and what it is identified from.

A robot with several recordings is identified from some and predicts the others; one with a single
recording holds blocks of it out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any, NamedTuple

from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.experiment.logs.readers import read_recordings
from asbuilt.experiment.recording import Recording
from drive_terms import SHARED, UR10E_SHEET

KR300_SHEET = """torque_source = "motor"
gains = [256.857143, 267.428571, 252.333333, 221, 239.619048, 154.323134]
zero = [0, 1.5707963, -1.5707963, 0, 0, 0]
units.position = "deg"
[columns]
time = 1
position = "2-7"
torque = "20-25"
"""
DVRK_SHEET = """rate = 200
header = false
torque_source = "motor"
[columns]
position = "1-7"
velocity = "8-14"
torque = "15-21"
"""
KRANG_SHEET = """torque_source = "current"
gains = [18.7144, 18.7144, 23.75, 23.75, 8.832, 8.832, 8.832]
"""
Z1_SHEET = 'torque_source = "motor"\n'
MED7_PARTS = tuple(f"joint_states_{part}.csv" for part in ("positions", "velocities", "efforts"))
BAXTER = (
    "Training_Random.csv",
    "Training_sin_XYZ_10s_T2_5_Tz_4T_r15.csv",
    "Training_sin_XYZ_10s_T2_Tz_5T_r10.csv",
    "Training_sin_XYZ_15s_T2_5_Tz_6T_r18.csv",
    "Training_sin_XYZ_8s_T2_Tz_4T_r5.csv",
    "Test_circle_XY_T2_r10.csv",
    "Test_sin_XYZ_12_5s_T2_5_Tz_5T_r18.csv",
)


class Robot(NamedTuple):
    """Recordings of one robot, by number from 0.

    `sets` are the recordings to identify from together, the others being predicted, in addition to
    each alone unless `only_sets`; `holdout` holds blocks of each recording out instead. `tilt` says
    that its mounting is estimated in `other_effects`, `two_arms` that each log is of another arm.
    """

    description: str
    folder: str
    recordings: tuple[str | tuple[str, ...], ...]
    sets: tuple[tuple[int, ...], ...] = ()
    tilt: bool = False
    options: Mapping[str, Any] = MappingProxyType({})
    only_sets: bool = False
    holdout: str | None = None
    two_arms: bool = False
    base: Mapping[str, Any] = MappingProxyType({})


USUAL = {
    "LWR4+": Robot(
        "kuka_lwr4.urdf",
        "kuka_lwr4",
        ("measurements_1.npz", "measurements_2.npz", "measurements_3.npz"),
        sets=((0, 1),),
        tilt=True,
    ),
    "LBR Med 7": Robot(
        "lbrstack_med7.urdf",
        "lbr_med7",
        ("measurements_with_ext_tau_1_dgr.csv", "measurements.csv"),
        tilt=True,
        options={"rate": 100.0, "flip_torque": True},
    ),
    "UR10e": Robot(
        "ur10e.urdf",
        "ur10e",
        (
            "ur-20_02_10-30sec_12harm.csv",
            "ur-20_02_12-40sec_12harm.csv",
            "ur-20_01_17-ptp_10_points.csv",
            "ur-20_02_19_14harm50sec.csv",
            "ur-20_01_31-unload.csv",
        ),
        options={"gain": [14.87, 13.26, 11.13, 10.62, 11.03, 11.47]},
    ),
    "AIRBOT": Robot(
        "airbot/airbot_play.urdf",
        "airbot",
        (
            "vali_ga_N12T25.csv",
            "vali_opt.csv",
            "vali_ptrnSrch_N7T25QR-5.csv",
            "vali_ptrnSrch_N8T25QR-8.csv",
        ),
        options={"sheet": "sheet.toml"},
    ),
}
"""Robots with other motions of which each recording is identified from alone."""
FURTHER = {
    "Baxter": Robot(
        "baxter/baxter_left.urdf",
        "baxter",
        BAXTER,
        ((0, 1, 2, 3, 4),),
        options={"rate": 100.0},
        only_sets=True,
    ),
    "KR300": Robot("kuka_kr300.toml", "kr300", ("A.csv", "B.csv"), options={"text": KR300_SHEET}),
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
        only_sets=True,
    ),
    "Panda": Robot("franka-panda", "panda", ("panda_gaz.csv", "panda_unisa.db3"), two_arms=True),
    "Z1": Robot("z1/z1.xml", "z1", ("zn_a.csv", "zn_b.csv"), options={"text": Z1_SHEET}),
    "dVRK PSM": Robot("dvrk-psm", "dvrk/psm", ("one.csv", "two.csv"), options={"text": DVRK_SHEET}),
    "dVRK MTM": Robot("dvrk-mtm", "dvrk/mtm", ("one.csv", "two.csv"), options={"text": DVRK_SHEET}),
}
"""Further robots with other motions."""
SINGLE = {
    "Panda, one log": Robot("franka-panda", "panda", ("panda_gaz.csv",), holdout="blocks:5s:3"),
    "LBR Med 7, one log": Robot(
        "lbrstack_med7.urdf",
        "lbr_med7",
        (MED7_PARTS,),
        options={"flip_torque": True},
        holdout="blocks:5s:3",
    ),
    "Krang": Robot(
        "krang/krang_arm.urdf",
        "krang",
        ("train.csv",),
        options={"text": KRANG_SHEET},
        holdout="blocks:5s:3",
    ),
    "Indy": Robot(
        "indy/indy7.urdf",
        "indy",
        ("random_free_MonitoringDataLog7.txt", "joint_free_with_load.txt"),
        options={"sheet": "sheet.toml"},
        holdout="blocks:5s:3",
    ),
    "TX40": Robot("staubli_tx40.toml", "tx40", ("tx40.csv",), holdout="blocks:1s:3"),
    "Rokae": Robot(
        "rokae_xmate.toml",
        "rokae_two_channels",
        ("rokae_a.csv",),
        holdout="blocks:2s:3",
    ),
    "UR10": Robot(
        "ur10.urdf",
        "ur10_rosbag2",
        ("ur10_exciting_trajectory.db3",),
        options={"torque_source": "motor"},
        holdout="blocks:2s:3",
    ),
    "Solo12": Robot(
        "solo12/solo12.urdf",
        "solo12",
        ("solo12.csv",),
        options={"torque_source": "motor"},
        holdout="last:0.4",
        base={"base": "free", "contacts": "FL_FOOT,FR_FOOT,HL_FOOT,HR_FOOT"},
    ),
}
"""Robots with a single motion, of which blocks are held out."""
ROBOTS = USUAL | FURTHER
"""Robots with another motion to predict."""


def sets_of(robot: Robot) -> list[tuple[int, ...]]:
    """Return the recordings that a robot is identified from, set by set."""
    alone = () if robot.only_sets else tuple((k,) for k in range(len(robot.recordings)))
    return [*alone, *robot.sets]


def load_described(robot: Robot, data: Path = SHARED) -> RobotModel:
    """Return the model of a description beside the recordings, or of a bundled robot."""
    path = data / "models" / robot.description
    return load_robot(str(path) if path.is_file() else robot.description, **robot.base)


def read_logs(robot: Robot, model: RobotModel, data: Path = SHARED) -> list[Recording]:
    """Read the recordings of a robot with its sheet."""
    folder = data / "data" / robot.folder
    options = dict(robot.options)
    text = UR10E_SHEET if "gain" in options else options.pop("text", "")
    with TemporaryDirectory() as scratch:
        if "sheet" in options:
            options["sheet"] = folder / options["sheet"]
        elif text:
            options["sheet"] = Path(scratch) / "sheet.toml"
            options["sheet"].write_text(text)
        return [
            read_recordings([folder / part for part in parts], model=model, **options)[0]
            for parts in ((each,) if isinstance(each, str) else each for each in robot.recordings)
        ]


def recorded_robots(
    names: Sequence[str] = (), data: Path = SHARED
) -> Iterator[tuple[str, Robot, RobotModel, list[Recording]]]:
    """Yield each robot with its name, model and recordings; all with other motion without names."""
    for name, robot in (ROBOTS | SINGLE).items():
        if name in names or (not names and name in ROBOTS):
            model = load_described(robot, data)
            yield name, robot, model, read_logs(robot, model, data)
