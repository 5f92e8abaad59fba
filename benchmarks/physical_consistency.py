"""Processor time of the physically consistent estimators on 7 joints, 43 base + 21 drive
parameters, from square-root information.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from asbuilt.description.load import load_robot
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.dynamics.regressor import observation_matrix
from asbuilt.excitation.motions.fourier import random_fourier
from asbuilt.experiment.signal.samples import Samples
from asbuilt.identification.bodies.body_bounds import bound_generously
from asbuilt.identification.bodies.cad_prior import build_cad_prior
from asbuilt.identification.bodies.conic_fit import ConicProblem
from asbuilt.identification.bodies.standard_parameters import find_standard_parameters
from asbuilt.identification.estimators.consistent_fit import fit_consistent, fit_toward_cad
from asbuilt.identification.information.square_root_information import accumulate

ROBOT = "kuka-iiwa7-r800"
REPEATS = 15


def measure() -> dict[str, float | str]:
    """Return milliseconds of processor time, the median of several runs."""
    model = load_robot(ROBOT)
    base = find_base_parameters(model, DriveSet.parse("viscous,coulomb,offset"))
    prior = build_cad_prior(model, base.drive)
    rng = np.random.default_rng(1)
    motion = random_fourier(model, rng=1, duration=60.0).sample(50.0)
    chi = prior.parameters.copy()
    chi[:70] = (chi[:70].reshape(7, 10) * rng.uniform(0.8, 1.2, (7, 1))).ravel()
    chi[70:] = rng.uniform(0.1, 1.0, len(chi) - 70)
    W = observation_matrix(
        model, motion.q, motion.qd, motion.qdd, drive=base.drive, columns=base.columns
    )
    tau = (W @ base.values(chi)).reshape(motion.q.shape)
    tau += 0.05 * np.sqrt(np.mean(tau**2, axis=0)) * rng.normal(size=tau.shape)
    samples = Samples(
        t=motion.t,
        q=motion.q,
        qd=motion.qd,
        qdd=motion.qdd,
        tau=tau,
        rate=50.0,
        joint_names=model.joint_names,
        segments=((0, len(motion.t)),),
    )
    information = accumulate(model, base, samples)
    estimate = fit_consistent(information, prior)
    factor, bounds = information.stacked(estimate.weights), bound_generously(prior)
    return {
        "conic_program_ms": _milliseconds(
            lambda: ConicProblem(prior, base.regrouping, bounds).fit(factor)
        ),
        "consistent_whole_ms": _milliseconds(lambda: fit_consistent(information, prior)),
        "entropic_given_weight_ms": _milliseconds(
            lambda: fit_toward_cad(information, prior, weight=10.0, weights=estimate.weights)
        ),
        "entropic_choosing_weight_ms": _milliseconds(lambda: fit_toward_cad(information, prior)),
        "euclidean_choosing_weight_ms": _milliseconds(
            lambda: fit_toward_cad(information, prior, metric="euclidean")
        ),
        "standard_parameters_ms": _milliseconds(
            lambda: find_standard_parameters(model, base, estimate.beta)
        ),
    }


def _milliseconds(work: Callable[[], object], repeats: int = REPEATS) -> float:
    took = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        took.append(time.process_time() - start)
    return 1e3 * float(np.median(took))


if __name__ == "__main__":
    for name, value in measure().items():
        print(f"{name:<32} {value:8.1f}")
