"""Names of packages, and previews of objects, whose modules are imported on the first use."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any

_PREVIEWS: dict[str, str] = {}


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
