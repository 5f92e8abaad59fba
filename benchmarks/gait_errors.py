"""How much of what fits to the recorded Solo12 leave comes again in every cycle of its gait.

    python benchmarks/gait_errors.py --data ../shared

A residual is foretold by the mean of other cycles at the same phase; the share of its power that
this explains is what repeats. What repeats in training is in the test, too: a fit that takes it for
dynamics scores better for it. `benchmarks/open/twin.py` gives a robot of known bodies such errors.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

OPEN = Path(__file__).resolve().parent / "open"
sys.path[:0] = [str(OPEN)]
sys.path.append(str(OPEN / "adapters"))  # last: adapters have names of packages

from adapter import Facts  # noqa: E402
from flyer import Flyer, described  # noqa: E402
from legged import legged_problem  # noqa: E402
from lmi import consistent_fit  # noqa: E402
from scipy.optimize import lsq_linear  # noqa: E402
from task import tasks  # noqa: E402
from twin import CYCLE  # noqa: E402

Array = NDArray[np.float64]
PHASES = 25
"""Parts of a cycle: each has some fifty samples of the training."""
NOT_NEGATIVE = ("Ia", "Fv", "Fc")


def residuals(folder: Path, data: Path) -> dict[str, Array]:
    """Return what two fits leave of the projected torque (N, 6 + n): without and with physics."""
    legged_problem(tasks()["solo12"], data, folder)
    facts = Facts(folder=folder, **json.loads((folder / "facts.json").read_text()))
    flyer = Flyer(facts)
    W, tau = flyer.stacked(facts.plain())
    plain = np.linalg.lstsq(W, tau, rcond=1e-9)[0]
    links = consistent_fit(flyer, described(facts)).links.ravel()
    left, drives = tau - W[:, : links.size] @ links, flyer.names[links.size :]
    least = [0.0 if name[:2] in NOT_NEGATIVE else -np.inf for name in drives]
    own = lsq_linear(W[:, links.size :], left, bounds=(least, np.inf)).x
    n = tau.size // (len(facts.joints) + 6)
    found = {
        "plain least squares": tau - W @ plain,
        "consistent fit": tau - W @ np.concatenate([links, own]),
    }
    found["what only plain least squares takes"] = (
        found["consistent fit"] - found["plain least squares"]
    )
    return {name: each.reshape(-1, n).T for name, each in found.items()}


def repeated(residual: Array, period: float) -> float:
    """Return the share of the power that the mean of every other cycle foretells."""
    at = np.arange(len(residual)) / period
    phase, cycle = (PHASES * (at % 1.0)).astype(int), at.astype(int) % 2
    foretold = np.zeros_like(residual)
    for k in range(PHASES):
        for half in (0, 1):
            others = residual[(phase == k) & (cycle != half)]
            foretold[(phase == k) & (cycle == half)] = others.mean(axis=0)
    return float(1.0 - np.sum((residual - foretold) ** 2) / np.sum(residual**2))


def main() -> None:
    """Print the shares."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--data", type=Path, required=True)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for name, each in residuals(Path(folder), arguments.data).items():
            share, later = repeated(each, 100.0 * CYCLE), round(100.0 * CYCLE)
            again = np.sum(each[later:] * each[:-later]) / np.sum(each**2)
            print(f"{name}: {share:.0%} foretold, correlation a cycle later {again:.2f}")


if __name__ == "__main__":
    main()
