"""What does the flange carry? A Panda is identified bare and weighed with a camera on its flange."""

import numpy as np

import asbuilt
from asbuilt.excitation.motions.random_motion import random_fourier
from asbuilt.experiment.virtual.virtual_robot import VirtualRobot
from asbuilt.identification.calibration.payload import identify_payload_samples, payload_frame

model = asbuilt.load_robot("franka-panda")
drive = asbuilt.DriveSet.parse("viscous,coulomb,offset")
bare = VirtualRobot.ideal(model).with_drive(drive, np.tile([1.0, 0.8, 0.1], model.n_joints))
camera = asbuilt.LinkInertia.from_com(0.8, [0.0, 0.04, 0.05], np.diag([0.002, 0.0015, 0.001]))
loaded = bare.with_tool(camera, at=payload_frame(model)[0])


def recorded(robot: VirtualRobot, seed: int) -> asbuilt.Samples:
    """Return samples of a random motion of 20 s."""
    return asbuilt.prepare_samples(
        robot.record(
            random_fourier(model, rng=seed, n_harmonics=10), rate=500.0, rng=seed
        ).recording
    )


result = asbuilt.identify(model, recorded(bare, 1), drive=drive)
payload = identify_payload_samples(result, recorded(loaded, 2))
for name, value, error in zip(payload.names, payload.values, payload.std_errors, strict=True):
    print(
        f"{name:6} {value:9.4f} +- {error:.4f} "
        f" {'told' if name in payload.determined else 'not told'} by this motion"
    )
