"""What is measured: the demo map, real extracts where there are any, and synthetic cities."""

from __future__ import annotations

import functools
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.scene import Scene, open_scene
from geoscene.sources import demo_path, read_osm
from geoscene.typing import Float, Ints
from lidar.options.drive import DriveOptions
from lidar.simulation.plan import DrivePlan, plan_drive

QUICK_BOX = (24.9425, 60.1665, 24.9445, 60.1680)
"""West, south, east, north of the part of the demo that quick runs build, degrees."""

EXTRACTS = ("nyc_lower_east_side.osm.pbf", "helsinki_center.osm.pbf", "monaco.osm.pbf")
"""Extracts that a whole run measures where they exist."""

RIGS = {"VLP-16": "vlp16", "HDL-64E": "hdl64e_s3", "camera": ""}
"""Sensor preset of each rig of one sensor."""

_CAMERA = """[[camera]]
name = "front"
translation = [1.5, 0.0, 1.5]
quat_wxyz = [0.5, -0.5, 0.5, -0.5]
width = 1280
height = 720
fx = 640.0
rate_hz = 10.0
"""


@dataclass(frozen=True)
class Setup:
    """Extent of a run.

    quick       : the demo and small sizes, a few minutes
    repetitions : of each measurement
    folder      : for files of the run
    helios      : the HELIOS++ program; None if none was given
    buildings   : sizes of the growth curve of builds; by default those of the run's extent
    full        : the greatest sizes of all growth curves
    """

    quick: bool
    repetitions: int
    folder: Path
    helios: Path | None = None
    buildings: tuple[int, ...] = ()
    full: bool = False

    def maps(self) -> dict[str, Path]:
        """Map files by name: the demo and, in whole runs, extracts in GEOSCENE_SHARED (default ../shared)."""
        found = {"demo": demo_path()}
        if not self.quick:
            root = Path(os.environ.get("GEOSCENE_SHARED") or Path(__file__).resolve().parents[3] / "shared")
            paths = (root / "osm" / name for name in EXTRACTS)
            found |= {path.name.split(".")[0]: path for path in paths if path.exists()}
        return found

    @functools.cached_property
    def town(self) -> str:
        """Name of the map that is driven through: the first extract, or else the demo."""
        return list(self.maps())[min(1, len(self.maps()) - 1)]

    @functools.cached_property
    def scene(self) -> Scene:
        """The scene of the town."""
        return self.scene_of(self.town)

    @functools.lru_cache  # noqa: B019 - one setup per run
    def scene_of(self, name: str) -> Scene:
        """The scene of a map, built when it is first needed."""
        out = self.folder / f"scene_{name}"
        bounds = QUICK_BOX if self.quick else None
        if not out.exists():
            build(read_osm(self.maps()[name], bounds=bounds), out, options=BuildOptions(name=name))
        return open_scene(out)

    def plan(self, rig: str, *, seconds: float, formats: tuple[str, ...] = ("pcd",)) -> DrivePlan:
        """A drive along a random route through the town."""
        return plan_drive(self.scene, self.options(rig, seconds=seconds, formats=formats))

    def options(
        self, rig: str, *, seconds: float, formats: tuple[str, ...] = ("pcd",), workers: int = 1
    ) -> DriveOptions:
        """Options of a drive with a rig of `RIGS`."""
        return DriveOptions(
            route="random",
            duration=seconds,
            seed=2,
            rig=str(rig_file(rig, self.folder)),
            formats=formats,
            workers=workers,
        )


def rig_file(name: str, folder: Path) -> Path:
    """A rig of `RIGS` on a car's roof, as a file."""
    preset, path = RIGS[name], folder / f"{name}.toml"
    scanner = f'[[lidar]]\nname = "top"\npreset = "{preset}"\ntranslation = [0.95, 0.0, 1.73]\n'
    path.write_text(f'name = "{name}"\nvehicle = "car"\n\n' + (scanner if preset else _CAMERA))
    return path


def boxes_on_hills(triangles: float, *, seed: int = 7) -> tuple[Float, Ints]:
    """Vertices and faces of 2,500 boxes along streets on hilly ground, about that many triangles."""
    rng, lots = np.random.default_rng(seed), 50
    half = lots * 15.0 + 60
    cells = max(int(np.sqrt(max(triangles - lots * lots * 12, 0) / 2)), 2)
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
    faces = (np.arange(lots * lots)[:, None, None] * 8 + _BOX).reshape(-1, 3) + len(ground)
    return np.concatenate([ground, boxes.reshape(-1, 3)]), np.concatenate([floor, faces])


def relief(x: Float, y: Float) -> Float:
    """Height of the ground."""
    return np.asarray(2.0 * np.sin(x / 170.0) + 1.5 * np.cos(y / 230.0))


_BOX = np.array(
    [int(k) for k in "021123456576014154263367042246135375"]  # corners of the twelve faces
).reshape(-1, 3)
