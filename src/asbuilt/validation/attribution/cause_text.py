"""What an attribution says in sentences."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from asbuilt.arrays import Array
from asbuilt.tables import SIGNIFICANT_SIGMAS, plus_minus, significant
from asbuilt.tables import share as percentage
from asbuilt.validation.attribution.cause_fits import NEARLY, POSSIBLE_REACH, CauseFits
from asbuilt.validation.attribution.causes import CAUSES
from asbuilt.validation.prediction import torque_units

WORTH_SAYING = 0.05
"""Share of the error from which a cause is named."""
MOSTLY = 0.5
"""Share of the error left unexplained from which no cause is named."""


def findings(fits: CauseFits, alike: tuple[tuple[str, str], ...]) -> tuple[str, ...]:
    """Say what the causes weighed amount to, what was ruled out, and what this recording does not
    tell apart.
    """
    weighed = fits.weighed
    found = []
    if "payload" in fits.causes and fits.tells_payload and {"payload", "links"} & set(weighed):
        _, mass, error, centre = fits.possible_payload
        away = float(np.linalg.norm(centre))
        where = ", ".join(f"{1e3 * float(c):.0f}" for c in centre)
        body = (
            f"{plus_minus(mass, error)} kg, its centre at ({where}) mm in the frame of"
            f" {fits.result.model.link_names[-1]}"
        )
        if "links" not in weighed:
            found.append(f"The last link carries {body}.")
        elif "payload" in weighed:
            found.append(
                f"A body at the flange of {body}, would explain much of what a changed mass"
                " distribution of the links explains; free links can imitate any payload, so only"
                " simplicity speaks for it."
            )
        elif mass <= 0:
            found.append(
                "A payload is no explanation: it would have a mass of"
                f" {plus_minus(mass, error)} kg."
            )
        elif away > POSSIBLE_REACH:
            found.append(
                f"A payload is no explanation: its centre would lie {significant(away, 2)} m off"
                " the last joint."
            )
    if "mounting" in weighed:
        place = fits.columns["mounting"]
        tilts = [
            plus_minus(*np.rad2deg([fits.chosen.values[j], fits.chosen.std_errors[j]]).tolist())
            for j in place
        ]
        turned = " and ".join(
            f"{tilt} about {_axis(axis)}"
            for tilt, axis in zip(tilts, fits.cause_data.tilt_axes, strict=True)
        )
        sure = np.any(
            np.abs(fits.chosen.values[place]) >= SIGNIFICANT_SIGMAS * fits.chosen.std_errors[place]
        )
        found.append(
            f"The root frame {'stands' if sure else 'may stand'} askew by {turned}, in degrees."
        )
    if "gain" in weighed:
        told = [
            (name, 100 * fits.chosen.values[j], 100 * fits.chosen.std_errors[j])
            for name, j in zip(fits.cause_data.joint_names, fits.columns["gain"], strict=True)
        ]
        listed = ", ".join(
            f"{name} {g:+.1f} +/- {e:.1f} %"
            for name, g, e in told
            if abs(g) >= SIGNIFICANT_SIGMAS * e
        )
        found.append(
            "Torques read larger or smaller than they are:"
            f" {listed or 'by no more than their errors at any one joint'}."
        )
    for one, two in alike:
        found.append(
            f"This recording does not tell {CAUSES[one]} from {CAUSES[two]}: with either in the"
            " model the other adds little, and their shares are divided between them for want of"
            " better."
        )
    rival = next(
        (
            fit
            for fit in fits.rivals
            if fits.chosen.causes - fit.causes and fit.score <= fits.chosen.score + NEARLY
        ),
        None,
    )
    if rival is not None:
        instead = (
            ", ".join(
                CAUSES[cause] for cause in CAUSES if cause in rival.causes - fits.chosen.causes
            )
            or "nothing"
        )
        replaced = ", ".join(
            CAUSES[cause] for cause in CAUSES if cause in fits.chosen.causes - rival.causes
        )
        found.append(
            f"About as likely, for what this recording tells: {instead} in place of {replaced}."
        )
    if fits.untold is not None:
        listed = ", ".join(CAUSES[cause] for cause in CAUSES if cause in fits.untold.causes)
        found.append(
            f"Too little is held out to tell why CAD is off: {listed} together take most of the"
            f" error away, but {fits.untold.rank} parameters stand against some"
            f" {significant(fits.independent_judged, 2)} independent samples of each joint. Record"
            " longer, or judge by a recording of its own (--validate)."
        )
        return tuple(found)
    missing = [
        CAUSES[cause]
        for cause in fits.causes
        if cause not in weighed and not (cause == "payload" and "links" in weighed)
    ]
    if missing:
        found.append(f"Not needed to explain this recording: {', '.join(missing)}.")
    return tuple(found)


def sentence(fits: CauseFits, k: int, shares: Mapping[str, Array], left: float) -> str:
    """Say by how much CAD is off at joint k and of what that is made.

    `left` is the share that stays unexplained.
    """
    unit = torque_units(fits.result.model)[k]
    head = (
        f"{fits.cause_data.joint_names[k]}: CAD is off by"
        f" {significant(float(fits.fit(frozenset()).rms[k]))} {unit} RMS"
    )
    return f"{head}; {reason(fits, k, shares, left)}."


def reason(fits: CauseFits, k: int, shares: Mapping[str, Array], left: float) -> str:
    """Say of what the CAD error of joint k is made, the largest cause first.

    What works against it is said to.
    """
    with_it, against = (
        sorted(
            (cause for cause, share in shares.items() if sign * share[k] >= WORTH_SAYING),
            key=lambda cause: -abs(shares[cause][k]),
        )
        for sign in (1, -1)
    )
    if fits.untold is not None:
        return "too little is held out to tell why"
    if not with_it or left > MOSTLY:
        return f"no cause explains {'it' if left > 1.0 - WORTH_SAYING else 'most of it'}"
    parts = [
        f"{percentage(float(shares[cause][k]), 0)} {_amount(fits, cause, k)}" for cause in with_it
    ]
    parts[0] = parts[0].replace(" % ", " % of the squared error is ", 1)
    opposed = ", ".join(
        f"{percentage(float(shares[cause][k]), 0)} {_amount(fits, cause, k)}" for cause in against
    )
    return "; ".join(
        [
            ", ".join(parts),
            *([f"against that, {opposed}"] if opposed else []),
            f"{percentage(left, 0)} unexplained",
        ]
    )


def _amount(fits: CauseFits, cause: str, k: int) -> str:
    """Say what a cause amounts to at a joint."""
    fit, names = fits.chosen, list(fits.names)
    unit = torque_units(fits.result.model)[k]
    size = fits.sizes(fits.weighed)[cause]

    def value(symbol: str) -> float:
        name = f"{symbol}{k + 1}"
        return float(size[names.index(name)]) if name in names else 0.0

    if cause == "payload":
        body = f"{significant(fits.possible_payload[1], 2)} kg at the flange"
        return f"what {body} would do" if "links" in fit.causes else body
    if cause == "friction":
        stated = any(
            name in names and fits.design[names.index(name)]
            for name in (f"Fc{k + 1}", f"Fv{k + 1}")
        )
        sizes = _friction_sizes(value("Fc"), value("Fv"), unit)
        return (
            f"friction ({sizes}{' beside that of CAD' if stated else ''})" if sizes else "friction"
        )
    if cause == "offset":
        return f"an offset of {significant(value('Fo'), 2)} {unit}"
    if cause == "armature":
        return f"armature ({significant(value('Ia'), 2)} {'kg m^2' if unit == 'N m' else 'kg'})"
    if cause == "gain":
        return f"torque gain ({100 * value('gain '):+.0f} %)"
    if cause == "mounting":
        return (
            "mounting askew"
            f" ({significant(float(np.rad2deg(np.hypot(*fit.values[fits.columns['mounting']]))), 2)}"
            " deg)"
        )
    return CAUSES[cause]


def _friction_sizes(coulomb: float, viscous: float, unit: str) -> str:
    """Return Coulomb and viscous friction in words, what is zero left out."""
    per_speed = f"{unit} {'s/rad' if unit == 'N m' else 's/m'}"
    parts = [f"Coulomb {significant(coulomb, 2)} {unit}"] if coulomb else []
    if viscous:
        parts.append(
            f"{'viscous' if viscous > 0 else 'falling with speed by'}"
            f" {significant(abs(viscous), 2)} {per_speed}"
        )
    return ", ".join(parts)


def _axis(axis: Array) -> str:
    for name, unit in zip("xyz", np.eye(3), strict=True):
        if np.allclose(axis, unit, atol=1e-9):
            return name
    return f"({', '.join(f'{c:.2f}' for c in axis)})"
