"""Measured forces on a robot: of the ground on its feet or hands, and of what carries its base.

In `tau + J^T f = Y chi` a measured f is known and enters the left side; one that nobody measured
is projected away (`dynamics.contact`). Forces [N] and moments [N m] act on the robot and are in
axes of the frame that names them, as a sensor that is fixed there measures them.

All forces on a robot together move its centre of mass and carry its weight, whatever its joints do.
So the masses of a description say in which axes the forces are, and which way.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.description.structure.parts import Contact
from asbuilt.dynamics import inverse_dynamics, link_poses
from asbuilt.dynamics.contact import SAMPLES_AT_ONCE, contact_jacobians
from asbuilt.errors import RecordingError
from asbuilt.experiment.free_base.feet import detect_force, set_rolling_radii
from asbuilt.experiment.recording import Recording
from asbuilt.findings import Cure, Finding, join_names

BASE = "base"
FORCE = ("fx", "fy", "fz")
MOMENT = ("mx", "my", "mz")


def with_measured_forces(recording: Recording, model: RobotModel) -> Recording:
    """Return a recording whose torque holds `J^T f` of measured forces.

    Contacts count as open where their force is measured, so that it is not projected away; where a
    sensor has no value, they are closed as their flag says.
    """
    if not any(name.endswith("_fx") for name in recording.extra):
        return recording
    rolling = set_rolling_radii(model, [recording])
    wrenches = collect_measured_wrenches(recording, rolling)
    contact = None if recording.contact is None else recording.contact.copy()
    for place, wrench in wrenches.items():
        for k, each in enumerate(model.contacts):
            if contact is not None and each.frame == place.frame:
                contact[np.isfinite(wrench).all(axis=1), k] = 0.0
    tau = recording.tau + generalised_forces(rolling, recording.q, wrenches)
    return replace(recording, tau=tau, contact=contact)


def select_force_columns(extra: Mapping[str, Array]) -> dict[str, Array]:
    """Return the columns of measured forces and of the flags of contacts."""
    ends = tuple(f"_{kind}" for kind in (*FORCE, *MOMENT))
    return {
        name: values
        for name, values in extra.items()
        if name.endswith(ends) or name.startswith("contact_")
    }


def collect_measured_wrenches(recording: Recording, model: RobotModel) -> dict[Contact, Array]:
    """Return measured forces (N, 3), or forces and moments (N, 6), with where they act.

    Raises
    ------
    RecordingError
        If some components of a force are missing, or the moments on a sole.
    """
    base = Contact(model.link_names[model.n_floating - 1], radius=0.0)
    places = {BASE: base} | {f"contact_{contact.frame}": contact for contact in model.contacts}
    found = {}
    for key, contact in places.items():
        parts = [[f"{key}_{axis}" for axis in kind] for kind in (FORCE, MOMENT)]
        known = [[name for name in names if name in recording.extra] for names in parts]
        if not any(known):
            continue
        wanted = parts[0] + (parts[1] if known[1] or contact.flat else [])
        missing = [name for name in wanted if name not in recording.extra]
        if missing:
            raise RecordingError(
                f"{recording.source} has {join_names([*known[0], *known[1]])} but no"
                f" {missing[0]}; a"
                f" measured force has {' '.join(wanted)}"
                + (", with the moments of a sole" if contact.flat else ""),
                cure=Cure("log all components, or leave the force out, and it is projected away"),
                file=recording.source,
                value=missing,
            )
        acts = replace(contact, flat=True, radius=0.0) if len(wanted) == 6 else contact
        found[acts] = np.stack([recording.extra[name] for name in wanted], axis=1)
    return found


def generalised_forces(model: RobotModel, q: Array, wrenches: Mapping[Contact, Array]) -> Array:
    """Return `J^T f` (N, n) of measured forces at positions q (N, n); those unknown count as 0."""
    found = np.zeros(q.shape)
    places = replace(model, contacts=tuple(wrenches))
    for start in range(0, len(q), SAMPLES_AT_ONCE):
        span = slice(start, start + SAMPLES_AT_ONCE)
        jacobians = contact_jacobians(places, q[span])
        for J, (contact, wrench) in zip(jacobians, wrenches.items(), strict=True):
            f = np.nan_to_num(turn_into_world_axes(model, q[span], contact, wrench[span]))
            found[span] += np.einsum("sij,si->sj", J, f)
    return found


def turn_into_world_axes(model: RobotModel, q: Array, contact: Contact, wrench: Array) -> Array:
    """Return a wrench (N, 3 or 6) turned from axes of its frame into axes of the world."""
    link, placement = model.placed(contact.frame)
    R = link_poses(model, q)[:, link, :3, :3] @ placement[:3, :3]
    parts = wrench.reshape(len(q), -1, 3)
    return np.asarray(np.einsum("sij,skj->ski", R, parts).reshape(wrench.shape))


# Say from when forces are read wrongly: own choices, tested on virtual robots.
#
# Forces are averaged over `FORCE_WINDOW` [s]. Another reading must leave less than `FORCE_SHARE` of
# the squared disagreement with the weight. Flags and forces disagree in more than a part
# `FORCE_OFTEN`.

FORCE_WINDOW = 0.1
FORCE_SHARE = 0.25
FORCE_OFTEN = 0.1


def check_forces(model: RobotModel, recording: Recording, rates: Array) -> Iterator[Finding]:
    """Find forces in other axes or of other sign, and flags that disagree with them."""
    wrenches = collect_measured_wrenches(recording, model)
    if not wrenches or model.n_floating != 6:
        return
    own = {place: f[:, :3] for place, f in wrenches.items()}
    world = _add_up(turn_into_world_axes(model, recording.q, place, f) for place, f in own.items())
    needed = inverse_dynamics(model, recording.q, rates, np.gradient(rates, recording.t, axis=0))[
        :, :3
    ]
    known = np.isfinite(world).all(axis=1)
    if recording.contact is not None:
        known &= ~(recording.contact > 0.5).any(axis=1)

    def off(force: Array) -> float:
        width = max(1, round(FORCE_WINDOW * recording.rate))
        left = (needed - force)[known]
        means = left[: len(left) // width * width].reshape(-1, width, 3).mean(axis=1)
        return float(np.mean(means**2)) if len(means) else 0.0

    plain = _add_up(own.values())
    readings = {
        "in world axes": plain,
        "forces of the robot on its surroundings": -world,
        "forces of the robot on its surroundings, in world axes": -plain,
    }
    best = min(readings, key=lambda name: off(readings[name]))
    if off(readings[best]) < FORCE_SHARE * off(world):
        yield Finding(
            "force_axes",
            "error",
            f"measured forces at {join_names([place.frame for place in own])} are {best}: so"
            " read, they"
            " carry the weight of the robot; as forces on it in axes of these frames they do not",
            Cure("turn them into axes of the frames, with the sign of what acts on the robot"),
        )
    for place, force in own.items():
        flag = recording.extra.get(f"contact_{place.frame}")
        if flag is None:
            continue
        wrong = float(np.mean((flag > 0.5) != (detect_force(np.linalg.norm(force, axis=1)) > 0.5)))
        if wrong > FORCE_OFTEN:
            yield Finding(
                "contact_force_flags",
                "warning",
                f"contact_{place.frame} and the force measured there disagree in {100 * wrong:.0f}"
                " % of the time; the force is used",
                Cure("check the flags, and the clock and zero of the force"),
            )


def _add_up(forces: Iterable[Array]) -> Array:
    return np.asarray(np.sum(list(forces), axis=0))
