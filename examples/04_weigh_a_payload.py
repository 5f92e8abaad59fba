"""Identify a Panda bare, then weigh the camera on its flange from a second recording."""

import numpy as np

import asbuilt

model = asbuilt.load_robot("franka-panda")
drive = asbuilt.DriveSet.parse("viscous,coulomb,offset")
bare = asbuilt.VirtualRobot.ideal(model).with_drive(drive, np.tile([1.0, 0.8, 0.1], 7))
camera = asbuilt.LinkInertia.from_com(0.8, [0.0, 0.04, 0.05], np.diag([0.002, 0.0015, 0.001]))
loaded = bare.with_tool(camera)


def recorded(robot, seed):
    """Return 20 s of a random motion at 500 Hz."""
    motion = asbuilt.random_fourier(model, rng=seed, n_harmonics=10)
    return robot.record(motion, rate=500.0, rng=seed).recording


study = asbuilt.identify(model, recorded(bare, 1), options=asbuilt.StudyOptions(drive=drive))
payload = asbuilt.identify_payload(study, recorded(loaded, 2))
for name, value, error in zip(payload.names, payload.values, payload.std_errors, strict=True):
    known = "determined" if name in payload.determined else "undetermined"
    print(f"{name:6} {value:9.4f} +/- {error:.4f}  {known}")
assert abs(payload.values[0] - camera.mass) < 0.02
