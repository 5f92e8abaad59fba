"""Preparation of recordings: check, choose the signal chain, filter, hold out."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

from asbuilt.description.model import RobotModel
from asbuilt.errors import RecordingError, UsageError
from asbuilt.experiment import (
    Recorded,
    Recording,
    RecordingStream,
    Samples,
    SignalChain,
    head_of,
    resolve_chain,
)
from asbuilt.experiment.command.torque import drop_saturated
from asbuilt.experiment.quality.checks import TOO_LITTLE, RecordingCheck, check_recording
from asbuilt.experiment.signal.preparation import MotionFilters
from asbuilt.experiment.signal.samples import (
    HALF,
    RECORDINGS,
    choose_usual_rule,
    hold_out,
)
from asbuilt.findings import Cure, Finding
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.identification.uncertainty.delay_errors import RecordingDelay
from asbuilt.validation.comparison.comparison import HELD_OUT
from asbuilt.validation.generalisation.coverage import repeats
from asbuilt.workflow.delays import Delays, settle_delays
from asbuilt.workflow.study_options import AUTOMATIC, StudyOptions

Progress = Callable[[str, float], None]
FINGERPRINTED = 50_000
"""Samples of a recording's beginning in its fingerprint; a stream holds more at once."""
FEWEST = 10
"""Samples, after the filters, below which a part is too short to be held out by default."""


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """Hold recordings as samples, and how they were made.

    Attributes
    ----------
    chain
        The signal chain, its open choices settled; None if samples were given.
    holdout
        The rule by which `held_out` was divided from `training`.
    checks
        The checks of all recordings, in the order given.
    training, held_out
        The two parts of the recordings, or all of them and nothing.
    validation, others
        Other recordings, and groups of them, whole.
    digests
        Fingerprints of the recordings, empty for samples.
    delay
        Delays of the recordings, empty for samples.
    whole
        The recordings undivided, if they were divided by default; else empty.
    motions
        Numbers of the recordings of each motion, which are left out in turn: `held_out` are then
        the recordings whole; else empty.

    Notes
    -----
    | hold-out | `training` | `held_out` | `whole` | `motions` |
    |---|---|---|---|---|
    | none, or too little data | all | - | - | - |
    | a stated rule | a part | the rest | - | - |
    | by default, else | a part | the rest | all | - |
    | by default, several motions | all | each recording, to be left out in turn | - | theirs |

    The final fit uses `whole`, else `training`; what is held out tests a fit of `training`, or fits
    without each of `motions`.
    """

    chain: SignalChain | None
    holdout: str | None
    checks: tuple[RecordingCheck, ...]
    training: tuple[Samples, ...]
    held_out: tuple[Samples, ...]
    validation: tuple[Samples, ...]
    others: tuple[tuple[Samples, ...], ...]
    digests: tuple[str, ...]
    delay: tuple[RecordingDelay, ...] = ()
    whole: tuple[Samples, ...] = ()
    motions: tuple[tuple[int, ...], ...] = ()

    @property
    def unseen(self) -> tuple[Samples, ...]:
        """Samples that no fit to `training` has seen."""
        # Recordings that are left out in turn are in the training samples.
        return self.validation if self.motions else (*self.held_out, *self.validation)


def prepare(
    model: RobotModel,
    recordings: Sequence[Recorded],
    *,
    validation: Sequence[Recorded] = (),
    others: Sequence[Sequence[Recorded]] = (),
    chain: SignalChain | None = None,
    holdout: str | None = None,
    checked: bool = True,
    tolerated: Collection[str] = TOO_LITTLE,
    settle: Callable[[SignalChain, Sequence[Recording]], SignalChain] | None = None,
    estimate_delay: bool = False,
    delays: Sequence[RecordingDelay] = (),
    filters: MotionFilters | None = None,
    in_turn: bool = False,
    progress: Progress | None = None,
) -> Prepared:
    """Check recordings, choose the signal chain, filter and hold out.

    Long recordings are read as streams: their first segment is checked and chosen by. All
    recordings go through one chain, so that none is cut short by a choice made for another.

    Parameters
    ----------
    model
        The robot.
    recordings
        Recordings to divide by `holdout`; samples are taken as they are.
    validation
        Recordings that take part in the choice of the chain, but are not divided.
    others
        Groups of recordings that follow the chain.
    chain
        The signal chain; what it leaves open is chosen from the recordings.
    holdout
        A rule of `hold_out`, such as "blocks:5s:3"; None holds nothing out. "auto" leaves out whole
        recordings (`in_turn`), or else holds out by the usual rule, of short recordings the second
        half, if enough is left of both parts; it estimates delays on both, and keeps the recordings
        undivided too.
    checked
        Refuse recordings in which `check_recording` finds errors.
    tolerated
        Codes of errors that are no reason to refuse.
    settle
        Returns the chain to use, from the one chosen and the beginnings of `recordings`.
    estimate_delay
        Estimate the delays of the torque of `recordings` if the chain says so; other recordings
        have their mean.
    delays
        Delays that are known already.
    filters
        What filters motions, once for all who share it; None: of its own.
    in_turn
        Whether "auto" may leave out whole recordings of several motions in turn.
    progress
        Called with the name of a step and the fraction done.

    Raises
    ------
    RecordingError
        If a check finds an error, or filters leave nothing.
    UsageError
        If no recording is given, or the rule cannot be read.
    """
    if not recordings:
        raise UsageError(f"no recording of {model.name} is given; give at least one")
    report = progress or (lambda what, fraction: None)
    filters = filters or MotionFilters()
    report("check", 0.0)
    # All recordings are checked before any is filtered: errors come at once.
    every = [item for group in (recordings, validation, *others) for item in group]
    heads = _list_recording_heads(every if checked else ())
    checks = tuple(check_recording(model, head) for head in heads)
    for check in checks:
        check.raise_errors(but=tolerated)
    report("filter", 0.0)
    own = _list_recording_heads(recordings)
    # Validation takes part in the choice, so that none is cut short by a chain for another.
    chosen = [*own, *_list_recording_heads(validation)]
    settled = chain or SignalChain()
    if chosen:
        if model.mixes_joints:
            from asbuilt.identification.uncertainty.pose_noise import (  # noqa: PLC0415
                settle_rates,
            )

            # Rates before the cutoff: it depends on which velocities are used.
            settled = settle_rates(model, chosen, settled, filters)
        settled = resolve_chain(settled, *chosen, filters=filters)
    if settle is not None:
        settled = settle(settled, own)
    automatic = holdout == AUTOMATIC
    holdout = settle_rule(recordings, holdout)
    digests = tuple(map(digest_recording, own))
    late = Delays(settled, tuple(delays))
    # Delays that are known already are not estimated again.
    if chosen and not delays and (estimate_delay or settled.delay != "auto"):
        report("delay", 0.0)
        # By default both parts estimate the delay, which is of the log and not of the fit.
        rule = None if automatic else holdout
        late = settle_delays(model, own, digests, settled, rule, filters)
        settled = late.chain
    whole = tuple(_prepare_samples(item, settled, filters, late) for item in recordings)
    if model.has_reactions:
        from asbuilt.identification.uncertainty.pose_noise import (  # noqa: PLC0415 - light start
            with_equation_noise,
        )

        # Equations are weighed by their noise, common to all recordings.
        whole = with_equation_noise(model, whole)
    motions = group_by_motion(whole) if automatic and in_turn else ()
    parts: tuple[tuple[Samples, ...], tuple[Samples, ...]] | None
    if motions:
        holdout = RECORDINGS
        parts = whole, tuple(name_held_out(recording, RECORDINGS) for recording in whole)
    elif automatic:
        holdout = holdout or HALF
        parts = _divide_if_enough(whole, holdout)
    else:
        parts = _divide_samples(whole, holdout)
    if parts is None:
        holdout = None
        parts = (whole, ())

    # Other recordings are weighed as those that were fitted.
    def alike(item: Recorded) -> Samples:
        samples = _prepare_samples(item, settled, filters)
        reactions = samples.reactions.in_units_of(whole[0].reactions.noise)
        return replace(samples, reactions=reactions)

    return Prepared(
        chain=settled if chosen else None,
        holdout=holdout,
        checks=checks,
        training=parts[0],
        held_out=parts[1],
        validation=tuple(alike(item) for item in validation),
        others=tuple(tuple(alike(item) for item in group) for group in others),
        digests=digests,
        delay=late.recordings,
        whole=whole if automatic and holdout is not None and not motions else (),
        motions=motions,
    )


def group_by_motion(recordings: Sequence[Samples]) -> tuple[tuple[int, ...], ...]:
    """Return the numbers of the recordings of each motion; empty for a single motion.

    One that repeats the states of another is of its motion: whichever is left out, the other would
    show it. Recordings that share a name cannot be told apart, and count as one motion.
    """
    if len({samples.source for samples in recordings}) < max(len(recordings), 2):
        return ()
    motion = list(range(len(recordings)))
    for one, other in itertools.combinations(motion[:], 2):
        # Recordings of one motion form a group, and groups that touch are joined.
        if motion[one] != motion[other] and repeats(recordings[one], recordings[other]):
            joined = motion[other]
            motion = [motion[one] if group == joined else group for group in motion]
    groups = [
        tuple(k for k, group_of in enumerate(motion) if group_of == own) for own in set(motion)
    ]
    return tuple(sorted(groups)) if len(groups) > 1 else ()


def name_held_out(samples: Samples, rule: str) -> Samples:
    """Return samples whose source says that they were held out by a rule."""
    return replace(samples, source=f"{samples.source}{HELD_OUT}{rule}")


def divide_recordings(
    recordings: Sequence[Recorded], chain: SignalChain, holdout: str | None
) -> tuple[tuple[Samples, ...], tuple[Samples, ...]]:
    """Filter recordings and divide them into training and held-out samples."""
    return _divide_samples(
        [_prepare_samples(item, chain, MotionFilters()) for item in recordings], holdout
    )


def settle_rule(recordings: Sequence[Recorded], holdout: str | None) -> str | None:
    """Return the rule that `AUTOMATIC` divides by: the usual rule of the shortest recording."""
    return choose_usual_rule(measure_shortest(recordings)) if holdout == AUTOMATIC else holdout


def measure_shortest(recordings: Sequence[Recorded]) -> float:
    """Return the length of the shortest recording [s]."""
    # A stream is measured by its beginning, which is long enough for any rule.
    parts = (item if isinstance(item, Samples) else head_of(item) for item in recordings)
    return min(float(part.t[-1] - part.t[0]) for part in parts)


def digest_recording(recording: Recording) -> str:
    """Return a fingerprint of the first times and positions of a recording."""
    # Beginnings tell recordings apart: reading all of a stream would take too long.
    parts = [part[:FINGERPRINTED].tobytes() for part in (recording.t, recording.q)]
    return hashlib.sha256(b"".join(parts)).hexdigest()[:16]


def is_trained_on(result: IdentificationResult, item: Recorded) -> bool:
    """Return whether a result was identified from a recording; of samples nothing is known."""
    return not isinstance(item, Samples) and digest_recording(head_of(item)) in result.digests


def find_unseeing(
    result: IdentificationResult, item: Recorded
) -> tuple[IdentificationResult, str | None]:
    """Return a result with values that have not seen a recording, and the rule that divides it.

    The rule is None if they have seen nothing of it, or all.
    """
    # Samples have no fingerprint: whether they were seen is not known.
    if isinstance(item, Samples) or result.holdout is None or not is_trained_on(result, item):
        return result, None
    if result.holdout == RECORDINGS:
        number = result.digests.index(digest_recording(head_of(item)))
        return result.without_recording(number), None
    return result.of_training, result.holdout


def _list_recording_heads(recordings: Sequence[Recorded]) -> list[Recording]:
    return [head_of(item) for item in recordings if not isinstance(item, Samples)]


def _divide_samples(
    whole: Sequence[Samples], holdout: str | None, *, shared: bool = False
) -> tuple[tuple[Samples, ...], tuple[Samples, ...]]:
    """Divide samples into training and held-out ones."""
    if holdout is None:
        return tuple(whole), ()
    parts = [hold_out(samples, holdout, shared=shared) for samples in whole]
    return (
        tuple(training for training, _ in parts),
        tuple(name_held_out(held, holdout) for _, held in parts),
    )


def _divide_if_enough(
    whole: Sequence[Samples], holdout: str
) -> tuple[tuple[Samples, ...], tuple[Samples, ...]] | None:
    """Return the divided samples; None if the filters do not leave enough of every part."""
    try:
        parts = _divide_samples(whole, holdout, shared=True)
    except RecordingError:
        return None
    # Of every part of every recording: one that is too short leaves a motion out.
    enough = min(part.n_filtered for side in parts for part in side) >= FEWEST
    return parts if enough else None


def _prepare_samples(
    item: Recorded, chain: SignalChain, filters: MotionFilters, delays: Delays | None = None
) -> Samples:
    if isinstance(item, Samples):
        return item
    digest = digest_recording(head_of(item)) if delays and delays.recordings else ""
    if delays and digest:
        chain = delays.chain_of(digest)
    if isinstance(item, RecordingStream):
        # What the chain still leaves open is chosen for this stream alone.
        samples = item.prepared(resolve_chain(chain, item.head))
    else:
        samples = drop_saturated(filters.prepare(item, chain).samples(chain.delay), item)
    return samples if delays is None else delays.applied(samples, digest)


def with_settled_holdout(
    options: StudyOptions, recordings: Sequence[Recorded], validation: Sequence[Recorded]
) -> StudyOptions:
    """Return options whose `holdout` stays automatic only if a part can be held out by default.

    Other recordings to validate on take the place of what would be held out. A refinement, which
    would take twice as long, is fitted to the training part alone.
    """
    if options.holdout != AUTOMATIC:
        return options
    if validation:
        # A refinement is fitted once, to the training part.
        return replace(options, holdout=None)
    if options.refine is not None:
        return replace(options, holdout=settle_rule(recordings, AUTOMATIC))
    return options


def report_holdout(
    wanted: StudyOptions, prepared: Prepared, recordings: Sequence[Recorded], validated: bool
) -> tuple[Finding, ...]:
    """Return what a study with such options says of what it held out by default.

    `validated` says whether there is anything to validate on.
    """
    if wanted.holdout != AUTOMATIC:
        return ()
    if prepared.whole or prepared.motions:
        fits = (
            "fits without the recording that is predicted, and others of its motion"
            if prepared.motions
            else f"a fit without what was held out ({prepared.holdout})"
        )
        return (
            Finding(
                "final_fit",
                "info",
                f"Held-out errors are of {fits}; parameters, their errors and the training error"
                " are of the final fit to everything",
            ),
        )
    if validated:
        return ()
    seconds = measure_shortest(recordings)
    return (
        Finding(
            "nothing_held_out",
            "warning",
            f"No validation data: too little of {seconds:.3g} s is left if a part is held out and"
            " filtered; errors are of the training data and too small",
            Cure("validate on another recording, or record longer"),
        ),
    )
