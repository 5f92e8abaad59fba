"""Malformed inputs by class: files that no command may take, and none may fail on but in words."""

from __future__ import annotations

import io
import json
import random
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

HOSTILE_NUMBERS = (
    *("nan", "inf", "-inf", "1e308", "-1e308", "1e999", "9" * 5000, "1e-400", "0x1p9999", "true"),
    *("''", "[]", "{}", "1979-05-27"),
)
"""Numbers in a text, most of them no numbers or none of a robot."""


@dataclass(frozen=True)
class Case:
    """A command with a malformed input: `arguments` name files, which `content` holds.

    `strict`: the command must fail; else it may as well find nothing wrong.
    """

    name: str
    arguments: tuple[str, ...]
    content: dict[str, bytes]
    strict: bool = True

    def written(self, folder: Path) -> list[str]:
        """Write the files; returns the arguments with the paths of the files for `@name`."""
        for name, data in self.content.items():
            (folder / name).write_bytes(data)
        return [str(folder / a[1:]) if a.startswith("@") else a for a in self.arguments]


def log_columns(n: int = 60) -> dict[str, np.ndarray]:
    """A recording of two joints."""
    t = np.arange(n) / 100.0
    q = np.column_stack([np.sin(3 * t), np.cos(2 * t)])
    return {"t": t, "q": q, "tau": 2.0 * q + 0.1}


def csv_log(n: int = 60) -> str:
    c = log_columns(n)
    rows = np.column_stack([c["t"], c["q"], c["tau"]])
    return "t,q_1,q_2,tau_1,tau_2\n" + "".join(
        ",".join(f"{v:.6f}" for v in row) + "\n" for row in rows
    )


def binary_logs() -> dict[str, bytes]:
    """A good recording in each binary format."""
    import h5py
    import polars as pl
    import scipy.io

    columns = log_columns()
    npz, mat, parquet, hdf5 = io.BytesIO(), io.BytesIO(), io.BytesIO(), io.BytesIO()
    np.savez_compressed(npz, **columns)
    scipy.io.savemat(mat, columns, do_compression=True)
    table = {"t": columns["t"]}
    table |= {f"{k}_{j + 1}": columns[k][:, j] for k in ("q", "tau") for j in range(2)}
    pl.DataFrame(table).write_parquet(parquet)
    with h5py.File(hdf5, "w") as file:
        for name, values in columns.items():
            file[name] = values
    return {f".{kind}": stream.getvalue() for kind, stream in
            (("npz", npz), ("mat", mat), ("parquet", parquet), ("h5", hdf5))} | {
        ".db3": bag()}  # fmt: skip


def bag() -> bytes:
    """A bag of joint states, version 4 of the SQLite storage."""
    import tempfile

    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    state, header, time = (
        store.types[name]
        for name in (
            "sensor_msgs/msg/JointState",
            "std_msgs/msg/Header",
            "builtin_interfaces/msg/Time",
        )
    )
    c = log_columns()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "bag"
        with Writer(place, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
            topic = writer.add_connection("/joint_states", state.__msgtype__, typestore=store)
            for t, q, tau in zip(c["t"], c["q"], c["tau"], strict=True):
                stamp = time(sec=int(t), nanosec=round(t % 1 * 1e9))
                message = state(
                    header=header(stamp=stamp, frame_id=""),
                    name=["joint_1", "joint_2"], position=q, velocity=0 * q, effort=tau,
                )  # fmt: skip
                data = store.serialize_cdr(message, state.__msgtype__)
                writer.write(topic, round(t * 1e9), data)
        return next(place.glob("*.db3")).read_bytes()


def damaged(data: bytes, rng: random.Random, count: int) -> Iterator[tuple[str, bytes]]:
    """Truncations, flipped bits, zeroed and repeated spans, noise after the start."""
    for k in range(count):
        at = rng.randrange(1, len(data))
        stop = min(len(data), at + rng.randrange(1, 64))
        match k % 5:
            case 0:
                yield f"cut at {at}", data[:at]
            case 1:
                spoilt = bytearray(data)
                for _ in range(8):
                    spoilt[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
                yield "8 bits flipped", bytes(spoilt)
            case 2:
                yield f"zeroed at {at}", data[:at] + bytes(stop - at) + data[stop:]
            case 3:
                yield f"repeated at {at}", data[:stop] + data[at:stop] + data[stop:]
            case 4:
                noise = bytes(rng.randrange(256) for _ in range(stop - at))
                yield f"noise at {at}", data[:at] + noise + data[stop:]


ROBOT_TOML = """name = "arm"
gravity = [0, 0, -9.81]
[[links]]
name = "link_1"
mass = 2.0
com = [0.1, 0, 0]
inertia_about_com = {Ixx = 0.01, Iyy = 0.02, Izz = 0.02}
axis = [0, 0, 1]
origin = {}
[[links]]
name = "link_2"
mass = 1.0
com = [0.1, 0, 0]
inertia_about_com = {Ixx = 0.01, Iyy = 0.02, Izz = 0.02}
axis = [0, 1, 0]
origin = {xyz = [0.3, 0, 0], rpy = [0, 0, 0]}
limits = {lower = -90, upper = 90, velocity = 100, torque = 50}
"""
URDF = """<robot name="arm"><link name="base"/>
<link name="a"><inertial><origin xyz="0.1 0 0"/><mass value="2"/>
<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>
<joint name="j" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 1 0"/>
<origin xyz="0 0 0.1" rpy="0 0 0"/><limit lower="-1" upper="1" effort="9" velocity="2"/></joint>
</robot>
"""
MJCF = """<mujoco model="arm"><worldbody><body name="a" pos="0 0 0.1">
<inertial pos="0.1 0 0" mass="2" diaginertia="0.1 0.1 0.1"/>
<joint name="j" type="hinge" axis="0 1 0" range="-1 1"/></body></worldbody></mujoco>
"""
DH = """link,b,a,alpha_deg,m,rx,ry,rz,Ixx,Iyy,Izz,Ixy,Iyz,Izx
1,0.3,0,90,2,0,0,0.1,0.1,0.1,0.1,0,0,0
2,0,0.4,0,1,0.1,0,0,0.1,0.1,0.1,0,0,0
"""
SHEET = """rate = 100
sign = 1
gains = [1.0, 2.0]
[columns]
time = "t"
position = "q_1-q_2"
torque = ["tau_1", "tau_2"]
[units]
position = "rad"
"""
MOTION = "t,q_joint_1,q_joint_2\n" + "".join(f"{k / 10},{k / 50},{-k / 60}\n" for k in range(10))
ROBOTS = {".toml": ROBOT_TOML, ".urdf": URDF, ".xml": MJCF, ".csv": DH}


def numbers_replaced(text: str) -> Iterator[tuple[str, str]]:
    """Each number of a text, replaced by a hostile one in turn."""
    import re

    for k, found in enumerate(re.finditer(r"(?<![\w.])-?\d+(\.\d+)?(?![\w.])", text)):
        new = HOSTILE_NUMBERS[k % len(HOSTILE_NUMBERS)]
        yield f"number {k} is {new[:12]}", text[: found.start()] + new + text[found.end() :]


def lines_spoilt(text: str) -> Iterator[tuple[str, str]]:
    """Each line left out, then each line twice."""
    lines = text.splitlines(keepends=True)
    for k in range(len(lines)):
        yield f"without line {k + 1}", "".join(lines[:k] + lines[k + 1 :])
        yield f"line {k + 1} twice", "".join([*lines[: k + 1], *lines[k:]])


def texts(
    text: str, suffix: str, arguments: Callable[[str], tuple[str, ...]], rng: random.Random
) -> Iterator[Case]:
    """Return cases of a text file: numbers, lines, bytes."""
    name = f"case{suffix}"
    spoilt = [*numbers_replaced(text), *lines_spoilt(text)]
    for what, content in spoilt:
        yield Case(f"{suffix} {what}", arguments(name), {name: content.encode()}, strict=False)
    for what, data in damaged(text.encode(), rng, 15):
        yield Case(f"{suffix} {what}", arguments(name), {name: data}, strict=False)
    for what, data in (
        ("empty", b""),
        ("zeros", bytes(1000)),
        ("utf-16", text.encode("utf-16")),
        ("random", rng.randbytes(2000)),
        ("latin-1", b"\xff\xfe\xfa name\n" * 9),
    ):
        yield Case(f"{suffix} {what}", arguments(name), {name: data}, strict=what != "utf-16")


def deep() -> Iterator[tuple[str, str, bytes]]:
    """Files nested or repeated 1e5 times: what, suffix, content."""
    n = 100_000
    yield "nested arrays", ".toml", b"x = " + b"[" * n
    yield "closed arrays", ".toml", b"x = " + b"[" * n + b"]" * n
    yield "inline tables", ".toml", b"x = " + b"{a=" * n
    yield "dotted keys", ".toml", b"a" + b".a" * n + b" = 1"
    yield "dotted keys with blanks", ".toml", b"a" + b" . a" * n + b" = 1"
    yield "dotted table", ".toml", b"[a" + b".a" * n + b"]"
    yield "dotted inline keys", ".toml", b"x = {a" + b".a" * n + b" = 1}"
    yield "long number", ".toml", b"name = " + b"9" * n
    yield "many tables", ".toml", b"[[links]]\n" * n
    yield "nested elements", ".urdf", b"<robot>" + b"<link>" * n
    yield "closed elements", ".urdf", b"<robot>" + b"<a>" * n + b"</a>" * n + b"</robot>"
    yield (
        "nested bodies", ".xml",
        b"<mujoco><worldbody>" + b"<body>" * n + b"</body>" * n + b"</worldbody></mujoco>",
    )  # fmt: skip
    yield "unclosed comments", ".xml", b"<!-- " * n
    yield "comments", ".xml", b"<!-- -->" * n
    yield "unclosed comments", ".urdf", b"<!--" * n + b"<robot/>"
    chain = "".join(
        f'<link name="l{k}"/><joint name="j{k}" type="revolute"><parent link="l{k}"/>'
        f'<child link="l{k + 1}"/><axis xyz="0 0 1"/></joint>'
        for k in range(1000)
    )
    yield (
        "1000 joints", ".urdf",
        f'<robot name="r">{chain}<link name="l1000"/></robot>'.encode(),
    )  # fmt: skip
    links = "".join(f'[[links]]\nname = "l{k}"\naxis = [0,0,1]\n' for k in range(1000))
    yield "1000 joints", ".toml", f'name = "r"\n{links}'.encode()
    rows = "".join(f"{k + 1},0.3,0,90,2,0,0,0.1,0.1,0.1,0.1,0,0,0\n" for k in range(1000))
    yield "1000 joints", ".csv", (DH.splitlines()[0] + "\n" + rows).encode()
    yield "long cell", ".csv", DH.encode() + b"9" * 1_500_000


@cache
def bomb(header: bytes) -> bytes:
    """A small archive of large arrays."""
    archived = io.BytesIO()
    with zipfile.ZipFile(archived, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("q.npy", header + bytes(10_000_000))
        archive.writestr("t.npy", bytes(300_000_000))
    return archived.getvalue()


def hostile_logs() -> Iterator[tuple[str, str, bytes]]:
    """Logs: what, suffix, content."""
    head = b"t,q_1,q_2,tau_1,tau_2\n"
    yield "header only", ".csv", head
    yield "one row", ".csv", head + b"0,0,0,0,0\n"
    yield "million columns", ".csv", b",".join(b"c%d" % k for k in range(120_000)) + b"\n1\n"
    yield "long line", ".csv", b"1," * 1_000_000
    yield "zeros", ".csv", bytes(5000)
    yield "text", ".csv", b"hello world\n" * 50
    yield "ragged", ".csv", head + b"0,1\n0,1,2,3,4,5,6,7\n" * 20
    yield "words", ".csv", head + b"a,b,c,d,e\n" * 20
    yield "infinite", ".csv", head + b"inf,inf,inf,inf,inf\n" * 20
    yield "not numbers", ".csv", head + b"nan,nan,nan,nan,nan\n" * 20
    yield "huge", ".csv", head + b"1e308,1e308,1e308,1e308,-1e308\n" * 20
    yield "falling times", ".csv", head + b"".join(b"%d,0,0,0,0\n" % -k for k in range(50))
    yield "one column", ".csv", b"t\n" + b"1\n" * 50
    yield "same names", ".csv", b"t,q_1,q_1,tau_1,tau_1\n" + b"0,0,0,0,0\n" * 20
    yield "long names", ".csv", b"t," + b"q" * 100_000 + b"\n0,0\n0.1,1\n"
    yield "quotes", ".csv", head + b'"0,0,0,0,0\n' * 20
    yield "html", ".csv", b"<html>" * 20
    for suffix in (".npz", ".mat", ".parquet", ".h5", ".db3", ".mcap", ".xyz", ".gz", ".bag"):
        yield "empty", suffix, b""
        yield "text", suffix, b"t,q,tau\n" * 100
    yield "magic only", ".parquet", b"PAR1" + bytes(100) + b"PAR1"
    yield "magic only", ".h5", b"\x89HDF\r\n\x1a\n" + bytes(500)
    yield "magic only", ".db3", b"SQLite format 3\0" + bytes(500)
    yield "magic only", ".mcap", b"\x89MCAP0\r\n" + b"\xff" * 500
    yield "magic only", ".mat", b"MATLAB 5.0 MAT-file" + b" " * 105 + b"\x00\x01IM" + b"\xff" * 500
    header = io.BytesIO()
    shape = {"descr": "<f8", "fortran_order": False, "shape": (10**11,)}
    np.lib.format.write_array_header_1_0(header, shape)
    yield "bomb", ".npz", bomb(header.getvalue())
    declared = io.BytesIO()
    with zipfile.ZipFile(declared, "w") as archive:
        archive.writestr("q.npy", header.getvalue() + bytes(1000))
    yield "declared size", ".npz", declared.getvalue()
    pickled = io.BytesIO()
    np.savez(pickled, q=np.array([{}, []], dtype=object))
    yield "pickle", ".npz", pickled.getvalue()


OPTIONS = (
    *(("excite", "two-link", "--duration", text) for text in ("1e9", "nan", "-1", "0", "inf", "x")),
    *(("excite", "two-link", "--rate", text) for text in ("1e12", "nan", "0", "-5", "inf")),
    *(("excite", "two-link", "--harmonics", text) for text in ("100000", "0", "-3", "1e3")),
    *(("excite", "two-link", "--static", text) for text in ("100000", "0", "-1")),
    *(("excite", "two-link", "--periods", text) for text in ("1000000000", "0")),
    *(("excite", "two-link", "--starts", text) for text in ("1000000000", "0")),
    *(("simulate", "two-link", "--duration", text) for text in ("1e9", "nan", "-1", "0", "inf")),
    *(("simulate", "two-link", "--rate", text) for text in ("1e12", "nan", "0", "-5", "inf")),
    *(("simulate", "two-link", "--free", "--duration", text) for text in ("1e9", "nan", "-1")),
    *(
        ("show", name)
        for name in ("", ".", "/", "/dev/zero", "/dev/full", "no", "a\0b", "x" * 9000)
    ),
    *(("base", name) for name in ("/dev/zero", "/tmp", "nothing.urdf")),
    *(("check", "two-link", name) for name in ("/dev/zero", "/tmp/none.csv", "/dev/full", "")),
    *(("identify", "two-link", name) for name in ("/dev/zero", "/tmp/none.csv", "/proc/self/mem")),
    ("check", "/dev/zero", "x.csv"),
    ("validate", "/dev/zero", "/dev/zero"),
    ("compare", "/dev/zero"),
    ("simulate", "two-link", "/dev/zero"),
    ("view", "two-link", "/dev/zero"),
    ("excite", "two-link", "--collision", "/dev/zero"),
    ("excite", "two-link", "--given", "/dev/zero"),
)
"""Options and paths that make no sense."""


def sheets() -> Iterator[tuple[str, str]]:
    """Recording sheets: what, text."""
    for k, value in enumerate(
        (
            '"1-100000000000"', '"q_1-q_99999999999"', '"5-2"', "[1, 2, 3, 4, 5, 6, 7]",
            "[0, 1]", "[-1, 2]",
            '["none", "q_1"]', "{}", "true", "1.5", '"' + "9" * 6000 + '-3"', "[[1], [2]]",
            '["q_1", "q_1"]', "[]",
        )
    ):  # fmt: skip
        yield f"columns {k}", f"rate = 100\n[columns]\nposition = {value}\n"
    for field in ("rate", "sign", "gains", "joints", "header", "separator", "windows", "units"):
        for value in ("-1", "0", "nan", "inf", "1e400", "'x'", "[]", "{}", "9" * 5000):
            yield f"{field} is {value[:9]}", f"{field} = {value}\n"
    for value in ("/dev/zero", "../../../../dev/zero", "nothing.csv", ".", "", "a/b/c"):
        yield f"file {value}", f"[files]\nposition = '{value}'\ntorque = '{value}'\n"


def huge_results() -> Iterator[tuple[str, str]]:
    """Stored results whose size or depth is the trouble: what, text."""
    head = '{"format": "asbuilt identification result", "version": 1, '
    yield "nested", '{"format": ' + "[" * 100_000
    yield "nested, closed", '{"a": ' + "[" * 100_000 + "]" * 100_000 + "}"
    yield "long integer", head + '"rate": ' + "9" * 1_000_000 + "}"
    yield "many parameters", head + '"parameters": [' + "{}," * 1_000_000 + "{}]}"
    yield "long text", head + '"robot": "' + "x" * 20_000_000 + '"}'
    yield "large matrix", head + '"covariance": [' + ",".join(["1.5"] * 3_000_000) + "]}"


def results(text: str) -> Iterator[tuple[str, str, bool]]:
    """Stored results edited by hand: what, text, whether it must be refused."""
    whole = json.loads(text)

    def edited(**fields: object) -> str:
        return json.dumps(whole | fields)

    for name in ("n_samples", "rate", "duration", "sigma", "covariance", "parameters", "model",
                 "singular_values", "method", "train", "cad", "findings", "errors"):  # fmt: skip
        for value in ("x", None, -1, {}, [], [[]], 1e308, True):
            yield f"{name} is {value}", edited(**{name: value}), False
        yield f"without {name}", json.dumps({k: v for k, v in whole.items() if k != name}), False
    for name in ("sigma", "singular_values"):
        for value in (float("nan"), float("inf"), "1", None, [1.0], {}):
            spoilt = [value, *whole[name][1:]]
            yield (
                f"{name}[0] is {value}",
                edited(**{name: spoilt}),
                (name == "sigma" and value is not None),
            )
    for value in (0.0, -1.0):
        yield f"sigma[0] is {value}", edited(sigma=[value, *whole["sigma"][1:]]), True
    first = whole["parameters"][0]
    for name in first:
        for value in (float("nan"), "x", None, -1, [], 10**400):
            one = [first | {name: value}, *whole["parameters"][1:]]
            yield f"{name} of the first is {str(value)[:9]}", edited(parameters=one), False
    yield "short", edited(parameters=whole["parameters"][1:]), True
    yield "1e999", text.replace('"rate": ', '"rate": 1e999, "old": ', 1), True
    yield "long integer", text.replace('"rate": ', '"rate": ' + "9" * 5000 + ', "old": ', 1), True
    yield "nested", '{"format": ' + "[" * 100_000, True
    yield "nested, closed", '{"a": ' + "[" * 500 + "]" * 500 + "}", True
    yield "no object", "[1, 2]", True
    yield "cut", text[: len(text) // 2], True
