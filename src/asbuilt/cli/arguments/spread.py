"""Options of commands, generated from option classes."""

from __future__ import annotations

import functools
import inspect
import types
from collections.abc import Callable, Mapping
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import typer

import asbuilt
from asbuilt.errors import AsbuiltError, UsageError
from asbuilt.ranges import Range, check_choice, make_range_error, option, switch

SPELLING = {
    "size": "--harmonics",
    "checked": "--unchecked",
    "purpose": "--for",
}
"""Options that are not named after their field; a flag of a field that is on turns it off."""

PANELS = {
    "DesignOptions": "Design",
    "Filtering": "Signal chain",
    "ReadingOptions": "Reading recordings",
    "RunOptions": "Rounds",
    "StudyOptions": "Identification",
    "WatchOptions": "Watching",
}
"""Heading of the options of a class in the help."""


def name_option(field: str) -> str:
    """Return the option of a field.

    >>> name_option("flip_torque"), name_option("size")
    ('--flip-torque', '--harmonics')
    """
    return SPELLING.get(field, "--" + field.replace("_", "-"))


def print_version(wanted: bool) -> None:
    """Print the version and end, if that is wanted."""
    if wanted:
        print(f"asbuilt {asbuilt.__version__}")
        raise typer.Exit


@dataclass(frozen=True, slots=True)
class Common:
    """The options of every command; `OF_ROBOTS` of those that read a robot."""

    quiet: bool = switch(False, "print errors and JSON only", also=("-q",))
    verbose: bool = switch(False, "print each step and its time on stderr", also=("-v",))
    version: bool = switch(
        False, "print the version and exit", typer={"is_eager": True, "callback": print_version}
    )
    trust_xacro: bool = switch(False, "let a .xacro file run any Python that it holds")
    xacro: str | None = option(None, "NAME=VALUE,...", "arguments of a .xacro file")

    @property
    def xacro_arguments(self) -> dict[str, str]:
        """Arguments of a .xacro file; raises `UsageError` for a text of another form."""
        pairs = [entry.partition("=") for entry in (self.xacro or "").split(",") if entry.strip()]
        if any(not name.strip() or not equals for name, equals, _ in pairs):
            raise UsageError(f"--xacro must be NAME=VALUE,..., got {self.xacro!r}")
        return {name.strip(): value.strip() for name, _, value in pairs}


OF_ROBOTS = ("trust_xacro", "xacro")
"""Options of the commands that read a robot."""


ANY_NUMBER = Range(-1e18, 1e18)
"""Numbers that any option may have; fields of option classes have narrower ranges."""


def spread(command: Callable[..., None], run: Callable[..., None]) -> Callable[..., None]:
    """Return the command as typer takes it: option classes become the options of their fields.

    A parameter of an option class becomes one option for each field that has `help` in its
    metadata; `metavar`, `choices` (names, or names and what they stand for), `names` (a function
    that returns names to complete), `parse` (from text), `also` (other spellings) and `typer`
    (further arguments of `typer.Option`) may be given too. The command gets the class built from
    the options given, so that the class alone owns its defaults. `run(common, call)` calls the
    command.
    """
    hints = get_type_hints(command, include_extras=True)
    groups = {
        name: hint for name, hint in hints.items() if isinstance(hint, type) and is_dataclass(hint)
    }
    parameters: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(command).parameters.items():
        if name in groups:
            parameters += _list_parameters(groups[name])
        else:
            parameters.append(_make_keyword(name, hints[name], parameter.default))
    # What the help calls the value of an argument names a robot.
    reads_robot = any(
        "ROBOT" in str(getattr(option, "metavar", ""))
        for hint in hints.values()
        for option in getattr(hint, "__metadata__", ())
    )
    parameters += [p for p in _list_parameters(Common) if p.name not in OF_ROBOTS or reads_robot]

    @functools.wraps(command)
    def called(**given: Any) -> None:
        given.setdefault("trust_xacro", False)
        given.setdefault("xacro", None)
        common = _collect_options(Common, given)
        for name, value in given.items():
            if type(value) in (int, float) and not ANY_NUMBER.holds(value):
                raise make_range_error(name_option(name), value, ANY_NUMBER)
        for name, group in groups.items():
            given[name] = _collect_options(group, given)
        run(common, functools.partial(command, **given))

    called.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    called.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return called


def find_given_options(group: Any) -> dict[str, bool]:
    """Return for each option of an instance of an option class whether it is off its default."""
    return {
        name_option(field.name): getattr(group, field.name) != field.default
        for field in _list_shown_fields(type(group))
    }


def _list_shown_fields(group: type[Any]) -> list[Field[Any]]:
    return [field for field in fields(group) if "help" in field.metadata]


def _list_parameters(group: type[Any]) -> list[inspect.Parameter]:
    hints = get_type_hints(group)
    panel = PANELS.get(group.__name__)
    return [
        _generate_parameter(field, hints[field.name], panel) for field in _list_shown_fields(group)
    ]


def _generate_parameter(field: Field[Any], hint: Any, panel: str | None) -> inspect.Parameter:
    metadata = field.metadata
    plain = _remove_none(hint)
    text = str(metadata["help"])
    flag = plain is bool
    if not flag and field.default not in (None, MISSING, ()):
        text += f" [default: {_name_default(field.default, metadata.get('choices'))}]"
    option = typer.Option(
        name_option(field.name),
        *metadata.get("also", ()),
        metavar=None if flag else metadata.get("metavar", field.name.upper()),
        help=text,
        show_default=False,
        rich_help_panel=panel,
        **{"autocompletion": None if flag else _make_completion(metadata)}
        | metadata.get("typer", {}),
    )
    as_given = plain in (int, float, Path) or get_origin(plain) is list
    kind: Any = plain if as_given and "parse" not in metadata else str
    return _make_keyword(
        field.name, Annotated[bool if flag else kind | None, option], False if flag else None
    )


def _make_completion(metadata: Mapping[str, Any]) -> Callable[[str], list[str]]:
    """Return what a shell may complete a value to: its choices, or what `names` returns."""

    def complete(incomplete: str) -> list[str]:
        known = metadata["names"]() if "names" in metadata else metadata.get("choices", ())
        return [str(name) for name in known if str(name).startswith(incomplete)]

    return complete


def _collect_options(group: type[Any], given: dict[str, Any]) -> Any:
    """Build an option class from the values given, which are taken out of `given`."""
    values: dict[str, Any] = {}
    for entry in _list_shown_fields(group):
        value = given.pop(entry.name)
        if isinstance(entry.default, bool):
            values |= {entry.name: not entry.default} if value else {}
        elif value is not None:
            values[entry.name] = _parse_value(name_option(entry.name), value, entry.metadata)
    try:
        return group(**values)
    except UsageError as problem:
        name = problem.fields.get("field", "")
        if name in values:
            message = problem.message.replace(name, name_option(name), 1)
            raise UsageError(message, cure=problem.cure, **problem.fields) from None
        raise


def _parse_value(option: str, value: Any, metadata: Mapping[str, Any]) -> Any:
    if "choices" in metadata:
        return require_known_value(option, value, metadata["choices"])
    if "parse" not in metadata:
        return value
    try:
        return metadata["parse"](value)
    except AsbuiltError as problem:
        raise UsageError(f"{option}: {problem.message}", cure=problem.cure) from None
    except ValueError:
        raise UsageError(
            f"{option} takes {metadata.get('metavar', 'a value')}, got {value!r}",
            option=option,
            value=value,
        ) from None


def require_known_value(option: str, value: str, known: Any) -> Any:
    """Return a value that is among the known, or what it stands for if they are a mapping.

    Raises `UsageError` otherwise.
    """
    check_choice(option, value, known, option=option)
    return known[value] if isinstance(known, Mapping) else value


def _name_default(default: Any, choices: Any) -> str:
    if isinstance(choices, Mapping):
        return next((str(name) for name, meant in choices.items() if meant == default), "")
    return f"{default:g}" if isinstance(default, float) else str(default)


def _remove_none(hint: Any) -> Any:
    if get_origin(hint) in (Union, types.UnionType):
        kinds = [kind for kind in get_args(hint) if kind is not type(None)]
        return kinds[0] if len(kinds) == 1 else str
    return hint


def _make_keyword(name: str, hint: Any, default: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=hint)
