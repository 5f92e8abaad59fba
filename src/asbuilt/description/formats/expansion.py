"""Expansion of one xacro file: what a child process runs.

The package xacro expands macros, properties and conditions. Its expressions are Python, from whose
restrictions a generator's frames lead out, so that strangers' expressions are evaluated on a list
of ours. Whatever that overlooks meets the audit hook, which lets nothing happen but reading.
"""

from __future__ import annotations

import ast
import contextlib
import math
import operator
import os
import stat
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
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
    asbuilt.description.formats.expansion.ExpressionError: a.__class__ is not allowed
    """
    return _Expression(symbols, functions).value(ast.parse(text.strip(), mode="eval").body)


class _Expression:
    def __init__(self, symbols: Mapping[str, Any], functions: Sequence[Any]) -> None:
        self._symbols = symbols
        self._functions = functions

    def value(self, node: Any) -> Any:
        """Return the value of a node of a listed kind."""
        value = self.value
        match node:
            case ast.Constant(value=constant) if isinstance(constant, LITERALS):
                return constant
            case ast.Name(id=name):
                return self._look_up(name)
            case ast.Attribute(value=inner, attr=name):
                # an item of a namespace or table, never an attribute of an object
                if isinstance(owner := value(inner), dict) and not name.startswith("_"):
                    return owner[name]
            case ast.Subscript(value=inner, slice=key):
                if isinstance(owner := value(inner), str | list | tuple | dict):
                    return owner[value(key)]
            case ast.Slice(lower=lower, upper=upper, step=step):
                return slice(*(each and value(each) for each in (lower, upper, step)))
            case ast.BinOp(left=left, op=op, right=right) if type(op) in BINARY:
                return BINARY[type(op)](value(left), value(right))
            case ast.UnaryOp(op=op, operand=operand) if type(op) in UNARY:
                return UNARY[type(op)](value(operand))
            case ast.BoolOp():
                return self._join_truths(node)
            case ast.Compare():
                return self._compare(node)
            case ast.IfExp(test=test, body=body, orelse=other):
                return value(body if value(test) else other)
            case ast.Tuple(elts=items):
                return tuple(map(value, items))
            case ast.List(elts=items):
                return [*map(value, items)]
            case ast.Dict(keys=keys, values=values):
                return dict(zip(map(value, keys), map(value, values), strict=True))
            case ast.Call(func=called, args=given, keywords=named):
                function = self._find_function(called)
                return function(
                    *map(value, given), **{str(each.arg): value(each.value) for each in named}
                )
        raise _make_refusal(node)

    def _look_up(self, name: str) -> Any:
        try:
            return self._symbols[name]
        except KeyError:
            raise NameError(f"name '{name}' is not defined") from None

    def _join_truths(self, node: ast.BoolOp) -> Any:
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

    def _find_function(self, node: ast.expr) -> Callable[..., Any]:
        """Return a listed function, or a listed method of a text or table."""
        if isinstance(node, ast.Attribute):
            owner = self.value(node.value)
            for kind, methods in METHODS.items():
                if isinstance(owner, kind) and node.attr in methods:
                    return getattr(kind(owner), node.attr)  # type: ignore[no-any-return]
        function: Callable[..., Any] = self.value(node)
        if not any(function is each for each in self._functions):
            raise _make_refusal(node)
        return function


def _make_refusal(node: ast.AST) -> ExpressionError:
    return ExpressionError(f"{ast.unparse(node)[:80]} is not allowed")


SECONDS = 30
"""CPU time [s] that an expansion may take."""
MEMORY = 1_000_000_000
"""Bytes that an expansion may take; `'a' * 10**10` asks for any amount."""
SUFFIXES = (".urdf", ".xacro", ".xml", ".yaml", ".yml")
"""Suffixes of files that a description may include or load."""
NEEDED = ("safe_eval", "eval_extension", "_global_symbols", "NameSpace", "process_file")
"""What is replaced or used of xacro; a version without one of them is not used."""
AHEAD = ("xml.dom.expatbuilder", "xml.dom.pulldom", "encodings.utf_16", "encodings.latin_1")
"""Modules that reading needs later, when none can be imported any more."""
HARMLESS = ("builtins.id", "compile", "object.__getattr__", "sys._getframe")
"""Audited events of parsing and copying; no code that is compiled can be run."""


def expand(
    path: str, largest: int, *, trusted: bool, arguments: Mapping[str, str] = MappingProxyType({})
) -> None:
    """Write the URDF of a xacro file on stdout and end this process; with status 2 if it cannot.

    One line on stderr says why. `largest` limits the bytes of a file that is read and of the URDF;
    `arguments` take the place of the file's defaults.
    """
    answer = os.fdopen(os.dup(1), "wb")
    reason = os.fdopen(os.dup(2), "wb")
    sys.stdout = sys.stderr = open(os.devnull, "w")  # noqa: SIM115 - until the process ends
    status = 0
    try:
        _limit_cost()
        xacro: Any = import_module("xacro")
        if not trusted:
            _restrict(xacro, Path(path).parent, largest)
        content = (
            xacro.process_file(path, mappings=dict(arguments)).toprettyxml(indent="  ").encode()
        )
        if len(content) > largest:
            raise ValueError(f"the URDF has {len(content)} bytes, more than {largest}")
        answer.write(content)
        answer.flush()
    except BaseException as problem:
        text = " ".join(str(problem).split()) or type(problem).__name__
        reason.write(text[:300].encode(errors="replace"))
        reason.flush()
        status = 2
    os._exit(status)


def _restrict(xacro: Any, folder: Path, largest: int) -> None:
    """Give a stranger's file expressions of ours, and files of its own folder, alone."""
    missing = [name for name in NEEDED if not hasattr(xacro, name)]
    if missing:
        raise ImportError(f"this version of xacro has no {missing[0]}; 2.1 has")
    for name in (*AHEAD, "yaml"):
        with contextlib.suppress(ImportError):
            import_module(name)
    math, python, own = (xacro.NameSpace() for _ in range(3))
    math.update(MATH)
    python.update(BUILTINS)
    own.update(load_yaml=xacro.load_yaml, dotify=dict, arg=_make_argument_lookup(xacro))
    names = {**MATH, **BUILTINS, "load_yaml": xacro.load_yaml}
    xacro._global_symbols = names | {"math": math, "python": python, "xacro": own}
    functions = [name for name in (*names.values(), *own.values()) if callable(name)]
    xacro.safe_eval = lambda text, symbols, local=None: evaluate(text, symbols, functions)
    package = _find_package(folder)
    xacro.eval_extension = lambda text: _substitute(xacro, text, folder, package)
    warnings.simplefilter("ignore")
    sys.addaudithook(lambda event, given: _allow(event, given, package or folder, largest))


def _find_package(folder: Path) -> Path | None:
    """Return the nearest folder around a file that is a ROS package; None where none is."""
    around = (folder, *folder.parents)[:DEEPEST_IN_PACKAGE]
    return next((each for each in around if (each / "package.xml").is_file()), None)


DEEPEST_IN_PACKAGE = 5
"""Folders from a description up to its package, both counted; `urdf/arm/v2` are three."""


def _make_argument_lookup(xacro: Any) -> Any:
    """Return the function that gives an argument of the file by name."""
    return lambda name: xacro.substitution_args_context["arg"][name]


def _substitute(xacro: Any, text: str, folder: Path, package: Path | None) -> Any:
    """Return what `$(arg NAME)` and `$(find NAME)` stand for; all else is refused.

    A package is found where the file lies: the package around it, or a folder beside it.
    """
    command, *names = text[2:-1].split()
    if len(names) == 1 and command == "arg":
        return _make_argument_lookup(xacro)(names[0])
    if len(names) == 1 and command == "find":
        name = names[0]
        if package is not None and name == package.name:
            return str(package)
        if name not in (".", "..") and "/" not in name and (folder / name).is_dir():
            return str(folder / name)
        raise ValueError(
            f"{text[:80]} is not allowed: no such package is around the file or beside it"
        )
    raise ValueError(f"{text[:80]} is not allowed")


def _allow(event: str, given: tuple[Any, ...], folder: Path, largest: int) -> None:
    """Raise `PermissionError` unless an audited event is harmless or reads a file of the folder."""
    if event in HARMLESS:
        return
    if event in ("glob.glob", "os.listdir", "os.scandir", "open"):
        place = Path(os.path.realpath(os.fsdecode(given[0])))
        mode = given[1:2] or ("r",)
        reads = event != "open" or mode[0] in ("r", "rb", None)
        if reads and place.is_relative_to(folder) and (event != "open" or _is_file(place, largest)):
            return
        raise PermissionError(f"{given[0]} is not a description in the folder of the robot")
    raise PermissionError(f"{event} is not allowed")


def _is_file(place: Path, largest: int) -> bool:
    """Return whether a path may be read: a regular file, of a description, and not too large."""
    if place.suffix.lower() not in SUFFIXES:
        return False
    state = os.stat(place)
    return stat.S_ISREG(state.st_mode) and state.st_size <= largest


def _limit_cost() -> None:
    with contextlib.suppress(ImportError, ValueError, OSError):
        resource: Any = import_module("resource")  # not on Windows
        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS + 1))
