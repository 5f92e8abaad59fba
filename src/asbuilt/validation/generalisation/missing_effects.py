"""Effects that the model lacks and the recording shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.findings import Cure, Finding, joined
from asbuilt.identification.errors.block_scatter import student_probability, widening
from asbuilt.identification.information.cause_data import TILTS, CauseData
from asbuilt.identification.information.triangular import triangular_factor
from asbuilt.validation.comparison.significance import holm
from asbuilt.validation.generalisation.effect_evidence import own_evidence, tilt_evidence

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples
    from asbuilt.identification.result.result import IdentificationResult


@dataclass(frozen=True, slots=True)
class EffectRule:
    """Say when an effect is named.

    `level` is the familywise error over all effects (Holm), `confirmed` that of a fit with the
    effect and its own standard error from time blocks (Bonferroni). A base tilt needs `tilt` of
    its standard errors, as `find_mounting` does. An effect less than `separate` of which, in
    torque, lies outside the columns of the model has no bias that data could show.
    """

    level: float = 0.01
    confirmed: float = 0.05
    tilt: float = 4.0
    separate: float = 1e-3


RULE = EffectRule()
TILT = "base tilt"


@dataclass(frozen=True, slots=True)
class MissingEffect:
    """Hold an effect at a joint (None: of the base) and its size in standard errors."""

    effect: str
    joint: str | None
    sigmas: float
    holm: float


def missing_effects(result: IdentificationResult) -> tuple[MissingEffect, ...]:
    """Return the effects that are significant beside the model, the surest first.

    Each column v of the cause data that the model lacks is added alone: `z = v'^T e / (s |v'|)`, v'
    its part outside the columns of the model, e the residual (a score test: Rao 1948). s^2 is the
    residual variance times the design effect of the parameters, so that correlated residuals are
    allowed for.
    """
    data = result.cause_data
    if data is None:
        return ()
    with one_blas_thread():
        columns = _lacking(data, result)
        if not columns:
            return ()
        inside, e = _outside(data, result, list(columns))
    length = np.linalg.norm(inside, axis=0)
    variance = float(e @ e) / max((data.n_fitted + data.n_judged) * data.n_joints - result.rank, 1)
    growth, freedom = _growth(result)
    kept = np.flatnonzero(length > 0.0)
    if variance <= 0.0 or not kept.size:
        return ()
    sigmas = (inside[:, kept].T @ e) / (length[kept] * np.sqrt(variance) * growth)
    freedoms = np.full(len(kept), freedom)
    strict = holm(student_probability(sigmas / widening(freedoms), freedoms))
    places = list(columns.values())
    found = [
        MissingEffect(*places[k], float(abs(z)), float(p))
        for k, z, p in zip(kept.tolist(), sigmas, strict, strict=True)
        if p <= RULE.level
    ]
    return tuple(sorted(found, key=lambda each: -each.sigmas))


def confirmed_effects(
    result: IdentificationResult,
    training: Sequence[Samples],
    *,
    block_seconds: float | None = None,
) -> tuple[MissingEffect, ...]:
    """Return the missing effects that a fit with each drive term confirms, the surest first.

    The score test takes one design effect for all columns, though residuals are correlated more
    along some: so 3 of 20 fault-free recordings had a missing effect. The fit has an own standard
    error of each effect.
    """
    suspected = missing_effects(result)
    if not suspected or result.cause_data is None:
        return suspected
    count, names = len(_lacking(result.cause_data, result)), result.cause_data.joint_names
    kept = [each for each in suspected if each.joint is None]
    if kept:
        axes = result.cause_data.tilt_axes
        tilt = tilt_evidence(result, training, axes, block_seconds=block_seconds)
        kept = [] if tilt < RULE.tilt else [replace(kept[0], sigmas=min(tilt, kept[0].sigmas))]
    for key in dict.fromkeys(each.effect for each in suspected if each.joint is not None):
        own = {
            names.index(each.joint): each
            for each in suspected
            if each.effect == key and each.joint is not None
        }
        evidence = own_evidence(result, training, key, sorted(own), block_seconds=block_seconds)
        for k, (sigmas, p) in evidence.items():
            if count * p <= RULE.confirmed:
                kept.append(replace(own[k], sigmas=min(sigmas, own[k].sigmas)))
    return tuple(sorted(kept, key=lambda each: -each.sigmas))


def missing_effect_findings(
    result: IdentificationResult, found: Sequence[MissingEffect], *, counted: bool
) -> tuple[Finding, ...]:
    """Return one finding that names the effects which the model lacks.

    `counted` says that the standard errors include their bias.
    """
    if not found:
        return ()
    keys = dict.fromkeys(each.effect for each in found)
    terms = [effect for effect in keys if effect != TILT]
    settings: Mapping[str, str] = (
        {"drive": ",".join((*result.base.drive.specifications, *terms))} if terms else {}
    ) | ({"mounting": "estimate"} if TILT in keys else {})
    return (
        Finding(
            "missing_effect",
            "warning",
            f"The recording shows effects that the model lacks: {effects_text(found)} (up to"
            f" {found[0].sigmas:.1f} standard errors). Standard errors"
            f" {'include' if counted else 'do not hold'} their bias",
            Cure("identify with them", dict(settings)),
        ),
    )


def effects_text(effects: Sequence[MissingEffect]) -> str:
    """Return effects and their joints as text."""
    joints: dict[str, list[str]] = {}
    for each in effects:
        joints.setdefault(each.effect, []).extend([each.joint] if each.joint else [])
    return joined(
        [f"{effect} at {joined(at, 4)}" if at else effect for effect, at in joints.items()]
    )


def _growth(result: IdentificationResult) -> tuple[float, float]:
    """Return block error over textbook error, typical of all parameters, and how well it is known.

    The latter as degrees of freedom: those of the parameters together, less what is common to all.
    """
    growth = max(result.errors.growth or 1.0, 1.0)
    if result.scatter is None:
        return growth, np.inf
    narrow = growth / float(np.median(widening(result.degrees_of_freedom)))
    together = result.rank * float(np.median(result.scatter.degrees_alone))
    return max(narrow, 1.0), 2.0 / (2.0 / together + result.scatter.common_variance)


def _lacking(data: CauseData, result: IdentificationResult) -> dict[str, tuple[str, str | None]]:
    """Return the columns that the model lacks, with the effect and joint of each."""
    terms = {
        name: (term.key, data.joint_names[k])
        for k in range(data.n_joints)
        for term in data.drive.terms
        for name in (f"{symbol}{k + 1}" for symbol in term.symbols)
    }
    tilts: dict[str, tuple[str, str | None]] = dict.fromkeys(TILTS, (TILT, None))
    known = set(result.base.names)
    candidates = {**terms, **({} if "mounting" in result.corrected else tilts)}
    return {
        name: candidates[name] for name in data.names if name in candidates and name not in known
    }


def _outside(
    data: CauseData, result: IdentificationResult, columns: list[str]
) -> tuple[Array, Array]:
    """Return the parts of columns and torque outside those of the model, (rows, m) and (rows,)."""
    own, further = data.places(result.base.names), data.places(columns)
    chosen = np.concatenate([own, further, [len(data.names)]])
    rows = [
        weight * factor[:, chosen]
        for factors in (data.fitted, data.judged)
        for weight, factor in zip(result.weights, data.whole(factors), strict=True)
    ]
    stacked = np.vstack(rows)
    scale = np.linalg.norm(stacked, axis=0)
    p = len(own)
    R = triangular_factor(stacked / np.where(scale > 0.0, scale, 1.0))
    inside = R[p:, p:-1].copy()
    inside[:, np.linalg.norm(inside, axis=0) < RULE.separate] = 0.0
    return inside, np.asarray(R[p:, -1] * scale[-1])
