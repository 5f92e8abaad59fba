"""How fast a base moves by feet that stand still, with an accelerometer between their steps.

Foot k stands at `p` of the base and moves at `J q'` while the base is held, so that the velocity of
the base in its own axes is `v = -J q' - w x p`. The accelerometer integrates the specific force f:
`v = integral (R (f - b) + g) + v0` in world axes, with an offset b that feet determine.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array, Mask
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.contact import SAMPLES_AT_ONCE, contact_jacobians
from asbuilt.experiment.free_base.measured_forces import detect_force
from asbuilt.experiment.recording import Recording


@dataclass(frozen=True, slots=True)
class InertialRules:
    """Say how a sensor is combined with feet, and when it is read wrongly: own choices.

    Tested on a virtual Go2 and Solo12.
    """

    tilt: float = 0.1
    """Frequency [Hz] below which gravity says how the base is tilted, above it the rates: a robot
    that walks comes back within 10 s, or its feet say by how much it does not."""
    drift: float = 0.2
    """Frequency [Hz] below which feet say how fast the base moves, above it the accelerometer."""
    updates: int = 5
    """Corrections of the tilt, each of which is right to first order."""
    turn: float = 1.0
    """Frequency [Hz] below which gravity turns against the base as its rates say."""
    gravity: float = 0.25
    """Part by which the mean specific force may differ from that of gravity."""
    upright: float = np.deg2rad(60.0)
    """Largest mean angle between gravity and where it is expected."""
    share: float = 0.5
    """Part of the squared disagreement that is left by another reading, if that is right."""


RULES = InertialRules()


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
        place, velocity = np.zeros(shape), np.zeros(shape)
        for start in range(0, len(q), SAMPLES_AT_ONCE):
            span = slice(start, start + SAMPLES_AT_ONCE)
            for k, J in enumerate(contact_jacobians(model, q[span])):
                velocity[k, span] = np.einsum("sij,sj->si", J[:, :3, 6:], rates[span])
                # At zero, the columns of yaw and pitch are z x place and y x place.
                place[k, span] = np.stack([J[:, 1, 3], -J[:, 0, 3], J[:, 0, 4]], axis=1)
        stands = np.zeros(shape[:2])
        for k, contact in enumerate(model.contacts):
            name = f"contact_{contact.frame}"
            flag = recording.extra.get(name)
            if flag is None and f"{name}_fz" in recording.extra:
                flag = detect_force(recording.extra[f"{name}_fz"])
            if flag is not None:
                stands[k] = np.nan_to_num(flag) > 0.5
        return cls(place, velocity, stands)

    def standing(self) -> Mask:
        """Return where any foot stands (N,); everywhere if none ever does."""
        any_foot = np.asarray(self.stands.any(axis=0), dtype=np.bool_)
        return any_foot if any_foot.any() else ~any_foot

    def base_velocity(self, w: Array) -> tuple[Array, Array]:
        """Return the velocity (N, 3) in base axes at which feet stand, and how many do (N,)."""
        each = -self.velocity - np.cross(w, self.place)
        count = self.stands.sum(axis=0)
        total = np.einsum("ks,ksi->si", self.stands, each)
        return total / np.maximum(count, 1.0)[:, None], count

    def slip(self, w: Array) -> float:
        """Return the mean square speed of feet that stand, at the velocity that suits them best."""
        v, count = self.base_velocity(w)
        speed = np.sum((v + self.velocity + np.cross(w, self.place)) ** 2, axis=2)
        several = self.stands * (count > 1)
        capped = np.minimum(speed, np.quantile(speed[several > 0], 0.9) if several.any() else 0.0)
        return float(np.sum(several * capped) / max(several.sum(), 1.0))


def velocity_of_base(
    R: Array, f: Array, feet: Feet, w: Array, rate: float, gravity: Array
) -> tuple[Array, Array]:
    """Return the velocity of the base (N, 3) in world axes, and the offset of the sensor (3,).

    The velocity is the integral of the accelerometer, but for what it drifts by, which feet that
    stand say: `v = integral (R (f - b) + g) + v0`, and slow deviations from that.
    """
    fallen = integral(np.einsum("sij,sj->si", R, f) + gravity, 1.0 / rate)
    own, count = feet.base_velocity(w)
    known = np.flatnonzero(count > 0)
    if known.size < rate:  # it hardly touches: the drift is not known, and no velocity enters
        return fallen, np.zeros(3)
    off = (fallen - np.einsum("sij,sj->si", R, own))[known]
    turned = integral(R.reshape(-1, 9), 1.0 / rate).reshape(-1, 3, 3)
    start = np.broadcast_to(np.eye(3), (known.size, 3, 3))
    columns = np.concatenate([turned[known], start], axis=2)
    fit = np.linalg.lstsq(columns.reshape(-1, 6), off.ravel(), rcond=None)[0]
    left = off - columns @ fit
    left = np.stack([np.interp(np.arange(len(f)), known, x) for x in left.T], axis=1)
    steady = turned @ fit[:3] + fit[3:]
    return np.asarray(fallen - steady - slow_part(left, RULES.drift, rate)), fit[:3]


def slow_part(x: Array, frequency: float, rate: float) -> Array:
    """Return x (N, m) below a frequency, by a Gaussian window that mirrors the ends.

    A recursive filter extends them so that it passes through the first and last sample, which are
    as noisy as any.
    """
    from scipy.ndimage import gaussian_filter1d  # noqa: PLC0415 - light start

    width = rate / (2.0 * np.pi * frequency)
    return np.asarray(gaussian_filter1d(x, width, axis=0, mode="reflect"))


def integral(x: Array, dt: float) -> Array:
    """Return the integral (N, m) from the first sample on, by trapezoids."""
    return np.vstack([np.zeros(x.shape[1]), np.cumsum(0.5 * dt * (x[1:] + x[:-1]), axis=0)])
