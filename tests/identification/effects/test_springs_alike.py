"""Springs of one stiffness are one cause, and springs of several are not."""

from __future__ import annotations

import numpy as np
import pytest

from asbuilt import identify
from asbuilt.description import bundled_robot
from asbuilt.dynamics import DriveSet
from asbuilt.excitation import random_fourier
from asbuilt.experiment import VirtualRobot

MODEL = bundled_robot("ur10e")


@pytest.mark.study
@pytest.mark.parametrize(
    ("stiffness", "alike"), [([2.0, 2.0, 2.0, 2.0], True), ([2.0, 5.0, 1.0, 3.0], False)]
)
def test_springs_of_one_stiffness_are_named_together(stiffness: list[float], alike: bool) -> None:
    drive = DriveSet.parse("viscous,coulomb,spring,offset")
    springs = [0.0, 0.0, *stiffness]
    values = [x for spring in springs for x in (1.0, 2.0, spring, 0.3)]
    machine = VirtualRobot.ideal(MODEL).with_drive(drive, np.array(values))
    log = machine.record(random_fourier(MODEL, rng=3, duration=30.0), rate=100.0).recording
    found = [f for f in identify(MODEL, log).findings if f.code == "springs_alike"]
    assert bool(found) == alike
    for each in found:
        common = float(each.message.partition("one stiffness, ")[2].split()[0])
        assert common == pytest.approx(2.0, abs=0.05)
