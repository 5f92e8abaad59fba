"""Virtual robots of three makes whose CAD is far off: error on another motion, by estimator.

Masses of CAD are wrong by a factor between 1 / `FACTOR` and `FACTOR`, centres by a tenth of the
reach of the link; the torque error on another motion, relative to the torque, in percent.
"""

from __future__ import annotations

import argparse

import numpy as np

from asbuilt.description.inertia import LinkInertia
from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.torque import choose_usual_drive
from asbuilt.excitation.motions.fourier import random_fourier
from asbuilt.experiment.signal.preparation import prepare_samples, resolve_chain
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.experiment.virtual.sensors import SensorNoise
from asbuilt.experiment.virtual.simulation import simulate_recording
from asbuilt.identification.identify import identify_samples
from asbuilt.validation.prediction import validate_samples

ROBOTS = ("kuka-iiwa7-r800", "ur10e", "franka-panda")
METHODS = ("auto", "wls", "consistent")
FACTOR = 3.0
RATE = 200.0
NOISE = SensorNoise(position_noise=2e-5, torque_noise=0.5)


def wrong_cad(model: RobotModel, rng: np.random.Generator, factor: float) -> RobotModel:
    """Return the robot with other masses and centres."""
    parameters = []
    for link in model.links:
        body = link.inertia
        scale = float(np.exp(rng.uniform(-1.0, 1.0) * np.log(factor)))
        reach = max(0.05, float(np.linalg.norm(body.com)))
        com = body.com + 0.1 * reach * rng.standard_normal(3)
        parameters.append(
            LinkInertia.from_com(scale * body.mass, com, scale * body.inertia_about_com).parameters
        )
    return model.with_parameters(np.concatenate(parameters))


def errors(name: str, seed: int, duration: float, factor: float) -> dict[str, float]:
    """Return the relative torque error [%] on another motion by method, and that of CAD."""
    rng = np.random.default_rng(seed)
    truth = load_robot(name)
    cad = wrong_cad(truth, rng, factor)
    logs = [
        simulate_recording(
            truth,
            random_fourier(truth, rng=seed + k, duration=duration),
            rate=RATE,
            noise=NOISE,
            rng=seed,
        )
        for k in (0, 1000)
    ]
    chain = resolve_chain(SignalChain(), logs[0])
    used, held = (prepare_samples(log, chain) for log in logs)
    drive = choose_usual_drive(cad, logs[0].torque_source)
    found: dict[str, float] = {}
    for method in METHODS:
        result = identify_samples(cad, [used], drive=drive, method=method)
        each = validate_samples(result, held)
        found[method] = 100 * each.metrics_as_built.relative_error
        found["CAD"] = 100 * each.metrics_cad.relative_error
    return found


def measure(seeds: int = 3, duration: float = 15.0) -> dict[str, float]:
    """Return the mean error [%] of each method by robot, and the worst of auto over wls."""
    means: dict[str, float] = {}
    for name in ROBOTS:
        rows = [errors(name, seed, duration, FACTOR) for seed in range(seeds)]
        for row in rows:
            print(name, " ".join(f"{key} {value:.3f}" for key, value in row.items()), flush=True)
        for key in rows[0]:
            means[f"{name}_{key}_percent"] = float(np.mean([row[key] for row in rows]))
        means[f"{name}_worst_auto_over_wls"] = max(row["auto"] / row["wls"] for row in rows)
    return means


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--duration", type=float, default=15.0)
    print(measure(**vars(parser.parse_args())))
