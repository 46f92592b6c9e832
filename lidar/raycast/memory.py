"""Access of compiled code to raw memory and to Embree's functions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import carray, types  # type: ignore[attr-defined]
from numba.extending import intrinsic

from geoscene.support.compiled import njit

intersect1: Any = types.ExternalFunction("rtcIntersect1", types.void(*[types.int64] * 3))
occluded1: Any = types.ExternalFunction("rtcOccluded1", types.void(*[types.int64] * 3))
_packets: list[Any] = [
    types.ExternalFunction(f"rtc{query}{width}", types.void(*[types.int64] * 4))
    for query in ("Intersect", "Occluded")
    for width in (4, 8, 16)
]
intersect4, intersect8, intersect16, occluded4, occluded8, occluded16 = _packets
"""Embree's tracing functions, by the names that `lidar.raycast.library` registers; all arguments are
addresses."""


def _loader(kind: Any, size: int) -> Any:
    @intrinsic
    def load(context: Any, address: Any, index: Any) -> Any:  # noqa: ARG001
        def build(target: Any, builder: Any, signature: Any, values: Any) -> Any:  # noqa: ARG001
            step = builder.mul(values[1], values[1].type(size))
            place = builder.inttoptr(builder.add(values[0], step), target.get_value_type(kind).as_pointer())
            return builder.load(place)

        return kind(types.int64, types.int64), build

    return load


float64_at = _loader(types.float64, 8)
float32_at = _loader(types.float32, 4)
int64_at = _loader(types.int64, 8)
int32_at = _loader(types.int32, 4)
"""The number at an index of the column at an address."""


def _pointer(kind: Any) -> Any:
    @intrinsic
    def point(context: Any, address: Any) -> Any:  # noqa: ARG001
        def build(target: Any, builder: Any, signature: Any, values: Any) -> Any:  # noqa: ARG001
            return builder.inttoptr(values[0], target.get_value_type(kind).as_pointer())

        pointer: Any = types.CPointer
        return pointer(kind)(types.int64), build

    return point


def _column(kind: Any) -> Any:
    point = _pointer(kind)

    @njit(nogil=True)
    def column(address: Any, shape: Any) -> Any:
        return carray(point(address), shape)

    return column


float64_column = _column(types.float64)
int64_column = _column(types.int64)
int32_column = _column(types.int32)
uint32_column = _column(types.uint32)
"""The column at an address as an array of a shape; the caller keeps the memory."""


_UNCOUNTED: dict[str, Any] = {"_nrt": False}


def _allocator(kind: Any, size: int) -> Any:
    @njit(nogil=True)
    def allocate(count: int) -> Any:
        raw = np.zeros(count + 64 // size, kind)
        start = (-raw.ctypes.data % 64) // size
        return raw[start : start + count]

    return allocate


float64_aligned = _allocator(np.float64, 8)
float32_aligned = _allocator(np.float32, 4)
int32_aligned = _allocator(np.int32, 4)
"""A count of zeros that start at a multiple of 64 bytes."""


def inline(function: Callable[..., Any]) -> Any:
    """The function inlined into its callers, without reference counting of arrays.

    The caller holds the arrays; counting references for every ray would take ten times as long as the rest.
    """
    return njit(nogil=True, error_model="numpy", forceinline=True, **_UNCOUNTED)(function)


def compile_out_of_line(function: Callable[..., Any]) -> Any:
    """The function compiled out of line, for rare cases, without reference counting of arrays."""
    return njit(nogil=True, error_model="numpy", **_UNCOUNTED)(function)


@inline
def vector(address: int, row: int) -> Any:
    """Three numbers of a row of an (n, 3) float64 column."""
    place = address + 24 * row
    return float64_at(place, 0), float64_at(place, 1), float64_at(place, 2)
