"""Whether a robot as described can exist: physical consistency of every link."""

from __future__ import annotations

from asbuilt.description.model import RobotModel


def find_inconsistencies(model: RobotModel) -> tuple[str, ...]:
    """Return one sentence per physically inconsistent link.

    Such as `"link 4: Ixx + Iyy < Izz by 0.0009 kg m^2 (about the centre of mass)"`.

    Links are numbered from 1; `LinkInertia.inconsistency` states the condition (Wensing, Kim
    and Slotine, 2018). A link whose mass properties the description does not give is passed over.
    """
    return tuple(
        f"link {number}: {reason}"
        for number, link in enumerate(model.links, start=1)
        if link.inertia_known and (reason := link.inertia.inconsistency()) is not None
    )
