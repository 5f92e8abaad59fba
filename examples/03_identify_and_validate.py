"""From a recording to a result that predicts another motion."""

import numpy as np

import asbuilt

model = asbuilt.load_robot("ur10e")
robot = asbuilt.VirtualRobot.typical(model, rng=1)
motions = (
    asbuilt.random_fourier(model, rng=2, n_harmonics=10),
    asbuilt.random_point_to_point(model, rng=3, n_poses=8),
)
training, test = (robot.record(motion, rate=500.0, rng=4).recording for motion in motions)
assert asbuilt.check_recording(model, training).ok

study = asbuilt.identify(model, training, validation=test)
result = study.result
print(study.summary())
assert result.rank == result.n_base
assert result.validation[0].relative_error < 0.5 * result.cad.relative_error

q, qd, qdd = np.zeros((3, model.n_joints))
print("\nholding torque at the zero pose [N m]:", np.round(result.torque(q, qd, qdd), 2))

again = asbuilt.IdentificationResult.from_json(result.to_json())
assert np.array_equal(again.estimates, result.estimates)
