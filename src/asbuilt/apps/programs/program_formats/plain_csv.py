"""Plain CSV: the motion as a table, for any other controller."""

from __future__ import annotations

from asbuilt.apps.programs.format import (
    PROGRAM_FORMATS,
    ProgramFile,
    ProgramFormat,
    ProgramRequest,
)
from asbuilt.apps.programs.wording import (
    GAINS_TO_FILL_IN,
    compose_preamble,
    format_motion_csv,
    format_sheet,
)
from asbuilt.excitation import PREFIXES

DECIMALS = 9
"""Decimals of positions, velocities and accelerations."""


class CsvFormat(ProgramFormat):
    """`t, q_<joint>..., qd_<joint>..., qdd_<joint>...` in SI units, one line per sample.

    Asbuilt reads it back as a motion.
    """

    key = "csv"
    title = "Motion table (CSV)"
    default_rate = 250.0

    def files(self, request: ProgramRequest) -> tuple[ProgramFile, ...]:
        """Return both tables at the same rate, notes and a sheet.

        At one rate the dry run is slow even if lines are played one per cycle.
        """
        stem = request.stem
        use = (
            (
                f"{stem}.csv and {stem}_dry_run.csv have the columns t [s], q_ [rad or m], qd_ [per"
                f" s], qdd_ [per s^2] for each joint, at {request.rate:g} Hz."
            ),
            (
                "Move to the pose of the first line slowly, check that the robot is there, play the"
                " dry run to its end, and only then the motion."
            ),
            (
                f"Record time, positions and torques (or currents) into {stem}_log.csv as"
                f" {stem}_log.toml says, or change the sheet to what you recorded: asbuilt identify"
                f" ROBOT {stem}_log.csv"
            ),
        )
        names = request.model.joint_names
        sheet = format_sheet(
            request,
            (
                (
                    "A proposal: adapt names of columns, units and sign to your log, or"
                    " log like this. torque_source is sensor, motor or current (then gains in N"
                    " m/A); sign = -1 where the log gives what the link exerts on the drive."
                ),
            ),
            {
                "joints": list(names),
                "torque_source": "unknown",
                "sign": 1,
                "columns": {
                    "time": "t",
                    "position": [f"q_{name}" for name in names],
                    "torque": [f"tau_{name}" for name in names],
                },
                "units": (
                    {"time": "s"}
                    | ({"position": "rad", "torque": "N m"} if all(request.revolute) else {})
                ),
            },
            gains=f"Where the torques are currents (then units.torque is A): {GAINS_TO_FILL_IN}:",
        )
        columns = [prefix + name for prefix in PREFIXES for name in names]
        full, slow = (
            format_motion_csv(motion, columns, request.rate, DECIMALS)
            for motion in (request.motion, request.dry_run)
        )
        return (
            ProgramFile("program", f"{stem}.csv", full),
            ProgramFile("dry_run", f"{stem}_dry_run.csv", slow),
            ProgramFile(
                "notes",
                f"{stem}_notes.txt",
                "\n".join(compose_preamble(request, self.title, use)) + "\n",
            ),
            ProgramFile("sheet", f"{stem}_log.toml", sheet),
        )


PROGRAM_FORMATS.register(CsvFormat.key, CsvFormat())
