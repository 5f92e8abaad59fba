"""Settings of a virtual robot as text: `backlash=2e-4`, `controller.rate=500`."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

from asbuilt.errors import UsageError
from asbuilt.experiment.virtual.drive_train import CONTROLLERS, DriveTrain
from asbuilt.experiment.virtual.sensors import DataLogger, JointFields, SensorNoise
from asbuilt.experiment.virtual.virtual_robot import VirtualRobot
from asbuilt.findings import Cure

PARTS: Mapping[str, type] = {
    "train": DriveTrain,
    **CONTROLLERS,
    "sensors": SensorNoise,
    "logger": DataLogger,
}
OWN = ("torque", "behind")
"""Settings of the robot itself."""
SWITCHES = {"yes": True, "true": True, "on": True, "no": False, "false": False, "off": False}


def list_settings() -> dict[str, str]:
    """Return the part of the robot that each setting belongs to, "" for the robot itself.

    Names that two parts share carry the part before a dot.

    Examples
    --------
    >>> list_settings()["backlash"], list_settings()["controller.rate"]
    ('train', 'controller')
    """
    count = Counter(entry.name for part in PARTS.values() for entry in fields(part))
    shared = {name for name, number in count.items() if number > 1}
    named = {
        f"{part}.{entry.name}" if entry.name in shared else entry.name: part
        for part, kind in PARTS.items()
        for entry in fields(kind)
    }
    return {**dict.fromkeys(OWN, ""), **named}


def with_settings(robot: VirtualRobot, settings: Sequence[str]) -> VirtualRobot:
    """Return the robot with each `NAME=VALUE` of `settings` changed.

    A value is a number, one per joint with commas, or a word.

    Raises
    ------
    UsageError
        If there is no such setting, its value is invalid, or the robot has no such part.

    Examples
    --------
    >>> from asbuilt.description.load import bundled_robot
    >>> robot = VirtualRobot.preset("ideal", bundled_robot("two-link"))
    >>> with_settings(robot, ["coulomb=1,0.5", "feedforward=none"]).train.coulomb
    (1.0, 0.5)
    """
    known = list_settings()
    changes: defaultdict[str, dict[str, Any]] = defaultdict(dict)
    for setting in settings:
        name, equals, text = (piece.strip() for piece in setting.partition("="))
        if name not in known or not equals or not text:
            raise UsageError(
                f"a setting of the virtual robot is NAME=VALUE with a NAME of {', '.join(known)};"
                f" got {setting!r}",
                value=setting,
                available=list(known),
            )
        part = known[name]
        field = name.rpartition(".")[2]
        if robot.controller is None and part in ("", "train", *CONTROLLERS):
            raise UsageError(
                f"the setting {name!r} belongs to robots in MuJoCo; this one follows exactly",
                cure=Cure("choose another engine", {"engine": "mujoco"}),
                value=setting,
            )
        if part in CONTROLLERS and not isinstance(robot.controller, CONTROLLERS[part]):
            raise UsageError(
                f"the setting {name!r} belongs to a {part}, which the preset {robot.name!r} does"
                " not have",
                cure=Cure(CONTROLLERS[part].preset_text),
                value=setting,
            )
        kind = PARTS.get(part, object)
        per_joint = kind.list_per_joint() if issubclass(kind, JointFields) else []
        place = "controller" if part in CONTROLLERS else part
        changes[place][field] = _parse_value(name, text, of_joints=field in per_joint)
    own = changes.pop("", {})
    parts = {place: replace(getattr(robot, place), **change) for place, change in changes.items()}
    return replace(robot, **own, **parts) if settings else robot


def _parse_value(
    name: str, text: str, *, of_joints: bool
) -> float | tuple[float, ...] | str | bool:
    if name in ("torque", "feedforward"):
        return text
    if name == "accelerations":
        if text.lower() not in SWITCHES:
            raise UsageError(f"{name} is yes or no, got {text!r}")
        return SWITCHES[text.lower()]
    try:
        numbers = tuple(float(piece) for piece in text.split(","))
    except ValueError:
        numbers = ()
    if not numbers or (len(numbers) > 1 and not of_joints):
        raise UsageError(
            f"{name} takes one"
            f" number{', or one per joint separated by commas' if of_joints else ''}; got {text!r}"
        )
    return numbers if len(numbers) > 1 else numbers[0]
