"""Whether a fit generalises to validation data, and joints whose torque it does not explain."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Cure, Finding, join_names
from asbuilt.identification.result.torque_prediction import TorqueMetrics
from asbuilt.statistics import estimate_mean_error
from asbuilt.validation.comparison.comparison import recording_name
from asbuilt.validation.prediction import Validation

# Say what validation data must not exceed; own choices, from recordings of seven real robots.

GENERALISATION_OVERFIT = 2.0  # Error of a joint, in multiples of its training error
# Error of a joint as a fraction of its torque, below which `GENERALISATION_OVERFIT` is no matter
GENERALISATION_NOTICEABLE = 0.1
GENERALISATION_BEHIND_CAD = 1.05  # Error of a joint as built, in multiples of CAD's error
GENERALISATION_RESTING_ENERGY = 0.5  # Share of a joint's squared error at rest,
GENERALISATION_RESTING_RATIO = 2.0  # Its error at rest in multiples of that in motion,
# And its share of the time at rest, from which static friction is named
GENERALISATION_RESTING_TIME = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class RestingErrors:
    """Divide the torque error of each joint, all (n,), into rest and motion.

    `time` is the share of samples at rest, `energy` the share of the squared error that falls on
    them; `resting` and `moving` are RMS errors, `relative_moving` the error in motion over the
    torque in motion. NaN if there are no such samples.
    """

    time: Array
    energy: Array
    resting: Array
    moving: Array
    relative_moving: Array

    @property
    def dominant(self) -> Mask:
        """Which joints (n,) have an error that is mostly static friction at rest."""
        return np.asarray(
            (self.energy > GENERALISATION_RESTING_ENERGY)
            & (self.resting > GENERALISATION_RESTING_RATIO * self.moving)
            & (self.time > GENERALISATION_RESTING_TIME)
        )


def divide_resting_errors(validation: Validation) -> RestingErrors:
    """Divide the errors of a prediction.

    At rest a joint is held by static friction, which may take any value up to break-away. A joint
    is at rest if its filtered velocity is exactly zero, which the signal chain makes it.
    """
    still = validation.velocity == 0.0
    error = validation.error
    # Joints that never rest, or never move, have no such errors.
    with np.errstate(invalid="ignore", divide="ignore"):
        squares = error**2
        resting, moving = (
            np.where(mask, squares, 0.0).sum(axis=0) / mask.sum(axis=0) for mask in (still, ~still)
        )
        torque = np.where(still, 0.0, validation.measured**2).sum(axis=0) / (~still).sum(axis=0)
        return RestingErrors(
            time=still.mean(axis=0),
            energy=np.where(still, squares, 0.0).sum(axis=0) / squares.sum(axis=0),
            resting=np.sqrt(resting),
            moving=np.sqrt(moving),
            relative_moving=np.sqrt(moving / torque),
        )


def check_validations(
    train: TorqueMetrics, validations: Sequence[Validation], *, refitted: bool = False
) -> tuple[Finding, ...]:
    """Return findings on validation errors, compared with the training error of the same fit.

    `refitted` says that the training errors shown elsewhere belong to another, final fit.
    """
    if not validations:
        return (
            Finding(
                "nothing_held_out",
                "warning",
                "No validation data: errors are of the training data and too small",
                Cure(
                    "validate on another recording, or hold out blocks", {"holdout": "blocks:5s:3"}
                ),
            ),
        )
    return _merge_by_code(
        (recording_name(validation.source), finding)
        for validation in validations
        for finding in (
            *report_carried_load(validation),
            *_report_generalisation(train, validation, refitted),
            *_report_rest(validation),
        )
    )


def report_carried_load(validation: Validation) -> Iterator[Finding]:
    """Name a load that a recording carries beyond the model, which is no fault of the model."""
    if validation.load is None:
        return
    yield Finding(
        "payload_in_log",
        "warning",
        f"{recording_name(validation.source)} {validation.load.text}",
        Cure("identify the payload, and validate on a log without it", call="identify_payload"),
        torque=1.0
        - (validation.load.relative_error / validation.metrics_as_built.relative_error) ** 2,
    )


def _merge_by_code(found: Iterable[tuple[str, Finding]]) -> tuple[Finding, ...]:
    """Return the first finding of each code, which names the recordings of the others."""
    first: dict[str, Finding] = {}
    others: dict[str, list[str]] = {}
    # Findings repeat in each recording: the first stands for all.
    for source, finding in found:
        if first.setdefault(finding.code, finding) is not finding:
            others.setdefault(finding.code, []).append(source)
    for code, sources in others.items():
        message = f"{first[code].message}; likewise on {join_names(sources)}"
        first[code] = replace(first[code], message=message)
    return tuple(first.values())


def _report_rest(validation: Validation) -> Iterator[Finding]:
    """Name joints whose error is mostly static friction while they rest."""
    errors = divide_resting_errors(validation)
    held = np.flatnonzero(errors.dominant)
    if held.size:
        listed = "; ".join(
            f"{validation.joint_names[k]} {100 * errors.energy[k]:.0f} % of the squared error in"
            f" {100 * errors.time[k]:.0f} % of the time, RMS {errors.resting[k]:.3g} at rest and"
            f" {errors.moving[k]:.3g} ({100 * errors.relative_moving[k]:.1f} %) in motion"
            for k in held
        )
        yield Finding(
            "error_at_standstill",
            "warning",
            f"Static friction at rest, which no friction law in velocity predicts, dominates the"
            f" errors on {recording_name(validation.source)}: {listed}",
            Cure("validate these joints by their motion"),
        )


def _report_generalisation(
    train: TorqueMetrics, validation: Validation, refitted: bool
) -> Iterator[Finding]:
    built = validation.metrics_as_built
    cad = validation.metrics_cad
    source = recording_name(built.source)
    shares = measure_error_shares(built)
    rest = divide_resting_errors(validation)
    # Static friction at rest is another finding, and no overfitting.
    error = np.where(rest.dominant, rest.moving, built.rms)

    def listed(joints: Indices, errors: Array, than: TorqueMetrics) -> str:
        return join_names(
            [
                f"{built.joint_names[k]} ({errors[k]:.3g} for {than.rms[k]:.3g}"
                f" {validation.units[k]})"
                for k in joints
            ]
        )

    worse = np.flatnonzero(
        # An error that is small compared with the torque is no matter, however it grew.
        (error > GENERALISATION_OVERFIT * train.rms)
        & (built.relative_error_per_joint > GENERALISATION_NOTICEABLE)
    )
    if worse.size:
        whose = " of the same fit" if refitted else ""
        yield Finding(
            "does_not_generalise",
            "warning",
            f"Errors on {source} are more than {GENERALISATION_OVERFIT:g} times those in"
            f" training{whose} at {listed(worse, error, train)}{_word_times(validation, worse)}",
            Cure("record longer and more varied motion, or use fewer drive terms"),
            joint=built.joint_names[worse[0]] if len(worse) == 1 else None,
            torque=float(shares[worse].sum()),
        )
    behind = np.flatnonzero(built.rms > GENERALISATION_BEHIND_CAD * cad.rms)
    # Without masses CAD predicts nothing that could be better.
    if behind.size and np.any(validation.predicted_cad):
        yield Finding(
            "cad_predicts_better",
            "warning",
            f"CAD predicts {source} better than the fit at {listed(behind, built.rms, cad)}",
            Cure("record longer, or regularise toward CAD", {"method": "ridge"}),
            torque=float(shares[behind].sum()),
        )


def measure_error_shares(metrics: TorqueMetrics) -> Array:
    """Return the share of the squared torque error at each joint (n,), zero without a channel."""
    # Exact torques have no error to share.
    energy = np.nan_to_num(metrics.rms**2)
    return np.asarray(energy / max(float(energy.sum()), np.finfo(np.float64).tiny))


def _word_times(validation: Validation, joints: Indices) -> str:
    """Return when the errors of joints are large, where most of them come at one time."""
    times = [
        f"{validation.joint_names[k]} {text.removeprefix(', ')}"
        for k in joints
        if (text := describe_large_errors(validation.t, validation.error[:, k]))
    ]
    return f"; {join_names(times)}" if times else ""


UNEXPLAINED = 0.5
"""RMS error over the standard deviation of a joint's torque beyond which it is not explained."""
MATTERS = 0.05
"""RMS error over the largest RMS torque of any joint below which a joint is not named."""
PARTS = 20
LONGEST = 10
MOST = 0.8
"""Parts of the time; how many in a row, at most, have this share of the squared error if it comes
and goes."""
ONE_SIDED = 0.5
"""Mean error over its RMS from which that span is pushed: pushes of 4 s in virtual logs of two
arms have 0.55 and 0.75, errors in nine real recordings at most 0.34."""
PUSHED = 0.1
"""RMS error in that span over the standard deviation of a joint's torque that is a push."""


def report_unexplained(training: Sequence[Validation]) -> Iterator[Finding]:
    """Name joints whose torque the model explains by less than three quarters of its variance.

    Also those whose error is mostly one push, a torque of one sign in one span of time. A torque
    that is small compared with other joints' is left out: friction and noise may be most of it.
    """
    for validation in training:
        error = np.sqrt(np.mean(validation.error**2, axis=0))
        spread = np.std(validation.measured, axis=0)
        largest = float(np.max(np.sqrt(np.mean(validation.measured**2, axis=0))))
        for k in np.flatnonzero(error > MATTERS * largest):
            wrong = validation.error[:, k]
            # A push comes once: in one span of the time.
            within = find_large_errors(validation.t, wrong)
            pushed = within is not None and _is_push(wrong[within], spread[k])
            # Half the standard deviation is a quarter of the variance.
            if not pushed and error[k] <= UNEXPLAINED * spread[k]:
                continue
            yield Finding(
                "torque_unexplained",
                "warning",
                f"The model does not explain the torque of {validation.joint_names[k]} in"
                f" {recording_name(validation.source)}:"
                f" RMS error {error[k]:.3g} of {spread[k]:.3g} {validation.units[k]}"
                f"{describe_large_errors(validation.t, wrong)}",
                Cure("check the column, the sensor and what touched the robot then"),
                joint=validation.joint_names[k],
            )


def describe_large_errors(t: Array, error: Array) -> str:
    """Return when the error (N,) is large, as text; empty if not most of it comes at one time."""
    within = find_large_errors(t, error)
    if within is None:
        return ""
    return f", most of it from {t[within][0]:.4g} to {t[within][-1]:.4g} s"


def find_large_errors(t: Array, error: Array) -> Mask | None:
    """Return the samples (N,) of the shortest span with most of the squared error (N,).

    None if that is more than half the time.
    """
    # Rounding must not number a part more.
    part = np.minimum(np.arange(t.size) * PARTS // t.size, PARTS - 1)
    sums = np.concatenate([[0.0], np.cumsum(np.bincount(part, error**2, PARTS))])
    # The shortest span first, up to half of the time.
    for width in range(1, LONGEST + 1):
        within = sums[width:] - sums[:-width]
        first = int(np.argmax(within))
        if within[first] >= MOST * sums[-1]:
            inside: Mask = (part >= first) & (part < first + width)
            return inside
    return None


def _is_push(error: Array, spread: float) -> bool:
    """Return whether errors (N,) of a span are large and of one sign."""
    size = float(np.sqrt(np.mean(error**2)))
    return size > PUSHED * spread and abs(float(np.mean(error))) > ONE_SIDED * size


# Say when a torque error returns with the state of its joint: own choices.

RETURNING_ORDER = 36  # Half waves over the range of positions, at most a turn: 18 teeth or poles
RETURNING_STIFF = (1.0, 10.0, 100.0)  # Trial weights of the prior, in samples
# Parts of a recording that are held out in turn; what returns is predicted by the others
RETURNING_FOLDS = 8
RETURNING_MOST = 20_000  # Samples of long recordings
RETURNING_SURE = 2.0  # Standard errors over the parts
RETURNING_SHARE = 0.2  # Share of the squared error from which on it is reported
# Share of the joint's torque below which it is of no account: torque sensors err as much
RETURNING_FELT = 0.01


def report_nameless(
    training: Sequence[Validation], samples: Sequence[Samples]
) -> Iterator[Finding]:
    """Name joints whose torque error returns wherever they pass a position in one direction.

    Noise does not return; what does is a torque that the model has no name for. `samples` are those
    of the predictions in `training`.
    """
    named = []
    for k, joint in enumerate(training[0].joint_names if training else ()):
        q, qd, error, torque = (
            np.concatenate(channel)
            for channel in zip(
                *(
                    (
                        np.interp(prediction.t, own.t, own.q[:, k]),
                        prediction.velocity[:, k],
                        prediction.error[:, k],
                        prediction.measured[:, k],
                    )
                    for prediction, own in zip(training, samples, strict=True)
                ),
                strict=True,
            )
        )
        # Ceiling division: at most `most` samples.
        every = -(-q.size // RETURNING_MOST)
        share, chance = returning_share(q[::every], qd[::every] > 0.0, error[::every])
        # Squares on both sides: `felt` is a share of the torque, not of its square.
        felt = share * np.mean(error**2) > RETURNING_FELT**2 * np.mean(torque**2)
        if felt and share > max(RETURNING_SHARE, RETURNING_SURE * chance):
            named.append(f"{joint} ({100 * share:.0f} %)")
    if named:
        yield Finding(
            "torque_nameless",
            "info",
            f"Something that we cannot name acts at {join_names(named, 4)}: this share of the"
            " squared"
            " torque error returns wherever the joint passes a position in the same direction",
            Cure("look at the torque error over position: cables, cogging, uneven friction"),
        )


def returning_share(q: Array, forward: Mask, error: Array) -> tuple[float, float]:
    """Return the share of a squared error (N,) that returns with position and direction (N,).

    And its standard error. A cosine series over the range of positions for each direction, with
    coefficients that fall as the order grows, is fitted to all parts of the recording but one and
    predicts that one (cross-validation; Stone, J. Royal Statistical Society B 36, 1974). Noise
    predicts nothing, so that the share is negative. What turns by more than one turn is taken to
    have the same error after each.
    """
    order = np.arange(RETURNING_ORDER + 1)
    whole = 2.0 * np.pi
    span = float(np.ptp(q))
    # Beyond a turn the same tooth passes again.
    way = (q - q.min()) % whole if span > whole else q - q.min()
    turn = np.pi * way / max(min(span, whole), np.finfo(np.float64).tiny)
    wave = np.cos(turn[:, None] * order)
    # Each direction has a series of its own: friction differs by it.
    X = np.hstack([wave * forward[:, None], wave * ~forward[:, None]])
    fold = np.arange(q.size) * RETURNING_FOLDS // q.size
    grams = np.array([X[fold == f].T @ X[fold == f] for f in range(RETURNING_FOLDS)])
    sides = np.array([X[fold == f].T @ error[fold == f] for f in range(RETURNING_FOLDS)])
    # Fine waves need more evidence than coarse ones.
    prior = np.tile(1.0 + (order / 4.0) ** 2, 2)
    energy = np.bincount(fold, error**2, RETURNING_FOLDS)
    best = (-np.inf, 0.0)
    for stiff in RETURNING_STIFF:
        ends = np.linalg.solve(
            grams.sum(axis=0) - grams + stiff * np.diag(prior),
            (sides.sum(axis=0) - sides)[..., None],
        )[..., 0]
        # |X b - e|^2 - |e|^2 on each part, by sums over it.
        left = np.einsum("fi,fij,fj->f", ends, grams, ends) - 2.0 * np.sum(ends * sides, axis=1)
        mean = max(float(energy.sum()), np.finfo(np.float64).tiny) / RETURNING_FOLDS
        shares = -left / mean
        # The best prior by held-out error, with its standard error.
        best = max(best, (float(shares.mean()), estimate_mean_error(shares)))
    return best
