"""Verdict on a recording: joint by joint, is the model as built better or worse than CAD."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.special import stdtr

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.findings import Finding, join_names
from asbuilt.identification.effects.effect import EFFECTS, name_group
from asbuilt.tables import round_significant
from asbuilt.validation.attribution.attribution import Attribution
from asbuilt.validation.comparison.comparison import recording_name
from asbuilt.validation.comparison.significance import holm
from asbuilt.validation.prediction import Validation

Outcome = Literal["better", "worse", "undecided"]


# Say when predictions differ.
#
# `VERDICT_LEVEL` is the familywise error over the joints (Holm). Time is divided into
# `VERDICT_BLOCKS`, none shorter than `VERDICT_SHORTEST` [s], so that the errors of successive
# blocks are about independent.

VERDICT_LEVEL = 0.05
VERDICT_BLOCKS = 20
VERDICT_SHORTEST = 1.0


FEWEST = 3
"""Time blocks whose scatter gives a standard error."""


@dataclass(frozen=True, slots=True)
class JointComparison:
    """Hold the RMS torque errors at a joint, CAD's and as built, and how sure their order is.

    `sigmas` is the mean over time blocks of CAD's squared error minus that as built, over the sum
    of both, in its standard errors: positive if the model as built is better. None with fewer than
    three blocks, or where the description knows no mass that moves the joint.
    `p_value` is by Student's distribution, `holm` for as many joints.
    """

    joint: str
    unit: str
    cad: float
    as_built: float
    sigmas: float | None
    p_value: float | None
    holm: float | None
    outcome: Outcome


@dataclass(frozen=True, slots=True)
class PredictionVerdict:
    """Hold the verdict on a recording: all joints, weighted by CAD's error, and each one."""

    source: str
    n_blocks: int
    whole: JointComparison
    joints: tuple[JointComparison, ...]

    @property
    def is_worse(self) -> bool:
        """Whether CAD predicts the recording better than the model, at some joint or on the whole.

        Beyond chance; on the whole also if it is undecided and the error as built is larger.
        """
        if self.whole.sigmas is None and self.n_blocks >= FEWEST:
            return False  # CAD gives no torque
        return (
            self.whole.outcome == "worse"
            or (self.whole.outcome == "undecided" and self.whole.as_built > self.whole.cad)
            or any(joint.outcome == "worse" for joint in self.joints)
        )

    @property
    def sentence(self) -> str:
        """The verdict in a sentence, bad news first and with its numbers."""
        named = {
            outcome: [joint for joint in self.joints if joint.outcome == outcome]
            for outcome in ("worse", "better")
        }
        parts = [f"WORSE at {join_names(list(map(_word_joint, named['worse'])), 7)}"]
        parts = parts if named["worse"] else []
        if len(named["better"]) == len(self.joints) > 1:
            parts.append("better at every joint")
        elif named["better"]:
            parts.append(f"better at {join_names([joint.joint for joint in named['better']], 7)}")
        undecided = [
            joint.joint
            for joint in self.joints
            if joint.outcome == "undecided" and joint.sigmas is not None
        ]
        if undecided:
            parts.append(f"no sure difference at {join_names(undecided, 7)}")
        if self.whole.sigmas is None:
            why = "too short for a verdict" if self.n_blocks < FEWEST else "CAD has no masses"
            return f"As built against CAD on {self.source}: {why}."
        return f"As built against CAD on {self.source}: {'; '.join(parts)}."

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers and texts, ready for JSON."""
        return asdict(self) | {
            "joints": [asdict(joint) for joint in self.joints],
            "worse_than_cad": self.is_worse,
            "sentence": self.sentence,
        }


def cad_verdict(validation: Validation) -> PredictionVerdict:
    """Compare squared errors as built and by CAD, block by block of time.

    The mean difference of B blocks over its standard error has Student's distribution with B - 1
    degrees of freedom (paired comparison; Diebold & Mariano, J. Business & Economic Statistics 13,
    1995, with blocks in place of a spectral estimate). Differences are those over the sum of both
    squared errors: of few blocks one of fast motion would otherwise be all of the mean, and of its
    standard error. An order that the RMS errors do not have is undecided, as is a joint of which
    the description knows no mass: no torque at all is no prediction that could be better.
    """
    cad = validation.measured - validation.predicted_cad
    built = validation.error
    block = _number_blocks(validation.t)
    # A joint that CAD predicts exactly must not divide by zero.
    tiny = np.finfo(np.float64).tiny
    scale = np.maximum(np.mean(cad**2, axis=0), tiny)
    by_cad = _average_blocks(cad**2, block)
    as_built = _average_blocks(built**2, block)
    gains = (by_cad - as_built) / np.maximum(by_cad + as_built, tiny)
    # Joints without a torque channel have no error to compare; those without a mass in the
    # description have no torque of CAD.
    seen = np.isfinite(built).all(axis=0)
    stated = np.any(validation.predicted_cad, axis=0)
    tested = seen & stated if stated[seen].any() else seen
    # The last column is the mean of all joints, tested once.
    sigmas, p = _test_gains(np.column_stack([gains, gains[:, tested].mean(axis=1)]))
    unknown = np.append(~stated, not stated[seen].any())
    sigmas = np.where(unknown, np.nan, sigmas)
    p = np.where(unknown, 1.0, p)
    rms_cad = np.sqrt(scale)
    relative = np.sqrt(np.mean(built**2, axis=0) / scale)
    rows = zip(
        (*validation.joint_names, "all"),
        (*validation.units, "of CAD's"),
        np.append(rms_cad, 1.0).tolist(),
        np.append(relative * rms_cad, np.sqrt(np.mean(relative[tested] ** 2))).tolist(),
        sigmas.tolist(),
        p.tolist(),
        # The whole is one test, to which Holm adds nothing.
        np.append(holm(p[:-1]), p[-1]).tolist(),
        strict=True,
    )
    *joints, whole = (_make_verdict(*row) for row in rows)
    source = recording_name(validation.source)
    return PredictionVerdict(source, int(block[-1]) + 1, whole, tuple(joints))


def report_cad_verdicts(validations: Sequence[Validation]) -> tuple[Finding, ...]:
    """Return the verdict on each recording that was not used to fit; none if CAD has no torque."""
    found = [
        cad_verdict(validation) for validation in validations if np.any(validation.predicted_cad)
    ]
    return tuple(
        Finding("verdict_against_cad", "info", verdict.sentence.rstrip(".")) for verdict in found
    )


def report_causes(attribution: Attribution | None, model: RobotModel) -> tuple[Finding, ...]:
    """Return the causes of the CAD error, and links of another mass, if any were found."""
    if attribution is None or not attribution.chosen:
        return ()
    masses = [
        replace(finding, effect=mass.effect)
        for mass in attribution.masses
        if (finding := EFFECTS[mass.effect].finding(mass, model)) is not None
    ]
    causes = Finding(
        "causes_of_cad_error",
        "info",
        "Causes of the torque error of CAD:"
        f" {join_names([name_group(key) for key in attribution.chosen])}, which explain"
        f" {100 * attribution.explained:.0f} % of its square on {attribution.judged_by}",
    )
    return (*masses, causes)


def _number_blocks(t: Array) -> Array:
    """Return the number of the time block of each sample, counted from 0 without gaps."""
    seconds = max(VERDICT_SHORTEST, float(t[-1] - t[0]) / VERDICT_BLOCKS)
    # 1e-9: a time that is a border up to rounding begins a block.
    return np.asarray(np.unique(np.floor((t - t[0]) / seconds + 1e-9), return_inverse=True)[1])


def _average_blocks(values: Array, block: Array) -> Array:
    """Return the means (B, n) of values (N, n) of each block."""
    sums = np.column_stack([np.bincount(block, weights=column) for column in values.T])
    return np.asarray(sums / np.bincount(block)[:, None])


def _test_gains(gains: Array) -> tuple[Array, Array]:
    """Return mean over standard error, NaN with fewer than three blocks, and its p value."""
    n = len(gains)
    if n < FEWEST:
        return np.full(gains.shape[1], np.nan), np.ones(gains.shape[1])
    mean = gains.mean(axis=0)
    error = gains.std(axis=0, ddof=1) / np.sqrt(n)
    sigmas = np.divide(mean, error, out=np.zeros_like(mean), where=error > 0)
    return sigmas, np.asarray(2.0 * stdtr(n - 1, -np.abs(sigmas)))


def _make_verdict(
    joint: str, unit: str, cad: float, built: float, sigmas: float, p: float, strict: float
) -> JointComparison:
    known = bool(np.isfinite(sigmas))
    # An order of means that the RMS errors contradict is one of few blocks.
    sure = known and strict <= VERDICT_LEVEL and (sigmas > 0) == (built < cad)
    outcome: Outcome = "undecided" if not sure else "better" if sigmas > 0 else "worse"
    if not known:
        return JointComparison(joint, unit, cad, built, None, None, None, outcome)
    return JointComparison(joint, unit, cad, built, sigmas, p, strict, outcome)


def _word_joint(joint: JointComparison) -> str:
    errors = f"{round_significant(joint.as_built)} for {round_significant(joint.cad)}"
    return f"{joint.joint} ({errors} {joint.unit})"
