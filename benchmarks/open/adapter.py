"""Runs one tool on one prepared task, in the environment of the tool: `adapter.py TOOL FOLDER`.

`adapters/TOOL.py` has `PACKAGE`, its name on the index, or `VERSION`, and `fit(facts) -> Fit`; only
the standard library, numpy, scipy and modules of this folder are its own beside the tool. The CPU
time [s] of `fit` is that of all threads and children, imports of the tool before it excluded.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import resource
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from plain import Motion, logged_motion, plain_motion

Array = Any
OTHER_TASKS = {
    "loaded": ("payload", "it has no function for payloads"),
    "contacts": ("fit_legs", "it takes no contact forces that nobody measured"),
    "horizon": ("follow", "it needs measured torques"),
}
"""Facts of tasks other than a fit of torques: what an adapter needs for them, why it cannot."""


@dataclass
class Facts:
    """What a tool gets: see `prepare`."""

    folder: Path
    joints: list[str]
    tree_joints: list[str]
    tree_links: list[str]
    gravity: list[float]
    cutoff: float
    rate: float
    torque_source: str
    training: list[str]
    test: list[str]
    settings: dict[str, Any]
    coupling: dict[str, Any] | None = None
    loops: dict[str, Any] | None = None
    armature: bool = False
    edge: float = 1.0
    description: str = ""
    contacts: list[str] = field(default_factory=list)
    horizon: float = 0.0
    loaded: list[str] = field(default_factory=list)
    task: str = ""

    @property
    def urdf(self) -> str:
        """Path of the description."""
        return str(self.folder / "robot.urdf")

    def logs(self, names: list[str] | None = None) -> list[dict[str, Array]]:
        """Return some logs, those that are trained on unless others are named."""
        return [dict(np.load(self.folder / each)) for each in names or self.training]

    def plain(self, names: list[str] | None = None) -> list[Motion]:
        """Return them after the plain low-pass."""
        if self.contacts:
            return [logged_motion(each, self.rate, self.cutoff) for each in self.logs(names)]
        return [
            plain_motion(each["t"], each["q"], each["tau"], self.rate, self.cutoff)
            for each in self.logs(names)
        ]


@dataclass
class Estimate:
    """A parameter: value, standard error, and the standard parameters that it is a sum of."""

    name: str
    value: float
    error: float
    of: dict[str, float] = field(default_factory=dict)


@dataclass
class Fit:
    """What a tool found; `predict` returns torques (N, n) at states of a `Motion`.

    `links` are (n_links, 10) inertial parameters `Ixx Ixy Ixz Iyy Iyz Izz mx my mz m` about the
    frame of each moving link, in the order of the joints of the tree; None if the tool has none.
    """

    predict: Callable[[Motion], Array]
    parameters: list[Estimate] = field(default_factory=list)
    links: Array | None = None
    note: str = ""
    details: dict[str, Any] = field(default_factory=dict)


LONGEST = 900
"""CPU seconds that a tool may take for one problem, of its own process: others may be at work."""


def _cpu() -> float:
    own, children = (
        resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime


def _load(path: Path) -> Any:
    spec = importlib.util.spec_from_file_location("tool_adapter", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["tool_adapter"] = module
    spec.loader.exec_module(module)
    return module


def main() -> None:
    """Fit, predict, write `answer.json` and `answer_*.npy` into the folder of answers."""
    tool, folder, out = Path(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3])
    sys.modules["adapter"] = sys.modules["__main__"]
    resource.setrlimit(resource.RLIMIT_CPU, (LONGEST, LONGEST))
    answer: dict[str, Any] = {}
    try:
        module = _load(tool)
        own = getattr(module, "VERSION", None)
        answer["version"] = own or importlib.metadata.version(module.PACKAGE)
        facts = Facts(folder=folder, **json.loads((folder / "facts.json").read_text()))
        for asked, (name, reason) in OTHER_TASKS.items():
            if getattr(facts, asked) and not hasattr(module, name):
                raise NotImplementedError(getattr(module, "LACKS", {}).get(name, reason))
        began = _cpu()
        if facts.loaded:
            asked = module.weights if "carrier" in facts.settings else module.payload
            answer |= {"links": None, "parameters": [vars(each) for each in asked(facts)]}
            answer["cpu_seconds"] = _cpu() - began
            return
        if facts.horizon:
            for k, path in enumerate(module.follow(facts)):
                np.save(out / f"answer_{k}.npy", np.asarray(path, dtype=float))
            answer["cpu_seconds"] = _cpu() - began
            answer |= {"links": None, "parameters": []}
            return
        fit = (module.fit_legs if facts.contacts else module.fit)(facts)
        answer["cpu_seconds"] = _cpu() - began
        for k, name in enumerate(facts.test):
            states = np.load(folder / name)
            motion = Motion(*(states[key] for key in ("t", "q", "qd", "qdd")))
            np.save(out / f"answer_{k}.npy", np.asarray(fit.predict(motion), dtype=float))
        answer["parameters"] = [vars(each) for each in fit.parameters]
        answer["links"] = None if fit.links is None else np.asarray(fit.links).tolist()
        answer |= {"note": fit.note, "details": fit.details}
    except NotImplementedError as reason:
        answer["cannot"] = str(reason)
    except Exception as problem:
        answer["failed"] = f"{type(problem).__name__}: {problem}"
        traceback.print_exc()
    finally:
        (out / "answer.json").write_text(json.dumps(answer, default=float))


if __name__ == "__main__":
    main()
