"""ROS 2: the motion as a JointTrajectory, and a script that runs it and records a bag."""

from __future__ import annotations

from asbuilt.apps.programs.format import (
    DRY_RUN_SLOWDOWN,
    PROGRAM_FORMATS,
    ProgramFile,
    ProgramFormat,
    ProgramRequest,
)
from asbuilt.apps.programs.program_formats.plain_csv import DECIMALS
from asbuilt.apps.programs.wording import (
    GAINS_TO_FILL_IN,
    comment_lines,
    compose_preamble,
    format_numbers,
    format_sheet,
    render,
)
from asbuilt.excitation import Motion, times_to_end
from asbuilt.writers import quote_yaml


class Ros2Format(ProgramFormat):
    """Points with position, velocity and acceleration; the controller interpolates by quintics."""

    key = "ros2"
    title = "ROS 2 joint trajectory"
    default_rate = 50.0

    def files(self, request: ProgramRequest) -> tuple[ProgramFile, ...]:
        """Return both trajectories, the script and the sheet of the bag."""
        stem = request.stem
        full = f"{stem}.yaml"
        dry_run = f"{stem}_dry_run.yaml"
        use = (
            (
                "Start the robot's driver with a joint_trajectory_controller (position or effort),"
                f" then: python3 {stem}_run.py --controller /NAME_OF_THE_CONTROLLER. It asks, moves"
                " to the start pose, asks again, records /joint_states into a bag and does the dry"
                " run."
            ),
            (
                f"When the dry run reached its end: python3 {stem}_run.py --controller"
                " /NAME_OF_THE_CONTROLLER --full. Ctrl-C cancels the motion; the emergency stop"
                " stops the robot."
            ),
            f"The bag is {stem}_bag, its sheet {stem}_bag.toml: asbuilt identify ROBOT {stem}_bag",
        )
        head = compose_preamble(request, self.title, use)
        yaml_head = comment_lines(head, "#") + "\n"
        script = render(
            "ros2_run.py.j2",
            preamble="\n".join(head),
            full=full,
            dry_run=dry_run,
            approach=format_numbers(request.approach_speed),
            tolerance=", ".join(f"{tolerance:g}" for tolerance in request.start_tolerance),
            bag=f"{stem}_bag",
            dry_run_bag=f"{stem}_dry_run_bag",
        )
        names = request.model.joint_names
        sheet = format_sheet(
            request,
            (
                (
                    "What the driver publishes as effort differs: torque of a sensor (sensor), of"
                    " the motor (motor), or its current (current, with gains in N m/A). Universal"
                    " Robots' driver publishes currents. KUKA's measured torques have the opposite"
                    " sign (sign = -1)."
                ),
                (
                    "Set torque_source, sign and gains to what yours does; `asbuilt check` finds"
                    " a wrong sign or scale."
                ),
            ),
            {
                "joints": list(names),
                "topic": "/joint_states",
                "torque_source": "unknown",
                "sign": 1,
            },
            gains=f"Where the effort is a current: {GAINS_TO_FILL_IN}:",
        )
        return (
            ProgramFile("program", f"{stem}_run.py", script, executable=True),
            ProgramFile(
                "motion",
                full,
                yaml_head + format_trajectory_yaml(request.motion, names, request.rate),
            ),
            ProgramFile(
                "dry_run",
                dry_run,
                yaml_head
                + format_trajectory_yaml(request.dry_run, names, request.rate / DRY_RUN_SLOWDOWN),
            ),
            ProgramFile("sheet", f"{stem}_bag.toml", sheet),
        )


def format_trajectory_yaml(motion: Motion, joint_names: tuple[str, ...], rate: float) -> str:
    """Return the fields of a trajectory_msgs/JointTrajectory as YAML.

    The end of the motion is the last point whatever the rate.
    """
    t = times_to_end(motion, rate)
    lines = [f"joint_names: [{', '.join(map(quote_yaml, joint_names))}]", "points:"]
    for time, q, qd, qdd in zip(t, *motion.at(t), strict=True):
        nanoseconds = round(float(time) * 1e9)
        lines += [
            f"- positions: [{format_numbers(q, DECIMALS)}]",
            f"  velocities: [{format_numbers(qd, DECIMALS)}]",
            f"  accelerations: [{format_numbers(qdd, DECIMALS)}]",
            f"  time_from_start: {{sec: {nanoseconds // 10**9}, nanosec: {nanoseconds % 10**9}}}",
        ]
    return "\n".join(lines) + "\n"


PROGRAM_FORMATS.register(Ros2Format.key, Ros2Format())
