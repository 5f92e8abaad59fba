"""A virtual robot with BAM's load-dependent friction is recovered with the set of that name."""

import numpy as np

from asbuilt.description import bundled_robot
from asbuilt.dynamics import DriveSet
from asbuilt.excitation import random_fourier
from asbuilt.experiment import SignalChain, VirtualRobot, prepare_samples, resolve_chain
from asbuilt.identification import identify_samples


def test_directional_load_friction_is_recovered() -> None:
    model = bundled_robot("two-link")
    drive = DriveSet.parse("bam:m5:velocity=0.3:power=1.5")
    values = np.tile([0.02, 0.1, 0.3, 0.2, 0.08, 0.05, 0.06, 0.04], (2, 1))
    assert drive.symbols == ("Ia", "Fv", "Fc", "Fs", "Flm", "Fle", "Flsm", "Flse")
    robot = VirtualRobot.ideal(model).with_drive(drive, values.ravel())
    motion = random_fourier(model, rng=2, duration=15.0, n_harmonics=8)
    recording = robot.record(motion, rate=200.0).recording
    samples = prepare_samples(recording, resolve_chain(SignalChain(cutoff=60.0), recording))
    result = identify_samples(model, samples, drive=drive)
    found = dict(zip(result.base.names, result.estimates, strict=True))
    for number in (1, 2):
        for symbol, size in zip(drive.symbols[3:], values[0, 3:], strict=True):
            assert abs(found[f"{symbol}{number}"] - size) < 0.02, symbol
