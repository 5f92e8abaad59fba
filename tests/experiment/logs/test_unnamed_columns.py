"""Columns without usable names: drafts of sheets by the values, numbers, dates, units."""

from __future__ import annotations

import tomllib
from itertools import permutations
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from asbuilt.description import bundled_robot
from asbuilt.dynamics import inverse_dynamics
from asbuilt.errors import RecordingError
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Recording, read_recording
from asbuilt.experiment.logs.long_recordings import stream_recording

MODEL = bundled_robot("ur10e")
NAMES = {"position": "q", "velocity": "v", "torque": "f"}


@pytest.fixture(scope="module")
def values() -> dict[str, np.ndarray]:
    motion = random_fourier(MODEL, 2, duration=20.0).sample(50.0)
    tau = inverse_dynamics(MODEL, motion.q, motion.qd, motion.qdd)
    friction = 5.0 * np.sign(motion.qd)
    return {"position": motion.q, "velocity": motion.qd, "torque": 0.1 * (tau + friction)}


@pytest.mark.parametrize("order", [*permutations(NAMES), ("torque", "position")])
@pytest.mark.parametrize("header", [False, True])
def test_groups_in_any_order(
    tmp_path: Path, values: dict[str, np.ndarray], order: tuple[str, ...], header: bool
) -> None:
    table = np.column_stack([values[each] for each in order])
    names = ",".join(f"{NAMES[each]}x{k}" for each in order for k in range(6)) if header else ""
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header=names, comments="")
    with pytest.raises(RecordingError) as caught:
        read_recording(tmp_path / "log.csv", model=MODEL, rate=50.0)
    text = [part for part in str(caught.value).split("\n\n") if "[columns]" in part][-1]
    sheet = tomllib.loads(text)
    assert sheet["rate"] == 50.0
    assert sheet.get("header", True) == header
    for k, each in enumerate(order):
        assert sheet["columns"][each] == f"{6 * k + 1}-{6 * k + 6}"


def _draft(path: Path, **options: float) -> dict[str, object]:
    with pytest.raises(RecordingError) as caught:
        read_recording(path, model=MODEL, **options)
    return tomllib.loads(_draft_text(caught.value))


def _draft_text(error: RecordingError) -> str:
    return [part for part in str(error).split("\n\n") if "[columns]" in part][-1]


@pytest.mark.parametrize("clock", ["ms", "us", "ns"])
@pytest.mark.parametrize("speed", ["rad/s", "deg/s"])
def test_drafts_have_units(
    tmp_path: Path, values: dict[str, np.ndarray], clock: str, speed: str
) -> None:
    t = np.arange(1001) * 20 * {"ms": 1.0, "us": 1e3, "ns": 1e6}[clock]
    v = np.degrees(values["velocity"]) if speed == "deg/s" else values["velocity"]
    table = np.column_stack([t, np.degrees(values["position"]), v, values["torque"]])
    log = tmp_path / "log.csv"
    np.savetxt(log, table, delimiter=",")
    with pytest.raises(RecordingError) as caught:
        read_recording(log, model=MODEL)
    (tmp_path / "log.toml").write_text(_draft_text(caught.value))
    recording = read_recording(log, model=MODEL)
    assert recording.rate == pytest.approx(50.0)
    np.testing.assert_allclose(recording.q, values["position"], atol=1e-12)
    if speed == "deg/s":
        np.testing.assert_allclose(recording.qd, values["velocity"], atol=1e-12)


def _with_text(table: np.ndarray, texts: dict[int, list[str]]) -> list[str]:
    """Return the lines of a table with columns of text put at the given places, from 0."""
    cells = [[repr(float(each)) for each in row] for row in table]
    for place, column in sorted(texts.items()):
        for row, text in zip(cells, column, strict=True):
            row.insert(place, text)
    return [",".join(row) for row in cells]


def test_columns_of_text_and_a_counter_beside_the_time(
    tmp_path: Path, values: dict[str, np.ndarray]
) -> None:
    t = np.arange(1001) * 0.02
    table = np.column_stack([np.arange(1001), t, values["position"], values["torque"]])
    lines = _with_text(table, {0: ["run"] * 1001, 6: ["auto"] * 1001})
    log = tmp_path / "log.csv"
    log.write_text("\n".join(lines))
    sheet = _draft(log)
    assert sheet["columns"] == {
        "time": 3,
        "position": ["4-6", "8-10"],
        "torque": "11-16",
    }
    recording = read_recording(log, model=MODEL, sheet=sheet)
    np.testing.assert_array_equal(recording.q, values["position"])
    np.testing.assert_array_equal(recording.t, t)
    chunks = list(stream_recording(log, model=MODEL, sheet=sheet, chunk_samples=300))
    np.testing.assert_array_equal(np.concatenate([c.q for c in chunks]), values["position"])
    with pytest.raises(ValueError, match="runs backwards"):
        read_recording(log, sheet={"columns": {"position": "10-5"}})
    with pytest.raises(RecordingError, match=r"column 7 .* holds text"):
        read_recording(log, sheet={"header": False, "columns": {"position": "5-10"}})


def test_numbers_count_the_columns_of_text_in_parquet(
    tmp_path: Path, values: dict[str, np.ndarray]
) -> None:
    columns = {"who": ["a"] * 1001, "t": np.arange(1001) * 0.02}
    columns |= {f"x{k}": values["position"][:, k] for k in range(6)}
    columns |= {"mode": ["b"] * 1001} | {f"y{k}": values["torque"][:, k] for k in range(6)}
    log = tmp_path / "log.parquet"
    pl.DataFrame(columns).write_parquet(log)
    sheet = _draft(log)
    assert sheet["columns"] == {"time": 2, "position": "3-8", "torque": "10-15"}
    whole = read_recording(log, model=MODEL, sheet=sheet)
    np.testing.assert_array_equal(whole.tau, values["torque"])
    chunks = list(stream_recording(log, model=MODEL, sheet=sheet, chunk_samples=300))
    np.testing.assert_array_equal(np.concatenate([c.tau for c in chunks]), values["torque"])


def test_repeated_names_do_not_matter_to_numbers(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("time,A1,A2,A1,A2\n0,1,2,3,4\n0.1,5,6,7,8\n")
    with pytest.raises(RecordingError, match="number all columns in a recording sheet"):
        read_recording(log)
    sheet = {"columns": {"time": 1, "position": "2-3", "torque": "4-5"}}
    np.testing.assert_array_equal(read_recording(log, sheet=sheet).tau, [[3, 4], [7, 8]])


def _streamed(log: Path) -> Recording:
    (chunk,) = stream_recording(log)
    return chunk


@pytest.mark.parametrize("read", [read_recording, _streamed])
@pytest.mark.parametrize(
    "stamps",
    [
        ["2026-03-01T12:00:00.990000", "2026-03-01T12:00:01", "2026-03-01T12:00:01.010000"],
        ["2026-03-01T12:00:00.99Z", "2026-03-01T12:00:01.00Z", "2026-03-01T12:00:01.01Z"],
        ["12:00:00.99", "12:00:01", "12:00:01.01"],
    ],
)
def test_dates_and_times_of_day_are_times(tmp_path: Path, stamps: list[str], read: object) -> None:
    log = tmp_path / "log.csv"
    log.write_text("time,q_1,tau_1\n" + "".join(f"{stamp},1,2\n" for stamp in stamps))
    recording = read(log)  # type: ignore[operator]
    np.testing.assert_allclose(np.diff(recording.t), 0.01, atol=3e-7)
    if stamps[0].startswith("2026"):
        assert recording.started == pytest.approx(1772366400.99, abs=1e-6)


@pytest.mark.parametrize("read", [read_recording, _streamed])
@pytest.mark.parametrize(
    "names", ["header.stamp.sec,header.stamp.nanosec", "nsecs,secs", "stamp_sec,stamp_nanosec,%"]
)
def test_seconds_and_nanoseconds_are_one_time(tmp_path: Path, names: str, read: object) -> None:
    log = tmp_path / "log.csv"
    stamps = [(1772366400, 990000000), (1772366401, 0), (1772366401, 10000000)]
    rest = ",7" if names.endswith("%") else ""
    if names.startswith("n"):
        stamps = [(b, a) for a, b in stamps]
    log.write_text(f"{names},q_1,tau_1\n" + "".join(f"{a},{b}{rest},1,2\n" for a, b in stamps))
    recording = read(log)  # type: ignore[operator]
    np.testing.assert_allclose(np.diff(recording.t), 0.01, atol=1e-9)


def test_a_damaged_date_is_named(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("time,q_1,tau_1\n2026-03-01T12:00:00,1,2\n2026-03-99T12:00:01,1,2\n")
    with pytest.raises(RecordingError, match=r"line 3, column 'time': .* is not a date or time"):
        read_recording(log)


def test_a_first_line_with_text_like_the_others_is_no_header(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("run,0.0,1,5\nrun,0.1,2,6\nrun,0.2,3,7\n")
    sheet = {"columns": {"time": 2, "position": 3, "torque": 4}}
    np.testing.assert_array_equal(read_recording(log, sheet=sheet).q[:, 0], [1, 2, 3])
    log.write_text("t,1,2\n0.0,1,5\n0.1,2,6\n")
    sheet = {"columns": {"time": 1, "position": 2, "torque": 3}}
    np.testing.assert_array_equal(read_recording(log, sheet=sheet).tau[:, 0], [5, 6])


@pytest.mark.parametrize(
    ("header", "factor", "source"),
    [
        ("IPOC,AIPos.A1,AIPos.A2,MACur.A1,MACur.A2", np.pi / 180, "current"),
        ("Zeit [ms],A1 [deg],A2 [deg],A1 [Nm],A2 [Nm]", np.pi / 180, "unknown"),
        ("tiempo_ms,rob1_joint_1_deg,rob1_joint_2_deg,eff_1,eff_2", np.pi / 180, "unknown"),
        ("temps [ms],joint1_pos,joint2_pos,joint1_eff,joint2_eff", 1.0, "unknown"),
        ("stamp_ms,Winkel_1,Winkel_2,Strom_1,Strom_2", 1.0, "current"),
        ("x (ms),J1 [rad],J2 [rad],J1 [A],J2 [A]", 1.0, "current"),
    ],
)
def test_names_of_controllers_and_units(
    tmp_path: Path, header: str, factor: float, source: str
) -> None:
    log = tmp_path / "log.csv"
    log.write_text(f"{header}\n4,10,20,3,4\n8,11,21,3,4\n12,12,22,3,4\n")
    recording = read_recording(log)
    np.testing.assert_allclose(recording.t, [0.004, 0.008, 0.012])
    np.testing.assert_allclose(recording.q, factor * np.array([[10, 20], [11, 21], [12, 22]]))
    np.testing.assert_array_equal(recording.tau, np.tile([3, 4], (3, 1)))
    assert recording.torque_source == source


def test_setpoints_of_the_sensor_interface_are_commands(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("IPOC,ASPos.A1,AIPos.A1,MACur.A1\n4,10,9,1\n8,11,10,1\n")
    recording = read_recording(log)
    assert recording.command is not None
    np.testing.assert_allclose(np.degrees(recording.command[:, 0]), [10, 11])
    np.testing.assert_allclose(np.degrees(recording.q[:, 0]), [9, 10])


@pytest.mark.parametrize("name", ["torque_percent_{}", "torque_{} [%]", "current_{}_pct"])
@pytest.mark.parametrize(
    "read", [read_recording, lambda log, **o: next(stream_recording(log, **o))]
)
def test_percent_of_an_unknown_torque_asks_for_gains(
    tmp_path: Path, name: str, read: object
) -> None:
    log = tmp_path / "log.csv"
    names = ",".join(name.format(k) for k in (1, 2))
    log.write_text(f"t,q_1,q_2,{names}\n0,1,2,30,40\n0.1,1,2,30,40\n")
    with pytest.raises(RecordingError, match="does not say how many N m"):
        read(log)  # type: ignore[operator]
    recording = read(log, gain=[0.5, 2.0])  # type: ignore[operator]
    np.testing.assert_array_equal(recording.tau[0], [15.0, 80.0])


def test_newton_metres_go_before_percent(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("t,q_1,torque_1,torque_1 [%]\n0,1,2,30\n0.1,1,2,30\n")
    assert read_recording(log).tau[0, 0] == 2.0


@pytest.mark.parametrize("first", ["position", "command"])
@pytest.mark.parametrize("velocity", [True, False])
def test_a_group_that_another_follows_is_its_command(
    tmp_path: Path, values: dict[str, np.ndarray], first: str, velocity: bool
) -> None:
    groups = {"position": values["position"][:-2], "command": values["position"][2:]}
    order = ["position", "command"] if first == "position" else ["command", "position"]
    if velocity:
        groups["velocity"] = values["velocity"][:-2]
        order.append("velocity")
    path = tmp_path / "log.csv"
    np.savetxt(path, np.column_stack([groups[each] for each in order]), delimiter=",")
    sheet = _draft(path, rate=50.0)
    for k, each in enumerate(order):
        assert sheet["columns"][each] == f"{6 * k + 1}-{6 * k + 6}"
    assert "torque" not in sheet["columns"]


@pytest.mark.parametrize("unit", [1.0, 180.0 / np.pi])
def test_velocities_give_the_rate_of_a_log_without_times(
    tmp_path: Path, values: dict[str, np.ndarray], unit: float
) -> None:
    table = np.column_stack([values["position"], unit * values["velocity"], values["torque"]])
    np.savetxt(tmp_path / "log.csv", table, delimiter=",")
    sheet = _draft(tmp_path / "log.csv")
    assert sheet["rate"] == pytest.approx(50.0, rel=0.01)
    assert sheet.get("units", {}) == ({"velocity": "deg/s"} if unit > 1.0 else {})


@pytest.mark.parametrize("where", ["first", "last", "set back", "named"])
def test_time_is_found_wherever_it_is(
    tmp_path: Path, values: dict[str, np.ndarray], where: str
) -> None:
    t = np.arange(len(values["position"])) / 50.0
    if where == "set back":
        t[300:] -= 0.05
    parts = [t[:, None], values["position"], values["torque"]]
    table = np.hstack(parts[1:] + parts[:1] if where == "last" else parts)
    header = ",".join(f"c{k}" for k in range(13)) if where == "named" else ""
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header=header, comments="")
    sheet = _draft(tmp_path / "log.csv")
    assert sheet["columns"]["time"] == (13 if where == "last" else 1)
    assert "rate" not in sheet


def test_a_stream_without_a_header_row_has_the_draft_of_a_sheet_too(
    tmp_path: Path, values: dict[str, np.ndarray]
) -> None:
    path = tmp_path / "log.csv"
    np.savetxt(path, np.column_stack([values[each] for each in NAMES]), delimiter=",")
    with pytest.raises(RecordingError, match="18 columns without a header row") as caught:
        next(stream_recording(path, model=MODEL, rate=50.0))
    sheet = tomllib.loads(_draft_text(caught.value))
    assert sheet["columns"] == {"position": "1-6", "velocity": "7-12", "torque": "13-18"}
    path.write_text("0,1,2,3,4\n")
    with pytest.raises(RecordingError, match="5 columns without a header row"):
        read_recording(path, model=MODEL)
