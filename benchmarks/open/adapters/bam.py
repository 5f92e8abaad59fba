"""BAM: friction models of one servo on a pendulum of known mass, fitted by simulated logs.

As its `bam.fit`: CMA-ES on the mean absolute position error of its own simulator, all logs in one
batch; its control law is simulated, too. States are set to measured ones at the horizon of the
task (its `reset_period`). Its own default is 100 000 trials, one at a time.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from adapter import Facts, Fit
from bam.actuator import VoltageControlledActuator
from bam.model import models
from bam.parameter import Parameter
from bam.simulate import Simulator
from bam.testbench import Pendulum
from cmaes import CMA
from plain import plain_motion, uniform

PACKAGE = "better-actuator-models"
REQUIRES = ["better-actuator-models==1.0.2", "cmaes", "scipy"]
PYTHON = "3.12"
TITLE = "BAM"
ADDRESS = "https://github.com/Rhoban/bam"
NO_ARM = "it fits one servo on a pendulum bench of known mass; a log of an arm is no input of it"
LACKS = {"payload": NO_ARM, "fit_legs": NO_ARM}
STEP = 0.005
"""Step [s] of its simulation: that of its own logs."""
TRIALS, MODEL = 600, "m4"
"""Simulations of all logs, and its model: Stribeck and load-dependent friction."""

KEYS = {"mass": "load", "arm_mass": "arm", "length": "length", "kp": "gain", "vin": "vin"}
"""What its logs say of the bench, by the names that the task has for it."""


class Servo(VoltageControlledActuator):
    """A DC motor behind a position gain; bounds are those of its servos of this size."""

    def initialize(self) -> None:
        """Add the parameters of the motor."""
        self.model.kt = Parameter(1.6, 1.0, 3.0)
        self.model.R = Parameter(2.0, 1.0, 5.0)
        self.model.armature = Parameter(0.005, 0.001, 0.05)

    def get_extra_inertia(self) -> float:
        """Return the inertia of the rotor."""
        return float(self.model.armature.value)


def fit(facts: Facts) -> Fit:
    """Say why not."""
    raise NotImplementedError(NO_ARM)


def follow(facts: Facts) -> list[Any]:
    """Identify the servo, and simulate the windows of the tests."""
    pendulum = facts.settings.get("pendulum")
    if pendulum is None:
        raise NotImplementedError(NO_ARM)
    model = models[MODEL]()
    model.set_actuator(Servo(Pendulum, pendulum["vin"], pendulum["gain"], 1.0, pendulum["max_pwm"]))
    batch, parameters = batched(facts, pendulum), model.get_parameters()
    simulator, every = Simulator(model), round(1.0 / (facts.rate * STEP))

    def error(values: Any) -> float:
        for name, value in values.items():
            parameters[name].value = value
        path, _, _ = simulator.rollout_log(batch, facts.horizon, simulate_control=True)
        measured = np.array([entry["position"] for entry in batch["entries"]])
        return float(np.mean(np.abs(np.array(path) - measured)))

    error(optimum(parameters, error))
    found = []
    for log in facts.logs(facts.test):
        simulator.reset(log["q"][:, 0], log["qd"][:, 0])
        model.actuator.load_log({key: each[0] for key, each in batch.items() if key in KEYS})
        path = []
        for k in range(every * (round(facts.horizon * facts.rate) - 1) + 1):
            path += [] if k % every else [np.array(simulator.q)]
            at = log["start"] + k // every / facts.rate
            goal = uniform(log["t"], log["u"], at)[:, 0]
            volts = model.actuator.compute_control(goal, simulator.q, simulator.dq, STEP)
            simulator.step(volts, True, STEP)
        found.append(np.array(path).T[:, :, None])
    return found


def batched(facts: Facts, pendulum: dict[str, float]) -> dict[str, Any]:
    """Return all logs in its format, with the command held between samples."""
    logs = facts.logs()
    batch: dict[str, Any] = {key: np.full(len(logs), pendulum[own]) for key, own in KEYS.items()}
    states = [plain_motion(log["t"], log["q"], None, facts.rate, facts.cutoff) for log in logs]
    grid = np.arange(0.0, min(each.t[-1] for each in states), STEP)
    held = np.floor(grid * facts.rate + 1e-6) / facts.rate
    columns = [
        [uniform(log["t"], log[key], times)[:, 0] for log in logs]
        for key, times in (("q", grid), ("u", held))
    ]
    speed = [uniform(each.t, each.qd, grid)[:, 0] for each in states]
    batch["dt"] = STEP
    batch["entries"] = [
        {"position": q, "speed": qd, "goal_position": u, "torque_enable": True}
        for q, qd, u in zip(
            np.transpose(columns[0]), np.transpose(speed), np.transpose(columns[1]), strict=True
        )
    ]
    return batch


def optimum(parameters: dict[str, Any], error: Any) -> dict[str, float]:
    """Return the best of so many trials by CMA-ES within the bounds of the parameters."""
    names = [name for name, each in parameters.items() if each.optimize]
    low, high = (np.array([getattr(parameters[n], key) for n in names]) for key in ("min", "max"))
    start = (np.array([parameters[n].value for n in names]) - low) / (high - low)
    unit = np.tile([0.0, 1.0], (len(names), 1))
    search, best = CMA(mean=start, sigma=0.2, bounds=unit, seed=1), (np.inf, start)
    for _ in range(TRIALS // search.population_size):
        told = []
        for _ in range(search.population_size):
            x = search.ask()
            told.append((x, error(dict(zip(names, low + x * (high - low), strict=True)))))
        search.tell(told)
        least = min(told, key=lambda each: each[1])
        best = min(best, (least[1], least[0]), key=lambda each: each[0])
    return dict(zip(names, low + best[1] * (high - low), strict=True))
