"""What the commands share: the types of their options, and how they read what these name."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from filecmp import cmp
from glob import escape, glob
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

import asbuilt
from asbuilt import UsageError, writers
from asbuilt.cli.arguments.spread import find_given_options
from asbuilt.description.load import HELD_BASE
from asbuilt.ranges import Range, make_range_error, option
from asbuilt.writing import check_replaceable, check_writable

if TYPE_CHECKING:
    from asbuilt import StudyOptions
    from asbuilt.executor import Workers
    from asbuilt.experiment.logs.long_recordings import RecordingStream

POSITIVE = Range(1e-9, 1e9)
"""Positive numbers of options: frequencies, durations, masses."""
DELAYS = Range(-10.0, 10.0, "s")
"""Delays of a torque; the search of one looks no further than a part of a second."""


def refuse_both(processes: int | None, scheduler: str | None) -> None:
    """Raise `UsageError` if `--workers` and `--scheduler` are both given."""
    if processes is not None and scheduler is not None:
        raise UsageError(
            "--workers and --scheduler exclude each other; start as many Dask workers as you want"
        )


@dataclass(frozen=True)
class Sharing:
    """The options that share work among processes."""

    workers: int | None = option(
        None,
        "N",
        "processes that share the work (default: this one)",
        typer={"min": 1, "max": 1024},
    )
    scheduler: str | None = option(
        None, "ADDRESS", "Dask scheduler whose workers share the work, such as tcp://10.0.0.1:8786"
    )

    @contextmanager
    def open(self) -> Iterator[Workers | None]:
        """Yield the workers that are asked for, None without any."""
        if self.workers is None and self.scheduler is None:
            yield None
            return
        refuse_both(self.workers, self.scheduler)
        with asbuilt.open_workers(self.workers, self.scheduler) as workers:
            yield workers

    def refuse(self, why: str) -> None:
        """Raise `UsageError`, saying why, if work that one process does is to be shared."""
        refuse_idle(why, find_given_options(self))


def require_writable_folder(folder: Path | None) -> Path | None:
    """Return a folder that can be written to or made.

    Raises `UsageError` before any work is done otherwise.
    """
    if folder is not None:
        check_writable(folder)
    return folder


def require_writable_file(file: Path | None) -> Path | None:
    """Return a file that can be written or replaced.

    Raises `UsageError` before any work is done otherwise.
    """
    if file is not None:
        require_writable_folder(file.parent)
        check_replaceable(file)
    return file


def complete_robot(incomplete: str) -> list[str]:
    """Return the bundled robots that a shell may complete a text to, else files.

    >>> complete_robot("ur")
    ['ur10e']
    """
    named = [name for name in asbuilt.robot_names() if name.startswith(incomplete)]
    return named or sorted(glob(f"{escape(incomplete)}*"))


Robot = Annotated[
    str,
    typer.Argument(
        metavar="ROBOT",
        autocompletion=complete_robot,
        help="a bundled robot (see `asbuilt robots`) or a .urdf, .xml, .toml or .csv file",
    ),
]
RobotOrResult = Annotated[
    str,
    typer.Argument(
        metavar="ROBOT|RESULT",
        autocompletion=complete_robot,
        help="a bundled robot, a robot file, or a result.json that `asbuilt identify --out` wrote",
    ),
]
Logs = Annotated[
    list[Path],
    typer.Argument(metavar="LOG...", help="recordings: .csv .parquet .npz .mat .h5 or ROS 2 bags"),
]
RESULT_HELP = "a result.json that `asbuilt identify --out` wrote, or its folder"
Result = Annotated[Path, typer.Argument(metavar="RESULT", help=RESULT_HELP)]
Seed = Annotated[int, typer.Option("--seed", metavar="N", min=0, help="seed of everything random")]
AsJson = Annotated[
    bool, typer.Option("--json", help="print one JSON document on stdout and nothing else there")
]
PagePort = Annotated[
    int,
    typer.Option(
        "--port", metavar="N", min=0, max=65_535, help="port of the page, or the next free one"
    ),
]
Browser = Annotated[bool, typer.Option("--browser/--no-browser", help="open the page in a browser")]
Full = Annotated[bool, typer.Option("--full", help="print all rows and notes whatever their width")]
FixedBase = Annotated[
    bool,
    typer.Option("--fixed-base", help=HELD_BASE),
]
OUT = ("--out", "-o")


def out_folder(text: str = "folder for the files to write") -> Any:
    """Return the option that names the folder of the files of a command."""
    return typer.Option(*OUT, metavar="DIR", help=text, callback=require_writable_folder)


def written_file(*names: str, metavar: str = "FILE", text: str) -> Any:
    """Return the option that names a file to write, `--out` without another name."""
    return typer.Option(*(names or OUT), metavar=metavar, help=text, callback=require_writable_file)


Out = Annotated[Path | None, out_folder()]
Judges = Annotated[
    list[Path] | None,
    typer.Option(
        "--validate",
        metavar="LOG",
        help="a recording to validate on; repeat for more",
    ),
]
Unchecked = Annotated[
    bool, typer.Option("--unchecked", help="use the recordings whatever their checks find")
]
Carrier = Annotated[
    str | None,
    typer.Option(
        "--frame",
        metavar="NAME",
        help="link or frame that carries the payload (default: the flange)",
    ),
]
Drive = Annotated[
    str | None,
    typer.Option(
        "--drive",
        metavar="LIST",
        help=(
            "terms such as armature,viscous,coulomb,stribeck:velocity=0.1 (see asbuilt drives),"
            " none, or for identify auto (auto,spring: chosen, with a spring)"
        ),
    ),
]


@dataclass(frozen=True)
class Filtering:
    """The options that choose the signal chain."""

    cutoff: str | None = option(
        None,
        "HZ",
        "low-pass cutoff, chosen from the recording by default; identify also takes"
        " auto: chosen by held-out torque",
    )
    decimate: int | None = option(
        None, "N", "keep every Nth sample after filtering", typer={"min": 1, "max": 100_000}
    )
    max_gap: float | None = option(
        None,
        "SECONDS",
        "longest pause that is bridged (default: what the low-pass does not resolve)",
    )
    delay: str | None = option(
        None,
        "SECONDS",
        "time by which torque is late against position, one number or one per joint;"
        " auto (the default): estimated; none",
    )
    preset: str = option("default", "NAME", "signal chain: default or paper2015 ")

    @property
    def given(self) -> dict[str, bool]:
        """Which of these options were given, by name."""
        return find_given_options(self)

    def chain(self) -> asbuilt.SignalChain:
        """Return the named signal chain, with the cutoff and decimation given."""
        chain = asbuilt.SignalChain.preset(self.preset)
        return replace(
            chain,
            cutoff=chain.cutoff
            if self.cutoff is None
            else parse_positive_number("--cutoff", self.cutoff),
            decimate=chain.decimate if self.decimate is None else self.decimate,
            max_gap=chain.max_gap
            if self.max_gap is None
            else parse_positive_number("--max-gap", str(self.max_gap)),
            delay=chain.delay if self.delay is None else parse_delay(self.delay),
        )

    def applied_to(self, options: StudyOptions) -> StudyOptions:
        """Return options of a study with this signal chain, whose cutoff "auto" is swept."""
        swept = self.cutoff == "auto"
        chain = replace(self, cutoff=None if swept else self.cutoff).chain()
        return replace(options, chain=chain, sweep_cutoff=swept)


def parse_delay(text: str) -> float | tuple[float, ...] | Literal["auto"] | None:
    """Return a delay as a signal chain takes it; raises `UsageError` on anything else."""
    word = text.strip().lower()
    if word in ("auto", "none"):
        return "auto" if word == "auto" else None
    try:
        values = parse_number_list("--delay", text)
    except UsageError:
        raise UsageError(
            f"--delay takes auto, none, or seconds (one number or one per joint), got {text!r}"
        ) from None
    for value in values:
        if not DELAYS.holds(value):
            raise make_range_error("--delay", value, DELAYS)
    return values[0] if len(values) == 1 else values


AS_IDENTIFIED = "the robot of a result is taken as it was identified"
"""Why options that change a robot as described do not go with a result."""


def is_result(path: str) -> bool:
    """Return whether a path is of a stored result, or of the folder of one, and no description."""
    return Path(path).suffix.lower() == ".json" or (Path(path) / "result.json").is_file()


def load_robot_as_built(robot: str, *, fixed_base: bool = False) -> asbuilt.RobotModel:
    """Return a described robot, or an identified one as built where a result is given."""
    if not is_result(robot):
        return asbuilt.load_robot(robot, fixed_base=fixed_base)
    refuse_idle(AS_IDENTIFIED, {"--fixed-base": fixed_base})
    return writers.as_built(asbuilt.read_result(Path(robot))).model


def parse_number_list(option: str, text: str | None, count: int | None = None) -> tuple[float, ...]:
    """Return the numbers of a list separated by commas, none where there is no text.

    Raises `UsageError` unless all are finite, and `count` of them.
    """
    if text is None:
        return ()
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = (math.nan,)
    if not all(abs(value) <= POSITIVE.upper for value in values) or len(values) != (
        count or len(values)
    ):
        example = ",".join(map(str, range(1, (count or 3) + 1)))
        raise UsageError(
            f"{option} takes {count or 'finite'} numbers separated by commas, got {text!r}; for"
            f" example {option} {example}"
        )
    return values


def parse_places(to: Sequence[str] | None) -> dict[str, Path]:
    """Return the file or folder of each format, from FORMAT=FILE; raises `UsageError` otherwise.

    >>> parse_places(["ur=arm.script"])["ur"].name
    'arm.script'
    """
    places: dict[str, Path] = {}
    for each in to or ():
        key, equals, place = each.partition("=")
        if not equals or not place:
            raise UsageError(f"--to takes FORMAT=FILE, got {each!r}", value=each)
        if key in places:
            raise UsageError(f"--to {key} is given twice", value=each)
        # Shells leave a ~ after FORMAT= as it is.
        places[key] = Path(os.path.expanduser(place))
    return places


def read_robot_and_recordings(
    model: asbuilt.RobotModel, reading: asbuilt.ReadingOptions, *logs: Sequence[Path] | None
) -> tuple[asbuilt.RobotModel, list[list[asbuilt.Recording | RecordingStream]]]:
    """Return a described robot as it was recorded, and its recordings, one list for each of `logs`.

    Joints that the recordings lack are locked, and what the options say of the robot is applied.
    """
    from asbuilt.experiment.logs.recordings import read_fitted_recordings

    return read_fitted_recordings(model, [log or [] for log in logs], reading)  # type: ignore[return-value]


def read_recordings_of_robot(
    model: asbuilt.RobotModel, logs: Sequence[Path] | None, reading: asbuilt.ReadingOptions
) -> list[asbuilt.Recording | RecordingStream]:
    """Return the recordings of an identified robot, none if no logs are given."""
    refuse_idle(
        AS_IDENTIFIED,
        {
            "--lock": reading.lock is not None,
            "--gravity": reading.gravity is not None,
            **find_given_options(reading.base),
        },
    )
    return asbuilt.as_recordings(model, logs or [], reading)  # type: ignore[return-value]


def require_distinct_logs(*groups: Sequence[Path] | None) -> None:
    """Raise `UsageError` where a log is given twice, in one place or in two, or as a copy.

    Counted twice it seems surer than it is, and it judges itself.
    """
    seen: list[Path] = []
    for path in (path for group in groups for path in group or ()):
        other = next((each for each in seen if _is_same_log(path, each)), None)
        if other is not None:
            what = "given twice" if os.path.realpath(path) == os.path.realpath(other) else (
                f"a copy of {other}"
            )  # fmt: skip
            raise UsageError(f"{path} is {what}; give every log once")
        seen.append(path)


def _is_same_log(path: Path, other: Path) -> bool:
    """Return whether two paths lead to one file, or to two of the same bytes."""
    if os.path.realpath(path) == os.path.realpath(other):
        return True
    if not (path.is_file() and other.is_file()):
        return False
    return path.stat().st_size == other.stat().st_size and cmp(path, other, shallow=False)


def refuse_idle(why: str, given: Mapping[str, bool]) -> None:
    """Raise `UsageError`, saying why, if options were `given` that would have no effect."""
    idle = [option for option, present in given.items() if present]
    if idle:
        raise UsageError(f"{why}; leave out {', '.join(idle)}")


def parse_positive_number(option: str, text: str) -> float:
    """Return a positive finite number; raises `UsageError` on anything else."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not POSITIVE.holds(value):
        raise UsageError(f"{option} takes a number {POSITIVE}, got {text[:60]!r}")
    return value


@dataclass(frozen=True)
class TimelineFiles:
    """The files in which a viewer shows measured and predicted torques over time."""

    mcap: Path | None = option(
        None,
        "FILE",
        "measured and predicted torques and events, for Foxglove and PlotJuggler",
        typer={"callback": require_writable_file, "autocompletion": None},
    )
    rrd: Path | None = option(
        None,
        "FILE",
        "the same with the moving robot, for rerun",
        typer={"callback": require_writable_file, "autocompletion": None},
    )

    def write(self, timelines: Callable[[], Sequence[writers.Timeline]]) -> dict[str, Path]:
        """Write the files that are asked for, and return their paths by kind."""
        if self.mcap is None and self.rrd is None:
            return {}  # what writes them takes long to import
        kinds = {"mcap": (self.mcap, writers.write_mcap), "rrd": (self.rrd, writers.write_rrd)}
        made = timelines()
        return {kind: write(path, made) for kind, (path, write) in kinds.items() if path}
