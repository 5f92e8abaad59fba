"""The recording sheet and its errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from asbuilt.errors import RecordingError
from asbuilt.experiment import LogTable, RecordingSheet, find_layout, read_recording, read_sheet
from asbuilt.experiment.logs.sheet import find_sheet_beside

FULL = """
rate = 100
header = false
separator = ";"
joints = ["a", "b"]
torque_source = "current"
sign = [1, -1]
gains = [14.87, 13.26]
[columns]
time = 1
position = "2-3"
torque = ["i_1", 5]
[columns.extra]
tau_ext = "6-7"
[units]
time = "ms"
position = "deg"
torque = "mN m"
[[windows]]
start = 2.0
stop = 5.0
"""


def test_every_field(tmp_path: Path) -> None:
    path = tmp_path / "log.toml"
    path.write_text(FULL)
    sheet = read_sheet(path)
    assert sheet.columns.position == [2, 3]
    assert sheet.columns.torque == ["i_1", 5]
    assert sheet.columns.extra == {"tau_ext": [6, 7]}
    assert (sheet.rate, sheet.header, sheet.torque_source) == (100, False, "current")
    assert sheet.windows[0].stop == 5
    path.write_text(FULL, encoding="utf-8-sig")
    assert read_sheet(path) == sheet


def test_windows_are_half_open_and_count_from_the_start() -> None:
    sheet = RecordingSheet.model_validate(
        {"windows": [{"start": 1.0, "stop": 2.0}, {"start": 3.0}]}
    )
    t = np.array([10.0, 11.0, 11.5, 12.0, 13.0, 99.0, np.nan])
    assert sheet.in_windows(t, 10.0).tolist() == [False, True, True, False, True, True, False]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rate = -5", "field 'rate' is -5"),
        ('rate = "fast"', "field 'rate' is 'fast'"),
        ("speed = 3", "not known here; did you mean 'goal_speed'? known are rate, header"),
        (
            '[columns]\ntorques = "1-7"',
            "'columns.torques' is not known here; did you mean 'torque'? known are time, position",
        ),
        ('[units]\nposition = "furlong"', "units.position: 'furlong' is not known; write s, ms"),
        ("sign = 2", "each sign is 1 or -1"),
        ("gains = [1.0, 0.0]", "each must be finite and not zero"),
        ('torque_source = "magic"', "torque_source"),
        ("[[windows]]\nstart = 3.0\nstop = 1.0", "stop 1 s does not come after start 3 s"),
        ("rate = = 3", "is not TOML"),
    ],
)
def test_mistakes_name_file_field_and_cure(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "log.toml"
    path.write_text(text)
    with pytest.raises(RecordingError, match=r"log\.toml") as caught:
        read_sheet(path)
    assert message in str(caught.value)


def test_sheet_beside_the_log(tmp_path: Path) -> None:
    log = tmp_path / "run.csv"
    assert find_sheet_beside(log) is None
    (tmp_path / "run.toml").write_text("rate = 100")
    assert find_sheet_beside(log) == tmp_path / "run.toml"
    (tmp_path / "run.csv.toml").write_text("rate = 200")
    assert find_sheet_beside(log) == tmp_path / "run.csv.toml"


def test_a_robot_file_beside_the_log_is_no_sheet(tmp_path: Path) -> None:
    (tmp_path / "arm.toml").write_text('gravity = [0, 0, -9.81]\n[[links]]\nname = "a"')
    assert find_sheet_beside(tmp_path / "arm.csv") is None


def test_ranges_keep_their_prefix() -> None:
    assert RecordingSheet.model_validate({"columns": {"position": "q_1-q_3"}}).columns.position == [
        "q_1",
        "q_2",
        "q_3",
    ]
    assert RecordingSheet.model_validate(
        {"columns": {"position": "positions"}}
    ).columns.position == ["positions"]


def test_a_list_of_joints_is_not_ignored() -> None:
    """Columns that name their joints are not renamed in silence, and their names tell the order."""
    names = ["time", "q_elbow", "q_wrist", "tau_elbow", "tau_wrist"]
    table = LogTable("log", dict.fromkeys(names, np.zeros(1)))
    for listed in (["elbow", "wrist"], ["wrist", "elbow"]):
        layout = find_layout(table, sheet=RecordingSheet(joints=listed))
        assert layout.joint_names == ("elbow", "wrist")
    with pytest.raises(RecordingError, match="lists the joints") as raised:
        find_layout(table, sheet=RecordingSheet(joints=["one", "two"]))
    assert '[joints] with "elbow"' in str(raised.value.cure)
    with pytest.raises(RecordingError, match="lists the joints"):
        find_layout(table, sheet=RecordingSheet(joints=[]))
    numbered = LogTable("log", dict.fromkeys(["time", "q1", "q2", "tau1", "tau2"], np.zeros(1)))
    with pytest.raises(RecordingError, match="names 0 joints"):
        find_layout(numbered, sheet=RecordingSheet(joints=[]))


def test_gains_of_a_servo_need_its_commands():
    columns = {"t": [0.0, 0.01], "q_1": [0.0, 0.1], "tau_1": [1.0, 2.0]}
    with pytest.raises(RecordingError, match="no commanded positions, so that kp, deadband"):
        read_recording(columns, torque_source="command", kp=20.0, deadband=0.01)
    columns["q_command_1"] = [0.1, 0.2]
    with pytest.raises(RecordingError, match="has torques in addition to its commands") as caught:
        read_recording(columns, kp=20.0)
    assert caught.value.cure.settings == {"torque_source": "command"}
    assert read_recording(columns, kp=20.0, torque_source="command").servo.kp == (20.0,)
