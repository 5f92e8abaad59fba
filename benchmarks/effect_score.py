"""What a study named of what acts on a robot: pure functions of plain rows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

import numpy as np

BOTH_FORCES_BETWEEN_POINTS = frozenset({"gravity_spring", "balancer"})
"""Two names of one family: springs and cylinders between two points pull alike."""
VISIBLE = 0.1
"""Torque, in deviations of its noise, from which on an effect is visible without CAD."""
WORSE = 1.03
"""Ratio of errors from which on `auto` counts as worse than `none`."""


class Effect(NamedTuple):
    """An effect at a joint (None: of the robot or its log), its size, and what looks alike."""

    effect: str
    joint: str | None = None
    estimate: float | tuple[float, ...] | None = None
    std_error: float | None = None
    unit: str = ""
    alternatives: tuple[tuple[str, str | None], ...] = ()

    @property
    def name(self) -> tuple[str, str | None]:
        return self.effect, self.joint


class Truth(NamedTuple):
    """An effect that acts; `beside` are further joints at which it may be named.

    A tilt has the unit "deg about x" or "deg about y".

    `visible` is the torque that no parameter of the model can imitate, in standard deviations of
    the noise: below some tenth only the distance to CAD can show it.
    """

    effect: str
    joint: str | None
    size: float
    unit: str
    visible: float = np.nan
    beside: tuple[str, ...] = ()

    def is_named_by(self, name: tuple[str, str | None]) -> bool:
        """Whether a name is that of the effect, at its joint."""
        effect, joint = name
        alike = effect == self.effect or {effect, self.effect} <= BOTH_FORCES_BETWEEN_POINTS
        return alike and (self.joint is None or joint in (self.joint, *self.beside))

    def about(self, estimate: float | Sequence[float]) -> float:
        """Return the part of an estimate about the axis of a true tilt; values are about x, y."""
        values = np.ravel(estimate)
        return float(values[int(len(values) > 1 and self.unit.endswith("y"))])


@dataclass(frozen=True)
class Row:
    """One robot: what acts, what was named, and relative torque errors on another motion.

    `errors` are by mode, `none` and `auto`; `seconds` is CPU.
    """

    robot: int
    make: str
    truth: tuple[Truth, ...] = ()
    named: tuple[Effect, ...] = ()
    errors: Mapping[str, float] = field(default_factory=dict)
    seconds: float = np.nan
    problem: str = ""

    def found(self, truth: Truth) -> str:
        """Return how an effect was found: `named`, as an `alternative`, or `missed`."""
        if any(truth.is_named_by(each.name) for each in self.named):
            return "named"
        others = [name for each in self.named for name in each.alternatives]
        return "alternative" if any(map(truth.is_named_by, others)) else "missed"

    def false_names(self) -> tuple[Effect, ...]:
        """Return what was named and does not act, nor any of its alternatives."""
        return tuple(
            each
            for each in self.named
            if not any(
                truth.is_named_by(name)
                for truth in self.truth
                for name in (each.name, *each.alternatives)
            )
        )

    def turns_right(self) -> tuple[bool, ...]:
        """Return, of each tilt about x or y that was named, whether its sign is the world's."""
        return tuple(
            truth.size * truth.about(each.estimate) > 0.0
            for truth in self.truth
            if truth.effect == "tilt"
            for each in self.named
            if each.effect == "tilt" and each.estimate is not None
        )

    def as_json(self) -> dict[str, Any]:
        """Return plain values that `from_json` reads."""
        return asdict(self) | {
            "truth": [each._asdict() for each in self.truth],
            "named": [each._asdict() for each in self.named],
        }

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Row:
        """Read what `as_json` gave."""
        truth = tuple(
            Truth(**each | {"beside": tuple(each["beside"])}) for each in document["truth"]
        )
        named = tuple(
            Effect(**each | {"alternatives": tuple(map(tuple, each["alternatives"]))})
            for each in document["named"]
        )
        return cls(**{**document, "truth": truth, "named": named})


@dataclass(frozen=True)
class Score:
    """Shares over all robots without a problem.

    `named` and `alternative` are shares of the true effects, `named_visible` of those that some
    torque shows without CAD; `falsely` of the robots with a false
    name, `falsely_alone` of the robots on which nothing acts; `signs` is the share of tilts with
    the sign of the world; `ratio` is the median of error `auto` over `none` where an effect acts,
    `worse` the share of robots on which `auto` is worse.
    """

    robots: int
    effects: int
    problems: int
    named: float
    named_visible: float
    alternative: float
    falsely: float
    falsely_alone: float
    signs: float
    ratio: float
    worse: float
    errors: Mapping[str, float]
    seconds: float


def score(rows: Iterable[Row]) -> Score:
    """Score rows."""
    every = list(rows)
    good = [row for row in every if not row.problem]
    how = [row.found(truth) for row in good for truth in row.truth]
    false = [bool(row.false_names()) for row in good]
    signs = [right for row in good for right in row.turns_right()]
    both = [row for row in good if {"none", "auto"} <= set(row.errors)]
    ratios = {row.robot: row.errors["auto"] / row.errors["none"] for row in both}
    modes = sorted({mode for row in good for mode in row.errors})
    return Score(
        robots=len(good),
        effects=len(how),
        problems=len(every) - len(good),
        named=_share([each == "named" for each in how]),
        named_visible=_share(
            [
                row.found(truth) == "named"
                for row in good
                for truth in row.truth
                if truth.visible > VISIBLE
            ]
        ),
        alternative=_share([each == "alternative" for each in how]),
        falsely=_share(false),
        falsely_alone=_share([bool(row.false_names()) for row in good if not row.truth]),
        signs=_share(signs),
        ratio=_median([ratios[row.robot] for row in both if row.truth]),
        worse=_share([ratio > WORSE for ratio in ratios.values()]),
        errors={
            mode: _median([row.errors[mode] for row in good if mode in row.errors])
            for mode in modes
        },
        seconds=_median([row.seconds for row in good]),
    )


def by_family(rows: Iterable[Row]) -> dict[str, tuple[int, int, int, int]]:
    """Return of each family how often it acts, is named, is an alternative, is falsely named."""
    counts: dict[str, list[int]] = {}
    for row in rows:
        for truth in row.truth:
            own = counts.setdefault(truth.effect, [0, 0, 0, 0])
            own[0] += 1
            how = row.found(truth)
            own[1] += how == "named"
            own[2] += how == "alternative"
        for each in row.false_names():
            counts.setdefault(each.effect, [0, 0, 0, 0])[3] += 1
    return {name: (a, b, c, d) for name, (a, b, c, d) in sorted(counts.items())}


def _share(flags: Sequence[bool]) -> float:
    return float(np.mean(flags)) if flags else float("nan")


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else float("nan")
