"""Events of a log: contact, fault of a joint, change of payload."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from asbuilt.apps.watch.contact import Contact, estimate_contact
from asbuilt.apps.watch.observed import Observed
from asbuilt.apps.watch.observer import Observer
from asbuilt.apps.watch.thresholds import Thresholds
from asbuilt.arrays import Array, Indices
from asbuilt.codec import make_plain
from asbuilt.description import RobotModel
from asbuilt.dynamics import observation_matrix

Kind = Literal["contact", "fault", "payload"]


# Hold when an event counts as a fault or a payload.

# Duration [s] from which an offset of one joint counts as a fault, and a payload is considered
EVENT_PERSISTENT = 2.0
# Share of an event in which a joint must be beyond its threshold to take part in an offset
EVENT_MOSTLY = 0.5
# Share of its threshold that the residual of a joint without a part in an event may reach
EVENT_QUIET = 0.7
EVENT_EXPLAINED = 0.8  # Share of the residual's squares that a payload must explain
# Largest condition number (columns scaled) of the four parameters of a payload
EVENT_DETERMINED = 200.0
EVENT_CLEAR = 3.0  # Least mass of a payload, in standard errors
EVENT_MOST_ROWS = 400  # Samples that a payload is fitted to
EVENT_CLUSTER = 1.0  # Time [s] in which errors of the model count as one


@dataclass(frozen=True, slots=True, eq=False)
class Event:
    """Hold one time in which a residual is beyond its threshold.

    Parameters
    ----------
    kind
        `"contact"`; `"fault"`: a lasting offset of one joint alone, as of a sensor, a gain or a
        brake; `"payload"`: a lasting change that a change of mass on the flange explains.
    start, end, peak
        Times [s] of the first and last sample beyond a threshold, and of the largest excess.
    joints
        Joints beyond their thresholds at any time, in the order of the chain.
    link
        Link at or beyond which a contact acts: the link of the last joint that responds.
    residual, threshold
        External torque and threshold at the peak, (n,) [N m or N].
    contact
        The force at the tool that explains the peak.
    mass, mass_error
        Change of mass [kg] and its standard error, of a payload.
    """

    kind: Kind
    start: float
    end: float
    peak: float
    joints: tuple[str, ...]
    link: str
    residual: Array
    threshold: Array
    contact: Contact
    mass: float | None = None
    mass_error: float | None = None

    @property
    def duration(self) -> float:
        """Time from the first to the last sample beyond a threshold [s]."""
        return self.end - self.start

    def as_document(self) -> dict[str, Any]:
        """Return plain numbers, texts and lists."""
        return dict(make_plain(self))


def find_events(
    observer: Observer,
    observed: Observed,
    scale: Array,
    limit: Array,
    thresholds: Thresholds,
    tool: tuple[int, Array],
    *,
    apart: float,
) -> tuple[Event, ...]:
    """Return the events of a log in order of time.

    Parameters
    ----------
    observer, observed
        The observer and what it made of the log.
    scale, limit
        Scale and threshold of the residual (N, n), of `Thresholds.of_log`.
    thresholds
        The thresholds.
    tool
        Link that carries the tool, counted from 0, and pose (4, 4) of the tool's frame in it.
    apart
        Time [s] without a residual beyond its threshold that ends an event.
    """
    beyond = np.abs(observed.residual) > limit
    places = np.flatnonzero(beyond.any(axis=1))
    if places.size == 0:
        return ()
    cuts = np.flatnonzero(np.diff(observed.t[places]) > apart) + 1
    return tuple(
        _make_event(
            observer, observed, scale, limit, thresholds, slice(part[0], part[-1] + 1), tool
        )
        for part in np.split(places, cuts)
    )


def join_events(events: Sequence[Event], apart: float) -> tuple[Event, ...]:
    """Return events with those closer than `apart` [s] joined, as chunks of a log divide them."""
    found: list[Event] = []
    for event in events:
        if found and event.start - found[-1].end <= apart:
            before = found.pop()
            larger = max(
                (before, event),
                key=lambda each: float(np.max(np.abs(each.residual) / each.threshold)),
            )
            names = tuple(dict.fromkeys((*before.joints, *event.joints)))
            found.append(replace(larger, start=before.start, end=event.end, joints=names))
        else:
            found.append(event)
    return tuple(found)


def _make_event(
    observer: Observer,
    observed: Observed,
    scale: Array,
    limit: Array,
    thresholds: Thresholds,
    part: slice,
    tool: tuple[int, Array],
) -> Event:
    model = observer.model
    t = observed.t[part]
    ratio = np.abs(observed.residual[part]) / limit[part]
    peak = part.start + int(np.argmax(ratio.max(axis=1)))
    responding = np.flatnonzero((ratio > 1.0).any(axis=0))
    here = slice(peak, peak + 1)
    q = observed.q[peak]
    r = observed.residual[peak]
    error = thresholds.covariance(observed.part(here), scale[here], observer.model_error)
    event = Event(
        kind="contact",
        start=float(t[0]),
        end=float(t[-1]),
        peak=float(observed.t[peak]),
        joints=tuple(model.joint_names[k] for k in responding),
        link=model.link_names[_find_last_joint(model, responding, ratio)],
        residual=r,
        threshold=limit[peak],
        contact=estimate_contact(model, q, r, error, *tool),
    )
    if event.duration < EVENT_PERSISTENT:
        return event
    mass = estimate_payload_change(observer, observed.part(part), scale[part], tool[0])
    if mass is not None:
        return replace(event, kind="payload", mass=mass[0], mass_error=mass[1])
    lasting = np.mean(ratio > 1.0, axis=0) > EVENT_MOSTLY
    if lasting.sum() == 1 and np.all(np.quantile(ratio, 0.9, axis=0)[~lasting] < EVENT_QUIET):
        return replace(event, kind="fault")
    return event


def _find_last_joint(model: RobotModel, responding: Indices, ratio: Array) -> int:
    """Return the responding joint farthest from the root; of branches that responding most."""
    routes = {k: model.ancestors(k) for k in responding.tolist()}
    carriers = {k for route in routes.values() for k in route[:-1]}
    ends = sorted(routes.keys() - carriers)
    return int(max(ends, key=lambda k: (float(ratio[:, k].max()), len(routes[k]))))


def estimate_payload_change(
    observer: Observer, observed: Observed, scale: Array, link: int
) -> tuple[float, float] | None:
    """Return the change of mass [kg] at a link that explains the residual, and its error, or None.

    `scale` (N, n) are standard deviations of the residual. Errors of the model last as long as a
    pose does, so the standard error is computed over clusters of `RULES.cluster` seconds (Liang
    and Zeger, 1986).
    """
    t = observed.t
    memory = 5.0 / (2.0 * np.pi * observer.bandwidth) / float(np.median(np.diff(t)))
    rows = np.arange(0, len(t), max(1, round(max(memory, len(t) / EVENT_MOST_ROWS))))
    weight = 1.0 / np.maximum(scale[rows], 1e-9).ravel()
    columns = 10 * link + np.arange(6, 10)
    state = (observed.q[rows], observed.qd[rows], observed.qdd[rows])
    A = weight[:, None] * observation_matrix(observer.model, *state, columns=columns)
    b = -weight * observed.residual[rows].ravel()
    lengths = np.linalg.norm(A, axis=0)
    if len(b) <= 8 or np.any(lengths == 0.0) or np.linalg.cond(A / lengths) > EVENT_DETERMINED:
        return None
    found = np.linalg.lstsq(A, b, rcond=None)[0]
    left = b - A @ found
    times = np.repeat(t[rows], observed.q.shape[1])
    error = _estimate_clustered_error(A, left, np.floor((times - t[0]) / EVENT_CLUSTER))
    explained = float(np.sum(left**2)) <= (1.0 - EVENT_EXPLAINED) * float(b @ b)
    return (float(found[3]), error) if explained and abs(found[3]) >= EVENT_CLEAR * error else None


def _estimate_clustered_error(A: Array, left: Array, cluster: Array) -> float:
    """Return the standard error of the last of p parameters, from sums over clusters of rows."""
    names, place = np.unique(cluster, return_inverse=True)
    scores = np.zeros((len(names), A.shape[1]))
    np.add.at(scores, place, A * left[:, None])
    spread = np.linalg.solve(A.T @ A, scores.T)[-1]
    return float(np.sqrt(np.sum(spread**2) * len(names) / max(len(names) - A.shape[1], 1)))
