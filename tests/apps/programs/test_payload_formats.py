"""Payloads in the words of makers, read back by parsers written from the makers' manuals.

The parsers are those of `benchmarks/payload_makers.py`, which prints what they read. The inertia
that is read is compared by other roads: MuJoCo's `fullinertia` and principal axes, and rotations of
SciPy.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from asbuilt import UsageError
from asbuilt.errors import IdentifiabilityError, ResultError
from asbuilt.writers import PAYLOAD_FORMATS, CarriedBody, read_stored_payload, write_payload
from command_line import call

sys.path.append(str(Path(__file__).parents[3] / "benchmarks"))
from payload_makers import (
    BODY,
    CENTRE,
    INERTIA,
    MASS,
    READERS,
    code,
    keep,
    numbers,
    read_abb,
    read_ur,
)


def in_mujoco(mass: float, centre: np.ndarray, inertia: np.ndarray) -> Any:
    """MuJoCo's body: principal moments, and where they point."""
    full = " ".join(map(repr, inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]].tolist()))
    place = " ".join(map(repr, centre.tolist()))
    text = (
        f'<mujoco><compiler balanceinertia="false"/><worldbody><body><freejoint/>'
        f'<inertial pos="{place}" mass="{mass!r}" fullinertia="{full}"/>'
        f"</body></worldbody></mujoco>"
    )
    return mujoco.MjModel.from_xml_string(text)


def test_every_maker_of_the_contract_is_there() -> None:
    assert set(PAYLOAD_FORMATS) == set(READERS)


@pytest.mark.parametrize("maker", READERS)
def test_what_is_written_is_the_same_body(maker: str, tmp_path: Path) -> None:
    files, _ = write_payload(BODY, {maker: tmp_path / "payload.txt"})
    mass, centre, inertia = READERS[maker](files[maker].read_text())
    assert mass == pytest.approx(MASS, rel=1e-7)
    np.testing.assert_allclose(centre, CENTRE, rtol=1e-7)
    kept = keep(maker)
    np.testing.assert_allclose(inertia, kept, rtol=1e-6, atol=1e-10)
    model, told = in_mujoco(mass, centre, inertia), in_mujoco(MASS, CENTRE, kept)
    np.testing.assert_allclose(model.body_inertia[1], told.body_inertia[1], rtol=1e-6)


def test_principal_axes_are_those_of_mujoco(tmp_path: Path) -> None:
    """RAPID's quaternion and moments make the matrix that MuJoCo is given, in its own axes."""
    files, _ = write_payload(BODY, {"abb": tmp_path / "load.mod"})
    q = numbers(code(files["abb"].read_text(), "!"))
    turn, moments, model = Rotation.from_quat([*q[5:8], q[4]]), q[8:], in_mujoco(
        MASS, CENTRE, INERTIA
    )  # fmt: skip
    w, x, y, z = model.body_iquat[1]
    axes = Rotation.from_quat([x, y, z, w]).as_matrix()
    between = np.abs(axes.T @ turn.as_matrix())
    np.testing.assert_allclose(between @ moments, model.body_inertia[1], rtol=1e-6)
    np.testing.assert_allclose(np.sort(between.ravel())[-3:], 1.0, atol=1e-6)


def test_numbers_are_in_the_axes_of_the_makers_flange(tmp_path: Path) -> None:
    """`flange` of a ROS description points along x, `tool0`, the maker's, along z."""
    placement = np.eye(4)
    placement[:3, :3] = Rotation.from_euler("xyz", [90, 0, 90], degrees=True).as_matrix()
    placement[:3, 3] = [0.01, 0.0, 0.0]
    R, p = placement[:3, :3], placement[:3, 3]
    seen = CarriedBody(
        "ur10e", "flange", MASS, 0.02, R @ CENTRE + p, R @ INERTIA @ R.T,
        frames={"ur_tool0": placement},
    )  # fmt: skip
    files, notes = write_payload(seen, {"ur": tmp_path / "payload.script"})
    _, centre, inertia = read_ur(files["ur"].read_text())
    np.testing.assert_allclose(centre, CENTRE, atol=1e-9)
    np.testing.assert_allclose(inertia, INERTIA, atol=1e-9)
    assert "in the axes of ur_tool0" in files["ur"].read_text()
    assert "ur" not in notes


def stored(folder: Path, left_out: list[str], **changed: Any) -> Path:
    document = {
        "robot": "ur10e", "frame": "tool0", "mass": {"estimate": MASS, "std_error": 0.02},
        "com": {"estimate": CENTRE.tolist()}, "inertia_about_com": INERTIA.tolist(),
        "not_determined": left_out,
    }  # fmt: skip
    (folder / "payload.json").write_text(json.dumps(document | changed))
    return folder / "payload.json"


def test_what_is_not_determined_is_the_makers_default(tmp_path: Path) -> None:
    body = read_stored_payload(stored(tmp_path, ["com_z", "Ixy", "Ixz", "Iyz"]))
    assert body is not None
    files, notes = write_payload(body, {"ur": tmp_path / "a", "franka": tmp_path / "b.json"})
    text = files["ur"].read_text()
    _, centre, inertia = read_ur(text)
    assert centre.tolist() == [0.03, -0.02, 0.0]
    np.testing.assert_allclose(inertia, np.diag(np.diagonal(INERTIA)))
    assert "# not determined and left at the maker's default: com_z, Ixy, Ixz and Iyz" in text
    assert json.loads(files["franka"].read_text())["centerOfMass"][2] == 0.0
    assert any("com_z" in note for note in notes["franka"])


def test_a_moment_alone_is_no_body(tmp_path: Path) -> None:
    body = read_stored_payload(stored(tmp_path, ["Ixx", "Ixy", "Ixz", "Iyz"]))
    assert body is not None
    assert body.is_point
    places = {maker: tmp_path / maker for maker in READERS} | {"franka": tmp_path / "desk.json"}
    files, notes = write_payload(body, places)
    for maker in ("kuka", "abb", "fanuc", "yaskawa", "doosan"):
        assert not READERS[maker](files[maker].read_text())[2].any()
    assert files["ur"].read_text().splitlines()[-1] == (
        "set_target_payload(1.8, [0.03, -0.02, 0.09])"
    )
    assert json.loads(files["franka"].read_text())["inertia"][::4] == [0.001] * 3
    assert all(any("belongs to no body" in note for note in each) for each in notes.values())


def test_preset_of_the_smart_pendant(tmp_path: Path) -> None:
    files, _ = write_payload(BODY, {"yaskawa": tmp_path / "payload.yps"})
    text = files["yaskawa"].read_text()
    plain = re.sub(r"(\w+):", r'"\1":', code(text, "//"))
    tool = json.loads(re.sub(r",(\s*[}\]])", r"\1", plain))["presets"][0]
    assert tool["weight"] == MASS
    np.testing.assert_allclose(tool["com"], 1e3 * CENTRE)
    np.testing.assert_allclose(tool["moi"], np.diagonal(INERTIA))


@pytest.mark.parametrize("maker", READERS)
def test_a_strange_name_stays_in_its_comment(maker: str, tmp_path: Path) -> None:
    strange = CarriedBody("x", 'a"\nhalt \\\n\u2028名', MASS, 0.02, CENTRE, INERTIA)
    plain = CarriedBody("x", "a", MASS, 0.02, CENTRE, INERTIA)
    comment = PAYLOAD_FORMATS[maker].comment
    told = []
    for body in (strange, plain):
        text = write_payload(body, {maker: tmp_path / "p"})[0][maker].read_text()
        assert text.isascii()
        told.append(code(text, comment))
    assert told[0] == told[1]


def test_no_mass_no_file(tmp_path: Path) -> None:
    path = stored(tmp_path, ["mass"])
    with pytest.raises(IdentifiabilityError, match="no controller takes a payload without one"):
        read_stored_payload(path)
    with pytest.raises(ResultError, match="is no payload"):
        read_stored_payload(stored(tmp_path, [], com={"estimate": [1.0]}))
    with pytest.raises(UsageError, match=r"payload format 'kukka'.*did you mean 'kuka'"):
        write_payload(BODY, {"kukka": tmp_path / "p"})


def test_stored_payload_on_the_command_line(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = stored(tmp_path, ["Ixy"])
    status, out, _ = call(
        capsys, "payload", path, "--to", f"ur={tmp_path}/p.script", "--to", f"abb={tmp_path}/p.mod"
    )
    assert status == 0
    assert "left at the maker's default: Ixy" in out
    assert read_abb((tmp_path / "p.mod").read_text())[0] == MASS
    status, _, err = call(capsys, "payload", path)
    assert (status, "--to MAKER=FILE" in err) == (2, True)
    status, _, err = call(capsys, "payload", path, "--to", "ur")
    assert (status, "--to takes FORMAT=FILE" in err) == (2, True)


def test_a_tilde_after_the_maker_is_the_home_folder(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Shells expand it only at the beginning of a word."""
    monkeypatch.setenv("HOME", str(tmp_path))
    assert call(capsys, "payload", stored(tmp_path, []), "--to", "ur=~/p.script")[0] == 0
    assert read_ur((tmp_path / "p.script").read_text())[0] == MASS
