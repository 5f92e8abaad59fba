"""Verdict on a model or a payload: whether to use it, the number behind it, what speaks against.

It is about the robot that exports carry, on motion that the fit has not seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from asbuilt.errors import IdentifiabilityError
from asbuilt.experiment.signal.samples import RECORDINGS
from asbuilt.findings import Finding, join_names
from asbuilt.identification import FeasibleInterval, IdentificationResult, Payload
from asbuilt.tables import format_plus_minus, format_share, round_significant
from asbuilt.validation.comparison.comparison import HELD_OUT
from asbuilt.validation.prediction import Validation
from asbuilt.validation.rollout.position_errors import position_unit
from asbuilt.validation.rollout.rollout import Rollout
from asbuilt.validation.verdicts.model_errors import (
    Measure,
    ModelErrors,
    choose_decisive_rollout,
    find_exported,
    find_worst_torque_error,
    summarise_rollout_error,
)
from asbuilt.validation.verdicts.reasons import (
    OF_MOTION,
    JointUse,
    Reason,
    Use,
    decide_joints,
    is_untested,
    list_reasons_against,
    list_reasons_against_bodies,
)

OPENING: dict[Use, str] = {
    "yes": "USE",
    "with care": "USE WITH CARE",
    "no": "DO NOT USE",
    "untested": "UNTESTED",
}
ANOTHER_MOTION = "record another motion"
"""What an untested model needs."""
NAMED = 2
"""Reasons that the sentence names."""
FINE = 0.01
"""Share of the torque below which an error is shown with two decimals."""


@dataclass(frozen=True, slots=True)
class BodiesUse:
    """Say whether to use the exported links as bodies, and why not; `reasons` are codes."""

    use: Use
    text: str = ""
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Verdict:
    """Say whether to use an identified model.

    Parameters
    ----------
    use
        Whether to use it.
    text
        One sentence, which begins with the use in capitals.
    error
        The errors by which the model is measured.
    measure
        Whether they are errors of torque, as shares of it, or of the motion that is simulated under
        logged commands [rad or m].
    reasons
        Codes of the findings that speak against the model, the weightiest first.
    joints
        The same joint by joint; empty where simulated motion is measured.
    bodies
        The same for the links as bodies, apart from the torque.
    """

    use: Use
    text: str
    error: ModelErrors
    measure: Measure
    reasons: tuple[str, ...] = ()
    joints: tuple[JointUse, ...] = ()
    bodies: BodiesUse = BodiesUse("yes")

    def __str__(self) -> str:
        return self.text

    @property
    def use_for_torque(self) -> Use:
        """Whether to use its torque, whatever speaks against its links as bodies."""
        alone = set(self.reasons) <= set(self.bodies.reasons)
        return "yes" if self.use == "with care" and alone else self.use


def study_verdict(
    result: IdentificationResult,
    findings: Sequence[Finding] = (),
    validations: Sequence[Validation] = (),
    rollouts: Sequence[Rollout] = (),
) -> Verdict:
    """Return the verdict on a result, by motion that it was not fitted to; without any, untested.

    Of several recordings the one with the largest error decides. Where commands stand for torques,
    which are what a law of the drive makes of them, simulated motion decides if there are rollouts.

    Parameters
    ----------
    result
        The identified robot.
    findings
        What is wrong, or worth knowing.
    validations
        Predictions of what was held out and of other recordings.
    rollouts
        Simulations of the same.
    """
    # Commands are measured by the motion that follows from them.
    simulated = choose_decisive_rollout(rollouts) if result.decided_by_motion else None
    untested = is_untested(result, findings, validations, simulated)
    joints: tuple[JointUse, ...] = ()
    if simulated is None:
        error = find_worst_torque_error(result, validations)
        joints = decide_joints(result, validations, untested=untested)
    else:
        error = summarise_rollout_error(simulated)
    reasons = list_reasons_against(
        result, findings, validations, simulated, error, joints, untested=untested
    )
    of_bodies = list_reasons_against_bodies(result)
    use = _decide_use(reasons, of_bodies, untested=untested)
    bodies = _decide_bodies(of_bodies)
    motion = _word_motion(result, findings, validations)
    outcome = _word_outcome(result, simulated, error, motion, untested=untested)
    return Verdict(
        use,
        _write_verdict(use, reasons, bodies, outcome, _word_mass(result)),
        # The error of what was fitted is no promise, so an untested model has none.
        ModelErrors(None, None, error.cad) if untested else error,
        "torque" if simulated is None else "rollout",
        tuple(dict.fromkeys(reason.code for reason in (*reasons, *of_bodies))),
        joints,
        bodies,
    )


def _decide_use(reasons: Sequence[Reason], of_bodies: Sequence[Reason], *, untested: bool) -> Use:
    if any(reason.forbids for reason in reasons):
        return "no"
    if untested:
        return "untested"
    return "with care" if reasons or of_bodies else "yes"


def _decide_bodies(reasons: Sequence[Reason]) -> BodiesUse:
    if not reasons:
        return BodiesUse("yes")
    forbidden = any(reason.forbids for reason in reasons)
    codes = tuple(dict.fromkeys(reason.code for reason in reasons))
    return BodiesUse("no" if forbidden else "with care", reasons[0].text, codes)


def _write_verdict(
    use: Use, reasons: Sequence[Reason], bodies: BodiesUse, outcome: str, mass: str
) -> str:
    """Return the sentence: the use of the torque, reasons and number, then the use as bodies."""
    opening = "USE for torque" if use == "with care" and not reasons else OPENING[use]
    if use == "untested":
        # Other reasons wait for another motion, and masses are no reason to use it.
        reasons = [reason for reason in reasons if reason.code == "torque_unexplained"]
        mass = ""
    against = f"{join_names(_choose_named(reasons))}; " if reasons else ""
    # One use for torque and bodies is said once where it is no.
    if bodies.text and use != "no":
        mass = f"; {OPENING[bodies.use]} as bodies: {bodies.text}"
    return f"{opening}: {against}{outcome}{mass}."


def _choose_named(reasons: Sequence[Reason]) -> list[str]:
    """Return the phrases of the weightiest reasons, one of them about motion that is untested.

    The sentence has a number, which other motion may not keep: if so it says so.
    """
    texts = list(dict.fromkeys(reason.text for reason in reasons))[:NAMED]
    of_motion = [reason.text for reason in reasons if reason.code in OF_MOTION]
    if of_motion and not {*texts} & {*of_motion}:
        texts[-1] = of_motion[0]
    return texts


def _word_outcome(
    result: IdentificationResult,
    simulated: Rollout | None,
    error: ModelErrors,
    motion: str,
    *,
    untested: bool,
) -> str:
    """Return how well the model predicts a motion, or fits its own if there is no other."""
    if untested and simulated is not None:
        return f"simulates its log to {_word_rollout(result, simulated, error)}; {ANOTHER_MOTION}"
    if untested:
        return f"fits its log to {_format_percent(error.decisive)}; {ANOTHER_MOTION}"
    if simulated is not None:
        return f"simulates {motion} to {_word_rollout(result, simulated, error)}"
    cad = "" if error.cad is None else f" (CAD {_format_percent(error.cad)})"
    return f"predicts {motion} to {_format_percent(error.decisive)} of the torque{cad}"


def _word_motion(
    result: IdentificationResult, findings: Sequence[Finding], validations: Sequence[Validation]
) -> str:
    """Return what the errors were measured on."""
    sources = [prediction.source for prediction in validations or result.validation]
    repeated = sum(finding.code == "held_out_repeats" for finding in findings)
    # Every recording repeats the training motion: it is the same one.
    if repeated and repeated >= len(sources):
        return "the same motion"
    if validations and all(validation.load is not None for validation in validations):
        return "motion under load"
    # A recording that is left out whole is another motion; a part of one belongs to its motion.
    part = result.holdout != RECORDINGS
    held = all(source.endswith(f"{HELD_OUT}{result.holdout}") for source in sources)
    return "motion held out" if part and held else "other motion"


def _format_percent(value: float | None) -> str:
    return format_share(value, 2 if value is not None and value < FINE else 1)


def _word_rollout(result: IdentificationResult, simulated: Rollout, error: ModelErrors) -> str:
    unit = position_unit(result.model)
    size = "one that diverges" if error.decisive is None else f"{1e3 * error.decisive:.3g} {unit}"
    cad = "" if error.cad is None else f" (CAD {round_significant(1e3 * error.cad)})"
    return f"{size} over {simulated.horizon:g} s{cad}"


def _word_mass(result: IdentificationResult) -> str:
    """Return that nothing can be exported, or the mass of links and CAD's if that is determined."""
    found = find_exported(result)
    if found is None:
        return ", and no robot can be exported"
    if not found.consistent:
        return ""
    mass = read_stated_mass(result)
    if mass is None:
        return ""
    cad = "" if mass.cad is None else f" for {round_significant(mass.cad)} of CAD"
    return f", {round_significant(mass.chosen)} kg{cad}"


def read_stated_mass(result: IdentificationResult) -> FeasibleInterval | None:
    """Return the mass of all links if its feasible interval lets one number stand for it."""
    try:
        mass: FeasibleInterval = result.feasible("mass", explained=False)
    except IdentifiabilityError:
        return None
    return mass if mass.is_narrow else None


def describe_payload_outcome(payload: Payload) -> str:
    """Return the verdict: whether to use the payload, and what it is, in a sentence with errors."""
    values = payload.values.tolist()
    errors = payload.std_errors.tolist()
    mass = format_plus_minus(values[0], errors[0])
    if "mass" not in payload.determined:
        at = payload.frame
        return f"{OPENING['no']}: the mass of the payload at {at} is undetermined ({mass} kg)."
    known = [k for k in (1, 2, 3) if payload.names[k] in payload.determined]
    centre = ", ".join(f"{'xyz'[k - 1]} {format_plus_minus(values[k], errors[k])}" for k in known)
    where = f"{centre} m" if centre else "undetermined"
    doubts = ["nearest consistent payload"] if payload.projected else []
    if payload.gains_in_doubt:
        doubts.insert(0, f"gains of {join_names(payload.gains_in_doubt)} in doubt")
    use = OPENING["with care" if doubts else "yes"]
    against = f"{join_names(doubts)}; " if doubts else ""
    return f"{use}: {against}payload at {payload.frame}: {mass} kg, its centre {where}."
