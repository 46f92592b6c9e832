"""Defences by name: read from text, and run over the frames of a dataset."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Container, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from geoscene.scene import Scene
from geoscene.support.progress import Progress, silent
from geoscene.support.registry import Registry
from geoscene.support.storage import url_of
from lidar.errors import InputError
from lidar.geometry.random_streams import generator
from lidar.parameters import Item, build, parameter_rows, read_items
from lidar.tools.defences.defence import Defence, Verdict, Window
from lidar.tools.defences.observation import Observation, RecordedScans
from lidar.world.world import World

DEFENCES: Registry[type[Defence]] = Registry(
    "defence",
    {
        "occlusion": "lidar.tools.defences.boxes:Occlusion",
        "shadow": "lidar.tools.defences.boxes:Shadow",
        "temporal": "lidar.tools.defences.boxes:Temporal",
        "void": "lidar.tools.defences.missing:Void",
        "azimuth": "lidar.tools.defences.missing:Azimuth",
        "overlay": "lidar.tools.defences.overlay:Overlay",
        "map": "lidar.tools.defences.missing:Map",
        "navigation": "lidar.tools.defences.navigation:NavigationDefence",
        "physics": "lidar.tools.defences.returns:Physics",
        "statistical": "lidar.tools.defences.returns:StatisticalDefence",
        "timing": "lidar.tools.defences.returns:Timing",
        "watermark": "lidar.tools.defences.returns:WatermarkDefence",
    },
    error=InputError,
)
"""Classes of defences by name."""

_AROUND = 20.0
"""Metres around the vehicle's path during a frame that its region covers."""

DETECTOR = "detector"
"""Name of the time that boxes and their returns take, which defences share."""


@dataclass(frozen=True, slots=True)
class NamedDefence:
    """A defence that is switched on; ``named`` by the user, not one of all."""

    name: str
    defence: Defence
    named: bool = True

    def to_json(self) -> dict[str, Any]:
        """Its name and parameters."""
        return {"name": self.name, **asdict(self.defence)}


def read_defences(texts: Iterable[str]) -> tuple[NamedDefence, ...]:
    """Defences from texts ``NAME:KEY=VALUE,KEY=VALUE``; several are separated by commas.

    texts : also ``all`` for those that the data allow, and files ``FILE.toml`` with tables ``[[defence]]``

    Raises InputError for a defence or parameter that is unknown or given twice, or a value out of its bounds.
    """
    found: dict[str, NamedDefence] = {}
    for item in read_items(texts, {"all", *DEFENCES}, table="defence"):
        is_all = item.name == "all" and not item.values
        for one in map(Item, DEFENCES) if is_all else [item]:
            if one.name in found:
                raise InputError(f"defence {one.name}: given twice")
            found[one.name] = NamedDefence(one.name, build(DEFENCES, one), named=not is_all)
    if not found:
        raise InputError(f"`defence`: give one or more of {', '.join(DEFENCES)}, or all")
    return tuple(found.values())


def defence_rows() -> list[dict[str, Any]]:
    """Name, meaning, needs, earlier frames and parameters of every defence."""
    return [
        {
            "name": name,
            "meaning": (kind.__doc__ or "").partition("\n")[0],
            "needs": sorted(kind.needs),
            "history": kind.history,
            "parameters": parameter_rows(kind),
        }
        for name, kind in DEFENCES.items()
    ]


@dataclass(frozen=True, slots=True)
class Judged:
    """A frame with its verdicts, and the seconds that each and the detector took, by name."""

    frame: Observation
    verdicts: dict[str, Verdict]
    seconds: dict[str, float]


def able(
    scans: Sequence[RecordedScans], defences: Sequence[NamedDefence], *, scene: Scene | None = None
) -> list[NamedDefence]:
    """The defences that the data of all scanners allow, and ``scene`` or those that they were driven in.

    Raises InputError if they lack what a defence needs that the user named, or if none is left.
    """
    found = []
    for named in defences:
        texts = (lacks(named.defence, each, scene=scene) for each in scans)
        lack = next(filter(None, texts), "")
        if lack and named.named:
            raise InputError(f"defence {named.name}: {lack}")
        if not lack:
            found.append(named)
    if not found:
        raise InputError("`defence`: the data lack what each of them needs")
    return found


def lacks(defence: Defence, scans: RecordedScans, *, scene: Scene | None = None) -> str:
    """What a defence needs and a scanner's dataset, or the scene given for it, lacks; empty if nothing."""
    needs = defence.needs if scene is None else defence.needs - {"scene"}
    path = scans.dataset.path
    if defence.lacks:
        return defence.lacks
    if "cameras" in needs and not scans.pictures:
        return f"needs colour images, and {path} has none"
    if "navigation" in needs and scans.navigation is None:
        return f"needs a GNSS receiver and an inertial unit, and the rig of {path} lacks one"
    if "scene" in needs and not (url_of(place := scans.dataset.scene_path) or place.exists()):
        return f"needs the scene {place} of {path}, which is missing; give `scene`"
    if "watermark" in needs and "watermark" not in scans.dataset.manifest["recipe"]:
        return f"needs clouds with a watermark (lidar sign), and {path} has none"
    if "firing_jitter" in needs and not scans.sensor.firing_jitter_ns:
        return f"needs random firing times, and {scans.sensor.name} of {path} has none (firing_jitter_ns)"
    return ""


def judged_frames(
    scans: RecordedScans,
    defences: Sequence[NamedDefence],
    *,
    scene: Scene | None = None,
    seed: int = 0,
    rows: Container[int] | None = None,
    progress: Progress = silent,
) -> Iterator[Judged]:
    """The frames of a scanner in order, with the verdict of each defence.

    scene : the map of defences that need one
    seed  : of the defences' random numbers
    rows  : of the frames to judge, all by default; the others are only what came before, without verdicts
    """
    past: deque[Observation] = deque(maxlen=1 + max((d.defence.history for d in defences), default=0))
    reach = scans.sensor.max_range
    world = World(scene, margin=reach) if scene is not None else None
    for done, frame in enumerate(scans):
        progress(scans.sensor.name, done, total=len(scans.frames))
        past.append(frame)
        if rows is not None and done not in rows:
            yield Judged(frame, {}, {})
            continue
        if world is not None:
            x, y, _ = frame.poses([frame.start_ns]).position[0]
            world.follow((x - _AROUND, y - _AROUND, x + _AROUND, y + _AROUND))
        verdicts: dict[str, Verdict] = {}
        began = time.perf_counter()
        _ = frame.members  # the detector, which several defences share
        seconds = {DETECTOR: time.perf_counter() - began}
        for named in defences:
            rng = generator(seed, "defence", named.name, scans.sensor.name, frame.number)
            window = Window(list(past)[-1 - named.defence.history :], world, rng)
            began = time.perf_counter()
            verdicts[named.name] = named.defence.judge(window)
            seconds[named.name] = time.perf_counter() - began
            _check_length(verdicts[named.name], frame, name=named.name)
        yield Judged(frame, verdicts, seconds)
    progress(scans.sensor.name, len(scans.frames), total=len(scans.frames))


def _check_length(verdict: Verdict, frame: Observation, *, name: str) -> None:
    for column, count in ((verdict.returns, len(frame)), (verdict.objects, len(frame.objects))):
        if column is not None and np.shape(column) != (count,):
            raise AssertionError(f"defence {name} gives {np.shape(column)} suspicions for {count}")
