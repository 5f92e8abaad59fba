"""Design of the most informative motion that a robot may make."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence

from asbuilt.arrays import Array
from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.description.structure.free_base import refuse_free_base
from asbuilt.dynamics.base.base_parameters import BaseParameters, find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.excitation.collision.constraint import constraints_of
from asbuilt.excitation.design.designed_motion import Design
from asbuilt.excitation.design.fixed_duration import design_fixed
from asbuilt.excitation.design.multistart import SearchProgress
from asbuilt.excitation.design.options import DesignOptions
from asbuilt.excitation.design.precision import design_for_precision
from asbuilt.excitation.limits import refuse_open_postures
from asbuilt.excitation.state_constraint import StateConstraint


def design_motion(
    robot: RobotModel | str | os.PathLike[str],
    options: DesignOptions | None = None,
    *,
    base: BaseParameters | None = None,
    prior: Array | None = None,
    constraints: Sequence[StateConstraint] = (),
    with_bound: bool = True,
    cores: int | None = None,
    scheduler: str | None = None,
    progress: Callable[[SearchProgress], None] | None = None,
) -> Design:
    """Return the most informative motion that several local searches find within the limits.

    A keyboard interrupt ends the search or the refinement and keeps the best motion so far.

    Parameters
    ----------
    robot
        Robot, name of a bundled robot, or path of a description.
    options
        Configuration; its time limit covers bounds, search and refinement.
    base
        Base parameters to determine; by default those of `options.drive`.
    prior
        Information (p, p) about the base parameters from earlier recordings.
    constraints
        Constraints besides those of the options.
    with_bound
        Whether to bound the information of all motions, for `Design.d_efficiency`.
    cores
        Number of processes that search, this one included; by default one for each core. The
        motion is the same for any number unless the time limit ends the search.
    scheduler
        Address of a Dask scheduler, such as `tcp://10.0.0.1:8786`, whose workers search besides
        this process.
    progress
        Called with the state of the search.

    Returns
    -------
    Design
        The motion, its margins to the limits, and predicted standard errors.

    Raises
    ------
    MotionError
        If no motion within the constraints is found, or none determines all parameters.
    UsageError
        If an option names something unknown.

    Examples
    --------
    >>> options = DesignOptions(duration=4.0, size=3, starts=1, drive="viscous")
    >>> design = design_motion("two-link", options, with_bound=False)
    >>> design.limits.is_respected, design.motion.duration
    (True, 4.0)
    """
    model = robot if isinstance(robot, RobotModel) else load_robot(robot)
    refuse_open_postures(model)
    refuse_free_base(
        model.name,
        model.n_floating,
        "a motion on which it keeps its balance is not designed; squat, twist the trunk and lift"
        " single legs",
    )
    asked = options or DesignOptions()
    kept = constraints_of(
        model, collision=asked.collision, tool_box=asked.tool_box, tool_frame=asked.tool_frame
    )
    design = design_for_precision if asked.duration == "auto" else design_fixed
    return design(
        model,
        base or find_base_parameters(model, DriveSet.parse(asked.drive)),
        asked,
        prior=prior,
        constraints=(*kept, *constraints),
        with_bound=with_bound,
        cores=cores,
        scheduler=scheduler,
        progress=progress,
    )
