"""Functions that numba compiles: for which processor, and where their machine code is kept.

Machine code is kept beside the source, in ``__pycache__``; in the user's cache directory where that is
read-only; or where ``NUMBA_CACHE_DIR`` says. It is made for a level of x86-64, not for one processor, so
that a wheel can bring it. It is used as long as the sources are those that it was made from, and the
version of numba the same; else functions are compiled on their first call.
"""

from __future__ import annotations

import functools
import gc
import glob
import hashlib
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import numba
import numpy as np
from llvmlite.binding import get_host_cpu_features
from numba.core import caching, types
from numba.core import config as _numba_config
from numba.core.dispatcher import Dispatcher
from numba.core.runtime.nrt import rtsys

from geoscene.support.optimised import OwnCompiler

try:
    import fcntl
except ImportError:  # on Windows
    fcntl = None  # type: ignore[assignment]

config: Any = _numba_config
_njit: Any = numba.njit  # its types lack options
_unliteral: Any = types.unliteral
Function = TypeVar("Function", bound=Callable[..., Any])
_PACKAGES = ("geoscene", "lidar")
_V3 = ("avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe")
LEVELS = {"x86-64-v4": (*_V3, "avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"), "x86-64-v3": _V3}
"""Levels of x86-64 (System V ABI, AMD64 supplement, section 3.1.1) and what a processor needs for each, best
first; a processor with less gets code of its own."""


def njit(
    *, cache: bool = False, needs: Callable[[], object] | None = None, **options: Any
) -> Callable[[Function], Function]:
    """`numba.njit` with the given options, for functions of this package and of `lidar`.

    cache : keep the machine code on disk
    needs : is called before the function is compiled or its machine code loaded, to load a library
    """

    def decorated(function: Function) -> Function:
        found = _njit(no_cfunc_wrapper=True, pipeline_class=OwnCompiler, **options)(function)
        if isinstance(found, Dispatcher):  # a plain function where numba is told not to compile
            part = _Part(function, options)
            found.get_call_template, found.get_overload = part.get_call_template, part.get_overload  # type: ignore[method-assign]
            if cache:
                found._cache = _Cache(function)  # type: ignore[attr-defined]
                found.compile = functools.partial(_compile_once, found, needs=needs)  # type: ignore[method-assign]
        return found  # type: ignore[no-any-return]

    return decorated


def _compile_once(function: Any, signature: Any, *, needs: Callable[[], object] | None) -> Any:
    """Load or compile a function; if another process is compiling it, wait for its machine code."""
    if needs is not None:
        needs()
    if is_compiled(function, signature):
        return Dispatcher.compile(function, signature)
    with function._cache.lock(), _without_collection():
        return Dispatcher.compile(function, signature)


@contextmanager
def _without_collection() -> Iterator[None]:
    """Search for no cyclic garbage: of the many objects of a compilation few are."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def is_compiled(function: Any, signature: tuple[Any, ...]) -> bool:
    """Whether the machine code of a function for types of arguments is on disk."""
    return bool(function._cache.has(signature, function.targetctx))


class _Part:
    """A function as other compiled functions call it, without what Python needs to call it."""

    def __init__(self, function: Callable[..., Any], options: Mapping[str, Any]) -> None:
        self._function, self._options = function, options

    @functools.cached_property
    def _compiled(self) -> Any:
        wrappers = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
        return _njit(**wrappers, **self._options)(self._function)

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Types of a call, for the caller's compilation; compiles the function for them.

        Constants count as numbers: numba would compile the function for each of them.
        """
        named = {name: _unliteral(kind) for name, kind in kws.items()}
        return self._compiled.get_call_template(tuple(map(_unliteral, args)), named)

    def get_overload(self, sig: Any) -> Any:
        """The function for types of arguments, as `get_call_template` compiled it."""
        return self._compiled.get_overload(sig)


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
    others = config.CACHE_LOCATOR_CLASSES or ",".join(c.__name__ for c in caching.CacheImpl._locator_classes)
    config.CACHE_LOCATOR_CLASSES = ",".join((*own, others))


class _Cache(caching.NullCache):
    """Machine code of a function on disk.

    Most functions are part of the code of others and never read, so files are sought when the first is.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    @functools.cached_property
    def _of_function(self) -> _FunctionCache:
        return _FunctionCache(self._function)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The machine code for types of arguments; None if there is none."""
        return self._of_function.load_overload(sig, target_context)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep the machine code for types of arguments."""
        self._of_function.save_overload(sig, data)  # type: ignore[no-untyped-call]

    def has(self, sig: Any, target_context: Any) -> bool:
        """Whether there is machine code for types of arguments."""
        return self._of_function.has(sig, target_context)

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the right to compile the function against other threads and processes."""
        with self._of_function.lock_path.open("w") as file:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX)
            yield


class _FunctionCache(caching.FunctionCache):
    """Machine code of a function on disk, which several processes may write at a time."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        stamp = self._impl.locator.get_source_stamp()
        self._cache_file = _Files(self._cache_path, self._impl.filename_base, stamp)  # type: ignore[no-untyped-call]
        self.lock_path = Path(self._cache_path, f"{self._impl.filename_base}.lock")

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The machine code for types of arguments; None if there is none.

        It needs numba's runtime alone. What numba's own method does first, loading all that is needed to
        compile, takes as long as importing numba.
        """
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)  # type: ignore[no-untyped-call]

    def has(self, sig: Any, target_context: Any) -> bool:
        """Whether there is machine code for types of arguments."""
        key = self._index_key(sig, target_context.codegen())  # type: ignore[no-untyped-call]
        return key in self._cache_file._load_index()  # type: ignore[no-untyped-call]


class _Files(caching.IndexDataCacheFile):
    """An index of types of arguments, and a file of machine code for each.

    Files of machine code are named after their contents and written before they are listed. Those that
    numba numbers can be of another process, for other types or of older sources, and crash when they are run.
    """

    def save(self, key: Any, data: Any) -> None:
        """Save machine code, and remove entries of older sources."""
        code: bytes = self._dump(data)  # type: ignore[no-untyped-call]
        name = self._data_name_pattern.replace("{number:d}", hashlib.sha256(code).hexdigest()[:16])
        with self._open_for_write(self._data_path(name)) as file:  # type: ignore[no-untyped-call]
            file.write(code)
        listed = self._load_index() | {key: name}
        self._save_index(listed)  # type: ignore[no-untyped-call]
        if len(listed) == 1:
            folder, base = Path(self._cache_path), self._data_name_pattern.split(".{")[0]
            for old in folder.glob(f"{glob.escape(base)}.*.nbc"):
                if old.name != name:
                    old.unlink(missing_ok=True)

    def _load_index(self) -> dict[Any, str]:
        """Listed types and files; none if the types are of classes that the sources no longer have."""
        try:
            listed: dict[Any, str] = super()._load_index()  # type: ignore[no-untyped-call]
        except (AttributeError, ImportError):
            return {}
        return listed


class _Own:
    """Cache locator for our own functions; entries are stale once an imported module changes."""

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
    """Cache locator for ``__pycache__`` beside the module."""


class _OfUser(_Own, caching.UserWideCacheLocator):
    """In the user's cache directory, which begins with what an installation brings that is read-only."""

    def ensure_cache_path(self) -> None:
        """Create the directory, and copy the code beside the module into it once."""
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
