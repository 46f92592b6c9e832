"""Missing returns: of the ground, of a sector, of surfaces of the map; and returns behind these."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.parameters import parameter
from lidar.raycast.geometry import ALL
from lidar.tools.defences.defence import Defence, Gaps, Verdict, Window, greatest, of_returns
from lidar.tools.defences.observation import Observation
from lidar.world.surfaces import FOLIAGE, GLASS, WATER
from lidar.world.world import World

_NEAREST, _BRIGHT = 3.0, 12.0
"""Metres from which on the ground is looked at, and up to which its brightness is measured."""
_CERTAIN = 1.7
"""Power over the threshold from which the ground is detected: four standard deviations of typical noise."""

_SECTORS = 360
_RADIUS = 30.0
"""Metres from the sensor within which a gap is placed."""
_ENOUGH = 0.3
"""Share of a sector's pulses of which a return is expected from which on its lack has full weight."""
_OPEN = 0.5
"""Share of a sector's expected returns that it may lack, as where buildings end: no suspicion up to it."""


@dataclass(frozen=True)
class Void(Defence):
    """Ground without returns that nothing nearer hides (Hau et al. 2022; fake shadows: Cao et al. 2023)."""

    sector: float = parameter(1.0, "azimuth of the cells of the ground", unit="degrees", low=0.2, high=10)
    least: float = parameter(1.8, "area of a void", unit="m^2", low=0, high=1000)
    reach: float = parameter(30.0, "distance up to which the ground is looked at", unit="m", low=5, high=100)
    half: float = parameter(6.0, "area of a void that has suspicion 0.5", unit="m^2", low=0.1, high=1000)

    def judge(self, window: Window) -> Verdict:
        """Judge the last frame."""
        frame = window.frame
        pulse, place, empty = ground_pulses(frame, reach=self.reach)
        if not len(pulse):
            return Verdict(None, None, 0.0)
        gaps = self._voids(frame.firings.ring[pulse].astype(np.int64), place, empty=empty)
        return Verdict(None, None, greatest(gaps.suspicion), gaps)

    def _voids(self, ring: NDArray[np.int64], place: Float, *, empty: NDArray[np.bool_]) -> Gaps:
        """Connected cells of ring and sector in which every pulse lacks its return.

        A cell is as long as the distance between the rings on the ground.
        """
        from scipy import ndimage  # noqa: PLC0415  (0.1 s)

        count = round(360 / self.sector)
        turn = np.degrees(np.arctan2(place[:, 1], place[:, 0])) + 180
        shape = int(ring.max()) + 1, count
        cell = ring * count + np.minimum((turn / 360 * count).astype(np.int64), count - 1)
        size = shape[0] * count
        fired = np.bincount(cell, minlength=size)
        lost = np.bincount(cell, weights=empty, minlength=size)
        void = ((fired > 0) & (lost == fired)).reshape(shape)
        away = np.hypot(*place.T)
        mean = np.bincount(ring, weights=away, minlength=shape[0]) / np.maximum(np.bincount(ring), 1)
        length = np.clip(np.abs(np.gradient(mean)) if shape[0] > 1 else np.ones(1), 0.1, 3.0)
        area = np.broadcast_to((length * mean * 2 * np.pi / count)[:, None], shape)
        total = np.stack([np.bincount(cell, weights=c, minlength=size) for c in place.T])
        middle: Float = (total / np.maximum(fired, 1)).reshape(2, *shape)
        label, most = ndimage.label(void, structure=np.ones((3, 3)))
        whole = ndimage.sum_labels(area, label, np.arange(1, most + 1))
        large = 1 + np.flatnonzero(whole >= self.least)
        center = np.array([ndimage.mean(axis, label, large) for axis in middle]).T.reshape(-1, 2)
        radius = [
            np.linalg.norm(middle[:, label == k].T - center[row], axis=1).max() for row, k in enumerate(large)
        ]
        whole = whole[large - 1]
        return Gaps(center, np.array(radius) + 0.5, whole / (whole + self.half))


def ground_pulses(frame: Observation, *, reach: float) -> tuple[NDArray[np.intp], Float, NDArray[np.bool_]]:
    """Pulses (k,), their ground points (k, 2), and whether they lack a return at the ground or before it.

    Pulses that a nearer return stops are left out: they tell nothing of the ground.
    """
    fired = frame.firings
    expected = frame.surface.hit(fired.direction, reach=reach)
    level = np.hypot(*fired.direction[:, :2].T)
    power = frame.power(_reflectance(frame) * np.abs(fired.direction[:, 2]), expected)
    nearest = np.full(len(fired), np.inf)
    known = frame.pulse >= 0
    np.minimum.at(nearest, frame.pulse[known], frame.distance[known])
    near = np.flatnonzero((expected * level > _NEAREST) & np.isfinite(expected) & (power > _CERTAIN))
    room = 0.5 + 0.15 * expected[near]
    stopped = nearest[near] < expected[near] - room
    chosen, room = near[~stopped], room[~stopped]
    empty = nearest[chosen] > expected[chosen] + room
    return chosen, fired.direction[chosen, :2] * expected[chosen, None], empty


def _reflectance(frame: Observation) -> float:
    """Reflectance of the ground near the vehicle, from the intensity of its returns; 0.1 without."""
    rows = np.flatnonzero(frame.ground & (frame.distance < _BRIGHT))
    if len(rows) < 20:
        return 0.1
    return float(np.median(frame.apparent[rows] / np.maximum(np.abs(frame.direction[rows, 2]), 1e-3)))


@dataclass(frozen=True)
class Azimuth(Defence):
    """A sector that lacks returns which the rest of the turn or earlier frames have (Cao et al. 2023)."""

    history: ClassVar[int] = 5

    width: float = parameter(4.0, "width of the sector", unit="degrees", low=1, high=90)
    turn: float = parameter(
        0.35, "share of the turn that may lack a ring's returns, as towards side streets", low=0, high=0.9
    )

    def judge(self, window: Window) -> Verdict:
        """Judge the last frame."""
        frame = window.frame
        expected = self._of_turn(frame)
        if known := [self._of_earlier(past, frame) for past in window.frames[:-1]]:
            least = np.min(known, axis=0)
            expected = np.maximum(expected, np.where(np.isfinite(least), least, 0.0))
        sector = np.clip((self._lack(frame, expected) - _OPEN) / (1 - _OPEN), 0, 1)
        worst = int(np.argmax(sector))
        middle = np.radians(worst + 0.5 - 180)
        place = Gaps(
            np.array([[np.cos(middle), np.sin(middle)]]) * _RADIUS / 2,
            np.array([_RADIUS / 2]),
            sector[[worst]],
        )
        return Verdict(None, None, float(sector[worst]), place)

    def _of_turn(self, frame: Observation) -> Float:
        """Share of each ring's pulses (rings, 360) with a return that all but a part of the turn reaches."""
        fired, share = frame.answered
        least = np.nanquantile(np.where(fired > 0, share, np.nan), self.turn, axis=1, method="lower")
        return np.repeat(np.nan_to_num(least)[:, None], _SECTORS, axis=1)

    def _of_earlier(self, past: Observation, frame: Observation) -> Float:
        """Shares (rings, 360) in an earlier frame, in the sectors that have its directions now.

        Each is the least of the sectors beside it, as the vehicle also moves; infinite in sectors that lack
        returns in that frame itself.
        """
        lack = self._lack(past, self._of_turn(past)) > _OPEN
        reach = round(self.width) + 2
        suspect = np.any([np.roll(lack, k) for k in range(-reach, reach + 1)], axis=0)
        share = np.min([np.roll(past.answered[1], k, axis=1) for k in (-2, -1, 0, 1, 2)], axis=0)
        turns = [f.poses([f.start_ns]).rotation[0] for f in (past, frame)]
        back = turns[1].T @ turns[0]
        yaw = np.degrees(np.arctan2(back[1, 0], back[0, 0]))
        turned: Float = np.roll(np.where(suspect, np.inf, share), round(float(yaw)), axis=1)
        return turned

    def _lack(self, frame: Observation, expected: Float) -> Float:
        """Share (360,) of the expected returns that the sector around each degree lacks."""
        fired, share = frame.answered
        wanted = _around((fired * expected).sum(axis=0), round(self.width))
        lost = _around((fired * np.maximum(expected - share, 0)).sum(axis=0), round(self.width))
        whole = _around(fired.sum(axis=0), round(self.width))
        # A sector of which few returns are expected, as towards the sky, tells little.
        weight = np.minimum(wanted / np.maximum(_ENOUGH * whole, 1e-9), 1.0)
        return weight * lost / np.maximum(wanted, 1e-9)


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
        found, (lack, gap) = of_returns(frame, returns), self._missing(frame, expected, cosine=cosine)
        return replace(found, frame=max(found.frame, lack), gaps=gap)

    def _missing(self, frame: Observation, expected: Float, *, cosine: Float) -> tuple[float, Gaps]:
        """The sector in which most of the pulses that must have a return have none."""
        sensor = frame.sensor
        seen = np.isfinite(expected) & (expected < 0.9 * sensor.max_range) & (expected > 2 * sensor.min_range)
        power = frame.power(self.reflectance * np.abs(cosine), np.where(seen, expected, 1.0))
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
