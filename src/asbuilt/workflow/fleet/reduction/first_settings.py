"""Settings of a robot type, fixed by its first log or by several when a ledger is made anew."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from asbuilt.description.model import RobotModel
from asbuilt.errors import UsageError
from asbuilt.experiment.logs.long_recordings import head_of
from asbuilt.experiment.logs.options import ReadingOptions
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.findings import Cure, joined
from asbuilt.identification.drives.drive_choice import settle_drive
from asbuilt.workflow.fleet.ledger.settings import TypeSettings, robot_type_of
from asbuilt.workflow.fleet.reduction.log_source import read_logs
from asbuilt.workflow.options import StudyOptions
from asbuilt.workflow.prepare import prepare


def choose_settings(
    described: RobotModel,
    logs: Sequence[Sequence[Path]],
    *,
    reading: ReadingOptions,
    options: StudyOptions,
    robot_type: str | None = None,
    generation: int = 0,
) -> TypeSettings:
    """Choose the signal chain and drive terms of a robot type from recordings.

    Parameters
    ----------
    described
        The robot as described.
    logs
        The files of each recording.
    reading, options
        How to read, and what is not left open; `drive`, `chain` and `checked` count.
    robot_type
        Name of the type, if it has one.
    generation
        Number of times that the type was made anew.

    Raises
    ------
    RecordingError
        If a recording cannot be read or used.
    UsageError
        If drive terms depend on the load, which differs from estimate to estimate.
    """
    model, read = read_logs(described, [path for files in logs for path in files], reading)
    prepared = prepare(
        model,
        read,
        chain=options.chain,
        checked=options.checked,
        tolerated=(),
        estimate_delay=head_of(read[0]).torque_source != "command",
    )
    choice = settle_drive(model, prepared.training, options.drive)
    if choice.drive.needs_load:
        raise UsageError(
            f"the drive terms {choice.drive} depend on the load, so that information of two logs"
            " does not merge",
            cure=Cure("leave these terms out", {"drive": "viscous,coulomb,offset"}),
        )
    chain = prepared.chain or SignalChain()
    names = joined([files[0].name for files in logs], most=3)
    cutoff = "" if chain.cutoff is None else f", cutoff {chain.cutoff:.3g} Hz"
    late = ", ".join(f"{1e3 * each:.3g}" for each in chain.delays)
    delay = f", torque {late} ms late" if late else ""
    return TypeSettings(
        robot_type=robot_type or robot_type_of(described),
        generation=generation,
        described=described,
        model=model,
        drive=choice.drive,
        chain=chain,
        torque_source=head_of(read[0]).torque_source,
        asked_drive=None if options.drive is None else str(options.drive),
        asked_chain=options.chain or SignalChain(),
        chosen=(
            f"drive terms {choice.drive}{cutoff}{delay}; chosen from {names}",
            *choice.sentences,
        ),
    )
