"""Expressions of strangers: arithmetic, comparisons, names, indices and functions on a list.

They are parsed as Python and evaluated here, node by node. What is not listed is refused, so that
no expression reaches an attribute of an object, by which Python's own evaluation is led astray.
"""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

BINARY: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
    ast.Mod: operator.mod,
    ast.Pow: lambda a, b: math.pow(a, b) if abs(b) > LARGEST_POWER else a**b,
}
UNARY: dict[type[ast.unaryop], Callable[[Any], Any]] = {
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
    ast.Not: operator.not_,
}
COMPARISONS: dict[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Is: operator.is_,
    ast.IsNot: operator.is_not,
    ast.In: lambda a, b: a in b,
    ast.NotIn: lambda a, b: a not in b,
}
LARGEST_POWER = 64
"""Exponent beyond which a power is a floating-point number, which has no more than 8 bytes."""
LITERALS = (bool, int, float, str, type(None))
METHODS: dict[type, tuple[str, ...]] = {
    str: ("endswith", "join", "lower", "replace", "split", "startswith", "strip", "upper"),
    dict: ("get", "items", "keys", "values"),
}
"""Methods that may be called; none gives access to more than its own text or table."""
BUILTINS: dict[str, Callable[..., Any]] = {
    each.__name__: each
    for each in (abs, all, any, bool, dict, divmod, enumerate, float, int, len, list, map, max,
                 min, range, reversed, round, set, sorted, str, sum, tuple, zip)
}  # fmt: skip
MATH: dict[str, Any] = {
    name: value
    for name, value in vars(math).items()
    if not name.startswith("_") and name not in ("comb", "factorial", "perm")
}
"""Functions and constants of `math`, without those whose value grows faster than any memory."""


class ExpressionError(ValueError):
    """An expression holds what is not on the list."""


def evaluate(text: str, symbols: Mapping[str, Any], functions: Sequence[Any]) -> Any:
    """Return the value of an expression.

    Parameters
    ----------
    text
        The expression, such as `length / 2 + cos(pi / 6)`.
    symbols
        Value of each name. A dotted name `a.b` is the item `b` of the mapping `a`.
    functions
        Objects that may be called.

    Raises
    ------
    ExpressionError
        If it holds anything that is not on the list; and whatever a listed operation raises.

    Examples
    --------
    >>> evaluate("2 * max(a, 3) + b['c']", {"a": 1, "b": {"c": 4}, "max": max}, [max])
    10
    >>> evaluate("a.__class__", {"a": 1}, [])
    Traceback (most recent call last):
    ...
    asbuilt.description.formats.expansion.expressions.ExpressionError: a.__class__ is not allowed
    """
    return _Expression(symbols, functions).value(ast.parse(text.strip(), mode="eval").body)


class _Expression:
    def __init__(self, symbols: Mapping[str, Any], functions: Sequence[Any]) -> None:
        self._symbols, self._functions = symbols, functions

    def value(self, node: Any) -> Any:
        """Return the value of a node; the method of its kind has it."""
        found = getattr(self, "_" + type(node).__name__.lower(), None)
        if found is None:
            raise _refused(node)
        return found(node)

    def _constant(self, node: ast.Constant) -> Any:
        if not isinstance(node.value, LITERALS):
            raise _refused(node)
        return node.value

    def _name(self, node: ast.Name) -> Any:
        try:
            return self._symbols[node.id]
        except KeyError:
            raise NameError(f"name '{node.id}' is not defined") from None

    def _attribute(self, node: ast.Attribute) -> Any:
        """Return an item of a namespace or table, never an attribute of an object."""
        owner = self.value(node.value)
        if not isinstance(owner, dict) or node.attr.startswith("_"):
            raise _refused(node)
        return owner[node.attr]

    def _subscript(self, node: ast.Subscript) -> Any:
        owner = self.value(node.value)
        if not isinstance(owner, str | list | tuple | dict):
            raise _refused(node)
        return owner[self.value(node.slice)]

    def _slice(self, node: ast.Slice) -> slice:
        ends = (node.lower, node.upper, node.step)
        return slice(*(None if each is None else self.value(each) for each in ends))

    def _binop(self, node: ast.BinOp) -> Any:
        if type(node.op) not in BINARY:
            raise _refused(node)
        return BINARY[type(node.op)](self.value(node.left), self.value(node.right))

    def _unaryop(self, node: ast.UnaryOp) -> Any:
        if type(node.op) not in UNARY:
            raise _refused(node)
        return UNARY[type(node.op)](self.value(node.operand))

    def _boolop(self, node: ast.BoolOp) -> Any:
        ends = bool if isinstance(node.op, ast.Or) else operator.not_
        for each in node.values[:-1]:
            if ends(value := self.value(each)):
                return value
        return self.value(node.values[-1])

    def _compare(self, node: ast.Compare) -> Any:
        left = self.value(node.left)
        for kind, right in zip(node.ops, map(self.value, node.comparators), strict=True):
            if not (found := COMPARISONS[type(kind)](left, right)):
                return found
            left = right
        return found

    def _ifexp(self, node: ast.IfExp) -> Any:
        return self.value(node.body if self.value(node.test) else node.orelse)

    def _tuple(self, node: ast.Tuple) -> tuple[Any, ...]:
        return tuple(map(self.value, node.elts))

    def _list(self, node: ast.List) -> list[Any]:
        return [*map(self.value, node.elts)]

    def _dict(self, node: ast.Dict) -> dict[Any, Any]:
        keys = map(self.value, node.keys)
        return dict(zip(keys, map(self.value, node.values), strict=True))

    def _call(self, node: ast.Call) -> Any:
        function = self._function(node.func)
        return function(
            *map(self.value, node.args),
            **{str(each.arg): self.value(each.value) for each in node.keywords},
        )

    def _function(self, node: ast.expr) -> Callable[..., Any]:
        """Return a listed function, or a listed method of a text or table."""
        if isinstance(node, ast.Attribute):
            owner = self.value(node.value)
            for kind, methods in METHODS.items():
                if isinstance(owner, kind) and node.attr in methods:
                    return getattr(kind(owner), node.attr)  # type: ignore[no-any-return]
        function: Callable[..., Any] = self.value(node)
        if not any(function is each for each in self._functions):
            raise _refused(node)
        return function


def _refused(node: ast.AST) -> ExpressionError:
    return ExpressionError(f"{ast.unparse(node)[:80]} is not allowed")
