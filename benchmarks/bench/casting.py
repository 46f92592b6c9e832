"""Subject casting: lidar's caster, native Embree loops, embreex as trimesh calls it, and Open3D.

The native loops are C, compiled by gcc -O3 -march=native if gcc is installed. For each packet, of as many
rays as lidar's, "native" rotates float64 directions by the rays' float64 poses, rounds them to float32, calls
rtcIntersect16, 8 or 4 of the same library on the same scene with the same flags, and writes 8 bytes per ray:
Embree's float32 range and the face number. It has no exact range, cosine, instances, range limits or input
checks, and does not retry rays that miss or hit a back face. It is the upper limit. "native, exact" is the
same loop with the columns of lidar's hits: the range and the cosine in float64 from the plane of the face,
face and instance, 20 bytes per ray. It has no range limits and checks, does not test hits near edges and
does not retry.
"""

from __future__ import annotations

import ctypes as c
import shutil
import subprocess
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from bench.measure import Case
from bench.scenes import Setup, boxes_on_hills, relief
from geoscene.typing import Float, Ints
from lidar.geometry.poses import Poses
from lidar.raycast import Caster
from lidar.raycast.library import library

_NATIVE = Path(__file__).with_name("native.c")

_NOTE = (
    "one thread, same rays. native: 8 bytes per ray, no exact ranges, cosines, checks and retries (upper"
    " limit); native, exact: float64 ranges and cosines, 20 bytes, no checks and retries;"
    " embreex and open3d: rays prepared outside the measured time, float32 ranges; open3d also"
    " returns normals and barycentric coordinates"
)

Work = Callable[[], object]


def casting(setup: Setup) -> Iterator[Case]:
    """Rays of two scanners and a camera in synthetic cities."""
    loop = native(setup.folder)
    for triangles in (1e5,) if setup.quick else (1e5, 1e6, 5e6) if setup.full else (1e5, 1e6):
        vertices, faces = boxes_on_hills(triangles)
        for sensor in ("VLP-16",) if setup.quick else SENSORS:
            directions, index = SENSORS[sensor]()
            frames = round((6e5 if setup.quick else 4e6) / len(directions)) + 1
            poses = street(frames, int(index.max()) + 1)
            sides = casters(vertices, faces, loop=loop, poses=poses, index=index, directions=directions)
            rays = len(directions) * frames / 1e6
            yield Case("casting", f"{sensor}, {len(faces):,} triangles", rays, "M rays", sides, _NOTE)
            if sensor == "VLP-16":
                yield Case(
                    "casting",
                    f"{sensor}, {len(faces):,} triangles, threads",
                    rays,
                    "M rays",
                    sides=shared(vertices, faces, loop=loop, poses=poses, index=index, directions=directions),
                    note="threads share each frame of 28,800 rays; native: each casts half of the frames",
                    clock="wall",
                )


def missing() -> list[str]:
    """Sentences about references that are not installed."""
    lacks = {"native loop: gcc": shutil.which("gcc"), "Open3D": find_spec("open3d")}
    return [f"{name} is not installed: left out of casting" for name, found in lacks.items() if found is None]


def casters(
    vertices: Float,
    faces: Ints,
    *,
    loop: c.CDLL | None,
    poses: list[Poses],
    index: Ints,
    directions: Float,
) -> dict[str, Work]:
    """Functions by name that cast all rays of all poses and return the ranges of the last."""
    caster = Caster(vertices, faces)
    sides: dict[str, Work] = {
        "lidar": lambda: [caster.cast_posed(p, index, directions=directions) for p in poses][-1].range
    }
    if loop is not None:
        for name, exact in (("native", False), ("native, exact", True)):
            sides[name] = lambda exact=exact: [
                native_ranges(loop, caster, p, index, directions, exact=exact) for p in poses
            ][-1]
    here = vertices - caster.origin
    rays = [(p.position[index] - caster.origin, p.take(index).directions(directions)) for p in poses]
    engine = EmbreeScene()
    TriangleMesh(engine, here.astype(np.float32), faces.astype(np.int32))
    single = [(start.astype(np.float32), way.astype(np.float32)) for start, way in rays]
    sides["embreex"] = lambda: [engine.run(*pair, output=1)["tfar"] for pair in single][-1]
    if find_spec("open3d") is not None:
        sides["open3d"] = _open3d(here, faces, single)
    return sides


def shared(
    vertices: Float,
    faces: Ints,
    *,
    loop: c.CDLL | None,
    poses: list[Poses],
    index: Ints,
    directions: Float,
) -> dict[str, Work]:
    """Functions by name that cast all rays of all poses by two threads and by one.

    Threads of lidar share the rays of a pose. Those of the native loop share poses: the limit of the machine.
    """
    caster = Caster(vertices, faces)

    def cast(threads: int) -> None:
        for p in poses:
            caster.cast_posed(p, index, directions=directions, threads=threads)

    def cast_native(part: list[Poses]) -> None:
        for p in part:
            native_ranges(loop, caster, p, index, directions, exact=True)

    def by_two() -> None:
        other = Thread(target=cast_native, args=(poses[1::2],))
        other.start()
        cast_native(poses[::2])
        other.join()

    sides: dict[str, Work] = {"2 threads": lambda: cast(2), "1 thread": lambda: cast(1)}
    if loop is not None:
        sides |= {"native, 2 threads": by_two, "native, 1 thread": lambda: cast_native(poses)}
    return sides


def _open3d(vertices: Float, faces: Ints, rays: list[tuple[NDArray[np.float32], ...]]) -> Work:
    import open3d as o3d  # noqa: PLC0415 - optional

    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(
        o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(faces.astype(np.uint32))
    )
    ready = [o3d.core.Tensor(np.concatenate(pair, axis=1)) for pair in rays]
    return lambda: [scene.cast_rays(tensor, nthreads=1)["t_hit"].numpy() for tensor in ready][-1]


def native(folder: Path) -> c.CDLL | None:
    """The native loops, compiled for this machine's packets; None without gcc or packets."""
    if shutil.which("gcc") is None or library().width == 1:
        return None
    built = folder / "native.so"
    subprocess.run(
        ["gcc", "-O3", "-march=native", f"-DW={library().width}", "-shared", "-fPIC", "-o", built, _NATIVE],
        check=True,
    )
    return c.CDLL(str(built))


def native_ranges(
    loop: c.CDLL, caster: Caster, poses: Poses, index: Ints, directions: Float, *, exact: bool
) -> NDArray[np.floating]:
    """Ranges of one of the native loops; exact ones need a caster of one mesh without instances."""
    lib, target, n = library(), caster.scene.target, len(directions)
    columns = (poses.position, poses.rotation, index, directions, target.origin)
    out: list[NDArray[Any]] = [np.empty(n, np.float64 if exact else np.float32), np.empty(n, np.int32)]
    if exact:
        out += np.empty(n, np.int32), np.empty(n, np.float32), caster.scene.parts[0].planes
    trace = c.cast(getattr(lib.embree, f"rtcIntersect{lib.width}"), c.c_void_p)
    addresses = (target.scene, target.packet, *(a.ctypes.data for a in columns))
    (loop.cast_planes if exact else loop.cast)(
        trace,
        *(c.c_void_p(address) for address in addresses),
        c.c_long(0),
        c.c_long(n),
        *(c.c_void_p(column.ctypes.data) for column in out),
    )
    return out[0]


def _scanner(low: float, high: float, *, rings: int) -> tuple[Float, Ints]:
    """Directions and firing columns of a spinning scanner of 1,800 columns, ring by ring."""
    elevation, columns = np.radians(np.linspace(low, high, rings)), 1800
    azimuth = -np.arange(columns) * 2 * np.pi / columns
    e, a = np.meshgrid(elevation, azimuth, indexing="ij")
    d = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1).reshape(-1, 3)
    return d, np.tile(np.arange(columns), rings)


def _camera() -> tuple[Float, Ints]:
    """Directions of a pinhole camera with 90° horizontal field of view, row by row, in vehicle axes."""
    width, height = 1280, 720
    u, v = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    d = np.stack([np.full(u.shape, width / 2), -u, -v], -1).reshape(-1, 3)
    return d / np.linalg.norm(d, axis=1, keepdims=True), np.zeros(width * height, np.int64)


SENSORS: dict[str, Callable[[], tuple[Any, Any]]] = {
    "VLP-16": lambda: _scanner(-15, 15, rings=16),
    "HDL-64E": lambda: _scanner(-24.9, 2, rings=64),
    "1280 x 720": _camera,
}


def street(frames: int, columns: int) -> list[Poses]:
    """Poses along a street, one per firing column, 1 m of travel per revolution."""
    out = []
    for start in np.linspace(-250, 250, frames):
        x = start + np.linspace(0, 1, columns)
        position = np.column_stack([x, np.zeros(columns), relief(x, np.zeros(columns)) + 1.8])
        out.append(Poses(position, np.tile(np.eye(3), (columns, 1, 1)), np.ones((columns, 3))))
    return out
