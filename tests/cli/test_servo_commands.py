"""From a log of commands to a simulator, on the command line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from asbuilt.description.load import load_robot
from command_line import call, document

WINDOWS = ("--rollout", "0.5,1")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("servo")


@pytest.fixture
def study(folder: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    """Return the log of a virtual servo arm beside its study, made once."""
    log = folder / "log.csv"
    if not log.exists():
        document(capsys, "simulate", "so-101", "--preset", "servo", "--duration", "16", "-o", log)
        document(capsys, "identify", "so-101", log, "--holdout", "last:0.3", "-o", folder / "study")
    return log


def test_a_rollout_proves_the_servo_arm(
    study: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result, picture, page = folder / "study" / "result.json", folder / "x.webp", folder / "pages"
    found = document(
        capsys, "validate", result, study, *WINDOWS, "--animation", picture, "-o", page
    )
    for rollout in found["rollout"]:
        assert rollout["driven_by"] == "command"
        assert rollout["as_built"]["rms_all"] < 0.3 * rollout["cad"]["rms_all"]
        assert rollout["as_built"]["rms_all"] < rollout["no_physics"]["rms_all"]
    text = Path(found["files"]["rollout"]).read_text()
    assert "data:image/webp;base64," in text
    assert text.count("<svg viewBox") == 5
    assert all(name in text for name in load_robot("so-101").joint_names)
    with Image.open(found["files"]["animation"]) as animation:
        assert animation.n_frames > 30
        frames = []
        for k in (0, animation.n_frames - 1):
            animation.seek(k)
            frames.append(np.asarray(animation.convert("RGB"), dtype=float))
    assert np.abs(frames[1] - frames[0]).max() > 100
    assert picture.stat().st_size < 2_000_000


def test_a_described_robot_has_a_page_too(
    study: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = document(capsys, "validate", "so-101", study, *WINDOWS, "-o", folder / "described")
    assert found["rollout"][0]["as_built"] is None
    assert "by CAD" in Path(found["files"]["rollout"]).read_text()


def test_an_animation_needs_a_rollout(
    study: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = folder / "study" / "result.json"
    status, _, err = call(capsys, "validate", result, study, "--animation", folder / "no.webp")
    assert status == 2
    assert "--animation" in err


@pytest.mark.slow
def test_arms_of_a_humanoid_roll_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Fourteen joints on one torso, whose stiffness is stated by the sheet of the log."""
    log = tmp_path / "log.csv"
    document(capsys, "simulate", "g1-arms", "--preset", "servo", "--duration", "20", "-o", log)
    found = document(capsys, "identify", "g1-arms", log, "--holdout", "last:0.3", *WINDOWS)
    truth = load_robot(str(log.with_name("log_robot.toml")))
    assert len(found["joints"]) == truth.n_joints == 14
    for rollout in found["rollout"]:
        assert rollout["n_windows"] >= 4
        assert rollout["as_built"]["rms_all"] < 0.5 * rollout["cad"]["rms_all"]
    (delay,) = found["delay"]
    assert abs(delay["estimate"] - 0.01) < 0.001
