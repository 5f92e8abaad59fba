"""The estimator that a recording calls for, chosen by rules that the summary states."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.errors import AsbuiltError, IdentifiabilityError
from asbuilt.findings import Cure, Finding, join_names
from asbuilt.identification.bodies.body_bounds import bound_generously, bound_with_certainty
from asbuilt.identification.bodies.cad_prior import (
    USUAL_DESIGN_EFFECT,
    CadPrior,
    build_cad_prior,
    with_drive_rows,
    with_drive_scale,
)
from asbuilt.identification.bodies.conic_fit import ConicProblem
from asbuilt.identification.bodies.consistency import (
    decide_consistency,
    find_inconsistency,
    non_passive_drives,
)
from asbuilt.identification.bodies.entropic_path import EntropicPath
from asbuilt.identification.estimators.consistent_fit import (
    STRONGEST_BELIEF,
    WEAKEST_BELIEF,
    ConsistentEstimate,
    choose_cad_weight,
    fit_consistent,
    fit_toward_cad,
    quietest_noise,
)
from asbuilt.identification.estimators.held_out_choice import (
    Candidate,
    Folds,
    MotionChoice,
    choose_candidate,
    group_different_motions,
)
from asbuilt.identification.estimators.least_squares import estimate_wls, refuse_few_rows
from asbuilt.identification.estimators.methods import estimator
from asbuilt.identification.estimators.robust import (
    HUBER,
    continue_huber,
    estimate_outlying_share,
    reweight,
)
from asbuilt.identification.information.estimate import Estimate, EstimationData
from asbuilt.identification.information.random_states import (
    build_random_motion_rows,
    measure_recorded_rates,
)
from asbuilt.identification.information.square_root_information import SquareRootInformation
from asbuilt.identification.information.triangular import solve_fast
from asbuilt.identification.uncertainty.uncertainty import FEWEST_BLOCKS, estimate_block_uncertainty

# Thresholds of the automatic choice.

# Share of torques beyond 4 robust standard deviations; normal noise has 0.006 %
SELECTION_OUTLYING_SHARE = 0.07
# Residual variance of a joint in robust variances; unmodelled friction alone reaches 12
SELECTION_OUTLYING_VARIANCE = 30.0
# Samples of a long recording, in evenly spread time blocks, that are searched for outliers
SELECTION_SCREENED = 20_000
# Groups of time blocks below which held-out errors have no usable standard error
SELECTION_FEWEST_FOLDS = 3
# Weights of CAD tried, times the design effect, so that samples count as often as they are
# independent. At 1 links lie within a factor of about e of CAD.
SELECTION_BELIEFS = (STRONGEST_BELIEF, 10.0, 10**0.5, 1.0)
# Samples per independent sample where the blocks are too few to estimate it
SELECTION_DESIGN_EFFECT = USUAL_DESIGN_EFFECT
# Rise of the torque error by a consistent fit beyond what its lost degrees of freedom cost
SELECTION_COSTLY = 0.05
# Rise of a joint's error in its torque [%] that is told, and of how many joints at most
SELECTION_FELT = 0.3
MOST_COSTLY = 3


SCALE_OF_TORQUE = "The description has no masses: those found have the scale of the torques"
BETTER_LEFT_OUT = "predicts the motion left out better than what was chosen without it"
CURE = Cure("check gains, description and what acts on the robot that the model lacks")


@estimator(
    "auto",
    "chosen automatically",
    "the estimate closest to CAD that predicts other motions as well as the best",
    needs="samples",
    held_fixed=(),
)
def estimate_auto(data: EstimationData) -> Estimate:
    """Estimate by the method closest to CAD that predicts other motions as well as the best.

    1. Weighted least squares; `huber` if more than 7 % of the torques lie beyond 4 robust standard
       deviations, or the residual variance of a joint exceeds 30 robust variances.
    2. Candidates are `entropic` with weights of CAD of 25 to 1 times the design effect, as far as
       the distance from CAD supports them (`choose_cad_weight`; the weight of 1 always),
       `consistent`, and the values of step 1, in this order. The first is chosen whose error on
       other motions is within one standard error of the least; physically inconsistent values only
       if they are better than every consistent candidate beyond chance (Student's test).

    The error on other motions is that on groups of time blocks of different motion, held out in
    turn, and an expected error of random motion beyond them (`choose_candidate`). Candidates that
    do not converge are left out. Without CAD masses the candidates are `consistent` and the values
    of step 1. Step 2 is left out if undetermined directions are refused. With `data.kind` the
    candidate of that kind is fitted, and no other, if there is one.
    """
    estimate = estimate_wls(data)
    reasons = []
    if data.samples is not None:
        sample = replace(data, every=max(1, data.information.n_samples // SELECTION_SCREENED))
        robust = reweight(sample, HUBER, estimate, roughly=True)
        share, ratio = estimate_outlying_share(sample, robust)
        if share > SELECTION_OUTLYING_SHARE or ratio > SELECTION_OUTLYING_VARIANCE:
            estimate = continue_huber(data, estimate)
            reasons.append(
                f"huber: {100 * share:.2g} % of the torques are outliers, and the residual variance"
                f" of one joint is {ratio:.3g} times the robust variance"
            )
    if data.undetermined == "refuse":
        why = f"{estimate.method}: undetermined directions are refused, not set from CAD"
        return _with_reasons(estimate, (*reasons, why))
    choose = _prepare_choice(data, estimate)

    def choose_kind(kind: str) -> Estimate:
        chosen, why, notes = choose(kind)
        return replace(_with_reasons(chosen, (*reasons, why), notes), of_kind=choose_kind)

    return choose_kind(data.kind)


def _with_reasons(
    estimate: Estimate, reasons: Sequence[str], notes: tuple[str, ...] = ()
) -> Estimate:
    """Return an estimate whose first note says why it was chosen."""
    first = f"Chosen automatically: {'; '.join(reasons)}."
    return replace(estimate, notes=(first, *notes, *estimate.notes))


@dataclass(frozen=True, slots=True, eq=False)
class _Candidates:
    """Hold candidates, and the names of those that failed."""

    known: list[Candidate] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)

    def add(
        self, estimate: Estimate, weight: float, held_out: Callable[[], Array], certain: bool = True
    ) -> None:
        """Add an estimate of all blocks as a candidate, or its name to those that failed."""
        name = estimate.method
        try:
            betas = held_out()
        except AsbuiltError:
            self.failed.append(name)
            return
        self.known.append(
            Candidate(name, weight, betas, certain, lambda: estimate, name, estimate.beta)
        )

    @property
    def note(self) -> tuple[str, ...]:
        """A note that names the candidates that did not converge."""
        if not self.failed:
            return ()
        return (f"Left out, since the fit did not converge: {', '.join(self.failed)}",)


Chosen = tuple[Estimate, str, tuple[str, ...]]
"""An estimate, why it was chosen, and notes."""


@use_one_blas_thread()
def _prepare_choice(data: EstimationData, free: Estimate) -> Callable[[str], Chosen]:
    """Return what chooses among all candidates, or those of a kind, as often as it is asked."""
    information = free.information or data.information
    prior = with_drive_scale(build_cad_prior(data.model, data.base.drive), information)
    # All candidates have one prior of the drives, so that they differ by CAD of the links alone.
    free = _with_drive_prior(information, free, prior)
    try:
        consistent = fit_consistent(information, prior)
    except AsbuiltError as problem:
        failed = free, f"{free.method}: the consistent fit failed ({problem})", ()
        return lambda _: failed
    only = _fit_kind_alone(data, prior, free, consistent) if data.kind else None
    if only is not None:
        return lambda _: only
    effect = design_effect(information, consistent)
    weights = _list_weights(data, effect)
    groups = group_different_motions(information, consistent.weights)
    if len(groups) < SELECTION_FEWEST_FOLDS:
        usual = _fit_usual_weight(data, prior, free, consistent)
        return lambda _: usual
    folds = Folds.of(information, groups, consistent.weights)
    candidates = _fit_candidates(information, prior, free, consistent, weights, folds)
    rates = None if data.samples is None else measure_recorded_rates(data.samples)
    motion = build_random_motion_rows(data.loading or data.model, data.base, rates)
    # Rows are sample-major, so the weights of the joints repeat.
    motion *= np.resize(consistent.weights, len(motion))[:, None]
    free_energy = float(consistent.weights**2 @ information.residual_energy(free.beta))
    return _Chooser(
        data,
        prior,
        free,
        candidates,
        lambda: choose_candidate(
            candidates.known,
            folds,
            information,
            consistent.weights,
            prior_information(information, prior),
            motion,
            effect * free_energy / information.n_rows,
        ),
    ).choose


def _list_weights(data: EstimationData, effect: float) -> list[float]:
    """Return the weights of CAD that are tried, none where it has no masses."""
    return [effect * belief for belief in SELECTION_BELIEFS] if data.model.has_masses else []


def _fit_kind_alone(
    data: EstimationData, prior: CadPrior, free: Estimate, consistent: ConsistentEstimate
) -> Chosen | None:
    """Return the fit of the kind that is asked for, compared with no other; None if there is none.

    Motion that was left out has decided for it, or it is compared with a fit of its kind.
    """
    information = free.information or data.information
    fits: dict[str, Callable[[], Estimate]] = {
        free.method: lambda: free,
        consistent.method: lambda: consistent,
    }
    if data.kind not in fits and data.model.has_masses:
        weights = _list_weights(data, design_effect(information, consistent))
        no_parts = np.zeros((0, information.base.n_base + 1, information.base.n_base + 1))
        near_cad = _fit_toward_cad(information, prior, consistent, weights, no_parts)
        fits |= {each.kind: each.fit for each in near_cad.known if each.fit}
    if data.kind not in fits:
        return None
    try:
        fit = fits[data.kind]()
    except AsbuiltError:
        return None
    why = f"{fit.method} {BETTER_LEFT_OUT}"
    return _conclude_choice(data, prior, free, replace(fit, kind=data.kind), why, ())


def _with_drive_prior(
    information: SquareRootInformation, free: Estimate, prior: CadPrior
) -> Estimate:
    """Return least squares with the prior of drive parameters, alike where they are determined."""
    x, root = _solve_with_drive_rows(information.stacked(free.weights), information, prior)
    solution = replace(free.solution, x=x, inverse_root=root)
    return free.renewed(
        free.method, information, solution, own_information=free.information, notes=free.notes
    )


def _solve_with_drive_rows(
    factor: Array, information: SquareRootInformation, prior: CadPrior
) -> tuple[Array, Array]:
    """Return least squares of a factor with the prior of drives (p,), and its inverse root."""
    return solve_fast(
        with_drive_rows(factor, information.base, prior),
        information.n_rows,
        information.base.regrouping @ prior.parameters,
    )


def design_effect(information: SquareRootInformation, estimate: Estimate) -> float:
    """Return samples per independent sample of the residuals' noise.

    What blocks of like motion share is no noise, and not counted: the error on motions held out
    already decides on it, and counted twice it drew the LWR4+ too far to CAD.
    """
    if information.n_blocks < FEWEST_BLOCKS:
        return SELECTION_DESIGN_EFFECT
    found = estimate_block_uncertainty(information, estimate)
    return max(1.0, information.n_samples / max(found.effective_samples * found.shared, 1.0))


def prior_information(information: SquareRootInformation, prior: CadPrior) -> Array:
    """Return the information (p, p) of CAD on base parameters: `(K M^-1 K^T)^-1`, M its metric."""
    # K M^-1 K^T of the links, and of the drives, whose metric is diagonal.
    regrouping = information.base.regrouping
    inertial = 10 * prior.n_links
    links = regrouping[:, :inertial].reshape(-1, prior.n_links, 10)
    turned = np.einsum("pia,iab->pib", links, np.linalg.inv(prior.metric))
    covariance = turned.reshape(len(links), -1) @ regrouping[:, :inertial].T
    drives = regrouping[:, inertial:] * prior.drive_scale
    covariance += drives @ drives.T / prior.drive_weight
    # Unit diagonal before the inverse: units of parameters differ by many decades.
    size = np.sqrt(np.diag(covariance))
    return np.asarray(np.linalg.inv(covariance / np.outer(size, size)) / np.outer(size, size))


def _fit_candidates(
    information: SquareRootInformation,
    prior: CadPrior,
    free: Estimate,
    consistent: ConsistentEstimate,
    weights: list[float],
    folds: Folds,
) -> _Candidates:
    """Return the candidates, the closest to CAD first, fitted without each group in turn."""
    candidates = _fit_toward_cad(information, prior, consistent, weights, folds.used)
    K = information.base.regrouping
    conic = ConicProblem(prior, K, bound_generously(prior))

    def fit_each(fit: Callable[[Array], Array]) -> Array:
        refuse_few_rows(information, part=1.0 - folds.counts.max() / folds.counts.sum())
        return np.array([fit(factor) for factor in folds.used])

    candidates.add(
        consistent,
        WEAKEST_BELIEF,
        lambda: fit_each(lambda factor: K @ conic.fit(factor, rough=True)),
    )
    candidates.add(
        free,
        0.0,
        lambda: fit_each(lambda factor: _solve_with_drive_rows(factor, information, prior)[0]),
        # Least squares needs a reason to be chosen unless its values could be those of a robot.
        certain=not free.undetermined and _is_consistent(information.base, free),
    )
    return candidates


def _fit_toward_cad(
    information: SquareRootInformation,
    prior: CadPrior,
    consistent: ConsistentEstimate,
    weights: list[float],
    parts: Array,
) -> _Candidates:
    """Return the candidates with a weight of CAD, fitted to m parts (m, p + 1, p + 1) as well."""
    candidates = _Candidates()
    if not weights:
        return candidates
    of_joints = consistent.weights
    K = information.base.regrouping
    path = EntropicPath(prior, information.base, bound_with_certainty(prior))
    rough, weights = _fit_supported_weights(
        path,
        information.stacked(of_joints)[None],
        weights,
        lambda chi, weight: choose_cad_weight(information, prior, of_joints, chi, weight),
    )
    folds = dict[float, Array]()
    for weight in (weight for weight in weights if weight in rough):
        with suppress(IdentifiabilityError):
            folds[weight] = path.fit_beside(parts, weight)
    for k, weight in enumerate(weights):
        name = f"entropic (weight {weight:.3g})"
        # From the weakest, which every fit has: other samples support other strong ones.
        kind = f"entropic {len(weights) - k}"
        fit = partial(fit_toward_cad, information, prior, weight=weight, weights=of_joints)
        if weight in folds:
            (whole,) = rough[weight] @ K.T
            candidates.known.append(
                Candidate(name, weight, folds[weight] @ K.T, fit=fit, kind=kind, beta=whole)
            )
        else:
            candidates.failed.append(name)
    return candidates


def _fit_supported_weights(
    path: EntropicPath,
    whole: Array,
    weights: list[float],
    supported: Callable[[Array, float], float],
) -> tuple[dict[float, Array], list[float]]:
    """Return rough fits (1, n_standard) by weight, and the weights that their distance supports.

    They are of all blocks, `whole` (1, p + 1, p + 1). Weights above the one that the fit with the
    strongest weight supports give way to it; the weakest always stays. At weaker weights model
    errors take links further from CAD than its tolerance does.
    """
    # The weights are beliefs times the design effect, the last belief being the weakest.
    effect = weights[-1] / SELECTION_BELIEFS[-1]
    rough = path.fit_descending(whole, weights)
    fitted = [weight for weight in weights if weight in rough]
    if not fitted:
        return rough, weights
    limit = effect * max(supported(rough[fitted[0]][0], fitted[0]), SELECTION_BELIEFS[-1])
    kept = [weight for weight in weights if weight <= limit]
    if len(kept) < len(weights) and limit > kept[0]:
        rough |= path.fit_descending(whole, [limit])
        kept = [limit, *kept]
    return rough, kept


@dataclass(slots=True, eq=False)
class _Chooser:
    """Choose among candidates that are compared once."""

    data: EstimationData
    prior: CadPrior
    free: Estimate
    candidates: _Candidates
    compare: Callable[[], MotionChoice]
    compared: MotionChoice | None = None

    @use_one_blas_thread()
    def choose(self, kind: str) -> Chosen:
        """Return the first candidate chosen whose fit to all blocks converges."""
        # Least squares is the last candidate, and is always said for comparison.
        while self.candidates.known:
            if self.compared is None:
                self.compared = self.compare()
            choice = self.compared.of_kind(kind)
            chosen = self.candidates.known[choice.chosen]
            try:
                fit = chosen.fit() if chosen.fit else self.free
            except AsbuiltError:
                # The rough fits did converge: the next best takes the place of this one.
                self.candidates.failed.append(chosen.name)
                del self.candidates.known[choice.chosen]
                self.compared = None
                continue
            fit = replace(fit, rivals=choice.rivals, kind=chosen.kind)
            notes = (choice.note, *self.candidates.note)
            why = self._explain(choice, kind)
            return _conclude_choice(self.data, self.prior, self.free, fit, why, notes)
        return self.free, f"{self.free.method}: no other fit converged", self.candidates.note

    def _explain(self, choice: MotionChoice, kind: str) -> str:
        """Return why a candidate was chosen, with its error and the errors it is compared with."""
        chosen = choice.candidates[choice.chosen]
        error = choice.sentence(choice.chosen)
        why = f"{chosen.name} has the least error on other motion"
        if choice.chosen != choice.best:
            near = self.data.model.has_masses
            nearest = "the fit closest to CAD" if near else "the first consistent fit"
            why = (
                f"{chosen.name} is {nearest} whose error on other motion is within one standard"
                " error of the least"
            )
            error += f", least {choice.sentence(choice.best)}"
        if chosen.kind != self.free.method:
            error += f", {choice.sentence(len(choice.candidates) - 1)}"
        if kind == chosen.kind:
            why = f"{chosen.name} {BETTER_LEFT_OUT}"
        beyond = " + expected beyond them" if np.any(choice.extrapolation > 0.0) else ""
        return (
            f"{why} ({error}: squared, in noise variances, on {choice.errors.shape[1]} groups of"
            f" time blocks{beyond})"
        )


def _conclude_choice(
    data: EstimationData,
    prior: CadPrior,
    free: Estimate,
    fit: Estimate,
    why: str,
    notes: tuple[str, ...],
) -> Chosen:
    """Return a fit that was chosen with what is wrong with it."""
    notes = notes if data.model.has_masses else (*notes, SCALE_OF_TORQUE)
    if fit.kind != free.method:
        return _join_notes(data, prior, fit, free), why, notes
    if _is_consistent(data.base, fit):
        return fit, why, notes
    finding = Finding(
        "consistent_fit_rejected",
        "warning",
        f"The values of {fit.method} are physically inconsistent, and were kept because consistent"
        " fits predict other motions worse on held-out groups of time blocks",
        CURE,
    )
    return replace(fit, findings=(*fit.findings, finding)), why, notes


def _fit_usual_weight(
    data: EstimationData, prior: CadPrior, free: Estimate, consistent: ConsistentEstimate
) -> tuple[Estimate, str, tuple[str, ...]]:
    """Return the entropic fit of the usual weight; the time blocks are too few to hold any out."""
    why = "the time blocks are too few to hold any out"
    information = free.information or data.information
    if data.model.has_masses:
        weight = SELECTION_DESIGN_EFFECT
        try:
            fit = fit_toward_cad(information, prior, weight=weight, weights=consistent.weights)
        except AsbuiltError:
            why += f", and entropic (weight {weight:g}) did not converge"
        else:
            return _join_notes(data, prior, fit, free), f"entropic (weight {weight:g}): {why}", ()
    return _join_notes(data, prior, consistent, free), f"consistent: {why}", ()


def _join_notes(data: EstimationData, prior: CadPrior, fit: Estimate, free: Estimate) -> Estimate:
    """Return a fit with notes and findings of the free one, and a finding if it fits far worse."""
    fit = replace(
        fit,
        information=free.information,
        sigma=np.maximum(fit.sigma, free.sigma),
        notes=(*free.notes, *fit.notes),
        findings=(*free.findings, *fit.findings),
    )
    information = free.information or data.information
    energy = information.residual_energy(free.beta)
    n = information.n_samples
    # The parameters are shared evenly, as no joint has its own count here.
    noise = np.sqrt(energy / max(n - free.rank / information.n_joints, 1.0))
    sigma = np.maximum(noise, quietest_noise(information))
    ratio = (information.residual_energy(fit.beta) / n / sigma**2)[information.has_torque]
    rise = float(np.sqrt(np.mean(ratio))) - 1.0
    if rise <= SELECTION_COSTLY:
        return fit
    finding = Finding(
        "consistent_fit_costly",
        "info",
        f"The physically consistent fit has {100 * rise:.0f} % more torque error on the data used"
        f" than the values of {free.method}, which predict the groups of motion held out no better"
        f" beyond chance{_locate_cost(data, prior, fit, free)}",
        CURE,
    )
    return replace(fit, findings=(*fit.findings, finding))


def _locate_cost(data: EstimationData, prior: CadPrior, fit: Estimate, free: Estimate) -> str:
    """Return at which joints consistency costs torque, and what free values have that no robot has.

    Empty where nothing is felt, or the rows of joints are mixed.
    """
    information = free.information or data.information
    if information.mixed:
        return ""
    torque = np.where(information.has_torque, information.torque_energy, np.inf)
    # Joints that were always still have no torque to share.
    torque = np.maximum(torque, np.finfo(np.float64).tiny)
    own, other = (
        100.0 * np.sqrt(information.residual_energy(each.beta) / torque) for each in (fit, free)
    )
    order = np.argsort(other - own, kind="stable")[:MOST_COSTLY]
    costs = [
        f"{data.model.joint_names[k]} {own[k]:.2g} % of its torque (else {other[k]:.2g} %)"
        for k in order.tolist()
        if own[k] - other[k] > SELECTION_FELT
    ]
    text = f": {join_names(costs)}" if costs else ""
    proof = find_inconsistency(data.base, prior, free.beta, free.covariance)
    if proof is None:
        return text
    value = proof.sentence.partition(" (base parameter")[0]
    return f"{text}. Those values have what no passive drive or body has: {value}"


def _is_consistent(base: BaseParameters, estimate: Estimate) -> bool:
    """Return whether an estimate is physically consistent; True if that cannot be decided."""
    # What cannot be decided is not held against an estimate.
    passive = not non_passive_drives(base, estimate.beta)
    return passive and decide_consistency(base, estimate.beta)[1] is not False
