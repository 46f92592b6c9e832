"""Functions that numba compiles: for which processor, and where their machine code is kept.

Machine code is kept beside the source, in ``__pycache__``; in the user's cache directory where that is
read-only; or where ``NUMBA_CACHE_DIR`` says. It is made for a level of x86-64, not for one processor, so
that a wheel can bring it. It is used as long as the sources are those that it was made from, and the
version of numba the same; else functions are compiled on their first call.
"""

from __future__ import annotations

import functools
import hashlib
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import numba
import numpy as np
from llvmlite.binding import get_host_cpu_features
from numba.core import caching
from numba.core import config as _numba_config
from numba.core.dispatcher import Dispatcher

config: Any = _numba_config
Function = TypeVar("Function", bound=Callable[..., Any])
_PACKAGES = ("geoscene", "lidar")
_V3 = ("avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe")
LEVELS = {
    "x86-64-v4": (*_V3, "avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"),
    "x86-64-v3": _V3,
}
"""Levels of x86-64 (System V ABI, AMD64 supplement, section 3.1.1) and what a processor needs for each, best
first; a processor with less gets code of its own."""


def njit(**options: Any) -> Callable[[Function], Function]:
    """`numba.njit` with the given options, for functions of this package and of `lidar`."""
    decorated: Callable[[Function], Function] = numba.njit(**options)
    return decorated


def level() -> str:
    """The level of x86-64 that functions are compiled for; empty for code for this processor alone."""
    return config.CPU_NAME if config.CPU_NAME in LEVELS else ""


def _set_up() -> None:
    """Choose the processor, unless numba's settings name one, and have numba ask this module for caches."""
    if config.CPU_NAME is None:
        has = dict(get_host_cpu_features())
        fit = (name for name, needs in LEVELS.items() if all(has.get(feature) for feature in needs))
        config.CPU_NAME = next(fit, None)
    if config.CPU_NAME in LEVELS:
        config.CPU_FEATURES = ""
    own = (f"{__name__}.{locator.__name__}" for locator in (_Given, _BesideSource, _OfUser))
    others = config.CACHE_LOCATOR_CLASSES or ",".join(c.__name__ for c in caching.CacheImpl._locator_classes)  # noqa: SLF001
    config.CACHE_LOCATOR_CLASSES = ",".join((*own, others))


class _Own:
    """Of functions of the two packages alone; their code is fresh while no module that it uses changes."""

    _py_file: str

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Any:
        """A locator, or None for functions of other packages."""
        if py_func.__module__.split(".")[0] not in _PACKAGES:
            return None
        found = super().from_function(py_func, py_file)  # type: ignore[misc]
        if found is not None:
            found.stamp = digest(sys.modules[py_func.__module__])
        return found

    def get_source_stamp(self) -> str:
        """The digest of what the function is compiled from."""
        return str(self.stamp)  # type: ignore[attr-defined]


class _Given(_Own, caching.UserProvidedCacheLocator):
    """In the directory that ``NUMBA_CACHE_DIR`` names."""


class _BesideSource(_Own, caching.InTreeCacheLocator):
    """In ``__pycache__`` beside the module."""


class _OfUser(_Own, caching.UserWideCacheLocator):
    """In the user's cache directory, which begins with what an installation brings that is read-only."""

    def ensure_cache_path(self) -> None:
        """Make the directory, and copy the code that lies beside the module into it once."""
        super().ensure_cache_path()  # type: ignore[no-untyped-call]
        folder, source = Path(self.get_cache_path()), Path(self._py_file)  # type: ignore[no-untyped-call]
        for brought in (source.parent / "__pycache__").glob(f"{source.stem}.*.nb[ic]"):
            if not (folder / brought.name).exists():
                shutil.copyfile(brought, folder / brought.name)


@functools.cache
def digest(module: ModuleType) -> str:
    """Digest of the source of a module and of what it imports for its compiled functions.

    These are modules of the packages that compiled functions and types come from, and numbers.
    """
    found = hashlib.sha256(_source(module))
    for name, value in sorted(vars(module).items()):
        home = sys.modules.get(str(getattr(value, "__module__", None)))
        if home and home is not module and home.__name__.split(".")[0] in _PACKAGES:
            found.update(digest(home).encode() if isinstance(value, Dispatcher) else _source(home))
        elif isinstance(value, np.ndarray):
            found.update(value.tobytes())
        elif not name.startswith("__") and _is_constant(value):
            found.update(f"{name}={value!r}\n".encode())
    return found.hexdigest()


@functools.cache
def _source(module: ModuleType) -> bytes:
    return Path(str(module.__file__)).read_bytes()


def _is_constant(value: object) -> bool:
    """Whether compiled code can hold a value, and its text is the same in each process."""
    plain = (bool, int, float, complex, np.number)
    return isinstance(value, plain) or (isinstance(value, tuple) and all(map(_is_constant, value)))


_set_up()
