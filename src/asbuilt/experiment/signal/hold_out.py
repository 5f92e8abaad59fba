"""Division of samples into training and held-out ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.errors import RecordingError, UsageError
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Cure
from asbuilt.ranges import Range

SHORTEST_DIVIDED = 6.0
"""Length of a recording [s] below which it is cut in two by default: filters leave too little of
shorter blocks, each of which borders at both ends on motion that is fitted."""
HALF = "last:0.5"
RECORDINGS = "recordings"
"""Rule by which whole recordings are left out in turn, each predicted by a fit to the others."""
FORMS = "blocks:5s:3 (every third 5 s block) or last:0.3 (the last 30 %)"


@dataclass(frozen=True, slots=True)
class Blocks:
    """Hold out the last of every so many blocks of so many seconds."""

    seconds: float
    every: int


@dataclass(frozen=True, slots=True)
class Last:
    """Hold out the last share of the time."""

    share: float


BLOCKS = Range(1e-3, 1e6, "s")
EVERY = Range(2, 1e6)
"""What lengths and numbers of blocks may be; a log has at most a million of either."""


def parse_rule(rule: str) -> Blocks | Last:
    """Return the rule of `hold_out` that a text stands for.

    Raises
    ------
    UsageError
        If it is none.

    Examples
    --------
    >>> parse_rule("blocks:5s:3")
    Blocks(seconds=5.0, every=3)
    """
    kind, *arguments = rule.strip().split(":")
    if kind == "blocks" and len(arguments) == 2:
        seconds = _parse_number(arguments[0].removesuffix("s"), rule, "a block length in seconds")
        every = _parse_number(arguments[1], rule, "every how many blocks one is held out")
        if not BLOCKS.holds(seconds) or every != int(every) or not EVERY.holds(every):
            raise UsageError(
                f"cannot hold out {rule!r}: blocks have a length {BLOCKS} and a whole number"
                f" {EVERY}, as in {FORMS}",
                value=rule,
            )
        return Blocks(seconds, int(every))
    if kind == "last" and len(arguments) == 1:
        share = _parse_number(arguments[0], rule, "a share of the time")
        if not 0 < share < 1:
            raise UsageError(
                f"cannot hold out {rule!r}: the share must lie between 0 and 1, as in {FORMS}",
                value=rule,
            )
        return Last(share)
    raise UsageError(f"cannot hold out {rule!r}: give {FORMS}", value=rule)


def choose_usual_rule(seconds: float) -> str | None:
    """Return the rule that holds out a third of a recording of this length; None if too short.

    Blocks of 5 s, of a shorter recording a sixth of it, so that two are held out.

    >>> choose_usual_rule(60.0), choose_usual_rule(15.0), choose_usual_rule(4.0)
    ('blocks:5s:3', 'blocks:2.5s:3', None)
    """
    if seconds < SHORTEST_DIVIDED:
        return None
    # A third of six sixths: two blocks are held out; to a tenth of a second for reading.
    return f"blocks:{min(5.0, np.floor(10.0 * seconds / 6.0) / 10.0):g}s:3"


def hold_out(samples: Samples, rule: str, *, shared: bool = False) -> tuple[Samples, Samples]:
    """Divide samples into training and held-out ones.

    Time counts from the beginning of the recording, so the division does not depend on what the
    filters trimmed. Every border ends a segment, so the parallel filter, which drops outputs
    without `margin` inputs on either side, does not mix torques of the two parts.

    Parameters
    ----------
    samples
        The samples.
    rule
        `"blocks:5s:3"` holds out every third block of 5 s, `"last:0.3"` the last 30 % of the time.
    shared
        Whether both parts are segments of the same arrays, which takes no memory.

    Returns
    -------
    train, held_out : Samples
        Every sample is in exactly one of them.

    Raises
    ------
    UsageError
        If the rule cannot be read.
    RecordingError
        If one part would be empty.

    Examples
    --------
    >>> t, x = np.arange(30.0), np.zeros((30, 1))
    >>> samples = Samples(t, x, x, x, x, rate=1.0, joint_names=("elbow",))
    >>> [part.n_samples for part in hold_out(samples, "blocks:5s:3")]
    [20, 10]
    """
    since = samples.t - samples.origin
    chosen = parse_rule(rule)
    if isinstance(chosen, Blocks):
        held = (
            # Rounding of times must not move the first sample of a block into the one before.
            np.floor(since / chosen.seconds + 1e-9).astype(int) % chosen.every == chosen.every - 1
        )
    else:
        # The last sample lasts one period.
        held = since >= (1.0 - chosen.share) * (since[-1] + 1.0 / samples.rate) - 1e-9
    if held.all() or not held.any():
        raise RecordingError(
            f"{samples.source}: holding out {rule!r} leaves nothing to"
            f" {'train' if held.all() else 'validate'} on in {since[-1]:.3g} s",
            cure=Cure("give shorter blocks"),
            file=samples.source,
            value=rule,
        )
    if shared:
        return samples.within(~held), samples.within(held)
    return samples.select(~held), samples.select(held)


def _parse_number(text: str, rule: str, what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise UsageError(
            f"cannot hold out {rule!r}: {text!r} is not {what}; give {FORMS}", value=rule
        )
    return value
