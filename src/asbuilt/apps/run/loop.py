"""The loop: design, record, predict, identify, until the model is proven."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np

import asbuilt
from asbuilt import AsbuiltError, DesignOptions, Recording, RobotModel, Study, UsageError, writers
from asbuilt.apps.run.drivers import Driver
from asbuilt.apps.run.folder import RunFolder
from asbuilt.apps.run.options import RunOptions
from asbuilt.apps.run.promise import States, choose_states, weigh_parameters
from asbuilt.apps.run.rounds import Round, check_log, learn_round, moves_as_goal, without_hold_out
from asbuilt.errors import MotionError
from asbuilt.excitation import Motion, check_motion, measure_clearance
from asbuilt.identification import known_information
from asbuilt.tables import format_share
from asbuilt.workflow import Progress

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
        return sum(round.seconds for round in self.rounds)


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
        motion = design_round(
            self.model,
            self.rounds,
            self.options,
            self._states,
            self.motion,
            as_goal=self._moves_as_goal(),
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        asbuilt.write_motion(path, motion, self.model.joint_names)


def choose_ending(rounds: Sequence[Round], options: RunOptions) -> Ending | None:
    """Return how a loop with these rounds ends; None while it goes on."""
    until = options.until / 100.0
    last = rounds[-IN_A_ROW:]
    if len(last) == IN_A_ROW and all(round.passes(until) for round in last):
        if all(round.verdict == "yes" for round in last):
            return "proven"
        reasons = [round.tested.verdict.reasons for round in last if round.tested is not None]
        if all(set(reasons[0]) == set(reason) for reason in reasons) and reasons[0]:
            return "with care"
    if len(rounds) >= LEARNED_FIRST and len(last) == IN_A_ROW:
        before, now = (round.goal_noise for round in last)
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
    tested = [round.tested for round in rounds[-IN_A_ROW:] if round.tested is not None]
    if not tested:
        return study
    return replace(
        study,
        findings=without_hold_out(study),
        validations=tuple(test.validation for test in tested),
        rollouts=tested[-1].rollouts,
    )


def explain_ending(ending: Ending, rounds: Sequence[Round], options: RunOptions) -> str:
    """Return why a loop ended, and what would help where it did not prove the model."""
    if not rounds:
        return "No round was recorded."
    seconds = sum(round.seconds for round in rounds)
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
        return (
            f"The error is within {wanted}, but further rounds would not lead to USE:"
            f" {last.tested.caution} ({spent}). {_advise(last)}"
        )
    found = f"{format_share(last.found)} was found in the last round, {promised} is promised"
    if ending == "rounds" and last.passes(options.until / 100.0):
        return (
            f"The error is within {wanted}, but not with USE in {IN_A_ROW} rounds in a row"
            f" ({spent}): {found}. More rounds may prove it."
        )
    if ending == "rounds":
        return f"Not proven within {wanted} after {spent}: {found}. {_advise(last)}"
    return (
        f"{wanted} cannot be reached by more motion of this kind: {found}, of which"
        f" {format_share(last.goal_noise)} is unexplained ({spent}). {_advise(last)}"
    )


def _advise(last: Round) -> str:
    """Return what is unexplained, at which joint, and which recording would tell."""
    result = last.study.result
    variance = (last.goal.noise * last.goal.widening) ** 2
    joint = int(np.argmax(variance))
    name = result.model.joint_names[joint]
    share = variance[joint] / np.sum(variance)
    findings = [finding for finding in without_hold_out(last.study) if finding.severity != "info"]
    # joint_1 is not named by a message on joint_10.
    named = re.compile(rf"(?<!\w){re.escape(name)}(?!\w)")
    about = [
        finding for finding in findings if finding.joint == name or named.search(finding.message)
    ]
    first = next(iter((*about, *findings)), None)
    place = f"{format_share(share, 0)} of the unexplained squared torque is at {name}."
    if first is None:
        return (
            f"{place} Record the last motion again: what differs between two logs of one motion is"
            " noise that no model explains."
        )
    return f"{place} {first.text}"


STARTS = 6
"""Random starts of a design; the best of six has 95 % of the information of the best of 96."""
FREQUENCY = 0.25
"""Highest frequency of random motions [Hz], as of `random_fourier` by default."""
ATTEMPTS = 20
"""Random motions that are tried until no bodies touch."""
SLOWER = 1.1
"""Factor by which a motion is slowed while it exceeds the torque limits of the robot as built."""
MOST_SLOWED = 20
"""How often that is tried: by then it is 7 times slower, and only gravity is left."""


def design_round(
    model: RobotModel,
    earlier: Sequence[Round],
    options: RunOptions,
    states: States,
    goal: Motion | None = None,
    *,
    as_goal: bool = False,
) -> Motion:
    """Return the motion of the round after others, within every limit.

    The first is small and slow and determines all parameters alike. One that moves `as_goal` is
    `goal`, the user's motion, or a random one over the whole range. Each further one has the least
    `tr(A C)` with what is known, A the cost of parameter errors for the purpose, in which joints
    count as much as tests have widened their promise.

    Raises
    ------
    MotionError
        If no motion within the limits is found.
    """
    number = len(earlier) + 1
    wanted = DesignOptions(
        duration=options.seconds,
        fraction=options.speed if number == 1 else options.fraction,
        collision=options.collision,
        starts=STARTS,
        seed=options.seed + number,
    )
    if not earlier:
        return _design(model, wanted)
    study = earlier[-1].study
    if as_goal:
        usual = _choose_goal_motion(model, options, number, goal)
        if usual is not None:
            return _slow_down(study, usual)
    result = study.result
    purpose = weigh_parameters(result, states, options.purpose, earlier[-1].goal.widening ** 2)
    sigma = result.sigma
    finite = np.where(np.isfinite(sigma), sigma, np.max(sigma[np.isfinite(sigma)]))
    try:
        motion = asbuilt.design_motion(
            result.model,
            replace(wanted, noise=tuple(np.maximum(finite, 1e-9).tolist())),
            base=result.base,
            prior=known_information(result),
            purpose=purpose,
            with_bound=False,
            cores=1,
        ).motion
    except (UsageError, MotionError):
        # Terms of coupled motors have no design, and of some models no motion determines all.
        motion = _design(model, wanted)
    return _slow_down(study, motion)


def _choose_goal_motion(
    model: RobotModel, options: RunOptions, number: int, goal: Motion | None
) -> Motion | None:
    """Return the user's motion or a random one; None if bodies touch or a limit is violated."""
    if goal is not None:
        return goal if _is_allowed(model, goal, options.collision) else None
    for attempt in range(ATTEMPTS):
        motion = asbuilt.random_fourier(
            model,
            np.random.default_rng([options.seed, number, attempt]),
            duration=options.seconds,
            n_harmonics=max(2, round(FREQUENCY * options.seconds)),
            fraction=options.fraction,
        )
        if _is_allowed(model, motion, options.collision):
            return motion
    return None


def _is_allowed(model: RobotModel, motion: Motion, collision: str | None) -> bool:
    if not check_motion(model, motion).is_respected:
        return False
    if collision is None:
        return True
    try:
        measure_clearance(model, motion, collision)
    except MotionError:
        return False
    return True


def _design(model: RobotModel, wanted: DesignOptions) -> Motion:
    motion = asbuilt.design_motion(model, wanted, with_bound=False, cores=1).motion
    check_motion(model, motion).raise_if_violated()
    return motion


def _slow_down(study: Study, motion: Motion) -> Motion:
    """Return a motion as slow as the torque limits of the robot as built need it."""
    try:
        robot = writers.as_built(study.result).model
    except AsbuiltError:
        robot = study.result.model
    for times in range(MOST_SLOWED):
        slower = motion if times == 0 else motion.slowed(SLOWER**times)
        if check_motion(robot, slower).is_respected:
            return slower
    check_motion(robot, slower).raise_if_violated()
    return slower
