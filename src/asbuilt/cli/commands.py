"""The commands: where each is defined, its summary, two examples, and the function it calls."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Entry:
    """Describe a command without importing it.

    Parameters
    ----------
    module
        Module of `asbuilt.cli` that has the function of the same name; it imports what computes
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


GROUPS: dict[str, dict[str, Entry]] = {
    "Robots": {
        "robots": Entry(
            "robot", "List the bundled robots.", ("", "--json"), "robot_names", compiles=False
        ),
        "show": Entry(
            "robot",
            "Show geometry, mass properties, limits and consistency.",
            ("kuka-iiwa7-r800", "my_robot.urdf --full"),
            "load_robot",
            compiles=False,
        ),
        "masses": Entry(
            "robot",
            "Compute link masses from meshes and materials, or from a table.",
            (
                "my_robot.urdf --meshes meshes --material aluminium",
                "my_robot.urdf --table cad.csv --about com -o new.urdf",
            ),
            "link_masses",
            compiles=False,
        ),
        "schema": Entry(
            "robot",
            "Print the JSON Schema of robot files or recording sheets.",
            ("robot -o robot.schema.json", "sheet"),
            "json_schema",
            compiles=False,
        ),
        "convert": Entry(
            "robot",
            "Write a robot description in another format.",
            (
                "my_robot.urdf my_robot.toml --gravity 9.81,0,0",
                "my_robot.urdf arm.urdf --lock finger",
            ),
            "convert_robot",
        ),
        "view": Entry(
            "robot",
            "Show the robot in 3-D in the browser, or save a picture.",
            ("ur10e", "ur10e motion.csv --save motion.html"),
            "view_robot",
        ),
        "base": Entry(
            "robot",
            "Find the base parameters and what of each link is identifiable.",
            ("kuka-iiwa7-r800", "ur10e --drive viscous,coulomb --full"),
            "find_base_parameters",
        ),
        "drives": Entry(
            "robot",
            "List the drive terms (friction, armature, springs).",
            ("", "--json"),
            "",
            compiles=False,
        ),
    },
    "Motions": {
        "excite": Entry(
            "motion",
            "Design the most informative motion within the limits.",
            (
                "kuka-iiwa7-r800 -o motion.csv",
                "ur10e --collision skeleton:0.08 --program urscript",
            ),
            "design_motion",
        ),
        "program": Entry(
            "motion",
            "Write a controller program that runs and records a motion.",
            (
                "kuka-iiwa7-r800 motion.csv --format sunrise -o program",
                "ur10e motion.csv --format urscript --rate 500",
            ),
            "make_program",
        ),
        "simulate": Entry(
            "recording",
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
            "recording",
            "Check recordings before they are used.",
            ("ur10e log.csv", "ur10e log.csv --flip-torque --json"),
            "check_recording",
        ),
        "columns": Entry(
            "page.columns",
            "Show which column of a log is which quantity of which joint.",
            ("ur10e log.csv", "ur10e log.csv --sheet log.toml --json"),
            "",
            compiles=False,
        ),
        "gains": Entry(
            "calibration",
            "Find torque per logged unit from a payload of known mass.",
            (
                "ur10e bare.csv --loaded loaded.csv --mass 5",
                "ur10e bare.csv --loaded loaded.csv --mass 5 --com 0,0,0.08",
            ),
            "find_gains",
        ),
        "channels": Entry(
            "calibration",
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
            "identify",
            "Identify the robot from recordings, and validate the result.",
            (
                "ur10e log.csv -o study",
                "ur10e log.csv --validate other.csv --torque-source current",
            ),
            "identify",
        ),
        "validate": Entry(
            "validation",
            "Predict other recordings with the result and with CAD.",
            ("study/result.json other.csv", "ur10e other.csv --json"),
            "validate",
        ),
        "compare": Entry(
            "validation",
            "Compare CAD with the robot as built, or two results.",
            ("study/result.json", "before.json --with after.json -o changes"),
            "compare",
            surplus="two results are compared by asbuilt compare RESULT --with RESULT2",
        ),
        "feasible": Entry(
            "validation",
            "Bound masses, centres, inertias, armatures by what bodies allow.",
            (
                "study/result.json",
                "study/result.json mass:link_3 com:link_3 armature --prior cad",
            ),
            "feasible_intervals",
        ),
        "review": Entry(
            "validation",
            "Judge the numbers that a description claims by recordings.",
            (
                "tuned.xml log.csv --torque-source command",
                "tuned.xml log.csv --torque-source command --kp 20 --kd 1.5",
            ),
            "review",
        ),
        "payload": Entry(
            "calibration",
            "Find mass, centre and inertia of what the flange carries.",
            (
                "study/result.json loaded.csv",
                "study/result.json loaded.csv --frame tool0 --arm frozen",
            ),
            "identify_payload",
        ),
        "watch": Entry(
            "validation",
            "Watch a log for external torque, contact and fault.",
            (
                "study/result.json log.csv --calibrate quiet.csv",
                "study/result.json log.csv --thresholds thresholds.json -o events",
            ),
            "watch",
        ),
        "export": Entry(
            "identify",
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
        "fleet": Entry(
            "fleet",
            "Keep the information of many robots over time in a ledger.",
            (
                "add ledger ur10e logs/*.parquet --id-from {id}/*.parquet",
                "identify ledger --id arm-7 --since 2026-03-01",
            ),
            "",
            compiles=False,
        ),
    },
    "Complete runs": {
        "open": Entry(
            "page.server",
            "Open a page in the browser: from files to a trusted model.",
            ("", "my_robot.urdf log.csv --no-browser"),
            "",
            compiles=False,
        ),
        "demo": Entry(
            "demos.story",
            "Design, record, identify, validate and export on a bundled robot.",
            ("", "fleet -o demo"),
            "run_demo",
        ),
        "reproduce": Entry(
            "demos.story",
            "Reproduce the 2015 paper, table by table and figure by figure.",
            ("", "-o paper"),
            "reproduce_paper",
        ),
    },
}

COMMANDS = {name: entry for group in GROUPS.values() for name, entry in group.items()}

SUBCOMMANDS: dict[str, dict[str, Entry]] = {
    "fleet": {
        "add": Entry(
            "fleet",
            "Reduce logs to their information and append it to a ledger.",
            (
                "ledger ur10e logs/arm-7/*.parquet --id arm-7",
                "s3://lab/fleet ur10e logs/*/*.csv --id-from {id}/*.csv",
            ),
            "add_logs",
        ),
        "rebuild": Entry(
            "fleet",
            "Reduce logs of a ledger again, with settings chosen from all.",
            ("ledger logs/*/*.parquet", "ledger logs/*/*.csv --drive auto"),
            "rebuild_ledger",
        ),
        "show": Entry(
            "fleet",
            "Show the robots of a ledger, their logs and settings.",
            ("ledger", "s3://lab/ledger --thorough --json"),
            "fleet_overview",
        ),
        "identify": Entry(
            "fleet",
            "Identify a robot from the ledger alone, in any window of dates.",
            ("ledger --id arm-7", "ledger --id arm-7 --since 2026-03-01 -o study"),
            "fleet_identify",
        ),
        "drift": Entry(
            "fleet",
            "Find the robots that changed: when, what and how large.",
            ("ledger", "ledger --since 2026-03-01 --json"),
            "fleet_drift",
        ),
        "report": Entry(
            "fleet",
            "Write a page of each robot's history, those that changed first.",
            ("ledger --out page", "ledger --since 2026-03-01 -o page"),
            "write_fleet_report",
        ),
    },
}
"""The commands of commands; `EVERY_COMMAND` has them as `fleet add`."""

EVERY_COMMAND = COMMANDS | {
    f"{name} {sub}": entry
    for name, entries in SUBCOMMANDS.items()
    for sub, entry in entries.items()
}
