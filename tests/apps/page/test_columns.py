"""Columns that are chosen by mouse are read as chosen."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asbuilt.apps.page.columns import write_sheet
from asbuilt.errors import UsageError
from asbuilt.experiment import read_recording
from command_line import call, document

T = np.arange(200) / 100.0
Q = np.column_stack([np.sin(T), np.cos(2 * T)])
TAU = np.column_stack([3.0 * Q[:, 1], -2.0 * Q[:, 0]])


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A log of `two-link` in degrees with its joints under names of its own."""
    table = np.column_stack([T, np.degrees(Q), TAU, np.zeros(len(T))])
    path = tmp_path / "log.csv"
    head = "t,alpha_pos_deg,beta_pos_deg,alpha_torque,beta_torque,temperature"
    np.savetxt(path, table, delimiter=",", header=head, comments="")
    return path


def chosen(found: dict[str, Any], **joints: str) -> list[dict[str, str]]:
    """The columns of a document with joints of the log renamed."""
    return [
        {
            "name": each["name"],
            "quantity": each["quantity"] or "",
            "joint": joints.get(each["joint"] or "", each["joint"] or ""),
        }
        for each in found["columns"]
    ]


def columns_of(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, Any]:
    import json

    status, out, _ = call(capsys, "columns", *arguments, "--json")
    found = dict(json.loads(out))
    assert status == (0 if found["ok"] else 1)
    return found


def test_joints_get_the_columns_that_they_were_given(
    capsys: pytest.CaptureFixture[str], log: Path, tmp_path: Path
) -> None:
    found = columns_of(capsys, "two-link", log)
    assert not found["ok"]
    assert "do not fit two-link" in found["problem"]
    roles = {each["name"]: (each["quantity"], each["joint"]) for each in found["columns"]}
    assert roles["beta_torque"] == ("torque", "beta")
    assert roles["temperature"] == (None, None)
    first, second = found["joints"]
    sheet = write_sheet(
        tmp_path / "s.toml", log, None, found, chosen(found, alpha=second, beta=first)
    )
    read = read_recording(log, sheet=sheet)
    assert read.joint_names == (first, second)
    np.testing.assert_allclose(read.t, T)
    np.testing.assert_allclose(read.q, Q[:, ::-1], atol=1e-12)
    np.testing.assert_allclose(read.tau, TAU[:, ::-1], atol=1e-12)
    assert columns_of(capsys, "two-link", log, "--sheet", sheet)["ok"]


def test_columns_without_names_have_a_draft_that_is_read(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    log = tmp_path / "bare.csv"
    speed = np.gradient(Q, T, axis=0)
    np.savetxt(log, np.column_stack([T, Q, speed, TAU]), delimiter=",")
    found = columns_of(capsys, "two-link", log)
    assert "without a header row" in found["problem"]
    sheet = write_sheet(tmp_path / "s.toml", log, None, found, chosen(found))
    read = read_recording(log, sheet=sheet)
    np.testing.assert_allclose(read.q, Q, atol=1e-12)
    np.testing.assert_allclose(read.tau, TAU, atol=1e-12)


def test_other_fields_of_the_sheet_are_kept(
    capsys: pytest.CaptureFixture[str], log: Path, tmp_path: Path
) -> None:
    before = tmp_path / "before.toml"
    before.write_text('sign = -1\ngains = [2.0, 3.0]\ntorque_source = "current"\n')
    found = columns_of(capsys, "two-link", log, "--sheet", before)
    first, second = found["joints"]
    sheet = write_sheet(
        tmp_path / "s.toml", log, str(before), found, chosen(found, alpha=first, beta=second)
    )
    read = read_recording(log, sheet=sheet)
    np.testing.assert_allclose(read.tau, -TAU * [2.0, 3.0], atol=1e-12)
    assert read.torque_source == "current"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"beta_torque": ("torque", "alpha")}, "has alpha_torque and beta_torque of torque"),
        ({"beta_torque": ("", "")}, "has no column of torque"),
        ({"temperature": ("time", "")}, "are both the time"),
    ],
)
def test_columns_that_do_not_go_together_are_refused(
    capsys: pytest.CaptureFixture[str],
    log: Path,
    tmp_path: Path,
    change: dict[str, tuple[str, str]],
    message: str,
) -> None:
    found = columns_of(capsys, "two-link", log)
    names = dict(zip(("alpha", "beta"), found["joints"], strict=True))
    wanted = chosen(found)
    for each in wanted:
        each["quantity"], each["joint"] = change.get(
            each["name"], (each["quantity"], each["joint"])
        )
        each["joint"] = names.get(each["joint"], each["joint"])
    with pytest.raises(UsageError, match=message):
        write_sheet(tmp_path / "s.toml", log, None, found, wanted)
    assert not (tmp_path / "s.toml").exists()


def test_a_joint_that_is_locked_by_an_option_has_no_columns(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "log.csv"
    head = "t,q_joint_1,q_joint_2,tau_joint_1,tau_joint_2"
    np.savetxt(path, np.column_stack([T, Q, TAU]), delimiter=",", header=head, comments="")
    assert columns_of(capsys, "two-link", path)["joints"] == ["joint_1", "joint_2"]
    found = columns_of(capsys, "two-link", path, "--lock", "joint_2")
    assert found["joints"] == ["joint_1"]
    assert [each["name"] for each in found["columns"] if each["joint"]] == head.split(",")[1::2]


def test_a_log_that_fits_is_shown_whole(capsys: pytest.CaptureFixture[str], log: Path) -> None:
    text = log.read_text().replace("alpha", "joint_1").replace("beta", "joint_2")
    log.write_text(text)
    found = document(capsys, "columns", "two-link", log)
    assert found["ok"]
    angle = next(each for each in found["columns"] if each["name"] == "joint_1_pos_deg")
    assert angle["factor"] == pytest.approx(np.pi / 180.0)
    assert (angle["smallest"], angle["largest"]) == pytest.approx(
        (np.degrees(Q[:, 0]).min(), np.degrees(Q[:, 0]).max())
    )
    status, out, _ = call(capsys, "columns", "two-link", log)
    assert status == 0
    assert "temperature" not in out
    assert max(map(len, out.splitlines())) <= 80


@pytest.mark.parametrize(
    "wanted",
    [
        None,
        {},
        "t",
        [None],
        [[]],
        [{}],
        [{"name": "t"}],
        [{"name": "t", "quantity": "time", "joint": None}],
        [{"name": "x", "quantity": "time", "joint": ""}],
        [{"name": "t", "quantity": "mass", "joint": ""}],
        [{"name": "alpha_torque", "quantity": "torque", "joint": "alpha"}],
        2 * [{"name": "t", "quantity": "time", "joint": ""}],
    ],
)
def test_what_is_no_list_of_columns_is_refused(
    capsys: pytest.CaptureFixture[str], log: Path, tmp_path: Path, wanted: Any
) -> None:
    found = columns_of(capsys, "two-link", log)
    with pytest.raises(UsageError, match="column"):
        write_sheet(tmp_path / "s.toml", log, None, found, wanted)
    assert not (tmp_path / "s.toml").exists()
