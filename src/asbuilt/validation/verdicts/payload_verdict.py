"""Verdict on a payload: whether to use it, and what it is."""

from __future__ import annotations

from asbuilt.findings import join_names
from asbuilt.identification import Payload
from asbuilt.tables import format_plus_minus
from asbuilt.validation.verdicts.verdict import OPENING


def describe_payload_outcome(payload: Payload) -> str:
    """Return the verdict: whether to use the payload, and what it is, in a sentence with errors."""
    values = payload.values.tolist()
    errors = payload.std_errors.tolist()
    mass = format_plus_minus(values[0], errors[0])
    if "mass" not in payload.determined:
        at = payload.frame
        return f"{OPENING['no']}: the mass of the payload at {at} is undetermined ({mass} kg)."
    known = [k for k in (1, 2, 3) if payload.names[k] in payload.determined]
    centre = ", ".join(f"{'xyz'[k - 1]} {format_plus_minus(values[k], errors[k])}" for k in known)
    where = f"{centre} m" if centre else "undetermined"
    doubts = ["nearest consistent payload"] if payload.projected else []
    if payload.gains_in_doubt:
        doubts.insert(0, f"gains of {join_names(payload.gains_in_doubt)} in doubt")
    use = OPENING["with care" if doubts else "yes"]
    against = f"{join_names(doubts)}; " if doubts else ""
    return f"{use}: {against}payload at {payload.frame}: {mass} kg, its centre {where}."
