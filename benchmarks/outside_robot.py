"""Robots whose torque another engine computes: Pinocchio's or MuJoCo's inverse dynamics of a URDF.

A log is made at `FINE` Hz from a smooth motion of the links: rigid bodies by the engine, then what
acts between link and motor (springs, elasticity), what acts at the motor (friction, rotor), and at
last what the log does to it (gain, zero, delay, encoder, noise).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import mujoco
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import RobotModel
from asbuilt.excitation.motions.motion import Motion
from asbuilt.experiment.recording import Recording, TorqueSource
from asbuilt.writers.models.urdf import format_urdf

Array = NDArray[np.float64]
Engine = Literal["pinocchio", "mujoco"]

FINE = 1000.0
"""Rate [Hz] at which a robot moves; logs take every so many of its samples."""
GRAVITY = np.array([0.0, 0.0, -9.81])
STRIBECK_POWER = 2.0


@dataclass(frozen=True)
class Sensors:
    """What a log does to motion and torque; noise (n,) is a standard deviation [N m or N].

    `coloured` is the share of it that is first-order noise of so many seconds, `turns` whether a
    joint has encoder counts (the others are logged to 10 um).
    """

    noise: Array
    counts: float = 2.0**18
    turns: tuple[bool, ...] = ()
    correlation_time: float = 0.1
    white: float = 0.0
    velocity: bool = False

    def positions(self, q: Array) -> Array:
        step = np.where(self.turns, 2.0 * np.pi / self.counts, 1e-5)
        return np.asarray(step * np.round(q / step))

    def errors(self, rng: np.random.Generator, n_samples: int, rate: float) -> Array:
        forget = np.exp(-1.0 / (rate * self.correlation_time))
        warm_up = int(20 * rate * self.correlation_time)
        shape = n_samples + warm_up, len(self.noise)
        slow = lfilter([np.sqrt(1.0 - forget**2)], [1.0, -forget], rng.normal(size=shape), axis=0)
        fast = rng.normal(size=(n_samples, len(self.noise)))
        share = self.white
        return np.asarray(
            self.noise * (np.sqrt(1.0 - share) * slow[warm_up:] + np.sqrt(share) * fast)
        )


class Logged(NamedTuple):
    """Times and, each (N, n), positions, rates and torques."""

    t: Array
    q: Array
    qd: Array
    qdd: Array
    tau: Array


@dataclass(frozen=True)
class OutsideRobot:
    """A robot as it is; arrays have one value per joint.

    `turn` is the rotation vector [rad] by which its base is turned in the world, `stiffness` is
    that between motor and link, `mix` turns joint rates into motor rates, `bristle` is the
    stiffness length of Dahl's friction (0: friction is Coulomb's), `beside` are further torques on
    the links by joint, `nameless` is one of all positions and velocities that no effect is the name
    of, `warming` is the share of viscous friction that goes over a log. `crosstalk` is the share of
    another joint's torque that a sensor adds, by its joint and the other one, `backlash` the play
    [rad] between motor and link, `efficiency` are the shares of the load that friction takes where
    the motor drives and where the load does.
    """

    bodies: RobotModel
    viscous: Array
    coulomb: Array
    offset: Array
    armature: Array
    turn: Array = field(default_factory=lambda: np.zeros(3))
    stiffness: Mapping[int, float] = field(default_factory=dict)
    mix: Mapping[tuple[int, int], float] = field(default_factory=dict)
    bristle: Mapping[int, float] = field(default_factory=dict)
    stribeck: Mapping[int, tuple[float, float]] = field(default_factory=dict)
    quadratic: Mapping[int, float] = field(default_factory=dict)
    load_share: Mapping[int, float] = field(default_factory=dict)
    efficiency: Mapping[int, tuple[float, float]] = field(default_factory=dict)
    backlash: Mapping[int, float] = field(default_factory=dict)
    crosstalk: Mapping[tuple[int, int], float] = field(default_factory=dict)
    beside: Mapping[int, Callable[[Array], Array]] = field(default_factory=dict)
    nameless: Callable[[Array, Array], Array] | None = None
    gain: Mapping[int, float] = field(default_factory=dict)
    zero: Mapping[int, float] = field(default_factory=dict)
    delay: float = 0.0
    warming: float = 0.0
    engine: Engine = "pinocchio"

    @property
    def gravity(self) -> Array:
        """Gravity in the frame of the turned base: `R^T g`."""
        return np.asarray(Rotation.from_rotvec(self.turn).inv().apply(GRAVITY))

    def rigid(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the torque of the bodies (N, n)."""
        torque = {"pinocchio": pinocchio_torque, "mujoco": mujoco_torque}[self.engine]
        return torque(self.bodies, q, qd, qdd, self.gravity)

    def logged(self, motion: Motion, rate: float = FINE) -> Logged:
        """Return what a log without noise or counts has of a motion."""
        move = motion.sample(rate)
        t, q, qd, qdd = (np.array(x) for x in (move.t, move.q, move.qd, move.qdd))
        n, load = q.shape[1], self.rigid(q, qd, qdd)
        for k, torque in self.beside.items():
            load[:, k] += torque(q[:, k])
        lags = [(k, load[:, k] / stiffness) for k, stiffness in self.stiffness.items()]
        lags += [(k, 0.5 * play * lean(load[:, k])) for k, play in self.backlash.items()]
        for k, lag in lags:
            ahead = np.gradient(lag, t)
            q[:, k] += lag
            qd[:, k] += ahead
            qdd[:, k] += np.gradient(ahead, t)
        tau = self._driven(t, q, qd, qdd, load)
        tau = _at(t, tau, t - self.delay) * _each(self.gain, n, 1.0)
        sensor = np.eye(n)
        for place, share in self.crosstalk.items():
            sensor[place] = share
        tau = tau @ sensor.T
        return Logged(t, q + _each(self.zero, n, 0.0), qd, qdd, tau)

    def at_states(self, log: Logged) -> Array:
        """Return the torque (N, n) in the states of a log, as if links and motors were one."""
        load = self.rigid(log.q, log.qd, log.qdd)
        for k, torque in self.beside.items():
            load[:, k] += torque(log.q[:, k])
        tau = self._driven(log.t, log.q, log.qd, log.qdd, load)
        return _at(log.t, tau, log.t - self.delay) * _each(self.gain, log.q.shape[1], 1.0)

    def _driven(self, t: Array, q: Array, qd: Array, qdd: Array, load: Array) -> Array:
        """Return a load with friction, rotors and offsets."""
        mix = np.eye(q.shape[1])
        for place, share in self.mix.items():
            mix[place] = share
        s, sd, sdd = q @ mix.T, qd @ mix.T, qdd @ mix.T
        more = 0.0 if self.nameless is None else self.nameless(q, qd)
        return np.asarray(load + self._drive(t, s, sd, sdd, load) @ mix + self.offset + more)

    def _drive(self, t: Array, s: Array, sd: Array, sdd: Array, load: Array) -> Array:
        """Return the torque of friction and rotors in the motors' coordinates (N, n)."""
        sign = np.sign(sd)
        viscous = self.viscous * (1.0 - self.warming * (t / t[-1]))[:, None]
        sliding = np.array(sign)
        for k, length in self.bristle.items():
            sliding[:, k] = dahl(s[:, k], length)
        torque = viscous * sd + self.coulomb * sliding + self.armature * sdd
        for k, (force, speed) in self.stribeck.items():
            fading = np.exp(-(np.abs(sd[:, k] / speed) ** STRIBECK_POWER))
            torque[:, k] += force * fading * sign[:, k]
        for k, factor in self.quadratic.items():
            torque[:, k] += factor * sd[:, k] * np.abs(sd[:, k])
        for k, share in self.load_share.items():
            torque[:, k] += share * np.abs(load[:, k]) * sign[:, k]
        for k, (driving, driven) in self.efficiency.items():
            share = np.where(load[:, k] * sign[:, k] > 0.0, driving, driven)
            torque[:, k] += share * np.abs(load[:, k]) * sign[:, k]
        return np.asarray(torque)

    def log(
        self,
        motion: Motion,
        sensors: Sensors,
        rate: float,
        rng: np.random.Generator,
        *,
        source: str = "outside",
        torque_source: TorqueSource = "unknown",
    ) -> Recording:
        """Return a recording of a motion."""
        clean = self.logged(motion)
        ticks = np.arange(int(clean.t[-1] * rate) + 1) / rate
        q, tau = (_at(clean.t, x, ticks) for x in (clean.q, clean.tau))
        tau = tau + sensors.errors(rng, len(ticks), rate)
        q = sensors.positions(q)
        return Recording(
            t=ticks,
            q=q,
            tau=tau,
            qd=np.gradient(q, ticks, axis=0) if sensors.velocity else None,
            joint_names=self.bodies.joint_names,
            source=source,
            torque_source=torque_source,
        )

    def true_parameters(self) -> Array:
        """Return standard parameters of links, then viscous, Coulomb and offset by joint."""
        drives = np.column_stack(
            [(1.0 - 0.5 * self.warming) * self.viscous, self.coulomb, self.offset]
        )
        return np.concatenate([self.bodies.parameters, drives.ravel()])


SOFT = 0.03
"""Share of the RMS load within which gears change from one flank to the other."""


def lean(load: Array) -> Array:
    """Return on which flank a load (N,) lies, in [-1, 1]."""
    return np.asarray(np.tanh(load / (SOFT * np.sqrt(np.mean(load**2)))))


def dahl(x: Array, length: float) -> Array:
    """Return friction over sliding friction of bristles, `dz/dx = (1 - sign(dx) z) / length`.

    Source: Dahl, A solid friction model, Aerospace Corporation TOR-0158, 1968, with exponent 1.
    """
    z = np.zeros(len(x))
    for i in range(1, len(x)):
        step = x[i] - x[i - 1]
        side = np.sign(step)
        z[i] = side + (z[i - 1] - side) * np.exp(-abs(step) / length)
    return z


def _each(values: Mapping[int, float], n: int, otherwise: float) -> Array:
    return np.array([values.get(k, otherwise) for k in range(n)])


def _at(t: Array, x: Array, times: Array) -> Array:
    """Return columns at other times, linear between samples of `FINE`; the ends are held."""
    return np.column_stack([np.interp(times, t, column) for column in x.T])


def _urdf(bodies: RobotModel) -> str:
    bare = replace(
        bodies, frames=(), joints=tuple(replace(j, drive=type(j.drive)()) for j in bodies.joints)
    )
    return format_urdf(bare)


def pinocchio_robot(bodies: RobotModel, gravity: Array = GRAVITY) -> pin.Model:
    """Return the robot as Pinocchio reads its URDF."""
    model = pin.buildModelFromXML(_urdf(bodies))
    assert tuple(model.names)[1:] == bodies.joint_names, tuple(model.names)
    model.gravity.linear = gravity
    return model


def pinocchio_torque(bodies: RobotModel, q: Array, qd: Array, qdd: Array, gravity: Array) -> Array:
    """Return the torque (N, n) by `pin.rnea`."""
    model = pinocchio_robot(bodies, gravity)
    data = model.createData()
    configurations = [configuration(model, each) for each in q]
    return np.array(
        [pin.rnea(model, data, *row) for row in zip(configurations, qd, qdd, strict=True)]
    )


def configuration(model: pin.Model, q: Array) -> Array:
    """Return positions (n,) as Pinocchio takes them: joints without limits by cosine and sine."""
    if model.nq == len(q):
        return q
    columns: list[Array] = []
    for joint, x in zip(list(model.joints)[1:], q, strict=True):
        columns += [np.cos(x), np.sin(x)] if joint.nq == 2 else [x]
    return np.array(columns)


def mujoco_torque(bodies: RobotModel, q: Array, qd: Array, qdd: Array, gravity: Array) -> Array:
    """Return the torque (N, n) by `mj_inverse`, without contacts and limits."""
    model = mujoco.MjModel.from_xml_string(_urdf(bodies))
    model.opt.gravity[:] = gravity
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data, found = mujoco.MjData(model), np.empty(q.shape)
    place = [model.joint(name).qposadr[0] for name in bodies.joint_names]
    for i, row in enumerate(zip(q, qd, qdd, strict=True)):
        data.qpos[place], data.qvel[place], data.qacc[place] = row
        mujoco.mj_inverse(model, data)
        found[i] = data.qfrc_inverse[place]
    return found


def other_bodies(
    model: RobotModel,
    rng: np.random.Generator,
    *,
    mass: float = 0.05,
    centre: float = 0.05,
    shape: float = 0.05,
) -> RobotModel:
    """Return the robot with bodies as far off as CAD usually is.

    Each pseudo-inertia becomes `m A P A^T`, with `A` a stretch and a shift: masses are off by
    `mass`, centres by `centre` of the radius of gyration and 3 mm, moments of inertia by about
    twice `shape`.
    """
    bodies = []
    for link in model.links:
        P = np.array(link.inertia.pseudo_inertia)
        factor, stretch = 1.0 + mass * rng.normal(), shape * rng.normal(size=(3, 3))
        shift = rng.normal(size=3)
        if link.inertia.mass > 0.0:
            com = link.inertia.com
            spread = np.trace(P[:3, :3] / P[3, 3] - np.outer(com, com))
            radius = float(np.sqrt(max(float(spread), 0.0)))
            A = np.eye(4)
            A[:3, :3] += 0.5 * (stretch + stretch.T)
            A[:3, 3] = (centre * radius + 0.003) * shift + com - A[:3, :3] @ com
            P = factor * A @ P @ A.T
        bodies.append(LinkInertia.from_pseudo_inertia(P).parameters)
    return model.with_parameters(np.concatenate(bodies))


def with_body(model: RobotModel, link: int, body: LinkInertia) -> RobotModel:
    """Return the robot with a body in the frame of a link added to that link."""
    parameters = np.array(model.parameters).reshape(-1, 10)
    parameters[link] += body.parameters
    return model.with_parameters(parameters.ravel())


def mean_inertia(bodies: RobotModel, q: Array) -> Array:
    """Return the mean inertia about each joint (n,) in positions (N, n): torque of unit qdd."""
    still, n = np.zeros_like(q), q.shape[1]
    torque = (
        pinocchio_torque(bodies, q, still, still + a, np.zeros(3))[:, k]
        for k, a in enumerate(np.eye(n))
    )
    return np.array([np.mean(each) for each in torque])
