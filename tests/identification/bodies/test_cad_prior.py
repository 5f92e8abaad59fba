"""The prior made of CAD.

Its divergence against that of Gaussian densities, frames, units, and descriptions that are
impossible or silent.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.description import LinkInertia, bundled_robot, robot_names
from asbuilt.description.inertia import pseudo_inertias
from asbuilt.dynamics import DriveSet
from asbuilt.dynamics.drives.drive_set import NO_DRIVE
from asbuilt.identification import build_cad_prior
from asbuilt.identification.bodies.cad_prior import smat, svec


def changed(model, number, **fields):
    links = list(model.links)
    links[number] = replace(links[number], **fields)
    return replace(model, links=tuple(links))


@pytest.mark.parametrize("name", robot_names())
def test_every_prior_body_is_real_and_at_no_distance_from_itself(name):
    prior = build_cad_prior(bundled_robot(name), DriveSet.parse("armature,viscous,coulomb,offset"))
    assert np.linalg.eigvalsh(prior.pseudo_inertias).min() > 0
    np.testing.assert_allclose(prior.divergence(prior.parameters), 0.0, atol=1e-9)
    np.testing.assert_allclose(prior.relative_eigenvalues(prior.parameters), 1.0, atol=1e-9)


def test_divergence_is_twice_that_of_gaussian_densities(around_cad):
    """Relative entropy of N(0, P) from N(0, P0) by Monte Carlo: the mean log ratio of densities."""
    rng = np.random.default_rng(0)
    prior = build_cad_prior(bundled_robot("two-link"), NO_DRIVE)
    chi = around_cad(prior, rng, 0.2)
    P, P0 = pseudo_inertias(chi[:10]), prior.pseudo_inertias[0]
    x = rng.normal(size=(400_000, 4)) @ np.linalg.cholesky(P).T
    log_ratio = 0.5 * (
        np.einsum("ni,ij,nj->n", x, np.linalg.inv(P0) - np.linalg.inv(P), x)
        + np.linalg.slogdet(P0)[1]
        - np.linalg.slogdet(P)[1]
    )
    error = log_ratio.std() / np.sqrt(len(x))
    assert 2.0 * log_ratio.mean() == pytest.approx(prior.divergence(chi)[0], abs=10.0 * error)


def test_divergence_and_metric_do_not_depend_on_frame_or_unit(around_cad):
    rng = np.random.default_rng(1)
    prior = build_cad_prior(bundled_robot("kuka-iiwa7-r800"), NO_DRIVE)
    chi = around_cad(prior, rng, 0.3)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn * np.sign(np.linalg.det(turn)), rng.normal(size=3)

    def elsewhere(parameters):
        return np.concatenate(
            [LinkInertia(body).moved(T).parameters for body in parameters.reshape(-1, 10)]
        )

    moved = replace(prior, parameters=elsewhere(prior.parameters))
    np.testing.assert_allclose(moved.divergence(elsewhere(chi)), prior.divergence(chi), rtol=1e-8)
    grams = np.array([1000.0] * 10 * 7)
    np.testing.assert_allclose(
        replace(prior, parameters=grams * prior.parameters).divergence(grams * chi),
        prior.divergence(chi),
        rtol=1e-9,
    )
    step = chi - prior.parameters
    here = np.einsum("na,nab,nb->n", step.reshape(7, 10), prior.metric, step.reshape(7, 10))
    there = np.einsum(
        "na,nab,nb->n",
        (elsewhere(chi) - moved.parameters).reshape(7, 10),
        moved.metric,
        (elsewhere(chi) - moved.parameters).reshape(7, 10),
    )
    np.testing.assert_allclose(there, here, rtol=1e-7)


def test_metric_is_the_curvature_of_the_divergence(around_cad):
    rng = np.random.default_rng(2)
    prior = build_cad_prior(bundled_robot("kuka-iiwa7-r800"), NO_DRIVE)
    step = 1e-3 * (around_cad(prior, rng, 0.3) - prior.parameters)
    curved = prior.divergence(prior.parameters + step) + prior.divergence(prior.parameters - step)
    np.testing.assert_allclose(
        curved,
        np.einsum("na,nab,nb->n", step.reshape(7, 10), prior.metric, step.reshape(7, 10)),
        rtol=1e-4,
    )


def test_svec_keeps_the_inner_product():
    rng = np.random.default_rng(3)
    A, B = (M + M.T for M in rng.normal(size=(2, 4, 4)))
    assert svec(A) @ svec(B) == pytest.approx(np.trace(A @ B))
    np.testing.assert_allclose(smat(svec(A)), A)


def test_links_without_mass_are_guessed_and_count_less():
    model = bundled_robot("puma-560")
    prior = build_cad_prior(model, NO_DRIVE)
    assert prior.strength.tolist() == [0.1, 1.0, 1.0, 1.0, 1.0, 1.0]
    assert "no mass" in prior.notes[0]
    silent = changed(bundled_robot("two-link"), 1, inertia=LinkInertia.zero(), inertia_known=False)
    assert build_cad_prior(silent, NO_DRIVE).parameters[19] == pytest.approx(
        silent.links[0].inertia.mass
    )


def test_a_negative_mass_is_reported():
    model = bundled_robot("two-link")
    chi = np.array(model.parameters)
    chi[9] = -1.5
    prior = build_cad_prior(model.with_parameters(chi), NO_DRIVE)
    assert prior.notes[0].startswith(f"{model.link_names[0]} has a mass of -1.5 kg in CAD")
    assert prior.parameters[9] > 0.0


def test_bodies_without_thickness_and_impossible_ones_are_mended():
    model = bundled_robot("two-link")
    for inertia in (
        LinkInertia.from_com(2.0, [0.1, 0.0, 0.0], np.zeros((3, 3))),
        LinkInertia.from_com(2.0, [0.1, 0.0, 0.0], np.diag([0.1, 0.2, 0.3])),
        LinkInertia.from_com(2.0, [0.1, 0.0, 0.0], np.diag([0.1, 0.1, 0.5])),
    ):
        prior = build_cad_prior(changed(model, 0, inertia=inertia), NO_DRIVE)
        body = LinkInertia(prior.parameters[:10])
        assert body.mass == 2.0
        np.testing.assert_allclose(body.com, [0.1, 0.0, 0.0])
        assert body.principal_moments.min() > 0
        assert np.linalg.eigvalsh(body.pseudo_inertia).min() > 0
        assert "corrected" in prior.notes[0]
