"""The command line: each command reads, makes one call and writes."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from asbuilt.errors import AsbuiltError, ResultError, UsageError
from asbuilt.identification.methods import methods

if TYPE_CHECKING:
    from asbuilt.description.model import RobotModel
    from asbuilt.excitation.motion import Motion
    from asbuilt.experiment.long_recordings import RecordingStream
    from asbuilt.experiment.recording import Recording
    from asbuilt.experiment.signal_chain import SignalChain
    from asbuilt.identification.result import IdentificationResult

app = typer.Typer(
    name="asbuilt",
    help="The dynamic model of a robot arm as built, from its description and a recording of its motion and torque.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

Robot = Annotated[str, typer.Argument(metavar="ROBOT", help="a bundled robot (see `asbuilt robots`) or a .urdf, .xml, .toml or .csv file")]
Log = Annotated[Path, typer.Argument(metavar="LOG", help="a recording: .csv .parquet .npz .mat .h5 or a ROS 2 bag")]
Logs = Annotated[list[Path], typer.Argument(metavar="LOG...", help="recordings: .csv .parquet .npz .mat .h5 or ROS 2 bags")]
Result = Annotated[Path, typer.Argument(metavar="RESULT", help="a result.json that `asbuilt identify --out` wrote")]
AsJson = Annotated[bool, typer.Option("--json", help="print one JSON document on stdout and nothing else there")]
Out = Annotated[Path | None, typer.Option("--out", metavar="DIR", help="folder for the files to write")]
Drive = Annotated[
    str | None,
    typer.Option(
        "--drive",
        metavar="LIST",
        help="terms such as armature,viscous,coulomb,stribeck:velocity=0.1 (see asbuilt drives), none, or for identify auto",
    ),
]
Rate = Annotated[float | None, typer.Option("--rate", metavar="HZ", help="sampling rate of a log without time stamps")]
Flip = Annotated[bool, typer.Option("--flip-torque", help="the log's torque has the opposite sign")]
Gain = Annotated[str | None, typer.Option("--gain", metavar="G1,G2,...", help="torque per logged unit, one for all joints or one each")]
Source = Annotated[str | None, typer.Option("--torque-source", metavar="KIND", help="sensor, motor or current")]
Sheet = Annotated[Path | None, typer.Option("--sheet", metavar="FILE", help="recording sheet (TOML) that describes the logs")]
Cutoff = Annotated[float | None, typer.Option("--cutoff", metavar="HZ", help="low-pass cutoff (default: chosen from the recording)")]
Decimate = Annotated[int | None, typer.Option("--decimate", metavar="N", help="keep every Nth sample after filtering")]
Preset = Annotated[str, typer.Option("--preset", metavar="NAME", help="signal chain: default or paper2015")]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; every failure is one message on stderr and an exit status of 1 (data, robot) or 2 (usage)."""
    try:
        app(args=list(arguments) if arguments is not None else None, prog_name="asbuilt")
    except UsageError as problem:
        _fail(str(problem), 2)
    except AsbuiltError as problem:
        _fail(str(problem), 1)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except (KeyboardInterrupt, EOFError):
        _fail("interrupted; no file was left half-written", 130)
    except Exception as problem:
        if os.environ.get("ASBUILT_TRACEBACK"):
            raise
        _fail(f"this should not have happened ({type(problem).__name__}: {problem}); ASBUILT_TRACEBACK=1 shows where, please report it", 1)


def _fail(message: str, status: int) -> None:
    print(f"asbuilt: {message}", file=sys.stderr)
    sys.exit(status)


def _answer(as_json: bool, document: Callable[[], dict[str, Any]], text: Callable[[], str]) -> None:
    """Print the document or the text on stdout."""
    if as_json:
        from asbuilt.writers.tabular import json_text

        sys.stdout.write(json_text(document()))
    else:
        sys.stdout.write(text().rstrip("\n") + "\n")
    sys.stdout.flush()


@contextmanager
def _progress() -> Iterator[Callable[[str, float], None]]:
    """Yield `report(what, fraction)`; draws a bar on stderr where that is a terminal, for anything that takes over a second."""
    if not sys.stderr.isatty():
        yield lambda what, fraction: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    bar = Progress(TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=Console(stderr=True), transient=True)
    tasks: dict[str, Any] = {}

    def report(what: str, fraction: float) -> None:
        stage = what.split(":", maxsplit=1)[0]
        if stage not in tasks:
            for task in tasks.values():
                bar.update(task, completed=1.0)
            tasks[stage] = bar.add_task(what, total=1.0)
        bar.update(tasks[stage], description=what, completed=fraction)

    with bar:
        yield report


def _load(robot: str) -> RobotModel:
    from asbuilt.description.load import load_robot

    return load_robot(robot)


def _gains(text: str | None) -> list[float] | None:
    if text is None:
        return None
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise UsageError(
            f"--gain takes numbers separated by commas, got {text!r}; for example --gain 14.87,13.26,11.13,10.62,11.03,11.47"
        ) from None


@app.command()
def robots(as_json: AsJson = False) -> None:
    """List the bundled robots."""
    from asbuilt.description.catalogue import bundled_robot, robot_names
    from asbuilt.writers.robot_tables import robots_document, robots_table

    models = [bundled_robot(name) for name in robot_names()]
    _answer(as_json, lambda: robots_document(models), lambda: robots_table(models).as_text())


@app.command()
def drives(as_json: AsJson = False) -> None:
    """List the drive terms that --drive takes, with their options."""
    from asbuilt.writers.drive_tables import drives_document, drives_text

    _answer(as_json, drives_document, drives_text)


@app.command()
def show(robot: Robot, as_json: AsJson = False) -> None:
    """Show geometry, mass properties, limits and the physical consistency of every link."""
    from asbuilt.writers.robot_tables import robot_document, robot_text

    model = _load(robot)
    _answer(as_json, lambda: robot_document(model), lambda: robot_text(model))


@app.command()
def base(robot: Robot, drive: Drive = "none", as_json: AsJson = False) -> None:
    """Find the base parameters, and say of each standard parameter whether torques tell it, and why."""
    from asbuilt.dynamics.base_parameters import find_base_parameters
    from asbuilt.dynamics.drives.selection import DriveSet
    from asbuilt.writers.robot_tables import base_table, standard_table
    from asbuilt.writers.tabular import base_document

    model = _load(robot)
    found = find_base_parameters(model, DriveSet.parse(drive or "none"))
    _answer(
        as_json, lambda: base_document(found, model), lambda: base_table(found, model).as_text() + "\n" + standard_table(found).as_text()
    )


@app.command()
def check(
    robot: Robot,
    log: Logs,
    rate: Rate = None,
    flip_torque: Flip = False,
    gain: Gain = None,
    torque_source: Source = None,
    sheet: Sheet = None,
    as_json: AsJson = False,
) -> None:
    """Say what is wrong with a recording before it is used."""
    from asbuilt.experiment.checks import check_recording
    from asbuilt.writers.tabular import check_document

    model = _load(robot)
    recordings = _read(model, log, rate, flip_torque, gain, torque_source, sheet)
    checks = [check_recording(model, recording) for recording in recordings]
    _answer(as_json, lambda: check_document(model, checks), lambda: "\n\n".join(found.as_text() for found in checks))
    if not all(found.ok for found in checks):
        raise typer.Exit(1)


def _read(
    model: RobotModel,
    logs: Sequence[Path],
    rate: float | None,
    flip_torque: bool,
    gain: str | None,
    torque_source: str | None,
    sheet: Path | None,
) -> list[Recording]:
    from asbuilt.experiment.readers import read_recordings

    return read_recordings(list(logs), **_reading(model, rate, flip_torque, gain, torque_source, sheet))


def _open(
    model: RobotModel,
    logs: Sequence[Path],
    rate: float | None,
    flip_torque: bool,
    gain: str | None,
    torque_source: str | None,
    sheet: Path | None,
) -> list[Recording | RecordingStream]:
    """Read recordings, those too long to be held excepted."""
    from asbuilt.experiment.long_recordings import open_recordings

    return open_recordings(list(logs), **_reading(model, rate, flip_torque, gain, torque_source, sheet))


def _reading(
    model: RobotModel, rate: float | None, flip_torque: bool, gain: str | None, torque_source: str | None, sheet: Path | None
) -> dict[str, Any]:
    from asbuilt.experiment.recording import TORQUE_SOURCES

    return {
        "model": model,
        "sheet": sheet,
        "rate": rate,
        "flip_torque": flip_torque,
        "gain": _gains(gain),
        "torque_source": _one_of("--torque-source", torque_source, TORQUE_SOURCES) if torque_source else None,
    }


@app.command()
def identify(
    robot: Robot,
    log: Logs,
    validate: Annotated[
        list[Path] | None, typer.Option("--validate", metavar="LOG", help="a recording to judge by; repeat for more")
    ] = None,
    holdout: Annotated[
        str | None, typer.Option("--holdout", metavar="RULE", help="blocks:5s:3 (every third 5 s block) or last:0.3")
    ] = None,
    drive: Drive = None,
    method: Annotated[str, typer.Option("--method", metavar="NAME", help=f"estimator: {', '.join(methods)}")] = "auto",
    undetermined: Annotated[
        str, typer.Option("--undetermined", metavar="HOW", help="what no motion excites: cad (keep at CAD, named) or refuse")
    ] = "cad",
    payload: Annotated[
        list[Path] | None, typer.Option("--payload", metavar="LOG", help="a recording under load: what does the flange carry?")
    ] = None,
    mounting: Annotated[
        str,
        typer.Option(
            "--mounting", metavar="HOW", help="gravity points as in the description (cad), or its direction is found too (estimate)"
        ),
    ] = "cad",
    unchecked: Annotated[bool, typer.Option("--unchecked", help="use the recordings whatever the checks say of them")] = False,
    rate: Rate = None,
    flip_torque: Flip = False,
    gain: Gain = None,
    torque_source: Source = None,
    sheet: Sheet = None,
    cutoff: Annotated[
        str | None, typer.Option("--cutoff", metavar="HZ|auto", help="low-pass cutoff; auto sweeps and judges by held-out torque")
    ] = None,
    decimate: Decimate = None,
    preset: Preset = "default",
    out: Out = None,
    as_json: AsJson = False,
) -> None:
    """Identify a robot from recordings: base parameters with errors, what they predict, and how CAD compares."""
    from asbuilt.dynamics.drives.selection import DriveSet
    from asbuilt.validation.payload_study import run_payload_study
    from asbuilt.validation.study import StudyOptions, run_study
    from asbuilt.writers.payload_tables import payload_document, payload_text
    from asbuilt.writers.study_files import study_document, study_text, write_study

    model, swept = _load(robot), cutoff == "auto"
    options = StudyOptions(
        drive=None if drive is None else "auto" if drive.strip() == "auto" else DriveSet.parse(drive),
        method=_one_of("--method", method, list(methods)),
        chain=_chain(preset, None if swept else _cutoff(cutoff), decimate),
        sweep_cutoff=swept,
        holdout=holdout,
        unexcited=_one_of("--undetermined", undetermined, {"cad": "toward_prior", "refuse": "refuse"}),
        mounting=_one_of("--mounting", mounting, {"cad": "as_described", "estimate": "estimate"}),
        checked=not unchecked,
    )
    with _progress() as report:
        report("read", 0.0)
        recordings = _open(model, log, rate, flip_torque, gain, torque_source, sheet)
        others = _open(model, validate or [], rate, flip_torque, gain, torque_source, sheet)
        study = run_study(model, recordings, validation=others, options=options, progress=report)
        loaded = _read(model, payload or [], rate, flip_torque, gain, torque_source, sheet)
        carried = run_payload_study(study.result, loaded, chain=options.chain) if loaded else None
        files = write_study(out, study, command=sys.argv[1:]) if out is not None else {}
    _answer(
        as_json,
        lambda: study_document(study, files) | ({"payload": payload_document(carried)} if carried is not None else {}),
        lambda: study_text(study) + (f"\n\n{payload_text(carried)}" if carried is not None else "") + _listed(files),
    )


@app.command()
def validate(
    result: Result,
    log: Logs,
    rate: Rate = None,
    flip_torque: Flip = False,
    gain: Gain = None,
    torque_source: Source = None,
    sheet: Sheet = None,
    cutoff: Cutoff = None,
    decimate: Decimate = None,
    preset: Preset = "default",
    out: Out = None,
    as_json: AsJson = False,
) -> None:
    """Predict other recordings with an identified model, and with CAD beside it."""
    from asbuilt.experiment.signal_chain import prepare_samples
    from asbuilt.validation.comparison import compare
    from asbuilt.validation.prediction import validate as predict
    from asbuilt.writers.study_files import write_validations
    from asbuilt.writers.tabular import validate_document

    identified = _result(result)
    recordings = _read(identified.model, log, rate, flip_torque, gain, torque_source, sheet)
    chain = _chain(preset, cutoff, decimate)
    validations = [predict(identified, prepare_samples(recording, chain)) for recording in recordings]
    files = write_validations(out, identified, validations) if out is not None else {}
    comparison = compare(identified, validation=validations)
    _answer(
        as_json,
        lambda: validate_document(identified, validations, files=files),
        lambda: comparison.torque_table().as_text() + "\n" + comparison.verdict() + _listed(files),
    )


@app.command()
def compare(
    result: Result,
    cad: Annotated[str | None, typer.Option("--cad", metavar="ROBOT", help="another description of the same robot to compare with")] = None,
    cad_tolerance: Annotated[
        str | None,
        typer.Option("--cad-tolerance", metavar="5%", help="how well CAD knows masses, centres and inertias: one fraction or three"),
    ] = None,
    other: Annotated[
        Path | None, typer.Option("--with", metavar="RESULT2", help="a later result of the same robot: what changed since RESULT")
    ] = None,
    controller: Annotated[
        Path | None, typer.Option("--controller", metavar="LOG", help="a recording with tau_ext: compare with the controller's own model")
    ] = None,
    holdout: Annotated[str, typer.Option("--holdout", metavar="RULE", help="what of --controller to judge by")] = "blocks:5s:3",
    rate: Rate = None,
    flip_torque: Flip = False,
    sheet: Sheet = None,
    out: Out = None,
    as_json: AsJson = False,
) -> None:
    """Compare CAD with the robot as built: what differs, what that costs in torque, which causes explain it; or two results of one robot."""
    from asbuilt.identification.determination import determination
    from asbuilt.validation.attribution import attribute
    from asbuilt.validation.comparison import compare as compare_with
    from asbuilt.validation.controller_model import compare_with_controller
    from asbuilt.validation.drift import compare_results
    from asbuilt.validation.significance import CadTolerance
    from asbuilt.writers.compare_files import CadVerdict, with_files, write_comparison, write_drift

    identified, files = _result(result), {}
    if sum(choice is not None for choice in (cad, other, controller)) > 1:
        raise UsageError("--cad, --with and --controller are three different comparisons; give one of them")
    if other is not None:
        drift = compare_results(identified, _result(other), labels=(str(result), str(other)))
        files = write_drift(out, drift) if out is not None else {}
        _answer(as_json, lambda: with_files(drift.as_document(), files), lambda: drift.as_text() + _listed(files))
        return
    if controller is not None:
        recording = _read(identified.model, [controller], rate, flip_torque, None, None, sheet)[0]
        beside = compare_with_controller(identified, recording, holdout=holdout)
        files = write_drift(out, beside.difference) if out is not None else {}
        _answer(as_json, lambda: with_files(beside.as_document(), files), lambda: beside.as_text() + _listed(files))
        return
    design = None if cad is None else _load(cad)
    verdict = CadVerdict(
        compare_with(identified, design, tolerance=None if cad_tolerance is None else CadTolerance.parse(cad_tolerance)),
        attribute(identified, design) if identified.evidence is not None else None,
        determination(identified),
    )
    files = write_comparison(out, identified, verdict) if out is not None else {}
    _answer(as_json, lambda: with_files(verdict.as_document(), files), lambda: verdict.as_text() + _listed(files))


@app.command()
def payload(
    result: Result,
    log: Logs,
    unloaded: Annotated[
        list[Path] | None, typer.Option("--unloaded", metavar="LOG", help="a recording of the bare arm; repeat for more")
    ] = None,
    validate: Annotated[list[Path] | None, typer.Option("--validate", metavar="LOG", help="a loaded recording to judge by")] = None,
    holdout: Annotated[
        str | None, typer.Option("--holdout", metavar="RULE", help="blocks:5s:3 or last:0.3, of the loaded recordings")
    ] = None,
    frame: Annotated[
        str | None, typer.Option("--frame", metavar="NAME", help="link or frame that carries it (default: the flange)")
    ] = None,
    arm: Annotated[str, typer.Option("--arm", metavar="HOW", help="refined (with the payload, held by the result) or frozen")] = "refined",
    rate: Rate = None,
    flip_torque: Flip = False,
    gain: Gain = None,
    torque_source: Source = None,
    sheet: Sheet = None,
    cutoff: Cutoff = None,
    decimate: Decimate = None,
    preset: Preset = "default",
    out: Out = None,
    as_json: AsJson = False,
) -> None:
    """Find what the flange carries: mass, centre and inertia, from recordings under load."""
    from asbuilt.validation.payload_study import run_payload_study
    from asbuilt.writers.payload_tables import payload_document, payload_text
    from asbuilt.writers.tabular import write_json

    identified = _result(result)
    read = [_read(identified.model, logs or [], rate, flip_torque, gain, torque_source, sheet) for logs in (log, unloaded, validate)]
    found = run_payload_study(
        identified,
        *read,
        chain=_chain(preset, cutoff, decimate),
        holdout=holdout,
        frame=frame,
        arm=_one_of("--arm", arm, ("refined", "frozen")),
    )
    files = {"payload": write_json(out / "payload.json", payload_document(found))} if out is not None else {}
    _answer(as_json, lambda: payload_document(found, files), lambda: payload_text(found) + _listed(files))


@app.command()
def gains(
    robot: Robot,
    log: Annotated[list[Path], typer.Argument(metavar="LOG...", help="recordings of the bare arm")],
    loaded: Annotated[list[Path], typer.Option("--loaded", metavar="LOG", help="a recording with the payload; repeat for more")],
    mass: Annotated[float, typer.Option("--mass", metavar="KG", help="mass of the payload")],
    com: Annotated[
        str | None, typer.Option("--com", metavar="X,Y,Z", help="its centre of mass in the flange frame [m], where known")
    ] = None,
    frame: Annotated[
        str | None, typer.Option("--frame", metavar="NAME", help="link or frame that carries it (default: the flange)")
    ] = None,
    drive: Drive = None,
    rate: Rate = None,
    flip_torque: Flip = False,
    gain: Gain = None,
    sheet: Sheet = None,
    cutoff: Cutoff = None,
    as_json: AsJson = False,
) -> None:
    """Find the torque per ampere (or the factor on a logged torque) of every drive from a payload of known mass."""
    from asbuilt.dynamics.drives.selection import DriveSet
    from asbuilt.experiment.signal_chain import prepare_samples
    from asbuilt.identification.torque_gains import identify_gains
    from asbuilt.writers.drive_tables import gains_document, gains_text

    model = _load(robot)
    bare, under = (_read(model, logs, rate, flip_torque, gain, "current", sheet) for logs in (log, loaded))
    chain = _chain("default", cutoff, None).resolved(*bare, *under)
    found = identify_gains(
        model,
        [prepare_samples(recording, chain) for recording in bare],
        [prepare_samples(recording, chain) for recording in under],
        mass=mass,
        com=None if com is None else _centre(com),
        drive=None if drive is None else DriveSet.parse(drive),
        frame=frame,
    )
    _answer(as_json, lambda: gains_document(found), lambda: gains_text(found))


@app.command()
def channels(
    robot: Robot,
    log: Annotated[list[Path], typer.Argument(metavar="LOG...", help="recordings of the joint torque sensors")],
    motor: Annotated[list[Path], typer.Option("--motor", metavar="LOG", help="the same with motor torques, in the same order")],
    motor_gain: Annotated[
        str | None, typer.Option("--motor-gain", metavar="G1,G2,...", help="torque per logged unit of the motors")
    ] = None,
    rate: Rate = None,
    flip_torque: Flip = False,
    sheet: Sheet = None,
    motor_sheet: Annotated[Path | None, typer.Option("--motor-sheet", metavar="FILE", help="recording sheet of the motor logs")] = None,
    cutoff: Cutoff = None,
    as_json: AsJson = False,
) -> None:
    """Identify links, link-side friction and motor side from torques recorded on both sides of the gears."""
    from asbuilt.experiment.signal_chain import prepare_samples
    from asbuilt.identification.two_channels import identify_two_channels
    from asbuilt.writers.drive_tables import channels_document, channels_text

    model = _load(robot)
    sensors = _read(model, log, rate, flip_torque, None, "sensor", sheet)
    motors = _read(model, motor, rate, flip_torque, motor_gain, "motor", motor_sheet or sheet)
    chain = _chain("default", cutoff, None).resolved(*sensors)
    found = identify_two_channels(model, *([prepare_samples(each, chain) for each in logs] for logs in (sensors, motors)))
    _answer(as_json, lambda: channels_document(found), lambda: channels_text(found))


def _centre(text: str) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != 3:
        raise UsageError(f"--com takes three numbers separated by commas, got {text!r}; for example --com 0,0,0.05")
    return values


@app.command()
def excite(
    robot: Robot,
    drive: Drive = "viscous,coulomb,offset",
    duration: Annotated[str, typer.Option("--duration", metavar="S", help="length of the motion, or auto (see --precision)")] = "20",
    parametrisation: Annotated[
        str, typer.Option("--parametrisation", metavar="KIND", help="fourier, bspline, quintic or point-to-point")
    ] = "fourier",
    harmonics: Annotated[
        int | None, typer.Option("--harmonics", metavar="N", help="harmonics, or control or way points (default: by duration)")
    ] = None,
    criterion: Annotated[str, typer.Option("--criterion", metavar="NAME", help="d, a, e or condition")] = "d",
    focus: Annotated[str | None, typer.Option("--focus", metavar="LIST", help="names or ids of the base parameters that matter")] = None,
    given: Annotated[
        Path | None, typer.Option("--given", metavar="RESULT", help="an earlier result: find what it left open, with its noise")
    ] = None,
    noise: Annotated[
        str | None, typer.Option("--noise", metavar="S1,S2,...", help="standard deviation of the torque, one or one per joint")
    ] = None,
    static: Annotated[
        int | None, typer.Option("--static", metavar="K", help="no motion: the best K poses to stand still in, for gravity alone")
    ] = None,
    precision: Annotated[
        float, typer.Option("--precision", metavar="SHARE", help="with --duration auto: torque error per parameter, as share of the torque")
    ] = 0.002,
    periods: Annotated[int, typer.Option("--periods", metavar="N", help="repeat a Fourier series so often within the duration")] = 1,
    collision: Annotated[
        str | None,
        typer.Option("--collision", metavar="SOURCE", help="keep bodies apart: skeleton[:RADIUS], a .urdf with geometry, or a .toml file"),
    ] = None,
    tool_box: Annotated[
        str | None, typer.Option("--tool-box", metavar="X0,X1,Y0,Y1,Z0,Z1", help="keep the tool in this box of the root frame [m]")
    ] = None,
    tool_frame: Annotated[str | None, typer.Option("--tool-frame", metavar="NAME", help="the frame that stays in the box")] = None,
    power: Annotated[
        str | None, typer.Option("--power", metavar="P1,P2,...", help="mechanical power allowed, one or one per joint [W]")
    ] = None,
    fraction: Annotated[float, typer.Option("--fraction", help="how much of the limits of motion may be used")] = 0.95,
    torque_fraction: Annotated[float, typer.Option("--torque-fraction", help="how much of the torque limits may be used")] = 0.8,
    perturbed: Annotated[
        int, typer.Option("--perturbed", metavar="N", help="hold the torque limit for N other robots, masses 10 % off")
    ] = 0,
    starts: Annotated[int, typer.Option("--starts", metavar="N", help="local searches")] = 24,
    time_limit: Annotated[float, typer.Option("--time-limit", metavar="S", help="be done after this time, with the best so far")] = 25.0,
    seed: Annotated[int, typer.Option("--seed", help="seed of everything random")] = 0,
    rate: Annotated[float, typer.Option("--rate", metavar="HZ", help="rate of the motion file")] = 1000.0,
    program: Annotated[
        list[str] | None, typer.Option("--program", metavar="FORMAT", help="program for a controller beside it: see `asbuilt program`")
    ] = None,
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="motion file to write")] = Path("motion.csv"),
    as_json: AsJson = False,
) -> None:
    """Design the most informative motion within the limits of a robot, and say how near it comes to the best there could be."""
    from asbuilt.dynamics.drives.selection import DriveSet
    from asbuilt.excitation.collision import watched
    from asbuilt.excitation.design import design_motion
    from asbuilt.excitation.design_options import DesignOptions
    from asbuilt.excitation.precision import design_for_precision
    from asbuilt.excitation.static_poses import design_static_poses
    from asbuilt.identification.known_information import known_information
    from asbuilt.writers.design_tables import excite_document, excite_text, static_document, static_text, write_design, write_static

    model, drives, prior = _load(robot), DriveSet.parse(drive or "none"), None
    sigma = _numbers("--noise", noise) or (1.0,)
    if given is not None:
        known = _result(given)
        if known.model.joint_names != model.joint_names:
            raise UsageError(f"{given} belongs to {known.robot}, not to {model.name}")
        model, drives, prior = known.model, known.base.drive, known_information(known)
        sigma = _numbers("--noise", noise) or tuple(known.sigma.tolist())
    _check_programs(model, program)
    constraints = watched(model, collision=collision, tool_box=_numbers("--tool-box", tool_box), tool_frame=tool_frame)
    if static is not None:
        standing = design_static_poses(
            model,
            static,
            noise=sigma,
            fraction=fraction,
            torque_fraction=torque_fraction,
            constraints=constraints,
            seed=seed,
        )
        files = write_static(out, standing, rate) | _programs(model, standing.motion, program, out)
        _answer(as_json, lambda: static_document(standing, files), lambda: static_text(standing) + _listed(files))
        return
    options = DesignOptions(
        parametrisation=parametrisation,
        size=harmonics,
        duration=20.0 if duration == "auto" else _positive("--duration", duration),
        periods=periods,
        criterion=criterion,
        focus=tuple(name for name in (focus or "").split(",") if name.strip()),
        noise=sigma[0] if len(sigma) == 1 else sigma,
        fraction=fraction,
        torque_fraction=torque_fraction,
        power=_numbers("--power", power),
        perturbed=perturbed,
        starts=starts,
        seed=seed,
        time_limit=time_limit,
    )
    with _progress() as report:
        report("bound the information", 0.0)

        def progress(state: Any) -> None:
            report(f"search: best {state.best:.2f}" if state.finished else "search", state.finished / state.planned)

        if duration == "auto":
            design, trials = design_for_precision(
                model, drives, options, precision, prior=prior, constraints=constraints, progress=progress
            )
        else:
            design, trials = design_motion(model, drives, options, prior=prior, constraints=constraints, progress=progress), ()
        files = write_design(out, design, rate) | _programs(model, design.motion, program, out)
    _answer(as_json, lambda: excite_document(design, files, trials), lambda: excite_text(design, trials) + _listed(files))


def _check_programs(model: RobotModel, forms: Sequence[str] | None) -> None:
    from asbuilt.excitation.programs.registry import program_format

    for form in forms or ():
        program_format(form, model)


def _programs(model: RobotModel, motion: Motion, forms: Sequence[str] | None, out: Path) -> dict[str, Path]:
    """Write the programs of a motion into folders beside its file."""
    from asbuilt.excitation.programs.registry import make_program
    from asbuilt.writers.program_files import write_program

    files: dict[str, Path] = {}
    for form in forms or ():
        written = write_program(out.with_name(f"{out.stem}_{form}"), make_program(model, motion, form, name=out.stem))
        files |= {f"{form}_{role}": path for role, path in written.items()}
    return files


@app.command()
def program(
    robot: Robot,
    motion: Annotated[Path, typer.Argument(metavar="MOTION", help="motion CSV (t, q_*, ...), as `asbuilt excite` writes it")],
    form: Annotated[str, typer.Option("--format", metavar="FORMAT", help="sunrise, fri, ros2, urscript, franka or csv")],
    rate: Annotated[float | None, typer.Option("--rate", metavar="HZ", help="rate of points or recording (default: what suits)")] = None,
    name: Annotated[str | None, typer.Option("--name", help="name of the motion and its files (default: the file's)")] = None,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="folder for the files to write")] = Path("program"),
    as_json: AsJson = False,
) -> None:
    """Write a program that makes a real controller run a motion and record it, slow dry run first."""
    from asbuilt.excitation.motion_csv import read_motion
    from asbuilt.excitation.programs.registry import program_format, program_request
    from asbuilt.writers.program_files import program_document, program_text, write_program

    model = _load(robot)
    chosen = program_format(form, model)
    request = program_request(model, read_motion(motion, model), form, name=name or motion.stem, rate=rate)
    files = write_program(out, chosen.files(request))
    _answer(as_json, lambda: program_document(request, form, files), lambda: program_text(request, form) + _listed(files))


@app.command()
def export(
    result: Result,
    urdf: Annotated[Path | None, typer.Option("--urdf", metavar="FILE", help="the URDF it was identified with, as built")] = None,
    mjcf: Annotated[Path | None, typer.Option("--mjcf", metavar="FILE", help="a model for MuJoCo")] = None,
    toml: Annotated[Path | None, typer.Option("--toml", metavar="FILE", help="a robot file of asbuilt")] = None,
    c: Annotated[Path | None, typer.Option("--c", metavar="FILE", help="C99 code FILE.c, and FILE.h beside it")] = None,
    original: Annotated[
        Path | None, typer.Option("--original", metavar="FILE", help="the URDF to edit (default: where the robot was read from)")
    ] = None,
    nearest: Annotated[
        bool,
        typer.Option("--nearest", help="where no real bodies and drives have the identified parameters, write the nearest that can be"),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Write the identified robot for other software."""
    from asbuilt.writers.export import export_result

    exported = export_result(_result(result), urdf=urdf, mjcf=mjcf, toml=toml, c=c, original=original, nearest=nearest)
    _answer(as_json, exported.as_document, exported.as_text)


@app.command()
def simulate(
    robot: Annotated[
        str,
        typer.Argument(metavar="ROBOT|RESULT", help="a bundled robot, a robot file, or a result.json that `asbuilt identify --out` wrote"),
    ],
    motion: Annotated[
        Path | None, typer.Argument(metavar="[MOTION]", help="motion CSV (t, q_*, ...); a random one where none is given")
    ] = None,
    preset: Annotated[str, typer.Option("--preset", metavar="NAME", help="the robot and its sensors: ideal, lab or factory")] = "ideal",
    tool: Annotated[
        str | None, typer.Option("--tool", metavar="KG@X,Y,Z", help="a ball of this mass, its centre in the axes of --at [m]")
    ] = None,
    at: Annotated[
        str | None, typer.Option("--at", metavar="NAME", help="link or frame that carries the tool (default: the last link)")
    ] = None,
    free: Annotated[
        str | None,
        typer.Option("--free", metavar="HOW", help="no motion, let go: drop (at rest), free (without friction), step (of a controller)"),
    ] = None,
    start: Annotated[str | None, typer.Option("--start", metavar="Q1,Q2,...", help="pose in which --free begins [rad, m]")] = None,
    engine: Annotated[
        str, typer.Option("--engine", metavar="NAME", help="mujoco (controlled, in physics) or inverse-dynamics (follows exactly)")
    ] = "mujoco",
    rate: Annotated[
        float | None, typer.Option("--rate", metavar="HZ", help="sampling rate of the recording (default: the preset's)")
    ] = None,
    duration: Annotated[
        float | None, typer.Option("--duration", metavar="S", help="length of the random motion (20) or of --free (3)")
    ] = None,
    seed: Annotated[int, typer.Option("--seed", help="seed of everything random")] = 0,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="LOG", help="recording to write, .csv or .parquet (default: recording.csv, or free.csv)")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Record a virtual robot along a motion, or let a robot go; the parameters it was made with are written beside the recording."""
    from asbuilt.description.tool import tool_from_text
    from asbuilt.excitation.motion_csv import read_motion
    from asbuilt.excitation.random_motion import random_fourier
    from asbuilt.experiment.simulation import InstalledRobot, with_body
    from asbuilt.writers.recording_files import simulate_document, write_simulation

    _one_of("--engine", engine, ("mujoco", "inverse-dynamics"))
    _one_of("--preset", preset, ("ideal", "lab", "factory"))
    carried = None if tool is None else tool_from_text(tool)
    model = _load_built(robot)
    if free is not None:
        from asbuilt.experiment.free_motion import run_free
        from asbuilt.writers.free_motion_files import free_motion_document, free_motion_text, write_free_motion

        let_go = model if carried is None else with_body(model, carried, at)
        freed = run_free(
            let_go, _one_of("--free", free, ("drop", "step", "free")), duration=duration or 3.0, start=_numbers("--start", start) or None
        )
        files = write_free_motion(out or Path("free.csv"), freed)
        _answer(as_json, lambda: free_motion_document(freed, files), lambda: free_motion_text(freed) + _listed(files))
        return
    moved = read_motion(motion, model) if motion is not None else random_fourier(model, rng=seed, duration=duration or 20.0)
    if engine == "mujoco":
        from asbuilt.experiment.virtual_robot import VirtualRobot

        virtual = VirtualRobot.preset(preset, model, rng=seed, tool=carried, at=at)
        with _progress() as report:
            simulated = virtual.logging(rate).record(moved, rng=seed, progress=lambda fraction: report("move", fraction))
    else:
        if preset == "factory":
            raise UsageError("--engine inverse-dynamics knows no preset 'factory'; it has ideal and lab")
        machine = InstalledRobot.typical(model, rng=seed) if preset == "lab" else InstalledRobot.ideal(model)
        simulated = (machine if carried is None else machine.with_tool(carried, at)).record(moved, rate or 1000.0, rng=seed)
    files = write_simulation(out or Path("recording.csv"), simulated)
    _answer(as_json, lambda: simulate_document(simulated, files), lambda: "; ".join(simulated.recording.notes) + _listed(files))


@app.command()
def view(
    robot: Annotated[
        str,
        typer.Argument(metavar="ROBOT|RESULT", help="a bundled robot, a robot file, or a result.json that `asbuilt identify --out` wrote"),
    ],
    motion: Annotated[Path | None, typer.Argument(metavar="[MOTION]", help="motion or recording as CSV (t, q_*, ...) to play")] = None,
    save: Annotated[
        Path | None,
        typer.Option(
            "--save", metavar="FILE", help="write a page of its own (.html), a picture (.png) or an animation (.gif .webp) instead"
        ),
    ] = None,
    style: Annotated[
        str, typer.Option("--style", metavar="NAME", help="of pictures: auto, rendered (MuJoCo, OpenGL) or skeleton")
    ] = "auto",
    port: Annotated[int, typer.Option("--port", help="port of the page, the next free one where it is taken")] = 8080,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="open the page in a browser")] = True,
    as_json: AsJson = False,
) -> None:
    """Show the robot in 3-D in the browser, with frames, centres of mass and inertia ellipsoids; Ctrl-C ends it."""
    from asbuilt.excitation.motion_csv import read_motion
    from asbuilt.writers.files import atomic_write

    model = _load_built(robot)
    moved = None if motion is None else read_motion(motion, model)
    about = {"robot": model.name, "duration": None if moved is None else moved.duration}
    if save is not None and save.suffix.lower() != ".html":
        from asbuilt.writers.animation import write_picture

        with _progress() as report:
            written = write_picture(
                save,
                model,
                moved,
                style=_one_of("--style", style, ("auto", "rendered", "skeleton")),
                progress=lambda done: report("draw", done),
            )
        _answer(as_json, lambda: {**about, "files": {"picture": str(written)}}, lambda: _listed({"picture": written}))
        return
    from asbuilt.writers.viewer import Viewer

    page = Viewer(model, moved, port=port)
    try:
        if save is not None:
            files = {"page": atomic_write(save, page.page().encode())}
            _answer(as_json, lambda: {**about, "files": _texts(files)}, lambda: _listed(files))
            return
        _answer(as_json, lambda: {**about, "url": page.url}, lambda: f"{model.name} at {page.url}; Ctrl-C ends it")
        if browser:
            import webbrowser

            webbrowser.open(page.url)
        with suppress(KeyboardInterrupt):
            page.serve()
    finally:
        page.close()


@app.command()
def reproduce(out: Out = None, as_json: AsJson = False) -> None:
    """Redo the 2015 paper that asbuilt grew from, table by table and figure by figure."""
    from asbuilt.reproduce import reproduce as redo
    from asbuilt.reproduce_tables import reproduction_document, reproduction_text, write_reproduction

    with _progress() as report:
        redone = redo(progress=report)
        files = write_reproduction(out, redone) if out is not None else {}
    _answer(as_json, lambda: reproduction_document(redone, files), lambda: reproduction_text(redone) + _listed(files))


@app.command()
def demo(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="folder for the files to write")] = Path("asbuilt-demo"),
    as_json: AsJson = False,
) -> None:
    """Run the whole story on bundled data: move, record, identify, validate, compare, export, report."""
    from asbuilt.demo import demo_document, demo_text, run_demo

    with _progress() as report:
        story = run_demo(out, progress=report)
    _answer(as_json, lambda: demo_document(story), lambda: demo_text(story))


def _result(path: Path) -> IdentificationResult:
    from asbuilt.identification.result import IdentificationResult

    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as problem:
        raise ResultError(
            f"{path} cannot be read as a result ({problem}); give the result.json that `asbuilt identify --out DIR` writes"
        ) from None
    return IdentificationResult.from_json(text)


def _load_built(robot: str) -> RobotModel:
    """Return a described robot, or an identified one as built where a result is given."""
    if Path(robot).suffix.lower() != ".json":
        return _load(robot)
    from asbuilt.writers.robot_toml import as_built_model

    return as_built_model(_result(Path(robot)))


def _chain(preset: str, cutoff: float | None, decimate: int | None) -> SignalChain:
    from dataclasses import replace

    from asbuilt.experiment.signal_chain import SignalChain

    chain = SignalChain.preset(preset)
    return replace(chain, cutoff=cutoff or chain.cutoff, decimate=decimate or chain.decimate)


def _cutoff(text: str | None) -> float | None:
    return None if text is None else _positive("--cutoff", text)


def _one_of(option: str, value: str, known: Mapping[str, Any] | Sequence[str]) -> Any:
    if value not in known:
        raise UsageError(f"{option} {value!r} is not one of {', '.join(known)}")
    return known[value] if isinstance(known, Mapping) else value


def _numbers(option: str, text: str | None) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in (text or "").split(",") if part.strip())
    except ValueError:
        raise UsageError(f"{option} takes numbers separated by commas, got {text!r}") from None


def _positive(option: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < float("inf"):
        raise UsageError(f"{option} takes a positive number, got {text!r}")
    return value


def _texts(files: Mapping[str, Path]) -> dict[str, str]:
    return {kind: str(path) for kind, path in files.items()}


def _listed(files: Mapping[str, Path]) -> str:
    lines = [f"  {kind:<11} {path}" for kind, path in files.items()]
    return "\n".join(["", "", "written:", *lines]) if lines else ""


if __name__ == "__main__":
    main()
