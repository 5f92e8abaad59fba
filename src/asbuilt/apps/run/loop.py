"""The loop: design, record, predict, identify, until the model is proven."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np

import asbuilt
from asbuilt import Recording, RobotModel, Study
from asbuilt.apps.run.design import design_round
from asbuilt.apps.run.drivers import Driver
from asbuilt.apps.run.folder import RunFolder
from asbuilt.apps.run.log_check import check_log
from asbuilt.apps.run.options import RunOptions
from asbuilt.apps.run.prediction import without_hold_out
from asbuilt.apps.run.purpose import States, choose_states
from asbuilt.apps.run.rounds import Round, learn_round, moves_as_goal
from asbuilt.excitation import Motion
from asbuilt.tables import format_share

Progress = Callable[[str, float], None]
Ending = Literal["proven", "with care", "unreachable", "rounds", "interrupted"]

IN_A_ROW = 2
"""Rounds in a row that must pass: one motion may be easy by chance."""
LEARNED_FIRST = 3
"""Rounds before the loop says that more motion does not help: the first is slow, and only the
third tests a model of full speed."""
STALLED = 0.9
"""Share of its former value above which the unexplained error has stopped falling."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """Hold how a loop ended: why, in sentences, and the study of all rounds (None without one)."""

    ending: Ending
    text: str
    study: Study | None
    rounds: tuple[Round, ...]

    @property
    def seconds(self) -> float:
        """Motion of all rounds [s]."""
        return sum(each.seconds for each in self.rounds)


@dataclass(eq=False, kw_only=True)
class Loop:
    """Move a robot in rounds until its model is proven.

    Iterate over it for the rounds; `outcome` then says how it ended.

    Parameters
    ----------
    model
        The robot as described.
    driver
        What moves it.
    folder
        Where motions and logs go; rounds that it has already are learned from there.
    options
        The options.
    motion
        The motion that matters; None: the robot's whole range.
    confirm
        Called with the motion's file and the number of the round before it is sent; False ends.
    stopped
        Returns whether the user wants the loop to end after the round.
    progress
        Called with the name of a step and the fraction done.

    Examples
    --------
    >>> import tempfile
    >>> from asbuilt import load_robot
    >>> from asbuilt.apps.run import DriverRequest, RunOptions, open_driver
    >>> robot = load_robot("two-link")
    >>> driver = open_driver("virtual", DriverRequest(model=robot))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     options = RunOptions(seconds=6.0, rounds=2)
    ...     loop = Loop(model=robot, driver=driver, folder=Path(folder), options=options)
    ...     rounds = [each.number for each in loop]
    >>> rounds, loop.outcome.ending
    ([1, 2], 'rounds')
    """

    model: RobotModel
    driver: Driver
    folder: Path
    options: RunOptions = field(default_factory=RunOptions)
    motion: Motion | None = None
    confirm: Callable[[Path, int], bool] = lambda path, number: True
    stopped: Callable[[], bool] = lambda: False
    progress: Progress = lambda what, fraction: None
    rounds: list[Round] = field(default_factory=list, init=False)
    _recordings: list[Recording] = field(default_factory=list, init=False)

    def __post_init__(self) -> None:
        self.files = RunFolder(self.folder)

    def __iter__(self) -> Iterator[Round]:
        while self.choose_ending() is None and not self.stopped():
            made = self._do_round(len(self.rounds) + 1)
            if made is None:
                return
            self.rounds.append(made)
            yield made

    @property
    def outcome(self) -> Outcome:
        """How the loop ended."""
        ending = self.choose_ending() or "interrupted"
        study = conclude(self.rounds)
        text = explain_ending(ending, self.rounds, self.options)
        return Outcome(ending, text, study, tuple(self.rounds))

    @cached_property
    def _states(self) -> States:
        return choose_states(self.model, self.motion)

    def choose_ending(self) -> Ending | None:
        """Return how the loop ends; None while it goes on."""
        return choose_ending(self.rounds, self.options)

    def _do_round(self, number: int) -> Round | None:
        """Return a round; None if its motion was not confirmed."""
        path = self.files.motion_path(number)
        if not path.exists():
            self._design(number, path)
        motion = asbuilt.read_motion(path, self.model)
        log = self.files.find_log(number)
        if log is None:
            if not self.confirm(path, number):
                return None
            self.progress(f"record round {number}", 0.0)
            taken = self.driver.record(motion)
            check_log(self.model, taken, motion)
            log = self.files.keep_log(number, taken)
        recording = asbuilt.read_recording(log, model=self.model)
        check_log(self.model, recording, motion)
        self.progress(f"predict and identify round {number}", 0.0)
        self._recordings.append(recording)
        return learn_round(
            self.model,
            self._recordings,
            motion,
            (path, log),
            self.rounds,
            self._states,
            self.options,
            as_goal=self._moves_as_goal(),
        )

    def _moves_as_goal(self) -> bool:
        return moves_as_goal(self.rounds, repeated=self.motion is not None)

    def _design(self, number: int, path: Path) -> None:
        self.progress(f"design round {number}", 0.0)
        last = self.rounds[-1] if self.rounds else None
        study, weights = (None, None) if last is None else (last.study, last.goal.widening)
        motion = design_round(
            self.model,
            study,
            self.options,
            number,
            self._states,
            weights,
            self.motion,
            as_goal=self._moves_as_goal(),
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        asbuilt.write_motion(path, motion, self.model.joint_names)


def choose_ending(rounds: Sequence[Round], options: RunOptions) -> Ending | None:
    """Return how a loop with these rounds ends; None while it goes on."""
    until = options.until / 100.0
    last = rounds[-IN_A_ROW:]
    if len(last) == IN_A_ROW and all(each.passes(until) for each in last):
        if all(each.verdict == "yes" for each in last):
            return "proven"
        reasons = [each.tested.verdict.reasons for each in last if each.tested is not None]
        if all(set(reasons[0]) == set(reason) for reason in reasons) and reasons[0]:
            return "with care"
    if len(rounds) >= LEARNED_FIRST and len(last) == IN_A_ROW:
        before, now = (each.goal_noise for each in last)
        if now > until and now > STALLED * before:
            return "unreachable"
    return "rounds" if len(rounds) >= options.rounds else None


def conclude(rounds: Sequence[Round]) -> Study | None:
    """Return the study of all rounds, measured by the last predictions; None without a round.

    Each prediction was made before its round was learned, so none saw what it predicts.
    """
    if not rounds:
        return None
    study = rounds[-1].study
    tested = [each.tested for each in rounds[-IN_A_ROW:] if each.tested is not None]
    if not tested:
        return study
    return replace(
        study,
        findings=without_hold_out(study),
        validations=tuple(each.validation for each in tested),
        rollouts=tested[-1].rollouts,
    )


def explain_ending(ending: Ending, rounds: Sequence[Round], options: RunOptions) -> str:
    """Return why a loop ended, and what would help where it did not prove the model."""
    if not rounds:
        return "No round was recorded."
    seconds = sum(each.seconds for each in rounds)
    spent = f"{len(rounds)} round{'s' if len(rounds) > 1 else ''}, {seconds:.4g} s of motion"
    last = rounds[-1]
    wanted = format_share(options.until / 100.0)
    promised = format_share(last.goal_error)
    if ending == "proven":
        return (
            f"Proven: {IN_A_ROW} rounds in a row were predicted within {wanted} before they were"
            f" learned; {promised} is promised for the motion that matters ({spent})."
        )
    if ending == "interrupted":
        return f"Ended after {spent}; {promised} is promised."
    if ending == "with care":
        assert last.tested is not None
        why = last.tested.verdict.text.partition(";")[0].partition(": ")[2]
        return (
            f"The error is within {wanted}, but further rounds would not lead to USE: {why}"
            f" ({spent}). {_advise(last)}"
        ).strip()
    found = f"{format_share(last.found)} was found in the last round, {promised} is promised"
    if ending == "rounds" and last.passes(options.until / 100.0):
        return (
            f"The error is within {wanted}, but not with USE in {IN_A_ROW} rounds in a row"
            f" ({spent}): {found}. More rounds may prove it."
        )
    if ending == "rounds":
        return f"Not proven within {wanted} after {spent}: {found}. {_advise(last)}".strip()
    return (
        f"{wanted} cannot be reached by more motion of this kind: {found}, of which"
        f" {format_share(last.goal_noise)} is unexplained ({spent}). {_advise(last)}"
    ).strip()


def _advise(last: Round) -> str:
    """Return what is unexplained, at which joint, and which recording would tell."""
    result = last.study.result
    variance = (last.goal.noise * last.goal.widening) ** 2
    joint = int(np.argmax(variance))
    name = result.model.joint_names[joint]
    share = variance[joint] / np.sum(variance)
    findings = [each for each in without_hold_out(last.study) if each.severity != "info"]
    about = [finding for finding in findings if finding.joint == name or name in finding.message]
    first = next(iter((*about, *findings)), None)
    place = f"{format_share(share, 0)} of the unexplained squared torque is at {name}."
    if first is None:
        return (
            f"{place} Record the last motion again: what differs between two logs of one motion is"
            " noise that no model explains."
        )
    return f"{place} {first.text}"
