"""The page of a checked recording: its headline, its findings, a drawing."""

from __future__ import annotations

import base64
import re
from dataclasses import replace
from pathlib import Path

from asbuilt.description import load_robot
from asbuilt.excitation import random_fourier
from asbuilt.experiment import VirtualRobot, check_recording
from asbuilt.writers import write_check_page


def test_the_page_says_what_is_wrong_and_draws_every_joint(tmp_path: Path) -> None:
    model = load_robot("scara")
    motion = random_fourier(model, rng=1, duration=8.0)
    log = VirtualRobot.typical(model, rng=5).record(motion, rate=100.0, rng=1).recording
    wrong = replace(log, tau=-log.tau, source="<b>.csv")
    checks = [check_recording(model, each) for each in (log, wrong)]
    files = write_check_page(tmp_path, [log, wrong], checks)
    text = files["page"].read_text(encoding="utf-8")
    assert "READY" in text
    assert "NOT READY" in text
    assert "<b>.csv" not in text
    drawn = re.findall(r'src="data:image/svg\+xml;base64,([^"]+)"', text)
    assert len(drawn) == 2
    assert all(b"</svg>" in base64.b64decode(each) for each in drawn)
    assert not re.search(r'(src|href)="https?:', text)
