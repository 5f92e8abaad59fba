"""A round of a loop: the check of its log, what its model promised, and what it taught."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

import asbuilt
from asbuilt import Recording, RecordingError, RobotModel, Study, StudyOptions, ValidationOptions
from asbuilt.apps.run.options import Purpose, RunOptions
from asbuilt.apps.run.promise import Promise, States, Unexplained, promise_error, widen_promise
from asbuilt.arrays import Array
from asbuilt.excitation import Motion
from asbuilt.findings import Cure, Finding
from asbuilt.tables import format_share, round_significant
from asbuilt.validation import Rollout, Validation, Verdict, study_verdict

PARTED = 1.5
"""Found over promised error of a joint from which a line names it; of 95 % of tests it is less."""
ALIKE = 0.9
"""Promise over the former one below which, or above whose inverse, a round tells it."""
FIRST_TEST = 3
"""First round that moves as the user will; two designed ones have taught the model before."""
KNOWN = 0.5
"""Error by parameters over the unexplained one below which parameters are known: it then adds 12 %
to the promise at most."""
NAMED = 3
"""Joints that are listed as the weakest."""


@dataclass(frozen=True, eq=False)
class Round:
    """Hold a round.

    Parameters
    ----------
    number
        From 1.
    motion, log
        Files of the motion and of its recording.
    seconds
        Duration of the motion [s].
    states
        States of the motion.
    promised, found
        Error that the model before it promised, and that its log showed before it was learned. In
        the first round no model promised, and CAD's error was found.
    promise, tested
        The promise and the prediction joint by joint; None in the first round.
    study
        The model identified from all rounds so far.
    goal
        Torque error that this model promises on the motion that matters.
    unexplained
        The torque that it leaves unexplained by speed; None if the measure is simulated motion.
    as_goal
        Whether the motion was one like the user's.
    exchange
        Share of simulated motion per torque error and one over the speed [rad/(N m s)]; None if the
        measure of the loop is the torque.
    goal_states
        The states that matter.
    learned
        What the round taught, in phrases.
    """

    number: int
    motion: Path
    log: Path
    seconds: float
    states: States
    promised: float | None
    found: float
    promise: Promise | None
    tested: Tested | None
    study: Study
    goal: Promise
    unexplained: Unexplained | None
    as_goal: bool
    exchange: float | None
    goal_states: States
    learned: tuple[str, ...]

    @property
    def goal_error(self) -> float:
        """The promise on the motion that matters, in the measure of the loop."""
        return convert_promise(self.goal.error, self.goal, self.goal_states, self.exchange)

    @property
    def goal_noise(self) -> float:
        """The part of it that more motion of the same kind does not take away."""
        return convert_promise(self.goal.noise_error, self.goal, self.goal_states, self.exchange)

    @property
    def verdict(self) -> str:
        """Verdict on the model that predicted this round: `yes`, `with care`, `no` or `cad`."""
        return "cad" if self.tested is None else self.tested.use

    @property
    def is_known(self) -> bool:
        """Whether the errors of parameters hardly add to the promise."""
        uncertain = np.linalg.norm(self.goal.uncertain)
        return bool(uncertain <= KNOWN * np.linalg.norm(self.goal.noise))

    def passes(self, until: float) -> bool:
        """Return whether the errors found and promised stay below the wanted one (a share)."""
        return self.tested is not None and self.found <= until and self.goal_error <= until

    def list_weakest(self) -> list[dict[str, str | float | None]]:
        """Return joints with promised and found RMS torque error, the weightiest first."""
        names = self.study.result.model.joint_names
        order = np.argsort(-self.goal.joints)[:NAMED].tolist()
        return [
            {
                "joint": names[k],
                "promised": float(self.goal.joints[k]),
                "found": None if self.tested is None else float(self.tested.joints[k]),
            }
            for k in order
        ]


def moves_as_goal(earlier: Sequence[Round], *, repeated: bool) -> bool:
    """Return whether the next round moves as the user will: from the third on, every other one.

    Designed motions are fast; what no model explains, such as friction at reversal, is larger in
    slower motion, which they would never test. As soon as the parameters are known nearly all of
    the promised error is of this kind, which no design lowers: then all further rounds move so,
    unless that is one motion, `repeated`, which would be predicted after it was learned.
    """
    number = len(earlier) + 1
    if number < FIRST_TEST:
        return False
    return (number - FIRST_TEST) % 2 == 0 or (earlier[-1].is_known and not repeated)


def learn_round(
    model: RobotModel,
    recordings: Sequence[Recording],
    motion: Motion,
    files: tuple[Path, Path],
    earlier: Sequence[Round],
    states: States,
    options: RunOptions,
    *,
    as_goal: bool,
) -> Round:
    """Return a round, whose recording, the last one, is predicted before it is learned.

    `files` are those of the motion and the log; `states` matter to the user, and a round that moves
    `as_goal` has states like them.
    """
    last = earlier[-1] if earlier else None
    tests = [
        (round.as_goal, round.states, round.promise, round.tested)
        for round in earlier
        if round.promise and round.tested
    ]
    promise = tested = promised = None
    moved = States.of([motion])
    if last is not None:
        promise = promise_error(last.study.result, moved, last.goal.widening, last.unexplained)
        promised = convert_promise(promise.error, promise, moved, last.exchange)
        tested = predict_round(last.study, recordings[-1], options.purpose)
        tests.append((as_goal, moved, promise, tested))
    study = asbuilt.identify(
        model, recordings, options=StudyOptions(holdout=None, drive=options.drive)
    )
    # What was found in motion like the user's counts, as soon as there is some.
    tests = [test for test in tests if test[0]] or tests
    simulated = is_simulated(study, options.purpose)
    # Position errors are torque errors over time: those of an instant hardly move a joint.
    unexplained = None if simulated else Unexplained.of(study.training)
    found = [(where, before, after.joints) for _, where, before, after in tests]
    widening = widen_promise(study.result, unexplained, found)
    goal = promise_error(study.result, states, widening, unexplained)
    exchange = None
    if simulated:
        tried = [(where, after) for _, where, _, after in tests]
        exchange = _find_exchange(study, recordings[-1], moved, tried)
    taught = [
        *_list_learned(last, study),
        *_list_surprises(study, promise, tested),
        *_list_promises(last, convert_promise(goal.error, goal, states, exchange)),
    ]
    return Round(
        len(recordings),
        *files,
        motion.duration,
        moved,
        promised,
        _find_error_of_cad(study, recordings[-1], options) if tested is None else tested.error,
        promise,
        tested,
        study,
        goal,
        unexplained,
        as_goal,
        exchange,
        states,
        tuple(taught),
    )


def _find_error_of_cad(study: Study, recording: Recording, options: RunOptions) -> float:
    if not is_simulated(study, options.purpose):
        return float(study.training[0].metrics_cad.relative_error)
    (rollout,) = asbuilt.roll_out_result(study.result, recording, [HORIZON])
    return relate_rollout(rollout, "cad")


def _find_exchange(
    study: Study, recording: Recording, moved: States, tests: Sequence[tuple[States, Tested]]
) -> float:
    """Return the share of simulated motion per torque error and one over the speed.

    Over windows of one length an error of the torque is integrated alike, whatever causes it, and
    the motion is as long as it is fast. The geometric mean of the predictions that were made, with
    their states; without one, that on the recording learned, which `moved` has.
    """
    found = [(after.error, after.joints, where) for where, after in tests]
    if not found:
        (rollout,) = asbuilt.roll_out_result(study.result, recording, [HORIZON])
        joints = study.training[-1].metrics_as_built.rms
        found = [(relate_rollout(rollout, "as_built"), joints, moved)]
    ratios = [
        error * where.speed / np.linalg.norm(np.nan_to_num(joints))
        for error, joints, where in found
    ]
    return float(np.exp(np.mean(np.log(ratios))))


def convert_promise(
    share: float, promise: Promise, states: States, exchange: float | None
) -> float:
    """Return a share of the torque of a promise on states in the measure of a loop."""
    if exchange is None:
        return share
    return share * float(np.linalg.norm(promise.torque)) * exchange / states.speed


def _list_learned(last: Round | None, study: Study) -> Iterator[str]:
    """Yield the parameters and effects that a round added to the model."""
    result = study.result
    before = () if last is None else last.study.effects
    known = {(effect.effect, effect.joint) for effect in before if effect.in_model}
    if last is None or last.study.result.rank != result.rank:
        yield f"{result.rank} of {result.n_base} parameters"
    for effect in study.effects:
        if effect.in_model and (effect.effect, effect.joint) not in known:
            size = f"{round_significant(effect.estimate, 2)} {effect.unit.removeprefix('1')}"
            at = "" if effect.joint is None else f" at {effect.joint}"
            yield f"{effect.effect.replace('_', ' ')} {size.strip()}{at}"


def _list_surprises(study: Study, promise: Promise | None, tested: Tested | None) -> Iterator[str]:
    """Yield the joint whose found error exceeds its promise the most, if it does so clearly."""
    if promise is None or tested is None:
        return
    ratio = tested.joints / np.maximum(promise.joints, np.finfo(float).tiny)
    joint = int(np.argmax(ratio))
    if ratio[joint] > PARTED:
        yield f"{study.result.model.joint_names[joint]} {ratio[joint]:.1f} times its promise"


def _list_promises(last: Round | None, error: float) -> Iterator[str]:
    """Yield the promise on the motion that matters, if it is new or another one."""
    now = format_share(error)
    if last is None:
        yield f"promises {now}"
    elif not ALIKE < error / last.goal_error < 1.0 / ALIKE and now != format_share(last.goal_error):
        yield f"promises {now}, before {format_share(last.goal_error)}"


HORIZON = 0.5
"""Windows [s] in which simulations are tested, as verdicts on logs of commands have them."""
OF_HOLD_OUT = ("nothing_held_out",)
"""Findings on a study without a test, which a round has."""


@dataclass(frozen=True, slots=True, eq=False)
class Tested:
    """Hold how a model predicted a round that it had not seen.

    Parameters
    ----------
    error
        Found error: of the torque as a share of it, or of the simulated motion as a share of the
        motion in its windows.
    joints
        RMS torque error of each joint (n,) [N m or N].
    validation, rollouts
        The prediction, and the simulations if the model is for a simulator.
    verdict
        Whether to use the model, by this round.
    purpose
        What the model is for.
    """

    error: float
    joints: Array
    validation: Validation
    rollouts: tuple[Rollout, ...]
    verdict: Verdict
    purpose: Purpose

    @property
    def use(self) -> str:
        """Whether to use the model for its purpose; bodies matter to simulators alone."""
        verdict = self.verdict
        return verdict.use if self.purpose == "simulator" else verdict.use_for_torque

    @property
    def caution(self) -> str:
        """The weightiest that speaks against the model, in words; empty without."""
        if self.verdict.use_for_torque == "yes":
            return self.verdict.bodies.text
        return self.verdict.text.partition(";")[0].partition(": ")[2]


def predict_round(study: Study, recording: Recording, purpose: Purpose) -> Tested:
    """Return how a model predicts a recording that it was not identified from."""
    # The loop has checked the recording.
    options = ValidationOptions(checked=False)
    (validation,) = asbuilt.validate(study.result, recording, options=options)
    rollouts: tuple[Rollout, ...] = ()
    if is_simulated(study, purpose):
        rollouts = asbuilt.roll_out_result(study.result, recording, [HORIZON], options=options)
    verdict = study_verdict(study.result, without_hold_out(study), (validation,), rollouts)
    error = relate_rollout(rollouts[0]) if rollouts else find_torque_error(validation)
    return Tested(error, validation.metrics_as_built.rms, validation, rollouts, verdict, purpose)


def is_simulated(study: Study, purpose: Purpose) -> bool:
    """Return whether errors are of simulated motion: for simulators, and on logs of commands.

    Where commands stand for torques, these are what the law of the servo makes of them.
    """
    return purpose == "simulator" or study.result.servo is not None


def find_torque_error(validation: Validation) -> float:
    """Return the torque error of the robot that exports carry, of the fitted model without one."""
    exported = validation.metrics_exported
    return float((exported or validation.metrics_as_built).relative_error)


def relate_rollout(rollout: Rollout, robot: Literal["as_built", "cad"] = "as_built") -> float:
    """Return the position error of simulations as a share of the motion in their windows.

    `|q_simulated - q| / |q - q_start|` over all samples, joints and windows; infinite where one
    diverges or the robot cannot be simulated.
    """
    error = moved = 0.0
    for motion in rollout.motions:
        q = motion.windows.q
        simulated = getattr(motion, robot)
        if simulated is None:
            return float("inf")
        error += float(np.sum((simulated - q) ** 2))
        moved += float(np.sum((q - q[:, :1]) ** 2))
    ratio = np.sqrt(error / moved) if moved > 0.0 else np.inf
    return float(ratio) if np.isfinite(ratio) else float("inf")


def without_hold_out(study: Study) -> tuple[Finding, ...]:
    """Return the findings of a study that concern its model rather than its lack of a test."""
    return tuple(finding for finding in study.findings if finding.code not in OF_HOLD_OUT)


FOLLOWED = 0.4
"""RMS distance of a joint from the motion, in standard deviations of the motion, that a log may
have at the best shift in time; controllers lag by less, other motion is farther off by 1."""
SAGGED = 0.05
"""RMS distance [rad or m] that a log may have beyond that: friction and the load on a soft servo
hold a joint that hardly moves this far from its motion."""
RATE = 50.0
"""Rate at which log and motion are compared [Hz]; no arm moves a radian between two samples."""
SHORTER = 0.9
"""Share of the motion that a log must last."""


def check_log(model: RobotModel, recording: Recording, motion: Motion) -> None:
    """Raise `RecordingError` unless a log is sound, and of the motion that was sent.

    It may begin before the motion and end after it.
    """
    asbuilt.check_recording(model, recording).raise_errors()
    cure = Cure(
        "run the motion of this round to its end, give its log, and resume the loop",
        {"resume": True},
    )
    if recording.duration < SHORTER * motion.duration:
        raise RecordingError(
            f"{recording.source} lasts {recording.duration:.3g} s, the motion that was sent"
            f" {motion.duration:.3g} s",
            cure=cure,
        )
    distance, size = measure_distance(recording, motion)
    joint = int(np.argmax(distance / _allow_distance(size)))
    if distance[joint] > _allow_distance(size)[joint]:
        raise RecordingError(
            f"{recording.source} is not a log of the motion that was sent:"
            f" {model.joint_names[joint]} is off by {distance[joint]:.2g}, where its motion is of"
            f" the size {size[joint]:.2g} (standard deviations in rad or m)",
            cure=cure,
            joint=model.joint_names[joint],
        )


def _allow_distance(size: Array) -> Array:
    """Return the distance (n,) [rad or m] up to which joints have followed motion of a size."""
    return FOLLOWED * size + SAGGED


def measure_distance(recording: Recording, motion: Motion) -> tuple[Array, Array]:
    """Return the RMS distance of each joint (n,) from a motion, and the size of that motion.

    At the shift in time at which all joints together are closest, and without a constant offset,
    as servos sag; the size is the standard deviation. Both are in rad or m.
    """
    sent = motion.derivative(motion.sample_times(RATE))
    t = np.arange(recording.t[0], recording.t[-1], 1.0 / RATE)
    logged = np.stack([np.interp(t, recording.t, column) for column in recording.q.T], axis=1)
    sent = sent[: len(logged)]
    size = sent.std(axis=0)
    scale = 1.0 / _allow_distance(size)
    a = logged * scale
    b = (sent - sent.mean(axis=0)) * scale
    sums = _add_windows(a, len(b))
    energy = _add_windows(a**2, len(b))
    cross = [np.correlate(x, y, "valid") for x, y in zip(a.T, b.T, strict=True)]
    # |a - mean a - b|^2 = |a|^2 - |sum a|^2 / N - 2 a.b + |b|^2 of every shift at once.
    squares = energy - sums**2 / len(b) - 2.0 * np.stack(cross, axis=1) + np.sum(b**2, axis=0)
    best = squares[int(np.argmin(squares.sum(axis=1)))]
    return np.asarray(np.sqrt(np.maximum(best, 0.0) / len(b)) / scale), size


def _add_windows(values: Array, length: int) -> Array:
    """Return the sums of all windows of a length, of each column."""
    running = np.cumsum(np.vstack([np.zeros(values.shape[1]), values]), axis=0)
    return np.asarray(running[length:] - running[:-length])
