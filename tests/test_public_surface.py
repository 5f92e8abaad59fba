"""Nothing that users may rely on disappears by accident."""

from __future__ import annotations

import json

import pytest

from public_surface import RECORD, find_lost, list_surface

RECORDING = "python tests/public_surface.py"
APPS = ("estimators", "fleet", "masses", "page", "paper", "programs", "run", "simulators", "watch")


@pytest.mark.apps(*APPS)
def test_all_that_is_recorded_is_still_public() -> None:
    lost = find_lost(json.loads(RECORD.read_text("utf-8")), list_surface())
    assert not lost, f"gone, which asks for a new major version: {lost}; on purpose: {RECORDING}"


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
