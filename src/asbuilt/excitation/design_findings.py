"""Findings about a designed motion: limits, collisions, undetermined parameters."""

from __future__ import annotations

import numpy as np

from asbuilt.excitation.collision.constraint import skeleton_distance
from asbuilt.excitation.design.designed_motion import Design
from asbuilt.excitation.design.static_poses import StaticDesign
from asbuilt.excitation.motions.motion import JUMPING
from asbuilt.findings import Cure, Finding, join_names, rank_findings


def design_findings(design: Design | StaticDesign) -> tuple[Finding, ...]:
    """Return the findings about a designed motion or static poses, the most severe first."""
    found = [
        Finding("limit_violated", "error", str(margin), joint=margin.joint, time=margin.time)
        for margin in design.limits.violations
    ]
    found.append(_report_collisions(design))
    found += [
        Finding("design_note", "warning" if note.startswith("NOT CHECKED") else "info", note)
        for note in design.notes
    ]
    found += _report_motion(design) if isinstance(design, Design) else _report_poses(design)
    return rank_findings(found)


def _report_collisions(design: Design | StaticDesign) -> Finding:
    distance = design.collision_distance
    if distance is not None:
        text = f"smallest distance between bodies {1000 * distance:.0f} mm"
        return Finding("smallest_distance", "info", text)
    text = "NOT CHECKED FOR COLLISIONS with itself, the floor or anything else"
    # Rate at which the skeleton of an unchecked motion is tested for collisions [Hz].
    poses = design.motion.derivative(design.motion.sample_times(100.0))
    own = skeleton_distance(design.model, poses)
    if own is not None:
        verb = "overlaps itself by" if own < 0 else "keeps this distance from itself:"
        text += f"; the robot's skeleton, as capsules, {verb} {abs(1000 * own):.0f} mm"
    cure = Cure("check them in the design", {"collision": "skeleton"})
    return Finding("collisions_unchecked", "warning", text, cure)


def _report_motion(design: Design) -> list[Finding]:
    undetermined = np.flatnonzero(~np.isfinite(design.std_errors))
    names = join_names([design.base.names[k] for k in undetermined])
    possible = (
        (
            undetermined.size,
            Finding(
                "parameters_undetermined",
                "warning",
                f"{undetermined.size} parameters UNDETERMINED by this motion: {names}",
                Cure(f"use more {design.size_name}, a longer motion or fewer drive terms"),
            ),
        ),
        (
            design.interrupted,
            Finding(
                "design_interrupted",
                "warning",
                f"INTERRUPTED: best of the {len(design.candidates)} searches until then",
            ),
        ),
        (
            design.assumed,
            Finding(
                "limits_assumed",
                "warning",
                f"the description lacks limits of {join_names(design.assumed)} for some joints",
                Cure("the usual ones were assumed; add the robot's own limits to the description"),
            ),
        ),
        (
            design.motion.parametrisation in JUMPING,
            Finding(
                "acceleration_jumps",
                "info",
                "the acceleration jumps; the jerk depends on the controller",
            ),
        ),
    )
    tried = [
        Finding(
            "duration_tried",
            "info",
            f"{trial.duration:g} s with {trial.size} {design.size_name}"
            + ("" if trial.periods == 1 else f" in {trial.periods} periods")
            + f" give a precision of {trial.precision:.3g} of the torque",
        )
        for trial in design.trials
    ]
    return [*(finding for holds, finding in possible if holds), *tried]


def _report_poses(design: StaticDesign) -> list[Finding]:
    # Difference in every joint below which poses are the same [rad or m].
    equal = np.ptp(design.poses, axis=0).max() < 1e-6
    turns = f"the route turns at {design.turns} further poses, without rest, to avoid obstacles"
    alike = "the poses are all the same, because gravity acts alike in every pose of this robot"
    possible = (
        (design.turns, Finding("route_turns", "info", turns)),
        (equal, Finding("poses_equal", "info", alike)),
    )
    return [finding for holds, finding in possible if holds]
