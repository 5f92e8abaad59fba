"""Ten seconds of a new robot with its siblings as prior, against more without.

    python benchmarks/fleet_siblings.py [--siblings 12] [--new 6]

Robots of three types with mass properties 5 % and friction 20 % off their type's, whose own mean
is as far off CAD; torque noise 2 % of its RMS, correlated over 50 ms. Errors are those of torque
on another motion, relative to the torque, without noise; CAD as the prior of what no motion
determines.
"""

from __future__ import annotations

import argparse
import json

import numpy as np

from asbuilt.apps.fleet.identification import (
    SiblingPrior,
    derive_posterior_uncertainty,
    estimate_prior,
    estimate_with_siblings,
)
from asbuilt.arrays import Array
from asbuilt.description.load import load_robot
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.dynamics.parameters import parameter_values
from asbuilt.dynamics.regressor import observation_matrix
from asbuilt.excitation.motions.fourier import random_fourier
from asbuilt.experiment.signal.samples import Samples
from asbuilt.identification.bodies.cad_prior import design_values
from asbuilt.identification.estimators.least_squares import fit_least_squares
from asbuilt.identification.estimators.methods import methods
from asbuilt.identification.information.estimate import EstimationData
from asbuilt.identification.information.square_root_information import (
    SquareRootInformation,
    accumulate,
)

TYPES = ("ur10e", "kuka-iiwa7-r800", "franka-panda")
RATE, NOISE, SHORT, LONG = 50.0, 0.02, 10.0, 60.0
MASSES, FRICTION = 0.05, 0.2
TOOL = 2.0
"""Mass [kg] of what an odd robot carries, 8 cm along z of the last link."""


class VirtualKind:
    """Make robots of one type and their data."""

    def __init__(self, name: str) -> None:
        self.model = load_robot(name)
        self.drive = DriveSet.parse("viscous,coulomb,offset,armature")
        self.base = find_base_parameters(self.model, self.drive)
        self.rng = np.random.default_rng(7)
        n = self.model.n_joints
        chi = np.nan_to_num(parameter_values(self.model, self.drive), nan=0.0)
        torque = np.array([min(joint.limits.torque, 500.0) for joint in self.model.joints])
        names = [name for k in range(n) for name in self.drive.names(k + 1)]
        for j, symbol in enumerate(names):
            share = {"Fv": 0.03, "Fc": 0.03, "Ia": 0.002}.get(symbol.rstrip("0123456789"), 0.0)
            chi[10 * n + j] = share * torque[j // self.drive.columns_per_joint]
        self.type = self.drawn(chi)
        self.design = np.nan_to_num(design_values(self.model, self.base), nan=0.0)

    def drawn(self, chi: Array, size: float = 1.0) -> Array:
        """Return parameters some per cent off, links in proportion, so they stay consistent."""
        n, rng = self.model.n_joints, self.rng
        found = chi.copy()
        for k in range(n):
            found[10 * k : 10 * k + 10] *= 1.0 + size * MASSES * rng.standard_normal()
        found[10 * n :] *= np.exp(size * FRICTION * rng.standard_normal(len(chi) - 10 * n))
        return found

    def torque(self, chi: Array, seed: int, seconds: float) -> tuple[Samples, Array]:
        """Return samples with noise, and the torque without it."""
        motion = random_fourier(self.model, rng=seed, duration=seconds).sample(RATE)
        W = observation_matrix(self.model, motion.q, motion.qd, motion.qdd, drive=self.drive)
        tau = (W @ chi).reshape(len(motion.q), -1)
        width = int(0.05 * RATE) + 1
        noise = np.apply_along_axis(
            lambda e: np.convolve(e, np.ones(width) / np.sqrt(width), "same"),
            0,
            self.rng.standard_normal(tau.shape),
        )
        noisy = tau + NOISE * np.sqrt(np.mean(tau**2, axis=0)) * noise
        samples = Samples(
            t=motion.t,
            q=motion.q,
            qd=motion.qd,
            qdd=motion.qdd,
            tau=noisy,
            rate=RATE,
            joint_names=self.model.joint_names,
            source=f"motion {seed}",
        )
        return samples, tau

    def information(self, chi: Array, seed: int, seconds: float) -> SquareRootInformation:
        """Return the information of a log."""
        return accumulate(self.model, self.base, self.torque(chi, seed, seconds)[0], threads=1)


def error(kind: VirtualKind, beta: Array, chi: Array, seed: int) -> float:
    """Return the relative torque error on another motion."""
    motion = random_fourier(kind.model, rng=seed, duration=20.0).sample(RATE)
    W = observation_matrix(kind.model, motion.q, motion.qd, motion.qdd, drive=kind.drive)
    error = W[:, kind.base.columns] @ (beta - kind.base.values(chi))
    return float(np.linalg.norm(error) / np.linalg.norm(W @ chi))


def scores_of(
    kind: VirtualKind, information: SquareRootInformation, prior: SiblingPrior, chi: Array
) -> list[float]:
    """Return the errors of all parameters in their standard errors; none if it is unlike."""
    found, _ = estimate_with_siblings("new", information, prior)
    if found is None:
        return []
    covariance = derive_posterior_uncertainty(information, found, prior).covariance
    return list((found.beta - kind.base.values(chi)) / np.sqrt(np.diag(covariance)))


def study(name: str, n_siblings: int, n_new: int) -> dict[str, object]:
    """Return median errors of new robots of a type."""
    kind = VirtualKind(name)
    siblings = {
        f"s{i}": kind.information(kind.drawn(kind.type), 100 + i, LONG) for i in range(n_siblings)
    }
    prior = estimate_prior(kind.model, kind.base, siblings)
    errors: dict[str, list[float]] = {
        key: []
        for key in ("siblings 10 s", "wls 10 s", "consistent 10 s", "wls 60 s", "consistent 60 s")
    }
    refused, scores = 0, {SHORT: list[float](), LONG: list[float]()}
    for i in range(n_new):
        chi = kind.drawn(kind.type)
        for seconds in (SHORT, LONG):
            information = kind.information(chi, 1000 + i, seconds)
            data = EstimationData(kind.model, information, None, kind.design, "toward_prior")
            wls = fit_least_squares(information, weights="joint", prior=kind.design)
            errors[f"wls {seconds:.0f} s"].append(error(kind, wls.beta, chi, 5000 + i))
            fit = methods.find("consistent").estimate(data)
            errors[f"consistent {seconds:.0f} s"].append(error(kind, fit.beta, chi, 5000 + i))
            if seconds == SHORT:
                found, _ = estimate_with_siblings("new", information, prior)
                refused += found is None
                beta = fit.beta if found is None else found.beta
                errors["siblings 10 s"].append(error(kind, beta, chi, 5000 + i))
            scores[seconds] += scores_of(kind, information, prior, chi)
    odd = 0
    for i in range(n_new):
        chi = kind.drawn(kind.type)
        n = kind.model.n_joints
        chi[10 * (n - 1) + 9] += TOOL
        chi[10 * (n - 1) + 8] += 0.08 * TOOL
        odd += (
            estimate_with_siblings("odd", kind.information(chi, 2000 + i, SHORT), prior)[0] is None
        )
    return {
        "type": name,
        "coverage_percent": {
            f"{seconds:.0f} s": round(100 * float(np.mean(np.abs(each) < 1.96)), 1)
            for seconds, each in scores.items()
        },
        "worst_score": round(float(np.max(np.abs([*scores[SHORT], *scores[LONG]]))), 1),
        "errors_percent": {key: round(100 * float(np.median(e)), 3) for key, e in errors.items()},
        "refused": f"{refused} of {n_new}",
        "with_a_tool_named": f"{odd} of {n_new}",
        "design_effect": round(prior.design_effect, 2),
        "dispersion": round(prior.dispersion, 2),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--siblings", type=int, default=12)
    parser.add_argument("--new", type=int, default=6)
    given = parser.parse_args()
    for name in TYPES:
        print(json.dumps(study(name, given.siblings, given.new)), flush=True)
