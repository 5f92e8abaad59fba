"""The demonstration of a fleet, small."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from asbuilt.apps.fleet.demo import (
    CHANGED,
    demo_document,
    describe_demo,
    run_demo,
)
from asbuilt.codec import format_json
from command_line import documented_fields


@pytest.mark.study
def test_the_robot_that_changed_stands_out(tmp_path: Path) -> None:
    demo = run_demo(tmp_path, robots=(CHANGED - 1, CHANGED), days=7)
    assert not demo.addition.failed
    document = json.loads(format_json(demo_document(demo)))
    assert set(document) in documented_fields()["demo"]
    change = {each["id"]: each["change"] for each in document["robots"]}
    changed = change.pop(f"arm-{CHANGED:02d}")
    assert changed > 100.0 * max(change.values())
    screen = describe_demo(demo)
    assert f"arm-{CHANGED:02d} changed most" in screen
    assert all(len(line) <= 80 or str(tmp_path) in line for line in screen.splitlines())
