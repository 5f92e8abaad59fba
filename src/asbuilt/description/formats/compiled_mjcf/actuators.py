"""Actuators of a compiled MuJoCo model: motors and position servos of joints."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np


@dataclass(frozen=True, slots=True)
class Actuators:
    """Read the actuators of a compiled `model` by joint; `mujoco` is the module."""

    mujoco: ModuleType
    model: Any

    def of(self, joint: int) -> list[int]:
        """Return the actuators that act on a joint."""
        m, kinds = self.model, self.mujoco.mjtTrn
        own = (int(kinds.mjTRN_JOINT), int(kinds.mjTRN_JOINTINPARENT))  # alike but for balls
        return [
            actuator
            for actuator in range(m.nu)
            if m.actuator_trntype[actuator] in own and m.actuator_trnid[actuator, 0] == joint
        ]

    def torque_limit(self, joint: int) -> float:
        """Return the largest torque [N m or N] of the actuators of a joint, infinite without.

        It is limited by the range of their force and, of motors, of their control.
        """
        m, found = self.model, np.inf
        for actuator in self.of(joint):
            gear = abs(float(m.actuator_gear[actuator, 0]))
            if m.actuator_forcelimited[actuator]:
                bias = self._constant(actuator)
                most = float(np.abs(m.actuator_forcerange[actuator] - bias).max())
                found = min(found, most * gear)
            if m.actuator_ctrllimited[actuator] and self.is_motor(actuator):
                most = float(np.abs(m.actuator_ctrlrange[actuator]).max())
                found = min(found, abs(float(m.actuator_gainprm[actuator, 0])) * most * gear)
        return found

    def gains(self, joint: int) -> tuple[float | None, float | None]:
        """Return kp and kd of the position servo of a joint, on its side of the gear."""
        m = self.model
        for actuator in filter(self.is_servo, self.of(joint)):
            gear = float(m.actuator_gear[actuator, 0])
            gain, bias = m.actuator_gainprm[actuator], m.actuator_biasprm[actuator]
            return float(gain[0]) * gear**2, float(-bias[2]) * gear**2
        return None, None

    def offset(self, joint: int) -> float | None:
        """Return the torque that the drive of a joint lacks at rest, None if there is none."""
        m = self.model
        held = [k for k in self.of(joint) if self.is_motor(k) or self.is_servo(k)]
        return -sum(self._constant(k) * float(m.actuator_gear[k, 0]) for k in held) or None

    def _constant(self, actuator: int) -> float:
        """Return the part of an actuator's force that depends on nothing."""
        m, kinds = self.model, self.mujoco
        affine = m.actuator_biastype[actuator] == kinds.mjtBias.mjBIAS_AFFINE
        return float(m.actuator_biasprm[actuator, 0]) if affine else 0.0

    def is_motor(self, actuator: int) -> bool:
        """Whether the torque of an actuator is its control times a factor, and a constant."""
        m, kinds = self.model, self.mujoco
        bias = m.actuator_biastype[actuator]
        constant = bias == kinds.mjtBias.mjBIAS_AFFINE and not np.any(
            m.actuator_biasprm[actuator, 1:3]
        )
        return bool(
            m.actuator_gaintype[actuator] == kinds.mjtGain.mjGAIN_FIXED
            and (bias == kinds.mjtBias.mjBIAS_NONE or constant)
        )

    def is_servo(self, actuator: int) -> bool:
        """Whether an actuator controls the position of its joint."""
        m, kinds = self.model, self.mujoco
        gain, bias = m.actuator_gainprm[actuator], m.actuator_biasprm[actuator]
        return bool(
            m.actuator_gaintype[actuator] == kinds.mjtGain.mjGAIN_FIXED
            and m.actuator_biastype[actuator] == kinds.mjtBias.mjBIAS_AFFINE
            and gain[0] > 0.0
            and bias[1] == -gain[0]
        )

    def notes(self) -> Iterator[str]:
        """Yield what a robot model does not hold of the actuators."""
        m = self.model
        at_joints = {actuator for joint in range(m.njnt) for actuator in self.of(joint)}
        held = [k for k in sorted(at_joints) if self.is_motor(k) or self.is_servo(k)]
        left = sorted(set(range(m.nu)) - set(held))
        late = [k for k in held if m.actuator_dyntype[k] != self.mujoco.mjtDyn.mjDYN_NONE]
        for some, said in (
            (left, "left out; motors and position actuators of joints are read"),
            (late, "taken to act at once; their dynamics are left out"),
        ):
            if some:
                yield f"the actuators {', '.join(map(self._name, some))} are {said}"
        for joint in range(m.njnt):
            several = [k for k in self.of(joint) if k in held]
            if len(several) > 1:
                yield (
                    f"the actuators {', '.join(map(self._name, several))} act on one joint: the"
                    " gains of the first servo and the least limit count"
                )

    def _name(self, actuator: int) -> str:
        kind = self.mujoco.mjtObj.mjOBJ_ACTUATOR
        return self.mujoco.mj_id2name(self.model, kind, actuator) or f"actuator_{actuator}"
