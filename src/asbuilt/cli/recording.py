"""Commands about recordings: check, simulate."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import typer

import asbuilt
from asbuilt import (
    MotionError,
    ReadingOptions,
    RecordingError,
    UsageError,
    excitation,
    experiment,
    workflow,
    writers,
    writing,
)
from asbuilt.cli.answers import answer, describe_cure, list_files, show_progress
from asbuilt.cli.arguments.options import (
    AsJson,
    FixedBase,
    Full,
    Logs,
    Out,
    Robot,
    RobotOrResult,
    load_robot_as_built,
    parse_number_list,
    parse_positive_number,
    read_robot_and_recordings,
    refuse_idle,
    require_distinct_logs,
    written_file,
)
from asbuilt.cli.arguments.spread import require_known_value
from asbuilt.description.inertia import tool_from_text
from asbuilt.findings import Cure
from asbuilt.ranges import option
from asbuilt.tables import wrap_text


def check(
    robot: Robot,
    log: Logs,
    *,
    reading: ReadingOptions,
    information: Annotated[
        bool,
        typer.Option(
            "--information/--no-information",
            help="compute the information efficiency, relative to the limits (takes a second)",
        ),
    ] = True,
    write_sheet: Annotated[
        bool,
        typer.Option(
            "--write-sheet",
            help="write the sheet with which the log is read, complete, beside it (LOG.toml)",
        ),
    ] = False,
    out: Out = None,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Check a recording before it is used.

    Checked are clock, missing values, units, signs, order of joints, limits, saturation, filters
    and excitation. A recording sheet that makes a log readable, or better, is printed, complete.
    """
    require_distinct_logs(log)
    described = reading.base.load_robot(robot)
    proposals: dict[Path, experiment.SheetProposal] = {}
    written: dict[str, Path] = {}
    if write_sheet:
        _refuse_name_of_sheet(log)
        proposals = _propose_sheets(described, log, reading)
        written = _write_sheets(proposals)
        # The sheet has the sign now, which the option would turn again.
        reading = replace(reading, flip_torque=reading.flip_torque and not written)
    try:
        model, (recordings,) = read_robot_and_recordings(described, reading, log)
    except RecordingError as problem:
        if not proposals and problem.cure is not None and problem.cure.sheet:
            _add_sheet(problem, _propose_sheets(described, log, reading))
        raise

    checks = [asbuilt.check_recording(model, recording) for recording in recordings]
    # What limits a motion on legs is balance, of which limits of joints say nothing.
    information = information and not model.mixes_joints
    carried = [
        _measure_information(model, recording) if information and found.ok else None
        for recording, found in zip(recordings, checks, strict=True)
    ]
    if not proposals and any(_is_cured_by_sheet(found) for found in checks):
        proposals = _propose_sheets(described, log, reading)
    document = writers.check_document(model, checks, carried)
    document["sheets"] = {str(path): proposal.text for path, proposal in proposals.items()}
    files = dict(written)
    if out is not None:
        files |= writers.write_check_page(out, recordings, checks, describe_cure)
    answer(
        as_json,
        lambda: writers.with_files(document, files) if files else document,
        lambda: (
            "\n\n".join(
                found.as_text(full=full, cure_text=describe_cure)
                + ("" if part is None else f"\n{part.as_text(describe_cure)}")
                for found, part in zip(checks, carried, strict=True)
            )
            + (_tell_unwritten(proposals, written) if write_sheet else _print_sheets(proposals))
            + list_files(files)
        ),
    )
    if not all(found.ok for found in checks):
        raise typer.Exit(1)


def _refuse_name_of_sheet(logs: list[Path]) -> None:
    """Refuse a name after --write-sheet, which would be read as a recording."""
    for path in logs:
        if path.suffix == ".toml" and not path.exists():
            raise UsageError(
                f"--write-sheet takes no name, and {path} is no recording",
                cure=Cure("leave the name out: the sheet of LOG is written to LOG.toml"),
            )


def _measure_information(
    model: asbuilt.RobotModel, recording: asbuilt.Recording | experiment.RecordingStream
) -> workflow.RecordedInformation | None:
    """Return the information of a recording; None of a robot for which no motion is designed.

    Nor is there a bound for one that is too heavy for its drives.
    """
    try:
        return workflow.recorded_information(model, recording)
    except (UsageError, MotionError):
        return None


def _propose_sheets(
    model: asbuilt.RobotModel, logs: list[Path], reading: ReadingOptions
) -> dict[Path, experiment.SheetProposal]:
    """Return the sheet of each recording, by its first file."""
    from asbuilt.experiment.logs.readers import group_files

    return {
        group[0]: experiment.propose_sheet(model, group, reading) for group in group_files(logs)
    }


def _is_cured_by_sheet(check: experiment.RecordingCheck) -> bool:
    """Return whether a field of a sheet cures an error or a warning."""
    cures = [finding.cure for finding in (*check.errors, *check.warnings) if finding.cure]
    return any(cure.sheet or cure.settings.get("flip_torque") for cure in cures)


def _write_sheets(proposals: dict[Path, experiment.SheetProposal]) -> dict[str, Path]:
    """Write sheets beside their logs, and return them; a sheet that is there already stays."""
    from asbuilt.experiment.logs.sheet import find_sheet_beside

    written = {}
    for log, proposal in proposals.items():
        if find_sheet_beside(log) is None and proposal.content:
            path = log.with_name(log.name + ".toml")
            written[f"sheet of {log.name}"] = writing.atomic_write(path, proposal.text)
    return written


def _tell_unwritten(
    proposals: dict[Path, experiment.SheetProposal], written: dict[str, Path]
) -> str:
    """Return for each log without a new sheet why it has none."""
    return "".join(
        f"\n\n{log.name} needs no sheet."
        if not proposal.content
        else f"\n\nThe sheet beside {log.name} stays as it is."
        for log, proposal in proposals.items()
        if f"sheet of {log.name}" not in written
    )


def _print_sheets(proposals: dict[Path, experiment.SheetProposal]) -> str:
    """Return the sheets that change how logs are read, and what they then are."""
    return "".join(
        "\n\n"
        + wrap_text(
            f"With this sheet {log.name} is {proposal.outcome} (--write-sheet writes it beside the"
            " log):"
        )
        + f"\n\n{proposal.text.rstrip()}"
        for log, proposal in proposals.items()
        if proposal.changed
    )


def _add_sheet(problem: RecordingError, proposals: dict[Path, experiment.SheetProposal]) -> None:
    """Put the complete sheet in place of the cure of an error, if one reads the log."""
    complete = [
        proposal for proposal in proposals.values() if proposal.changed and proposal.problem is None
    ]
    if complete:
        each = complete[0]
        problem.cure = Cure(
            f"write this recording sheet beside it, with which it is {each.outcome}, or let"
            f" --write-sheet do so:\n\n{each.text}",
            sheet=each.content,
        )


@dataclass(frozen=True)
class Simulating:
    """The options of a virtual robot, of what it carries, and of how it moves."""

    preset: str | None = option(
        None, "NAME", "robot and sensors: ideal (default), lab, factory or servo (no torque)"
    )
    set: list[str] | None = option(
        None,
        "NAME=VALUE",
        "change a value of the preset, such as backlash=2e-4 or feedforward=none; repeat for more",
    )
    tool: str | None = option(
        None, "KG@X,Y,Z", "a ball of this mass, its centre in the axes of --at [m]"
    )
    at: str | None = option(
        None, "NAME", "link or frame that carries the tool (default: the flange)"
    )
    free: str | None = option(
        None,
        "HOW",
        "free simulation: drop (from rest), free (without friction), step (of a controller)",
    )
    start: str | None = option(None, "Q1,Q2,...", "pose in which --free begins [rad, m]")
    engine: str = option(
        "mujoco", "NAME", "mujoco (controlled) or inverse-dynamics (follows exactly)"
    )
    rate: float | None = option(
        None,
        "HZ",
        "sampling rate of the recording (default: the preset's)",
        typer={"min": 0.1, "max": 1e5},
    )
    duration: float | None = option(
        None,
        "S",
        "length of the random motion (20) or of --free (3)",
        typer={"min": 0.01, "max": 86_400.0},
    )
    seed: int = option(0, "N", "seed of everything random", typer={"min": 0})
    robot_seed: int | None = option(
        None,
        "N",
        "seed of the robot alone, so that --seed draws another motion and other noise of the same"
        " robot (default: the value of --seed)",
        typer={"min": 0},
    )


def simulate(
    robot: RobotOrResult,
    *,
    motion: Annotated[
        Path | None,
        typer.Argument(
            metavar="[MOTION]", help="motion CSV (t, q_*, ...), by default a random one"
        ),
    ] = None,
    options: Simulating,
    out: Annotated[
        Path | None,
        written_file(
            metavar="LOG",
            text="recording to write, .csv or .parquet (default: recording.csv, or free.csv)",
        ),
    ] = None,
    fixed_base: FixedBase = False,
    as_json: AsJson = False,
) -> None:
    """Record a virtual robot along a motion, or simulate it without controller.

    The parameters of the robot are written next to the recording.
    """
    runs_on = require_known_value("--engine", options.engine, ("mujoco", "inverse-dynamics"))
    kind = require_known_value(
        "--preset", options.preset or "ideal", ("ideal", "lab", "factory", "servo")
    )
    model = load_robot_as_built(robot, fixed_base=fixed_base)

    carried = None if options.tool is None else tool_from_text(options.tool)
    if options.at is not None and carried is None:
        raise UsageError("--at names the carrier of a tool; give --tool KG@X,Y,Z too")
    from asbuilt.experiment.virtual.settings import with_settings
    from asbuilt.identification.calibration.payload import choose_payload_frame

    place = None if carried is None else choose_payload_frame(model, options.at)[0]
    if options.free is not None:
        given = {
            "MOTION": motion,
            "--preset": options.preset,
            "--set": options.set,
            "--rate": options.rate,
            "--engine inverse-dynamics": options.engine != "mujoco",
            "--robot-seed": options.robot_seed is not None,
        }
        refuse_idle(
            "--free simulates the robot as described, without controller and sensors",
            {name: bool(value) for name, value in given.items()},
        )
        _simulate_free(model, carried, place, options, out, as_json)
        return
    if options.start is not None:
        raise UsageError("--start is for --free; a motion starts where its file says")
    if motion is not None and options.duration is not None:
        raise UsageError(f"--duration is for the random motion or --free; {motion} has its own")
    of_robot = options.seed if options.robot_seed is None else options.robot_seed
    virtual = asbuilt.VirtualRobot.preset(
        kind, model, of_robot, tool=carried, at=place, engine=runs_on
    )
    virtual = with_settings(virtual.logging(options.rate), options.set or ())
    moved = _choose_motion(model, virtual, motion, options.duration, options.seed)
    with show_progress() as report:
        simulated = virtual.record(
            moved, options.seed, progress=lambda fraction: report("move", fraction)
        )
    files = writers.write_simulation(out or Path("recording.csv"), simulated)
    answer(
        as_json,
        lambda: writers.simulate_document(simulated, files),
        lambda: writers.simulation_text(simulated) + list_files(files),
    )


def _choose_motion(
    model: asbuilt.RobotModel,
    virtual: asbuilt.VirtualRobot,
    motion: Path | None,
    duration: float | None,
    seed: int,
) -> excitation.Motion:
    """Return the motion of a file, or a random one that shows the virtual robot."""
    if motion is not None:
        return asbuilt.read_motion(motion, model)
    seconds = 20.0 if duration is None else parse_positive_number("--duration", str(duration))
    return asbuilt.random_fourier(
        model, rng=seed, duration=seconds, n_harmonics=virtual.count_harmonics(seconds)
    )


def _simulate_free(
    model: asbuilt.RobotModel,
    tool: asbuilt.LinkInertia | None,
    place: str | None,
    options: Simulating,
    out: Path | None,
    as_json: bool,
) -> None:
    from asbuilt.experiment.virtual.presets import with_body

    moved = asbuilt.run_free(
        model if tool is None else with_body(model, tool, place),
        require_known_value("--free", options.free or "", ("drop", "step", "free")),
        duration=3.0 if options.duration is None else options.duration,
        start=parse_number_list("--start", options.start) or None,
    )
    files = writers.write_free_motion(out or Path("free.csv"), moved)
    answer(
        as_json,
        lambda: writers.free_motion_document(moved, files),
        lambda: writers.free_motion_text(moved) + list_files(files),
    )
