"""Relative torque error on another motion: without effects, with all found, with the best one.

    python benchmarks/other_effects.py [ROBOT ...]

Effects are found on the recordings trained on alone. `best single` is the least error with one of
them in the model. Masses are those of the exported robot in masses of CAD, link by link.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.dynamics.drives.torque import choose_usual_drive
from asbuilt.errors import AsbuiltError
from asbuilt.experiment.signal.preparation import prepare_samples, resolve_chain
from asbuilt.experiment.signal.samples import Samples
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.identification.effects.search import find_effects
from asbuilt.identification.identify import identify_samples
from asbuilt.validation.prediction import validate_samples
from asbuilt.workflow.delays import settle_delays
from asbuilt.workflow.prepare import digest_recording
from asbuilt.writers.tables.tabular import exported_masses
from drive_terms import SHARED
from recorded_robots import recorded_robots, sets_of


class Case(NamedTuple):
    """Samples of one robot to train on and to predict."""

    robot: str
    train: str
    model: RobotModel
    used: list[Samples]
    others: list[Samples]


def cases(names: Sequence[str], data: Path = SHARED) -> Iterator[Case]:
    """Yield every set of recordings with the others of the same robot."""
    for name, robot, model, logs in recorded_robots(names, data):
        for train in sets_of(robot):
            heads = [logs[k] for k in train]
            chain = resolve_chain(SignalChain(), *heads)
            late = settle_delays(
                model, heads, [digest_recording(head) for head in heads], chain, None
            )
            samples = [
                prepare_samples(each, late.chain_of(digest_recording(each))) for each in logs
            ]
            label = "+".join(Path(logs[k].source).stem for k in train)
            others = [samples[k] for k in range(len(logs)) if k not in train]
            yield Case(name, label, model, [samples[k] for k in train], others)


def errors(case: Case, model: RobotModel, drive: DriveSet) -> tuple[list[float], str]:
    """Return the relative errors [%] on the other motions, and the masses."""
    base = find_base_parameters(model, drive)
    result = identify_samples(model, case.used, base=base, method="auto")
    found = [
        100 * validate_samples(result, each).metrics_as_built.relative_error for each in case.others
    ]
    masses = exported_masses(result)
    _, cad, built = ((), (), ()) if masses is None else zip(*masses.links, strict=True)
    if masses is None or not all(cad):
        return found, ""
    ratios = np.array(built) / np.array(cad, dtype=np.float64)
    return found, " ".join(f"{each:.2f}" for each in ratios)


def report(names: Sequence[str]) -> None:
    """Print the table."""
    for case in cases(names):
        drive = choose_usual_drive(case.model, case.used[0].torque_source)
        began = time.process_time()
        effects = find_effects(case.model, drive, case.used)
        seconds = time.process_time() - began
        print(f"{case.robot} from {case.train} (effects found in {seconds:.1f} s CPU)")
        for each in effects.found:
            print(f"    {'in ' if each.in_model else 'out'} {each.text}")
        rows = {"none": (case.model, drive), "auto": (effects.model, effects.drive)}
        for each in effects.found:
            if each.in_model:
                keys = {each.effect}
                single = find_effects(case.model, drive, case.used, keys=keys)
                rows[f"only {each.effect}"] = single.model, single.drive
        for label, (model, chosen) in rows.items():
            try:
                found, masses = errors(case, model, chosen)
            except AsbuiltError as problem:
                print(f"    {label:<24}{problem}")
                continue
            listed = " ".join(f"{each:7.2f}" for each in found)
            print(f"    {label:<24}{listed}   masses {masses}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robots", nargs="*", help="robots (default: all)")
    report(parser.parse_args().robots)
