"""Files of every kind that is read, damaged: read, or one error that names the file.

`test_corpus` runs commands on some of them; here the readers are called, which is quicker.
"""

from __future__ import annotations

import json
import random
import re
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

import asbuilt
from asbuilt.description import load_robot
from asbuilt.errors import AsbuiltError
from asbuilt.excitation import read_motion
from asbuilt.excitation.collision.capsules import build_surroundings
from asbuilt.experiment import read_recording, read_sheet
from asbuilt.experiment.logs.formats.robot_learning import read_lerobot, read_sage
from asbuilt.isolated_reading import read_guarded
from asbuilt.workflow import identify, read_result
from fleet_logs import MODEL, recording
from robustness import corpus

SEED, QUICK, ALL = 5, 25, 120
"""Files of each kind: in `make test`, in `make studies`."""
SLOWEST = 20
"""CPU time [s] after which a reader counts as hung."""
HOSTILE = ("", "x" * 5000, "a\\u0000b", "../../etc/passwd", "/dev/zero", "nan", "\\n", "[", "<")
"""Texts in place of a name, a path or a unit."""
SDF = """<sdf version="1.9"><model name="arm"><link name="base"/><frame name="f" attached_to="base">
<pose>0 0 0.1 0 0 0</pose></frame><link name="a"><pose relative_to="f">0 0 0 0 0 0</pose>
<inertial><pose>0.1 0 0 0 0 0</pose><mass>2</mass><inertia><ixx>0.1</ixx><iyy>0.1</iyy>
<izz>0.1</izz></inertia></inertial></link>
<joint name="w" type="fixed"><parent>world</parent><child>base</child></joint>
<joint name="j" type="revolute"><parent>base</parent><child>a</child><axis><xyz>0 1 0</xyz>
<limit><lower>-1</lower><upper>1</upper><effort>9</effort></limit></axis></joint></model></sdf>
"""
XACRO = """<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro">
<xacro:property name="m" value="2"/><xacro:macro name="l" params="n mass"><link name="${n}">
<inertial><mass value="${mass * 2}"/><inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0"
izz="${1 / 10}"/></inertial></link></xacro:macro><link name="base"/><xacro:l n="a" mass="${m}"/>
<joint name="j" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="9" velocity="2"/></joint></robot>
"""
CELL = """clearance = 0.01
floor = -0.5
allowed = [["link_1", "link_2"]]
[[capsules]]
link = "link_1"
start = [0, 0, 0]
stop = [0.2, 0, 0]
radius = 0.05
[[capsules]]
link = "link_2"
start = [0, 0, 0]
stop = [0.2, 0, 0]
radius = 0.05
[[obstacles]]
name = "table"
size = [1, 1, 0.1]
position = [0.8, 0, -0.4]
"""
MASSES = """link,part,mass [kg],cx [mm],cy [mm],cz [mm],\
Ixx [kg m^2],Iyy [kg m^2],Izz [kg m^2],Ixy [kg m^2],Ixz [kg m^2],Iyz [kg m^2]
link_1,tube,2.0,100,0,0,0.01,0.02,0.02,0,0,0
link_2,tube,1.0,100,0,0,0.01,0.02,0.02,0,0,0
"""
STATES = "type,timestamp,positions,velocities,torques\n" + "".join(
    f'STATE_MOTOR,{20000 * k},"[{0.1 * k}, {-0.1 * k}]","[1, 1]","[0.5, 0.5]"\n' for k in range(9)
)


@dataclass(frozen=True)
class Kind:
    """Name and content of a good file, the files beside it, and what reads it.

    `slow`: another process reads it.
    """

    name: str
    text: str
    read: Callable[[Path], Any]
    beside: dict[str, str | bytes] = field(default_factory=dict)
    slow: bool = False


def kinds_of_apps(result: Any) -> dict[str, Kind]:
    """Files that apps read, where they are installed."""
    found: dict[str, Kind] = {}
    if hasattr(asbuilt, "watch"):
        from asbuilt.apps.watch import read_thresholds
        from asbuilt.apps.watch.watched_log import format_thresholds

        thresholds = asbuilt.watch(result, recording(4, seconds=6.0)).thresholds
        text = format_thresholds(thresholds)
        found["thresholds"] = Kind("thresholds.json", text, read_thresholds)
    if hasattr(asbuilt, "link_masses"):
        from asbuilt.apps.masses import read_cad_table

        found["masses"] = Kind(
            "masses.csv",
            MASSES,
            lambda path: read_cad_table(path, about="com", products="tensor"),
        )
    if hasattr(asbuilt, "open_ledger"):
        about = json.dumps({"format": "asbuilt fleet ledger", "format_version": 1})
        found["ledger"] = Kind(
            "ledger.json", about, lambda path: asbuilt.open_ledger(str(path.parent))
        )
    return found


@cache
def kinds() -> dict[str, Kind]:
    log = recording(3, seconds=6.0)
    result = identify(MODEL, [log]).result
    robots = {f"robot{suffix}": Kind(f"r{suffix}", text, load_robot)
              for suffix, text in (*corpus.ROBOTS.items(), (".sdf", SDF))}  # fmt: skip
    names = {"names": ["joint_1.pos", "joint_2.pos"], "shape": [2], "dtype": "float32"}
    info = {"fps": 30, "features": {"observation.state": names, "action": names}}
    return robots | kinds_of_apps(result) | {
        "robot.xacro": Kind("r.xacro", XACRO, load_robot, slow=True),
        "result": Kind("result.json", result.to_json(), read_result),
        "sheet": Kind("log.toml", corpus.SHEET, read_sheet),
        "sheet of a log": Kind("log.toml", corpus.SHEET,
                               lambda path: read_recording(path.with_suffix(".csv")),
                               {"log.csv": corpus.csv_log()}),
        "log": Kind("log.csv", corpus.csv_log(), read_recording),
        "motion": Kind("m.csv", corpus.MOTION, lambda path: read_motion(path, MODEL)),
        "cell": Kind("cell.toml", CELL, lambda path: build_surroundings(MODEL, path)),
        "lerobot": Kind("meta/info.json", json.dumps(info),
                        lambda path: read_guarded(read_lerobot, path.parent.parent),
                        {"data/x.parquet": dataset()}),
        "sage": Kind("state_motor.csv", STATES, lambda path: read_guarded(read_sage, path.parent),
                     {"joint_list.txt": "One\nTwo\n",
                      "control.csv": STATES.replace("STATE_MOTOR", "CONTROL")}),
    }  # fmt: skip


def dataset() -> bytes:
    """The frames of a LeRobot dataset."""
    import io

    states = 60.0 * np.column_stack([np.sin(np.arange(30) / 9), np.cos(np.arange(30) / 7)])
    stream = io.BytesIO()
    rows = {"observation.state": states.tolist(), "action": states.tolist()}
    pl.DataFrame(rows).write_parquet(stream)
    return stream.getvalue()


def texts_replaced(text: str) -> Iterator[tuple[str, str]]:
    """Each quoted text, each XML text and each cell replaced by a hostile one in turn."""
    for k, found in enumerate(re.finditer(r'(?<=")[^"\n]*(?=")|(?<=>)[^<>\n]+(?=<)', text)):
        new = HOSTILE[k % len(HOSTILE)]
        yield f"text {k} is {new[:9]}", text[: found.start()] + new + text[found.end() :]


def damaged(text: str, rng: random.Random, count: int) -> Iterator[tuple[str, bytes]]:
    """Return so many damaged files, as even as there are of each damage."""
    data = text.encode()
    ways: list[list[tuple[str, bytes]]] = [
        [(what, each.encode()) for what, each in way(text)]
        for way in (corpus.numbers_replaced, corpus.lines_spoilt, texts_replaced)
    ]
    ways += [
        [*corpus.damaged(data, rng, count)],
        [("empty", b""), ("zeros", bytes(999)), ("utf-16", text.encode("utf-16")),
         ("random", rng.randbytes(2000)), ("twice", data + data), ("latin", b"\xff\xfe " + data)],
    ]  # fmt: skip
    for way in ways:
        yield from rng.sample(way, min(len(way), count // len(ways)))


def failures(kind: Kind, folder: Path, count: int) -> Iterator[str]:
    """Read damaged files; yield what is neither read nor refused in words."""
    place = folder / kind.name
    for name, content in kind.beside.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
    place.parent.mkdir(parents=True, exist_ok=True)
    for what, data in damaged(kind.text, random.Random(SEED), count):
        place.write_bytes(data)
        signal.setitimer(signal.ITIMER_PROF, SLOWEST)
        try:
            kind.read(place)
        except AsbuiltError as said:
            if not str(said) or len(str(said)) > 3000:
                yield f"{what}: {len(str(said))} letters of error {str(said)[:200]}"
            elif not any(str(each) in str(said) for each in (place.name, folder)):
                yield f"{what}: names no file: {str(said)[:300]}"
        except Exception as wrong:
            yield f"{what}: {type(wrong).__name__} {str(wrong)[:300]}"
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)


NAMES = (
    *(f"robot{suffix}" for suffix in (*corpus.ROBOTS, ".sdf", ".xacro")),
    *("result", "sheet", "sheet of a log", "log", "motion", "cell", "lerobot", "sage"),
    *(("thresholds",) if hasattr(asbuilt, "watch") else ()),
    *(("masses",) if hasattr(asbuilt, "link_masses") else ()),
    *(("ledger",) if hasattr(asbuilt, "open_ledger") else ()),
)


def test_every_kind_is_tried() -> None:
    assert set(kinds()) == set(NAMES)


@pytest.mark.parametrize("name", [name for name in NAMES if name != "robot.xacro"])
def test_good_files_are_read_and_damaged_ones_refused_by_name(name: str, tmp_path: Path) -> None:
    kind = kinds()[name]
    assert not [*failures(kind, tmp_path, QUICK)]
    (tmp_path / kind.name).write_text(kind.text)
    kind.read(tmp_path / kind.name)


@pytest.mark.study
@pytest.mark.parametrize("name", NAMES)
def test_many_damaged_files_are_refused_by_name(name: str, tmp_path: Path) -> None:
    kind = kinds()[name]
    assert not [*failures(kind, tmp_path, QUICK if kind.slow else ALL)]
