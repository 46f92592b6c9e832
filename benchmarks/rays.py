"""Rays per second of `lidar.raycast`, plain embreex, Open3D and a native loop, in turns in one process.

The native loop is C, compiled by gcc -O3 -march=native if gcc is installed. For each packet of 16 it
rotates float64 directions by the rays' float64 poses, rounds them to float32, calls rtcIntersect16 of the
same library on the same scene with the same flags, and writes 8 bytes per ray: Embree's float32 range and
the face number. It has no exact range, cosine, instances, range limits or input checks, and does not retry
rays that miss or hit a back face. It is the upper limit; the table gives ratios to it.

Rays of plain embreex and Open3D are prepared outside the measured time, those of `lidar` and the native
loop within it. Open3D's `cast_rays` always also returns normals and barycentric coordinates.

    python benchmarks/rays.py --triangles 0.1 1 5 --rounds 5 --json rays.json --markdown rays.md
    python benchmarks/rays.py --leaks 10_000_000
"""

from __future__ import annotations

import argparse
import ctypes as c
import json
import shutil
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from lidar.geometry.poses import Poses
from lidar.raycast import Caster
from lidar.raycast.library import library

Float = NDArray[np.float64]

NATIVE = r"""
#include <math.h>
#include <stdint.h>
typedef void (*trace_t)(const int *, void *, void *, void *);
#define W 16
struct packet {
  float ox[W], oy[W], oz[W], near[W], dx[W], dy[W], dz[W], time[W], far[W];
  uint32_t mask[W], id[W], flags[W];
  float ng[3][W], uv[2][W];
  uint32_t prim[W], geom[W], inst[W], place[W];
};
void cast(trace_t trace, void *scene, void *args, const double *position, const double *rotation,
          const int64_t *pose, const double *dirs, const double *origin, long lo, long hi,
          float *t, uint32_t *prim) {
  struct packet p __attribute__((aligned(64)));
  int valid[W] __attribute__((aligned(64)));
  for (long b = lo; b < hi; b += W) {
    int m = hi - b < W ? (int)(hi - b) : W;
    for (int k = 0; k < W; k++) {
      long i = k < m ? b + k : b;
      const double *R = rotation + 9 * pose[i], *o = position + 3 * pose[i], *d = dirs + 3 * i;
      valid[k] = k < m ? -1 : 0;
      p.ox[k] = o[0] - origin[0]; p.oy[k] = o[1] - origin[1]; p.oz[k] = o[2] - origin[2];
      p.dx[k] = R[0] * d[0] + R[1] * d[1] + R[2] * d[2];
      p.dy[k] = R[3] * d[0] + R[4] * d[1] + R[5] * d[2];
      p.dz[k] = R[6] * d[0] + R[7] * d[1] + R[8] * d[2];
      p.near[k] = 0; p.far[k] = INFINITY; p.time[k] = 0;
      p.mask[k] = 0xFFFFFFFFu; p.id[k] = k; p.flags[k] = 0;
      p.geom[k] = p.inst[k] = p.place[k] = 0xFFFFFFFFu;
    }
    trace(valid, scene, &p, args);
    for (int k = 0; k < m; k++) {
      t[b + k] = p.far[k];
      prim[b + k] = p.geom[k] == 0xFFFFFFFFu ? 0xFFFFFFFFu : p.prim[k];
    }
  }
}
"""


@dataclass(frozen=True)
class Row:
    """One measurement: millions of rays per second of CPU and of wall time, medians over the rounds."""

    triangles: int
    sensor: str
    threads: int
    path: str
    cpu: float
    wall: float
    to_native: float | None
    to_embreex: float | None


def city(triangles: float, seed: int = 7) -> tuple[Float, NDArray[np.int32]]:
    """Vertices and faces of boxes along streets on hilly ground, about that many million triangles."""
    rng = np.random.default_rng(seed)
    lots = 50
    half = lots * 15.0 + 60
    cells = int(np.sqrt((triangles * 1e6 - lots * lots * 12) / 2))
    g = np.linspace(-half, half, cells + 1)
    x, y = np.meshgrid(g, g)
    ground = np.column_stack([x.ravel(), y.ravel(), relief(x, y).ravel()])
    i, j = np.meshgrid(np.arange(cells), np.arange(cells))
    k, n = (j * (cells + 1) + i).ravel(), cells + 1
    floor = np.concatenate([np.column_stack([k, k + 1, k + n + 1]), np.column_stack([k, k + n + 1, k + n])])
    row, column = np.divmod(np.arange(lots * lots), lots)
    at = np.stack([column, row], 1) * 30.0 - lots * 15 + 15 + np.where(np.stack([column, row], 1) % 2, -3, 3)
    size = rng.uniform(11, 20, (lots * lots, 2)) / 2
    base = relief(at[:, 0], at[:, 1])
    corner = np.array([[a, b, e] for e in (0, 1) for b in (-1, 1) for a in (-1, 1)], float)
    boxes = np.empty((lots * lots, 8, 3))
    boxes[:, :, :2] = at[:, None] + corner[:, :2] * size[:, None]
    height = np.clip(rng.lognormal(2.4, 0.45, lots * lots), 4, 60)
    boxes[:, :, 2] = base[:, None] - 1 + corner[:, 2] * (height[:, None] + 1)
    faces = (np.arange(lots * lots)[:, None, None] * 8 + BOX).reshape(-1, 3) + len(ground)
    return np.concatenate([ground, boxes.reshape(-1, 3)]), np.concatenate([floor, faces]).astype(np.int32)


BOX = np.array(
    [
        0,
        2,
        1,
        1,
        2,
        3,
        4,
        5,
        6,
        5,
        7,
        6,
        0,
        1,
        4,
        1,
        5,
        4,
        2,
        6,
        3,
        3,
        6,
        7,
        0,
        4,
        2,
        2,
        4,
        6,
        1,
        3,
        5,
        3,
        7,
        5,
    ]
).reshape(-1, 3)


def relief(x: Float, y: Float) -> Float:
    """Height of the ground."""
    return 2.0 * np.sin(x / 170.0) + 1.5 * np.cos(y / 230.0)


def scanner(low: float, high: float, rings: int, columns: int = 1800) -> tuple[Float, NDArray[np.int64]]:
    """Directions and firing columns of a spinning scanner, ring by ring."""
    elevation = np.radians(np.linspace(low, high, rings))
    azimuth = -np.arange(columns) * 2 * np.pi / columns
    e, a = np.meshgrid(elevation, azimuth, indexing="ij")
    d = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1).reshape(-1, 3)
    return d, np.tile(np.arange(columns), rings)


def camera(width: int = 1280, height: int = 720) -> tuple[Float, NDArray[np.int64]]:
    """Directions of a pinhole camera with 90° horizontal field of view, row by row, in vehicle axes."""
    u, v = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    d = np.stack([np.full(u.shape, width / 2), -u, -v], -1).reshape(-1, 3)
    return d / np.linalg.norm(d, axis=1, keepdims=True), np.zeros(width * height, np.int64)


SENSORS: dict[str, Callable[[], tuple[Float, NDArray[np.int64]]]] = {
    "VLP-16": lambda: scanner(-15, 15, 16),
    "HDL-64E": lambda: scanner(-24.9, 2, 64),
    "camera": camera,
}


def drive(frames: int, columns: int) -> list[Poses]:
    """Poses along a street, one per firing column, 1 m of travel per revolution."""
    out = []
    for start in np.linspace(-250, 250, frames):
        x = start + np.linspace(0, 1, columns)
        position = np.column_stack([x, np.zeros(columns), relief(x, np.zeros(columns)) + 1.8])
        out.append(Poses(position, np.tile(np.eye(3), (columns, 1, 1)), np.ones((columns, 3))))
    return out


def native() -> c.CDLL | None:
    """The compiled native loop; None without gcc."""
    if shutil.which("gcc") is None:
        return None
    folder = Path(tempfile.mkdtemp())
    source = folder / "native.c"
    source.write_text(NATIVE)
    built = folder / "native.so"
    subprocess.run(["gcc", "-O3", "-march=native", "-shared", "-fPIC", "-o", built, source], check=True)
    return c.CDLL(str(built))


def paths(vertices: Float, faces: NDArray[np.int32], threads: int) -> dict[str, Callable[..., object]]:
    """Functions by name that cast all rays of (poses, pose numbers, directions)."""
    caster = Caster(vertices, faces)
    out: dict[str, Callable[..., object]] = {
        "lidar": lambda p, k, d: caster.cast_posed(p, k, directions=d, threads=threads),
    }
    loop, lib = native(), library()
    if loop is not None and lib.width == 16:
        trace = c.cast(lib.embree.rtcIntersect16, c.c_void_p)
        target = caster.scene.target

        def run(p: Poses, k: NDArray[np.int64], d: Float) -> object:
            t, prim = np.empty(len(d), np.float32), np.empty(len(d), np.uint32)
            columns = [a.ctypes.data for a in (p.position, p.rotation, k, d, target.origin)]
            head = [c.c_void_p(v) for v in (target.scene, target.packet, *columns)]

            def part(lo: int) -> None:
                hi = min(lo + 8192, len(d))
                loop.cast(
                    trace,
                    *head,
                    c.c_long(lo),
                    c.c_long(hi),
                    c.c_void_p(t.ctypes.data),
                    c.c_void_p(prim.ctypes.data),
                )

            share(part, range(0, len(d), 8192), threads)
            return t

        out["native"] = run
    out["embreex"] = plain_embreex(vertices - caster.origin, faces, caster.origin, threads)
    try:
        import open3d as o3d  # noqa: PLC0415
    except ImportError:
        return out
    scene = o3d.t.geometry.RaycastingScene(nthreads=threads)
    scene.add_triangles(
        o3d.core.Tensor((vertices - caster.origin).astype(np.float32)),
        o3d.core.Tensor(faces.astype(np.uint32)),
    )

    ready: dict[int, object] = {}

    def run_open3d(p: Poses, k: NDArray[np.int64], d: Float) -> object:
        if id(p) not in ready:
            rays = np.concatenate([p.position[k] - caster.origin, p.take(k).directions(d)], 1)
            ready[id(p)] = o3d.core.Tensor(rays.astype(np.float32))
        return scene.cast_rays(ready[id(p)], nthreads=threads)["t_hit"].numpy()

    out["open3d"] = run_open3d
    return out


def plain_embreex(
    vertices: Float, faces: NDArray[np.int32], origin: Float, threads: int
) -> Callable[[Poses, NDArray[np.int64], Float], object]:
    """Embreex's own run() on rays prepared with NumPy outside the measured time."""
    scene = EmbreeScene()
    TriangleMesh(scene, vertices.astype(np.float32), faces)
    ready: dict[int, tuple[NDArray[np.float32], NDArray[np.float32]]] = {}

    def run(p: Poses, k: NDArray[np.int64], d: Float) -> object:
        if id(p) not in ready:
            ready[id(p)] = (
                (p.position[k] - origin).astype(np.float32),
                p.take(k).directions(d).astype(np.float32),
            )
        start, way = ready[id(p)]
        step = -(-len(d) // threads)
        return share(
            lambda lo: scene.run(start[lo : lo + step], way[lo : lo + step], output=1),
            range(0, len(d), step),
            threads,
        )

    return run


def share(work: Callable[[int], object], starts: range, threads: int) -> list[object]:
    """Run the parts on that many threads."""
    if threads == 1:
        return [work(lo) for lo in starts]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, starts))


def measure(triangles: float, sensor: str, threads: int, rounds: int, frames: int) -> list[Row]:
    """Rows of all ray casters, timed in turns."""
    vertices, faces = city(triangles)
    directions, index = SENSORS[sensor]()
    poses = drive(frames, int(index.max()) + 1)
    todo = paths(vertices, faces, threads)
    cpu: dict[str, list[float]] = {name: [] for name in todo}
    wall: dict[str, list[float]] = {name: [] for name in todo}
    for k in range(rounds + 1):
        for name, run in todo.items():
            c0, w0 = time.process_time(), time.perf_counter()
            for p in poses:
                run(p, index, directions)
            if k:  # the first round warms up
                cpu[name].append(len(directions) * frames / (time.process_time() - c0) / 1e6)
                wall[name].append(len(directions) * frames / (time.perf_counter() - w0) / 1e6)

    def ratio(name: str, other: str) -> float | None:
        if other not in todo:
            return None
        rate = cpu if threads == 1 else wall
        return statistics.median(a / b for a, b in zip(rate[name], rate[other], strict=True))

    return [
        Row(
            len(faces),
            sensor,
            threads,
            name,
            statistics.median(cpu[name]),
            statistics.median(wall[name]),
            ratio(name, "native"),
            ratio(name, "embreex"),
        )
        for name in todo
    ]


def leaks(rays: int) -> dict[str, int]:
    """Number, by solid, of rays from inside at its vertices and edges that hit nothing."""
    rng = np.random.default_rng(1)
    turn = trimesh.transformations.euler_matrix(0.3, 0.6, 0.2)
    ball = trimesh.creation.icosphere(subdivisions=4, radius=10.0)
    box = trimesh.creation.box([20, 30, 10])
    solids = {"box": box, "turned box": box.copy().apply_transform(turn), "ball": ball}
    out = {}
    for name, solid in solids.items():
        caster = Caster(solid.vertices, solid.faces)
        edges = solid.vertices[solid.edges_unique]
        missed = 0
        for _ in range(0, rays // len(solids), 200_000):
            e = edges[rng.integers(0, len(edges), 200_000)]
            w = rng.random((200_000, 1)) * (np.arange(200_000) % 2)[:, None]  # half exactly at a vertex
            origins = rng.uniform(-2, 2, (200_000, 3))
            missed += int(
                np.isinf(caster.cast(origins, e[:, 0] + w * (e[:, 1] - e[:, 0]) - origins).range).sum()
            )
        out[name] = missed
    return out


def table(rows: list[Row]) -> str:
    """A Markdown table, one line per scene, sensor and number of threads."""
    paths = ["lidar", "native", "embreex", "open3d"]
    heads = ["triangles", "sensor", "threads", *paths, "to native", "to embreex"]
    lines = [f"| {' | '.join(heads)} |", "|" + "---|" * len(heads)]
    cases: dict[tuple[int, str, int], dict[str, Row]] = {}
    for r in rows:
        cases.setdefault((r.triangles, r.sensor, r.threads), {})[r.path] = r
    for (triangles, sensor, threads), case in cases.items():
        rates = [(case[n].cpu if threads == 1 else case[n].wall) if n in case else None for n in paths]
        cells = [f"{rate:.1f}" if rate is not None else "-" for rate in rates]
        ours = case["lidar"]
        ratios = [f"{v:.2f}" if v is not None else "-" for v in (ours.to_native, ours.to_embreex)]
        label = sensor.replace("camera", "1280 x 720")
        lines.append(f"| {' | '.join([f'{triangles:,}', label, str(threads), *cells, *ratios])} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--triangles", type=float, nargs="+", default=[0.1, 1, 5], help="millions")
    parser.add_argument("--sensors", nargs="+", choices=SENSORS, default=list(SENSORS))
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--frames", type=int, default=10)
    parser.add_argument("--leaks", type=int, default=0, metavar="RAYS", help="count leaks instead")
    parser.add_argument("--markdown", type=Path, help="also write the table to this file")
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    options = parser.parse_args()
    if options.leaks:
        print(f"rays from inside at vertices and edges that hit nothing: {leaks(options.leaks)}")
        return
    for what, program in (("native loop: gcc", shutil.which("gcc")), ("Open3D", find_spec("open3d"))):
        if program is None:
            print(f"{what} is not installed and left out")
    rows: list[Row] = []
    print(f"{'triangles':>9} {'sensor':8} threads {'path':8} M rays/CPU-s  M rays/s  x native  x embreex")
    for triangles in options.triangles:
        for sensor in options.sensors:
            for threads in options.threads:
                found = measure(triangles, sensor, threads, options.rounds, options.frames)
                rows += found
                for r in found:
                    to = [f"{v:9.2f}" if v is not None else " " * 9 for v in (r.to_native, r.to_embreex)]
                    print(
                        f"{r.triangles:9} {r.sensor:8} {r.threads:7} {r.path:8} {r.cpu:12.2f} {r.wall:9.2f}"
                        f" {to[0]} {to[1]}",
                        flush=True,
                    )
    print("\nMillions of rays per second: of CPU time for one thread, of wall time for more.\n")
    print(table(rows))
    if options.markdown:
        options.markdown.write_text(table(rows), "utf-8")
    if options.json:
        options.json.write_text(json.dumps([asdict(r) for r in rows], indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
