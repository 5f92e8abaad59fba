"""Commands of a page that answer at once, each by what it was asked and what the files hold."""

from __future__ import annotations

import json
import random
import threading
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

JOINTS = ("shoulder", "elbow", "wrist")
T = [0.1 * k for k in range(20)]


class FakedWorker:
    """Stands for the process of the commands; every answer is a function of the question.

    A command takes up to `longest` seconds, so that answers come in any order.
    """

    longest = 0.05

    def __init__(self) -> None:
        self._random = random.Random(0)
        self._cancelled = threading.Event()

    def run(
        self, arguments: tuple[str, ...], progress: Callable[[str, float], None]
    ) -> dict[str, Any]:
        cancelled = self._cancelled
        mark = _mark(arguments)
        progress("read", 0.3)
        if cancelled.wait(self._random.uniform(0.0, self.longest)):
            return _error("the command ended with status -9")
        return _ANSWERS[arguments[0]](arguments, mark)

    def cancel(self) -> None:
        self._cancelled.set()
        self._cancelled = threading.Event()

    def close(self) -> None:
        self.cancel()


def _mark(arguments: tuple[str, ...]) -> int:
    """A number of the arguments and of the files that they name."""
    digest = sha256("\0".join(arguments).encode())
    for word in arguments:
        if Path(word).is_file():
            digest.update(Path(word).read_bytes())
    return int.from_bytes(digest.digest()[:4])


def _error(message: str) -> dict[str, Any]:
    return {"error": {"kind": "RecordingError", "message": message, "hint": "give --rate"}}


def _show(arguments: tuple[str, ...], mark: int) -> dict[str, Any]:
    if mark % 7 == 0:
        return _error(f"{arguments[1]} is no robot")
    joints = [{"name": name} for name in JOINTS]
    links = [{"inertia": [0.0] * 9 + [1.0 + mark % 100]}]
    return {"robot": f"robot {mark}", "model": {"joints": joints, "links": links}}


def _columns(arguments: tuple[str, ...], mark: int) -> dict[str, Any]:
    if mark % 7 == 1:
        return _error(f"{arguments[2]} is no recording")
    ok = mark % 3 > 0
    names = ["t", *(f"{q}_{joint}" for q in ("position", "torque") for joint in JOINTS)]
    return {
        "robot": arguments[1],
        "source": arguments[2],
        "ok": ok,
        "problem": None if ok else f"the columns of {mark} do not fit (--flip-torque)",
        "joints": [*JOINTS],
        "torque_source": None,
        "named": True,
        "columns": [
            {
                "name": name,
                "quantity": name.partition("_")[0] if "_" in name else "time",
                "joint": (name.partition("_")[2] if ok else "of the log") if "_" in name else None,
                "factor": 1.0,
                "smallest": 0.0,
                "largest": float(mark % 10),
                "curve": {"row": [0.0, 1.0], "above_smallest": [0.0, 1.0]},
            }
            for name in names
        ],
    }


def _check(arguments: tuple[str, ...], mark: int) -> dict[str, Any]:
    if mark % 11 == 0:
        return _error(f"no sample of {mark} can be read")
    cures = ({"flip_torque": True}, {"rate": "HZ"}, {"rate": 99.5}, {"torque_source": "current"})
    severity = ("error", "warning", "info", "info")[mark % 4]
    finding = {
        "code": "found",
        "severity": severity,
        "message": f"finding {mark}",
        "cure": {"text": "mend it", "settings": cures[mark // 4 % 4]},
    }
    logs = [word for word in arguments[2:] if word.endswith(".csv")]
    about = {"n_samples": mark % 1000, "duration": 10.0, "rate": 100.0, "findings": [finding]}
    return {"recordings": [{"source": log, **about} for log in logs]}


def _identify(arguments: tuple[str, ...], mark: int) -> dict[str, Any]:
    if mark % 5 == 0:
        return _error(f"the motion of {mark} is not exciting")
    folder = Path(arguments[-1])
    folder.mkdir(parents=True, exist_ok=True)
    curve = {"unit": "N m", "t": T, **dict.fromkeys(("measured", "cad", "built"), T)}
    curves = {"joints": [*JOINTS], "recordings": [{"joints": [curve | {"rms": mark}] * 3}]}
    data = f'<script type="application/json" id="data">{json.dumps(curves)}</script>'
    files = {"result": f"{{{mark}}}", "report": data}
    paths = {kind: folder / f"{kind}.{'json' if kind == 'result' else 'html'}" for kind in files}
    for kind, content in files.items():
        paths[kind].write_text(content)
    fit = {"source": "log.csv", "rms": [0.1] * 3, "relative_error": mark % 100 / 1e3, "units": None}
    use = ("yes", "no", "with care")[mark % 3]
    wanted = "--effects" not in arguments or "tilt" in arguments[arguments.index("--effects") + 1]
    tilt = {
        "effect": "tilt",
        "joint": None,
        "in_model": True,
        "text": f"tilt {mark}",
        "error_before": 0.1,
        "error_after": 0.05,
    }
    return {
        "joints": [*JOINTS],
        "train": fit,
        "validation": [],
        "cad": fit,
        "mass": None,
        "physically_consistent": True,
        "findings": [],
        "effects": [tilt] if wanted else [],
        "verdict": {"use": use, "text": f"verdict {mark}", "measure": "torque", "error": {}},
        "payload": {"headline": f"payload {mark}"} if "--payload" in arguments else None,
        "files": {kind: str(path) for kind, path in paths.items()},
    }


def _view(arguments: tuple[str, ...], mark: int) -> dict[str, Any]:
    Path(arguments[-1]).write_text(f"view {mark}")
    return {"files": {"page": arguments[-1]}}


def _export(arguments: tuple[str, ...], mark: int) -> dict[str, Any]:
    if mark % 5 == 1:
        return _error(f"format {mark} cannot hold it")
    path = arguments[-1].rpartition("=")[2]
    Path(path).write_text(f"model {mark}")
    return {"files": {arguments[-2].strip("-"): path}, "notes": {"urdf": [f"note {mark}"]}}


def _simulate(arguments: tuple[str, ...], mark: int) -> dict[str, Any]:
    path = Path(arguments[-1])
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("t\n")
    return {"files": {"recording": str(path)}}


_ANSWERS = {
    "show": _show,
    "columns": _columns,
    "check": _check,
    "identify": _identify,
    "view": _view,
    "export": _export,
    "simulate": _simulate,
}
