"""How much motion `asbuilt run` needs, beside one random motion and one designed motion.

Virtual robots of five makes in MuJoCo, with none to two effects that the description lacks, whose
sensors, motors or commands are logged. Each learns from growing amounts of motion: the rounds of
the loop, the beginning of one long random motion, and one motion of `asbuilt excite` of the same
length. The error of each model is measured on three random motions that none has seen, of the
torque or, from commands, of simulated motion.

    python benchmarks/loop.py --robots 15 --out out/loop.jsonl
    python benchmarks/loop.py --summary out/loop.jsonl

Reported are the seconds of motion until the error stays within 1.2 of the least that 120 s of the
random or the designed motion reach, and how often USE is right: an error of at most 1.5 times the
promise. Rows are added to the file, and robots that it has are not measured again.
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

Purpose = Literal["torque", "simulator", "payload"]
MAKES = ("ur10e", "kuka-iiwa7-r800", "franka-panda", "puma-560", "scara")
LOGGED = ("sensor", "motor", "command")
EFFECTS = ("tilt", "tool", "stiction", "backlash")
LENGTHS = (10.0, 20.0, 30.0, 40.0, 60.0, 120.0)
"""Seconds of motion from which models are made."""
ROUNDS = 6
"""Rounds of the loop, 10 s each, unless stated."""
TESTS = 3
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


class EndlessLoop(Loop):
    """A loop that goes on whatever it finds."""

    def choose_ending(self) -> Any:
        return "rounds" if len(self.rounds) >= self.options.rounds else None


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


def measure_robot(
    number: int,
    known: dict[str, Any] | None = None,
    *,
    rounds: int = ROUNDS,
    purpose: Purpose = "torque",
    loop_only: bool = False,
) -> dict[str, Any]:
    """Return the errors of one robot for each way of moving it.

    With a `known` row only the loop is measured again, with `loop_only` nothing else.
    """
    model, robot, effects, logged = make_robot(number)
    tests = [
        robot.record(random_motion(model, 9000 + 10 * number + k, 20.0), k).recording
        for k in range(TESTS)
    ]
    row: dict[str, Any] = {"robot": number, "make": model.name, "effects": effects,
                           "logged": logged, "loop": [], "random": [], "excite": []}  # fmt: skip
    began = time.process_time()
    options = RunOptions(rounds=rounds, until=WANTED, seed=number, purpose=purpose)
    with tempfile.TemporaryDirectory() as folder:
        loop = EndlessLoop(
            model=model,
            driver=Moved(robot, 1000 * number),
            folder=Path(folder),
            options=options,
        )
        seconds = 0.0
        for made in loop:
            seconds += made.seconds
            row["loop"].append({
                "seconds": seconds, "error": measure_error(made.study, tests, purpose),
                "promised": made.goal_error, "verdict": made.verdict,
                "passes": made.passes(WANTED / 100), "round": [made.promised, made.found],
            })  # fmt: skip
    row["cpu_of_loop"] = time.process_time() - began
    if known is not None:
        return {**known, **{key: row[key] for key in ("loop", "cpu_of_loop")}}
    if loop_only:
        return row
    whole = robot.record(random_motion(model, number, LENGTHS[-1]), number + 1).recording
    for length in LENGTHS:
        part = whole.between(0.0, length) if length < LENGTHS[-1] else whole
        row["random"].append([length, attempt(model, part, tests)])
    for length in LENGTHS:
        options_of_length = DesignOptions(
            duration=length, starts=6, time_limit=20.0, seed=number,
            periods=None if length <= 40.0 else round(length / 20.0),
        )  # fmt: skip
        motion = asbuilt.design_motion(model, options_of_length, with_bound=False, cores=1).motion
        recording = robot.record(motion, number + 2).recording
        row["excite"].append([length, attempt(model, recording, tests)])
    row["cpu"] = time.process_time() - began
    return row


def attempt(model: RobotModel, recording: Recording, tests: list[Recording]) -> float | None:
    try:
        return measure_error(learn(model, recording), tests)
    except AsbuiltError:
        return None


def time_until(errors: list[tuple[float, float | None]], level: float) -> float:
    """Return the seconds from which on the error stays within a level; infinite if never."""
    reached = np.inf
    for seconds, error in reversed(errors):
        if error is None or not error <= level:
            break
        reached = seconds
    return float(reached)


def summarise(rows: list[dict[str, Any]]) -> Iterator[str]:
    yield (
        f"{'robot':<18}{'logged':<9}{'effects':<19}{'level %':>8}{'loop s':>8}{'random':>8}"
        f"{'excite':>8}"
    )
    times = []
    for row in rows:
        name = f"{row['make']:<18}{row['logged']:<9}{'+'.join(row['effects']) or '-':<19}"
        if not row["excite"]:
            yield name
            continue
        ends = [row[way][-1][1] for way in ("random", "excite")]
        level = WITHIN * min(each for each in ends if each is not None)
        loop = [(each["seconds"], each["error"]) for each in row["loop"]]
        found = [time_until(each, level) for each in (loop, row["random"], row["excite"])]
        times.append(found)
        yield f"{name}{100 * level:>8.2f}" + "".join(f"{each:>8.0f}" for each in found)
    if times:
        medians = np.median(times, axis=0)
        yield f"median seconds: loop {medians[0]:g}, random {medians[1]:g}, excite {medians[2]:g}"
        yield from compare_at_equal_seconds(rows)
    proven = [
        (now["error"] / now["promised"], now)
        for row in rows
        for before, now in zip(row["loop"][:-1], row["loop"][1:], strict=True)
        if before["passes"] and now["passes"] and before["verdict"] == now["verdict"] == "yes"
    ]
    right = sum(ratio <= TRUSTED for ratio, _ in proven)
    worst = max((ratio for ratio, _ in proven), default=np.nan)
    yield f"proven (USE twice in a row): right {right} of {len(proven)}, worst {worst:.2f}"
    ratios = [ratio for ratio, _ in proven] or [np.nan]
    low, middle, high = np.quantile(ratios, (0.05, 0.5, 0.95))
    yield f"error over promise when proven: median {middle:.2f}, 90 % in {low:.2f} to {high:.2f}"
    every = [each["error"] / each["promised"] for row in rows for each in row["loop"][1:]]
    yield (
        f"error within {TRUSTED:g} of the promise after any round but the first:"
        f" {np.mean(np.array(every) <= TRUSTED):.0%} of {len(every)}"
    )
    tested = [
        each["round"][1] / each["round"][0]
        for row in rows
        for each in row["loop"]
        if each["round"][0]
    ]
    yield f"found within 1.5 of the promised error: {np.mean(np.array(tested) <= 1.5):.0%}"
    yield f"CPU seconds of a loop: median {np.median([row['cpu_of_loop'] for row in rows]):.0f}"


def compare_at_equal_seconds(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the error of the loop over that of one designed motion of the same length."""
    for length in LENGTHS:
        ratios = [
            here["error"] / there[1]
            for row in rows
            for here in row["loop"]
            for there in row["excite"]
            if here["seconds"] == there[0] == length and there[1] is not None
        ]
        if ratios:
            low, middle, high = np.quantile(ratios, (0.0, 0.5, 1.0))
            yield (
                f"{length:g} s: error of the loop over that of one designed motion: median"
                f" {middle:.2f}, {low:.2f} to {high:.2f}"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--robots", type=int, default=15)
    parser.add_argument("--out", type=Path, default=Path("out/loop.jsonl"))
    parser.add_argument("--summary", type=Path)
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--for", dest="purpose", choices=get_args(Purpose), default="torque")
    parser.add_argument("--loop-only", action="store_true", help="without the other motions")
    parser.add_argument("--first", type=int, default=0, help="number of the first robot")
    parser.add_argument("--again", type=Path, help="rows of which only the loop is measured again")
    given = parser.parse_args()
    path = given.summary or given.out
    former = (
        [json.loads(line) for line in given.again.read_text().splitlines()] if given.again else []
    )
    rows = {row["robot"]: row for row in former}
    known = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    if given.summary is None:
        path.parent.mkdir(parents=True, exist_ok=True)
        for number in range(given.first, given.first + given.robots):
            if number in {row["robot"] for row in known}:
                continue
            known.append(
                measure_robot(
                    number,
                    rows.get(number),
                    rounds=given.rounds,
                    purpose=given.purpose,
                    loop_only=given.loop_only,
                )
            )
            with path.open("a") as file:
                file.write(json.dumps(known[-1]) + "\n")
    print("\n".join(summarise(known)))


if __name__ == "__main__":
    main()
