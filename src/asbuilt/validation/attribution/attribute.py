"""Attribution of the torque error of CAD to what a model has beyond CAD."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.errors import ResultError
from asbuilt.findings import Cure, join_names
from asbuilt.identification.effects.effect import (
    EFFECTS,
    LINKS,
    FoundEffect,
    find_group,
    locate_drive_parameters,
    name_group,
)
from asbuilt.identification.effects.families.bodies import LinkMass, Payload
from asbuilt.identification.information.cause_data import TILT, CauseData
from asbuilt.identification.result.feasible import bound_effects
from asbuilt.identification.result.result import IdentificationResult, Identified
from asbuilt.identification.screen import format_size
from asbuilt.tables import format_plus_minus
from asbuilt.validation.attribution.attribution import NAMED_SHARE, Attribution, EffectShare
from asbuilt.validation.attribution.body_differences import Body, BodyDifference, explain_bodies
from asbuilt.validation.comparison.comparison import FALSE_DISCOVERY_RATE, recording_name
from asbuilt.validation.comparison.equal_terms import select_tested_values
from asbuilt.validation.comparison.significance import holm
from asbuilt.validation.prediction import derive_cad_values, torque_units

BODIES = (Payload.key, LinkMass.key)


def can_attribute(result: IdentificationResult) -> bool:
    """Return whether a result has what its causes follow from, and joints that stand for links."""
    return result.cause_data is not None and not result.model.mixes_joints


def attribute(
    result: IdentificationResult | Identified, cad: RobotModel | None = None
) -> Attribution:
    """Attribute the torque error of CAD to the effects that the model of a result has.

    With y_i the torque of what effect i adds to CAD, `e = tau - tau_CAD` and `r = e - sum y`, the
    share of effect i in the drop |e|^2 - |r|^2 is its Shapley value `y_i . (e + r)` (Shapley,
    1953). CAD is the description as given, without a tilt that was found. Sizes and errors are
    the result's; `explain_bodies` divides what bodies have beyond CAD.

    Parameters
    ----------
    result
        A result with `cause_data`.
    cad
        Another description of the same geometry; None: the one identified with.

    Returns
    -------
    Attribution
        Shares and sizes of the effects.

    Raises
    ------
    ResultError
        If the result has no cause data.
    """
    result = result.result
    data = result.cause_data
    if data is None:
        raise ResultError(
            f"this result of {result.robot} has no cause data; `identify` gathers them from"
            " recordings of at least some seconds",
            cure=Cure("identify again from a longer recording", call="identify"),
        )
    by_design = result.cad_values if cad is None else derive_cad_values(result, cad)
    bodies = _estimate_bodies(result, cad or result.model, by_design)
    # Parameters without a CAD value count as zero: all of them is change.
    values = np.nan_to_num(by_design)
    changes = _list_changes(result, values, bodies)
    e, y, torque = _predict_torques(result, data, values, changes)
    left = e - sum(y.values(), np.zeros_like(e))
    # A joint without error has no shares; dividing by infinity leaves zero.
    energy = np.sum(e**2, axis=1)
    energy = np.where(energy > 0.0, energy, np.inf)
    # Shapley's value of a sum of torques: y . (e + r) / |e|^2.
    parts = {
        key: np.sum(torque_of_effect * (e + left), axis=1) / energy
        for key, torque_of_effect in y.items()
    }
    sure = _find_significant(result, values, changes, bodies)
    added = {str(k): _regroup_body(result, body) for k, body in enumerate(bodies.bodies)}
    _, separate, _ = _predict_torques(result, data, values, added)
    single = bound_effects(
        result, _find_single_bodies(result, bodies, separate, left, torque, data.n_judged)
    )
    shares = [
        EffectShare(
            key,
            part,
            _word_sizes(result, key, values, single),
            sure[key] and bool(np.any(part >= NAMED_SHARE)),
        )
        for key, part in parts.items()
    ]
    return Attribution(
        robot=result.robot,
        joint_names=data.joint_names,
        units=torque_units(result.model),
        judged_by=recording_name(data.judged_by),
        torque=_evaluate_rms(torque, data.n_judged),
        rms_cad=_evaluate_rms(e, data.n_judged),
        rms_chosen=_evaluate_rms(left, data.n_judged),
        shares=tuple(sorted(shares, key=lambda cause: -float(cause.share @ np.sum(e**2, axis=1)))),
        unexplained=np.sum(left**2, axis=1) / energy,
        payload=next(
            (body_effect for body_effect in single if body_effect.effect == Payload.key), None
        ),
        masses=tuple(body_effect for body_effect in single if body_effect.effect == LinkMass.key),
        effects=tuple(
            other_effect for other_effect in result.effects if other_effect.effect not in BODIES
        ),
    )


def _predict_torques(
    result: IdentificationResult, data: CauseData, values: Array, changes: Mapping[str, Array]
) -> tuple[Array, dict[str, Array], Array]:
    """Return the error of CAD (n, R), what each effect adds to CAD (n, R), and the torque (n, R).

    They are rotated by the factors of held-out data, which leaves sums of squares as they are.
    """
    # The tilt's column is not among the base parameters.
    tilts = [TILT] * (TILT in data.names)
    places = data.places([*result.base.names, *tilts])
    terms = block_diag(np.column_stack([values, *changes.values()]), np.eye(len(tilts)))
    terms[len(values) :, 0] = -1.0  # columns of links hold under the gravity of the tilt
    rows = data.whole(data.judged)
    both = np.zeros((1 + terms.shape[1], len(rows), max(map(len, rows))))
    for k, factor in enumerate(rows):
        both[0, k, : len(factor)] = factor[:, -1]
        both[1:, k, : len(factor)] = (factor[:, places] @ terms).T
    return both[0] - both[1], dict(zip([*changes, *tilts], both[2:], strict=True)), both[0]


# Of sums of squares: rotated rows have no samples of their own.
def _evaluate_rms(torque: Array, n: int) -> Array:
    return np.asarray(np.linalg.norm(torque, axis=-1) / np.sqrt(n))


def _estimate_bodies(
    result: IdentificationResult, cad: RobotModel, by_design: Array
) -> BodyDifference:
    """Return what the bodies have beyond CAD, by estimates without regularisation."""
    free = select_tested_values(result)
    # Dropped and undetermined values say nothing of bodies.
    known = free.determined & ~free.dropped & (free.std_errors > 0.0)
    difference = np.where(known, free.estimates - by_design, np.nan)
    wrong = any(EFFECTS[other_effect.effect].of_log for other_effect in result.effects)
    found = explain_bodies(cad, result.base, difference, free.covariance, right_log=not wrong)
    named = tuple(body for body in found.bodies if _is_supported(result, cad, body))
    return replace(found, bodies=named, links_differ=found.links_differ or named != found.bodies)


def _is_supported(result: IdentificationResult, cad: RobotModel, body: Body) -> bool:
    """Return whether a body is a payload, or no consistent bodies give the link its CAD mass."""
    if body.key == Payload.key:
        return True
    link = cad.links[body.link]
    interval = result.feasible("mass", link.name, explained=False)
    return not interval.holds(float(link.inertia.mass))


def _list_changes(
    result: IdentificationResult, values: Array, bodies: BodyDifference
) -> dict[str, Array]:
    """Return what each effect adds to the base parameters of CAD, (p,) each."""
    base = result.base
    change = result.estimates - values
    found = {LINKS: np.where(base.columns < 10 * base.n_links, change, 0.0)}
    for k in range(base.n_joints):
        for key, places in locate_drive_parameters(base, k).items():
            found.setdefault(key, np.zeros(base.n_base))[places] = change[places]
    for body in bodies.bodies:
        regrouped = _regroup_body(result, body)
        found[body.key] = found.get(body.key, 0.0) + regrouped
        # What a single body explains is no longer the links'.
        found[LINKS] -= regrouped
    return {key: changed for key, changed in found.items() if changed.any()}


def _regroup_body(result: IdentificationResult, body: Body) -> Array:
    """Return what a body adds to the base parameters, (p,)."""
    body_columns = slice(10 * body.link, 10 * body.link + 10)
    return np.asarray(result.base.regrouping[:, body_columns] @ body.parameters)


def _find_significant(
    result: IdentificationResult,
    values: Array,
    changes: Mapping[str, Array],
    bodies: BodyDifference,
) -> dict[str, bool]:
    """Return which effects are no chance, at a familywise error rate over effects of drives."""
    tested = select_tested_values(result)
    p = {
        key: tested.test_against(np.where(change != 0.0, values, np.nan)).probability
        for key, change in changes.items()
        if key not in (LINKS, *BODIES)
        # Over drives alone: bodies have been tested against each other already.
    }
    sure = (holm(list(p.values())) <= FALSE_DISCOVERY_RATE).tolist() if p else []
    return {
        # Bodies and tilts were tested when they were found.
        **dict.fromkeys(BODIES, True),
        LINKS: bodies.links_differ,
        TILT: True,
        **dict(zip(p, sure, strict=True)),
    }


def _find_single_bodies(
    result: IdentificationResult,
    bodies: BodyDifference,
    torques: Mapping[str, Array],
    left: Array,
    torque: Array,
    n: int,
) -> tuple[FoundEffect, ...]:
    """Return bodies of these torques, next to what the model leaves of the torque of n samples."""
    names = result.joint_names
    joints = result.base.link_joints
    found = []
    for k, body in enumerate(bodies.bodies):
        family = EFFECTS[body.key]
        y = torques[str(k)]
        joint = None if body.key == Payload.key else names[joints[body.link]]
        before, after = (
            float(np.linalg.norm(residual) / np.linalg.norm(torque))
            for residual in (left + y, left)
        )
        others = [f"{key} at {names[joints[link]]}" for key, link in body.alike]
        found.append(
            family.found(
                joint,
                body.parameters,
                body.covariance,
                revolute=True,
                in_model=True,
                torque=float(np.linalg.norm(y) / np.sqrt(n)),
                errors=(before, after),
                alternatives=(*others, *([LINKS] if bodies.links_differ else [])),
            )
        )
    return tuple(found)


def _word_sizes(
    result: IdentificationResult, key: str, values: Array, bodies: tuple[FoundEffect, ...]
) -> tuple[str, ...]:
    """Return the parameters of an effect at each joint as text, as changes from CAD."""
    n = result.model.n_joints
    if key in BODIES:
        masses = [body for body in bodies if body.effect == key]
        texts = [format_size(body) for body in masses]
        return (join_names(texts),) * n
    if key in (LINKS, TILT):
        texts = [
            other_effect.text
            for other_effect in result.effects
            if other_effect.effect == key and other_effect.in_model
        ]
        return ("".join(texts).partition(":")[0].removeprefix(name_group(key)).strip(),) * n
    words = {
        symbol: term.title.removesuffix(" friction") if key == "friction" else ""
        for term in result.base.drive.terms
        if find_group(term) == key
        for symbol in term.symbols
    }

    def word(j: int) -> str:
        parameter = result.parameters[j]
        change = format_plus_minus(parameter.estimate - float(values[j]), parameter.std_error)
        # A zero in CAD is no value to be more than.
        more = " more than in CAD" if values[j] else ""
        title = words.get(parameter.name.rstrip("0123456789"), "")
        return f"{title} {change} {parameter.unit}{more}".strip()

    drive_places = (locate_drive_parameters(result.base, k).get(key, []) for k in range(n))
    return tuple(", ".join(map(word, places)) for places in drive_places)
