"""Find which causes explain the torque error of CAD: a tool that it lacks, and friction."""

import numpy as np

import asbuilt

model = asbuilt.load_robot("kuka-iiwa7-r800")
drive = asbuilt.DriveSet.parse("viscous,coulomb,offset")
tool = asbuilt.LinkInertia.from_com(1.5, [0.0, 0.0, 0.08], np.diag([0.004, 0.004, 0.002]))
robot = asbuilt.VirtualRobot.ideal(model).with_tool(tool)
robot = robot.with_drive(drive, np.tile([0.4, 0.6, 0.1], model.n_joints))
motion = asbuilt.random_fourier(model, rng=4, duration=30.0, n_harmonics=10)
recording = robot.record(motion, rate=200.0, rng=4).recording

study = asbuilt.identify(model, recording, options=asbuilt.StudyOptions(holdout="blocks:3s:3"))
print(study.comparison.verdict())
causes = asbuilt.attribute(study.result)
print(causes)
assert "payload" in causes.chosen
