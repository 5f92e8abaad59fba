"""Dataclasses as plain data, ready for JSON, and back to the last bit."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

T = TypeVar("T")
_hints = cache(get_type_hints)


class FieldError(ValueError):
    """A field of plain data is missing or damaged; `place` is its dotted name."""

    def __init__(self, place: str, reason: str) -> None:
        super().__init__(f"{place}: {reason}")
        self.place = place
        self.reason = reason


def store_as(
    *,
    key: str = "",
    missing: float = math.nan,
    encode: Callable[[Any], Any] | None = None,
    decode: Callable[[Any], Any] | None = None,
) -> dict[str, Any]:
    """Return metadata of a dataclass field that say how it is stored.

    Parameters
    ----------
    key
        Its name in plain data, by default the field's.
    missing
        What a stored None means where the type asks for a number.
    encode, decode
        Conversions in place of those that follow from the type.
    """
    return {"key": key, "missing": missing, "encode": encode, "decode": decode}


def make_plain(value: Any) -> Any:
    """Return dataclasses, arrays and tuples as dictionaries and lists, NaN and infinities as None.

    >>> make_plain({"a": np.array([1.0, np.nan]), "b": (True, "x")})
    {'a': [1.0, None], 'b': [True, 'x']}
    """
    # Most of a document: it is passed through without asking further.
    if type(value) in (bool, int, str, NoneType):
        return value
    if type(value) is float:
        return value if math.isfinite(value) else None
    if is_dataclass(value) and not isinstance(value, type):
        return {
            _choose_key(item): (item.metadata.get("encode") or make_plain)(
                getattr(value, item.name)
            )
            for item in fields(value)
        }
    if isinstance(value, Mapping):
        return {str(key): make_plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        finite = value.dtype.kind in "biuf" and bool(np.all(np.isfinite(value)))
        return value.tolist() if finite else make_plain(value.tolist())
    if isinstance(value, list | tuple):
        return [make_plain(item) for item in value]
    return str(value) if isinstance(value, os.PathLike) else value


def restore_dataclass(kind: type[T], data: Mapping[str, Any]) -> T:
    """Rebuild a dataclass from `make_plain`; a field that is missing takes its default.

    Raises
    ------
    FieldError
        If a field without default is missing, or a value is not of the type of its field.
    TypeError
        If the data are no object.
    """
    return kind(**decode_fields(kind, data))


def decode_fields(
    kind: type[Any], data: Mapping[str, Any], but: Container[str] = ()
) -> dict[str, Any]:
    """Return the fields of a dataclass, except those in `but`, made by `restore_dataclass`."""
    if not isinstance(data, Mapping):
        raise TypeError(f"{kind.__name__} is stored as an object, got {type(data).__name__}")
    hints = _hints(kind)  # type: ignore[arg-type]
    given = {}
    for item in fields(kind):
        if item.name in but:
            continue
        key = _choose_key(item)
        decode = item.metadata.get("decode")
        if key in data:
            try:
                given[item.name] = (
                    _convert(hints[item.name], data[key], item.metadata.get("missing", math.nan))
                    if decode is None
                    else decode(data[key])
                )
            except FieldError as problem:
                raise FieldError(f"{key}.{problem.place}", problem.reason) from None
            except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as problem:
                raise FieldError(key, f"{type(problem).__name__} {problem}"[:200]) from None
        elif item.default is MISSING and item.default_factory is MISSING:
            raise FieldError(key, "it is missing")
    return given


def format_number(value: float) -> str:
    """Return the shortest text that reads back to the same number, without a minus before zero.

    >>> format_number(0.1), format_number(-0.0), format_number(3)
    ('0.1', '0.0', '3.0')
    """
    return repr(float(value) + 0.0)


def format_numbers(values: Iterable[float]) -> str:
    """Return numbers as `format_number` does, separated by spaces, as XML formats take them."""
    return " ".join(map(format_number, values))


def format_toml(value: Any, number: Callable[[float], str] = format_number) -> str:
    """Return a value of TOML on one line, as `tomli_w` does not write tables and lists.

    >>> format_toml({"mass": 2, "name of link": "tool", "com": [0, 0, 0.1], "known": True})
    '{mass = 2.0, "name of link" = "tool", com = [0.0, 0.0, 0.1], known = true}'
    """
    if isinstance(value, Mapping):
        items = (f"{format_toml_key(key)} = {format_toml(x, number)}" for key, x in value.items())
        return f"{{{', '.join(items)}}}"
    if isinstance(value, list | tuple | np.ndarray):
        return f"[{', '.join(format_toml(x, number) for x in value)}]"
    if isinstance(value, bool | str):
        import tomli_w  # noqa: PLC0415 - light start

        # Behind "x = ": tomli_w knows how to quote, and ends with a line break.
        return tomli_w.dumps({"x": value})[4:].rstrip("\n")
    return number(float(value))


def format_toml_key(key: str) -> str:
    """Return a key of TOML: bare if it is of ASCII letters, digits, - and _, else quoted."""
    bare = key.replace("_", "").replace("-", "").isalnum() and key.isascii()
    return key if bare else format_toml(key)


def format_json(document: Any) -> str:
    """Return one JSON document of plain data, indented, with a newline at the end."""
    return json.dumps(make_plain(document), indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def _choose_key(item: Field[Any]) -> str:
    return item.metadata.get("key") or item.name


def _convert(hint: Any, value: Any, missing: float = math.nan) -> Any:
    """Return plain data as what a type hint asks for."""
    origin = get_origin(hint)
    arguments = get_args(hint)
    if hint is Any:
        return value
    if origin in (Union, UnionType):
        return _convert_to_one_of(arguments, value)
    if origin is Literal:
        if value not in arguments:
            raise ValueError(f"{value!r} is not one of {', '.join(map(repr, arguments))}")
        return value
    if origin is np.ndarray:
        (number,) = get_args(arguments[1])
        return _decode_array(value, number, missing)
    if origin is tuple:
        if not isinstance(value, list):
            raise TypeError(f"expected a list, got {type(value).__name__}")
        if arguments[-1] is Ellipsis:
            return tuple(_convert(arguments[0], item, missing) for item in value)
        return tuple(_convert(kind, item) for kind, item in zip(arguments, value, strict=True))
    if origin is not None and issubclass(origin, Mapping):
        return {key: _convert(arguments[1], item) for key, item in value.items()}
    if is_dataclass(hint):
        return restore_dataclass(hint, value)  # type: ignore[arg-type]
    if hint is float:
        return missing if value is None else _require_finite(value)
    if not isinstance(value, hint) or (hint is int and isinstance(value, bool)):
        raise TypeError(f"expected {hint.__name__}, got {value!r}")
    return value


def _decode_array(value: Any, number: Any, missing: float) -> Any:
    """Return an array of finite numbers, `missing` where None is stored."""
    found = np.array(value)
    numeric = found.dtype != object or all(
        item is None or (isinstance(item, int | float) and math.isfinite(item))
        for item in found.flat
    )
    if found.dtype.kind not in "biufO" or not numeric:
        raise TypeError("expected an array of numbers")
    if found.dtype.kind == "f" and not np.all(np.isfinite(found)):
        raise ValueError("expected finite numbers")
    array = found.astype(number)
    if found.dtype == object:
        array[np.isnan(array)] = missing
    return array


def _require_finite(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"expected a number, got {str(value)[:60]!r}")
    if not math.isfinite(value):
        raise ValueError(f"expected a finite number, got {value}")
    return float(value)


def _convert_to_one_of(kinds: tuple[Any, ...], value: Any) -> Any:
    """Return plain data as the first of several types that it fits; None only where it may be."""
    if value is None and NoneType in kinds:
        return None
    rest = [kind for kind in kinds if kind is not NoneType]
    for kind in rest[:-1]:
        try:
            return _convert(kind, value)
        except (KeyError, TypeError, ValueError):
            continue
    return _convert(rest[-1], value)
