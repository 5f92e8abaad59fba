"""Registries: objects by name, from the modules of one package and from other distributions."""

from __future__ import annotations

import difflib
import pkgutil
from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import TypeVar

from asbuilt.errors import UsageError

T = TypeVar("T")


class Registry(Mapping[str, T]):
    """Hold objects by name; every module of `package` may `register` some when it is imported.

    Modules of other distributions take part through the entry point group `group`: each entry
    names a module that registers its objects. All are imported on first use of the registry, in
    alphabetical order.

    Parameters
    ----------
    what
        What one object is, for messages, such as `"drive term"`.
    package
        Package whose modules and sub-packages register their objects.
    group
        Entry point group, such as `"asbuilt.drive_terms"`.
    """

    def __init__(self, what: str, package: str, group: str) -> None:
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
        near = difflib.get_close_matches(name, self, n=1, cutoff=0.5)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise UsageError(f"unknown {self.what} {name!r}; {hint}available: {', '.join(self)}")

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
        from importlib.metadata import entry_points  # noqa: PLC0415 - slow

        self._complete = True
        home = import_module(self.package)
        prefix = f"{self.package}."
        for module in sorted(each.name for each in pkgutil.walk_packages(home.__path__, prefix)):
            import_module(module)
        for entry in sorted(entry_points(group=self.group), key=lambda each: each.name):
            entry.load()
