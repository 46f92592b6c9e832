"""Runs defences over a dataset."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from geoscene.scene import Scene
from geoscene.support.progress import Progress, silent
from geoscene.support.storage import url_of
from lidar.errors import InputError
from lidar.geometry.random_streams import generator
from lidar.tools.defences.defence import Window
from lidar.tools.defences.observation import Observation
from lidar.tools.defences.reading import RecordedScans
from lidar.tools.defences.registry import NamedDefence
from lidar.tools.defences.verdict import Verdict
from lidar.world.world import World

_AROUND = 20.0
"""Metres around the vehicle's path during a frame that its region covers."""


DETECTOR = "detector"
"""Name of the time that boxes and their returns take, which defences share."""


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
        needs = named.defence.needs if scene is None else named.defence.needs - {"scene"}
        texts = (_lacks(each, needs=needs) for each in scans)
        lacks = [text for text in (named.defence.lacks, *texts) if text]
        if lacks and named.named:
            raise InputError(f"defence {named.name}: {lacks[0]}")
        if not lacks:
            found.append(named)
    if not found:
        raise InputError("`defence`: the data lack what each of them needs")
    return found


def _lacks(scans: RecordedScans, *, needs: frozenset[str]) -> str:
    """Names of data that a defence needs and a scanner's dataset lacks; empty if none."""
    path = scans.dataset.path
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
