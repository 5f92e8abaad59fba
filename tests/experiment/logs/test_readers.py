"""One recording in every format, and what is said of files that are none."""

from __future__ import annotations

import gzip
import os
import warnings
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from scipy.io import savemat

from asbuilt.description import bundled_robot, load_robot
from asbuilt.errors import RecordingError, UsageError
from asbuilt.experiment import Recording, RecordingSheet, read_recording, read_recordings
from asbuilt.experiment.logs.long_recordings import stream_recording

UR10E_GAINS = [14.87, 13.26, 11.13, 10.62, 11.03, 11.47]
UR10E_SHEET = f"""
header = false
torque_source = "current"
gains = {UR10E_GAINS}
[columns]
time = 1
position = "2-7"
velocity = "8-13"
torque = "14-19"
"""


@pytest.fixture
def logged() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(5)
    t = np.arange(300) / 100
    q = np.sin(t[:, None] * np.array([1.0, 2.0, 3.0]))
    return {
        "t": t,
        "q": q,
        "qd": np.cos(t[:, None]) * np.array([1.0, 2.0, 3.0]),
        "tau": rng.normal(size=q.shape),
    }


def spread(logged: dict[str, np.ndarray]) -> pl.DataFrame:
    columns = {"t": logged["t"]}
    for name in ("q", "qd", "tau"):
        columns |= {f"{name}_{k}": logged[name][:, k] for k in range(3)}
    return pl.DataFrame(columns)


def assert_same(recording: Recording, logged: dict[str, np.ndarray], exactly: bool = True) -> None:
    for name in ("t", "q", "qd", "tau"):
        np.testing.assert_allclose(
            getattr(recording, name),
            logged[name],
            rtol=0 if exactly else 1e-12,
            atol=0 if exactly else 1e-12,
        )


def test_csv(tmp_path: Path, logged: dict) -> None:
    spread(logged).write_csv(tmp_path / "log.csv")
    assert_same(read_recording(tmp_path / "log.csv"), logged)


@pytest.mark.parametrize(
    ("clock", "rows"),
    [
        ("time_ms", ["0", "300", "600", "1000"]),
        ("stamp.sec,stamp.nanosec", ["100,0", "100,300000000", "100,600000000", "101,0"]),
    ],
)
def test_files_of_a_quantity_each_keep_the_unit_of_their_clock(
    tmp_path: Path, clock: str, rows: list[str]
) -> None:
    paths = [tmp_path / "run_positions.csv", tmp_path / "run_efforts.csv"]
    for path, symbol in zip(paths, ("q", "tau"), strict=True):
        lines = [f"{clock},{symbol}_1,{symbol}_2", *(f"{stamp},1,2" for stamp in rows)]
        path.write_text("\n".join(lines))
    recording = read_recording(paths)
    assert recording.joint_names == ("joint_1", "joint_2")
    np.testing.assert_allclose(recording.t - recording.t[0], [0.0, 0.3, 0.6, 1.0], atol=1e-12)


def test_a_second_of_uneven_stamps_keeps_them() -> None:
    """Seconds that all are the same are no clock of single precision: nanoseconds go on."""
    nanoseconds = np.cumsum([*[1e6] * 30, *[2e6] * 30])
    columns = {"stamp.sec": np.full(60, 7.0), "stamp.nanosec": nanoseconds}
    recording = read_recording({**columns, "q_1": np.arange(60.0), "tau_1": np.ones(60)})
    np.testing.assert_allclose(np.diff(recording.t), 1e-9 * np.diff(nanoseconds))
    assert not recording.notes


@pytest.mark.parametrize("begin", [0, 1_700_000_000])
@pytest.mark.parametrize(("unit", "digits"), [("ms", 3), ("us", 6)])
def test_clocks_of_files_are_compared_whatever_their_unit(
    tmp_path: Path, unit: str, digits: int, begin: int
) -> None:
    rows = range(100)
    seconds = [f"{begin + k // 100}.{k % 100:02},1" for k in rows]
    others = [f"{begin * 10**digits + k * 10 ** (digits - 2)},2" for k in rows]
    (tmp_path / "run_positions.csv").write_text("\n".join(["time,q_1", *seconds]))
    (tmp_path / "run_efforts.csv").write_text("\n".join([f"time_{unit},tau_1", *others]))
    recording = read_recording([tmp_path / "run_positions.csv", tmp_path / "run_efforts.csv"])
    assert recording.n_samples == len(rows)
    assert recording.duration == pytest.approx(0.99, abs=1e-6)


@pytest.mark.parametrize(
    ("angle", "torque"),
    [("shoulder_pos_deg", "shoulder_eff_mNm"), ("shoulder [deg]", "shoulder [mNm]")],
)
def test_files_of_a_quantity_each_keep_the_units_of_their_columns(
    tmp_path: Path, angle: str, torque: str
) -> None:
    (tmp_path / "run_positions.csv").write_text(f"t,{angle}\n0.0,90\n0.1,180\n")
    (tmp_path / "run_efforts.csv").write_text(f"t,{torque}\n0.0,1500\n0.1,2000\n")
    recording = read_recording([tmp_path / "run_positions.csv", tmp_path / "run_efforts.csv"])
    assert recording.joint_names == ("shoulder",)
    np.testing.assert_allclose(recording.q, [[np.pi / 2], [np.pi]])
    np.testing.assert_allclose(recording.tau, [[1.5], [2.0]])


def test_commands_without_a_unit_have_that_of_the_positions() -> None:
    q = np.array([[0.0], [90.0], [180.0]])
    log = {"t": [0.0, 0.1, 0.2], "q_deg": q, "q_command": q, "q_motor": q, "tau": 0.0 * q + 1.0}
    sheet = {"columns": {"motor_position": ["q_motor"]}}
    recording = read_recording(log, sheet=sheet)
    for values in (recording.q, recording.command, recording.extra["q_motor"]):
        np.testing.assert_allclose(values, np.deg2rad(q))
    assert any("command columns name no unit" in note for note in recording.notes)


def test_tabs_and_decimal_commas(tmp_path: Path) -> None:
    (tmp_path / "log.txt").write_text("t\tq_1\ttau_1\n0,0\t0,5\t1\n0,1\t0,25\t2,5\n")
    recording = read_recording(tmp_path / "log.txt")
    np.testing.assert_array_equal(recording.q, [[0.5], [0.25]])
    np.testing.assert_array_equal(recording.tau, [[1.0], [2.5]])


def test_semicolons_and_decimal_commas(tmp_path: Path, logged: dict) -> None:
    spread(logged).write_csv(tmp_path / "log.csv")
    text = (tmp_path / "log.csv").read_text().replace(",", ";").replace(".", ",")
    (tmp_path / "excel.csv").write_text(text)
    assert_same(read_recording(tmp_path / "excel.csv"), logged)


def test_blanks_under_a_commented_header(tmp_path: Path, logged: dict) -> None:
    frame = spread(logged)
    np.savetxt(tmp_path / "log.txt", frame.to_numpy(), header=" ".join(frame.columns))
    assert_same(read_recording(tmp_path / "log.txt"), logged, exactly=False)


def test_parquet(tmp_path: Path, logged: dict) -> None:
    spread(logged).write_parquet(tmp_path / "log.parquet")
    assert_same(read_recording(tmp_path / "log.parquet"), logged)


def test_matrices_in_npz_and_mat_whatever_their_orientation(tmp_path: Path, logged: dict) -> None:
    np.savez(
        tmp_path / "log.npz",
        time=logged["t"],
        positions=logged["q"],
        velocities=logged["qd"],
        torques=logged["tau"],
        comment="run 3",
    )
    assert_same(read_recording(tmp_path / "log.npz"), logged)
    savemat(
        tmp_path / "log.mat",
        {
            "t": logged["t"][None],
            "q": logged["q"].T,
            "data": {"dq": logged["qd"].T, "tau": logged["tau"].T},
        },
    )
    assert_same(read_recording(tmp_path / "log.mat"), logged)


def test_hdf5(tmp_path: Path, logged: dict) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "log.h5", "w") as file:
        group = file.create_group("robot")
        for name in ("t", "q", "qd", "tau"):
            group[name] = logged[name]
    assert_same(read_recording(tmp_path / "log.h5"), logged)


def test_hdf5_takes_no_values_from_other_files(tmp_path: Path, logged: dict) -> None:
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "log.h5"
    for tau, said in (
        (h5py.ExternalLink("/etc/passwd", "/tau"), "'tau' links to the file '/etc/passwd'"),
        (None, "'tau' takes its values from other files"),
    ):
        with h5py.File(path, "w") as file:
            file["t"] = logged["t"]
            file["q"] = logged["q"]
            if tau is not None:
                file["tau"] = tau
            else:
                file.create_dataset("tau", (9, 2), "f8", external=[("/etc/passwd", 0, 144)])
        with pytest.raises(RecordingError, match=f"{said}, which is refused; copy the values"):
            read_recording(path)


def test_values_that_no_joint_has_count_as_missing(tmp_path: Path) -> None:
    t = np.arange(300) / 100
    q = np.sin(t)
    tau = np.where(np.arange(300) == 100, 3.4e38, np.cos(t))
    columns = {"t": t, "q_1": q, "tau_1": tau}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read = read_recording(columns)
        assert np.flatnonzero(np.isnan(read.tau)).tolist() == [100]
        said = "values of tau_1 beyond 1e+12, such as 3.4e+38 in row 101, count as missing: 1"
        assert said in read.notes[-1]
        with pytest.raises(RecordingError, match="most values of q_1 are none of a joint"):
            read_recording(columns | {"q_1": 1e200 * q})


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_ros_bag_with_changing_joint_order(tmp_path: Path, logged: dict, storage: str) -> None:
    writer_module = pytest.importorskip("rosbags.rosbag2")
    from rosbags.rosbag2.enums import StoragePlugin
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    names = (
        store.types["sensor_msgs/msg/JointState"],
        store.types["std_msgs/msg/Header"],
        store.types["builtin_interfaces/msg/Time"],
    )
    state_type, header_type, time_type = names
    joints = np.array(["base", "elbow", "wrist"])
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    with writer_module.Writer(tmp_path / "bag", version=9, storage_plugin=plugin) as bag:
        connection = bag.add_connection(
            "/joint_states", "sensor_msgs/msg/JointState", typestore=store
        )
        for row in range(300):
            order = np.roll([0, 1, 2], row)
            stamp = time_type(sec=1_700_000_000 + row // 100, nanosec=(row % 100) * 10_000_000)
            values = [np.ascontiguousarray(logged[name][row, order]) for name in ("q", "qd", "tau")]
            message = state_type(header_type(stamp, ""), joints[order].tolist(), *values)
            bag.write(
                connection, row + 1, store.serialize_cdr(message, "sensor_msgs/msg/JointState")
            )
    for path in (
        tmp_path / "bag",
        next((tmp_path / "bag").glob("*.mcap" if storage == "mcap" else "*.db3")),
    ):
        recording = read_recording(path)
        order = [recording.joint_names.index(name) for name in joints]
        assert_same(
            recording.reordered([recording.joint_names[k] for k in order]), logged, exactly=False
        )


def test_files_of_one_quantity_each_in_shuffled_order(tmp_path: Path, logged: dict) -> None:
    order = {"positions": [2, 0, 1], "velocities": [0, 1, 2], "efforts": [1, 2, 0]}
    for (what, joints), name in zip(order.items(), ("q", "qd", "tau"), strict=True):
        pl.DataFrame(
            {"time": logged["t"]} | {f"arm_joint_{k}": logged[name][:, k] for k in joints}
        ).write_csv(tmp_path / f"run_{what}.csv")
    paths = [tmp_path / f"run_{what}.csv" for what in order]
    (recording,) = read_recordings(paths)
    assert_same(recording.reordered(["arm_joint_0", "arm_joint_1", "arm_joint_2"]), logged)
    assert_same(
        read_recording(paths).reordered(["arm_joint_0", "arm_joint_1", "arm_joint_2"]), logged
    )
    with pytest.raises(
        RecordingError,
        match=(r"holds the position only.*run_efforts.csv, run_velocities.csv lie next to it"),
    ):
        read_recording(paths[0])
    (tmp_path / "all.toml").write_text(
        '[files]\nposition = "run_positions.csv"\nvelocity = "run_velocities.csv"\ntorque ='
        ' "run_efforts.csv"'
    )
    assert_same(
        read_recording(tmp_path / "all.toml").reordered(
            ["arm_joint_0", "arm_joint_1", "arm_joint_2"]
        ),
        logged,
    )


def test_independent_recordings_stay_apart(tmp_path: Path, logged: dict) -> None:
    for name in ("run1.csv", "run2.csv"):
        spread(logged).write_csv(tmp_path / name)
    assert len(read_recordings([tmp_path / "run1.csv", tmp_path / "run2.csv"])) == 2
    with pytest.raises(RecordingError, match="2 files are 2 recordings, not one"):
        read_recording([tmp_path / "run1.csv", tmp_path / "run2.csv"])


def test_sheet_changes_units_sign_gains_and_windows(tmp_path: Path, logged: dict) -> None:
    frame = spread(logged).with_columns(
        pl.col("t") * 1e3, *[pl.col(f"q_{k}").degrees() for k in range(3)]
    )
    frame.write_csv(tmp_path / "log.csv")
    (tmp_path / "log.toml").write_text(
        'sign = -1\ngains = [2, 3, 4]\n[units]\ntime = "ms"\nposition = "deg"\n[[windows]]\nstart ='
        " 0.5\nstop = 1.0\n[[windows]]\nstart = 2.0"
    )
    recording = read_recording(tmp_path / "log.csv")
    keep = ((logged["t"] >= 0.5) & (logged["t"] < 1.0)) | (logged["t"] >= 2.0)
    np.testing.assert_allclose(recording.t, logged["t"][keep])
    np.testing.assert_allclose(recording.q, logged["q"][keep], atol=1e-14)
    np.testing.assert_allclose(recording.tau, -logged["tau"][keep] * [2, 3, 4])
    flipped = read_recording(
        tmp_path / "log.csv", flip_torque=True, gain=1.0, torque_source="motor"
    )
    np.testing.assert_allclose(flipped.tau, logged["tau"][keep])
    assert flipped.torque_source == "motor"


def test_external_torques_and_currents_are_kept_apart(tmp_path: Path) -> None:
    columns = [f"{name}{k}" for name in ("q", "tau", "tau_ext_", "current") for k in (1, 2)]
    pl.DataFrame(np.arange(80.0).reshape(10, 8), schema=columns).write_csv(tmp_path / "log.csv")
    recording = read_recording(tmp_path / "log.csv", rate=100)
    np.testing.assert_array_equal(recording.tau[0], [2, 3])
    np.testing.assert_array_equal(recording.extra["tau_ext"][0], [4, 5])
    np.testing.assert_array_equal(recording.extra["current"][0], [6, 7])
    pl.DataFrame(np.arange(40.0).reshape(10, 4), schema=["q1", "q2", "i_1", "i_2"]).write_csv(
        tmp_path / "amp.csv"
    )
    assert read_recording(tmp_path / "amp.csv", rate=100).torque_source == "current"


def test_blank_lines_units_below_the_header_and_byte_order_mark(
    tmp_path: Path, logged: dict
) -> None:
    spread(logged).write_csv(tmp_path / "log.csv")
    lines = (tmp_path / "log.csv").read_text().splitlines()
    units = "s,deg,deg,deg,deg/s,deg/s,deg/s,mN m,mN m,mN m"
    (tmp_path / "log.csv").write_text(
        "\ufeff" + "\r\n\r\n".join([lines[0], units, *lines[1:]]), encoding="utf-8"
    )
    recording = read_recording(tmp_path / "log.csv")
    np.testing.assert_array_equal(recording.t, logged["t"])
    np.testing.assert_allclose(recording.q, np.radians(logged["q"]), atol=1e-15)
    np.testing.assert_allclose(recording.tau, logged["tau"] / 1000, atol=1e-15)


def test_whole_recordings_named_after_a_quantity_stay_apart(tmp_path: Path, logged: dict) -> None:
    paths = [tmp_path / "position_control.csv", tmp_path / "torque_control.csv"]
    for path in paths:
        spread(logged).write_csv(path)
    for recording in read_recordings(paths):
        assert_same(recording, logged)


def test_what_is_logged_beside_is_kept_under_its_own_name(tmp_path: Path) -> None:
    t = np.arange(50) * 0.01
    names = (
        "q",
        "qd",
        "tau",
        "motor_torque",
        "external_torque",
        "torque_sensor",
        "current",
        "position_sensor",
        "temperature",
    )
    columns = {
        f"{name}_{k}": 10.0 * i + np.sin(t + k) for i, name in enumerate(names) for k in (1, 2)
    }
    pl.DataFrame({"t": t} | columns).write_csv(tmp_path / "log.csv")
    recording = read_recording(tmp_path / "log.csv")
    np.testing.assert_array_equal(recording.tau[:, 1], columns["tau_2"])
    expected = {
        "tau_motor": "motor_torque",
        "tau_ext": "external_torque",
        "tau_sensor": "torque_sensor",
        "current": "current",
    }
    expected |= {"position_sensor": "position_sensor"}
    assert set(recording.extra) == set(expected)
    for name, column in expected.items():
        np.testing.assert_array_equal(recording.extra[name][:, 0], columns[f"{column}_1"])


BAD = {
    "empty.csv": ("", "is not a recording: it is empty"),
    "page.csv": ("<!DOCTYPE html><html>", "is not a recording: it starts with '<!DOCTYPE"),
    "head.csv": ("t,q1,tau1\n", "has a header (t, q1, tau1) but no data"),
    "words.csv": ("a,b\nx,y\n", "line 2 holds no number"),
    "cell.csv": ("t,q1,tau1\n0,1,2\n0.1,oops,2\n", "line 3, column 'q1': 'oops' is not a number"),
    "long.csv": ("t,q1,tau1\n0,1,2\n0.1,1,2,3\n", "line 3: 4 fields where 3 columns are expected"),
    "twice.csv": ("t,q1,q1,tau1\n0,1,2,3\n", "column name 'q1' appears 2 times (columns 2, 3)"),
    "gone.csv": (
        "t,q1,q3,tau1,tau3\n0,1,2,3,4\n",
        "the position column of joint number 2 is missing; there are q1, q3",
    ),
    "other.csv": (
        "t,x,y\n0,1,2\n",
        "has no columns for joint positions and joint torques. Its columns are: t, x, y",
    ),
    "notau.csv": ("t,q1\n0,1\n", "has no columns for joint torques"),
    "norate.csv": ("q1,tau1\n0,1\n", "no time column and no rate is given"),
    "bare.csv": (
        "0,1,2\n0.1,1,2\n",
        "has 3 columns without a header row; name them in a recording sheet bare.toml",
    ),
    "fake.npz": ("PK nonsense", "it cannot be read as an .npz archive of NumPy"),
    "fake.mat": ("nonsense", "cannot be read as a MATLAB file"),
    "fake.parquet": ("nonsense", "cannot be read as Parquet"),
    "fake.h5": ("nonsense", "cannot be read as HDF5"),
    "fake.db3": ("nonsense", "cannot be read as a ROS 2 bag"),
    "fake.mcap": ("nonsense", "cannot be read as MCAP"),
    "comma.csv": (
        "t,q1,tau1\n0,0,1,5,2,5\n",
        "line 2: 6 fields where 3 columns are expected; export decimal points, or semicolons",
    ),
    "preamble.csv": (
        "Robot: R\nDate: D\n\nt,q1,tau1\n0,1,2\n",
        "remove the lines above the header",
    ),
    "old.csv": ("t,q1,tau1\r0,1,2\r1,1,2\r", "its lines end in a carriage return alone"),
    "wide.csv": ("\ufefft\0,\0", "it holds binary data"),
    "log.csv.gz": ("nonsense", "unpack it first"),
    "log.xlsx": ("nonsense", "export the sheet as CSV"),
    "notes.docx": ("nonsense", "known are .bag, .csv, .dat, .db3, .h5"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_recording_is_refused_with_place_and_cure(tmp_path: Path, name: str) -> None:
    text, message = BAD[name]
    (tmp_path / name).write_text(text)
    with pytest.raises(RecordingError) as caught:
        read_recording(tmp_path / name)
    assert message in str(caught.value)
    assert str(tmp_path / name) in str(caught.value)


def test_binary_pickles_and_missing_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "image.csv").write_bytes(b"\x89PNG\r\n\x1a\n\x00\x00")
    np.savez(tmp_path / "objects.npz", q=np.array([{"a": 1}], dtype=object))
    np.savez(tmp_path / "uneven.npz", t=np.arange(9.0), q=np.ones((8, 2)), tau=np.ones((9, 2)))
    pl.DataFrame({"t": [0.0, 1.0], "q": [[0.0, 1.0]] * 2, "tau": [[0.0, 1.0]] * 2}).write_parquet(
        tmp_path / "lists.parquet"
    )
    (tmp_path / "wide.csv").write_text("t,q1,tau1\n0,1,2\n", encoding="utf-16")
    (tmp_path / "packed.csv").write_bytes(gzip.compress(b"t,q1,tau1\n0,1,2\n"))
    (tmp_path / "book.csv").write_bytes(b"PK\x03\x04 and so on")
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe.csv")
    for name, message in (
        ("image.csv", "holds binary data"),
        ("objects.npz", r"pickled objects \(q\), which are not read for safety"),
        (
            "uneven.npz",
            (
                r"no columns for joint positions.*variables without the common length 9 were left"
                r" out: q \(8, 2\)"
            ),
        ),
        ("lists.parquet", "columns that hold no numbers: q, tau"),
        ("wide.csv", "UTF-16 text; save it as UTF-8"),
        ("packed.csv", "a gzip archive; unpack it"),
        ("book.csv", "a ZIP archive or a spreadsheet"),
        ("folder", "is no ROS bag.*give the file of a recording"),
        ("pipe.csv", "not a regular file"),
    ):
        with pytest.raises(RecordingError, match=message):
            read_recording(tmp_path / name)
    with pytest.raises(RecordingError, match="does not exist"):
        read_recording(tmp_path / "nothing.csv")


@pytest.mark.parametrize("name", ["log.csv", "log.parquet", "log.npz", "log.mat", "bag"])
def test_what_may_not_be_read_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    place = tmp_path / name
    place.mkdir() if name == "bag" else place.write_text("x")

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "iterdir" if name == "bag" else "open", refuse)
    for read in (
        lambda: read_recording(place),
        lambda: read_recordings([place]),
        lambda: list(stream_recording(place)),
    ):
        with pytest.raises(RecordingError, match=f"{name} cannot be read: Permission denied"):
            read()


def test_wrong_robot_and_wrong_rate(tmp_path: Path, logged: dict) -> None:
    spread(logged).drop("t").write_csv(tmp_path / "log.csv")
    with pytest.raises(
        RecordingError, match=r"has 3 position columns \(q_0 ... q_2\) but ur10e has 6 joints"
    ):
        read_recording(tmp_path / "log.csv", model=bundled_robot("ur10e"), rate=100)
    for rate in (-1, 0, float("nan"), float("inf")):
        with pytest.raises(UsageError, match=f"rate is {rate}; it must be a number from"):
            read_recording(tmp_path / "log.csv", rate=rate)
    with pytest.raises(RecordingError, match="2 gains for 3 joints"):
        read_recording(tmp_path / "log.csv", rate=100, gain=[1, 2])


def test_sheet_columns_that_are_not_there(tmp_path: Path, logged: dict) -> None:
    spread(logged).write_csv(tmp_path / "log.csv")
    for columns, message in (
        ({"position": ["x"]}, "gives column 'x' for position, which the log does not have"),
        ({"position": [99]}, "columns run from 1 to 10"),
    ):
        with pytest.raises(RecordingError, match=message):
            read_recording(
                tmp_path / "log.csv", sheet=RecordingSheet.model_validate({"columns": columns})
            )


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".npz"])
@pytest.mark.parametrize("with_time", [True, False])
def test_stream_is_the_whole_in_stretches(
    tmp_path: Path, logged: dict, suffix: str, with_time: bool
) -> None:
    frame = spread(logged) if with_time else spread(logged).drop("t")
    path = tmp_path / f"log{suffix}"
    if suffix == ".npz":
        np.savez(path, **{name: frame[name].to_numpy() for name in frame.columns})
    else:
        getattr(frame, f"write_{suffix[1:]}")(path)
    rate = None if with_time else 100.0
    whole = read_recording(path, rate=rate, flip_torque=True)
    stretches = list(stream_recording(path, rate=rate, flip_torque=True, chunk_samples=70))
    assert [part.n_samples for part in stretches] == [70, 70, 70, 70, 20]
    for name in ("t", "q", "qd", "tau"):
        joined = np.concatenate([getattr(part, name) for part in stretches])
        np.testing.assert_array_equal(joined, getattr(whole, name))


@pytest.mark.parametrize("separator", [",", " "])
def test_a_cut_last_line_is_left_out(tmp_path: Path, logged: dict, separator: str) -> None:
    frame = spread(logged)
    path = tmp_path / "log.csv"
    text = frame.write_csv(separator=separator)
    path.write_text("# recorder\n" + (text if separator == "," else f"#{text}")[:-30])
    recording = read_recording(path)
    assert_same(recording, {name: values[:-1] for name, values in logged.items()})
    assert any("last line is cut" in note for note in recording.notes)
    if separator == ",":
        parts = list(stream_recording(path, chunk_samples=299))
        assert [part.n_samples for part in parts] == [299]


def test_a_whole_last_line_without_an_end_is_kept(tmp_path: Path, logged: dict) -> None:
    (tmp_path / "log.csv").write_text(spread(logged).write_csv().rstrip())
    assert_same(read_recording(tmp_path / "log.csv"), logged)


def test_stream_keeps_windows_of_the_sheet(tmp_path: Path, logged: dict) -> None:
    spread(logged).write_csv(tmp_path / "log.csv")
    (tmp_path / "log.toml").write_text("[[windows]]\nstart = 0.95\nstop = 1.55")
    whole = read_recording(tmp_path / "log.csv")
    joined = np.concatenate(
        [part.t for part in stream_recording(tmp_path / "log.csv", chunk_samples=50)]
    )
    np.testing.assert_array_equal(joined, whole.t)


def test_real_recordings(shared: Path, tmp_path: Path) -> None:
    data, models = shared / "data", shared / "models"
    med7 = load_robot(models / "lbrstack_med7.urdf")
    slow = read_recording(
        data / "lbr_med7" / "measurements_with_ext_tau_1_dgr.csv", model=med7, rate=100
    )
    assert slow.q.shape == slow.extra["tau_ext"].shape == (10007, 7)
    assert slow.joint_names == med7.joint_names
    (states,) = read_recordings(sorted((data / "lbr_med7").glob("joint_states_*.csv")), model=med7)
    assert states.q.shape == (12048, 7)
    raw = pl.read_csv(data / "lbr_med7" / "joint_states_positions.csv")
    np.testing.assert_array_equal(
        states.q, raw.select([f"lbr_joint_{k}" for k in range(7)]).to_numpy()
    )
    assert any("lbr_joint_0 -> lbr_A1" in note for note in states.notes)

    lwr = read_recording(
        data / "kuka_lwr4" / "measurements_1.npz", model=load_robot(models / "kuka_lwr4.urdf")
    )
    assert lwr.q.shape == (5027, 7)
    assert lwr.qd is not None
    assert lwr.qdd is not None

    bag = read_recording(
        data / "ur10_rosbag2" / "ur10_exciting_trajectory.db3",
        model=load_robot(models / "ur10.urdf"),
    )
    assert bag.q.shape == (3441, 6)
    assert bag.rate == pytest.approx(125)

    ur10e = load_robot(models / "ur10e.urdf")
    log = data / "ur10e" / "ur-20_02_10-30sec_12harm.csv"
    with pytest.raises(
        RecordingError, match=r'time = 1\nposition = "2-7"\nvelocity = "8-13"\ntorque = "14-19"'
    ):
        read_recording(log, model=ur10e)
    (tmp_path / "ur10e.toml").write_text(UR10E_SHEET)
    run = read_recording(log, model=ur10e, sheet=tmp_path / "ur10e.toml")
    table = np.loadtxt(log, delimiter=",")
    np.testing.assert_allclose(run.tau, table[:, 13:19] * UR10E_GAINS, rtol=1e-12)
    np.testing.assert_array_equal(run.t, table[:, 0])
