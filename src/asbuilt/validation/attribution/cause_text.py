"""Sentences about the causes of the torque error of CAD."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from asbuilt.arrays import Array
from asbuilt.findings import joined
from asbuilt.tables import SIGNIFICANT_SIGMAS, plus_minus, significant
from asbuilt.tables import share as percentage
from asbuilt.validation.attribution.cause_choice import LIMITS, CauseChoice
from asbuilt.validation.attribution.cause_fits import ASSUMED
from asbuilt.validation.attribution.causes import CAUSES, Subset
from asbuilt.validation.prediction import torque_units

SHORT: dict[str, str] = {
    "friction": "friction",
    "offset": "offset",
    "payload": "payload",
    "gain": "gain",
    "mounting": "tilt",
    "links": "links",
}
"""Names of causes in tables, where shorter."""
MOST_LEFT = 0.5
"""Share of the error left unexplained above which a joint's causes are not named."""


def sentences_on_causes(
    choice: CauseChoice, correlated: tuple[tuple[str, str], ...]
) -> tuple[str, ...]:
    """Return sentences on the sizes of the causes, and on what the recording cannot decide."""
    fits, weighed = choice.fits, choice.weighed
    found = [*_on_undecided(choice), *_on_payload(choice)]
    if "mounting" in weighed:
        found.append(_on_tilt(choice))
    if "gain" in weighed:
        found.append(_on_gains(choice))
    found += [
        f"This recording cannot separate {CAUSES[one]} from {CAUSES[two]}; their shares are divided"
        " evenly."
        for one, two in correlated
    ]
    if choice.rival is not None:
        instead = choice.rival.causes - choice.chosen.causes
        replaced = choice.chosen.causes - choice.rival.causes
        found.append(
            f"About as likely on this recording: {_listed(instead) or 'no cause'} instead of"
            f" {_listed(replaced)}."
        )
    missing = frozenset(fits.causes) - set(weighed)
    missing -= {"payload"} if "links" in weighed else frozenset()
    missing -= choice.rival.causes if choice.rival is not None else frozenset()
    corrected = frozenset(fits.result.corrected) - set(weighed)
    missing -= corrected
    if missing and choice.undecided is None:
        found.append(f"Not needed to explain this recording: {_listed(missing)}.")
    if corrected:
        found.append(
            f"Corrected in this result, so no longer part of the error: {_listed(corrected)}."
        )
    return tuple(found)


def sentence(choice: CauseChoice, k: int, shares: Mapping[str, Array], left: float) -> str:
    """Return the CAD error of joint k and its causes; `left` is the share unexplained."""
    fits = choice.fits
    unit = torque_units(fits.result.model)[k]
    error = significant(float(fits.fit(frozenset()).rms[k]))
    return (
        f"{fits.cause_data.joint_names[k]}: RMS error of CAD {error} {unit};"
        f" {reason(choice, k, shares, left)}."
    )


def reason(choice: CauseChoice, k: int, shares: Mapping[str, Array], left: float) -> str:
    """Return the causes of joint k's CAD error with share and size, the largest first."""
    if choice.undecided is not None:
        return "too few validation samples to attribute it"
    with_it, against = (_ordered(k, shares, sign) for sign in (1, -1))
    if not with_it or left > MOST_LEFT:
        return f"no cause explains {'it' if left > 1.0 - LIMITS.share else 'most of it'}"
    parts, opposed = (
        [f"{percentage(float(shares[each][k]), 0)} {_amount(choice, each, k)}" for each in causes]
        for causes in (with_it, against)
    )
    parts[0] = parts[0].replace(" % ", " % of the squared error is ", 1)
    return "; ".join(
        [
            ", ".join(parts),
            *([f"against that, {', '.join(opposed)}"] if opposed else []),
            f"{percentage(left, 0)} unexplained",
        ]
    )


def short_reason(choice: CauseChoice, k: int, shares: Mapping[str, Array], left: float) -> str:
    """Return the causes of joint k's CAD error with their shares, for a table."""
    with_it = _ordered(k, shares, 1)
    if choice.undecided is not None or not with_it or left > MOST_LEFT:
        return "unexplained"
    return ", ".join(
        f"{SHORT.get(cause, cause)} {percentage(float(shares[cause][k]), 0)}" for cause in with_it
    )


def _ordered(k: int, shares: Mapping[str, Array], sign: int) -> list[str]:
    return sorted(
        (cause for cause, share in shares.items() if sign * share[k] >= LIMITS.share),
        key=lambda cause: -abs(shares[cause][k]),
    )


def _listed(causes: Subset) -> str:
    return joined([CAUSES[cause] for cause in CAUSES if cause in causes]) if causes else ""


def _on_undecided(choice: CauseChoice) -> list[str]:
    fits, most = choice.fits, choice.undecided
    if most is None:
        return []
    return [
        "Too few validation samples to attribute the error of CAD:"
        f" {_listed(most.causes)} together explain most of it, but with {most.rank} parameters for"
        f" about {significant(fits.independent_judged, 2)} independent samples of each joint."
        " Record longer, or validate on a recording of its own."
    ]


def _on_payload(choice: CauseChoice) -> list[str]:
    fits, weighed = choice.fits, choice.weighed
    if not ("payload" in fits.causes and choice.has_payload and {"payload", "links"} & {*weighed}):
        return []
    _, mass, error, centre = choice.possible_payload
    place = ", ".join(f"{1e3 * float(c):.0f}" for c in centre)
    body = (
        f"{plus_minus(mass, error)} kg with its centre of mass at ({place}) mm in the frame of"
        f" {fits.result.model.link_names[fits.result.model.tool_link]}"
    )
    away = float(np.linalg.norm(centre))
    if "links" not in weighed:
        return [f"The robot carries {body}."]
    if "payload" in weighed:
        return [
            f"A payload of {body} would explain much of what a changed mass distribution of the"
            " links explains; the recording cannot separate the two."
        ]
    if mass <= 0:
        return [f"A payload is ruled out: its mass would be {plus_minus(mass, error)} kg."]
    if away > ASSUMED.reach:
        return [
            f"A payload is ruled out: its centre of mass would be {significant(away, 2)} m from"
            " the last joint."
        ]
    return []


def _on_tilt(choice: CauseChoice) -> str:
    fits, fit = choice.fits, choice.chosen
    place = fits.columns["mounting"]
    tilts = " and ".join(
        f"{plus_minus(*np.rad2deg([fit.values[j], fit.std_errors[j]]).tolist())} deg about"
        f" {_axis(axis)}"
        for j, axis in zip(place, fits.cause_data.tilt_axes, strict=True)
    )
    sure = np.any(np.abs(fit.values[place]) >= SIGNIFICANT_SIGMAS * fit.std_errors[place])
    return f"Fitted with the other causes, the base {'is' if sure else 'may be'} tilted by {tilts}."


def _on_gains(choice: CauseChoice) -> str:
    fits, fit = choice.fits, choice.chosen
    listed = [
        f"{name} {100 * fit.values[j]:+.1f} +/- {100 * fit.std_errors[j]:.1f} %"
        for name, j in zip(fits.cause_data.joint_names, fits.columns["gain"], strict=True)
        if abs(fit.values[j]) >= SIGNIFICANT_SIGMAS * fit.std_errors[j]
    ]
    return (
        f"Torque gains differ from their nominal values: {joined(listed)}."
        if listed
        else "Torque gains differ from their nominal values, at no single joint significantly."
    )


def _amount(choice: CauseChoice, cause: str, k: int) -> str:
    """Return a cause with its size at a joint."""
    fit, names, size = choice.chosen, choice.fits.names, choice.sizes[cause]
    unit = torque_units(choice.fits.result.model)[k]

    def value(symbol: str) -> float:
        name = f"{symbol}{k + 1}"
        return float(size[names.index(name)]) if name in names else 0.0

    if cause == "payload":
        body = f"payload ({significant(choice.possible_payload[1], 2)} kg"
        return f"{body}, if there is one)" if "links" in fit.causes else f"{body})"
    if cause == "friction":
        design = choice.fits.design
        stated = any(
            design[names.index(name)] for name in (f"Fc{k + 1}", f"Fv{k + 1}") if name in names
        )
        sizes = _friction_sizes(value("Fc"), value("Fv"), unit)
        more = " more than in CAD" if stated else ""
        return f"friction ({sizes}{more})" if sizes else "friction"
    if cause == "offset":
        return f"offset ({significant(value('Fo'), 2)} {unit})"
    if cause == "armature":
        return f"armature ({significant(value('Ia'), 2)} {'kg m^2' if unit == 'N m' else 'kg'})"
    if cause == "gain":
        return f"torque gain ({100 * value('gain '):+.0f} %)"
    if cause == "mounting":
        tilt = float(np.rad2deg(np.hypot(*fit.values[choice.fits.columns["mounting"]])))
        return f"base tilt ({significant(tilt, 2)} deg)"
    return CAUSES[cause]


def _friction_sizes(coulomb: float, viscous: float, unit: str) -> str:
    per_speed = f"{unit} {'s/rad' if unit == 'N m' else 's/m'}"
    return ", ".join(
        f"{name} {significant(value, 2)} {each}"
        for name, value, each in (("Coulomb", coulomb, unit), ("viscous", viscous, per_speed))
        if value
    )


def _axis(axis: Array) -> str:
    for name, unit in zip("xyz", np.eye(3), strict=True):
        if np.allclose(axis, unit, atol=1e-9):
            return name
    return f"({', '.join(f'{c:.2f}' for c in axis)})"
