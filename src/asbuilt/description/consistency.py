"""Whether a robot as described can exist: physical consistency of every link."""

from __future__ import annotations

from asbuilt.description.model import RobotModel


def inconsistencies(model: RobotModel) -> tuple[str, ...]:
    """Return one sentence per physically inconsistent link.

    Such as `"link 4: Ixx + Iyy < Izz by 0.0009 kg m^2 (about the centre of mass)"`.

    Links are numbered from 1; the condition is that of `LinkInertia.inconsistency` (Wensing, Kim
    and Slotine, 2018). A link whose mass properties the description does not give is passed over.
    """
    reasons = []
    for number, link in enumerate(model.links, start=1):
        reason = link.inertia.inconsistency() if link.inertia_known else None
        if reason is not None:
            reasons.append(f"link {number}: {reason}")
    return tuple(reasons)
