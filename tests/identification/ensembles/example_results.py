"""Results with a chosen covariance for tests of ensembles."""

from dataclasses import replace
from functools import cache

import numpy as np

from asbuilt.description import bundled_robot
from asbuilt.dynamics import DriveSet, PositionServo, find_base_parameters
from asbuilt.experiment.virtual.presets import perturb_links
from asbuilt.identification import IdentificationResult, IdentifiedParameter, torque_metrics
from asbuilt.identification.servo.servo_rows import ServoErrors

FRICTION = (0.2, 0.5, 0.1, 0.3)
RELATIVE = 0.002


@cache
def two_link_result() -> IdentificationResult:
    """Return a result with the exact torques of other links than CAD's, small correlated errors."""
    model = bundled_robot("two-link")
    base = find_base_parameters(model, DriveSet.parse("viscous,coulomb"))
    true = perturb_links(model, 0.05, np.random.default_rng(2)).parameters
    beta = base.values(np.append(true, FRICTION))
    p, rng = base.n_base, np.random.default_rng(0)
    mixed = np.eye(p) + 0.5 * rng.normal(size=(p, p))
    covariance = mixed @ mixed.T
    size = RELATIVE * np.maximum(np.abs(beta), 0.01) / np.sqrt(np.diag(covariance))
    covariance *= np.outer(size, size)
    errors = np.sqrt(np.diag(covariance))
    parameters = tuple(
        IdentifiedParameter(
            int(i), name, expression, symbolic, unit, float(value), float(value), float(error),
            float(error), determined=True, poorly_determined=False,
        )
        for i, name, expression, symbolic, unit, value, error in zip(
            base.ids, base.names, base.expressions, base.symbolic, base.units, beta, errors,
            strict=True,
        )
    )  # fmt: skip
    metrics = torque_metrics(np.ones((5, 2)), np.ones((5, 2)), "log.csv", model.joint_names)
    return IdentificationResult(
        model=model, base=base, method="wls", sources=("log.csv",), n_samples=5, rate=100.0,
        duration=1.0, parameters=parameters, covariance=covariance,
        textbook_covariance=covariance, sigma=np.ones(2), effective_samples=5.0, rank=p,
        singular_values=np.ones(p), condition_number=1.0, scaled_condition_number=1.0,
        undetermined=(), train=metrics, validation=(), cad=metrics, physically_consistent=True,
        consistency_margin=0.1, findings=(), provenance=(),
    )  # fmt: skip


def servo_result(*, shared: bool, relative: float) -> IdentificationResult:
    """Return the same as if it came from a command, its stiffness identified."""
    kp = (40.0, 20.0)
    return replace(
        two_link_result(),
        servo=PositionServo(kp=kp, kd=(1.0, 0.5), torque_limit=(30.0, 20.0), delay=0.012),
        servo_errors=ServoErrors(
            kp=tuple(relative * each for each in kp), delay=5e-4, shared=shared
        ),
    )
