"""Objects by name, imported when they are used: registries, names of packages, previews in notebooks."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Collection, Iterator, Mapping
from difflib import get_close_matches
from types import MappingProxyType
from typing import Any, Generic, TypeVar

T = TypeVar("T")

_NEAR = 0.6
"""Least similarity of a name that is offered for a misspelt one, 0 to 1."""

_PREVIEWS: dict[str, str] = {}


def nearest(name: str, known: Collection[str]) -> str:
    """The known name that is most like a misspelt one; empty if none is like it."""
    return next(iter(get_close_matches(name, known, 1, _NEAR)), "")


def hint(name: str, known: Collection[str]) -> str:
    """A question with the known name that is meant; empty if none is like the name."""
    near = nearest(name, known)
    return f"; is {near} meant?" if near else ""


def unknown_name(
    what: str,
    name: object,
    *,
    known: Collection[str],
    removed: Mapping[str, str] = MappingProxyType({}),
    remedy: str = "",
) -> str:
    """The message for a name that is not among the known ones.

    what    : what has the name, such as ``stage`` or `` `align` ``
    removed : for names that were known once, what to write instead
    remedy  : how to find the known names, where they are too many to list
    """
    if name in removed:
        return f"{what} {name}: {removed[str(name)]}"
    listed = remedy or f"known are {', '.join(known) or 'none'}"
    return f"{what} {name!r} is unknown{hint(str(name), known)} ({listed})"


def load(place: str) -> Any:
    """The object at ``module:name``; its module is imported here, not before."""
    module, _, name = place.partition(":")
    return getattr(importlib.import_module(module), name)


class Registry(Mapping[str, T], Generic[T]):
    """Objects by the name that users choose them by; those given as ``module:name`` are imported when used.

    what    : what the names are of, for messages
    removed : for names that were known once, what to write instead
    """

    def __init__(
        self,
        what: str,
        places: Mapping[str, str | T],
        *,
        error: type[Exception],
        removed: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """Register objects, or the places of objects; ``error`` is raised for unknown names."""
        self.what, self.removed = what, removed
        self._places, self._error = dict(places), error

    def __getitem__(self, name: str) -> T:
        """The object of a name; raises KeyError for an unknown one, see `find`."""
        found = self._places[name]
        if isinstance(found, str):
            found = self._places[name] = load(found)
        return found

    def __iter__(self) -> Iterator[str]:
        """The names, in the order of registration."""
        return iter(self._places)

    def __len__(self) -> int:
        """Number of names."""
        return len(self._places)

    def __contains__(self, name: object) -> bool:
        """Whether a name is registered; imports nothing."""
        return name in self._places

    def find(self, name: str) -> T:
        """The object of a name; raises the registry's error, with similar names, for an unknown one."""
        self.check([name])
        return self[name]

    def check(self, names: Collection[str]) -> None:
        """Raise the registry's error for the first unknown one of several names."""
        for name in names:
            if name not in self._places:
                raise self._error(unknown_name(self.what, name, known=self._places, removed=self.removed))


def lazily(package: str, homes: Mapping[str, str]) -> Callable[[str], Any]:
    """The ``__getattr__`` of a package that offers names of its modules.

    homes : module in the package of each name, which must not be the name of a module
    """

    def named(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(f"{package}.{homes[name]}"), name)

    return named


def register_previews(modules: Mapping[str, str]) -> None:
    """Register the modules whose functions ``png`` and ``html`` draw an object, by ``module.Class``."""
    _PREVIEWS.update(modules)


class Previewed:
    """Base of classes that notebooks show as a picture and a table of figures."""

    __slots__ = ()

    def _repr_png_(self) -> bytes:
        """A picture from above, for notebooks."""
        return bytes(_preview_of(type(self)).png(self))

    def _repr_html_(self) -> str:
        """The picture and a table of figures, for notebooks."""
        return str(_preview_of(type(self)).html(self))


def _preview_of(kind: type) -> Any:
    """The module that draws objects of a class or of the first of its bases that has one."""
    names = (f"{base.__module__}.{base.__qualname__}" for base in kind.__mro__)
    return importlib.import_module(next(_PREVIEWS[name] for name in names if name in _PREVIEWS))
