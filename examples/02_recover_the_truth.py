"""Identify a virtual robot, whose parameters are known, and count the errors that are too small."""

import numpy as np

import asbuilt

for name in ("ur10e", "scara"):
    model = asbuilt.load_robot(name)
    robot = asbuilt.VirtualRobot.preset("lab", model, rng=1)
    logs = [
        robot.record(asbuilt.random_fourier(model, rng=seed, n_harmonics=5 + seed), rng=seed)
        for seed in range(2)
    ]
    options = asbuilt.StudyOptions(drive=robot.drive)
    study = asbuilt.identify(model, [each.recording for each in logs[:1]], options=options)
    result = study.result

    truth = result.base.regrouping @ robot.truth
    within = np.abs(result.estimates - truth) <= 3.0 * result.std_errors
    (held_out,) = asbuilt.validate(study, logs[1].recording)
    cad, built = held_out.metrics_cad.relative_error, held_out.metrics_as_built.relative_error
    print(
        f"{name:6} {within.sum()} of {within.size} parameters within 3 standard errors of the"
        f" truth; torque error on another motion: CAD {cad:.1%}, as built {built:.2%}"
    )
    assert within.mean() > 0.9
    assert built < 0.2 * cad
