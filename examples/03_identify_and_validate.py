"""From a recording to a result that predicts another motion.

The main job from Python, on a virtual UR10e.
"""

import asbuilt
from asbuilt.excitation.motions.random_motion import random_fourier, random_point_to_point
from asbuilt.experiment.virtual.virtual_robot import VirtualRobot

model = asbuilt.load_robot("ur10e")
robot = VirtualRobot.typical(model, rng=1)
training = robot.record(random_fourier(model, rng=2, n_harmonics=10), rate=500.0, rng=2).recording
test = robot.record(random_point_to_point(model, rng=3, n_poses=8), rate=500.0, rng=3).recording

for finding in asbuilt.check_recording(model, training).findings:
    print(finding)

options = asbuilt.StudyOptions(
    drive=asbuilt.DriveSet.parse("armature,viscous,coulomb,offset"), method="auto"
)
study = asbuilt.identify(model, [training], validation=[test], options=options)
result = study.result
print(
    f"{result.rank} of {result.n_base} parameters by {result.method}, physically consistent:"
    f" {result.physically_consistent}"
)
for parameter in sorted(result.parameters, key=lambda p: p.relative_error)[:5]:
    print(
        f"  {parameter.name:6} {parameter.estimate:10.4f} +- {parameter.std_error:.4f}"
        f" {parameter.unit}"
    )
print(study.comparison.torque_table().as_text())

again = asbuilt.IdentificationResult.from_json(result.to_json())
print("the same from its JSON:", bool((again.estimates == result.estimates).all()))
