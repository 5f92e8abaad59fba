"""Verdicts on the numbers of a description: supported, contradicted or undetermined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.appearance import stretched_length
from asbuilt.dynamics.parameters import parameter_values
from asbuilt.findings import Finding
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.identification.uncertainty.block_scatter import mean_degrees, student_probability
from asbuilt.validation.comparison.cad_tolerance import CadTolerance
from asbuilt.validation.comparison.comparison import FALSE_DISCOVERY_RATE, compare
from asbuilt.validation.comparison.equal_terms import ComparedValues
from asbuilt.validation.comparison.significance import RESOLUTION, benjamini_hochberg
from asbuilt.validation.prediction import Validation, choose_letter
from asbuilt.validation.review.claimed_numbers import (
    Claim,
    ClaimedNumber,
    ClaimStatus,
    Profile,
    list_claimed_numbers,
    profile_numbers,
)
from asbuilt.validation.review.control_claims import (
    TOGETHER,
    derive_added_damping,
    derive_scale_errors,
    list_gain_aliases,
    review_gains,
)

ORDER: tuple[ClaimStatus, ...] = ("contradicted", "supported", "undetermined")
PLAUSIBLE = CadTolerance(0.3, 0.3, 0.3)
"""Plausible errors of masses, centres and inertias of a description; own choice."""
NOT_NEGATIVE = (
    *("mass", "armature", "damping", "friction loss"),
    *("inertia xx", "inertia yy", "inertia zz"),
)
"""Numbers that no robot has below zero: they are tested at the nearest possible value."""
DOUBTFUL = 0.05
"""Probability by chance up to which a number is not supported, alone as it is."""
IMPOSSIBLE = 3.0
"""Standard errors below zero from which a number that cannot be negative is not tested; own
choice."""
DETERMINED = 0.5
"""Standard error of a supported number, relative to its size, at most."""


@dataclass(frozen=True, eq=False)
class Review:
    """Hold the verdicts on the numbers of a description, contradicted ones first.

    Attributes
    ----------
    robot
        Name of the robot.
    claims
        The verdicts.
    tolerance
        What is plausible for masses, centres and inertias while another number is tested.
    misfit
        Root mean square of what no plausible numbers explain, in standard errors; errors are
        widened by it.
    sources
        The recordings.
    findings
        What the identification found.
    result
        The result whose weighted least squares the verdicts are of.
    """

    robot: str
    claims: tuple[Claim, ...]
    tolerance: CadTolerance
    misfit: float
    sources: tuple[str, ...]
    findings: tuple[Finding, ...]
    result: IdentificationResult

    def __repr__(self) -> str:
        counts = ", ".join(f"{self.count(verdict)} {verdict}" for verdict in ORDER)
        return f"<Review of {self.robot}: {counts}>"

    @property
    def error(self) -> float:
        """Relative torque error of the description on the recordings, NaN if it has no masses."""
        return self.result.cad.relative_error

    @property
    def letter(self) -> str | None:
        """The letter of the description, which was not fitted to the recordings, by `LETTERS`."""
        return choose_letter(self.error) if np.isfinite(self.error) else None

    @cached_property
    def contradicted_sums(self) -> tuple[int, int]:
        """Base parameters, sums of the numbers, that are contradicted, and how many are tested.

        By the values, thresholds and tests of `compare`: a log can contradict a sum without
        determining which of its numbers is wrong.
        """
        sums = compare(self.result)
        return sums.n_differing, sums.n_compared

    @property
    def first_findings(self) -> list[Finding]:
        """The findings on gains, without which the verdicts cannot be read."""
        return [finding for finding in self.findings if finding.code.startswith("servo_")]

    def count(self, verdict: ClaimStatus) -> int:
        """Return the number of claims with a verdict."""
        return sum(claim.verdict == verdict for claim in self.claims)

    def of(self, what: str, joint: str) -> Claim:
        """Return the claim of a number, such as the "armature" of a joint.

        Raises `KeyError` if the description makes none.
        """
        for claim in self.claims:
            if (claim.what, claim.joint) == (what, joint):
                return claim
        raise KeyError(f"the description claims no {what} of {joint}")


def review_result(
    result: IdentificationResult,
    *,
    peaks: Array | None = None,
    motions: Sequence[Validation] = (),
    tolerance: CadTolerance = PLAUSIBLE,
    findings: Sequence[Finding] = (),
) -> Review:
    """Judge the numbers of the description that a result was identified with.

    Parameters
    ----------
    result
        The result; its values by weighted least squares are used, which nothing pulls to CAD.
    peaks
        Largest torque that the drive of each joint was asked for (n,), for torque limits.
    motions
        Torques asked for and as built, which show torque limits.
    tolerance
        What is plausible for masses, centres and inertias while another number is tested.
    findings
        What the identification found.

    Returns
    -------
    Review
        A verdict on every number.
    """
    model = result.model
    base = result.base
    numbers = list_claimed_numbers(model, base.drive, tolerance)
    scale = derive_scale_errors(result)
    added = derive_added_damping(result, model)
    values = ComparedValues.free(result)
    # Other damping that the fit has in its viscous friction belongs to the claim.
    claimed = np.nan_to_num(parameter_values(model, base.drive), nan=0.0) + added
    rows = np.flatnonzero(values.determined & (values.std_errors > 0) & ~values.dropped)
    profile = profile_numbers(
        numbers,
        base.regrouping[rows],
        (values.estimates - base.regrouping @ claimed)[rows],
        values.covariance[np.ix_(rows, rows)],
    )
    whole = [number.claimed + float(number.column @ added) for number in numbers]
    drives = {
        joint.name: model.joint_names[k]
        for joint, k in zip(model.moving_joints, model.link_joints, strict=True)
    }
    # A link that follows has the scale of the joint that moves it.
    relative = [scale[result.joint_names.index(drives[number.joint])] for number in numbers]
    # The scale of torques comes last: with other errors it would be pulled toward zero where claims
    # and recording disagree (Peelle, 1987).
    scaled = np.nan_to_num(np.nan_to_num(whole) + profile.change) * relative
    profile = replace(profile, std_error=np.hypot(profile.std_error, scaled))
    freedom = mean_degrees(values.degrees_of_freedom[rows])
    claims = [
        _make_claim(result, numbers, profile, j, freedom, whole[j], stretched_length(model))
        for j, number in enumerate(numbers)
        # Locked joints claim nothing that moves.
        if np.isfinite(number.claimed) and number.joint not in model.locked_joints
    ]
    claims += review_gains(result, model, claims, peaks, motions)
    return Review(
        result.robot,
        tuple(sorted(_limit_false_discoveries(claims), key=_rank_claim)),
        tolerance,
        profile.misfit,
        result.sources,
        tuple(findings),
        result,
    )


def _make_claim(
    result: IdentificationResult,
    numbers: Sequence[ClaimedNumber],
    profile: Profile,
    j: int,
    freedom: float,
    whole: float,
    reach: float,
) -> Claim:
    """Return the verdict on number j, without regard to the number of tests.

    `whole` is the claim with another one that acts alike, `reach` the length of the robot,
    beyond which no link has its centre [m].
    """
    number = numbers[j]
    change = float(profile.change[j])
    error = float(profile.std_error[j])
    # Without an error nothing is known, however good the estimate looks.
    known = bool(np.isfinite(change) and np.isfinite(error))
    what = number.what if whole == number.claimed else TOGETHER
    others = [numbers[k] for k in profile.aliases[j] if numbers[k].what != "unknown"]
    claim = Claim(
        what,
        number.joint,
        number.unit,
        whole,
        whole + change if known else None,
        error if known else None,
        "supported" if known and error <= DETERMINED * number.size else "undetermined",
        (
            *list_gain_aliases(result, what, number.joint),
            *(f"{other.what} of {other.joint}" for other in others),
        ),
    )
    if not known:
        return claim
    # The nearest value that a robot can have is tested in place of an impossible one.
    possible = max(change, -whole) if number.what in NOT_NEGATIVE else change
    beyond = number.what.startswith("centre") and abs(whole + change) > reach
    # Far below zero, or outside the robot: the model lacks what acts there.
    if beyond or possible - change > IMPOSSIBLE * error:
        return replace(claim, verdict="undetermined", note="impossible: another effect acts here")
    p = float(student_probability(np.array([possible / error]), np.array([freedom]))[0])
    return replace(
        claim,
        p_value=p,
        torque=_measure_torque_change(result, number.column * possible),
        alike=abs(possible) <= RESOLUTION * number.size,
        note="" if possible == change else "tested at zero",
    )


def _measure_torque_change(result: IdentificationResult, change: Array) -> float | None:
    """Return the RMS torque over all joints of a change of the standard parameters."""
    data = result.cause_data
    base = result.base
    if data is None:
        return None
    places = data.places(base.names)
    beta = base.regrouping @ change
    # On the data that were fitted, as the verdicts are by their estimates.
    rows = [factor[:, places] @ beta for factor in (*data.whole(data.fitted),)]
    return float(np.sqrt(sum(float(row @ row) for row in rows) / data.n_fitted))


def _limit_false_discoveries(claims: Sequence[Claim]) -> list[Claim]:
    """Return the claims with those contradicted that are so at the false discovery rate."""
    tested = [j for j, claim in enumerate(claims) if claim.p_value is not None]
    found = list(claims)
    discovery = benjamini_hochberg([claims[j].p_value or 0.0 for j in tested])
    for j, rate in zip(tested, discovery.tolist(), strict=True):
        # Within a tenth nothing is contradicted, however small the error.
        claim = replace(claims[j], false_discovery=rate)
        if not claim.alike and rate <= FALSE_DISCOVERY_RATE:
            # Neither contradicted among many tests, nor supported by itself.
            claim = replace(claim, verdict="contradicted")
        elif not claim.alike and (claim.p_value or 0.0) <= DOUBTFUL:
            claim = replace(claim, verdict="undetermined")
        found[j] = claim
    return found


def _rank_claim(claim: Claim) -> tuple[int, float, float]:
    """Return the place in the order: by torque; what is undetermined by its probability."""
    probability = 2.0 if claim.p_value is None else claim.p_value
    by_chance = probability if claim.verdict == "undetermined" else 0.0
    return ORDER.index(claim.verdict), by_chance, -(claim.torque or 0.0)
