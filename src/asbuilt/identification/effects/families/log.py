"""Errors of the log: its clock, zero positions, gains, and what drifts or saturates."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.parameters import parameter_names
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Cure, Finding
from asbuilt.identification.effects.effect import (
    Described,
    Effect,
    FoundEffect,
    Motion,
    Variant,
    effect,
)
from asbuilt.tables import format_plus_minus

ANGLE = 1e-4
LENGTH = 1e-5
SPEED = 1e-3
"""Steps of central differences: angle [rad], length [m], share of the speed."""
DEAD = 0.15
"""Part of the model's torque below which a torque channel does not follow the motion."""
RATES = (0.1, 0.125, 0.2, 0.25, 0.4, 0.5, 2.0, 2.5, 4.0, 5.0, 8.0, 10.0)
"""Factors by which clocks are wrong: ratios of usual rates (1000, 500, 400, 250, 200, 125, 100 Hz),
samples left out, another unit."""


class _OfTorque(Effect):
    """Act on the logged torque of single joints."""

    of_log = True

    def variants(self, robot: Described) -> Iterator[Variant]:
        """Yield the effect at every joint."""
        # Local: each joint's column has only its own torque, which shares one slot of all joints.
        yield Variant(self, 1, local=True, joints=tuple(range(robot.model.n_joints)))


@effect
class Clock(Effect):
    """Run the motion faster than logged by a share."""

    key = "clock"
    title = "wrong clock"
    of_log = True
    least = 0.01
    removable = True
    of_shares = True
    shown = 0.05
    starts = tuple(factor - 1.0 for factor in RATES)
    near = 0.3
    about = 0.06
    """Largest share by which a clock drifts or is set wrong; distance from a ratio of rates."""

    def is_possible(self, values: Array, joint: int | None, robot: Described) -> bool:
        """Return whether velocities, which do not follow the clock, admit its error.

        A clock that is off by much is off by a ratio of usual rates: errors of gains, and masses
        that CAD lacks, imitate others.
        """
        # By the logarithm, in which a ratio of rates and its inverse are as far off.
        rate = 1.0 + float(values[0])
        usual = abs(values[0]) <= self.near or any(
            abs(np.log(rate / factor)) <= self.about for factor in RATES if rate > 0.0
        )
        # Logged velocities come from another clock, so that they bound the error of this one.
        admitted = abs(values[0]) <= robot.clock_bound
        return super().is_possible(values, joint, robot) and usual and admitted

    def variants(self, robot: Described) -> Iterator[Variant]:
        """Yield the clock of the log."""
        yield Variant(self, 1, local=False)

    def columns(self, variant: Variant, motion: Motion) -> list[Array]:
        """Return the derivative of the torque by the logarithm of the clock's rate."""
        # Time that runs faster by f scales velocity by f and acceleration by f^2; positions stay.
        up, down = (
            motion.torque_of(motion.q, motion.qd * f, motion.qdd * f**2)[1]
            for f in (1.0 + SPEED, 1.0 - SPEED)
        )
        return [(up - down) / (2.0 * SPEED)]

    def without(
        self, model: RobotModel, samples: Sequence[Samples], joint: int | None, values: Array
    ) -> tuple[RobotModel, list[Samples]]:
        """Return samples of a motion that is so much faster."""
        f = 1.0 + float(values[0])
        return model, [
            replace(recording, qd=f * recording.qd, qdd=f**2 * recording.qdd)
            for recording in samples
        ]

    def unseen(self, sizes: str) -> Finding:
        """Return below which sizes the log does not show it."""
        return Finding(
            "clock_unseen",
            "info",
            f"A wrong clock would not show in this log {sizes}: other parameters take its place",
            Cure("compare the rate with another clock, or record faster motions as well"),
        )

    def finding(self, found: FoundEffect, model: RobotModel) -> Finding:
        """Return what a wrong clock does, and by which factor it is corrected."""
        pace = "faster" if found.estimate > 0.0 else "slower"
        rate = 1.0 + found.estimate
        return Finding(
            "clock_wrong",
            "warning",
            f"The torques belong to a motion {_format_percent(found)} {pace} than the clock of"
            " the log says, for only then do masses act alike by gravity and"
            f" acceleration{_word_worth(found)}",
            Cure(
                f"check the sampling rate; if it is wrong, multiply the times by {1.0 / rate:.4g}"
                f" (time_factor = {1.0 / rate:.4g} in a recording sheet), or the rate by {rate:.4g}"
            ),
        )


@effect
class Zero(Effect):
    """Log the positions of a joint too large [rad or m]."""

    key = "zero"
    title = "wrong zero position"
    of_log = True
    units = "rad", "m"
    least = 0.005
    """A third of a degree, or 5 mm."""
    removable = True
    farthest = 0.35
    """20 degrees: a joint that is off by more is another one, or has another sign."""
    shown = 0.035
    """Two degrees, or 35 mm."""

    def shown_in(self, revolute: bool) -> tuple[float, str]:
        """Return the factor and the unit in which its size is read: degrees or mm."""
        return (float(np.rad2deg(1.0)), "deg") if revolute else (1e3, "mm")

    def variants(self, robot: Described) -> Iterator[Variant]:
        """Yield the zero position of each joint."""
        for k in range(robot.model.n_joints):
            yield Variant(self, 1, local=False, joint=k)

    def columns(self, variant: Variant, motion: Motion) -> list[Array]:
        """Return minus the derivative of the torque by the position of the joint."""
        k = variant.joint or 0
        step = np.zeros(motion.q.shape[1])
        step[k] = ANGLE if motion.robot.model.joints[k].is_revolute else LENGTH
        up, down = (
            motion.torque_of(x, motion.qd, motion.qdd)[1]
            for x in (motion.q + step, motion.q - step)
        )
        # Logged too large, the robot stands at less: the derivative has a minus.
        return [(down - up) / (2.0 * step[k])]

    def without(
        self, model: RobotModel, samples: Sequence[Samples], joint: int | None, values: Array
    ) -> tuple[RobotModel, list[Samples]]:
        """Return samples with positions of the joint so much smaller."""
        off = np.zeros(model.n_joints)
        off[joint or 0] = values[0]
        return model, [replace(recording, q=recording.q - off) for recording in samples]

    def unseen(self, sizes: str) -> Finding:
        """Return below which sizes the log does not show it."""
        return Finding(
            "zero_unseen",
            "info",
            f"A wrong zero position would not show in this log {sizes}: other parameters take its"
            " place",
            Cure("calibrate these joints, or record more poses"),
        )

    def finding(self, found: FoundEffect, model: RobotModel) -> Finding:
        """Return by how much a zero position is off."""
        k = model.joint_names.index(str(found.joint))
        revolute = model.joints[k].is_revolute
        size = self.text_of(abs(found.estimate), found.std_error, revolute=revolute)
        return Finding(
            "zero_position_wrong",
            "warning",
            f"Positions of {found.joint} seem logged {size} too"
            f" {'large' if found.estimate > 0.0 else 'small'}: the zero position is not the"
            f" description's{_word_worth(found)}",
            Cure(
                "check the calibration of the joint, or correct it in a recording sheet:"
                f" zero = {_write_joint_list(model, k, '0', f'{found.estimate:.3g}')}"
            ),
            joint=found.joint,
        )


@effect
class Gain(_OfTorque):
    """Log the torques of a joint too large by a share."""

    key = "gain"
    title = "wrong torque gain"
    least = 0.03
    """Accuracy of the gains that makers state."""
    farthest = 1.15
    """Gain error of a dead channel: beyond it, the column is another quantity."""
    removable = True
    of_shares = True
    shown = 0.1

    def columns(self, variant: Variant, motion: Motion) -> list[Array]:
        """Return the torque of the model."""
        return [motion.torques[1]]

    def advanced(self, values: Array, step: Array) -> Array:
        # Dividing by nearly 0 would only blow up noise.
        """Return the values after a step; a dead channel is not taken out."""
        return super().advanced(values, step) if 1.0 + values[0] > DEAD else step

    def without(
        self, model: RobotModel, samples: Sequence[Samples], joint: int | None, values: Array
    ) -> tuple[RobotModel, list[Samples]]:
        """Return samples with torques of the joint so much smaller; a dead channel stays."""
        gain = np.ones(model.n_joints)
        gain[joint or 0] = 1.0 + float(values[0])
        gain = np.where(gain > DEAD, gain, 1.0)
        return model, [replace(recording, tau=recording.tau / gain) for recording in samples]

    def unseen(self, sizes: str) -> Finding:
        """Return below which sizes the log does not show it."""
        return Finding(
            "gain_unseen",
            "info",
            f"A wrong torque gain would not show in this log {sizes}: other parameters take its"
            " place",
            Cure("calibrate these gains by a payload of known mass", call="find_gains"),
        )

    def finding(self, found: FoundEffect, model: RobotModel) -> Finding:
        """Return the gain, or that the torque is another quantity."""
        gain = 1.0 + found.estimate
        factor = format_plus_minus(gain, found.std_error)
        if gain < DEAD:
            return Finding(
                "torque_does_not_follow",
                "warning",
                f"The torque of {found.joint} is {factor} of what the motion and the other joints"
                f" imply{_word_worth(found)}: it is another quantity, or its sensor fails",
                Cure("check the column and the sensor"),
                joint=found.joint,
            )
        k = model.joint_names.index(str(found.joint))
        return Finding(
            "joint_gain_wrong",
            "warning",
            f"The torque of {found.joint} is {factor} of what its own motion and the other joints"
            f" imply{_word_worth(found)}",
            Cure(
                "check its gain; to agree with the others, multiply it in a recording sheet by"
                f" gains = {_write_joint_list(model, k, '1', f'{1.0 / gain:.3g}')}"
            ),
            joint=found.joint,
        )


@effect
class Saturation(_OfTorque):
    """Log large torques of a joint too small: by this share at its largest torque."""

    key = "saturation"
    title = "saturating torque"
    least = 0.05
    farthest = 0.8
    of_shares = True

    def is_possible(self, values: Array, joint: int | None, robot: Described) -> bool:
        """Return whether torques fall behind: none grows over its sensor."""
        return super().is_possible(values, joint, robot) and bool(values[0] < 0.0)

    def columns(self, variant: Variant, motion: Motion) -> list[Array]:
        """Return `tau |tau|` over the largest torque of the span."""
        torque = motion.torques[1]
        # Over the largest torque, so that the value is the share that is lost there.
        return [torque * np.abs(torque) / motion.robot.largest]

    def finding(self, found: FoundEffect, model: RobotModel) -> Finding:
        """Return by how much large torques are too small."""
        return Finding(
            "torque_saturates",
            "warning",
            f"The largest torques of {found.joint} are {_format_percent(found)} smaller than the"
            f" small ones imply{_word_worth(found)}: the drive or the sensor saturates, or a gain"
            " depends on the torque",
            Cure("record a gentler motion, or check the range of the sensor"),
            joint=found.joint,
        )


@effect
class Drift(_OfTorque):
    """Let the torque offset drift over the recording [N m or N]."""

    key = "drift"
    title = "drift of the torque offset"
    units = ("N m", "N")
    felt = 0.02
    """Drift in the joint's largest torque below which it is of no account."""

    def is_possible(self, values: Array, joint: int | None, robot: Described) -> bool:
        """Return whether the drift matters next to the joint's largest torque."""
        # Relative to the joint: a wrist's drift matters at torques that a shoulder does not feel.
        return bool(abs(values[0]) >= self.felt * robot.largest[joint or 0])

    def columns(self, variant: Variant, motion: Motion) -> list[Array]:
        """Return the share of the recording that has passed."""
        return [np.repeat(motion.elapsed[:, None], motion.q.shape[1], axis=1)]

    def finding(self, found: FoundEffect, model: RobotModel) -> Finding:
        """Return the drift."""
        size = f"{format_plus_minus(found.estimate, found.std_error)} {found.unit}"
        return Finding(
            "torque_drifts",
            "warning",
            f"The torque of {found.joint} drifts by {size} over the recording{_word_worth(found)}",
            Cure("let the sensor warm up and set it to zero, or identify shorter parts"),
            joint=found.joint,
        )


@effect
class Warming(_OfTorque):
    """Let friction of a joint, or its viscous part alone, change by a share over the recording.

    Warm lubricant takes viscous friction away and leaves Coulomb friction nearly as it is
    (Bittencourt and Gunnarsson, J. Dyn. Sys. Meas. Control 134, 2012).
    """

    key = "warming"
    title = "drift of friction"
    least = 0.05
    of_log = False
    of_shares = True

    def variants(self, robot: Described) -> Iterator[Variant]:
        """Yield all friction, and as a trial its viscous part, at every joint."""
        for plain in super().variants(robot):
            # The trial value 1 stands for the viscous part alone.
            yield from (plain, replace(plain, trial=1.0))

    def columns(self, variant: Variant, motion: Motion) -> list[Array]:
        """Return the torque of the drive, or of its viscous friction, times the time passed."""
        robot = motion.robot
        rigid, torque = motion.torques
        # What is left of the whole torque without rigid bodies is the drive's.
        changing = torque - rigid
        if variant.trial:
            values = dict(zip(parameter_names(robot.model, robot.drive), robot.chi, strict=True))
            # A joint without viscous friction has none that warms.
            changing = motion.qd * [values.get(f"Fv{k + 1}", 0.0) for k in range(len(rigid[0]))]
        return [motion.elapsed[:, None] * changing]

    def finding(self, found: FoundEffect, model: RobotModel) -> Finding:
        """Return by how much friction changes."""
        pace = "rises" if found.estimate > 0.0 else "falls"
        return Finding(
            "friction_drifts",
            "warning",
            f"Friction of {found.joint}, or its viscous part, {pace} by {_format_percent(found)}"
            " over the recording, as in a drive whose temperature changes"
            f"{_word_worth(found)}; its parameters hold for the middle",
            Cure("record cold and warm robots separately"),
            joint=found.joint,
        )


def _format_percent(found: FoundEffect) -> str:
    error = None if found.std_error is None else 100.0 * found.std_error
    return f"{format_plus_minus(100.0 * abs(found.estimate), error)} %"


def _word_worth(found: FoundEffect) -> str:
    """Return what the effect is worth, as the end of a clause."""
    others = (
        f"; {' or '.join(found.alternatives)} would explain as much" if found.alternatives else ""
    )
    return f" ({found.improvement}{others})"


def _write_joint_list(model: RobotModel, joint: int, otherwise: str, value: str) -> str:
    return f"[{', '.join(value if k == joint else otherwise for k in range(model.n_joints))}]"
