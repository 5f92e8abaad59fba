"""Why a standard parameter is identifiable, identifiable only in a sum, or not identifiable."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.description.inertia import PARAMETER_NAMES
from asbuilt.description.model import ROOT, RobotModel
from asbuilt.dynamics.base.regrouping import Regrouping
from asbuilt.dynamics.base.regrouping_relations import RANK_TOLERANCE, row_space
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.dynamics.kinematics import draw_postures, link_jacobians, link_poses
from asbuilt.findings import join_names

Status = Literal["identifiable", "grouped", "unidentifiable"]

STATEMENTS: dict[Status, str] = {
    "identifiable": "identifiable",
    "grouped": "identifiable only in a sum",
    "unidentifiable": "not identifiable",
}
"""How sentences begin."""

SMALL = 1e3 * RANK_TOLERANCE
"""Directions smaller than this count as absent in the sentences, and angles as exact."""

POSTURES = 12
"""Random postures of a closed chain from which it follows how its links move."""
SEED = 20153
MOMENTS = ("mx", "my", "mz")
LISTED_NAMES = 4
"""So many names are spelt out before a sentence says how many more there are."""


@dataclass(frozen=True, slots=True)
class StandardParameter:
    """Say whether a standard parameter is identifiable, alone or in sums.

    `members` are the ids of the base parameters whose expressions contain it; `why` is a sentence.
    """

    id: int
    name: str
    status: Status
    members: tuple[int, ...]
    why: str


@dataclass(frozen=True, eq=False)
class _LinkView:
    """Describe the motion of a link.

    `phrase` is text, `turns` counts the directions it turns about, `screws` its twists,
    `axis` its only axis of rotation, in its frame.
    """

    phrase: str
    turns: int
    screws: int
    axis: Array
    origin_moves: bool


def parameter_verdicts(
    model: RobotModel, drive: DriveSet, found: Regrouping, names: Sequence[str]
) -> tuple[StandardParameter, ...]:
    """Return the status of every standard parameter, in id order."""
    views = [_view_link(found, i) for i in range(model.n_joints)]

    def reason(j: int, status: Status) -> str:
        if j >= 10 * model.n_links:
            joint, position = divmod(j - 10 * model.n_links, drive.columns_per_joint)
            return _explain_richer_drive(drive, joint, position, status) or _explain_drive(
                model, views, joint, symbol=drive.symbols[position], status=status
            )
        link = j // 10
        symbol = PARAMETER_NAMES[j % 10]
        if status == "grouped":
            return _explain_sums(model, found, views, j, symbol)
        if status == "identifiable":
            return _explain_alone(views[link], symbol)
        return _explain_no_effect(model, views[link], symbol)

    return _classify_columns(found.columns, found.matrix, names, reason)


def _classify_columns(
    columns: Indices,
    matrix: Array,
    names: Sequence[str],
    reason: Callable[[int, Status], str],
) -> tuple[StandardParameter, ...]:
    """Return the status of each column of a regrouping matrix; `reason` says why."""
    classified = []
    for j, name in enumerate(names):
        rows = [int(b) for b in np.flatnonzero(matrix[:, j])]
        alone = len(rows) == 1 and np.count_nonzero(matrix[rows[0]]) == 1
        status: Status = "unidentifiable" if not rows else "identifiable" if alone else "grouped"
        shown = _name_sum(columns, matrix, names, j, rows) if status == "grouped" else ""
        sentence = f"{name}: {STATEMENTS[status]}: {reason(j, status)}{shown}"
        members = tuple(int(columns[b]) + 1 for b in rows)
        classified.append(StandardParameter(j + 1, name, status, members, sentence))
    return tuple(classified)


def classify_numerically(
    model: RobotModel, columns: Indices, matrix: Array, names: Sequence[str]
) -> tuple[StandardParameter, ...]:
    """Return the status of each standard parameter by a regrouping matrix alone.

    The structure of closed chains adds why: about which axes a link turns, and which loop joins it
    to links whose masses have the same effect.
    """
    views = _view_closed_chains(model)
    reasons: dict[Status, str] = {
        "unidentifiable": "no motion of the joints that have a drive gives it a torque",
        "identifiable": "no other parameter has the same effect on the torques",
        "grouped": "others have the same effect on the torques of the joints that have a drive",
    }

    def reason(j: int, status: Status) -> str:
        link = j // 10
        usual = reasons[status]
        if not views or link >= model.n_links:
            return usual
        if status == "unidentifiable" and not model.links[link].negligible:
            return _explain_no_effect(model, views[link], PARAMETER_NAMES[j % 10])
        if status == "grouped":
            together = np.flatnonzero(matrix[matrix[:, j] != 0.0].any(axis=0))
            return _explain_loop(model, link, together) or usual
        return usual

    return _classify_columns(columns, matrix, names, reason)


def _view_closed_chains(model: RobotModel) -> list[_LinkView]:
    """Return how the links of closed chains move, from random postures; none for other robots."""
    if not model.loops:
        return []
    q = draw_postures(model, np.random.default_rng(SEED), POSTURES)
    twists = link_jacobians(model, q)
    poses = link_poses(model, q)
    views = []
    for k in range(model.n_links):
        own = np.concatenate(list(np.swapaxes(twists[:, k], 1, 2)))
        directions = row_space(own[:, :3])
        in_root = row_space(np.concatenate([*(poses[:, k, :3, :3] @ twists[:, k, :3])], axis=1).T)
        turns = len(directions)
        screws = len(row_space(own))
        slope = _describe_slope(model, in_root[0]) if len(in_root) == 1 else ""
        axes = f"{_add_article(slope)} axis" if screws == 1 and slope else "parallel axes"
        several = f"turns about axes of {'two' if turns == 2 else 'all'} directions"
        ways = {0: "never turns", 1: f"only turns about {axes}"}
        phrase = f"link {k + 1} {ways.get(turns, several)}"
        moves = bool(np.abs(own[:, 3:]).max(initial=0.0) > SMALL)
        axis = directions[0] if turns == 1 else np.zeros(3)
        views.append(_LinkView(phrase, turns, screws, axis, moves))
    return views


def _explain_loop(model: RobotModel, link: int, columns: Indices) -> str:
    """Return why a parameter of a link in a loop is summed with parameters of others, or ""."""
    others = {int(j) // 10 for j in columns if j < 10 * model.n_links} - {link}
    for loop in model.loops:
        if loop.kind == "joint":
            continue
        chains = [
            set(() if at == ROOT else model.ancestors(at))
            for at in (model.place_of(name)[0] for name, _ in loop.ends)
        ]
        inside = chains[0] ^ chains[1]
        if link in inside and others & inside:
            held = [str(k + 1) for k in sorted({link, *(others & inside)})]
            return (
                f"the {loop} joins links {join_names(held, len(held))}: a mass on a joint between"
                " two links of it has the same effect on either"
            )
    return ""


def _name_sum(
    columns: Indices, matrix: Array, names: Sequence[str], column: int, rows: Sequence[int]
) -> str:
    if column in columns:
        others = [names[int(j)] for j in np.flatnonzero(matrix[rows[0]]) if j != column]
        listed = join_names(others, LISTED_NAMES)
        return f"; its sum with {listed} is identifiable, named {names[column]}"
    listed = join_names([names[int(columns[b])] for b in rows], LISTED_NAMES)
    return f"; it is part of the {'sums' if len(rows) > 1 else 'sum'} named {listed}"


def _find_axis_at_rest(model: RobotModel, joint: int) -> Array:
    """Return the axis of a joint in root axes with all joints at zero."""
    R = np.eye(3)
    for i in model.ancestors(joint):
        if i == joint:
            break
        R = R @ model.joints[i].before[:3, :3] @ model.joints[i].after[:3, :3]
    return np.asarray(R @ model.joints[joint].before[:3, 2])


def _describe_slope(model: RobotModel, axis: Array) -> str:
    strength = float(np.linalg.norm(model.gravity))
    if strength == 0.0:
        return "fixed"
    cosine = abs(float(axis @ model.gravity)) / strength
    return "vertical" if cosine > 1.0 - SMALL else "horizontal" if cosine < SMALL else "inclined"


def _add_article(word: str) -> str:
    return f"an {word}" if word[:1] in set("aeiou") else f"a {word}"


def _view_link(found: Regrouping, link: int) -> _LinkView:
    model = found.model
    R = model.joints[link].after[:3, :3]
    t = model.joints[link].after[:3, 3]
    twists = found.motions[link].twists
    angular = twists[:, :3] @ R
    linear = (twists[:, 3:] + np.cross(twists[:, :3], t / found.size)) @ R
    directions = row_space(angular)
    chain = model.ancestors(link)
    turning = [i for i in chain if model.joints[i].is_revolute]
    name = f"link {link + 1}"
    slides = row_space(np.array([_find_axis_at_rest(model, i) for i in chain]))
    slope = _describe_slope(model, _find_axis_at_rest(model, turning[0])) if turning else ""
    fixed = slope == "fixed"
    parallel = len(directions) == 1
    phrases = (
        (
            not turning and len(slides) == 1,
            f"only slides along {_add_article(_describe_slope(model, slides[0]))} line and never"
            " turns",
        ),
        (
            not turning,
            f"only slides, {'in a plane' if len(slides) == 2 else 'in all directions'},"
            " and never turns",
        ),
        (parallel and len(twists) == 1, f"only turns about {_add_article(slope)} axis"),
        (
            parallel and len(turning) < len(chain),
            f"slides, but turns only about {'parallel' if fixed else slope} axes",
        ),
        (parallel, f"only turns about {'' if fixed else slope + ', '}parallel axes"),
        (True, f"turns about axes of {'two' if len(directions) == 2 else 'all'} directions"),
    )
    phrase = f"{name} {next(phrase for holds, phrase in phrases if holds)}"
    axis = directions[0] if len(directions) == 1 else np.zeros(3)
    return _LinkView(
        phrase,
        len(directions),
        len(twists),
        axis,
        bool(np.abs(linear).max(initial=0.0) > SMALL),
    )


def _explain_no_effect(model: RobotModel, view: _LinkView, symbol: str) -> str:
    inertia = symbol.startswith("I")
    product = symbol in ("Ixy", "Ixz", "Iyz")
    about_one = view.turns == view.screws == 1
    along = float(view.axis @ np.array([symbol == moment for moment in MOMENTS], dtype=np.float64))
    still = "lies on that axis" if about_one else "never moves"
    work = (
        "gravity does no work on this part of its first moment"
        if np.any(model.gravity)
        else "there is no gravity"
    )
    reasons = (
        (
            inertia and view.turns == 0,
            ", so its moments of inertia have no effect on the torques",
        ),
        (
            inertia and view.turns == 1,
            ", so only its inertia about"
            f" {'that axis' if view.screws == 1 else 'that direction'} has an effect",
        ),
        (
            inertia,
            f", but no motion excites this {'product' if product else 'moment'} of inertia",
        ),
        (
            symbol == "m",
            f" and the origin of its frame {still}, so its mass requires no torque",
        ),
        (
            view.turns == 0,
            ", so the position of its mass has no effect on the torques",
        ),
        (
            view.turns == 1 and abs(along) > 1.0 - SMALL,
            ", so the position of its mass along"
            f" {'that axis' if view.screws == 1 else 'this direction'} has no effect",
        ),
        (
            view.origin_moves,
            f", {work}, and its inertia about its axes of motion does not depend on it",
        ),
        (
            about_one,
            f" through the origin of its frame and {work}, so the position of its"
            " mass has an effect only through its inertia about that axis",
        ),
        (True, f", but the origin of its frame never moves and {work}"),
    )
    return view.phrase + next(reason for holds, reason in reasons if holds)


def _explain_alone(view: _LinkView, symbol: str) -> str:
    if symbol.startswith("I"):
        what = "this product of inertia" if symbol[1] != symbol[2] else "this moment of inertia"
    else:
        what = "its mass" if symbol == "m" else "this part of its first moment"
    return f"{view.phrase}, and no other parameter has the same effect on the torques as {what}"


def _explain_sums(
    model: RobotModel, found: Regrouping, views: Sequence[_LinkView], column: int, symbol: str
) -> str:
    link = column // 10
    parent = model.joints[link].parent
    own = found.null_blocks[link]
    mine = np.abs(own[:, column]) > SMALL
    givers = [
        child
        for child, other in enumerate(model.joints)
        if other.parent == link and (np.abs(found.null_blocks[child][:, column]) > SMALL).any()
    ]
    if givers and (column in found.columns or not mine.any()):
        return _explain_gathering(model, link, givers)
    if parent != ROOT:
        return _explain_move_to_parent(model, found, views, column, symbol)
    of_drive = np.abs(own[mine, 10 * model.n_links :]).max(initial=0.0) > SMALL
    reasons = (
        (
            _bears_weight(model, link, symbol),
            "it has an effect only through its inertia about that axis and the torque of gravity"
            " about it, which other parameters have too",
        ),
        (of_drive, f"its effect on joint {link + 1} equals the effect of a drive parameter"),
        (True, "it has an effect only through its inertia about that axis"),
    )
    return f"{views[link].phrase}, so {next(reason for holds, reason in reasons if holds)}"


def _bears_weight(model: RobotModel, link: int, symbol: str) -> bool:
    """Return whether gravity has a torque about the axis of a link on the root, by a parameter.

    `u . (r x g)` for the lever r of the mass (the origin of the frame) or of a first moment (an
    axis of the frame), u the axis; it vanishes at every angle if g or r is along u.
    """
    joint = model.joints[link]
    if symbol.startswith("I") or not joint.is_revolute:
        return False
    lever = joint.after[:3, 3] if symbol == "m" else joint.after[:3, "xyz".index(symbol[1])]
    across = np.linalg.norm(np.cross(_find_axis_at_rest(model, link), model.gravity))
    return bool(np.linalg.norm(lever[:2]) > SMALL and across > SMALL)


def _explain_gathering(model: RobotModel, link: int, givers: Sequence[int]) -> str:
    turning = all(model.joints[child].is_revolute for child in givers)
    unchanged = "does not change as it turns" if turning else "does not change as it moves"
    numbers = join_names([str(child + 1) for child in givers], len(givers))
    return (
        f"link {link + 1} carries link{'s' * (len(givers) > 1)} {numbers}, of which the part that"
        f" {unchanged} has the effect of a part of link {link + 1}"
    )


def _explain_move_to_parent(
    model: RobotModel, found: Regrouping, views: Sequence[_LinkView], column: int, symbol: str
) -> str:
    link = column // 10
    joint = model.joints[link]
    number = link + 1
    axis = f"the axis of joint {number}"
    parent = f"link {joint.parent + 1}"
    kind = 0 if symbol == "m" else 1 if symbol.startswith("m") else 2
    turns = joint.is_revolute
    above = views[joint.parent].phrase
    axial = np.abs(found.axial_blocks[link][:, column % 10]) > SMALL
    own = found.matrix[found.columns == column, 10 * link : 10 * link + 10]
    summed = turns & (own != 0.0).any(axis=0)  # nothing where the column is not kept
    block = found.null_blocks[link]
    moved = np.abs(block[np.abs(block[:, column]) > SMALL]).max(axis=0, initial=0.0) > SMALL
    reasons = (
        (
            not turns and kind == 2,
            f"joint {number} slides, so link {number} always turns with {parent} and their inertias"
            " add up",
        ),
        (
            turns and axial[2],
            f"equal inertias about the two directions perpendicular to {axis} are the same at every"
            f" angle of joint {number}, so they have the effect of an inertia of {parent}",
        ),
        (
            axial[0] and summed[9],
            f"a mass on {axis} has the effect of one of {parent}; the other effects of the"
            f" mass equal the effects of {symbol}{number}",
        ),
        (
            axial[1] and summed[6:9].any(),
            f"a first moment along {axis} has the effect of one of {parent}; the other effects of"
            f" the first moment equal the effects of {symbol}{number}",
        ),
        (
            turns and axial[kind] and kind == 0,
            f"a mass on {axis} moves with {parent} whatever joint {number} does, so the mass of"
            f" link {number} is not separable from {parent}",
        ),
        (
            turns and axial[kind],
            f"a first moment along {axis} does not change as joint {number} turns, so it has the"
            f" effect of one of {parent}",
        ),
        (
            moved[10 * model.n_links :].any(),
            f"{above}, never along {axis}, so a drive parameter of joint {number} has the same"
            " effect",
        ),
        (
            moved[10 * joint.parent : 10 * joint.parent + 10].any(),
            f"{above}, so this parameter of link {number} is not separable from"
            f" the parameters of {parent}",
        ),
        (True, f"{above}, so this parameter of link {number} is not separable from its others"),
    )
    return next(reason for holds, reason in reasons if holds)


def _explain_richer_drive(drive: DriveSet, joint: int, position: int, status: Status) -> str:
    """Return the reason for a term that some joints lack or that shares its columns.

    Empty if neither is the case.
    """
    term = [term for term in drive.terms for _ in term.symbols][position]
    grouped = status == "grouped"
    number = joint + 1
    reasons = (
        (
            not term.is_at(joint),
            f"joint {number} is not among the joints for which {term.key} was chosen",
        ),
        (
            term.of_motor and status == "unidentifiable",
            f"motor {number} turns with joint {number} alone, where"
            f" {term.key.removeprefix('motor_')} has the same effect",
        ),
        (
            term.of_motor and grouped,
            f"motor {number} turns as a link does, so its rotor has the effect of an inertia of"
            " that link",
        ),
        (
            term.key == "balancer" and grouped,
            f"gravity has a fixed direction at joint {number}, so a first moment of link"
            f" {number} has the same effect as its balancer",
        ),
        (
            term.key.startswith("asymmetric") and grouped,
            f"other drive terms of joint {number} give the same torque",
        ),
    )
    return next((reason for holds, reason in reasons if holds), "")


def _explain_drive(
    model: RobotModel, views: Sequence[_LinkView], joint: int, *, symbol: str, status: Status
) -> str:
    number = joint + 1
    parent = model.joints[joint].parent
    turns = model.joints[joint].is_revolute
    ahead = (
        f"the axis of joint {number} is fixed"
        if parent == ROOT
        else f"{views[parent].phrase}, never along the axis of joint {number}"
    )
    alone = {
        "Fo": f"no other parameter gives joint {number} a constant"
        f" {'torque' if turns else 'force'}",
        "Ia": f"it has an effect on joint {number} alone, the inertia of link {number} also on the"
        f" motion of link {parent + 1}",
        "": f"its torque at joint {number} differs from the torque of every other parameter",
    }
    shared = {
        "Fo": f"joint {number} slides at a constant slope, so the weight it carries is constant,"
        " too",
        "Ia": f"{ahead}, so the armature has the effect of"
        f" {'an inertia of link' if turns else 'a mass of link'} {number}",
        "": f"other parameters give the same torque at joint {number}",
    }
    reasons = {
        "Fv": f"its torque is proportional to the velocity of joint {number} and dissipates power,"
        " which the torque of no inertia does",
        "Fc": "no other parameter has a torque proportional to the sign of the velocity of joint"
        f" {number}",
        **(alone if status == "identifiable" else shared),
    }
    return reasons.get(symbol, reasons[""])
