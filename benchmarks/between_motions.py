"""Whether standard errors explain how estimates from different motions of one robot differ.

z is the difference of two estimates of a parameter over its standard error; its RMS is 1 and 95 %
are within 1.96 where errors hold. `scatter` has the scatter of time blocks alone, `effects` the
bias by effects that the model lacks too, as `identify` reports it.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from asbuilt.validation.generalisation.effect_bias import with_effects
from asbuilt.validation.generalisation.missing_effects import confirmed_effects

from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.torque import usual_drive
from asbuilt.experiment.logs.readers import read_recordings
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.preparation import prepare_samples, resolve_chain
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.identification.identify import fit_samples
from asbuilt.identification.information.cause_data import gather_cause_data
from asbuilt.identification.result.result import IdentificationResult
from drive_terms import SHARED
from other_motions import ROBOTS

NORMAL_95 = 1.959964


class Halves(NamedTuple):
    """One recording whose halves are compared."""

    description: str
    recording: str


HALVES = {
    "Rokae": Halves("rokae_xmate.toml", "rokae_two_channels/rokae_a.csv"),
    "TX40": Halves("staubli_tx40.toml", "tx40/tx40.csv"),
}
MOTIONS = {"LWR4+": ((0, 1), (2,)), "LBR Med 7": ((0,), (1,))}
"""Recordings of a robot of `other_motions` on either side."""


def pairs(
    data: Path,
) -> Iterator[tuple[str, RobotModel, Sequence[Recording], Sequence[Recording]]]:
    """Yield what is compared: a name, the robot, and the recordings of either side."""
    for name, (first, second) in MOTIONS.items():
        robot = ROBOTS[name]
        model = load_robot(str(data / "models" / robot.description))
        logs = [
            _read(model, data / "data" / robot.folder / each, **robot.options)
            for each in robot.recordings
        ]
        yield name, model, [logs[k] for k in first], [logs[k] for k in second]
    for name, (description, path) in HALVES.items():
        model = load_robot(str(data / "models" / description))
        log = _read(model, data / "data" / path)
        half = log.n_samples // 2
        yield (
            f"{name} halves",
            model,
            [log.taken(slice(0, half))],
            [log.taken(slice(half, log.n_samples))],
        )


def _read(model: RobotModel, path: Path, **options: Any) -> Recording:
    return read_recordings([path], model=model, **options)[0]


def results(
    model: RobotModel, recordings: Sequence[Recording]
) -> tuple[IdentificationResult, IdentificationResult]:
    """Return the result by weighted least squares without and with the bias by missing effects."""
    samples = [prepare_samples(log, resolve_chain(SignalChain(), log)) for log in recordings]
    fit = fit_samples(model, samples, drive=usual_drive(model, recordings[0].torque_source))
    metrics = fit.metrics(samples)
    cause_data = gather_cause_data(model, fit.base, samples, ())
    plain = fit.concluded(*metrics, cause_data=cause_data)
    effects = confirmed_effects(plain, samples)
    return plain, with_effects(fit, samples, effects).concluded(*metrics, cause_data=cause_data)


def measure(data: Path = SHARED) -> dict[str, float | str]:
    """Return the RMS of z and the share within 1.96 of every pair."""
    if not (data / "data").is_dir():
        return {"skipped": "no recordings beside the repository"}
    numbers: dict[str, float | str] = {}
    for name, model, first, second in pairs(data):
        before, after = results(model, first), results(model, second)
        for kind, one, two in zip(("scatter", "effects"), before, after, strict=True):
            both = [
                p.determined and q.determined
                for p, q in zip(one.parameters, two.parameters, strict=True)
            ]
            z = (one.estimates - two.estimates)[both] / np.hypot(one.std_errors, two.std_errors)[
                both
            ]
            numbers[f"{name}_{kind}_z_rms"] = float(np.sqrt(np.mean(z**2)))
            numbers[f"{name}_{kind}_within"] = float(np.mean(np.abs(z) < NORMAL_95))
    return numbers


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=SHARED, help="folder of data/ and models/")
    for key, value in measure(parser.parse_args().data).items():
        print(f"{key:<40} {value:.3}")
