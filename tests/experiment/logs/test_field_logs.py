"""Logs as the field has them, made afresh with Pinocchio: what is read must be the clean log."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asbuilt.arrays import Array
from asbuilt.description import RobotModel, load_robot
from asbuilt.errors import RecordingError
from asbuilt.experiment import (
    ReadingOptions,
    RecordingSheet,
    RecordingStream,
    check_recording,
    propose_sheet,
    read_recording,
)
from asbuilt.untrusted import parse_toml
from command_line import call

from .test_ros_logs import STATE, Store

pin = pytest.importorskip("pinocchio")

RATE, COUNT = 200.0, 1600
JOINTS = ("pan", "lift", "bend")
URDF = """<robot name="trio"><link name="root"/>
<link name="a"><inertial><origin xyz="0.02 0.01 0.06"/><mass value="3.1"/>
<inertia ixx="0.02" iyy="0.021" izz="0.015" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="b"><inertial><origin xyz="0.14 0.02 0.01"/><mass value="2.6"/>
<inertia ixx="0.006" iyy="0.04" izz="0.042" ixy="0" ixz="0.001" iyz="0"/></inertial></link>
<link name="c"><inertial><origin xyz="0.1 0 0.01"/><mass value="1.7"/>
<inertia ixx="0.003" iyy="0.016" izz="0.017" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="pan" type="continuous"><parent link="root"/><child link="a"/><axis xyz="0 0 1"/>
<limit effort="90" velocity="5"/></joint>
<joint name="lift" type="continuous"><parent link="a"/><child link="b"/>
<origin xyz="0.03 0 0.1" rpy="1.5707963 0 0"/><axis xyz="0 0 1"/>
<limit effort="90" velocity="5"/></joint>
<joint name="bend" type="continuous"><parent link="b"/><child link="c"/>
<origin xyz="0.3 0 0"/><axis xyz="0 0 1"/><limit effort="90" velocity="5"/></joint></robot>"""


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> RobotModel:
    path = tmp_path_factory.mktemp("trio") / "trio.urdf"
    path.write_text(URDF)
    return load_robot(path)


@pytest.fixture(scope="module")
def clean() -> dict[str, Array]:
    """Times, positions, velocities and torques with friction, by Pinocchio."""
    robot = pin.buildModelFromXML(URDF)
    data = robot.createData()
    t = np.arange(COUNT) / RATE
    phases = np.arange(3.0)
    speeds = 2.0 * np.pi * np.array([[0.35, 0.5, 0.62], [0.8, 1.1, 0.95]])
    sizes = np.array([[0.5, 0.45, 0.4], [0.2, 0.18, 0.22]])
    waves = [speed * t[:, None] + phases for speed in speeds]
    q = sum(a * np.sin(x) for a, x in zip(sizes, waves, strict=True)) + np.array([0.1, 0.4, -0.3])
    qd = sum(a * w * np.cos(x) for a, w, x in zip(sizes, speeds, waves, strict=True))
    qdd = sum(-a * w**2 * np.sin(x) for a, w, x in zip(sizes, speeds, waves, strict=True))
    turns = [np.column_stack([np.cos(row), np.sin(row)]).ravel() for row in q]
    tau = np.array([pin.rnea(robot, data, *each) for each in zip(turns, qd, qdd, strict=True)])
    tau += 0.4 * qd + 0.3 * np.tanh(qd / 0.05)
    tau += 0.02 * np.random.default_rng(3).standard_normal(tau.shape)
    return {"t": t, "q": q, "qd": qd, "tau": tau}


def named(clean: Mapping[str, Array], **changed: Array) -> dict[str, Array]:
    """Columns by usual names; `changed` replaces quantities."""
    values = {**clean, **changed}
    columns = {"time": values["t"]}
    for quantity, word in (("q", "position"), ("qd", "velocity"), ("tau", "effort")):
        for joint, column in zip(JOINTS, values[quantity].T, strict=True):
            columns[f"{joint}_{word}"] = column
    return columns


def write(path: Path, columns: Mapping[str, Array], form: str = "%.9g") -> Path:
    rows = np.column_stack([*columns.values()])
    text = (",".join("" if np.isnan(x) else form % x for x in row) for row in rows)
    path.write_text("\n".join([",".join(columns), *text]) + "\n")
    return path


def read_proposed(model: RobotModel, path: Path) -> Any:
    """The recording read by the proposed sheet, as text beside the log, and its check."""
    proposal = propose_sheet(model, [path])
    assert proposal.problem is None
    sheet = RecordingSheet.model_validate(parse_toml(proposal.text))
    recording = read_recording(path, model=model, sheet=sheet)
    return recording, check_recording(model, recording), proposal


def test_a_stated_rate_wins_over_one_guessed_from_columns_without_names(
    model: RobotModel, clean: dict[str, Array], tmp_path: Path
) -> None:
    path = tmp_path / "log.csv"
    table = np.hstack([clean["q"], clean["qd"], clean["tau"]])
    np.savetxt(path, table, delimiter=",")
    # A clock of 1 % less than velocities say: columns are kept all the same.
    proposal = propose_sheet(model, [path], ReadingOptions(rate=0.99 * RATE))
    assert proposal.problem is None
    assert proposal.content["rate"] == 0.99 * RATE
    assert proposal.content["columns"]["torque"] == [7, 8, 9]


def test_rows_of_another_topic_are_left_out(
    model: RobotModel, clean: dict[str, Array], tmp_path: Path
) -> None:
    columns = named(clean)
    other = clean["t"][::3] + 0.0012
    order = np.argsort(np.concatenate([clean["t"], other]), kind="stable")
    merged = {
        name: np.concatenate([x, other if name == "time" else np.full(other.size, np.nan)])[order]
        for name, x in columns.items()
    }
    merged["voltage"] = np.concatenate([np.full(COUNT, np.nan), other])[order]
    recording = read_recording(write(tmp_path / "merged.csv", merged), model=model)
    np.testing.assert_allclose(recording.q, clean["q"], atol=1e-8)
    assert f"{other.size} of {order.size} rows hold other topics and were left out" in (
        recording.notes
    )
    assert check_recording(model, recording).ok


def test_topics_in_rows_of_their_own_are_joined_by_time(
    model: RobotModel, clean: dict[str, Array], tmp_path: Path
) -> None:
    t, late = clean["t"], clean["t"] + 0.4 / RATE
    torque = np.column_stack([np.interp(late, t, column) for column in clean["tau"].T])
    gap = np.full((COUNT, 3), np.nan)
    order = np.argsort(np.concatenate([t, late]), kind="stable")
    merged = {
        "t": np.concatenate([t, late])[order],
        "q": np.concatenate([clean["q"], gap])[order],
        "qd": np.concatenate([clean["qd"], gap])[order],
        "tau": np.concatenate([gap, torque])[order],
    }
    recording = read_recording(write(tmp_path / "two.csv", named(merged)), model=model)
    np.testing.assert_allclose(recording.q, clean["q"], atol=1e-8)
    spread = np.std(clean["tau"] - recording.tau, axis=0, where=np.isfinite(recording.tau))
    assert np.all(spread < 0.05)
    assert any("were interpolated at the 1600 times" in note for note in recording.notes)


def test_rows_out_of_order_are_sorted_and_doubled_stamps_thinned(
    model: RobotModel, clean: dict[str, Array], tmp_path: Path
) -> None:
    order = np.arange(COUNT)
    swapped = np.arange(50, COUNT - 50, 60)
    order[swapped], order[swapped + 1] = order[swapped + 1], order[swapped]
    again = np.insert(order, swapped[::2] + 20, order[swapped[::2] + 20])
    spoilt = {name: values[again] for name, values in clean.items()}
    recording = read_recording(write(tmp_path / "order.csv", named(spoilt)), model=model)
    np.testing.assert_allclose(recording.t, clean["t"], atol=1e-8)
    np.testing.assert_allclose(recording.tau, clean["tau"], atol=1e-7)
    said = " ".join(recording.notes)
    assert f"{swapped.size} times a row was earlier" in said
    assert f"{swapped[::2].size} of {again.size} rows have the time stamp of another" in said
    assert check_recording(model, recording).ok


def test_a_clock_that_was_set_back_is_not_sorted(
    model: RobotModel, clean: dict[str, Array], tmp_path: Path
) -> None:
    t = np.where(clean["t"] < 4.0, clean["t"], clean["t"] - 3.9973)
    recording = read_recording(write(tmp_path / "again.csv", named(clean, t=t)), model=model)
    assert np.sum(np.diff(recording.t) < 0) == 1
    assert "clock_backward" in check_recording(model, recording).codes


@pytest.mark.parametrize("stamps", ["tenths", "single precision"])
def test_rounded_stamps_become_the_regular_clock_behind_them(
    model: RobotModel, clean: dict[str, Array], tmp_path: Path, stamps: str
) -> None:
    t = np.floor(10.0 * clean["t"]) / 10.0
    if stamps == "single precision":
        t = (clean["t"] + 8000.0).astype(np.float32).astype(np.float64)
    path = write(tmp_path / "coarse.csv", named(clean, t=t), "%.17g")
    recording = read_recording(path, model=model)
    np.testing.assert_allclose(np.diff(recording.t), 1.0 / RATE, rtol=2e-3)
    assert any("replaced by the regular clock of" in note for note in recording.notes)


@pytest.mark.parametrize(("unit", "turn"), [("rad", 2.0 * np.pi), ("deg", 360.0)])
def test_positions_that_wrap_are_unwrapped(
    model: RobotModel, clean: dict[str, Array], tmp_path: Path, unit: str, turn: float
) -> None:
    scale = turn / (2.0 * np.pi)
    columns = named(clean, q=np.mod(scale * clean["q"], turn), qd=scale * clean["qd"])
    columns = {
        (f"{name} [{unit}]" if "position" in name else f"{name} [{unit}/s]")
        if "position" in name or "velocity" in name
        else name: values
        for name, values in columns.items()
    }
    recording = read_recording(write(tmp_path / "wrap.csv", columns), model=model)
    np.testing.assert_allclose(recording.q, clean["q"], atol=1e-6)
    assert any(f"wrap at {turn:.6g} were unwrapped" in note for note in recording.notes)
    assert check_recording(model, recording).ok


def test_a_flipped_sign_is_found_behind_the_wraps(
    model: RobotModel, clean: dict[str, Array], tmp_path: Path
) -> None:
    columns = named(clean, q=np.mod(clean["q"], 2.0 * np.pi), tau=-clean["tau"])
    recording, check, proposal = read_proposed(model, write(tmp_path / "both.csv", columns))
    assert proposal.content["sign"] == -1
    assert check.ok
    np.testing.assert_allclose(recording.tau, clean["tau"], atol=1e-7)


def test_counts_of_a_servo_and_unsigned_currents(
    model: RobotModel, clean: dict[str, Array], tmp_path: Path
) -> None:
    counts = np.round(clean["q"] * 4096 / (2.0 * np.pi) + 2048)
    current = np.mod(np.round(150.0 * clean["tau"]), 65536)
    columns = {"time_ms": 1e3 * clean["t"]}
    for joint, q, i in zip(JOINTS, counts.T, current.T, strict=True):
        columns |= {f"{joint}_present_position": q, f"{joint}_present_current": i}
    recording, check, proposal = read_proposed(model, write(tmp_path / "raw.csv", columns))
    assert proposal.content["units"]["position"] == "1/4096 turn"
    np.testing.assert_allclose(recording.q, clean["q"], atol=2.0 * np.pi / 4096)
    np.testing.assert_allclose(recording.tau, 150.0 * clean["tau"], atol=0.51)
    # What is left to a person are the gains.
    assert {finding.code for finding in check.errors} <= {"torque_scale"}


@pytest.mark.parametrize(
    ("factor", "unit"),
    [(0.01 / 0.229, "22.9 rad/s"), (60.0 / (2.0 * np.pi) / 0.229, "0.229 rpm"), (2.5, "0.4 rad/s")],
)
def test_a_unit_of_velocities_is_no_rate_where_torques_keep_the_clock(
    model: RobotModel, clean: dict[str, Array], tmp_path: Path, factor: float, unit: str
) -> None:
    path = write(tmp_path / "vel.csv", named(clean, qd=factor * clean["qd"]))
    recording, check, proposal = read_proposed(model, path)
    assert proposal.content["units"]["velocity"] == unit
    assert check.ok
    np.testing.assert_allclose(recording.qd, clean["qd"], atol=0.02)


def test_a_clock_that_torques_contradict_is_a_wrong_rate(
    model: RobotModel, clean: dict[str, Array], tmp_path: Path
) -> None:
    path = write(tmp_path / "fast.csv", named(clean, t=clean["t"] / 2.5))
    codes = check_recording(model, read_recording(path, model=model)).codes
    assert "rate_wrong" in codes
    assert "velocity_units" not in codes


def test_publishers_that_share_a_topic_are_joined_by_time(
    model: RobotModel, clean: dict[str, Array], tmp_path: Path
) -> None:
    store = Store(first=False)
    state, header, time = (
        store.types[name] for name in (STATE, "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    with import_module("rosbags.rosbag2").Writer(tmp_path / "bag", version=9) as bag:
        connection = bag.add_connection("/joint_states", STATE, typestore=store.store)
        for k in range(400):
            for names, late in ((JOINTS[:1], 0.0), (JOINTS[1:], 0.0013)):
                at = round(1e9 * (1000.0 + clean["t"][k] + late))
                places = [JOINTS.index(name) for name in names]
                values = [np.array(clean[part][k, places]) for part in ("q", "qd", "tau")]
                head = header(time(sec=at // 10**9, nanosec=at % 10**9), "")
                message = state(head, list(names), *values)
                bag.write(connection, at, store.store.serialize_cdr(message, STATE))
    recording = read_recording(tmp_path / "bag", model=model)
    assert recording.joint_names == JOINTS
    assert np.isfinite(recording.q).mean() > 0.99
    np.testing.assert_allclose(recording.q[5:-5], clean["q"][5:395], atol=0.01)
    assert any("400 messages name pan alone" in note for note in recording.notes)


def test_a_log_without_names_whose_time_stands_behind_marks(
    model: RobotModel, clean: dict[str, Array], tmp_path: Path
) -> None:
    """Marks, time, positions measured and commanded, both velocities, something, torques."""
    late = np.roll(clean["q"], 2, axis=0)
    order = np.arange(COUNT)
    order[300:320] = order[300:320][::-1]
    parts = [
        np.full((COUNT, 2), [1001.0, 7.0]),
        (1.6e9 + clean["t"])[:, None],
        np.degrees(late),
        np.degrees(clean["q"]),
        np.degrees(np.roll(clean["qd"], 2, axis=0)),
        np.degrees(clean["qd"]),
        np.tile([4.0, 5.0, 6.0], (COUNT, 1)),
        np.roll(clean["tau"], 2, axis=0),
    ]
    path = tmp_path / "monitor.txt"
    np.savetxt(path, np.hstack(parts)[order], fmt="%.9f")
    recording, check, proposal = read_proposed(model, path)
    columns = proposal.content["columns"]
    assert columns["time"] == 3
    found = [columns[name] for name in ("position", "command", "velocity", "torque")]
    assert found == [[4, 5, 6], [7, 8, 9], [10, 11, 12], [19, 20, 21]]
    assert proposal.content["units"]["position"] == "deg"
    np.testing.assert_allclose(recording.q, late, atol=1e-8)
    assert check.ok


def test_channels_are_named_and_the_sensor_is_taken(
    model: RobotModel, clean: dict[str, Array], tmp_path: Path
) -> None:
    """As a maker logs them, with commanded accelerations that overflowed."""
    tau = {"Torque": clean["tau"], "TorqueSm": clean["tau"] + 0.1, "TorqueCur": 1.3 * clean["tau"]}
    columns = {"Time": clean["t"]}
    for word, values in {
        "Position": clean["q"],
        "Velocity": clean["qd"],
        **tau,
        "AccCmptd": np.full((COUNT, 3), 1e250),
        "TorqueCmptd": clean["tau"],
    }.items():
        columns |= {f"{word}{k}": column for k, column in enumerate(values.T, start=1)}
    recording = read_recording(write(tmp_path / "maker.csv", columns), model=model)
    np.testing.assert_allclose(recording.tau, tau["TorqueSm"], atol=1e-7)
    assert recording.qdd is None
    note = next(note for note in recording.notes if "3 channels of torque" in note)
    assert "TorqueSm* was taken" in note
    assert "Torque*, TorqueCur* were not" in note


@pytest.mark.parametrize(
    ("position", "torque"),
    [("y_angle_{k}", "u_torque_{k}"), ("{name}_pos", "{name}_torque_raw")],
)
def test_headers_of_the_field(
    model: RobotModel, clean: dict[str, Array], tmp_path: Path, position: str, torque: str
) -> None:
    columns = {"t": clean["t"]}
    for k, name in enumerate(JOINTS):
        columns[position.format(k=k + 1, name=name)] = clean["q"][:, k]
        columns[torque.format(k=k + 1, name=name)] = clean["tau"][:, k]
    recording = read_recording(write(tmp_path / "headers.csv", columns), model=model)
    np.testing.assert_allclose(recording.tau, clean["tau"], atol=1e-7)


def test_raw_and_filtered_columns_and_a_spare_velocity(
    model: RobotModel, clean: dict[str, Array], tmp_path: Path
) -> None:
    columns = named(clean)
    columns = {name: x for name, x in columns.items() if name != "bend_velocity"}
    columns |= {
        f"{name}_effort_raw": x for name, x in zip(JOINTS, 9.0 * clean["tau"].T, strict=True)
    }
    recording = read_recording(write(tmp_path / "raw.csv", columns), model=model)
    np.testing.assert_allclose(recording.tau, clean["tau"], atol=1e-7)
    assert recording.qd is None
    said = " ".join(recording.notes)
    assert "2 channels of torque" in said
    assert "columns of velocity do not match" in said


def test_check_writes_the_sheet_beside_the_log(
    clean: dict[str, Array], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = tmp_path / "trio.urdf"
    robot.write_text(URDF)
    columns = named(clean, t=1e3 * clean["t"], q=np.mod(clean["q"], 2.0 * np.pi), tau=-clean["tau"])
    log = write(tmp_path / "run.csv", columns)
    asked = ("check", robot, log, "--no-information", "--json")
    status, out, _ = call(capsys, *asked)
    before = json.loads(out)
    assert status == 1
    assert not before["ok"]
    assert "sign = -1" in before["sheets"][str(log)]
    assert not (tmp_path / "run.csv.toml").exists()
    assert call(capsys, *asked, "--write-sheet")[0] == 0
    written = parse_toml((tmp_path / "run.csv.toml").read_text())
    assert written["units"] == {"time": "ms"}
    assert written["sign"] == -1
    # What a person wrote into it is kept.
    (tmp_path / "run.csv.toml").write_text("sign = 1\n")
    assert call(capsys, *asked, "--write-sheet")[0] == 1
    assert (tmp_path / "run.csv.toml").read_text() == "sign = 1\n"


@pytest.mark.parametrize("zero", [-0.35, np.array([0.0, 0.9, -0.6])])
def test_encoders_that_wrap_within_the_motion_get_the_zero_of_the_torques(
    model: RobotModel, clean: dict[str, Array], tmp_path: Path, zero: Any
) -> None:
    wrapped = np.mod(clean["q"] + zero, 2.0 * np.pi)
    columns = named(clean, q=wrapped)
    velocities = [name for name in columns if "velocity" in name]
    path = write(tmp_path / "wrap.csv", {k: v for k, v in columns.items() if k not in velocities})
    recording, check, proposal = read_proposed(model, path)
    assert check.ok
    # The pan axis is vertical: no torque shows its zero.
    away = np.abs(recording.q - clean["q"])[:, 1:]
    assert np.degrees(away.max()) < 4.0
    assert "zero" in proposal.content


def test_zero_of_a_counter_that_wraps_may_be_given(
    model: RobotModel, clean: dict[str, Array], tmp_path: Path
) -> None:
    path = write(tmp_path / "wrap.csv", named(clean, q=np.mod(clean["q"] + 6.0, 2.0 * np.pi)))
    recording = read_recording(path, model=model, sheet=RecordingSheet(zero=6.0))
    np.testing.assert_allclose(recording.q, clean["q"], atol=1e-7)


def test_one_impossible_mass_is_not_said_of_the_torques(
    model: RobotModel, clean: dict[str, Array], tmp_path: Path
) -> None:
    heavy = tmp_path / "heavy.urdf"
    heavy.write_text(
        URDF.replace('mass value="2.6"', 'mass value="26"').replace(
            'ixx="0.006" iyy="0.04" izz="0.042"', 'ixx="0.006" iyy="0.012" izz="0.012"'
        )
    )
    robot = load_robot(heavy)
    check = check_recording(
        robot, read_recording(write(tmp_path / "a.csv", named(clean)), model=robot)
    )
    assert check.ok
    assert [(f.code, f.link) for f in check.warnings] == [("implausible_density", "b")]
    assert "agree with 2.6 kg" in check.warnings[0].message


def test_parts_of_a_long_log_are_mended_as_the_whole(
    model: RobotModel, clean: dict[str, Array], tmp_path: Path
) -> None:
    order = np.arange(COUNT)
    swapped = np.arange(50, COUNT - 50, 60)
    order[swapped], order[swapped + 1] = order[swapped + 1], order[swapped]
    spoilt = {name: values[order] for name, values in clean.items()}
    spoilt["q"] = np.mod(spoilt["q"], 2.0 * np.pi)
    path = write(tmp_path / "long.csv", named(spoilt))
    whole = read_recording(path, model=model)
    parts = [*RecordingStream(path, model=model, chunk_samples=500)]
    for name in ("t", "q", "qd", "tau"):
        np.testing.assert_array_equal(
            np.concatenate([getattr(p, name) for p in parts]), getattr(whole, name)
        )
    assert parts[-1].notes == whole.notes
    check = check_recording(model, RecordingStream(path, model=model, chunk_samples=500))
    assert [f.message for f in check.findings if f.code == "note"] == [*whole.notes]


def in_turns(clean: Mapping[str, Array]) -> dict[str, Array]:
    return {"q": clean["q"] / (2.0 * np.pi), "qd": clean["qd"] / (2.0 * np.pi)}


def in_registers(clean: Mapping[str, Array]) -> dict[str, Array]:
    counts = np.round(clean["q"] * 4096 / (2.0 * np.pi))
    speeds = np.round(clean["qd"] / (0.229 * np.pi / 30.0))
    return {"q": np.mod(counts, 2.0**32), "qd": np.mod(speeds, 2.0**32)}


LIMITS = np.array([120.0, 90.0, 30.0])


@pytest.mark.parametrize(
    ("change", "content"),
    [
        (in_turns, {"units": {"position": "turn", "velocity": "turn/s"}}),
        (in_registers, {"units": {"position": "1/4096 turn", "velocity": "0.229 rpm"}}),
        (lambda clean: {"tau": 1e3 * clean["tau"]}, {"units": {"torque": "mN m"}}),
        (lambda clean: {"tau": np.round(1e3 * clean["tau"] / LIMITS)}, {"gains": 1e-3 * LIMITS}),
        (lambda clean: {"tau": 100.0 * clean["tau"] / LIMITS}, {"gains": 1e-2 * LIMITS}),
    ],
)
def test_units_are_named_by_what_agrees(
    clean: dict[str, Array], tmp_path: Path, change: Any, content: dict[str, Any]
) -> None:
    robot = tmp_path / "limited.urdf"
    text = URDF
    for limit in LIMITS:
        text = text.replace('effort="90" velocity', f'effort="{limit:g}"  velocity', 1)
    robot.write_text(text)
    model = load_robot(robot)
    recording, check, proposal = read_proposed(
        model, write(tmp_path / "log.csv", named(clean, **change(clean)), "%.12g")
    )
    assert check.ok
    # Counts of a small motion are coarse, which is true.
    assert {finding.code for finding in check.warnings} <= {"band_limited_by_noise"}
    for name, value in content.items():
        if isinstance(value, dict):
            assert value.items() <= proposal.content[name].items()
        else:
            np.testing.assert_allclose(proposal.content[name], value)
    np.testing.assert_allclose(recording.q, clean["q"], atol=1e-3)
    np.testing.assert_allclose(recording.tau, clean["tau"], atol=0.07)


def test_units_in_names_of_torque_columns(
    model: RobotModel, clean: dict[str, Array], tmp_path: Path
) -> None:
    columns = {
        name.replace("effort", "torque_kgcm"): x / (0.0980665 if "effort" in name else 1.0)
        for name, x in named(clean).items()
    }
    recording = read_recording(write(tmp_path / "kgcm.csv", columns), model=model)
    np.testing.assert_allclose(recording.tau, clean["tau"], atol=1e-6)
    shares = {name.replace("effort", "torque_permille"): x for name, x in named(clean).items()}
    path = write(tmp_path / "permille.csv", shares)
    with pytest.raises(RecordingError, match="are in permille, which does not say") as refused:
        read_recording(path, model=model)
    assert refused.value.cure is not None
    assert refused.value.cure.sheet == {"gains": [0.09, 0.09, 0.09]}


def test_currents_are_said_to_lack_gains(
    model: RobotModel, clean: dict[str, Array], tmp_path: Path
) -> None:
    counts = np.mod(np.round(250.0 * clean["tau"]), 65536.0)
    columns = {
        k.replace("effort", "present_current"): x for k, x in named(clean, tau=counts).items()
    }
    recording = read_recording(write(tmp_path / "raw.csv", columns), model=model)
    (error,) = check_recording(model, recording).errors
    assert error.code == "torque_scale"
    assert "currents without gains" in error.message
    assert "0.004 N m at" in error.message
