"""What a ledger holds: robots, their logs and types."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from asbuilt.findings import Finding, ranked
from asbuilt.workflow.fleet.ledger.ledger import Ledger, open_ledger
from asbuilt.workflow.fleet.ledger.settings import TypeSettings
from asbuilt.workflow.fleet.suspicions import suspicions


@dataclass(frozen=True, slots=True)
class RobotRow:
    """Hold what a ledger has of a robot: `first` and `last` are the dates of its logs."""

    id: str
    robot_type: str
    n_logs: int
    first: str
    last: str
    seconds: float | None = None
    n_samples: int | None = None


@dataclass(frozen=True, eq=False)
class Overview:
    """Hold what a ledger holds."""

    ledger: str
    robots: tuple[RobotRow, ...]
    types: tuple[TypeSettings, ...]
    findings: tuple[Finding, ...]

    def as_document(self) -> dict[str, Any]:
        """Return it as plain data."""
        return {
            "ledger": self.ledger,
            "robots": [asdict(each) for each in self.robots],
            "types": [
                {
                    "type": each.robot_type,
                    "robot": each.model.name,
                    "settings": each.digest,
                    "generation": each.generation,
                    "joints": list(each.model.joint_names),
                    "drive": str(each.drive),
                    "cutoff": each.chain.cutoff,
                    "torque_source": each.torque_source,
                    "n_base": each.base.n_base,
                    "chosen": list(each.chosen),
                }
                for each in self.types
            ],
            "warnings": [{"code": each.code, "message": each.text} for each in self.findings],
            "findings": [each.as_dict() for each in self.findings],
        }


def fleet_overview(ledger: Ledger | str | Path, *, thorough: bool = False) -> Overview:
    """Return what a ledger holds.

    Parameters
    ----------
    ledger
        A ledger, its folder or URL.
    thorough
        Read every entry: durations, damaged files, logs that do not fit their robot.

    Raises
    ------
    UsageError
        If there is no ledger.
    """
    opened = ledger if isinstance(ledger, Ledger) else open_ledger(str(ledger))
    types = opened.types()
    rows, said = [], []
    for robot_id in opened.robot_ids():
        names = opened.current_names(robot_id, types=types)
        if not names:
            continue
        row = RobotRow(
            id=robot_id,
            robot_type=names[-1][1].robot_type,
            n_logs=len(names),
            first=names[0][0].date.isoformat(),
            last=names[-1][0].date.isoformat(),
        )
        if thorough:
            entries = [e for e in (opened.read(*each) for each in names) if e is not None]
            row = RobotRow(
                row.id,
                row.robot_type,
                len(entries),
                row.first,
                row.last,
                sum(entry.duration for entry in entries),
                sum(entry.information.n_samples for entry in entries),
            )
            said += suspicions(opened, robot_id)
        rows.append(row)
    return Overview(
        opened.root, tuple(rows), tuple(types.values()), ranked([*said, *opened.findings])
    )
