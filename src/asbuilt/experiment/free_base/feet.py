"""Feet: which of them stand, how fast a base moves by those, and the forces measured at them.

Foot k stands at `p` of the base and moves at `J q'` while the base is held, so that the velocity of
the base in its own axes is `v = -J q' - w x p`. The accelerometer integrates the specific force f:
`v = integral (R (f - b) + g) + v0` in world axes, with an offset b that feet determine.

The centre of a ball that rolls on level ground without slipping moves as `d(x, y) = r (w_y, -w_x)
dt`, where a point that stands does not move at all. So pose and joints alone say on which radius a
foot stands. Forces that act there have another moment than at its centre: legs of 16 cm of which
the lowest 2 are rubber turn by 0.5 rad in a step, and the moment is off by as much as 1 cm.

In `tau + J^T f = Y chi` a measured f is known and enters the left side; one that nobody measured
is projected away (`dynamics.reactions`). Forces [N] and moments [N m] act on the robot and are in
axes of the frame that names them, as a sensor that is fixed there measures them.

All forces on a robot together move its centre of mass and carry its weight, whatever its joints do.
So the masses of a description say in which axes the forces are, and which way.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from asbuilt.arrays import Array, Mask, find_finite_rows
from asbuilt.description.model import RobotModel
from asbuilt.description.structure.parts import Contact
from asbuilt.dynamics import inverse_dynamics, link_poses
from asbuilt.dynamics.reactions import SAMPLES_AT_ONCE, contact_jacobians
from asbuilt.errors import RecordingError
from asbuilt.experiment.recording import Recording
from asbuilt.findings import Cure, Finding, join_names

Name = TypeVar("Name")
Reading = TypeVar("Reading")

PRESSED = 0.02
"""Part of a large force above which a contact without a flag counts as closed."""


def detect_force(force: Array) -> Array:
    """Return 1 where a force (N,) is felt, or has no value, and 0 elsewhere."""
    large = float(np.nanquantile(np.abs(force), 0.95))
    return np.asarray(~(np.abs(force) <= PRESSED * large), dtype=np.float64)


def find_closed(columns: Mapping[str, Array], frame: str) -> Array | None:
    """Return where a contact is closed (N,), by its flag, else by its force; None without them."""
    name = f"contact_{frame}"
    if name not in columns and f"{name}_fz" in columns:
        return detect_force(columns[f"{name}_fz"])
    return columns.get(name)


LEFT_BY_BETTER = 0.5
"""Part of a squared disagreement that another reading of a log leaves at most, if that is right:
own choice, tested on virtual and real robots."""


def find_better_reading(
    disagree: Callable[[Reading], float],
    plain: Reading,
    others: Iterable[tuple[Name, Reading]],
    part: float = LEFT_BY_BETTER,
) -> Name | None:
    """Return which other reading of a log leaves least of a squared disagreement.

    None where it is no better than a part of what the plain reading leaves.
    """
    left = {name: disagree(reading) for name, reading in others}
    best = min(left, key=lambda name: left[name])
    return best if left[best] < part * disagree(plain) else None


@dataclass(frozen=True, slots=True, eq=False)
class Feet:
    """Hold how feet move in base axes while the base is held: for each its place and velocity.

    `place` and `velocity` are (n_contacts, N, 3), `stands` (n_contacts, N) where it is closed.
    """

    place: Array
    velocity: Array
    stands: Array

    @classmethod
    def of(cls, recording: Recording, model: RobotModel) -> Feet:
        """Return the feet of a recording of the joints alone; of contact flags those it has."""
        q = np.hstack([np.zeros((recording.n_samples, 6)), recording.q])
        rates = recording.qd
        rates = np.gradient(recording.q, recording.t, axis=0) if rates is None else rates
        shape = (len(model.contacts), recording.n_samples, 3)
        place = np.zeros(shape)
        velocity = np.zeros(shape)
        for start in range(0, len(q), SAMPLES_AT_ONCE):
            span = slice(start, start + SAMPLES_AT_ONCE)
            for k, J in enumerate(contact_jacobians(model, q[span])):
                velocity[k, span] = np.einsum("sij,sj->si", J[:, :3, 6:], rates[span])
                # At zero, the columns of yaw and pitch are z x place and y x place.
                place[k, span] = np.stack([J[:, 1, 3], -J[:, 0, 3], J[:, 0, 4]], axis=1)
        stands = np.zeros(shape[:2])
        for k, contact in enumerate(model.contacts):
            closed = find_closed(recording.extra, contact.frame)
            stands[k] = 0.0 if closed is None else np.nan_to_num(closed) > 0.5
        return cls(place, velocity, stands)

    def find_stance(self) -> Mask:
        """Return where any foot stands (N,); everywhere if none ever does."""
        any_foot = np.asarray(self.stands.any(axis=0), dtype=np.bool_)
        return any_foot if any_foot.any() else ~any_foot

    def base_velocity(self, w: Array) -> tuple[Array, Array]:
        """Return the velocity (N, 3) in base axes at which feet stand, and how many do (N,)."""
        each = -self.velocity - np.cross(w, self.place)
        count = self.stands.sum(axis=0)
        return np.einsum("ks,ksi->si", self.stands, each) / np.maximum(count, 1.0)[:, None], count

    def slip(self, w: Array) -> float:
        """Return the mean square speed of feet that stand, at the velocity that suits them best."""
        v, count = self.base_velocity(w)
        speed = np.sum((v + self.velocity + np.cross(w, self.place)) ** 2, axis=2)
        several = self.stands * (count > 1)
        capped = np.minimum(speed, np.quantile(speed[several > 0], 0.9) if several.any() else 0.0)
        return float(np.sum(several * capped) / max(several.sum(), 1.0))


# When a foot is taken to roll: own choices, tested on virtual robots and a Solo12.

LONGEST_PIECE = 0.5
"""Longest piece of stance [s] over which a foot is followed."""
FEWEST_SAMPLES = 5
"""Samples of a piece."""
EDGE = 1.0 / 6.0
"""Part of every stance at both ends that is left out, where the foot lands and lifts."""
FEWEST_PIECES = 5
LEFT_BY_ROLLING = 0.5
"""Part of the squared displacement that rolling leaves in the median piece."""
SMALLEST_RADIUS = 2e-3
LARGEST_RADIUS = 0.2
"""Radii of feet [m]."""
LOOKED_AT = 20_000
"""Samples of a recording that are looked at."""


def set_rolling_radii(model: RobotModel, recordings: Sequence[Recording]) -> RobotModel:
    """Return a robot whose contacts of unstated radius have that on which they roll, if any."""
    unstated = [contact.radius is None and not contact.flat for contact in model.contacts]
    if not any(unstated):
        return model
    radii = estimate_rolling_radii(model, recordings)
    return replace(
        model,
        contacts=tuple(
            replace(contact, radius=radius) if open_ and radius else contact
            for contact, radius, open_ in zip(model.contacts, radii, unstated, strict=True)
        ),
    )


def estimate_rolling_radii(
    model: RobotModel, recordings: Sequence[Recording]
) -> list[float | None]:
    """Return the radius [m] on which each contact rolls; None where it does not show one."""
    flat = replace(
        model, contacts=tuple(replace(contact, flat=True, radius=0.0) for contact in model.contacts)
    )
    pieces: list[list[tuple[Array, Array]]] = [[] for _ in model.contacts]
    for recording in recordings:
        part = recording.taken(slice(0, LOOKED_AT))
        readable = np.isfinite(part.rate) and bool(np.all(np.isfinite(part.q)))
        if part.contact is None or model.n_floating != 6 or not readable:
            continue
        for own, moved, closed in zip(
            pieces, _sum_displacements(flat, part.q), part.contact.T > 0.5, strict=True
        ):
            own.extend(_cut_stance_segments(moved, closed, part.rate))
    return [_estimate_radius(own) for own in pieces]


def _sum_displacements(model: RobotModel, q: Array) -> Array:
    """Return the sums of displacements and turns (n_contacts, N, 6) of each contact's frame."""
    steps = [np.zeros((len(model.contacts), 1, 6))]
    for start in range(0, len(q) - 1, SAMPLES_AT_ONCE):
        own = q[start : start + SAMPLES_AT_ONCE + 1]
        J = np.stack(contact_jacobians(model, own))
        middle = 0.5 * (J[:, 1:] + J[:, :-1])
        steps.append(np.einsum("csij,sj->csi", middle, np.diff(own, axis=0)))
    return np.cumsum(np.concatenate(steps, axis=1), axis=1)


def _cut_stance_segments(moved: Array, closed: Mask, rate: float) -> Iterator[tuple[Array, Array]]:
    """Yield displacement and what a radius of 1 m would give, (2 n,) each, of pieces of stance."""
    changes = np.flatnonzero(np.diff(np.r_[False, closed, False].astype(np.int8)))
    for start, stop in changes.reshape(-1, 2).tolist():
        edge = round(EDGE * (stop - start))
        stance = moved[start + edge : stop - edge]
        parts = max(1, round(len(stance) / (LONGEST_PIECE * rate)))
        for piece in np.array_split(stance, parts):
            if len(piece) >= FEWEST_SAMPLES:
                off = piece - piece.mean(axis=0)
                yield off[:, :2].ravel(), np.stack([off[:, 4], -off[:, 3]], axis=1).ravel()


def _estimate_radius(pieces: Sequence[tuple[Array, Array]]) -> float | None:
    """Return the median radius, weighted by the turns of pieces, if the foot rolls on it."""
    if len(pieces) < FEWEST_PIECES:
        return None
    turns = np.array([x @ x for _, x in pieces])
    radii = np.array([y @ x for y, x in pieces]) / np.maximum(turns, 1e-30)
    order = np.argsort(radii)
    half = np.searchsorted(np.cumsum(turns[order]), 0.5 * turns.sum())
    radius = float(radii[order][half])
    left = [np.sum((y - radius * x) ** 2) / max(float(y @ y), 1e-30) for y, x in pieces]
    rolls = SMALLEST_RADIUS < radius < LARGEST_RADIUS and np.median(left) < LEFT_BY_ROLLING
    return round(radius, 4) if rolls else None


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
                contact[find_finite_rows(wrench), k] = 0.0
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


# When forces are read wrongly: own choices, tested on virtual robots.

FORCE_WINDOW = 0.1
"""Time [s] over which forces are averaged."""
FORCE_SHARE = 0.25
"""Part of the squared disagreement with the weight that another reading leaves at most."""
FORCE_OFTEN = 0.1
"""Part of the time in which flags and forces disagree, from which that is said."""


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
    known = find_finite_rows(world)
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
    best = find_better_reading(off, world, readings.items(), FORCE_SHARE)
    if best is not None:
        yield Finding(
            "force_axes",
            "error",
            f"measured forces at {join_names([place.frame for place in own])} are {best}: so read,"
            " they carry the weight of the robot; as forces on it in axes of these frames they do"
            " not",
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
