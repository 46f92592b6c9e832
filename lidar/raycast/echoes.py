"""All surfaces along a ray: Embree reports every face it passes to a filter, which keeps the nearest."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numba import cfunc, njit, types
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.raycast.columns import Rays, Target
from lidar.raycast.library import ARGUMENT_FILTER, INVALID
from lidar.raycast.memory import aligned, inlined, intersect1, pointer
from lidar.raycast.packets import first_bad, gather, nudge
from lidar.raycast.planes import meet, numbered, placed

carray: Any = vars(numba)["carray"]  # numba does not declare it as its own

_SPARE = 4
"""Faces kept beyond those asked for: float32 and float64 may differ in the order of near faces."""


_ARGUMENTS: Any = types.CPointer(types.int64)  # type: ignore[no-untyped-call]


@cfunc(types.void(_ARGUMENTS), cache=True)
def _collect(arguments: Any) -> None:
    """Keep a face if it is among the nearest; refuse it as a hit so that Embree goes on.

    arguments : RTCFilterFunctionNArguments: valid, user, context, ray, hit, count. After the context's own 8
                bytes stand the room, the number found, and the addresses of their ranges and names
    """
    words = carray(arguments, 6)
    valid = carray(pointer(words[0]), 1, np.int32)
    if valid[0] == 0:
        return
    kept = carray(pointer(words[2] + 8), 4, np.int64)
    t = carray(pointer(words[3]), 12, np.float32)[8]
    hit = carray(pointer(words[4]), 9, np.uint32)
    room = kept[0]
    ranges = carray(pointer(kept[2]), room, np.float32)
    names = carray(pointer(kept[3]), room * 4, np.uint32)
    n = kept[1]
    valid[0] = 0
    for i in range(n):
        same = True
        for j in range(4):
            same &= names[4 * i + j] == hit[5 + j]
        if same:
            return
    if n == room and t >= ranges[room - 1]:
        valid[0] = -1  # nothing farther can count: let it end the ray
        return
    i = min(n, room - 1)
    while i > 0 and ranges[i - 1] > t:
        ranges[i] = ranges[i - 1]
        for j in range(4):
            names[4 * i + j] = names[4 * i - 4 + j]
        i -= 1
    ranges[i] = t
    for j in range(4):
        names[4 * i + j] = hit[5 + j]
    kept[1] = min(n + 1, room)


COLLECT = int(_collect.address or 0)
"""Address of the filter, for `echoes`."""


@inlined
def _pass(target: Target, f: Any, u: Any, kept: Any, arguments: Any) -> Any:
    """Trace one ray through everything; the number of faces kept."""
    u[18] = INVALID
    u[19] = INVALID
    kept[2] = 0
    intersect1(target.scene, f.ctypes.data, arguments.ctypes.data)
    return kept[2]


@inlined
def _resolve(target: Target, n: int, names: Any, work: Any, what: Any, found: Any, cosines: Any) -> Any:
    """Exact ranges of the faces kept, nearest first, within reach; their number.

    found, cosines : range and cosine of each; ``what`` gets face and instance, two rows a face
    """
    count = 0
    for e in range(n):
        row, instance = placed(target, names[4 * e + 1], names[4 * e + 2], names[4 * e + 3])
        prim = np.int64(names[4 * e])
        t, cosine, _, _, _ = meet(target, 1, 0, row, prim, instance, work)
        if t > work[7]:
            continue
        face = numbered(target, row, prim)
        i = count
        while i > 0 and found[i - 1] > t:
            found[i], cosines[i] = found[i - 1], cosines[i - 1]
            what[2 * i], what[2 * i + 1] = what[2 * i - 2], what[2 * i - 1]
            i -= 1
        found[i], cosines[i] = t, cosine
        what[2 * i], what[2 * i + 1] = face, instance
        count += 1
    return count


@njit(nogil=True, cache=True, error_model="numpy")
def echoes(
    target: Target,
    rays: Rays,
    collect: int,
    lo: int,
    hi: int,
    counts: NDArray[np.int32],
    ranges: Float,
    faces: NDArray[np.int32],
    instances: NDArray[np.int32],
    cosines: NDArray[np.float32],
) -> Any:
    """Fill in the columns of `Echoes` for the rays lo to hi; the first bad ray's number, or -1."""
    k = ranges.shape[1]
    room = k + _SPARE
    packet = aligned(128)
    f, u = packet.view(np.float32), packet.view(np.uint32)
    near, names = np.zeros(room, np.float32), np.zeros(4 * room, np.uint32)
    kept = np.zeros(5, np.int64)
    kept[0], kept[1], kept[3], kept[4] = -1, room, near.ctypes.data, names.ctypes.data
    arguments = np.zeros(8, np.int64)
    arguments.view(np.uint32)[0], arguments.view(np.uint32)[1] = ARGUMENT_FILTER, INVALID
    arguments[1], arguments[2] = kept.ctypes.data, collect
    work, ids = np.zeros(9), np.zeros(1, np.int64)
    what = np.zeros(2 * room, np.int64)
    found, cosine = np.zeros(room), np.zeros(room)
    for at in range(lo, hi):
        if not gather(target, rays, at, 1, (0,), ids, work, f):
            return first_bad(1, ids, work)
        u[9] = rays.mask
        count = _resolve(target, _pass(target, f, u, kept, arguments), names, work, what, found, cosine)
        if count == 0 or cosine[0] < 0.0:
            nudge(1, 0, work, f, work[7])
            again = _resolve(target, _pass(target, f, u, kept, arguments), names, work, what, found, cosine)
            if again < count:  # the second look lost a face: the first one counts
                gather(target, rays, at, 1, (0,), ids, work, f)
                _resolve(target, _pass(target, f, u, kept, arguments), names, work, what, found, cosine)
            count = max(count, again)
        i = ids[0]
        counts[i] = min(count, k)
        for e in range(k):
            met = e < count
            ranges[i, e] = found[e] if met else np.inf
            cosines[i, e] = cosine[e] if met else 0.0
            faces[i, e] = what[2 * e] if met else -1
            instances[i, e] = what[2 * e + 1] if met else -1
    return -1
