"""What the bodies of a model have beyond CAD: a payload, another mass of a link, and scatter."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg import null_space
from scipy.special import chdtrc, fdtrc

from asbuilt.arrays import Array
from asbuilt.description.appearance import find_size_units
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.identification.effects.families.bodies import LinkMass, Payload
from asbuilt.identification.effects.trials import RULES
from asbuilt.scaled import Scaled
from asbuilt.validation.comparison.cad_tolerance import CadTolerance

# Say how far CAD may scatter, what bodies there may be, and what the data determine.
#
# Scatters are factors on the tolerances of CAD, the last is no CAD at all; amounts are kilograms of
# a payload or shares of a link. Directions whose singular value is below `BODY_WEAKEST`, in the
# largest, are undetermined.

BODY_SCATTERS = (0.05, 100.0)
BODY_AMOUNTS = (0.02, 20.0)
BODY_TRIALS = 40
BODY_WEAKEST = 1e-6
# Farthest centre of a payload from the frame of the link that carries it, in the robot's unit of
# length
BODY_REACH = 1.0
# Sizes of payloads, and distances of their centres from the frame of the link, in that unit
BODY_SIZES = (0.03, 0.1, 0.3)


SCATTERS = np.append(0.0, np.geomspace(*BODY_SCATTERS, BODY_TRIALS))
SHARES = np.maximum(SCATTERS, BODY_SCATTERS[0])
DOUBT = 2.0 * np.log((1.0 + SHARES**2) / (2.0 * SHARES))
"""Minus twice the logarithm of the density of scatters, on a logarithmic scale, less that at 1: a
half-Cauchy prior, as is usual for scales (Gelman, Bayesian Analysis 1, 2006). CAD says how far off
it may be: links that are all off by their mass are less likely than one body."""
AMOUNTS = np.geomspace(*BODY_AMOUNTS, BODY_TRIALS)


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """Hold a body beyond CAD at a link (from 0): its parameters (10,) with their covariance.

    `key` is the effect that it is, `alike` the effects and links that would explain as much. The
    covariance holds the scatter of CAD: the worse the rest agrees with CAD, the less is known.
    """

    key: str
    link: int
    parameters: Array
    covariance: Array
    alike: tuple[tuple[str, int], ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class BodyDifference:
    """Hold the bodies beyond CAD, and whether the links differ from CAD in addition."""

    bodies: tuple[Body, ...] = ()
    links_differ: bool = False


def explain_bodies(
    model: RobotModel,
    base: BaseParameters,
    difference: Array,
    covariance: Array,
    *,
    right_log: bool = True,
) -> BodyDifference:
    """Explain base parameters of links, as built minus CAD, by single bodies and scatter of CAD.

    `d = K z + e + n`: `cov n = C` the errors of the estimate, `cov e = s^2 M` with M the tolerances
    of CAD, `cov z = a^2 G` with G the covariance of a body of unit amount at one link. The body of
    the largest likelihood, over all s and a, is tested by the ratio to the likelihood without it
    (Wilks, Annals of Math. Statistics 9, 1938), at 5 % over all bodies, and becomes part of C;
    others are tested again.

    Parameters
    ----------
    model, base
        The robot by CAD, and its base parameters.
    difference, covariance
        Base parameters (p,) as built minus CAD, those left out NaN, and their covariance (p, p).
    right_log
        Whether no error of the log was found: a wrong gain looks like a heavier link, so that no
        mass of a link is named if there is one.
    """
    # Base parameters of drives have no body in them.
    used = np.flatnonzero((base.columns < 10 * model.n_links) & np.isfinite(difference))
    K = base.regrouping[used]
    # Combinations that rotors and unknown links do not enter.
    seen = null_space(_select_open_columns(model, base)[used].T)
    if not seen.shape[1]:
        return BodyDifference()
    d = seen.T @ difference[used]
    C = seen.T @ covariance[np.ix_(used, used)] @ seen
    M = seen.T @ CadTolerance().covariance(model, base)[np.ix_(used, used)] @ seen
    K = (seen.T @ K)[:, : 10 * model.n_links].reshape(len(d), -1, 10)
    left = [
        candidate
        for candidate in _list_candidates(model)
        if right_log or candidate.key == Payload.key
    ]
    found = list[Body]()
    while True:
        # C grows with each body found, so that the rest is scaled anew.
        scale = _Scale.of(d, C, M)
        alone = scale.fit(np.zeros((len(d), 1)))
        fits = [(candidate, scale.fit(K[:, candidate.link] @ candidate.root)) for candidate in left]
        fits = [(candidate, fit) for candidate, fit in fits if candidate.is_possible(fit)]
        if not fits:
            break
        best, fit = min(fits, key=lambda pair: pair[1].least)
        gain = alone.least - fit.least
        # Twice the level, since amounts are not negative.
        if _evaluate_chance(gain, len(d)) * len(left) >= 2.0 * RULES.level:
            break
        alike = {
            (candidate.key, candidate.link): None
            for candidate, other_fit in fits
            if candidate.link != best.link and alone.least - other_fit.least > RULES.alike * gain
        }
        mean = fit.mean(best.root)
        spread = fit.covariance(best.root)
        found.append(Body(best.key, best.link, mean, spread, tuple(alike)))
        added = K[:, best.link] @ best.root * fit.amount
        # What is explained becomes part of the errors: others are tested next to it.
        C = C + added @ added.T
        left = [candidate for candidate in left if candidate.link != best.link]
    # Without the prior of the scatter: do the data alone ask for one?
    by_data = alone.deviance - DOUBT[:, None]
    ratio = by_data[0].min() - by_data.min()
    return BodyDifference(tuple(found), float(chdtrc(1, max(ratio, 0.0))) < RULES.level)


def _select_open_columns(model: RobotModel, base: BaseParameters) -> Array:
    """Return the columns of what CAD says nothing of: drives, and links without mass.

    A rotor is part of the inertia about its axis. Offsets are small next to weights: they hide no
    mass that a vertical slide carries.
    """
    unknown = np.repeat([not link.has_mass for link in model.links], 10)
    symbols = [s for term in base.drive.terms if term.key != "offset" for s in term.symbols]
    drives = [name.rstrip("0123456789") in symbols for name in base.standard_names[len(unknown) :]]
    columns = base.regrouping[:, np.concatenate([unknown, np.array(drives, dtype=np.bool_)])]
    return np.asarray(columns[:, np.abs(columns).max(axis=0, initial=0.0) > 0.0])


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """Hold a body that may be there: its link, and S (10, m) with `S S^T` of a unit amount."""

    key: str
    link: int
    root: Array
    lighter: bool = False
    reach: float = BODY_REACH

    def is_possible(self, fit: _Fit) -> bool:
        """Return whether a payload has mass within reach, or a link less than twice its own.

        What is heavier carries something, as a heavier tool link does.
        """
        # Ten parameters end with the mass.
        z = fit.mean(self.root)
        if self.key == Payload.key:
            # Rounding can leave the variance of a mass that the data hardly see below zero.
            variance = max(float(fit.covariance(self.root)[9, 9]), 0.0)
            heavy = z[9] > RULES.sure * np.sqrt(variance)
            return bool(heavy and np.linalg.norm(z[6:9]) <= self.reach * z[9])
        mass = float(self.root[9, 0])
        return bool(-mass < z[9] < (0.0 if self.lighter else mass))


def _list_candidates(model: RobotModel) -> Iterator[_Candidate]:
    """Yield payloads of some sizes r, with variances of `1, r^2, r^4`, and links made heavier."""
    units = find_size_units(model)
    reach = BODY_REACH * units.length
    for share in BODY_SIZES:
        size = share * units.length
        link_root = units.mass * np.diag(np.repeat([size**2, size, 1.0], [6, 3, 1]))
        yield _Candidate(Payload.key, model.tool_link, link_root, reach=reach)
    for k, link in enumerate(model.links):
        if link.has_mass:
            link_root = link.inertia.parameters[:, None]
            # At the tool link what is heavier is a payload.
            yield _Candidate(LinkMass.key, k, link_root, k == model.tool_link)


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Hold minus twice the logarithm of likelihood and prior by scatter and amount (S, A).

    `means` (S, m) and `covariances` (S, m, m) describe the coefficients of a body that is there
    for sure, of the largest amount: by a smaller one they are drawn to zero.
    """

    deviance: Array
    means: Array
    covariances: Array

    @property
    def least(self) -> float:
        """The least deviance."""
        return float(self.deviance.min())

    @property
    def amount(self) -> float:
        """The amount of the largest likelihood."""
        return float(AMOUNTS[np.unravel_index(self.deviance.argmin(), self.deviance.shape)[1]])

    def mean(self, root: Array) -> Array:
        """Return the body's parameters (10,)."""
        return np.asarray(root @ (self._weights @ self.means))

    def covariance(self, root: Array) -> Array:
        """Return their covariance (10, 10)."""
        away = self.means - self._weights @ self.means
        # Covariance within scatters, and between their means.
        inner = np.einsum("s,smn->mn", self._weights, self.covariances)
        between = np.einsum("s,sm,sn->mn", self._weights, away, away)
        return np.asarray(root @ (inner + between) @ root.T)

    @property
    def _weights(self) -> Array:
        """Probabilities of the scatters: one that is taken as certain understates errors."""
        likelihood = np.exp(-0.5 * (self.deviance.min(axis=1) - self.least))
        return np.asarray(likelihood / likelihood.sum())


@dataclass(frozen=True, slots=True, eq=False)
class _Scale:
    """Hold a difference with the covariance `1 + s^2 diag(spread)`, and what turned it so."""

    turn: Array
    y: Array
    spread: Array

    @classmethod
    def of(cls, d: Array, C: Array, M: Array) -> _Scale:
        """Return the difference of covariance `C + s^2 M`."""
        # Whitened by the errors, then turned so that CAD's scatter is diagonal.
        white = Scaled(C).raised(BODY_WEAKEST**2).inverse_root
        spread, own = np.linalg.eigh(white.T @ M @ white)
        turn = (white @ own).T
        # Rounding leaves eigenvalues just below zero.
        return cls(turn, turn @ d, np.maximum(spread, 0.0))

    def fit(self, columns: Array) -> _Fit:
        """Fit columns (d, m) with coefficients of variance a^2, for all scatters and amounts.

        With `X = U diag(w) V^T` after division by the standard deviations, the logarithm of the
        determinant grows by `log(1 + a^2 w^2)`, and each `(U^T y)^2` counts `1 / (1 + a^2 w^2)`.
        """
        root = np.sqrt(1.0 + SCATTERS[:, None] ** 2 * self.spread)
        X = (self.turn @ columns) / root[:, :, None]
        y = self.y / root
        U, w, Vt = np.linalg.svd(X, full_matrices=False)  # one for each scatter
        along = np.einsum("sdm,sd->sm", U, y)
        g = AMOUNTS[:, None] ** 2 * w[:, None] ** 2
        kept = 1.0 / (1.0 + g)
        explained = ((1.0 - kept) @ along[..., None] ** 2)[..., 0]
        # -2 log L without the body: log determinant, and squares.
        unexplained = DOUBT[:, None] + (2.0 * np.log(root) + y**2).sum(axis=1, keepdims=True)
        # A body that is there for sure has the largest amount: a wide prior.
        largest = AMOUNTS[-1] ** 2
        left = kept[:, -1]
        means = np.einsum("sm,smn->sn", largest * left * w * along, Vt)
        inner = np.eye(columns.shape[1]) + np.einsum("smk,sm,smn->skn", Vt, left - 1.0, Vt)
        return _Fit(unexplained + np.log1p(g).sum(axis=2) - explained, means, largest * inner)


def _evaluate_chance(ratio: float, count: int) -> float:
    """Return the probability of a likelihood ratio by chance, by F: the scatter is estimated."""
    freedom = max(count - 1, 1)
    # The ratio of variances by F, as the scatter is estimated from as few numbers.
    return float(fdtrc(1, freedom, np.expm1(max(ratio, 0.0) / max(count, 1)) * freedom))
