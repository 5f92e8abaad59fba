"""Sets of drive terms that have a name of their own."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence

from asbuilt.dynamics.drives.term import TERMS
from asbuilt.errors import UsageError

_PLAIN = ("armature", "viscous", "coulomb")
NAMED_SETS: Mapping[str, tuple[str, ...]] = {
    "bam-m1": _PLAIN,
    "bam-m2": (*_PLAIN, "stribeck"),
    "bam-m3": (*_PLAIN, "load_friction"),
    "bam-m4": (*_PLAIN, "stribeck", "load_friction", "load_stribeck"),
    "bam-m5": (*_PLAIN, "stribeck", "directional_load_friction", "directional_load_stribeck"),
    "bam-m6": (
        *_PLAIN,
        "stribeck",
        "directional_load_friction",
        "directional_load_stribeck",
        "quadratic_load_stribeck",
    ),
}
"""Friction models M1 to M6 of BAM, with the armature that BAM identifies beside them.

Source: Duclusaud, Passault, Padois and Ly, Extended friction models for the physics simulation of
servo actuators, arXiv 2410.08650, 2024.
"""
STATED = ("velocity", "power")
"""Options that a set hands on to those of its terms that have them."""


def with_sets_expanded(entries: Sequence[Sequence[str]]) -> list[list[str]]:
    """Return entries (key, options) in which the terms of a set stand for its name.

    A set is named `bam-m4` or `bam:m4`; its options `velocity` and `power` go to all terms that
    fade with speed. Raises `UsageError` for a set that does not exist.
    """
    expanded = list[list[str]]()
    for entry in entries:
        by_colon = entry[0] == "bam" and len(entry) > 1
        key, *options = [f"bam-{entry[1]}", *entry[2:]] if by_colon else entry
        if key.startswith("bam") or f"bam-{key}" in NAMED_SETS:
            expanded += _terms_of(key, options)
        else:
            expanded.append([key, *options])
    return expanded


def _terms_of(key: str, options: Sequence[str]) -> list[list[str]]:
    if key not in NAMED_SETS:
        near = difflib.get_close_matches(key, NAMED_SETS, n=1, cutoff=0.5)
        guess = f"did you mean {near[0]!r}? " if near else ""
        raise UsageError(
            f"there is no set of drive terms {key!r}; {guess}available: {', '.join(NAMED_SETS)}"
        )
    names = [option.partition("=")[0].strip() for option in options]
    if unknown := [name for name in names if name not in STATED]:
        raise UsageError(f"a set of drive terms takes velocity and power, got {unknown[0]!r}")
    fading = [bool(TERMS[term].nonlinear) for term in NAMED_SETS[key]]
    if options and not any(fading):
        raise UsageError(f"no term of {key!r} fades with speed; it takes no {names[0]}")
    return [
        [term, *(options if fades else ())]
        for term, fades in zip(NAMED_SETS[key], fading, strict=True)
    ]
