"""Models that no robot can have, refused before they are written for other software."""

from __future__ import annotations

from collections.abc import Collection

from asbuilt.description.consistency import inconsistencies
from asbuilt.description.model import RobotModel
from asbuilt.errors import InertiaError


def impossibilities(model: RobotModel) -> tuple[str, ...]:
    """Return one sentence per link that no rigid body can be and per drive that would push: negative armature, viscous or Coulomb friction."""
    reasons = list(inconsistencies(model))
    for number, joint in enumerate(model.joints, start=1):
        for name in ("armature", "viscous", "coulomb"):
            value = getattr(joint.drive, name)
            if value is not None and value < 0.0:
                what = {"armature": "armature", "viscous": "viscous friction", "coulomb": "Coulomb friction"}[name]
                reasons.append(f"joint {number}: {what} is {value:.4g}; it must not be negative")
    return tuple(reasons)


def left_out_drives(model: RobotModel, carried: Collection[str], kind: str) -> tuple[str, ...]:
    """Return a note that names the further drive terms which a kind of file does not carry, with the joints that have them; none where it carries all."""
    joints: dict[str, list[str]] = {}
    for joint in model.joints:
        for key in joint.drive.terms:
            if key not in carried:
                joints.setdefault(key, []).append(joint.name)
    if not joints:
        return ()
    said = ", ".join(key if len(names) == model.n_joints else f"{key} ({', '.join(names)})" for key, names in joints.items())
    return (
        f"{kind} has no place for the drive terms {said}; they are left out, and its torques lack them (robot files of asbuilt, --toml, carry all)",
    )


def refuse_impossible(model: RobotModel, cure: str = "take the nearest possible robot") -> None:
    """Raise `InertiaError` with every reason and the cure where the model is impossible; simulators would refuse it or blow up."""
    reasons = impossibilities(model)
    if reasons:
        raise InertiaError(
            f"{model.name} is not exported, for no robot can have this model: {'; '.join(reasons)}. Identify with physical consistency "
            f"(--method consistent), {cure}, or leave out drive terms that the recording does not tell"
        )
