"""figaroh with the settings of its own manipulator examples (Staubli TX40).

Positions through its median and Butterworth filters and `gradient`, torques decimated with the
regressor, QR and weighted least squares (`wls: true`); its consistent fit (`physical_fit`) beside
it. Its filter gets the cutoff of the task, its decimation ten rows a period of that.
"""

from __future__ import annotations

import logging
import signal
import warnings
from typing import Any

import numpy as np
import yaml
from adapter import Estimate, Facts, Fit
from figaroh.data.trajectory import TrajectoryData
from figaroh.identification.base_identification import BaseIdentification
from figaroh.tools.regressor import build_regressor_basic, build_regressor_reduced
from figaroh.tools.robot import load_robot
from plain import Motion, uniform
from regression import INERTIAL

PACKAGE = "figaroh"
REQUIRES = ["figaroh==1.0.2", "pyyaml"]
TITLE = "figaroh"
ADDRESS = "https://github.com/thanhndv212/figaroh"
FITTED_RATE_PER_CUTOFF = 10.0
CONSISTENT_SECONDS = 60.0
"""CPU time that its consistent fit may take, as in its example."""


def fit(facts: Facts) -> Fit:
    """Identify base parameters, and consistent links beside them."""
    if facts.coupling is not None:
        raise NotImplementedError("its regressor has no joints that follow a motor together")
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)
    config = facts.folder / "figaroh.yaml"
    config.write_text(yaml.safe_dump(configuration(facts)))
    robot = load_robot(facts.urdf, package_dirs=str(facts.folder))
    arm = Arm(robot, str(config), facts)
    arm.initialize()
    factor = max(1, round(facts.rate / (FITTED_RATE_PER_CUTOFF * facts.cutoff)))
    arm.solve(decimate=factor > 1, decimation_factor=factor, plotting=False, wls=True)

    def predict(motion: Motion) -> Any:
        W = build_regressor_basic(robot, motion.q, motion.qd, motion.qdd, arm.identif_config)
        base = build_regressor_reduced(W, arm._idx_eliminated)[:, arm._base_indices]
        return (base @ arm.phi_base).reshape(len(facts.joints), -1).T

    record = (arm._physical_fit or {}).get("record")
    note = "base parameters; masses by its physical fit"
    if not (arm._physical_fit or {}).get("accepted"):
        note = f"its physical fit: {(arm._physical_fit or {}).get('reason', 'none')}"[:120]
    names = list(arm.standard_parameter)
    return Fit(
        predict, estimates(arm, facts), links(record, names, facts), f"{note}; {verdict(arm)}"
    )


def verdict(arm: Any) -> str:
    """Return what its `verify` says of the run (prediction needs limits that the user states)."""
    report = arm.verify(scope="execution")
    passed = getattr(report, "passed", None)
    if passed is None and isinstance(report, dict):
        passed = report.get("passed")
    return f"verify: {'passed' if passed else 'not passed'} (numbers finite)"


class Arm(BaseIdentification):
    """An arm whose logs are arrays."""

    def __init__(self, robot: Any, config: str, facts: Facts) -> None:
        self.facts = facts
        super().__init__(robot, config)
        joints = [robot.model.getJointId(name) for name in facts.joints]
        self.identif_config["active_joints"] = list(facts.joints)
        self.identif_config["act_Jid"] = joints
        self.identif_config["act_J"] = [robot.model.joints[j] for j in joints]
        self.identif_config["act_idxq"] = [robot.model.joints[j].idx_q for j in joints]
        self.identif_config["act_idxv"] = [robot.model.joints[j].idx_v for j in joints]

    def load_trajectory_data(self, data_source: str | None = None) -> TrajectoryData:
        """Return the logs one after another; the ends of each are masked."""
        q, tau, mask = [], [], []
        for log in self.facts.logs():
            grid = np.arange(log["t"][0], log["t"][-1], 1.0 / self.facts.rate)
            q.append(uniform(log["t"], log["q"], grid))
            tau.append(uniform(log["t"], log["tau"], grid))
            edge = self.facts.edge
            mask.append((grid > grid[0] + edge) & (grid < grid[-1] - edge))
        position = np.concatenate(q)
        return TrajectoryData(
            t=np.arange(len(position)) / self.facts.rate,
            joint_names=tuple(self.facts.joints),
            q=position,
            effort=np.concatenate(tau),
            effort_kind=("joint_torque",) * len(self.facts.joints),
            effort_unit=("N m",) * len(self.facts.joints),
            mask=np.concatenate(mask),
        )

    def _select_and_store_estimate(self) -> None:
        """Hold the consistent fit to its time limit, which its solver CVXOPT does not know."""
        signal.signal(signal.SIGPROF, _stop)
        signal.setitimer(signal.ITIMER_PROF, CONSISTENT_SECONDS)
        try:
            super()._select_and_store_estimate()
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)


def _stop(*_: Any) -> None:
    raise TimeoutError(f"it takes more than {CONSISTENT_SECONDS:.0f} s")


def configuration(facts: Facts) -> dict[str, Any]:
    """Return its unified configuration."""
    n = len(facts.joints)
    zero = [0.0] * n
    return {
        "robot": {
            "name": "arm",
            "properties": {
                "joints": {"active_joints": list(facts.joints)},
                "mechanics": {
                    "reduction_ratios": [1.0] * n,
                    "friction_coefficients": {"viscous": zero, "static": zero},
                    "actuator_inertias": zero,
                    "joint_offsets": zero,
                },
                "coupling": {"has_coupled_wrist": bool(facts.settings.get("coupled_wrist"))},
            },
        },
        "tasks": {
            "identification": {
                "enabled": True,
                "problem": {
                    "include_external_forces": False,
                    "use_joint_torques": True,
                    "wls": True,
                    "model_components": {
                        "friction": True,
                        "joint_offset": True,
                        "actuator_inertia": facts.armature,
                    },
                },
                "signal_processing": {
                    "sampling_frequency": facts.rate,
                    "cutoff_frequency": facts.cutoff,
                    "filter_type": "butterworth",
                    "filter_order": 4,
                },
                "physical_fit": {"enabled": True, "max_seconds": CONSISTENT_SECONDS},
            }
        },
    }


def standard_names(facts: Facts) -> dict[str, str]:
    """Return the names here of its standard parameters."""
    drives = {"fv": "Fv", "fs": "Fc", "Ia": "Ia", "off": "Fo"}
    return {
        f"{key}_{joint}": f"{drives.get(key, key)}{k + 1}"
        for k, joint in enumerate(facts.joints)
        for key in (*INERTIAL, *drives)
    }


def estimates(arm: Any, facts: Facts) -> list[Estimate]:
    """Return the base parameters, with the sums that they stand for."""
    own, found = standard_names(facts), []
    relative = np.asarray(arm.result["wls_std_deviations"], dtype=float)
    for text, value, percent in zip(arm.params_base, arm.phi_base, relative, strict=True):
        of, sign = {}, 1.0
        for word in str(text).split():
            if word in "+-":
                sign = -1.0 if word == "-" else 1.0
                continue
            factor, _, name = word.rpartition("*")
            if name.startswith("-"):
                sign, name = -sign, name[1:]
            of[own[name]] = sign * float(factor or 1.0)
        error = abs(float(value)) * float(percent) / 100.0
        found.append(Estimate(str(text), float(value), error, of))
    return found


def links(record: Any, names: list[str], facts: Facts) -> Any:
    """Return the links of its consistent fit."""
    if record is None or record.theta is None:
        return None
    own = standard_names(facts)
    values = {own.get(name, name): v for name, v in zip(names, record.theta, strict=True)}
    return [[values[f"{key}{k + 1}"] for key in INERTIAL] for k in range(len(facts.joints))]
