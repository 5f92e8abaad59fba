"""Commands that design a motion and bring it to a controller."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from asbuilt.cli.answers import answer, listed_files, progress_bar
from asbuilt.cli.options import (
    AsJson,
    Robot,
    Seed,
    described_robot,
    number_list,
    positive_number,
    read_result,
    refuse_idle,
    writable_file,
    writable_folder,
)
from asbuilt.errors import UsageError

if TYPE_CHECKING:
    from asbuilt.description.model import RobotModel
    from asbuilt.excitation.design.multistart import SearchProgress
    from asbuilt.excitation.motions.motion import Motion


def excite(
    robot: Robot,
    drive: Annotated[
        str | None,
        typer.Option(
            "--drive",
            metavar="LIST",
            help=(
                "drive terms to identify (see asbuilt drives), or none (default:"
                " viscous,coulomb,offset)"
            ),
        ),
    ] = None,
    duration: Annotated[
        str,
        typer.Option(
            "--duration", metavar="S", help="length of the motion, or auto (see --precision)"
        ),
    ] = "20",
    parametrisation: Annotated[
        str,
        typer.Option(
            "--parametrisation", metavar="KIND", help="fourier, bspline, quintic or point-to-point"
        ),
    ] = "fourier",
    harmonics: Annotated[
        int | None,
        typer.Option(
            "--harmonics",
            metavar="N",
            help="harmonics, or control or way points (default: by duration and limits)",
        ),
    ] = None,
    criterion: Annotated[
        str, typer.Option("--criterion", metavar="NAME", help="d, a, e or condition")
    ] = "d",
    focus: Annotated[
        str | None,
        typer.Option(
            "--focus", metavar="LIST", help="names or ids of the base parameters that matter"
        ),
    ] = None,
    given: Annotated[
        Path | None,
        typer.Option(
            "--given",
            metavar="RESULT",
            help="an earlier result: find what it left open, with its noise and drive terms",
        ),
    ] = None,
    noise: Annotated[
        str | None,
        typer.Option(
            "--noise",
            metavar="S1,S2,...",
            help="standard deviation of the torque, one or one per joint",
        ),
    ] = None,
    static: Annotated[
        int | None,
        typer.Option(
            "--static",
            metavar="K",
            help="no motion: the best K poses to stand still in, for gravity alone",
        ),
    ] = None,
    precision: Annotated[
        float | None,
        typer.Option(
            "--precision",
            metavar="SHARE",
            help=(
                "with --duration auto: torque error per parameter, as share of the torque (default:"
                " 0.002)"
            ),
        ),
    ] = None,
    periods: Annotated[
        int | None,
        typer.Option(
            "--periods",
            metavar="N",
            help="repeat a Fourier series so often within the duration (default: by duration)",
        ),
    ] = None,
    collision: Annotated[
        str | None,
        typer.Option(
            "--collision",
            metavar="SOURCE",
            help="keep bodies apart: skeleton[:RADIUS], a .urdf with geometry, or a .toml file",
        ),
    ] = None,
    tool_box: Annotated[
        str | None,
        typer.Option(
            "--tool-box",
            metavar="X0,X1,Y0,Y1,Z0,Z1",
            help="keep the tool in this box of the root frame [m]",
        ),
    ] = None,
    tool_frame: Annotated[
        str | None,
        typer.Option("--tool-frame", metavar="NAME", help="the frame that stays in the box"),
    ] = None,
    power: Annotated[
        str | None,
        typer.Option(
            "--power",
            metavar="P1,P2,...",
            help="mechanical power allowed, one or one per joint [W]",
        ),
    ] = None,
    fraction: Annotated[
        float, typer.Option("--fraction", help="how much of the limits of motion may be used")
    ] = 0.95,
    torque_fraction: Annotated[
        float, typer.Option("--torque-fraction", help="how much of the torque limits may be used")
    ] = 0.8,
    perturbed: Annotated[
        int,
        typer.Option(
            "--perturbed",
            metavar="N",
            min=0,
            help="hold the torque limit for N other robots, masses 10 % off",
        ),
    ] = 0,
    starts: Annotated[
        int, typer.Option("--starts", metavar="N", help="random starts of local searches")
    ] = 96,
    time_limit: Annotated[
        float,
        typer.Option(
            "--time-limit",
            metavar="S",
            help="have the design ready after this time, with the best found by then",
        ),
    ] = 24.0,
    seed: Seed = 0,
    rate: Annotated[
        float, typer.Option("--rate", metavar="HZ", help="rate of the motion file")
    ] = 1000.0,
    program: Annotated[
        list[str] | None,
        typer.Option(
            "--program",
            metavar="FORMAT",
            help="program for a controller beside it: see `asbuilt program`",
        ),
    ] = None,
    out: Annotated[
        Path,
        typer.Option("--out", metavar="FILE", help="motion file to write", callback=writable_file),
    ] = Path("motion.csv"),
    as_json: AsJson = False,
) -> None:
    """Design the most informative motion within the limits of a robot, and say how near it comes to
    the best there could be.
    """
    from asbuilt.dynamics.drives.selection import DriveSet
    from asbuilt.excitation.collision.constraint import watched
    from asbuilt.excitation.design.design import USUAL_DRIVE, design_motion
    from asbuilt.excitation.design.options import DesignOptions
    from asbuilt.excitation.design.precision import USUAL_PRECISION, design_for_precision
    from asbuilt.excitation.design.static_poses import design_static_poses
    from asbuilt.identification.information.known_information import known_information
    from asbuilt.writers.programs.registry import program_format
    from asbuilt.writers.tables.design_tables import (
        excite_document,
        excite_text,
        static_document,
        static_text,
        write_design,
    )

    if not 0.0 < rate < math.inf:
        raise UsageError(f"--rate takes a positive number of Hz, got {rate:g}")
    of_motions = {
        "--parametrisation": parametrisation != "fourier",
        "--harmonics": harmonics is not None,
        "--criterion": criterion != "d",
        "--focus": focus is not None,
        "--periods": periods is not None,
        "--power": power is not None,
        "--perturbed": perturbed != 0,
        "--drive": drive is not None,
    }
    if static is not None:
        refuse_idle(
            "--static chooses poses for what gravity tells, all of it, and these options are for"
            " motions",
            of_motions,
        )
    if duration != "auto":
        refuse_idle(
            "--precision is what --duration auto aims at", {"--precision": precision is not None}
        )
    if given is not None:
        refuse_idle(
            "--given brings the drive terms of the earlier result", {"--drive": drive is not None}
        )
    if tool_box is None:
        refuse_idle(
            "--tool-frame says what stays in --tool-box", {"--tool-frame": tool_frame is not None}
        )
    model, drives, prior = (
        described_robot(robot),
        USUAL_DRIVE if drive is None else DriveSet.parse(drive or "none"),
        None,
    )
    sigma = number_list("--noise", noise) or (1.0,)
    if given is not None:
        known = read_result(given)
        if known.model.joint_names != model.joint_names:
            raise UsageError(f"{given} belongs to {known.robot}, not to {model.name}")
        model, drives, prior = known.model, known.base.drive, known_information(known)
        sigma = number_list("--noise", noise) or tuple(known.sigma.tolist())
    for form in program or ():
        program_format(form, model, "point-to-point" if static is not None else parametrisation)
    constraints = watched(
        model,
        collision=collision,
        tool_box=number_list("--tool-box", tool_box),
        tool_frame=tool_frame,
    )
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
        files = write_design(out, standing, rate) | _programs(
            model, standing.motion, program, out, collision
        )
        answer(
            as_json,
            lambda: static_document(standing, files),
            lambda: static_text(standing) + listed_files(files),
        )
        return
    options = DesignOptions(
        parametrisation=parametrisation,
        size=harmonics,
        duration=20.0 if duration == "auto" else positive_number("--duration", duration),
        periods=periods,
        criterion=criterion,
        focus=tuple(name for name in (focus or "").split(",") if name.strip()),
        noise=sigma[0] if len(sigma) == 1 else sigma,
        fraction=fraction,
        torque_fraction=torque_fraction,
        power=number_list("--power", power),
        perturbed=perturbed,
        starts=starts,
        seed=seed,
        time_limit=time_limit,
    )
    with progress_bar() as report:

        def progress(state: SearchProgress) -> None:
            report(
                (
                    f"{state.phase}: best {state.best:.2f}"
                    if math.isfinite(state.best)
                    else state.phase
                ),
                state.share,
            )

        if duration == "auto":
            design, trials = design_for_precision(
                model,
                drives,
                options,
                USUAL_PRECISION if precision is None else precision,
                prior=prior,
                constraints=constraints,
                progress=progress,
            )
        else:
            design, trials = (
                design_motion(
                    model, drives, options, prior=prior, constraints=constraints, progress=progress
                ),
                (),
            )
        files = write_design(out, design, rate) | _programs(
            model, design.motion, program, out, collision
        )
    answer(
        as_json,
        lambda: excite_document(design, files, trials),
        lambda: excite_text(design, trials) + listed_files(files),
    )


def _programs(
    model: RobotModel, motion: Motion, forms: Sequence[str] | None, out: Path, collision: str | None
) -> dict[str, Path]:
    """Write the programs of a motion into folders beside its file."""
    from asbuilt.writers.programs.program_files import write_program
    from asbuilt.writers.programs.registry import make_program

    files: dict[str, Path] = {}
    for form in forms or ():
        written = write_program(
            out.with_name(f"{out.stem}_{form}"),
            make_program(model, motion, form, name=out.stem, collision=collision),
        )
        files |= {f"{form}_{role}": path for role, path in written.items()}
    return files


def program(
    robot: Robot,
    motion: Annotated[
        Path,
        typer.Argument(
            metavar="MOTION", help="motion CSV (t, q_*, ...), as `asbuilt excite` writes it"
        ),
    ],
    form: Annotated[
        str,
        typer.Option(
            "--format", metavar="FORMAT", help="sunrise, fri, ros2, urscript, franka or csv"
        ),
    ],
    rate: Annotated[
        float | None,
        typer.Option(
            "--rate", metavar="HZ", help="rate of points or recording (default: what suits)"
        ),
    ] = None,
    name: Annotated[
        str | None,
        typer.Option("--name", help="name of the motion and its files (default: the file's)"),
    ] = None,
    collision: Annotated[
        str | None,
        typer.Option(
            "--collision",
            metavar="SOURCE",
            help="say how near bodies come, and refuse a motion on which they touch: as for excite",
        ),
    ] = None,
    out: Annotated[
        Path,
        typer.Option(
            "--out", metavar="DIR", help="folder for the files to write", callback=writable_folder
        ),
    ] = Path("program"),
    as_json: AsJson = False,
) -> None:
    """Write a program that makes a real controller run a motion and record it, slow dry run first."""
    from asbuilt.excitation.motions.motion_csv import read_motion
    from asbuilt.writers.programs.program_files import program_document, program_text, write_program
    from asbuilt.writers.programs.registry import program_format, program_request

    model = described_robot(robot)
    chosen = program_format(form, model)
    request = program_request(
        model,
        read_motion(motion, model),
        form,
        name=name or motion.stem,
        rate=rate,
        collision=collision,
    )
    files = write_program(out, chosen.files(request))
    answer(
        as_json,
        lambda: program_document(request, form, files),
        lambda: program_text(request, form) + listed_files(files),
    )
