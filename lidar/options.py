"""How a drive is made."""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, cast

from geoscene.scene import Scene
from lidar.dataset.recording import Contents
from lidar.errors import InputError
from lidar.planning.route import Side, Spec
from lidar.rig.specs import load_rig, rig_digest
from lidar.settings import settings_of
from lidar.signal.registry import NamedStage, Stages
from lidar.traffic.fcd import TrafficFile
from lidar.traffic.populate import TrafficOptions


@dataclass(frozen=True, slots=True)
class DriveOptions:
    """How a drive is made. Everything here is stored in the dataset and shapes its bytes, but ``workers``.

    route      : ``random``, a GPX or GeoJSON file, waypoints (latitude, longitude) in degrees, or a poses.csv
                 or trajectory.csv of an earlier drive, which is then driven again as it was
    duration   : seconds; a whole route, or 60 seconds of a random one, by default
    from_rest  : a random drive too starts and ends at rest, as drives along a given route do; by default it
                 is under way when the record starts and when it ends
    survey     : area that a craft flies over in strips instead of a route: ``all``, W,S,E,N in degrees, or a
                 GeoJSON file
    altitude   : metres above the ground of a flight, see `lidar.planning.flight_planning.plan_flight`
    overlap    : share of a survey's strip that the next one covers too
    turns      : scanners work in the turns between a survey's strips too, and on the way there
    rig        : name of a rig, or a TOML file
    vehicle    : name of a vehicle, or a TOML file; the rig's by default
    formats    : of clouds, of `lidar.dataset.formats.FORMATS`
    labels     : files of labels in others' codes, of `lidar.dataset.formats.LABELS`
    deskew     : moment (start, middle, end) to which clouds are brought in further files; none by default
    seed       : of everything random, 0 or more
    start      : UTC time of the drive's start; 10:00 local solar time on 21 June 2026 by default
    crs        : of LAZ files: ``utm``, ``scene`` or any pyproj name
    exact      : georeference every point through the projection instead of a bounded affine map
    side       : side of the road, left or right; the scene's by default
    fidelity   : level of `lidar.settings.levels`: draft, standard or survey
    traffic    : other road users and parked cars, as densities or a file of SUMO; none by default
    settings   : single settings that differ from the level, as (name, text)
    stages     : that change echoes, clouds or images, see `lidar.signal`; none by default
    workers    : threads
    """

    route: Spec = "random"
    duration: float | None = None
    from_rest: bool = False
    survey: str = ""
    altitude: float | None = None
    overlap: float = 0.3
    turns: bool = False
    rig: str = "seed"
    vehicle: str = ""
    formats: tuple[str, ...] = ("pcd", "laz")
    labels: tuple[str, ...] = ()
    deskew: str = ""
    seed: int = 0
    start: datetime | None = None
    crs: str = "utm"
    exact: bool = False
    side: str = ""
    fidelity: str = "standard"
    traffic: TrafficOptions | TrafficFile | None = None
    settings: tuple[tuple[str, str], ...] = ()
    stages: tuple[NamedStage, ...] = ()
    workers: int = 2

    def __post_init__(self) -> None:
        """Refuse options that cannot be meant."""
        if self.duration is not None and not 0.1 <= self.duration <= 86400:
            raise InputError(f"`duration` {self.duration}: give 0.1 to 86400 seconds")
        if self.side not in ("", "left", "right"):
            raise InputError(f"`side` {self.side}: left or right")
        if not 1 <= self.workers <= 256:
            raise InputError(f"`workers` {self.workers}: give 1 to 256")
        if not 0 <= self.seed < 1 << 63:
            raise InputError(f"`seed` {self.seed}: give a whole number from 0 on")
        if self.altitude is not None and not 0 < self.altitude <= 20_000:
            raise InputError(f"`altitude` {self.altitude:g}: give metres above the ground, up to 20000")
        if not 0 <= self.overlap < 1:
            raise InputError(f"`overlap` {self.overlap:g}: give a share from 0 to less than 1")
        self.contents()

    def keeps(self, scene: Scene) -> Side:
        """The side of the road that is driven on."""
        return cast("Side", self.side) if self.side else "left" if scene.left_hand else "right"

    def contents(self) -> Contents:
        """What is written of every frame; raises InputError for what cannot be."""
        scanner, camera = settings_of(self.fidelity, self.settings)
        stages = Stages(self.stages, self.seed)
        return Contents(self.formats, self.labels, self.deskew, self.seed, scanner, camera, stages)

    def recipe(self, scene: Scene) -> dict[str, Any]:
        """What the dataset's bytes depend on, as JSON; of files their contents too."""
        given = self.route
        return {
            "scene": scene.manifest.get("fingerprint", scene.path.name),
            "route": _named(given) if isinstance(given, str | Path) else [list(point) for point in given],
            "duration": self.duration,
            "from_rest": self.from_rest,
            "survey": _named(self.survey),
            "altitude": self.altitude,
            "overlap": self.overlap,
            "turns": self.turns,
            "rig": f"{self.rig} ({rig_digest(self.rig)})",
            "vehicle": _named(self.vehicle or load_rig(self.rig).vehicle),
            "formats": list(self.formats),
            "labels": list(self.labels),
            "deskew": self.deskew,
            "seed": self.seed,
            "start": self.start.isoformat() if self.start else None,
            "crs": self.crs,
            "exact": self.exact,
            "side": self.keeps(scene),
            "fidelity": self.fidelity,
            "traffic": self._traffic(scene),
            "settings": [list(pair) for pair in self.settings],
            **({"stages": [stage.to_json() for stage in self.stages]} if self.stages else {}),
        }

    def _traffic(self, scene: Scene) -> dict[str, Any] | None:
        if self.traffic is None:
            return None
        told = asdict(replace(self.traffic, side=self.keeps(scene)))
        return {name: _named(value) if isinstance(value, Path) else value for name, value in told.items()}


def _named(what: str | Path) -> str:
    """A name; of a file with a digest of what is in it, so that a changed one is told from the old."""
    path = Path(what)
    if not str(what) or not path.is_file():
        return str(what)
    return f"{what} ({hashlib.blake2b(path.read_bytes(), digest_size=6).hexdigest()})"
