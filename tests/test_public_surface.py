"""Nothing that users may rely on disappears by accident."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

import asbuilt
from public_surface import RECORD, find_last_release, find_lost, list_surface

RECORDING = "python tests/public_surface.py"
APPS = ("estimators", "fleet", "masses", "page", "paper", "programs", "run", "simulators", "watch")


@pytest.mark.apps(*APPS)
def test_all_that_is_recorded_is_still_public() -> None:
    lost = find_lost(json.loads(RECORD.read_text("utf-8")), list_surface())
    assert not lost, f"gone, which asks for a new major version: {lost}; on purpose: {RECORDING}"


@pytest.mark.apps(*APPS)
def test_a_release_keeps_what_the_last_one_of_its_major_version_had() -> None:
    """The record of the newest tag, which nobody can edit afterwards."""
    release = find_last_release()
    if release is None:
        pytest.skip("no release is tagged here")
    tag, recorded = release
    if tag[1:].split(".")[0] != asbuilt.__version__.split(".")[0]:
        return
    lost = find_lost(recorded, list_surface())
    assert not lost, f"in {tag} and gone, which asks for a new major version: {lost}"


def test_the_last_release_is_the_newest_tag(tmp_path: Path) -> None:
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b"]
    record = tmp_path / "tests" / RECORD.name
    record.parent.mkdir()
    subprocess.run([*git, "init", "-q"], check=True)
    assert find_last_release(tmp_path) is None
    for tag, word in (("v1.2.0", "a"), ("v1.10.0", "b")):
        record.write_text(json.dumps({"names": {"asbuilt": [word]}}))
        subprocess.run([*git, "add", "."], check=True)
        subprocess.run([*git, "commit", "-qm", word], check=True)
        subprocess.run([*git, "tag", tag], check=True)
    assert find_last_release(tmp_path) == ("v1.10.0", {"names": {"asbuilt": ["b"]}})


def test_the_record_is_no_empty_promise() -> None:
    recorded = json.loads(RECORD.read_text("utf-8"))
    assert {"identify", "load_robot"} <= {*recorded["names"]["asbuilt"]}
    assert {"--json", "--out", "--drive"} <= {*recorded["options"]["asbuilt identify"]}
    assert "parameters" in recorded["json"]["identify"]
    assert recorded["files"]


def test_what_disappears_is_named() -> None:
    now = {"names": {"asbuilt": ["a", "b"]}}
    assert find_lost({"names": {"asbuilt": ["a", "c"]}, "json": {"x": ["y"]}}, now) == [
        "names: asbuilt: c",
        "json: x: y",
    ]
