"""Fixtures of this room.

Robots whose bodies differ from their description, moved along an exact motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from three_links import DRIVE, arm, truth

from asbuilt.description import LinkInertia, load_robot
from asbuilt.dynamics import DriveSet, find_base_parameters, observation_matrix
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Samples
from asbuilt.identification import build_cad_prior
from asbuilt.identification.information.square_root_information import accumulate

FULL = "armature,viscous,coulomb,offset"


@pytest.fixture(scope="session")
def robot():
    """The robot of three links, its base parameters and their true values."""
    model = arm()
    base = find_base_parameters(model, DRIVE)
    return model, base, truth(base, model)


@dataclass(frozen=True)
class Trial:
    model: object
    base: object
    prior: object
    chi: np.ndarray
    samples: Samples
    information: object

    @property
    def beta(self):
        return self.base.values(self.chi)


def real_bodies(prior, rng, spread=0.1):
    """Bodies around CAD: each pseudo-inertia rotated and scaled at random, drives positive."""
    chi = prior.parameters.copy()
    for i in range(prior.n_links):
        L = np.linalg.cholesky(LinkInertia(chi[10 * i : 10 * i + 10]).pseudo_inertia)
        A = np.eye(4) + spread * rng.normal(size=(4, 4))
        P = L @ A @ A.T @ L.T
        chi[10 * i : 10 * i + 10] = LinkInertia.from_pseudo_inertia(0.5 * (P + P.T)).parameters
    chi[10 * prior.n_links :] = rng.uniform(0.1, 1.0, len(chi) - 10 * prior.n_links)
    return chi


def make_trial(
    robot, drive=FULL, *, noise=0.0, seed=0, duration=20.0, spread=0.1, chi=None, rate=25.0
):
    """A robot with real bodies of its own, and what a motion of it with white noise (a fraction of
    each joint's torque) tells.
    """
    rng = np.random.default_rng(seed)
    model = load_robot(robot) if isinstance(robot, str) else robot
    base = find_base_parameters(model, DriveSet.parse(drive))
    prior = build_cad_prior(model, base.drive)
    chi = real_bodies(prior, rng, spread) if chi is None else chi
    motion = random_fourier(model, rng=rng, duration=duration).sample(rate)
    W = observation_matrix(
        model, motion.q, motion.qd, motion.qdd, drive=base.drive, columns=base.columns
    )
    tau = (W @ base.values(chi)).reshape(motion.q.shape)
    tau = tau + noise * np.sqrt(np.mean(tau**2, axis=0)) * rng.normal(size=tau.shape)
    samples = Samples(
        t=motion.t,
        q=motion.q,
        qd=motion.qd,
        qdd=motion.qdd,
        tau=tau,
        rate=rate,
        joint_names=model.joint_names,
        segments=((0, len(motion.t)),),
    )
    return Trial(model, base, prior, chi, samples, accumulate(model, base, samples))


@pytest.fixture(scope="session")
def trial():
    """The function that makes trials."""
    return make_trial


@pytest.fixture(scope="session")
def around_cad():
    """The function that draws real bodies around CAD."""
    return real_bodies
