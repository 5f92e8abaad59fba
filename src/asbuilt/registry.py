"""Names: registries of objects, options by keyword, the nearest known name, and public faces."""

from __future__ import annotations

import ast
import difflib
import gc
import pkgutil
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import lazy_loader

from asbuilt.errors import UsageError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoints

T = TypeVar("T")

APPS = "asbuilt.apps"
"""Package whose sub-packages are the apps."""


def suggest_name(name: str, known: Iterable[str]) -> str:
    """Return a question that proposes the nearest of the known names, empty if none is near.

    >>> suggest_name("metod", ["method", "drive"])
    "did you mean 'method'? "
    """
    near = difflib.get_close_matches(name, list(known), n=1, cutoff=0.5)
    return f"did you mean {near[0]!r}? " if near else ""


def check_known(what: str, name: str, known: Collection[str]) -> None:
    """Raise `UsageError` unless a name is among the known ones; the nearest one is proposed."""
    if name not in known:
        raise UsageError(
            f"there is no {what} {name!r}; {suggest_name(name, known)}there are {', '.join(known)}",
            value=name,
            available=[*known],
        )


def list_known_fields(schema: Mapping[str, Any], location: Sequence[int | str]) -> list[str]:
    """Return the fields that a JSON Schema allows at a place, such as `("links", 0, "drive")`.

    Steps that name a variant of a union, as pydantic's errors have them, lead nowhere else.

    >>> schema = {"properties": {"units": {"properties": {"time": {}}}}}
    >>> list_known_fields(schema, ()), list_known_fields(schema, ("units",))
    (['units'], ['time'])
    """
    places = _list_variants(schema, schema)
    for step in location:
        inner = [each for place in places for each in _enter_place(place, step)]
        places = [variant for place in inner for variant in _list_variants(place, schema)] or places
    return [name for place in places for name in place.get("properties", {})]


def _list_variants(place: Mapping[str, Any], schema: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return a place of a schema, or the members of its union, with references resolved."""
    if "$ref" in place:
        return _list_variants(schema["$defs"][place["$ref"].rpartition("/")[2]], schema)
    members = [*place.get("anyOf", ()), *place.get("allOf", ())]
    return [variant for member in members for variant in _list_variants(member, schema)] or [place]


def _enter_place(place: Mapping[str, Any], step: int | str) -> list[Mapping[str, Any]]:
    """Return the part of a place at a field or an index, if there is one."""
    further = place.get("items" if isinstance(step, int) else "additionalProperties")
    inner = place.get("properties", {}).get(step, further)
    return [inner] if isinstance(inner, Mapping) else []


def divide_settings(settings: Mapping[str, Any], *groups: type[Any]) -> list[dict[str, Any]]:
    """Return the settings of each class of options, by the names of their fields.

    Texts are read as an interface reads them (`parse` and `choices` in the field's metadata).

    Raises
    ------
    UsageError
        If no class has a field of this name; the nearest one is proposed.
    """
    entries = {entry.name: (group, entry) for group in groups for entry in fields(group)}
    found: dict[type[Any], dict[str, Any]] = {group: {} for group in groups}
    for name, value in settings.items():
        check_known("option", name, entries)
        group, entry = entries[name]
        found[group][name] = _read(value, entry.metadata)
    return [*found.values()]


def _read(value: Any, metadata: Mapping[str, Any]) -> Any:
    """Return what a text stands for, other values as they are."""
    choices = metadata.get("choices")
    parse = metadata.get("parse")
    if not isinstance(value, str):
        return value
    if isinstance(choices, Mapping):
        return choices.get(value, value)
    return value if parse is None else parse(value)


def find_app_modules(name: str) -> list[str]:
    """Return the modules or packages of this name in the apps, and the app of this name.

    It is how the core gets what apps add: it looks for a name in the apps that are installed, and
    knows none of them.
    """
    return [module for each, module in _list_app_modules() if each == name]


@cache
def _list_app_modules() -> list[tuple[str, str]]:
    """Return the apps that are installed, and the modules and packages in each, with their names.

    An app stands before what is in it.
    """
    package = find_spec(APPS)
    places = [] if package is None else list(package.submodule_search_locations or ())
    found = []
    for place in places:
        for app in pkgutil.iter_modules([place]):
            found.append((app.name, f"{APPS}.{app.name}"))
            for module in pkgutil.iter_modules([f"{place}/{app.name}"]):
                found.append((module.name, f"{APPS}.{app.name}.{module.name}"))
    return found


class Registry(Mapping[str, T]):
    """Hold objects by name; every module of `package` may `register` some when it is imported.

    Modules of apps and of other distributions take part. In an app it is the module or package that
    is called as the entry point group, without `asbuilt.`; in another distribution each entry of
    the group names a module. All are imported on first use of the registry, in alphabetical order.

    Parameters
    ----------
    what
        What one object is, for messages, such as `"drive term"`.
    package
        Package whose modules and sub-packages register their objects; None if only apps and other
        distributions have any.
    group
        Entry point group, such as `"asbuilt.drive_terms"`.
    """

    def __init__(self, what: str, package: str | None, group: str) -> None:
        self.what = what
        self.package = package
        self.group = group
        self._objects: dict[str, T] = {}
        self._complete = False

    def register(self, name: str, value: T) -> T:
        """Add an object and return it; raises `UsageError` if another has its name."""
        known = self._objects.setdefault(name, value)
        if known is not value:
            raise UsageError(f"{self.what} {name!r} is registered twice: {known!r} and {value!r}")
        return value

    def find(self, name: str) -> T:
        """Return the object of this name; raises `UsageError` with the nearest and all names."""
        if name in self:
            return self[name]
        if not self:
            raise UsageError(f"no {self.what} is installed")
        raise UsageError(
            f"unknown {self.what} {name!r}; {suggest_name(name, self)}available: {', '.join(self)}"
        )

    def __getitem__(self, name: str) -> T:
        self._load()
        return self._objects[name]

    def __iter__(self) -> Iterator[str]:
        self._load()
        return iter(self._objects)

    def __len__(self) -> int:
        self._load()
        return len(self._objects)

    def _load(self) -> None:
        if self._complete:
            return
        self._complete = True
        places = find_app_modules(self.group.removeprefix("asbuilt."))
        if self.package is not None:
            places.append(self.package)
        below = {name: place for place in places for name in _list_modules(place)}
        # An app's modules stand among the core's as if they were in its package.
        for name in sorted(below, key=lambda name: name.removeprefix(below[name])):
            import_module(name)
        entries = _select_entry_points()(group=self.group)
        for entry in sorted(entries, key=lambda entry: entry.name):
            entry.load()


@cache
def _select_entry_points() -> Callable[..., EntryPoints]:
    """Return what selects entry points, of files that take longer to read than most imports."""
    from importlib.metadata import entry_points  # noqa: PLC0415 - slow

    return entry_points().select


def _list_modules(place: str) -> list[str]:
    """Return the modules below a package, or the module itself."""
    folder = getattr(import_module(place), "__path__", None)
    if folder is None:
        return [place]
    return [package.name for package in pkgutil.walk_packages(folder, f"{place}.")]


@contextmanager
def pause_garbage_collection() -> Iterator[None]:
    """Spare imports and the compiler the collector: it finds little and takes a tenth of the time.

    What an import makes lives to the end.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


Face = tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]
"""`__getattr__`, `__dir__` and `__all__` of a package."""


def attach_face(package: str, file: str) -> Face:
    """Return the face of a package whose names are imported when they are first used.

    The stub next to `file` names them, as `lazy_loader.attach_stub` reads it; lines of an app whose
    folder is missing are passed over.
    """
    stub = Path(file).with_suffix(".pyi")
    names: dict[str, list[str]] = {}
    for node in ast.parse(stub.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom) and _is_installed(stub.parent, str(node.module)):
            names.setdefault(str(node.module), []).extend(alias.name for alias in node.names)
    find, list_all, all_names = lazy_loader.attach(package, submod_attrs=names)

    def find_name(name: str) -> Any:
        with pause_garbage_collection():
            return find(name)

    return find_name, list_all, all_names


def _is_installed(folder: Path, module: str) -> bool:
    """Return whether a module belongs to no app, or to one that is there."""
    first, *below = module.split(".")
    return first != "apps" or (folder / first / below[0]).is_dir()
