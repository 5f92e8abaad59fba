"""Inputs at the edge: endless chains, circles, long paths, shapes and datasets that are none."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from asbuilt.cli import require_distinct_logs
from asbuilt.description import load_robot
from asbuilt.errors import DescriptionError, UsageError
from asbuilt.excitation import read_motion
from asbuilt.experiment import LogTable, read_recording, suggest_sheet
from asbuilt.experiment.logs.columns.unnamed_columns import DRAFT
from asbuilt.experiment.logs.formats.log_format import tabulate_variables
from asbuilt.writers.pictures.skeleton import MotionView
from command_line import call
from fleet_logs import write_logs
from robustness import corpus
from studied_cases import first_of

LONG = 5000
"""Letters of a path; the longest that Linux takes has 4095."""


def sdf_of_frames(count: int, last: str = "") -> str:
    """A robot whose link is placed at the end of a chain of frames, a millimetre each."""
    frames = "".join(
        f'<frame name="f{k}"><pose relative_to="f{k + 1}">0 0 0.001 0 0 0</pose></frame>'
        for k in range(count)
    )
    return (
        f'<sdf version="1.9"><model name="m">{frames}'
        f'<frame name="f{count}"><pose relative_to="{last}">0 0 0 0 0 0</pose></frame>'
        '<link name="b"/><link name="a"><pose relative_to="f0"/>'
        "<inertial><mass>1</mass></inertial></link>"
        '<joint name="w" type="fixed"><parent>world</parent><child>b</child></joint>'
        '<joint name="j" type="revolute"><parent>b</parent><child>a</child>'
        "<axis><xyz>0 1 0</xyz></axis></joint></model></sdf>"
    ).replace(' relative_to=""', "")


def test_a_chain_of_frames_is_followed_to_its_end(tmp_path: Path) -> None:
    path = tmp_path / "chain.sdf"
    path.write_text(sdf_of_frames(2000))
    (joint,) = load_robot(path).joints
    assert joint.before[2, 3] == pytest.approx(2.0)


def test_frames_in_a_circle_are_named(tmp_path: Path) -> None:
    path = tmp_path / "circle.sdf"
    path.write_text(sdf_of_frames(2000, last="f1990"))
    with pytest.raises(DescriptionError, match=r"poses of f1990, .* in a circle") as said:
        load_robot(path)
    assert len(str(said.value)) < 500


@pytest.mark.parametrize(
    "words",
    [
        ("show", "@"), ("check", "two-link", "@"), ("check", "two-link", "log.csv", "--sheet", "@"),
        ("base", "@"), ("identify", "two-link", "log.csv", "--out", "@"), ("validate", "@", "log"),
        ("compare", "@"), ("compare", "result.json", "--cad", "@"), ("convert", "two-link", "@"),
        ("simulate", "two-link", "@"), ("view", "two-link", "@"), ("fleet", "show", "@"),
        ("view", "two-link", "--save", "@"), ("masses", "two-link", "--meshes", "@"),
        ("masses", "two-link", "--table", "@"), ("program", "two-link", "@", "--format", "csv"),
        ("excite", "two-link", "--given", "@"), ("excite", "two-link", "--collision", "@"),
        ("schema", "@"), ("schema", "robot", "--out", "@"), ("review", "two-link", "@"),
        ("gains", "two-link", "@", "--loaded", "log.csv", "--mass", "1"), ("@",),
        ("fleet", "add", "@", "two-link", "log.csv", "--id", "r"), ("export", "@", "--urdf", "x"),
    ],
    ids=" ".join,
)  # fmt: skip
@pytest.mark.parametrize("path", ["x" * LONG, "a/" * (LONG // 2) + "x.urdf", "loop", "loop/x"])
def test_paths_that_lead_nowhere(
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    words: tuple[str, ...],
    path: str,
) -> None:
    """Too long, or a symbolic link to itself: one error that fits a screen."""
    monkeypatch.chdir(tmp_path)
    Path("log.csv").write_text(corpus.csv_log())
    Path("loop").symlink_to("loop")
    status, _, err = call(capsys, *(path if each == "@" else each for each in words))
    assert status in (1, 2)
    assert "unexpected" not in err
    assert err.count("asbuilt: ") == 1
    assert len(err) < 700, err


def test_a_mass_of_no_body_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(
        '<mujoco><worldbody><body name="l"><joint name="j" axis="0 1 0"/>'
        '<geom type="cylinder" size="0.1 0.2" density="1e308"/></body></worldbody></mujoco>'
    )
    with pytest.raises(DescriptionError, match=r"mass of the body 'l' is 1\.2566.*e\+306"):
        load_robot(path)


def test_a_log_is_given_once_under_whatever_name(tmp_path: Path) -> None:
    log, copy, other, link = (tmp_path / name for name in ("a.csv", "b.csv", "c.csv", "d.csv"))
    log.write_text(corpus.csv_log())
    copy.write_text(corpus.csv_log())
    other.write_text(corpus.csv_log().replace("0.1", "0.2"))
    link.symlink_to(log)
    require_distinct_logs([log], [other], None)
    for first, second, said in ((log, log, "twice"), (log, link, "twice"), (log, copy, "copy of")):
        with pytest.raises(UsageError, match=said):
            require_distinct_logs([first], [other, second])


def lerobot(folder: Path, fps: object, stamps: object) -> Path:
    """Write a dataset of two joints with or without what tells time."""
    (folder / "meta").mkdir(parents=True)
    (folder / "data").mkdir()
    names = {"names": ["joint_1.pos", "joint_2.pos"]}
    info = {"features": {"observation.state": names, "action": names}}
    (folder / "meta" / "info.json").write_text(json.dumps(info | {"fps": fps}))
    states = 60.0 * np.column_stack([np.sin(np.arange(60) / 9), np.cos(np.arange(60) / 7)])
    rows = {"observation.state": states.tolist(), "action": (states + 1.0).tolist(),
            "frame_index": [*range(40), *range(20)],
            "episode_index": [0] * 40 + [1] * 20}  # fmt: skip
    pl.DataFrame(rows | ({} if stamps == "none" else {"timestamp": stamps})).write_parquet(
        folder / "data" / "x.parquet"
    )
    return folder


@pytest.mark.parametrize(
    ("fps", "stamps"),
    first_of(1, [(None, "none"), (0, "none"), (True, [None] * 60), ("x", ["x"] * 60)]),
)
def test_a_dataset_without_time_is_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, fps: object, stamps: object
) -> None:
    folder, sheet = lerobot(tmp_path / "set", fps, stamps), tmp_path / "sheet.toml"
    sheet.write_text('units = {position = "deg", command = "deg"}\n')
    status, _, err = call(capsys, "check", "two-link", folder, "--sheet", sheet)
    assert status == 1
    assert "has no time" in err
    assert "a number from 0.001 to 1e+06 Hz" in " ".join(err.split())


def test_frames_of_a_dataset_tell_its_time(tmp_path: Path) -> None:
    folder = lerobot(tmp_path / "set", 30, "none")
    units = {"units": {"position": "deg", "command": "deg"}}
    steps = np.diff(read_recording(folder, sheet=units).t)
    assert np.delete(steps, 39) == pytest.approx(1 / 30)
    assert steps[39] > 1.0


def test_robots_of_a_worst_case_are_counted(capsys: pytest.CaptureFixture[str]) -> None:
    status, _, err = call(capsys, "excite", "two-link", "--perturbed", "100000")
    assert status == 2
    assert "--perturbed is 100000; it must be a number from 0 to 1000" in " ".join(err.split())


def test_an_animation_of_a_year_has_as_many_frames_as_any(tmp_path: Path) -> None:
    path, model = tmp_path / "year.csv", load_robot("two-link")
    days = "".join(f"{day * 86_400},{np.sin(day)},{np.cos(day)}\n" for day in range(366))
    path.write_text(f"t,q_joint_1,q_joint_2\n{days}")
    view = MotionView.of_motion(model, read_motion(path, model), most=125)
    assert len(view.t) == 125
    assert view.t[-1] == 365 * 86_400


def test_want_of_memory_is_said_with_size_and_limit(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def greedy(*_: object) -> None:
        np.empty((1 << 40, 1 << 10))

    monkeypatch.setattr("asbuilt.check_recording", greedy)
    path = tmp_path / "log.csv"
    path.write_text(corpus.csv_log())
    status, _, err = call(capsys, "check", "two-link", path)
    assert status == 1
    assert "8.00 PiB" in err
    assert "this process may have" in err


@pytest.mark.study
def test_an_entry_of_another_robot_is_no_entry(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """A file of one robot's folder that is copied into that of another."""
    ledger = tmp_path / "ledger"
    for robot in (1, 2):
        logs = write_logs(tmp_path / f"r{robot}", 2, robot)
        status, _, err = call(capsys, "fleet", "add", ledger, "two-link", *logs, "--id", robot)
        assert status == 0, err
    foreign = next((ledger / "logs" / "2").glob("*.parquet"))
    foreign.rename(ledger / "logs" / "1" / foreign.name)
    status, out, _ = call(capsys, "fleet", "identify", ledger, "--id", "1", "--full")
    assert status == 0
    flat = "".join(out.split())
    assert f"logs/1/{foreign.name}isdamaged" in flat
    assert f"itistheentrylogs/2/{foreign.name}" in flat


def test_columns_by_the_thousand_are_not_compared_pair_by_pair() -> None:
    columns = {f"x{k}": np.sin(np.arange(50.0) / (k + 1)) for k in range(4000)}
    assert DRAFT in suggest_sheet(LogTable("log", columns), load_robot("two-link"))


def test_a_second_encoder_beyond_what_robots_log_is_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path, t = tmp_path / "log.csv", np.arange(300) / 100
    q, far = np.stack([np.sin(t), np.cos(t)]), np.full(300, 1e308)
    rows = np.stack([t, *q, far, q[1], *q], axis=1)
    names = "t,q_motor_1,q_motor_2,q_link_1,q_link_2,tau_1,tau_2"
    np.savetxt(path, rows, delimiter=",", header=names, comments="")
    status, _, err = call(capsys, "identify", "two-link", path)
    assert status == 1
    assert "most values of q_link_1 are none of a joint, such as 1e+308" in err


def test_complex_variables_are_left_out_by_name() -> None:
    table = tabulate_variables("x.npz", {"t": np.arange(9.0), "tau_1": np.arange(9) * 1j})
    assert list(table.columns) == ["t"]
    assert "tau_1" in table.notes[0]
