"""Rules of a verdict, and the findings that speak against a model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True, slots=True)
class VerdictRules:
    """Say when a model is used, used with care, or not.

    Parameters
    ----------
    useless
        Torque error, as a share of the torque, beyond which a model is not used: it explains less
        than three quarters of the squared torque, less than gravity alone on most arms.
    weak
        Torque error beyond which it is used with care: the drives follow another law than the
        model's.
    behind_cad
        Error in multiples of CAD's beyond which a model is not used; errors of one model on two
        motions of one robot differ by less.
    far
        Ratio of a link's mass to that of CAD, or its inverse, that no tolerance of CAD explains.
    heavier
        Share of the mass of all links by which a link far from CAD is heavier or lighter, beyond
        which its body imitates something that is not in the model. Light links of a wrist may be
        far from CAD without harm.
    named
        Reasons that the sentence names.
    """

    useless: float = 0.5
    weak: float = 0.3
    behind_cad: float = 1.25
    far: float = 1.5
    heavier: float = 0.1
    named: int = 2


RULES = VerdictRules()

DIMMING: Mapping[str, str] = MappingProxyType(
    {
        "held_out_repeats": "tested on the same motion only",
        "gravity_direction": "gravity points elsewhere than described",
        "clock_wrong": "the clock of the log looks wrong",
        "torque_scale": "torques have another scale than masses",
        "joint_torque_scale": "torque of another scale{at}",
        "joint_gain_wrong": "a wrong torque gain{at}",
        "zero_position_wrong": "a wrong zero position{at}",
        "torque_does_not_follow": "torque that hardly follows the motion{at}",
        "torque_saturates": "saturated torque{at}",
        "torque_unexplained": "torque that the model does not explain{at}",
        "joint_without_torque": "no torque was logged{at}",
        "not_excited": "what the motion does not excite is that of CAD",
        "motion_narrow": "tested in part of the range only",
        "motion_slow": "tested at low speed only",
        "does_not_generalise": "errors{at} are more than twice those in training",
    }
)
"""What is said of each finding that speaks against a model, the weightiest first."""
OF_TORQUE = frozenset(
    {
        "torque_scale",
        "joint_torque_scale",
        "joint_gain_wrong",
        "torque_unexplained",
        "torque_uncorrelated",
        "cad_predicts_better",
        "does_not_generalise",
    }
)
"""Findings on torques that are no measure where commands stand for them."""
