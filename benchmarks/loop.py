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
            duration=length, starts=6, time_limit=20.0, seed=number,
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
    for length in LENGTHS["excite"]:
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
    parser.add_argument("--only", choices=("fixed", "loop"), help="measure one half")
    given = parser.parse_args()
    path = given.summary or given.out
    options = RunOptions(
        rounds=given.rounds, seconds=given.seconds, speed=given.speed, purpose=given.purpose,
        until=WANTED,
    )  # fmt: skip
    parts = {"excite": measure_fixed, "loop": lambda number: measure_loop(number, options)}
    skipped = {"fixed": "loop", "loop": "excite"}.get(given.only)
    if given.summary is None:
        path.parent.mkdir(parents=True, exist_ok=True)
        known = read_rows(path)
        for number in range(given.first, given.first + given.robots):
            for key, measure in parts.items():
                if key == skipped or key in known.get(number, {}):
                    continue
                model, _, effects, logged = make_robot(number)
                row = {"robot": number, "make": model.name, "effects": effects, "logged": logged}
                with path.open("a") as file:
                    file.write(json.dumps(row | measure(number)) + "\n")
    print("\n".join(summarise(list(read_rows(path).values()))))


if __name__ == "__main__":
    main()
