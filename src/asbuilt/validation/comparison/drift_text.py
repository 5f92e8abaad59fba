"""One base parameter in two results, and sentences about the changes of drive terms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Mask
from asbuilt.findings import join_names
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.tables import round_with_error
from asbuilt.validation.comparison.compared_parameter import ParameterTest

LARGEST_GROWTH = 3.0
"""Largest relative change given in percent; beyond it the first value was near zero."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ParameterChange(ParameterTest):
    """Hold one base parameter in two results; what is unknown is None.

    | attribute | meaning |
    |---|---|
    | `felt_at` | the joint with most of the torque of the change |
    | `changed` | whether it changed significantly |
    | `dropped` | whether a result set it to zero, without an error; it is not tested |
    """

    before: float
    before_error: float
    after: float
    after_error: float
    felt_at: int | None = None
    changed: bool
    dropped: bool = False

    @property
    def error(self) -> float:
        """Standard error of the change."""
        return float(np.hypot(self.before_error, self.after_error))


def describe_other_drives(
    before: IdentificationResult, after: IdentificationResult, labels: tuple[str, ...]
) -> tuple[str, ...]:
    """Return a sentence if the results have different drive terms or nonlinear parameters."""
    one, two = (
        {term.key: str(term) for term in result.base.drive.terms} for result in (before, after)
    )
    if one == two:
        return ()
    alone = [
        (label, [key for key in terms_of if key not in others])
        for label, terms_of, others in zip(labels, (one, two), (two, one), strict=True)
    ]
    parts = [f"only {label} has {', '.join(keys)}" for label, keys in alone if keys]
    changed = ", ".join(key for key, term in one.items() if two.get(key, term) != term)
    if changed:
        parts.append(f"both have {changed}, with other nonlinear parameters or at other joints")
    missing = any(keys for _, keys in alone)
    # The richer set can describe both robots.
    richer = max(before.base.drive, after.base.drive, key=lambda drive: len(drive.terms))
    return (
        f"DIFFERENT DRIVE TERMS: {'; '.join(parts)}."
        f" {'Those that only one has are left out here. ' if missing else ''}What follows may be"
        f" the effect of these terms; identify both with {richer}.",
    )


def describe_dropped(dropped: Mask) -> tuple[str, ...]:
    """Return a sentence if parameters were dropped and so not tested."""
    sentence = (
        f"{np.count_nonzero(dropped)} parameters that one result or both dropped are not tested;"
        " their torque counts as change."
    )
    return (sentence,) if dropped.any() else ()


def describe_friction_changes(
    result: IdentificationResult,
    changes: tuple[ParameterChange, ...],
    models: tuple[str, ...] | None,
) -> tuple[str, ...]:
    """Return how the drive terms of every joint changed."""
    by_name = {change.name: change for change in changes if change.changed}
    named = {"Fc": "Coulomb friction", "Fv": "viscous friction", "Fo": "offset", "Ia": "armature"}
    found = []
    for number, joint in enumerate(result.joint_names, start=1):
        parts = [
            f"{what} {_describe_change(by_name[f'{symbol}{number}'], models)}"
            for symbol, what in named.items()
            if f"{symbol}{number}" in by_name
        ]
        if parts:
            found.append(f"{joint}: {', '.join(parts)}.")
    return tuple(found) or (f"No drive term {'differs' if models else 'changed'} significantly.",)


def _describe_change(change: ParameterChange, models: tuple[str, ...] | None) -> str:
    """Return both values of a parameter, by how much it grew, and with what it is correlated."""
    before, after = (
        round_with_error(value, error if error > 0 else None)[0]
        for value, error in (
            (change.before, change.before_error),
            (change.after, change.after_error),
        )
    )
    text = (
        f"{before} to {after} {change.unit}"
        if models is None
        else f"{before} ({models[0]}) against {after} {change.unit} ({models[1]})"
    )
    # Near zero a percentage says nothing.
    if change.before > 3 * change.before_error:
        growth = change.after / change.before - 1
        text += f" ({100 * growth:+.0f} %)" if abs(growth) <= LARGEST_GROWTH else ""
    return text + (
        f" (correlated with {join_names(change.shared_with)})" if change.shared_with else ""
    )
