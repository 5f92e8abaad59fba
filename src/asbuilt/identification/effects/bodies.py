"""What the bodies of a model have beyond CAD: a payload, and the scatter of CAD itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, fdtrc

from asbuilt.arrays import Array
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.identification.bodies.cad_prior import CadPrior
from asbuilt.identification.effects.selection import RULES


@dataclass(frozen=True, slots=True)
class BodyRules:
    """Say how far CAD may scatter, and what the data determine.

    Scatters are shares of the metric of `CadPrior`; the last is no CAD at all. Directions whose
    singular value is below `weakest`, in the largest, are undetermined.
    """

    least: float = 3e-3
    most: float = 10.0
    trials: int = 60
    weakest: float = 1e-6
    reach: float = 1.0
    """Farthest centre of a payload from the frame of the link that carries it [m]."""


BODIES = BodyRules()


@dataclass(frozen=True, slots=True, eq=False)
class BodyDifference:
    """Hold the payload (10,) with its covariance, and whether the links differ from CAD beside it.

    Without a payload, its values are zero. The covariance holds the scatter of CAD: the worse the
    rest agrees with CAD, the less the mass of a payload is known.
    """

    payload: Array
    covariance: Array
    links_differ: bool

    @property
    def has_payload(self) -> bool:
        """Whether there is one."""
        return bool(self.payload.any())


def explain_bodies(
    base: BaseParameters, prior: CadPrior, tool: int, difference: Array, covariance: Array
) -> BodyDifference:
    """Explain base parameters of links, as built minus CAD, by a payload and by scatter of CAD.

    `d = K z + e + n`: K the columns of the link that carries the payload z, `cov n = C` the errors
    of the estimate, `cov e = s^2 M` with M the inverse metric of the prior. For each scatter s, z
    follows by generalised least squares. Both are tested by their likelihood ratio (Wilks, Annals
    of Math. Statistics 9, 1938).

    Parameters
    ----------
    base, prior, tool
        Base parameters, CAD, and the link that carries a payload, from 0.
    difference, covariance
        Base parameters (p,) as built minus CAD, those left out NaN, and their covariance (p, p).
    """
    links = 10 * prior.n_links
    used = np.flatnonzero((base.columns < links) & np.isfinite(difference))
    if not used.size:
        return BodyDifference(np.zeros(10), np.zeros((10, 10)), False)
    d, C = difference[used], covariance[np.ix_(used, used)]
    K = base.regrouping[used, :links].reshape(-1, prior.n_links, 10)
    M = np.einsum("pia,iab,qib->pq", K, np.linalg.inv(prior.metric), K)
    size = np.sqrt(np.diag(C))
    values, axes = np.linalg.eigh(C / np.outer(size, size))
    white = axes / np.sqrt(np.maximum(values, BODIES.weakest**2 * values[-1])) / size[:, None]
    spread, turn = np.linalg.eigh(white.T @ M @ white)
    y, X = (white @ turn).T @ d, (white @ turn).T @ K[:, tool]
    alone, carried = _fits(y, X[:, :0], spread), _fits(y, X, spread)
    best, other = min(carried, key=_deviance), min(alone, key=_deviance)
    count = len(d) if best.scatter else np.inf
    p_value = _by_chance(max(other.deviance - best.deviance, 0.0), best.rank, count)
    z, cov = _averaged(carried[1:])
    possible = z[9] > 0.0 and float(np.linalg.norm(z[6:9])) <= BODIES.reach * z[9]
    if not (p_value < RULES.level and possible):
        z, cov, carried, best = np.zeros(10), np.zeros((10, 10)), alone, other
    ratio = carried[0].deviance - best.deviance
    return BodyDifference(z, cov, _by_chance(ratio, 1, np.inf) < RULES.level)


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Hold z, its covariance and rank for a scatter, and minus twice the logarithm of likelihoods.

    `restricted` is that of residuals (Harville, J. Am. Stat. Assoc. 72, 1977).
    """

    scatter: float
    deviance: float
    restricted: float
    z: Array
    covariance: Array
    rank: int


def _deviance(fit: _Fit) -> float:
    return fit.deviance


def _fits(y: Array, X: Array, spread: Array) -> list[_Fit]:
    """Fit `y = X z + v` with variances `1 + s^2 spread` for every scatter s, the first without."""
    length = np.linalg.norm(X, axis=0)
    length = np.where(length > BODIES.weakest * length.max(initial=0.0), length, np.inf)
    found = []
    for s in (0.0, *np.geomspace(BODIES.least, BODIES.most, BODIES.trials).tolist()):
        variance = 1.0 + s**2 * np.maximum(spread, 0.0)
        root = np.sqrt(variance)
        U, sizes, Vt = np.linalg.svd(X / length / root[:, None], full_matrices=False)
        kept = sizes > BODIES.weakest * sizes.max(initial=0.0)
        back = Vt[kept].T / sizes[kept] / length[:, None]
        z = back @ (U[:, kept].T @ (y / root))
        left = (y - X @ z) / root
        deviance = float(np.log(variance).sum() + left @ left)
        restricted = deviance + 2.0 * float(np.log(sizes[kept]).sum())
        found.append(_Fit(s, deviance, restricted, z, back @ back.T, int(kept.sum())))
    return found


def _averaged(fits: Sequence[_Fit]) -> tuple[Array, Array]:
    """Return z and its covariance over scatters, equally likely before on a logarithmic scale.

    A scatter that is taken as certain understates errors.
    """
    restricted = np.array([each.restricted for each in fits])
    weight = np.exp(-0.5 * (restricted - restricted.min()))
    weight /= weight.sum()
    z = np.einsum("s,si->i", weight, np.array([each.z for each in fits]))
    away = np.array([each.z - z for each in fits])
    inner = np.einsum("s,sij->ij", weight, np.array([each.covariance for each in fits]))
    return z, inner + np.einsum("s,si,sj->ij", weight, away, away)


def _by_chance(ratio: float, rank: int, count: float) -> float:
    """Return the probability of a likelihood ratio by chance, by F if a variance is estimated."""
    if not np.isfinite(count):
        return float(chdtrc(max(rank, 1), max(ratio, 0.0)))
    freedom = max(count - rank, 1.0)
    return float(fdtrc(max(rank, 1), freedom, np.expm1(ratio / count) * freedom / max(rank, 1)))
