"""Pulses per second from a scene on disk to LAS files: a VLP-16 drives through a synthetic city.

The city comes from a generator program: called with a folder, it writes ``city.npz`` (V, F, part, bid) and
``route.csv`` (t, x, y, z, yaw_deg) there. The benchmark converts them to a scene directory and a trajectory
and records the drive like ``lidar drive``, each time in a new process: figures include imports, loading,
scanning and writing. An uncounted run compiles the kernels to disk.

    python benchmarks/pulses.py MAKE_CITY --seconds 60 --rays 1 7 19 61 --json pulses.json

Rates are those of the whole process and of the drive without imports, per second of wall time and per second
of CPU time (which other programs on the machine affect less).
"""

from __future__ import annotations

import argparse
import hashlib
import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

_TILE = 250.0  # metres
_START = datetime(2026, 6, 21, 10, tzinfo=UTC)


def convert(city: Path, out: Path) -> None:
    """Write the generator's city as a scene in ``out`` / scene, and its route as a trajectory."""
    from geoscene.classes import Class, materials  # noqa: PLC0415
    from geoscene.files import write_json  # noqa: PLC0415
    from geoscene.frames import Frame  # noqa: PLC0415
    from geoscene.mesh import Mesh  # noqa: PLC0415
    from geoscene.scene.layout import SCHEMA, SceneFiles  # noqa: PLC0415
    from geoscene.scene.tile_files import Tile, write_shapes, write_tile  # noqa: PLC0415
    from lidar.geometry.poses import Trajectory  # noqa: PLC0415
    from lidar.geometry.trajectory_csv import write_trajectory  # noqa: PLC0415

    made = np.load(city / "city.npz")
    vertices, faces, built, building = made["V"], made["F"], made["part"] == 1, made["bid"]
    codes = {name: material.code for name, material in materials().items()}
    whole = Mesh.of(
        vertices,
        faces,
        feature=building,
        klass=np.where(built, Class.BUILDING, Class.TERRAIN),
        material=np.where(built, codes["plaster"], codes["asphalt"]),
        closed=built,
    )
    # A building belongs to the tile of its centre, a face of the ground to the tile of its own centre.
    middle = vertices[faces, :2].mean(axis=1)
    owner = np.where(built, building, building.max() + 1 + np.arange(len(faces)))
    _, owner = np.unique(owner, return_inverse=True)
    count = np.bincount(owner)
    place = np.stack([np.bincount(owner, middle[:, k]) / count for k in (0, 1)], axis=1)[owner]
    square = np.floor(place / _TILE).astype(int)
    folder = out / "scene"
    files = SceneFiles(folder)
    files.tiles.mkdir(parents=True)
    indices = np.unique(square, axis=0)
    for i, j in indices.tolist():
        origin = np.array([i * _TILE, j * _TILE, 0.0])
        part = whole.take((square == (i, j)).all(axis=1))
        write_tile(files.tile(i, j), Tile(origin, part.shifted(-origin)))
    write_shapes(files.shapes, {})
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    frame = Frame.at(2.0, 48.0, crs="utm")
    document = {
        "schema": SCHEMA,
        "name": "city",
        "frame": frame.to_json(),
        "bounds": [*low[:2].tolist(), *high[:2].tolist()],
        "tile_size": _TILE,
        "tiles": [(i, j, 1) for i, j in indices.tolist()],
        "layers": {"buildings": [0, int(building.max()) + 1]},
    }
    write_json(files.manifest, document)

    t, x, y, z, yaw_deg = np.loadtxt(city / "route.csv", delimiter=",", skiprows=1).T
    time_ns = np.round(t * 1e9).astype(np.int64)
    position = np.column_stack([x, y, z])
    half = np.radians(yaw_deg) / 2
    turn = np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], axis=1)
    scale = frame.scale_at(x, y)
    speed = np.gradient(position, t, axis=0)
    write_trajectory(out / "trajectory.csv", Trajectory(time_ns, position, turn, speed, scale))


def record(work: Path, out: Path, *, rays: int, seconds: float, workers: int) -> dict[str, float]:
    """Record the drive; returns seconds per stage and the number of points."""
    began = time.perf_counter()
    from geoscene.scene.layout import open_scene  # noqa: PLC0415
    from lidar.dataset.recording import Contents, Recording  # noqa: PLC0415
    from lidar.geometry.georeference import Georeference, export_crs  # noqa: PLC0415
    from lidar.geometry.trajectory_csv import read_trajectory  # noqa: PLC0415
    from lidar.pipeline import record_all  # noqa: PLC0415
    from lidar.plan import schedule  # noqa: PLC0415
    from lidar.rig.devices import scanners  # noqa: PLC0415
    from lidar.rig.specs import load_rig  # noqa: PLC0415
    from lidar.settings import settings_of  # noqa: PLC0415

    imported, imported_cpu = time.perf_counter(), time.process_time()
    scene = open_scene(work / "scene")
    trajectory = read_trajectory(work / "trajectory.csv").until(round(seconds * 1e9))
    sensors = scanners(load_rig("vlp16"))
    geo = Georeference(scene.frame, export_crs(scene.frame))
    settings, _ = settings_of("standard", [("rays", str(rays))])
    recording = Recording(
        out,
        scene.frame,
        trajectory=trajectory,
        start=_START,
        geo=geo,
        contents=Contents(("las",), scanner=settings),
    )
    jobs = schedule(sensors, trajectory.duration_ns)
    points = record_all(recording, jobs, scene=scene, workers=workers)
    ended = time.perf_counter()
    return {
        "import_s": imported - began,
        "loop_s": ended - imported,
        "loop_cpu_s": time.process_time() - imported_cpu,
        "points": sum(points.values()),
        **recording.watch.seconds,
    }


def load(work: Path) -> dict[str, float]:
    """Load the whole scene; returns the seconds without imports."""
    from geoscene.scene.layout import open_scene  # noqa: PLC0415
    from lidar.world.world import World  # noqa: PLC0415

    began = time.perf_counter()
    world = World.load(open_scene(work / "scene"))
    hit = world.caster.cast([0.0, 0.0, 100.0], [[0.0, 0.0, -1.0]]).range
    return {"load_s": time.perf_counter() - began, "below_m": float(hit[0])}


def child(arguments: dict[str, Any]) -> dict[str, float]:
    """What `record` or `load` returns in its own process, with wall and CPU seconds and peak MiB."""
    command = [sys.executable, __file__, "--child", json.dumps(arguments)]
    began = time.perf_counter()
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    found: dict[str, float] = json.loads(done.stdout)
    return found | {"wall_s": time.perf_counter() - began}


def pulses(work: Path, seconds: float) -> int:
    """Pulses fired in the drive."""
    from lidar.geometry.trajectory_csv import read_trajectory  # noqa: PLC0415
    from lidar.rig.devices import scanners  # noqa: PLC0415
    from lidar.rig.scanner import firings  # noqa: PLC0415
    from lidar.rig.specs import load_rig  # noqa: PLC0415

    duration = read_trajectory(work / "trajectory.csv").until(round(seconds * 1e9)).duration_ns
    (scanner,) = scanners(load_rig("vlp16"))
    return sum(len(firings(scanner.sensor, k)) for k in range(scanner.frame_count(duration)))


def digest(folder: Path) -> str:
    """Digest of names and contents of all files of a folder."""
    total = hashlib.blake2b()
    for path in sorted(folder.rglob("*.las")):
        total.update(path.name.encode() + hashlib.blake2b(path.read_bytes()).digest())
    return total.hexdigest()


def measure(work: Path, rays: int, seconds: float) -> dict[str, float]:
    """One row: the drive with one and with two workers, each in a new process."""
    found, kept = {}, set()
    for workers in (1, 2):
        out = work / "out"
        found[workers] = child(
            {"work": str(work), "out": str(out), "rays": rays, "seconds": seconds, "workers": workers}
        )
        kept.add(digest(out))
        shutil.rmtree(out)
    total, two = pulses(work, seconds), found[2]
    return {
        "rays": rays,
        "seconds": seconds,
        "pulses": total,
        "rate": total / two["wall_s"],
        "rate_loop": total / two["loop_s"],
        "rate_cpu": total / two["loop_cpu_s"],
        "rate_one_worker": total / found[1]["wall_s"],
        "same_bytes": len(kept) == 1,
        **two,
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("generator", type=Path, nargs="?", help="program that makes the city")
    parser.add_argument(
        "--seconds", type=float, default=60.0, help="length of the drive at one ray per pulse"
    )
    parser.add_argument("--rays", type=int, nargs="+", default=[1, 7, 19, 61])
    parser.add_argument("--rounds", type=int, default=1, help="rounds; the best one counts")
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        task = json.loads(options.child)
        work = Path(task.pop("work"))
        found = record(work, Path(task.pop("out")), **task) if "out" in task else load(work)
        used = resource.getrusage(resource.RUSAGE_SELF)
        print(json.dumps(found | {"peak_mib": used.ru_maxrss / 1024, "cpu_s": used.ru_utime + used.ru_stime}))
        return
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        subprocess.run([sys.executable, options.generator, work], check=True)
        convert(work, work)
        measure(work, 7, 1.0)  # compiles the kernels
        loads = [child({"work": str(work)}) for _ in range(3)]
        quickest = min(loads, key=lambda row: row["load_s"])
        print(
            f"whole scene loaded in {quickest['load_s']:.2f} s,"
            f" process {quickest['peak_mib']:.0f} MiB\n"
            "rays driven s  pulses   wall s  k pulses/s  without imports  per core s"
            "  1 worker  peak MiB  same bytes"
        )
        rows = []
        for rays in options.rays:
            # Several rays per pulse take longer: an eighth of the drive outweighs the imports.
            seconds = options.seconds if rays == 1 else max(options.seconds / 4, 2.0)
            row = max((measure(work, rays, seconds) for _ in range(options.rounds)), key=lambda r: r["rate"])
            rows.append(row)
            print(
                f"{rays:4} {seconds:8.1f} {row['pulses']:8} {row['wall_s']:7.2f} {row['rate'] / 1e3:11.0f}"
                f" {row['rate_loop'] / 1e3:16.0f}"
                f" {row['rate_cpu'] / 1e3:11.0f} {row['rate_one_worker'] / 1e3:9.0f}"
                f" {row['peak_mib']:9.0f}  {row['same_bytes']}",
                flush=True,
            )
    if options.json:
        options.json.write_text(json.dumps({"load": loads, "rows": rows}, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
