"""The commands: where each is defined, its summary, two examples, and the function it calls."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module

from asbuilt.registry import find_app_modules


@dataclass(frozen=True, slots=True)
class Entry:
    """Describe a command without importing it.

    Parameters
    ----------
    module
        Module below `asbuilt` that has the function of the same name; it imports what computes
        after it has read robots and recordings, so that bad input is refused early.
    summary
        First line of its help, at most 66 characters.
    examples
        Arguments of two calls.
    call
        Public function of `asbuilt` that does the same.
    compiles
        Whether it calls compiled dynamics.
    bare
        Options that may stand without their value.
    surplus
        What to do with one argument too many, in place of reading the help.
    """

    module: str
    summary: str
    examples: tuple[str, str]
    call: str
    compiles: bool = True
    bare: tuple[str, ...] = ()
    surplus: str = ""


Entries = Mapping[str, Mapping[str, Entry]]
"""Commands by group, or by the command whose commands they are."""

TABLE: dict[str, dict[str, Entry | str]] = {
    "Robots": {
        "robots": Entry(
            "cli.robot", "List the bundled robots.", ("", "--json"), "robot_names", compiles=False
        ),
        "show": Entry(
            "cli.robot",
            "Show geometry, mass properties, limits and consistency.",
            ("kuka-iiwa7-r800", "my_robot.urdf --full"),
            "load_robot",
            compiles=False,
        ),
        "masses": "masses",
        "schema": Entry(
            "cli.robot",
            "Print the JSON Schema of robot files or recording sheets.",
            ("robot -o robot.schema.json", "sheet"),
            "json_schema",
            compiles=False,
        ),
        "convert": Entry(
            "cli.robot",
            "Write a robot description in another format.",
            (
                "my_robot.urdf my_robot.toml --gravity 9.81,0,0",
                "my_robot.urdf arm.urdf --lock finger",
            ),
            "convert_robot",
        ),
        "view": Entry(
            "cli.robot",
            "Show the robot in 3-D in the browser, or save a picture.",
            ("ur10e", "ur10e motion.csv --save motion.html"),
            "view_robot",
        ),
        "base": Entry(
            "cli.robot",
            "Find the base parameters and what of each link is identifiable.",
            ("kuka-iiwa7-r800", "ur10e --drive viscous,coulomb --full"),
            "find_base_parameters",
        ),
        "drives": Entry(
            "cli.robot",
            "List the drive terms (friction, armature, springs).",
            ("", "--json"),
            "",
            compiles=False,
        ),
    },
    "Motions": {
        "excite": Entry(
            "cli.motion",
            "Design the most informative motion within the limits.",
            (
                "kuka-iiwa7-r800 -o motion.csv",
                "ur10e --collision skeleton:0.08 --program urscript",
            ),
            "design_motion",
        ),
        "program": "programs",
        "run": "run",
        "simulate": Entry(
            "cli.recording",
            "Record a virtual robot, or simulate its free motion.",
            (
                "ur10e motion.csv --preset lab -o recording.csv",
                "kuka-iiwa7-r800 --free drop --duration 2",
            ),
            "simulate_recording",
        ),
    },
    "Recordings": {
        "check": Entry(
            "cli.recording",
            "Check recordings before they are used.",
            ("ur10e log.csv", "ur10e log.csv --flip-torque --json"),
            "check_recording",
        ),
        "columns": "page",
        "gains": Entry(
            "cli.calibration",
            "Find torque per logged unit from a payload of known mass.",
            (
                "ur10e bare.csv --loaded loaded.csv --mass 5",
                "ur10e bare.csv --loaded loaded.csv --mass 5 --com 0,0,0.08",
            ),
            "find_gains",
        ),
        "channels": Entry(
            "cli.calibration",
            "Identify link and motor side from two torque channels.",
            (
                "kuka-iiwa7-r800 sensors.csv --motor motors.csv",
                "kuka-iiwa7-r800 sensors.csv --motor currents.csv -v",
            ),
            "identify_channels",
        ),
    },
    "Identification": {
        "identify": Entry(
            "cli.identify",
            "Identify the robot from recordings, and validate the result.",
            (
                "ur10e log.csv -o study",
                "ur10e log.csv --validate other.csv --torque-source current",
            ),
            "identify",
        ),
        "validate": Entry(
            "cli.validation",
            "Predict other recordings with the result and with CAD.",
            ("study/result.json other.csv", "ur10e other.csv --json"),
            "validate",
        ),
        "compare": Entry(
            "cli.validation",
            "Compare CAD with the robot as built, or two results.",
            ("study/result.json", "before.json --with after.json -o changes"),
            "compare",
            surplus="two results are compared by asbuilt compare RESULT --with RESULT2",
        ),
        "feasible": Entry(
            "cli.validation",
            "Bound masses, centres, inertias, armatures by what bodies allow.",
            (
                "study/result.json",
                "study/result.json mass:link_3 com:link_3 armature --prior cad",
            ),
            "feasible_intervals",
        ),
        "review": Entry(
            "cli.validation",
            "Judge the numbers that a description claims by recordings.",
            (
                "tuned.xml log.csv --torque-source command",
                "tuned.xml log.csv --torque-source command --kp 20 --kd 1.5",
            ),
            "review",
        ),
        "payload": Entry(
            "cli.calibration",
            "Find mass, centre and inertia of what the flange carries.",
            (
                "study/result.json loaded.csv",
                "study/result.json loaded.csv -o study --to ur=payload.script",
            ),
            "identify_payload",
        ),
        "watch": "watch",
        "export": Entry(
            "cli.identify",
            "Write the identified robot, or many of it, for other software.",
            (
                "study/result.json --urdf arm.urdf --to isaac-lab=actuators.py",
                "study/result.json --ensemble 100 -o ensemble --seed 1",
            ),
            "export_result",
            bare=("--urdf",),
        ),
    },
    "Fleets": {
        "fleet": "fleet",
    },
    "Complete runs": {
        "open": "page",
        "demo": "paper",
        "reproduce": "paper",
    },
}
"""The commands in the order of the help; of an app's command stands the name of the app."""


def _add_commands_of_apps() -> tuple[dict[str, dict[str, Entry]], dict[str, Mapping[str, Entry]]]:
    """Return commands by group, and the commands of commands, with those of installed apps."""
    added: dict[str, dict[str, Entry]] = {}
    below: dict[str, Mapping[str, Entry]] = {}
    for name in find_app_modules("commands"):
        module = import_module(name)
        for title, entries in module.COMMANDS.items():
            added.setdefault(title, {}).update(entries)
        below |= getattr(module, "SUBCOMMANDS", {})
    groups: dict[str, dict[str, Entry]] = {}
    for title in (*TABLE, *(name for name in added if name not in TABLE)):
        of_apps = added.get(title, {})
        placed = {name: of_apps.get(name, entry) for name, entry in TABLE.get(title, {}).items()}
        there = {
            name: entry for name, entry in (placed | of_apps).items() if isinstance(entry, Entry)
        }
        if there:
            groups[title] = there
    return groups, below


GROUPS, SUBCOMMANDS = _add_commands_of_apps()
"""The commands by group; the commands of commands, which `EVERY_COMMAND` has as `fleet add`."""

COMMANDS = {name: entry for group in GROUPS.values() for name, entry in group.items()}

ABSENT = {
    name: app
    for group in TABLE.values()
    for name, app in group.items()
    if isinstance(app, str) and name not in COMMANDS
}
"""Commands whose app is not installed."""

EVERY_COMMAND = COMMANDS | {
    f"{name} {sub}": entry
    for name, entries in SUBCOMMANDS.items()
    for sub, entry in entries.items()
}
