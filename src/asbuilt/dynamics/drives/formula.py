"""Formulas of drive terms: one text, evaluated by NumPy, written as C and run by the kernels."""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.kernels.operations import STACK, count_operands
from asbuilt.errors import UsageError

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
