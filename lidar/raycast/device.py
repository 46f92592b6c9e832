"""Devices that cast rays: the CPU, CUDA devices, and the CPU through Warp, which tests their kernels."""

from __future__ import annotations

import ctypes
import functools
import re
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from geoscene.errors import need
from lidar.errors import BackendError, InputError

CPU = "cpu"
WARP_CPU = "warp-cpu"
_CUDA = r"cuda(:\d{1,3})?"
DEVICES = f"{CPU}, cuda, cuda:N (the N-th CUDA device, from 0), {WARP_CPU} (tests the kernels of CUDA)"
"""The names of devices, for messages."""


def name_fault(name: str) -> str:
    """Description of an invalid device name; empty for a valid one."""
    if name in (CPU, WARP_CPU) or re.fullmatch(_CUDA, name):
        return ""
    return f"device {name!r}: choose one of {DEVICES}"


def check_device(name: str) -> None:
    """Raise the errors of `device` unless a device has this name and is there."""
    if name != CPU:
        device(name)


@functools.cache
def device(name: str) -> WarpDevice:
    """The device of a name other than ``cpu``; one object in a process.

    Raises InputError if there is none, MissingExtraError if Warp is not installed.
    """
    if fault := name_fault(name):
        raise InputError(fault)
    wp = need("warp", "gpu")
    if name != WARP_CPU and not _has_driver():  # Warp would print a warning before the error
        raise InputError(f"`device` {name}: no CUDA driver is there; leave the option out to use the CPU")
    wp.config.log_level = wp.LOG_ERROR
    wp.init()
    if name == WARP_CPU:
        return WarpDevice(wp.get_device("cpu"))
    number, count = int(name.partition(":")[2] or 0), wp.get_cuda_device_count()
    if number >= count:
        there = f"devices 0 to {count - 1} are there" if count else "no CUDA device is there"
        raise InputError(f"`device` {name}: {there}; leave the option out to use the CPU")
    return WarpDevice(wp.get_device(f"cuda:{number}"))


def _has_driver() -> bool:
    """Whether the library of the CUDA driver can be loaded."""
    try:
        ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return False
    return True


class WarpDevice:
    """A compute device of Warp: its name, arrays and launches.

    lock : held while kernels are launched; threads take turns on a device
    """

    def __init__(self, warp_device: Any) -> None:
        self.warp_device = warp_device
        self.lock = threading.Lock()

    def __str__(self) -> str:
        return f"{self.warp_device.name} ({self.warp_device.alias})"

    def upload(self, column: Any, kind: Any = Any) -> Any:
        """A copy of a NumPy array in the memory of the device, or the array itself on the CPU.

        Raises BackendError if there is no memory left, as `empty` does.

        kind : type of Warp of an item, such as a vector; by default that of the array
        """
        import warp as wp  # noqa: PLC0415

        flat = np.ascontiguousarray(column)
        with self._full():
            return wp.array(flat, dtype=kind, device=self.warp_device, copy=not self.warp_device.is_cpu)

    def empty(self, count: int | tuple[int, ...], kind: Any) -> Any:
        """An array of the device for results, with undefined items."""
        import warp as wp  # noqa: PLC0415

        with self._full():
            return wp.empty(count, dtype=kind, device=self.warp_device)

    @contextmanager
    def _full(self) -> Iterator[None]:
        """Raise BackendError where Warp cannot allocate memory."""
        try:
            yield
        except RuntimeError as error:
            advice = "take fewer `workers`, or leave `device` out to use the CPU"
            raise BackendError(f"device {self}: {error}; {advice}") from error
