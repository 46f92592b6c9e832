"""Returns behind solid surfaces of the map, and missing returns where the map has a surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from geoscene.typing import Float
from lidar.parameters import parameter
from lidar.raycast.geometry import ALL
from lidar.sensors.physics.link import amplitude
from lidar.tools.defences.defence import Defence, Window
from lidar.tools.defences.observation import Observation
from lidar.tools.defences.verdict import FEW, Gaps, Verdict, greatest
from lidar.world.surfaces import FOLIAGE, GLASS, WATER
from lidar.world.world import World

_SECTORS = 360


@dataclass(frozen=True)
class Map(Defence):
    """Returns where the map says that none can be, and none where it says that there must be some."""

    needs: ClassVar[frozenset[str]] = frozenset({"scene"})

    tolerance: float = parameter(0.5, "error of the map and the pose", unit="m", low=0, high=20)
    share: float = parameter(0.02, "error that grows with distance, metres per metre", low=0, high=1)
    reflectance: float = parameter(0.1, "reflectance that surfaces have at least", low=0.01, high=1)
    margin: float = parameter(
        3.0, "power over the threshold from which a surface must be seen", low=1, high=100
    )
    width: float = parameter(3.0, "width of a sector of missing returns", unit="degrees", low=1, high=90)

    def judge(self, window: Window) -> Verdict:
        """Judge the last frame."""
        frame = window.frame
        assert window.scene is not None, "the runner gives the scene that it needs"  # noqa: S101
        expected, cosine = map_ranges(frame, window.scene)
        known = frame.pulse >= 0
        at = expected[np.maximum(frame.pulse, 0)]
        behind = frame.distance - at - self.tolerance - self.share * at
        returns = np.where(known & np.isfinite(at), 1 - np.exp(-np.maximum(behind, 0)), 0.0)
        objects = np.array([returns[rows].mean() if len(rows) else 0.0 for rows in frame.members])
        lack, gap = self._missing(frame, expected, cosine=cosine)
        return Verdict(returns, objects, max(greatest(returns, count=FEW), lack), gap)

    def _missing(self, frame: Observation, expected: Float, *, cosine: Float) -> tuple[float, Gaps]:
        """The sector in which most of the pulses that must have a return have none."""
        sensor = frame.sensor
        seen = np.isfinite(expected) & (expected < 0.9 * sensor.max_range) & (expected > 2 * sensor.min_range)
        power = amplitude(
            self.reflectance * np.abs(cosine),
            np.where(seen, expected, 1.0),
            reference_reflectance=sensor.reference_reflectance,
            reference_range=sensor.reference_range,
            falloff=sensor.falloff,
        )
        must = np.flatnonzero(seen & (power > self.margin))
        direction = frame.firings.direction[must]
        sector = np.clip(np.degrees(np.arctan2(direction[:, 1], direction[:, 0])) + 180, 0, _SECTORS - 1)
        empty = np.isin(must, frame.empty)
        width = round(self.width)
        whole, lost = (
            _around(np.bincount(sector.astype(int), weights=weights, minlength=_SECTORS).astype(float), width)
            for weights in (np.ones(len(must)), empty.astype(float))
        )
        share = np.where(whole >= 10 * width, lost / np.maximum(whole, 1), 0.0)
        worst = int(np.argmax(share))
        middle = np.radians(worst + 0.5 - 180)
        near = empty & (np.abs((sector - worst + 180) % 360 - 180) <= width)
        away = float(np.median(expected[must][near])) if near.any() else 0.0
        place = np.array([[np.cos(middle), np.sin(middle)]]) * away
        return float(share[worst]), Gaps(place, np.array([max(away / 2, 2.0)]), share[[worst]])


def map_ranges(frame: Observation, scene: World) -> tuple[Float, Float]:
    """Metres (p,) from the sensor's origin to the first solid surface on each pulse, and the cosine there.

    Infinite without one. Rays pass glass, leaves and water.
    """
    fired = frame.firings
    poses = frame.poses(fired.time_ns)
    hits = scene.caster.cast(
        poses.place(fired.origin),
        poses.directions(fired.direction),
        far=frame.sensor.max_range,
        mask=ALL & ~(GLASS | FOLIAGE | WATER),
        order=fired.order,
        precision="refined",
    )
    met = np.isfinite(hits.range)
    place = fired.origin + fired.direction * np.where(met, hits.range, 0)[:, None]
    return np.where(met, np.linalg.norm(place, axis=1), np.inf), hits.cosine.astype(np.float64)


def _around(values: Float, width: int) -> Float:
    """Sums over ``width`` sectors around each."""
    total: Float = np.sum([np.roll(values, k - width // 2) for k in range(width)], axis=0)
    return total
