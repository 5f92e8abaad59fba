"""Checks of joints that follow others, where a log has columns of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from asbuilt.description.model import RobotModel
from asbuilt.experiment.recording import Recording
from asbuilt.findings import Cure, Finding


@dataclass(frozen=True, slots=True)
class CouplingThresholds:
    """Hold when a logged follower is away from where its coupling puts it: own choices.

    Parameters
    ----------
    angle, length
        Root mean square [rad, m] that the play of a gripper explains.
    share
        Share of the follower's range in the log that it must exceed besides.
    """

    angle: float = 0.02
    length: float = 0.001
    share: float = 0.05


THRESHOLDS = CouplingThresholds()


def coupling_findings(model: RobotModel, recording: Recording) -> Iterator[Finding]:
    """Compare logged positions of followers with those that follow; name torques not used."""
    placed, shares = model.link_positions(recording.q), model.link_shares
    for k, joint in enumerate(model.followers, start=model.n_joints):
        master = " and ".join(
            name for name, share in zip(model.joint_names, shares[k], strict=True) if share
        )
        logged = recording.extra.get(f"q_{joint.name}")
        if logged is not None:
            q = np.asarray(logged).reshape(-1)
            away = float(np.sqrt(np.nanmean((q - placed[:, k]) ** 2)))
            play = THRESHOLDS.angle if joint.is_revolute else THRESHOLDS.length
            if away > max(play, THRESHOLDS.share * float(np.nanmax(q) - np.nanmin(q))):
                unit = "rad" if joint.is_revolute else "m"
                yield Finding(
                    "coupling_disagrees",
                    "warning",
                    f"{joint.name} is logged {away:.3g} {unit} (root mean square) away from where"
                    f" {master} puts it by the coupling in the description, with which the torques"
                    " are computed",
                    Cure("correct multiplier and offset of the mimic joint in the description"),
                    joint=joint.name,
                )
        torque = recording.extra.get(f"tau_{joint.name}")
        if torque is not None and float(np.nanmax(np.abs(torque), initial=0.0)) > 0.0:
            yield Finding(
                "follower_torque",
                "warning",
                f"the log has a torque of {joint.name}, which follows {master}; only the torque of"
                f" {master} is used",
                Cure("if it has a drive of its own, remove the mimic from the description"),
                joint=joint.name,
            )
