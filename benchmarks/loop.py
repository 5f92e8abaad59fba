"""How much motion `asbuilt run` needs, beside one random motion and one designed motion.

Virtual robots of five makes in MuJoCo, with none to two effects that the description lacks, whose
sensors, motors or commands are logged. Each learns from growing amounts of motion: the rounds of
the loop, the beginning of one long random motion, and one motion of `asbuilt excite` of the same
length. The error of each model is measured on three random motions that none has seen, of the
torque or, from commands, of simulated motion.

    python benchmarks/loop.py --first 100 --robots 60 --out out/loop.jsonl
    python benchmarks/loop.py --summary out/loop.jsonl

Reported are the seconds of motion until the error stays within 1.2 of the least that 120 s of the
random or the designed motion reach, and how often USE is right: an error of at most 1.5 times the
promise. Lines are added to the file: one for the fixed motions of a robot and one for its loop,
each as soon as it is measured; what the file has is not measured again.

Robots below 100 were looked at while the rules of the loop were settled; those from 100 on were
not.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from scipy.stats import binomtest

import asbuilt
from asbuilt import (
    AsbuiltError,
    DesignOptions,
    LinkInertia,
    Recording,
    RobotModel,
    Study,
    StudyOptions,
    VirtualRobot,
)
from asbuilt.apps.run import Loop, RunOptions, predict_round
from asbuilt.excitation import Motion
from asbuilt.identification import choose_payload_frame

Purpose = Literal["torque", "simulator", "payload"]
MAKES = ("ur10e", "kuka-iiwa7-r800", "franka-panda", "puma-560", "scara")
LOGGED = ("sensor", "motor", "command")
EFFECTS = ("tilt", "tool", "stiction", "backlash")
LENGTHS = {
    "random": (10.0, 20.0, 40.0, 60.0, 120.0),
    "excite": (3.0, 5.0, 10.0, 20.0, 120.0),
}
"""Seconds of motion from which models are made; times between follow by interpolation."""
REPEATED = 20.0
"""Longest period of a designed motion [s]; a longer motion repeats that of this length."""
LEAST_ROUNDS = 4
"""Fewest rounds of the loop; most loops end with it."""
TESTS = 3
LOAD = 0.05
"""Mass that is weighed with the models, as a share of the moving mass."""
CENTRE = (0.02, -0.01, 0.08)
"""Its centre of mass at the flange [m]."""
WEIGHED = (20.0, 40.0)
"""Seconds of motion of the bare arm with which it is weighed."""
WITHIN = 1.2
"""Error, in multiples of what 120 s reach, at which a model counts as learned."""
TRUSTED = 1.5
"""Error in multiples of the promise up to which USE is right."""
WANTED = 5.0
"""Wanted error [%] of the rule that calls a model proven."""


@dataclass
class Moved:
    """A driver on a virtual robot."""

    robot: VirtualRobot
    seed: int
    moves_metal = False

    def record(self, motion: Motion) -> Recording:
        self.seed += 1
        return self.robot.record(motion, self.seed).recording

    def describe(self) -> str:
        return repr(self.robot)


class LongLoop(Loop):
    """A loop of at least `LEAST_ROUNDS`, whatever it finds; none after that goes on for long."""

    def choose_ending(self) -> Any:
        return super().choose_ending() if len(self.rounds) >= LEAST_ROUNDS else None


def make_robot(number: int) -> tuple[RobotModel, VirtualRobot, list[str], str]:
    """Return description, robot, its effects and what is logged."""
    model = asbuilt.load_robot(MAKES[number % len(MAKES)])
    logged = LOGGED[number % len(LOGGED)]
    rng = np.random.default_rng([number, 17])
    robot = VirtualRobot.preset("servo" if logged == "command" else "lab", model, number)
    if logged == "motor":
        robot = replace(robot, torque="motor")
    chosen = sorted(
        rng.choice(EFFECTS, size=(2 * number + number // 3) % 3, replace=False).tolist()
    )
    for name in chosen:
        robot = add_effect(robot, name, rng)
    return model, robot, chosen, logged


def add_effect(robot: VirtualRobot, name: str, rng: np.random.Generator) -> VirtualRobot:
    if name == "tilt":
        roll, pitch = np.deg2rad(rng.choice([-1, 1], 2) * rng.uniform(0.5, 2.0, 2))
        return robot.tilted(float(roll), float(pitch))
    if name == "tool":
        mass = rng.uniform(0.01, 0.04) * sum(link.inertia.mass for link in robot.model.links)
        body = LinkInertia.from_com(mass, rng.normal(0, 0.03, 3), 1e-3 * mass * np.eye(3))
        return robot.with_tool(body)
    n, train = robot.model.n_joints, robot.train
    coulomb = np.broadcast_to(train.coulomb, (n,))
    if name == "stiction":
        changed = replace(train, stiction=tuple((0.5 * coulomb).tolist()))
    else:
        changed = replace(train, backlash=tuple((2e-4 * rng.uniform(0.5, 1.5, n)).tolist()))
    return replace(robot, train=changed)


def measure_error(study: Study, tests: list[Recording], purpose: Purpose = "torque") -> float:
    """Return the root mean square error on motions that the study has not seen."""
    errors = [predict_round(study, each, purpose).error for each in tests]
    return float(np.sqrt(np.mean(np.square(errors))))


def learn(model: RobotModel, recording: Recording) -> Study:
    return asbuilt.identify(model, [recording], options=StudyOptions(holdout=None))


def random_motion(model: RobotModel, seed: int, seconds: float) -> Motion:
    return asbuilt.random_fourier(
        model, seed, duration=seconds, n_harmonics=max(5, round(seconds / 4))
    )


def record_tests(number: int) -> tuple[RobotModel, VirtualRobot, list[Recording]]:
    """Return description, robot, and recordings of motions that no model has seen."""
    model, robot, _, _ = make_robot(number)
    tests = [
        robot.record(random_motion(model, 9000 + 10 * number + k, 20.0), k).recording
        for k in range(TESTS)
    ]
    return model, robot, tests


def measure_fixed(number: int) -> dict[str, Any]:
    """Return the errors of models from growing lengths of one random and one designed motion."""
    model, robot, tests = record_tests(number)
    began = time.process_time()
    errors: dict[str, list[Any]] = {"random": [], "excite": []}
    whole = robot.record(random_motion(model, number, 120.0), number + 1).recording
    for length in LENGTHS["random"]:
        part = whole.between(0.0, length) if length < whole.duration else whole
        errors["random"].append([length, attempt(model, part, tests)])
    for length in LENGTHS["excite"]:
        options = DesignOptions(
            duration=length, starts=6, seed=number,
            periods=None if length <= REPEATED else round(length / REPEATED),
        )  # fmt: skip
        try:
            motion = asbuilt.design_motion(model, options, with_bound=False, cores=1).motion
        except AsbuiltError:
            # Too short for as many parameters.
            errors["excite"].append([length, None])
            continue
        recording = robot.record(motion, number + 2).recording
        errors["excite"].append([length, attempt(model, recording, tests)])
    return errors | {"cpu": time.process_time() - began}


def measure_loop(number: int, options: RunOptions) -> dict[str, Any]:
    """Return the errors of the models of a loop round by round, which goes on when it is proven."""
    model, robot, tests = record_tests(number)
    began = time.process_time()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        loop = LongLoop(
            model=model,
            driver=Moved(robot, 1000 * number),
            folder=Path(folder),
            options=replace(options, seed=number),
        )
        seconds = 0.0
        for made in loop:
            seconds += made.seconds
            rows.append({
                "seconds": seconds, "error": measure_error(made.study, tests, options.purpose),
                "promised": made.goal_error, "verdict": made.verdict,
                "passes": made.passes(options.until / 100), "round": [made.promised, made.found],
                "ending": Loop.choose_ending(loop),
            })  # fmt: skip
    return {"loop": rows, "cpu_of_loop": time.process_time() - began}


def measure_weighing(number: int, options: RunOptions) -> dict[str, Any]:
    """Return how far a mass is off that is weighed with the models of both loops and of `excite`.

    Rows are the seconds of motion, the relative error of the mass, its standard error likewise, and
    the distance of the centre [mm].
    """
    model, robot, _, _ = make_robot(number)
    mass = LOAD * sum(link.inertia.mass for link in robot.model.links)
    load = LinkInertia.from_com(mass, CENTRE, 2e-3 * mass * np.eye(3))
    carrying = robot.with_tool(load, choose_payload_frame(model)[0])
    loaded = carrying.record(random_motion(model, 8000 + number, 20.0), number + 3).recording

    def weigh(seconds: float, study: Study) -> list[float]:
        found = asbuilt.identify_payload(study, loaded)
        centre = 1e3 * float(np.linalg.norm(found.values[1:4] - CENTRE))
        error = float(found.values[0]) / mass - 1.0
        return [seconds, error, float(found.std_errors[0]) / mass, centre]

    weighed: dict[str, list[Any]] = {}
    for purpose in ("payload", "torque"):
        wanted = replace(options, purpose=purpose, seed=number, rounds=LEAST_ROUNDS)
        driver = Moved(robot, 1000 * number)
        with tempfile.TemporaryDirectory() as folder:
            loop = LongLoop(model=model, driver=driver, folder=Path(folder), options=wanted)
            made = list(loop)
        seconds = np.cumsum([each.seconds for each in made])
        weighed[purpose] = [
            weigh(float(at), each.study)
            for at, each in zip(seconds, made, strict=True)
            if np.min(np.abs(at - np.array(WEIGHED))) < 0.5 * options.seconds
        ]
    weighed["excite"] = []
    for length in WEIGHED:
        design = DesignOptions(duration=length, starts=6, seed=number)
        motion = asbuilt.design_motion(model, design, with_bound=False, cores=1).motion
        recording = robot.record(motion, number + 2).recording
        weighed["excite"].append(weigh(length, learn(model, recording)))
    return {"weighed": weighed}


def attempt(model: RobotModel, recording: Recording, tests: list[Recording]) -> float | None:
    try:
        return measure_error(learn(model, recording), tests)
    except AsbuiltError:
        return None


def time_until(errors: list[tuple[float, float | None]], level: float) -> float:
    """Return the seconds from which on the error stays within a level; infinite if never.

    Between two lengths the logarithm of the error falls straight over that of the length.
    """
    reached = after = np.inf
    for seconds, error in reversed(errors):
        if error is None:
            break
        if not error <= level:
            if np.isfinite(reached) and after < level:
                share = np.log(error / level) / np.log(error / after)
                reached = seconds * (reached / seconds) ** share
            break
        reached, after = seconds, error
    return float(reached)


def interpolate(errors: list[tuple[float, float | None]], seconds: float) -> float:
    """Return the error after some seconds, straight between logarithms; NaN before the first."""
    known = [(at, error) for at, error in errors if error is not None]
    if not known or seconds < known[0][0]:
        return float("nan")
    at, error = np.log(np.transpose(known))
    return float(np.exp(np.interp(np.log(seconds), at, error)))


def summarise(rows: list[dict[str, Any]]) -> Iterator[str]:
    whole = [row for row in rows if "loop" in row and "excite" in row]
    if whole:
        yield from compare_seconds(whole)
    looped = [row for row in rows if "loop" in row]
    if looped:
        yield from judge_use(looped)
    weighed = [row for row in rows if "weighed" in row]
    if weighed:
        yield from compare_weighing(weighed)


def compare_seconds(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the seconds of motion until a model counts as learned, by robot."""
    yield (
        f"{'robot':>5} {'make':<18}{'logged':<9}{'effects':<19}{'level %':>8}{'loop s':>8}"
        f"{'random':>8}{'excite':>8}"
    )
    times = []
    at_half = []
    for row in rows:
        ends = [row[way][-1][1] for way in ("random", "excite")]
        level = WITHIN * min(each for each in ends if each is not None)
        loop = [(each["seconds"], each["error"]) for each in row["loop"]]
        found = [time_until(each, level) for each in (loop, row["random"], row["excite"])]
        times.append(found)
        at_half.append(interpolate(row["excite"], found[2] / 2) / level)
        effects = "+".join(row["effects"]) or "-"
        yield (
            f"{row['robot']:>5} {row['make']:<18}{row['logged']:<9}{effects:<19}"
            f"{100 * level:>8.2f}" + "".join(f"{each:>8.2g}" for each in found)
        )
    seconds = np.array(times)
    medians = np.median(seconds, axis=0)
    yield f"median seconds: loop {medians[0]:.2g}, random {medians[1]:.2g}, excite {medians[2]:.2g}"
    for way, of in (("random", seconds[:, 1]), ("excite", seconds[:, 2])):
        # What neither reaches tells nothing.
        told = np.isfinite(seconds[:, 0]) | np.isfinite(of)
        half = int(np.sum(seconds[told, 0] <= of[told] / 2))
        yield f"the loop needs at most half of {way}: {half} of {np.sum(told)}"
    known = [each for each in at_half if np.isfinite(each)]
    if known:
        yield (
            f"half of its own seconds leave excite at {np.median(known):.2g} times the level"
            f" (median of {len(known)})"
        )
    yield from compare_at_equal_seconds(rows)


def judge_use(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield how loops end, and how often USE is right."""
    ends: dict[str, int] = {}
    proven = []
    for row in rows:
        last = next((each for each in row["loop"] if each["ending"]), row["loop"][-1])
        ending = last["ending"] or "goes on"
        ends[ending] = ends.get(ending, 0) + 1
        if ending == "proven":
            kind = "simulated motion" if row["logged"] == "command" else "torque"
            proven.append((last["error"] / last["promised"], kind, row["robot"]))
    yield "loops end: " + ", ".join(f"{ending} {count}" for ending, count in ends.items())
    for kind in ("torque", "simulated motion", None):
        ratios = [ratio for ratio, of, _ in proven if kind in (of, None)]
        if not ratios:
            continue
        right = int(np.sum(np.array(ratios) <= TRUSTED))
        low, high = binomtest(right, len(ratios)).proportion_ci()
        spread = " to ".join(f"{each:.2f}" for each in np.quantile(ratios, (0.05, 0.5, 0.95)))
        yield (
            f"USE right, {kind or 'all'}: {right} of {len(ratios)} (95 % interval {low:.0%} to"
            f" {high:.0%}); error over promise {spread} (5, 50, 95 %), worst {max(ratios):.2f}"
        )
    wrong = [f"{robot} ({ratio:.2f})" for ratio, _, robot in proven if ratio > TRUSTED]
    if wrong:
        yield "USE wrong: robots " + ", ".join(wrong)
    errors = [each["error"] for row in rows for each in row["loop"] if each["ending"] == "proven"]
    yield f"largest error on unseen motions when proven: {max(errors, default=np.nan):.1%}"
    seconds = np.median([row["cpu_of_loop"] / len(row["loop"]) for row in rows])
    yield f"CPU seconds of a round: median {seconds:.1f}"


def compare_weighing(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield how far masses are off that were weighed with the models of three ways."""
    for index, length in enumerate(WEIGHED):
        for way in ("payload", "torque", "excite"):
            found = np.array([row["weighed"][way][index][1:] for row in rows])
            name = "one designed motion" if way == "excite" else f"loop --for {way}"
            off = 100 * np.median(np.abs(found[:, 0]))
            within = int(np.sum(np.abs(found[:, 0]) <= 1.96 * found[:, 1]))
            yield (
                f"{length:g} s, {name}: mass off by {off:.2g} % (median), centre by"
                f" {np.median(found[:, 2]):.2g} mm; 95 % interval holds {within} of {len(rows)}"
            )


def compare_at_equal_seconds(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the error of the loop over that of one designed motion of the same length."""
    for length in LENGTHS["excite"]:
        ratios = [
            here["error"] / there[1]
            for row in rows
            for here in row["loop"]
            for there in row["excite"]
            if abs(here["seconds"] - length) < 0.5 and there[0] == length and there[1] is not None
        ]
        if ratios:
            low, middle, high = np.quantile(ratios, (0.0, 0.5, 1.0))
            yield (
                f"{length:g} s: error of the loop over that of one designed motion: median"
                f" {middle:.2f}, {low:.2f} to {high:.2f}"
            )


def read_rows(path: Path) -> dict[int, dict[str, Any]]:
    """Return what a file holds of each robot."""
    rows: dict[int, dict[str, Any]] = {}
    for line in path.read_text().splitlines() if path.exists() else ():
        row = json.loads(line)
        rows.setdefault(row["robot"], {}).update(row)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--robots", type=int, default=60)
    parser.add_argument("--first", type=int, default=100, help="number of the first robot")
    parser.add_argument("--out", type=Path, default=Path("out/loop.jsonl"))
    parser.add_argument("--summary", type=Path)
    parser.add_argument("--rounds", type=int, default=RunOptions().rounds)
    parser.add_argument("--seconds", type=float, default=RunOptions().seconds)
    parser.add_argument("--speed", type=float, default=RunOptions().speed)
    parser.add_argument("--for", dest="purpose", choices=get_args(Purpose), default="torque")
    parser.add_argument("--only", choices=("fixed", "loop", "weigh"), help="measure one part")
    given = parser.parse_args()
    path = given.summary or given.out
    options = RunOptions(
        rounds=given.rounds, seconds=given.seconds, speed=given.speed, purpose=given.purpose,
        until=WANTED,
    )  # fmt: skip
    parts = {
        "fixed": ("excite", measure_fixed),
        "loop": ("loop", lambda number: measure_loop(number, options)),
        "weigh": ("weighed", lambda number: measure_weighing(number, options)),
    }
    wanted = [given.only] if given.only else ["fixed", "loop"]
    if given.summary is None:
        path.parent.mkdir(parents=True, exist_ok=True)
        known = read_rows(path)
        for number in range(given.first, given.first + given.robots):
            for key, measure in (parts[part] for part in wanted):
                if key in known.get(number, {}):
                    continue
                model, _, effects, logged = make_robot(number)
                row = {"robot": number, "make": model.name, "effects": effects, "logged": logged}
                with path.open("a") as file:
                    file.write(json.dumps(row | measure(number)) + "\n")
    print("\n".join(summarise(list(read_rows(path).values()))))


if __name__ == "__main__":
    main()
