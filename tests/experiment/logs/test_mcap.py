"""MCAP files with messages in JSON, written here by the specification (mcap.dev/spec)."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from asbuilt.errors import RecordingError
from asbuilt.experiment import RecordingSheet, read_recording
from asbuilt.experiment.logs.formats.mcap import read_mcap
from studied_cases import first_of

pytest.importorskip("mcap")

MAGIC = b"\x89MCAP0\r\n"
N = 200
T = np.arange(N) * 0.01
Q = np.column_stack([np.sin(3 * T), np.cos(2 * T)])
QD = np.column_stack([3 * np.cos(3 * T), -2 * np.sin(2 * T)])
TAU = np.column_stack([5 * Q[:, 0], 2 * Q[:, 1]])
NAMES = ["shoulder", "elbow"]


def text(value: str) -> bytes:
    return struct.pack("<I", len(value.encode())) + value.encode()


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def channel(number: int, topic: str, encoding: str = "json", schema: str = "State") -> bytes:
    described = struct.pack("<H", number) + text(schema) + text("jsonschema") + text("{}")
    return record(3, described) + record(
        4, struct.pack("<HH", number, number) + text(topic) + text(encoding) + struct.pack("<I", 0)
    )


def message(number: int, row: int, content) -> bytes:
    stamp = 1_700_000_000_000_000_000 + round(T[row] * 1e9)
    head = struct.pack("<HIQQ", number, row, stamp, stamp)
    return record(5, head + json.dumps(content).encode())


def chunk(records: bytes, kind: str) -> bytes:
    if kind == "lz4":
        packed = pytest.importorskip("lz4.frame").compress(records)
    elif kind == "zstd":
        packed = pytest.importorskip("backports.zstd").compress(records)
    else:
        packed = records
    head = struct.pack("<QQQI", 0, 1, len(records), 0) + text(kind)
    return record(6, head + struct.pack("<Q", len(packed)) + packed)


def written(path: Path, body: bytes, *, whole: bool = True) -> Path:
    head = MAGIC + record(1, text("") + text("a test"))
    tail = record(15, struct.pack("<I", 0)) + record(2, struct.pack("<QQI", 0, 0, 0)) + MAGIC
    path.write_bytes(head + body + (tail if whole else b""))
    return path


def joint_state(row: int) -> dict:
    order = [0, 1] if row % 2 else [1, 0]
    nanoseconds = round(T[row] * 1e9)
    return {
        "header": {"stamp": {"sec": 100 + nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}},
        "name": [NAMES[k] for k in order],
        "position": Q[row, order].tolist(),
        "velocity": QD[row, order].tolist(),
        "effort": TAU[row, order].tolist(),
    }


def listed_joints(row: int) -> dict:
    return {
        "timestamp": {"sec": 100, "nsec": round(T[row] * 1e9)},
        "joints": [
            {"name": NAMES[k], "position": Q[row, k], "velocity": QD[row, k], "effort": TAU[row, k]}
            for k in (0, 1)
        ],
    }


def same(recording, *, velocities: bool = True) -> None:
    np.testing.assert_allclose(recording.t - recording.t[0], T, atol=1e-8)
    order = [recording.joint_names.index(name) for name in NAMES]
    np.testing.assert_array_equal(recording.q[:, order], Q)
    np.testing.assert_array_equal(recording.tau[:, order], TAU)
    assert velocities == (recording.qd is not None)


@pytest.mark.parametrize("kind", ["", "lz4", "zstd", "no chunk"])
@pytest.mark.parametrize("state", [joint_state, listed_joints])
def test_joint_states_in_json_are_read(tmp_path: Path, state, kind: str) -> None:
    body = channel(1, "/joint_states") + b"".join(message(1, k, state(k)) for k in range(N))
    body = body if kind == "no chunk" else chunk(body, kind)
    same(read_recording(written(tmp_path / "log.mcap", body)))


def test_numbers_and_lists_become_columns_with_names_that_are_recognised(tmp_path: Path) -> None:
    rows = [{"q": Q[k].tolist(), "tau": TAU[k].tolist(), "mode": "run"} for k in range(N)]
    rows[7] = {"q": [1.0], "mode": "restart"}
    body = channel(1, "/robot") + b"".join(message(1, k, row) for k, row in enumerate(rows))
    recording = read_recording(written(tmp_path / "log.mcap", body))
    kept = np.arange(N) != 7
    np.testing.assert_array_equal(recording.q, Q[kept])
    np.testing.assert_array_equal(recording.tau, TAU[kept])
    np.testing.assert_allclose(recording.t - recording.t[0], T[kept], atol=1e-8)
    assert any("1 of 200 messages have other fields" in note for note in recording.notes)


def test_a_topic_is_chosen_in_the_sheet_where_several_have_messages(tmp_path: Path) -> None:
    body = channel(1, "/a") + channel(2, "/b")
    for k in range(N):
        body += message(1, k, {"battery": 1.0 + k})
        body += message(2, k, {"q": Q[k].tolist(), "tau": TAU[k].tolist()})
    path = written(tmp_path / "log.mcap", body)
    with pytest.raises(RecordingError, match=r"2 topics \(/a, /b\)"):
        read_recording(path)
    (tmp_path / "log.mcap.toml").write_text('topic = "/b"\n')
    np.testing.assert_array_equal(read_recording(path).q, Q)


def test_commands_in_json_on_a_topic_of_their_own(tmp_path: Path) -> None:
    body = channel(1, "/joint_states") + channel(2, "/arm/command")
    for k in range(N):
        body += message(1, k, {"name": NAMES, "position": Q[k].tolist()})
        body += message(2, k, {"name": NAMES[::-1], "position": (Q[k, ::-1] + 1.0).tolist()})
    recording = read_recording(written(tmp_path / "log.mcap", body), kp=1.0)
    np.testing.assert_array_equal(recording.command, Q + 1.0)
    path = written(tmp_path / "log.mcap", body.replace(b"/arm/command", b"/arm/leaders"))
    with pytest.raises(RecordingError, match="command_topic"):
        read_recording(path)
    recording = read_recording(path, sheet={"command_topic": "/arm/leaders"}, kp=1.0)
    np.testing.assert_array_equal(recording.command, Q + 1.0)


def test_commands_in_json_of_the_kinds_that_ros_has(tmp_path: Path) -> None:
    numbers = channel(1, "/joint_states") + channel(2, "/arm/commands")
    trajectories = channel(1, "/joint_states") + channel(2, "/arm/joint_trajectory")
    for k in range(N):
        state = message(1, k, {"name": NAMES, "position": Q[k].tolist()})
        ahead = (Q[k, ::-1] + 1.0).tolist()
        numbers += message(2, k, {"layout": {}, "data": ahead}) + state
        point = {"positions": ahead, "time_from_start": {"sec": 0, "nsec": 0}}
        trajectories += message(2, k, {"joint_names": NAMES[::-1], "points": [point]}) + state
    path = written(tmp_path / "log.mcap", trajectories)
    np.testing.assert_array_equal(read_recording(path, kp=1.0).command, Q + 1.0)
    path = written(tmp_path / "log.mcap", numbers)
    recording = read_recording(path, sheet={"command_joints": NAMES[::-1]}, kp=1.0)
    np.testing.assert_array_equal(recording.command, Q + 1.0)
    with pytest.raises(RecordingError, match="2 numbers without the names"):
        read_mcap(path, RecordingSheet())


def test_a_file_that_was_cut_off_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    body = channel(1, "/joint_states")
    body += b"".join(message(1, k, joint_state(k)) for k in range(N))
    path = written(tmp_path / "log.mcap", body[:-20], whole=False)
    recording = read_recording(path)
    assert recording.n_samples == N - 1
    assert any("cut off after 199 messages" in note for note in recording.notes)


def test_a_chunk_that_differs_from_its_checksum_is_refused(tmp_path: Path) -> None:
    records = channel(1, "/joint_states") + message(1, 0, joint_state(0))
    head = struct.pack("<QQQI", 0, 1, len(records), zlib.crc32(records)) + text("")
    changed = records.replace(b'"effort": [', b'"effort": {')
    path = written(
        tmp_path / "log.mcap", record(6, head + struct.pack("<Q", len(records)) + changed)
    )
    with pytest.raises(RecordingError, match="crc validation failed"):
        read_recording(path)


@pytest.mark.parametrize(
    ("body", "said"),
    first_of(
        3,
        [
            (b"\x05" + b"\xff" * 30, "record has length"),
            (channel(1, "/x", "protobuf"), r"no message in JSON \(topics: /x \(protobuf\)\)"),
            (channel(1, "/x") + record(5, struct.pack("<HIQQ", 1, 0, 0, 0) + b"{"), "is not JSON"),
            (channel(1, "/x") + record(5, b"12"), "cannot be read as MCAP"),
            (record(6, struct.pack("<QQQI", 0, 1, 1 << 40, 0) + text("zstd")), "unpacks to"),
            (
                record(6, struct.pack("<QQQI", 0, 1, 9, 0) + text("snappy") + struct.pack("<Q", 0)),
                "snappy",
            ),
            (channel(1, "/x") + message(1, 0, {"state": "idle"}), "hold no numbers"),
        ],
    ),
)
def test_damage_is_one_error_that_names_the_file(tmp_path: Path, body: bytes, said: str) -> None:
    path = written(tmp_path / "log.mcap", body)
    with pytest.raises(RecordingError, match=said) as caught:
        read_recording(path)
    assert "log.mcap" in str(caught.value)
