"""Compile functions ahead of their first call, in processes of their own.

``kernels.json`` of a package lists its compiled functions by use, with the types of their arguments: a name
for numbers; a name, the dimensions and the layout for arrays (``float64 2 C``); a list for tuples, and one
under the name of the class for named tuples. Types that depend on the width of the processor's vectors are
listed under the use and a level of x86-64. Functions that it lacks are compiled on their first call.
``tests/kernels.py`` writes the lists.

python -m geoscene.support.kernels [USE...]   compiles what both packages list, or what they list for the uses
"""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from importlib.util import find_spec
from typing import Any

import numpy as np
from numba.core import types
from numba.np.numpy_support import from_dtype

from geoscene.support.compiled import is_compiled, level
from geoscene.support.processes import run_tasks

PACKAGES = ("geoscene", "lidar")
LIST = "kernels.json"
_Tuple: Any = types.BaseTuple
_NamedTuple: Any = types.BaseNamedTuple
_BESIDE = "--beside"
"""Option of a process that another one starts: it leaves that one a core, and ends with it."""


@dataclass(frozen=True, slots=True)
class Kernel:
    """A compiled function, and the types of arguments that it is called with.

    name      : module and function, with dots
    arguments : descriptions of types, as in ``kernels.json``
    """

    name: str
    arguments: tuple[Any, ...]

    @property
    def function(self) -> Any:
        """The function, of numba's class for compiled functions."""
        module, _, name = self.name.rpartition(".")
        return getattr(importlib.import_module(module), name)

    @property
    def signature(self) -> tuple[Any, ...]:
        """Types of its arguments."""
        return tuple(map(read_type, self.arguments))

    def is_missing(self) -> bool:
        """Whether its machine code for these types is not on disk."""
        return not is_compiled(self.function, self.signature)

    def compile(self) -> None:
        """Compile it and keep the machine code on disk."""
        self.function.compile(self.signature)


def read_type(entry: Any) -> Any:
    """The type that an entry of ``kernels.json`` describes."""
    if isinstance(entry, list):
        return _Tuple.from_types(tuple(map(read_type, entry)))
    if isinstance(entry, dict):
        ((name, fields),) = entry.items()
        return _Tuple.from_types(tuple(map(read_type, fields)), pyclass=_named(name))
    name, *shape = entry.split(" ")
    item = from_dtype(_named(name) if ":" in name else np.dtype(name))
    if not shape:
        return item
    dimensions, layout, *flags = shape
    return types.Array(
        item, int(dimensions), layout, readonly="readonly" in flags, aligned="unaligned" not in flags
    )


def describe_type(kind: Any) -> Any:
    """The entry of ``kernels.json`` for a type; raises TypeError for types that have none."""
    if isinstance(kind, _NamedTuple):
        cls = kind.instance_class
        return {f"{cls.__module__}:{cls.__name__}": list(map(describe_type, kind))}
    if isinstance(kind, _Tuple):
        return list(map(describe_type, kind))
    if isinstance(kind, types.Array):
        flags = " readonly" * (not kind.mutable) + " unaligned" * (not kind.aligned)
        return f"{_describe_item(kind.dtype)} {kind.ndim} {kind.layout}{flags}"
    return _describe_item(kind)


def _describe_item(kind: Any) -> str:
    if isinstance(kind, types.Number | types.Boolean):
        return str(kind)
    for module in [module for name, module in sys.modules.items() if name.startswith(PACKAGES)]:
        for name, value in vars(module).items():
            if isinstance(value, np.dtype) and value.names and from_dtype(value) == kind:
                return f"{module.__name__}:{name}"
    raise TypeError(f"{kind} has no description")


def _named(name: str) -> Any:
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)


def read_kernels(uses: Sequence[str] = ()) -> list[Kernel]:
    """Kernels that the installed packages list for some uses, or for all, on processors of this level.

    Of each use and package those with most code are first.
    """
    found = []
    for package in PACKAGES:
        if find_spec(package):
            listed = json.loads(files(package).joinpath(LIST).read_text("utf-8"))
            for key, entries in listed.items():
                use, _, needs = key.partition(" ")
                if (not uses or use in uses) and needs in ("", level()):
                    found += [Kernel(name, tuple(arguments)) for name, *arguments in entries]
    return found


def compile_kernels(kernels: Sequence[Kernel], *, workers: int) -> None:
    """Compile kernels in worker processes."""
    for _ in run_tasks(Kernel.compile, kernels, workers=workers):
        pass


def compile_ahead(*uses: str, quiet: bool = False) -> None:
    """Start to compile what is missing for some uses in another process, which ends with this one.

    Unless quiet, a line on standard error says so, and another one how long it took. A function that this
    process needs meanwhile is compiled by the process that comes to it first; the other one waits.
    """
    missing = [kernel for kernel in read_kernels(uses) if kernel.is_missing()]
    if not missing:
        return
    begun = time.monotonic()
    if not quiet:
        _say(f"compiling, once, beside other work; functions: {len(missing)}")
    command = [sys.executable, "-m", __name__, _BESIDE, *uses]
    process = subprocess.Popen(command, stdin=subprocess.PIPE)  # noqa: S603

    def wait() -> None:
        code = process.wait()
        if process.stdin:
            process.stdin.close()
        if code == 0 and not quiet:
            _say(f"compiled in {time.monotonic() - begun:.0f} s")

    threading.Thread(target=wait, daemon=True).start()


def _say(text: str) -> None:
    """Print a line on standard error, whole also where several threads print."""
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()


def _end_with_parent() -> None:
    """Exit when the parent process ends and with it the pipe; without a lock of ``sys.stdin``, for forks."""
    os.read(0, 1)
    os._exit(1)


def main() -> None:
    """Compile what is missing."""
    words, cores = sys.argv[1:], os.cpu_count() or 1
    beside = _BESIDE in words
    missing = [kernel for kernel in read_kernels([w for w in words if w != _BESIDE]) if kernel.is_missing()]
    if beside:
        threading.Thread(target=_end_with_parent, daemon=True).start()
        cores = max(cores - 1, 1)
    elif missing:
        _say(f"compiling, once; functions: {len(missing)}")
    begun = time.monotonic()
    compile_kernels(missing, workers=cores)
    if missing and not beside:
        _say(f"compiled in {time.monotonic() - begun:.0f} s")


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:  # the terminal sends it to the program beside, too, which says so
        sys.exit(130)
