"""Role of a column: quantity, joint and unit by its name."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence, Set
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Literal

from asbuilt.description.joint_matching import WORD, split_words

Quantity = Literal["time", "position", "velocity", "acceleration", "torque", "current", "command"]

_NAMES: dict[Quantity, str] = {
    "time": "time times timestamp timestamps stamp stamps clock duration elapsed sec secs seconds"
    " uptime zeit temps tiempo tempo ipoc",
    "position": "position positions pos angle angles ang theta qpos winkel",
    "velocity": "velocity velocities vel vels speed speeds qvel omega qdot thetadot dtheta"
    " geschwindigkeit",
    "acceleration": "acceleration accelerations accel acc qacc qddot thetaddot ddtheta",
    "torque": "torque torques effort efforts eff tau taus moment moments drehmoment trq torq",
    "current": "current currents curr amps ampere amperes strom",
}
_WORDS = {word: quantity for quantity, words in _NAMES.items() for word in words.split()}
_SYMBOLS: dict[str, Quantity] = {
    "t": "time",
    "q": "position",
    "qd": "velocity",
    "dq": "velocity",
    "qp": "velocity",
    "qdd": "acceleration",
    "ddq": "acceleration",
    "qpp": "acceleration",
    "i": "current",
}
_PAIRS: dict[tuple[str, ...], Quantity] = {
    ("q", "dot", "dot"): "acceleration",
    ("q", "ddot"): "acceleration",
    ("q", "dot"): "velocity",
    ("theta", "dot"): "velocity",
    ("d", "q"): "velocity",
    ("dd", "q"): "acceleration",
}
_KUKA_POSITION = ("axis", "act")
"""Words of the positions in traces of KUKA controllers, such as `$AXIS_ACT` and `AxisAct.A1`."""
_SPELT = {
    "AIPos.": "position (deg) ",
    "ASPos.": "command position (deg) ",
    "MACur.": "current ",
}
"""Names of KUKA's sensor interface, in words."""
_NO_CLOCK = {"latency", "delay", "dt", "delta", "period", "cycle", "jitter", "step", "flight"}
"""Words of other times than those at which samples were taken."""
_SECONDS = {"sec", "secs", "seconds"}
_NANOSECONDS = {"nanosec", "nanosecs", "nsec", "nsecs", "nanoseconds"}
_JOINT = {"joint", "joints", "jnt", "axis", "achse", "j", "a", "dof"}
"""Words before the number of a joint."""
_DESIRED = {
    "target",
    "targets",
    "desired",
    "des",
    "cmd",
    "command",
    "commands",
    "commanded",
    "cmptd",
    "computed",
    "planned",
    "requested",
    "ff",
    "feedforward",
    "ref",
    "reference",
    "references",
    "setpoint",
    "setpoints",
    "goal",
    "goals",
    "action",
    "actions",
    "d",
    "error",
    "err",
}
COMMANDS = {"command", "commands", "commanded", "cmd", "cmptd"}
"""Words that make a command of a column without another quantity."""
GOALS = {
    *("ref", "reference", "references", "setpoint", "setpoints", "goal", "goals"),
    *("target", "targets", "desired", "des"),
}
"""Words that may do so too."""
_ANGLE_UNITS = {"deg", "degrees", "rad", "mrad"}
"""Units of angles at the end of a name: a command in another unit is none of positions."""
_OTHER = {
    "temperature",
    "temp",
    "voltage",
    "tcp",
    "cartesian",
    "cart",
    "ee",
    "force",
    "forces",
    "wrench",
    "gripper",
    "mode",
    "status",
    "limit",
    "std",
}
_EXTERNAL = {"ext", "external", "extern"}
_MEASURED = {
    "act",
    "actual",
    "present",
    "feedback",
    "measured",
    "meas",
    "msr",
    "filtered",
    "filt",
    "hat",
    "raw",
    "joint",
    "joints",
    "states",
    "state",
    "axis",
    "j",
    "header",
    "log",
    "data",
    "dof",
}
_PREFIXES = _MEASURED - {"hat", "joint", "joints", "j"}
"""Words before a joint's name that do not belong to it."""
_PROCESSED = {"raw", "filtered", "filt", "meas", "measured", "present", "actual", "feedback"}
"""Words behind a joint's name that do not belong to it."""
_MOTOR = {"motor", "motors"}
PARTS = {
    **dict.fromkeys(("%", "percent", "pct", "percentage"), 0.01),
    **dict.fromkeys(("‰", "permille", "permil", "promille", "permill"), 0.001),
}
"""Units that are parts of another quantity, such as the rated torque."""
_NO_FACTOR = {*PARTS, "count", "counts", "tick", "ticks"}
"""Units that another quantity, such as the rated torque, has to turn into SI."""
_SENSOR = {"sensor", "sensors"}
_UNIT_TABLE: tuple[tuple[Quantity | None, float, str], ...] = (
    ("time", 1.0, "s,sec"),
    ("time", 1e-3, "ms"),
    ("time", 1e-6, "us,µs"),
    ("time", 1e-9, "ns"),
    ("position", 1.0, "rad"),
    ("position", 1e-3, "mrad"),
    ("position", math.pi / 180, "deg,degree,degrees,grad,°"),
    ("position", 2 * math.pi, "rev,turn,turns"),
    ("velocity", math.pi / 30, "rpm"),
    ("torque", 1.0, "nm,n m,n*m,n.m"),
    ("torque", 1e-3, "mnm,mn m,nmm,n mm"),
    ("torque", 1e3, "knm,kn m"),
    ("torque", 1e-2, "ncm,n cm"),
    ("torque", 9.80665e-2, "kgcm,kg cm,kgfcm,kgf cm,kgf.cm"),
    ("torque", 9.80665, "kgm,kgfm,kgf m,kgf.m"),
    ("torque", 7.0615518e-3, "ozin,oz in"),
    ("torque", 0.11298483, "lbin,lb in,lbf in"),
    ("torque", 1.3558179, "lbft,lb ft,ftlb,ft lb,lbf ft"),
    ("current", 1.0, "a"),
    ("current", 1e-3, "ma"),
    # Of sliding joints, where they do not say a quantity: m may be a motor, and n a number.
    (None, 1.0, "m,n"),
    (None, 1e-3, "mm"),
)
"""Spellings of units, their factors to SI, and the quantity of a joint that has each.

An angle per second is a velocity, twice per second an acceleration."""
_UNITS = {unit: scale for _, scale, units in _UNIT_TABLE for unit in units.split(",")}
_QUANTITY_OF_UNIT = {unit: what for what, _, units in _UNIT_TABLE for unit in units.split(",")}
_RATES: tuple[Quantity, ...] = ("position", "velocity", "acceleration")
"""Quantities of an angle by how often it is per second."""
_COUNTED = re.compile(r"(\d+(?:\.\d*)?(?:[eE][-+]?\d{1,3})?)(?:/(\d+(?:\.\d*)?))?\s+([^\d\s].*)")
"""A unit with a number before it, or a part of one: "0.229 rpm", "1/4096 turn"."""
_UNIT_SUFFIX = re.compile(
    r"(?i)[_ .](deg|degrees|rad|mrad|mnm|nmm|ncm|nm|kgf?cm|ozin|lbin|lbft|ms|us|ns|sec|s|ma|rpm)"
    r"(?:_?(?:p|per)?_?(s[2²]?))?"
    r"(?=[_ .]?\d*$)"
)


@dataclass(frozen=True)
class Role:
    """Hold what the name of a column gives.

    `joint` is the name of the joint ("" if it only counts), `index` its last number, `scale` the
    factor to SI, `kind` one of "", "external", "motor", "sensor" or, if the unit has no factor,
    "unscaled". `column` is the whole name, of columns in a layout.
    """

    quantity: Quantity
    joint: str = ""
    index: int | None = None
    kind: str = ""
    scale: float = 1.0
    unit: str = ""
    column: str = field(default="", repr=False)


def parse_unit_scale(unit: str) -> float | None:
    """Return the factor from `unit`, such as "deg/s" or "mN m", to SI; None if it is unknown.

    Examples
    --------
    >>> parse_unit_scale("mNm"), parse_unit_scale("rad/s"), parse_unit_scale("furlong")
    (0.001, 1.0, None)
    >>> round(parse_unit_scale("1/4096 turn") * 4096, 6), round(parse_unit_scale("0.229 rpm"), 6)
    (6.283185, 0.023981)
    """
    counted = _COUNTED.fullmatch(unit.strip())
    if counted is None:
        return _UNITS.get(unit.strip().split("/")[0].strip().lower())
    number, part, of_what = counted.groups()
    scale = _UNITS.get(of_what.split("/")[0].strip().lower())
    factor = float(number) / float(part or 1.0) if float(part or 1.0) else 0.0
    return None if scale is None or not 0.0 < factor < 1e12 else factor * scale


def recognise(name: str) -> Role | None:
    """Return the role of a column by its name; None for desired values, temperatures and others.

    Examples
    --------
    >>> recognise("q_0")
    Role(quantity='position', joint='', index=0, kind='', scale=1.0, unit='')
    >>> recognise("joint_3_torque").quantity, recognise("elbow_joint_vel").joint
    ('torque', 'elbow_joint')
    >>> recognise("target_q_1")
    """
    bare, index, unit, _ = _split_unit(_spell(name))
    spans = list(WORD.finditer(bare))
    words = [span[0].lower() for span in spans]
    quantity, used = _find_quantity(words)
    others = set(words) - {words[k] for k in used}
    marked = (mark for mark in ("%", "‰") if mark in name)
    unscaled = next(marked, "") or next((word for word in words if word in _NO_FACTOR), "")
    no_clock = quantity == "time" and set(words) & _NO_CLOCK
    unwanted = others & (_DESIRED | _OTHER) or (unscaled and others & _EXTERNAL)
    if quantity is None or unwanted or no_clock:
        return None
    unit = unscaled or ("ms" if "ipoc" in words else unit)
    kinds = {
        "unscaled": bool(unscaled),
        "external": others & _EXTERNAL,
        "motor": others & _MOTOR and quantity in ("torque", "position"),
        "sensor": others & _SENSOR,
    }
    kind = next((kind for kind, found in kinds.items() if found), "")
    of_kind = {unscaled} | _EXTERNAL | _MOTOR | _SENSOR
    rest = [k for k in range(len(words)) if k not in used and words[k] not in of_kind]
    if quantity == "torque" and rest and rest[0] == used[-1] + 1 and words[rest[0]] == "j":
        rest = rest[1:]
    numbers = [int(words[k]) for k in rest if words[k].isdigit()]
    index = numbers[-1] if index is None and numbers else index
    counts = "joint" in others and not unit
    joint = "" if quantity == "time" else _find_joint(bare, spans, rest, counts)
    return Role(quantity, joint, index, kind, (unit and parse_unit_scale(unit)) or 1.0, unit)


def _spell(name: str) -> str:
    """Return a name with Greek symbols and names of KUKA's interface in words."""
    start = next((each for each in _SPELT if name.startswith(each)), "")
    name = _SPELT.get(start, "") + name.removeprefix(start)
    return name.replace("τ", "tau").replace("θ", "theta")


def _find_joint(
    bare: str, spans: Sequence[re.Match[str]], rest: Sequence[int], counts: bool
) -> str:
    """Return the name of a joint that the words `rest` of a column's name give; "" if they count.

    A joint that `counts` may be called joint_1, and is called so if nothing else is left.
    """
    words = [span.group().lower() for span in spans]
    numbers = [k for k in rest if words[k].isdigit()]
    named = len(numbers) > 1 or any(k not in numbers and words[k] not in _MEASURED for k in rest)
    while named and words[rest[0]] in _PREFIXES and len(rest) > 1:
        rest = rest[1:]
    while named and words[rest[-1]] in _PROCESSED and len(rest) > 1:
        rest = rest[:-1]
    whole = [*rest] == [*range(rest[0], rest[-1] + 1)] if rest else False
    if not (
        named or (counts and whole and words[rest[0]] == "joint" and words[rest[-1]].isdigit())
    ):
        return ""
    parts = [spans[k].group() for k in rest]
    joint = bare[spans[rest[0]].start() : spans[rest[-1]].end()] if whole else "_".join(parts)
    return re.sub("^(joint_states/)?(joint_states_)?(joint_state_)?", "", joint)


def find_nanoseconds(name: str, names: Sequence[str]) -> str | None:
    """Return the column of nanoseconds that belongs to one of whole seconds, as in ROS stamps.

    >>> find_nanoseconds("stamp.sec", ["stamp.sec", "stamp.nanosec"])
    'stamp.nanosec'
    >>> find_nanoseconds("ZeitInSec", ["ZeitInSec", "ZeitInNanoSec"])
    'ZeitInNanoSec'
    """
    *before, last = split_words(name) or [""]
    if last not in _SECONDS:
        return None
    wanted = [[*before, last] for last in _NANOSECONDS] + [[*before, "nano", last]]
    return next((name for name in names if split_words(name) in wanted), None)


def recognise_any(name: str) -> Role | None:
    """Return what a column is by its name, a measured quantity, a command or a goal; or None."""
    return recognise(name) or match_commanded_role(name) or match_commanded_role(name, GOALS)


def match_commanded_role(name: str, alone: Set[str] = COMMANDS) -> Role | None:
    """Return the role of a column of commanded positions by its name, None for all others.

    Words of `alone` need no quantity next to them: `COMMANDS` do not, `GOALS` only where each joint
    with a position has such a column, and no other has one.

    Examples
    --------
    >>> match_commanded_role("des_dof_pos_3").index
    3
    >>> match_commanded_role("elbow_joint_target_position").joint
    'elbow_joint'
    >>> match_commanded_role("elbow_cmd_deg").joint, match_commanded_role("elbow_cmd_deg").unit
    ('elbow', 'deg')
    >>> match_commanded_role("elbow/setpoint", GOALS).joint
    'elbow'
    >>> [match_commanded_role(name) for name in ("q_1", "target_velocity_1", "elbow_cmd_mA")]
    [None, None, None]
    """
    name = _spell(name)
    words = {word.lower() for word in WORD.findall(name)}
    if not words & _DESIRED or words & {"error", "err"}:
        return None
    bare = WORD.sub(lambda word: "" if word[0].lower() in _DESIRED else word[0], name)
    rest = re.sub(r"([_./ -])[_./ -]+", r"\1", bare).strip("_./ -")
    role = recognise(rest)
    if role is None and alone & words:
        unit = _UNIT_SUFFIX.search(rest)
        if unit and unit.group(1).lower() not in _ANGLE_UNITS:
            return None
        bare, end = (rest[: unit.start()], rest[unit.start() :]) if unit else (rest, "")
        parts = (bare, "_position") if re.search("[a-zA-Z]", bare) else ("position_", bare)
        role = recognise("".join((*parts, end)))
    if role is None or role.quantity != "position" or role.kind:
        return None
    return replace(role, quantity="command")


def names_command(name: str) -> bool:
    """Return whether the name of a topic or a column says that it holds commands.

    Examples
    --------
    >>> [names_command(each) for each in ("/joint_states", "/arm/joint_commands", "/desired_state")]
    [False, True, True]
    """
    return bool(set(split_words(name)) & (COMMANDS | GOALS))


def recognise_by_unit(name: str) -> Role | None:
    """Return the role of a column that names a numbered joint or nothing, and a unit.

    An angle is a position, per second a velocity. None for names that `recognise` knows, and for
    desired values and other quantities.

    Examples
    --------
    >>> recognise_by_unit("rob1_joint_1_deg").quantity, recognise_by_unit("A2 [Nm]").index
    ('position', 2)
    >>> recognise_by_unit("step [ms]"), recognise_by_unit("heading_deg")
    (None, None)
    """
    bare, _, unit, order = _split_unit(name)
    words = split_words(bare)
    if not unit or recognise(name) is not None or set(words) & (_DESIRED | _OTHER | _EXTERNAL):
        return None
    quantity = _find_quantity_of_unit(unit, order)
    scale = parse_unit_scale(unit) or 1.0
    if quantity == "time":
        return None if set(words) & _NO_CLOCK else Role("time", scale=scale, unit=unit)
    numbered = [
        int(words[k + 1])
        for k in range(len(words) - 1)
        if words[k] in _JOINT and words[k + 1].isdigit()
    ]
    if quantity is None or not numbered:
        return None
    return Role(quantity, index=numbered[-1], scale=scale, unit=unit)


def _find_quantity_of_unit(unit: str, order: int) -> Quantity | None:
    """Return the quantity of a joint that has a unit, so often per second."""
    quantity = _QUANTITY_OF_UNIT.get(unit.lower().split("/")[0].strip())
    if order == 0:
        return quantity
    return _RATES[order] if quantity == "position" else None


def split_unit(name: str, quantity: str) -> tuple[str, str]:
    """Return the name of a column of a quantity without its unit, and the unit; "" without one.

    >>> split_unit("shoulder [deg]", "position"), split_unit("arm_ms", "position")
    (('shoulder', 'deg'), ('arm_ms', ''))
    """
    bare, _, unit, order = _split_unit(_spell(name))
    fits = unit and _find_quantity_of_unit(unit, order) in (None, quantity)
    return (bare.strip("_./ -"), unit) if fits else (name, "")


def parse_file_quantity(stem: str) -> tuple[Quantity | None, str]:
    """Return the quantity that a file name ends or begins with, and the rest of the name.

    "run1_positions" -> ("position", "run1").
    """
    words = split_words(stem)
    for k in dict.fromkeys((len(words) - 1, 0)) if words else ():
        quantity = (_WORDS | _SYMBOLS).get(words[k])
        if quantity not in (None, "time") and words[k] != "i":
            return quantity, "_".join(words[:k] + words[k + 1 :])
    return None, "_".join(words)


def _split_unit(name: str) -> tuple[str, int | None, str, int]:
    """Split "speed[3] (deg/s)" into the bare name, the index, the unit and its order in time."""
    index: int | None = None
    unit = ""
    for content in re.findall(r"[\[(]([^\])]*)[\])]", name):
        if content.strip().isdigit():
            index = int(content)
        elif parse_unit_scale(content) is not None:
            unit = content.strip()
    bare = re.sub(r"[\[(][^\])]*[\])]", "", name)
    suffix = _UNIT_SUFFIX.search(bare)
    if suffix and _QUANTITY_OF_UNIT.get(suffix.group(1).lower()) == "time":
        # Baxter's joints are s0 to w2: `ang_left_s0` is no angle in seconds
        rest = _find_quantity(split_words(bare[: suffix.start()]))[0]
        suffix = suffix if rest in (None, "time") else None
    if suffix and not unit:
        bare = bare[: suffix.start()] + bare[suffix.end() :]
        unit = suffix.group(1)
        per = suffix.group(2) or ""
    else:
        per = unit.partition("/")[2].strip()
    return bare, index, unit, 0 if not per else 2 if per[-1] in "2²" else 1


def _find_quantity(words: list[str]) -> tuple[Quantity | None, list[int]]:
    """Return the quantity that the words name, and the indices of these words."""
    for k, size in product(range(len(words)), (3, 2)):
        quantity = _PAIRS.get(tuple(words[k : k + size]))
        if quantity is not None:
            return quantity, list(range(k, min(k + size, len(words))))
    strong = [k for k, word in enumerate(words) if word in _WORDS]
    if strong:
        k = next((i for i in reversed(strong) if _WORDS[words[i]] != "time"), strong[-1])
        symbols = [
            i
            for i in (k - 1, k + 1)
            if _WORDS[words[k]] == "position"
            and words[max(i, 0) : i + 1] == ["q"]
            and not _follows_number(words, i)
        ]
        return _WORDS[words[k]], sorted([k, *symbols])
    for k in range(len(words) - 1):
        if tuple(words[k : k + 2]) == _KUKA_POSITION:
            return "position", [k, k + 1]
    for k, word in enumerate(words):
        counts = len(words) == 1 or _follows_number(words, k)
        if word in _SYMBOLS and (counts or word not in {"t", "i"}):
            return _SYMBOLS[word], [k]
    return None, []


def _follows_number(words: list[str], k: int) -> bool:
    return k + 1 < len(words) and words[k + 1].isdigit()
