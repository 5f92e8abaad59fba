"""The verdict on one number of a description."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

ClaimVerdict = Literal["supported", "contradicted", "undetermined"]


@dataclass(frozen=True, slots=True)
class Claim:
    """Hold the verdict on one number of a description.

    Attributes
    ----------
    what, joint, unit
        What it is, of which joint (or of the link that this joint moves).
    claimed
        The number in the description.
    estimate, std_error
        What the recording says, with nothing that pulls it to the claim; None where it says
        nothing.
    verdict
        Supported, contradicted, or undetermined.
    alias_of
        Numbers that could take its place: the torque determines them together only.
    torque
        RMS torque of the difference on the recording, over all joints [N m]; None if unknown.
    p_value, false_discovery
        Probability of as large a difference by chance, and the same for as many tests.
    alike
        Whether the estimate is within a tenth of the claim.
    note
        What else there is to say.
    """

    what: str
    joint: str
    unit: str
    claimed: float
    estimate: float | None = None
    std_error: float | None = None
    verdict: ClaimVerdict = "undetermined"
    alias_of: tuple[str, ...] = ()
    torque: float | None = None
    p_value: float | None = None
    false_discovery: float | None = None
    alike: bool = False
    note: str = ""
