"""Claims of gains and torque limits of position servos, and what these leave of other numbers.

Where torques were measured nothing is added, and the claims stay untested.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description import RobotModel
from asbuilt.dynamics import parameter_values
from asbuilt.dynamics.parameters import parameter_names
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.identification.uncertainty.block_scatter import student_probability
from asbuilt.validation.prediction import Validation
from asbuilt.validation.review.claimed_numbers import Claim

UNDETERMINED = 0.5
"""Relative standard error of a stiffness beyond which only ratios to it are determined."""
TOGETHER = "damping + kv"
"""Damping of a joint and of its servo, where only their sum is tested."""
BEYOND = 0.1
"""Share of a torque limit by which the command must ask for more to show it; own choice."""
FOLLOWED = 0.2
"""Share of the torque beyond a limit that a motion without the limit may lack; own choice."""
MOST = 0.2
"""Largest share of samples beyond a torque limit: the fit must not rest on them; own choice."""
FEWEST = 20
"""Fewest samples that show a torque limit."""
OF_NO_SERVO = "the torque of this recording is not from the servo"
SCALED = ("mass", "armature", "damping", TOGETHER, "friction loss")
"""Numbers whose torque grows with the stiffness, and of whose aliases it is named."""


def derive_scale_errors(result: IdentificationResult) -> Array:
    """Return the relative error of the torque of each joint from its stiffness, shape (n,)."""
    errors = result.servo_errors
    servo = result.servo
    if errors is None or servo is None or not errors.kp:
        return np.zeros(result.model.n_joints)
    # A relative error of the stiffness is one of every torque of the joint.
    return np.asarray(np.array(errors.kp) / np.array(servo.kp))


def derive_added_damping(result: IdentificationResult, model: RobotModel) -> Array:
    """Return what the claimed damping of servos adds to the standard parameters (n_standard,).

    Where the damping of the servo was not given, viscous friction as built includes it.
    """
    added = np.zeros(len(parameter_values(model, result.base.drive)))
    errors = result.servo_errors
    if errors is None:
        return added
    names = parameter_names(model, result.base.drive)
    for k, (joint, unknown) in enumerate(zip(model.joints, errors.kd_unknown, strict=True)):
        # Only where the servo's damping is part of the fitted friction.
        if unknown and joint.drive.kd and f"Fv{k + 1}" in names:
            added[names.index(f"Fv{k + 1}")] = joint.drive.kd
    return added


def review_gains(
    result: IdentificationResult,
    model: RobotModel,
    claims: Sequence[Claim],
    peaks: Array | None,
    motions: Sequence[Validation] = (),
) -> list[Claim]:
    """Return the verdicts on claims of servos, without regard to the number of tests.

    `claims` are on drives, `peaks` (n,) the largest torques that the servos were asked for,
    `motions` torques asked for ("measured") and of the motion as built ("predicted").
    """
    found = []
    together = {claim.joint for claim in claims if claim.what == TOGETHER}
    for k, joint in enumerate(model.joints):
        if joint.drive.kp is not None:
            unit = f"{joint.torque_unit}/{joint.unit}"
            claim = Claim("kp", joint.name, unit, joint.drive.kp)
            found.append(_judge_stiffness(result, k, claim))
        # Where only the sum acts it has been tested as damping + kv.
        if joint.drive.kd and joint.name not in together:
            unit = f"{joint.torque_unit} s/{joint.unit}"
            claim = Claim("kv", joint.name, unit, joint.drive.kd)
            found.append(_judge_damping(result, k, claim))
        if np.isfinite(joint.limits.torque) and peaks is not None:
            limit = Claim("forcerange", joint.name, joint.torque_unit, joint.limits.torque)
            found.append(_test_torque_limit(limit, k, float(peaks[k]), motions))
    return found


def list_gain_aliases(result: IdentificationResult, what: str, joint: str) -> tuple[str, ...]:
    """Return the unknown gains of the servo at a joint that a number is an alias of."""
    errors = result.servo_errors
    if errors is None or what not in SCALED or joint not in result.joint_names:
        return ()
    k = result.joint_names.index(joint)
    stiffness = () if errors.scale[k] == "given" else (f"kp of {joint}",)
    damping = (f"kv of {joint}",) if errors.kd_unknown[k] and what == "damping" else ()
    return (*stiffness, *damping)


def _judge_stiffness(result: IdentificationResult, k: int, claim: Claim) -> Claim:
    errors = result.servo_errors
    servo = result.servo
    if errors is None or servo is None:
        return replace(claim, note=OF_NO_SERVO)
    if errors.scale[k] == "given":
        return replace(claim, note=f"given as {servo.kp[k]:.6g}, not tested")
    estimate = servo.kp[k]
    error = errors.kp[k]
    all_torques = f"scale of all torques of {claim.joint}"
    # An undetermined stiffness leaves ratios alone.
    if not error < UNDETERMINED * estimate:
        return replace(
            claim, alias_of=(all_torques,), note="only ratios of other numbers to it are determined"
        )
    sigmas = (estimate - claim.claimed) / error
    p = float(student_probability(np.array([sigmas]), np.array([np.inf]))[0])
    return replace(
        claim,
        estimate=estimate,
        std_error=error,
        verdict="supported",
        alias_of=(all_torques,),
        p_value=p,
        note=f"scale from the {errors.scale[k]} of the description",
    )


def _judge_damping(result: IdentificationResult, k: int, claim: Claim) -> Claim:
    errors = result.servo_errors
    if errors is not None and errors.kd_unknown[k]:
        return replace(claim, alias_of=(f"damping of {claim.joint}",))
    return replace(claim, note=OF_NO_SERVO if errors is None else "given, not tested")


def _test_torque_limit(claim: Claim, k: int, peak: float, motions: Sequence[Validation]) -> Claim:
    """Return the verdict on a torque limit, tested where the command asks for more than it.

    The estimate is the mean torque of the motion there, its error the error of single samples
    within the limit. A motion that has the torque asked for contradicts the limit, one that has the
    torque of the limit supports it. `peak` is the largest torque that the command asks for.
    """
    asked = np.concatenate([np.zeros(0), *(motion.measured[:, k] for motion in motions)])
    moved = np.concatenate([np.zeros(0), *(motion.predicted[:, k] for motion in motions)])
    beyond = np.abs(asked) > (1.0 + BEYOND) * claim.claimed
    within = np.abs(asked) <= claim.claimed
    # Too few samples beyond the limit, or so many that the fit rests on them.
    if np.count_nonzero(beyond) < FEWEST or np.mean(~within) > MOST:
        reached = "beyond the claim" if peak > claim.claimed else "below it"
        asks = f"largest torque that the command asks for: {peak:.3g} {claim.unit}, {reached}"
        return replace(claim, note=asks)
    # Within the limit both torques are the same, but for errors.
    error = float(np.sqrt(np.mean((asked - moved)[within] ** 2)))
    # Along the torque asked for, so that both signs count alike.
    moves = float(np.mean((moved * np.sign(asked))[beyond]))
    wanted = float(np.mean(np.abs(asked[beyond])))
    more = moves - claim.claimed
    clear = 2.0 * error
    little = BEYOND * claim.claimed
    # The motion has the torque asked for: there is no limit at the claim.
    follows = abs(wanted - moves) < FOLLOWED * (wanted - claim.claimed)
    # It has the torque of the limit, and much more was asked for.
    held = abs(more) <= max(little, error) and wanted - claim.claimed > clear
    return replace(
        claim,
        estimate=moves,
        std_error=error,
        verdict="contradicted"
        if follows and more > max(little, clear)
        else "supported"
        if held
        else "undetermined",
        note=(
            f"the motion has {moves:.3g} {claim.unit} where the command asks for {wanted:.3g}"
            f" {claim.unit}"
        ),
    )
