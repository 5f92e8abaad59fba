"""The verdict on a CAD model: which causes explain its torque error, joint by joint."""

import numpy as np

import asbuilt
from asbuilt.excitation.motions.random_motion import random_fourier
from asbuilt.experiment.virtual.virtual_robot import VirtualRobot
from asbuilt.validation.attribution.attribution import attribute

model = asbuilt.load_robot("kuka-iiwa7-r800")
drive = asbuilt.DriveSet.parse("viscous,coulomb,offset")
tool = asbuilt.LinkInertia.from_com(1.5, [0.0, 0.0, 0.08], np.diag([0.004, 0.004, 0.002]))
robot = (
    VirtualRobot.ideal(model)
    .with_drive(drive, np.tile([0.4, 0.6, 0.1], model.n_joints))
    .with_tool(tool)
)
recording = robot.record(
    random_fourier(model, rng=4, duration=30.0, n_harmonics=10), rate=200.0, rng=4
).recording

study = asbuilt.identify(model, [recording], options=asbuilt.StudyOptions(holdout="blocks:3s:3"))
print(study.comparison.verdict())
for sentence in attribute(study.result).sentences:
    print(" ", sentence)
