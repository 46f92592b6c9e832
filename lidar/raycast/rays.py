"""Checks rays, arranges them for the kernels and distributes them among threads."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.support.compiled import njit
from geoscene.support.registry import unknown_name
from geoscene.typing import Float
from lidar.errors import InputError
from lidar.geometry.poses import Poses
from lidar.raycast.columns import CHUNK, EXACT, PRECISIONS, RayColumns
from lidar.raycast.geometry import ALL

EXACTLY = (0.0, 0.0)
"""The footprint of rays without width."""


_NO_OFFSETS, _NO_MATRICES = np.empty((0, 3)), np.empty((0, 3, 3))
_NO_OFFSETS.flags.writeable = False  # as of `_rows`
_NONE, _NO_TIMES = np.empty(0, np.int64), np.empty(0, np.float32)
_ENDLESS = np.array([np.inf])


def _rows(values: ArrayLike, name: str) -> Float:
    rows = np.ascontiguousarray(values, np.float64)
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise InputError(f"{name} have the shape {rows.shape}, rays need (n, 3)")
    rows = rows.view()
    rows.flags.writeable = False  # kernels are compiled once, and not again for read-only arrays
    return rows


def free_rays(origins: ArrayLike, directions: ArrayLike) -> RayColumns:
    """Rays in the caster's frame from origins (n, 3) or (3,) and directions (n, 3)."""
    d = _rows(directions, "directions")
    o = np.ascontiguousarray(origins, np.float64)
    o = _rows(o[None] if o.ndim == 1 else o, "origins")
    if len(o) not in (1, len(d)):
        raise InputError(f"{len(o)} origins for {len(d)} directions; give one, or one per ray")
    return _plain(d, o, _NONE, _NO_OFFSETS, _NO_MATRICES)


def posed_rays(
    poses: Poses, pose_index: NDArray[np.integer], *, directions: ArrayLike, offsets: ArrayLike | None
) -> RayColumns:
    """Rays in the frames of poses; see `lidar.raycast.Caster.cast_posed`."""
    d = _rows(directions, "directions")
    o = _NO_OFFSETS if offsets is None else _rows(offsets, "offsets")
    index, count = np.ascontiguousarray(pose_index, np.int64), len(poses.position)
    if len(o) not in (0, 1, len(d)) or index.shape != (len(d),):
        raise InputError(f"{len(d)} directions, {len(o)} offsets and {len(index)} pose numbers disagree")
    if not _numbers(index, count):
        raise InputError(f"a ray has a pose number beyond the {count} poses")
    matrix = poses.rotation if _level(poses.scale) else poses.scale[:, :, None] * poses.rotation
    return _plain(d, o, index, _rows(poses.position, "positions"), np.ascontiguousarray(matrix))


def _plain(d: Float, o: Float, pose: NDArray[np.int64], position: Float, matrix: Float) -> RayColumns:
    return RayColumns(
        d, o, pose, position, matrix, _NONE, _NO_TIMES, 0.0, _ENDLESS, ALL, EXACT, True, EXACTLY, False
    )


@njit(cache=True, nogil=True)
def _numbers(index: Any, count: int) -> Any:
    """Whether all of some numbers are rows of a table."""
    inside = True
    for i in range(len(index)):
        inside &= (index[i] >= 0) & (index[i] < count)
    return inside


@njit(cache=True, nogil=True)
def _level(scale: Any) -> Any:
    """Whether all scales (n, 3) are 1."""
    level = True
    for i in range(len(scale)):
        level &= (scale[i, 0] == 1.0) & (scale[i, 1] == 1.0) & (scale[i, 2] == 1.0)
    return level


@njit(cache=True, nogil=True)
def _permutes(order: Any, named: Any) -> Any:
    """Whether an order names each row once; ``named`` (n,) is zero, and overwritten."""
    for i in range(len(order)):
        row = order[i]
        if not 0 <= row < len(named) or named[row]:
            return False
        named[row] = True
    return len(order) == len(named)


def limit_rays(
    rays: RayColumns,
    *,
    near: float,
    far: float | Float,
    mask: int,
    time: ArrayLike | None,
    order: NDArray[np.integer] | None = None,
    precision: str = PRECISIONS[EXACT],
    retrace: bool = True,
    footprint: tuple[float, float] = EXACTLY,
    scattered: bool = False,
) -> RayColumns:
    """The rays with bounds, mask, times, order of work, precision and footprint.

    Raises InputError unless 0 <= near <= far, times lie within 0 to 1, the order is a permutation, the
    precision one of `PRECISIONS` and the footprint finite and not negative.
    """
    n, moments, work = len(rays.directions), _NO_TIMES, _NONE
    if isinstance(far, float):
        reach, ahead = np.array([far]), far >= near
    else:
        reach = np.ascontiguousarray(far, np.float64).reshape(-1)
        ahead = len(reach) in (1, n) and bool((reach >= near).all())
    if not (near >= 0 and ahead):
        raise InputError("rays need 0 <= near <= far, far one number or one per ray")
    wide, growth = float(footprint[0]), float(footprint[1])
    if not (0.0 <= wide < np.inf and 0.0 <= growth < np.inf):
        raise InputError(f"a footprint of {footprint}: give metres and metres per metre, 0 or more")
    if precision not in PRECISIONS:
        raise InputError(unknown_name("precision", precision, known=PRECISIONS))
    if time is not None:
        moments = np.ascontiguousarray(time, np.float32)
        if not (moments.shape == (n,) and ((moments >= 0) & (moments <= 1)).all()):
            raise InputError(f"ray times are numbers from 0 to 1, one for each of {n} rays")
    if order is not None:
        work = np.ascontiguousarray(order, np.int64)
        if not (work.ndim == 1 and _permutes(work, np.zeros(n, np.bool_))):
            raise InputError(f"order is not a permutation of {n} rays")
    # A microsecond, where `_replace` takes six.
    return RayColumns(
        rays.directions,
        rays.offsets,
        rays.pose,
        rays.position,
        rays.matrix,
        work,
        moments,
        float(near),
        reach,
        int(mask) & ALL,
        PRECISIONS.index(precision),
        bool(retrace),
        (wide, growth),
        bool(scattered),
    )


def in_scene(rays: RayColumns) -> tuple[Float, Float]:
    """Origins and directions (n, 3) in the caster's frame.

    Raises InputError for an invalid ray, as the kernels do.
    """
    d, o = rays.directions, rays.offsets
    if rays.pose.size:
        matrix = rays.matrix[rays.pose]
        d = np.einsum("nij,nj->ni", matrix, d)
        shift = np.einsum("nij,nj->ni", matrix, np.broadcast_to(o, d.shape)) if len(o) else 0.0
        o = rays.position[rays.pose] + shift
    o = np.broadcast_to(o, d.shape)
    with np.errstate(over="ignore", invalid="ignore"):
        squared = np.einsum("ij,ij->i", d, d)
        usable = (squared > 0) & (squared < 1e100) & (np.abs(o).sum(axis=1) < 1e100)
    if not usable.all():
        raise _refusal(rays, int(np.argmin(usable)))
    return o, d


def taken(rays: RayColumns, row: NDArray[np.int64]) -> RayColumns:
    """Selected rays, without an order."""
    return rays._replace(
        directions=_rows(rays.directions.take(row, axis=0), "directions"),
        offsets=_rows(rays.offsets.take(row, axis=0), "origins") if len(rays.offsets) > 1 else rays.offsets,
        pose=rays.pose[row] if len(rays.pose) else rays.pose,
        order=_NONE,
        time=rays.time[row] if len(rays.time) else rays.time,
        far=rays.far[row] if len(rays.far) > 1 else rays.far,
    )


def beyond(rays: RayColumns, at: Float) -> RayColumns:
    """The rest of rays from the ray parameters (n,) on; it is exact, as the rays start on a face."""
    if rays.pose.size:
        origin, direction = in_scene(rays)
        origin = origin + at[:, None] * direction
    else:
        origin, direction = np.empty(rays.directions.shape), rays.directions
        _advance(rays.offsets, direction, at, origin)
    far = np.maximum(rays.far - at, 0.0) if np.isfinite(rays.far).any() else rays.far
    return free_rays(origin, direction)._replace(
        time=rays.time,
        far=far,
        mask=rays.mask,
        retrace=rays.retrace,
        footprint=rays.footprint,
        scattered=rays.scattered,
    )


@njit(cache=True, nogil=True)
def _advance(start: Any, direction: Any, at: Any, out: Any) -> None:
    """Points (n, 3) of rays at parameters (n,)."""
    for i in range(len(out)):
        o = i if len(start) > 1 else 0
        for k in range(3):
            out[i, k] = start[o, k] + at[i] * direction[i, k]


def _refusal(rays: RayColumns, bad: int) -> InputError:
    where = f" at the pose {rays.position[rays.pose[bad]].tolist()}" if rays.pose.size else ""
    if len(rays.offsets):
        where = f" from {rays.offsets[bad if len(rays.offsets) > 1 else 0].tolist()}" + where
    return InputError(
        f"ray {bad} of {len(rays.directions)}, direction {rays.directions[bad].tolist()}{where},"
        " cannot be cast: rays need finite numbers and a direction that is not zero"
    )


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """A persistent thread pool: starting threads takes as long as a small frame."""
    return ThreadPoolExecutor(threads, "rays")


if hasattr(os, "register_at_fork"):  # a forked process has none of its parent's threads
    os.register_at_fork(after_in_child=_pool.cache_clear)


def _parts(n: int, threads: int) -> list[tuple[int, int]]:
    """Bounds of parts of n rays in whole chunks, each two thirds of an equal share of the remaining rays.

    The last part is the smallest, but at least a chunk, so that threads end at about the same time.
    """
    bounds = [0]
    while (left := n - bounds[-1]) > 0:
        end = bounds[-1] + CHUNK * -(-2 * left // (3 * threads * CHUNK))
        bounds.append(end if n - end >= CHUNK else n)
    return list(pairwise(bounds))


def share(work: Callable[[int, int], int], rays: RayColumns, *, threads: int) -> None:
    """Call ``work`` for parts of the order of rays in threads; it returns an invalid ray, or -1.

    Raises InputError for an invalid ray.
    """
    n = len(rays.directions)
    if threads <= 1 or n <= CHUNK:
        bad = work(0, n)
    else:
        parts = iter(_parts(n, threads))  # of which each thread takes the next

        def some() -> int:
            return max((work(lo, hi) for lo, hi in parts), default=-1)

        helpers = [_pool(threads - 1).submit(some) for _ in range(threads - 1)]
        bad = max(some(), *(-1 if helper.cancel() else helper.result() for helper in helpers))
    if bad >= 0:
        raise _refusal(rays, bad)
