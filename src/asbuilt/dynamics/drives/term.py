"""Terms of a drive's torque and their formulas, linear in their parameters given nonlinear ones."""

from __future__ import annotations

import ast
from collections.abc import Callable, Hashable, Mapping
from dataclasses import KW_ONLY, dataclass, replace
from functools import cache
from typing import Any, ClassVar, Self, TypeVar, cast, dataclass_transform

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import DriveValues
from asbuilt.dynamics.kernels.operations import STACK, count_operands
from asbuilt.errors import UsageError
from asbuilt.registry import Registry

NonlinearValue = float | tuple[float, ...] | None
"""One number for all joints, one per joint, or None: fitted, and the default until then."""

ALL_SOURCES = ("sensor", "motor", "current", "command", "unknown")
MOTOR_SOURCES = ("motor", "current", "command")


@dataclass(frozen=True, slots=True)
class NonlinearParameter:
    """Describe a number that enters the columns of a drive term nonlinearly.

    Parameters
    ----------
    name
        Name in the formulas of the columns, and of the field of the term.
    default
        Value used where none is stated, and where a fit starts.
    lower, upper
        Bounds of what may be stated.
    unit
        Unit, empty for a pure number.
    fitted
        Whether it is fitted to a recording unless a value is stated.
    of_geometry
        Whether only the design gives it, so that no recording shows a term without its value.
    typical
        A value at which the columns differ clearly from columns of other terms at speeds of some
        rad/s, for questions of structure; None where the value itself decides them.
    speed
        Whether it is a speed, so that `credible` are fractions of the joint's top speed.
    credible
        Range in which a fit searches: values for which the name of the term describes its physics.
    """

    name: str
    default: float
    lower: float
    upper: float
    unit: str
    fitted: bool = True
    of_geometry: bool = False
    typical: float | None = None
    speed: bool = False
    credible: tuple[float, float] = (0.0, np.inf)


@dataclass(frozen=True, slots=True)
class DriveTerm:
    """Add `sum_c columns[c](q, qd, qdd, load) * parameter_c` to the torque of one joint.

    A term is one class decorated by `drive_term`. A number that enters its columns nonlinearly (a
    Stribeck velocity, an exponent) is declared in `nonlinear` and is a field of the same name, None
    by default.

    Parameters
    ----------
    joints
        Numbers (from 1) of the joints that have the term, None for all.
    """

    _: KW_ONLY
    joints: tuple[int, ...] | None = None

    key: ClassVar[str]
    """Name used to select the term."""
    title: ClassVar[str] = ""
    """Name in tables and messages; the key with spaces unless given."""
    position: ClassVar[int]
    """Place in the canonical order; smaller comes first."""
    symbols: ClassVar[tuple[str, ...]]
    """Symbol of each parameter; the joint number follows it in parameter names."""
    columns: ClassVar[tuple[str, ...]]
    """Each column in the language of `Formula`; `q`, `qd`, `qdd` of the motor for `of_motor`."""
    formula: ClassVar[str]
    """The torque in mathematical notation."""
    revolute_units: ClassVar[tuple[str, ...]] = ()
    """Unit of each parameter at a revolute joint; all N m if empty."""
    prismatic_units: ClassVar[tuple[str, ...]] = ()
    """Unit of each parameter at a prismatic joint; if empty, it follows from `revolute_units`."""
    nonlinear: ClassVar[tuple[NonlinearParameter, ...]] = ()
    cause: ClassVar[str | None] = None
    """Physical cause of a difference to the design that the term stands for."""
    default_for: ClassVar[tuple[str, ...]] = ()
    """Torque sources for which the term is among the defaults."""
    tried_for: ClassVar[tuple[str, ...]] = ()
    """Torque sources for which an automatic choice of terms tries it, with parameters > 0."""
    stands_for: ClassVar[str | None] = None
    """Key of the simpler term that it then replaces."""
    by_construction: ClassVar[bool] = False
    """Whether only the description decides if a robot has it; an automatic choice never does."""
    non_negative: ClassVar[bool] = False
    """Whether its parameters are inertia or friction that no other term can offset, hence >= 0."""
    ratio_powers: ClassVar[tuple[float, ...]] = ()
    """Power of the gear ratio by which each parameter is smaller at the motor, all 1 if empty."""
    turns_over: ClassVar[bool] = False
    """Whether its parameters change sign at a motor that turns against its joint."""
    needs_load: ClassVar[bool] = False
    """Whether a column depends on the rigid-body torque of the joint; follows from `columns`."""
    by_position: ClassVar[bool] = False
    """Whether a column depends on the position of the joint; follows from `columns`."""
    of_motor: ClassVar[bool] = False
    """Whether it belongs to a motor that several joints turn, and acts on all of these."""

    def __init_subclass__(cls) -> None:
        known = {*STATE, *(parameter.name for parameter in cls.nonlinear)}
        used = {name for column in cls.columns for name in Formula(column).names}
        if unknown := sorted(used - known):
            raise UsageError(
                f"the columns of drive term {cls.key!r} use {unknown[0]!r}; they may use"
                f" {', '.join(sorted(known))}"
            )
        cls.needs_load = "load" in used
        cls.by_position = "q" in used
        cls.title = cls.__dict__.get("title") or cls.key.replace("_", " ")

    def evaluate(self, q: Array, qd: Array, qdd: Array, load: Array | None, out: Array) -> None:
        """Write the columns of one joint into `out` (len(symbols), n_samples).

        The inputs have shape (n_samples,), or all one other shape, such as one for several joints,
        which `out` then has after its first axis. `load` is the rigid-body torque [N m or N],
        required by terms that need it; a term `of_motor` takes the motion of the motor. Raises
        UsageError where a load is missing.
        """
        values: dict[str, Any] = {"q": q, "qd": qd, "qdd": qdd, "load": load}
        if load is None and self.needs_load:
            raise UsageError(
                f"drive term {self.key!r} needs the rigid-body torque of the joint; pass load,"
                f" shape {q.shape}"
            )
        values |= {parameter.name: self.value(parameter.name) for parameter in self.nonlinear}
        for column, row in zip(self.columns, out, strict=True):
            Formula(column).write(row, values)

    def functions(self) -> tuple[Mapping[Hashable, float], ...]:
        """Return each column as a sum of elementary functions, which show linear dependence.

        The link dynamics contain "qdd", "1", "sin(q)" and "cos(q)" too; columns with any other
        function are dependent only on drive columns with the same function.
        """
        if self.of_motor or self.nonlinear:
            values = tuple(self.value(parameter.name) for parameter in self.nonlinear)
            return tuple({(self.key, symbol, *values): 1.0} for symbol in self.symbols)
        return tuple({column: 1.0} for column in self.columns)

    def units(self, *, revolute: bool) -> tuple[str, ...]:
        """Return the unit of each parameter."""
        units = self.revolute_units or ("N m",) * len(self.symbols)
        if revolute:
            return units
        return self.prismatic_units or tuple(_derive_unit_of_slide(unit) for unit in units)

    def values(self, drive: DriveValues) -> tuple[float | None, ...]:
        """Return the value of each parameter in the description, None where it has none."""
        stated: float | None = getattr(drive, self.key, None)
        return (stated,) if len(self.symbols) == 1 else (None,) * len(self.symbols)

    def powers_of_ratio(self) -> tuple[float, ...]:
        """Return the power of the gear ratio N by which each parameter is smaller at the motor.

        With `theta = N q` and `tau_joint = N tau_motor`.
        """
        return self.ratio_powers or (1.0,) * len(self.symbols)

    @property
    def free_nonlinear(self) -> tuple[NonlinearParameter, ...]:
        """The nonlinear parameters that are fitted, since no value is stated."""
        return tuple(
            parameter
            for parameter in self.nonlinear
            if parameter.fitted and getattr(self, parameter.name) is None
        )

    @property
    def can_be_found(self) -> bool:
        """Whether recordings alone can show it: at one joint, by no geometry that is not stated."""
        return not self.of_motor and not any(
            each.of_geometry and getattr(self, each.name) is None for each in self.nonlinear
        )

    def value(self, name: str) -> float:
        """Return the stated value of a nonlinear parameter, or its default.

        Raises UsageError for a term with one value per joint; take it `at` a joint first.
        """
        stated: NonlinearValue = getattr(self, name)
        if stated is None:
            return next(parameter.default for parameter in self.nonlinear if parameter.name == name)
        if isinstance(stated, tuple):
            raise UsageError(f"{self} has one {name} per joint; take the term at one joint")
        return stated

    def is_at(self, joint: int) -> bool:
        """Whether a joint (counted from 0) has the term."""
        return self.joints is None or joint + 1 in self.joints

    @property
    def differs_by_joint(self) -> bool:
        """Whether a nonlinear parameter has one value per joint."""
        return any(isinstance(getattr(self, each.name), tuple) for each in self.nonlinear)

    def at(self, joint: int) -> Self:
        """Return the term of one joint (counted from 0), one value per nonlinear parameter."""
        own = {parameter.name: getattr(self, parameter.name) for parameter in self.nonlinear}
        several = {name: each[joint] for name, each in own.items() if isinstance(each, tuple)}
        return self._replace_fields(several) if several else self

    def typical(self) -> Self:
        """Return the term with typical values of its nonlinear parameters."""
        values = {
            parameter.name: parameter.typical
            for parameter in self.nonlinear
            if parameter.typical is not None
        }
        return self._replace_fields(values) if values else self

    def check_joints(self, n_joints: int) -> None:
        """Raise UsageError for a joint that does not exist and a wrong number of values."""
        outside = [number for number in self.joints or () if not 1 <= number <= n_joints]
        if outside:
            raise UsageError(
                f"{self} names joint {outside[0]}; the robot has joints 1 to {n_joints}"
            )
        for parameter in self.nonlinear:
            stated = getattr(self, parameter.name)
            if isinstance(stated, tuple) and len(stated) != n_joints:
                raise UsageError(
                    f"{self} states {len(stated)} values of {parameter.name}, one per joint; the"
                    f" robot has {n_joints} joints"
                )

    def with_nonlinear(self, values: Mapping[str, NonlinearValue]) -> Self:
        """Return the term with these nonlinear parameters stated.

        Raises UsageError for an unknown name and a value out of bounds.
        """
        known = {parameter.name: parameter for parameter in self.nonlinear}
        for name, stated in values.items():
            if name not in known:
                there = f"it has {', '.join(known)}" if known else "it has none"
                raise UsageError(f"drive term {self.key!r} has no option {name!r}; {there}")
            lower = known[name].lower
            upper = known[name].upper
            unit = known[name].unit
            for number in stated if isinstance(stated, tuple) else (stated,):
                if number is not None and not lower <= number <= upper:
                    raise UsageError(
                        f"{name} of drive term {self.key!r} must lie between {lower:g} and"
                        f" {f'{upper:g} {unit}'.strip()}, got {number:g}"
                    )
        return self._replace_fields(values)

    def _replace_fields(self, fields: Mapping[str, Any]) -> Self:
        return cast(Self, replace(cast(Any, self), **fields))

    def __str__(self) -> str:
        given = {"joints": self.joints} | {
            parameter.name: getattr(self, parameter.name) for parameter in self.nonlinear
        }
        stated = {
            name: each if isinstance(each, tuple) else (each,)
            for name, each in given.items()
            if each is not None
        }
        return ":".join(
            [self.key, *(f"{name}={'/'.join(map(repr, each))}" for name, each in stated.items())]
        )


def _derive_unit_of_slide(unit: str) -> str:
    """Return the unit with m for rad, N for N m and kg for kg m^2."""
    for turning, sliding in (("rad", "m"), ("(N m)", "N"), ("N m", "N"), ("kg m^2", "kg")):
        unit = unit.replace(turning, sliding)
    return unit


TERMS: Registry[DriveTerm] = Registry(
    "drive term", "asbuilt.dynamics.drives.terms", "asbuilt.drive_terms"
)
"""All drive terms; other distributions add theirs by an entry point of group
`asbuilt.drive_terms` that names the module.
"""
Term = TypeVar("Term", bound=DriveTerm)


@dataclass_transform(frozen_default=True)
def drive_term(kind: type[Term]) -> type[Term]:
    """Make a frozen dataclass of a class of terms and register it."""
    made = dataclass(frozen=True, slots=True)(kind)
    TERMS.register(made.key, made())
    return made


T = TypeVar("T")

STATE = ("q", "qd", "qdd", "load")
"""Quantities of a joint that a formula may use."""
FUNCTIONS: Mapping[str, Callable[..., Any]] = {
    **{"abs": np.abs, "sign": np.sign, "exp": np.exp, "log": np.log, "sqrt": np.sqrt},
    **{"sin": np.sin, "cos": np.cos, "tanh": np.tanh, "atan": np.arctan},
    **{"minimum": np.minimum, "maximum": np.maximum},
}
_OPERATORS: Mapping[type[ast.AST], str] = {
    **{ast.Add: "add", ast.Sub: "subtract", ast.Mult: "multiply", ast.Div: "divide"},
    **{ast.Pow: "power", ast.USub: "negative"},
}


@dataclass(frozen=True, slots=True)
class Formula:
    """Hold a formula in `q`, `qd`, `qdd`, `load` and named numbers.

    It may use `+ - * / **`, numbers and the functions `abs sign exp log sqrt sin cos tanh atan
    minimum maximum`.

    Raises
    ------
    UsageError
        If the text is no such formula.

    Examples
    --------
    >>> law = Formula("exp(-abs(qd/velocity))*sign(qd)")
    >>> law.names
    ('qd', 'velocity')
    >>> out = np.zeros(3)
    >>> law.write(out, {"qd": np.array([-1.0, 0.0, 1.0]), "velocity": 1.0})
    >>> out.round(3).tolist()
    [-0.368, 0.0, 0.368]
    """

    text: str

    def __post_init__(self) -> None:
        _list_steps(self.text)

    @property
    def names(self) -> tuple[str, ...]:
        """Names used, in order."""
        return tuple(dict.fromkeys(name for kind, name in _list_steps(self.text) if kind == "name"))

    def write(self, out: Array, values: Mapping[str, Array | float]) -> None:
        """Write the value of the formula into `out` (n_samples,)."""
        _make_array_function(self.text)(out, values)

    def fold(
        self,
        number: Callable[[float], T],
        name: Callable[[str], T],
        apply: Callable[..., T],
    ) -> T:
        """Return the formula built from its numbers and names by `apply(operation, *operands)`."""
        stack: list[T] = []
        for kind, step in _list_steps(self.text):
            if kind == "number":
                stack.append(number(float(step)))
            elif kind == "name":
                stack.append(name(step))
            else:
                taken = [stack.pop() for _ in range(count_operands(step))]
                stack.append(apply(step, *reversed(taken)))
        return stack.pop()


@cache
def _list_steps(text: str) -> tuple[tuple[str, str], ...]:
    """Return a formula in postfix order, as pairs of kind (number, name, apply) and text."""
    try:
        steps = tuple(_order_postfix(ast.parse(text, mode="eval").body))
    except (SyntaxError, ValueError) as error:
        raise UsageError(f"{text!r} is no formula of a drive term: {error}", formula=text) from None
    depth = np.cumsum(
        [1 - (count_operands(step) if kind == "apply" else 0) for kind, step in steps]
    )
    if depth.max() > STACK:
        raise UsageError(f"the formula {text!r} is nested too deeply", formula=text)
    return steps


def _order_postfix(node: ast.AST) -> list[tuple[str, str]]:
    match node:
        case ast.Constant(value=int() | float() as number):
            return [("number", repr(float(number)))]
        case ast.Name(id=name):
            return [("name", name)]
        case ast.UnaryOp(op=op, operand=operand) if type(op) in _OPERATORS:
            parts = [operand]
            operation = _OPERATORS[type(op)]
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
            parts = [left, right]
            operation = _OPERATORS[type(op)]
        case ast.Call(func=ast.Name(id=name), args=parts, keywords=[]) if name in FUNCTIONS:
            operation = name
        case _:
            allowed = ", ".join(FUNCTIONS)
            raise ValueError(f"{ast.unparse(node)!r} is not allowed; functions are {allowed}")
    if len(parts) != count_operands(operation):
        raise ValueError(f"{operation} takes {count_operands(operation)} values, got {len(parts)}")
    return [*(step for part in parts for step in _order_postfix(part)), ("apply", operation)]


@cache
def _make_array_function(text: str) -> Callable[[Array, Mapping[str, Array | float]], None]:
    """Return a function that evaluates a formula for arrays, in place where its last step can."""
    body = ast.parse(text, mode="eval").body
    if isinstance(body, ast.Call):
        body.keywords = [ast.keyword("out", ast.Name("out", ast.Load()))]
    code = compile(ast.fix_missing_locations(ast.Expression(body)), f"<formula {text}>", "eval")
    names = {**FUNCTIONS, "__builtins__": {}}

    def write(out: Array, values: Mapping[str, Array | float]) -> None:
        found = eval(code, names, {**values, "out": out})
        if found is not out:
            out[...] = found

    return write
