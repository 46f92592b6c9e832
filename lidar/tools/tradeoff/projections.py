"""What a frame's scale costs: distances in it against distances in space (WGS 84), on a drive's ranges."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from pyproj import Transformer

from geoscene.geometry.frames import Frame
from geoscene.typing import Float
from lidar.sensors.rig.devices import Scanner
from lidar.tools.tradeoff.comparison import Listing, Record
from lidar.tools.tradeoff.errors import percentile, rms
from lidar.tools.tradeoff.simulate import Bench, measured_frame

_EVERY = 8  # every n-th pulse of the sampled frames
_SHORT = 1.0  # metres: of shorter ranges there is no relative error


def frames_listing(bench: Bench, scanner: Scanner) -> Listing:
    """Errors of distances in the scene's frame, in UTM and in a tangent plane, and of simulated ranges."""
    plan = bench.plan
    seen = [measured_frame(bench, scanner, frame=f, every=_EVERY) for f in bench.frames[scanner.name]]
    start, end = (np.concatenate([getattr(s, name) for s in seen]) for name in ("start", "placed"))
    ranges = np.concatenate([s.range for s in seen])
    return Listing(
        "frame",
        f"Frames: {len(ranges):,} ranges of {scanner.name} up to {ranges.max(initial=0.0):.0f} m",
        "Distances between sensor and return in coordinates of each frame, against distances in space with"
        " heights above the ellipsoid. Simulated ranges are corrected for the projection's scale; heights"
        " above the ellipsoid make both longer in space, by 0.16 ppm a metre. Heights of the tangent plane"
        " are off by the Earth's curvature from its origin, the scene's.",
        tuple(frame_records(plan.scene.frame, start, end=end, ranges=ranges)),
    )


def frame_records(frame: Frame, start: Float, *, end: Float, ranges: Float) -> list[Record]:
    """Rows of ranges (n,) measured from ``start`` to ``end`` (n, 3), in scene metres."""
    space = _space(frame)
    exact = np.linalg.norm(space(end) - space(start), axis=1)
    lon, lat = (float(v) for v in frame.to_geographic(0.0, 0.0))
    utm = Frame.at(lon, lat, crs="utm", vertical=frame.vertical)
    rows = [_record("ranges as simulated", ranges, exact=exact)]
    for label, other in ((f"scene ({frame.name})", frame), (f"UTM ({utm.name})", utm)):
        place = _move(frame, other)
        rows.append(_record(label, np.linalg.norm(place(end) - place(start), axis=1), exact=exact))
    east_north_up = _tangent(frame, at=(lon, lat))
    there = east_north_up(end)
    row = _record("tangent plane", np.linalg.norm(there - east_north_up(start), axis=1), exact=exact)
    row.figures["height_max_m"] = percentile(np.abs(there[:, 2] - end[:, 2]), 1.0)
    return [*rows, row]


def _record(label: str, found: Float, *, exact: Float) -> Record:
    away, long = np.abs(found - exact), exact > _SHORT
    ratio = found[long] / exact[long] - 1.0
    figures = {
        "rms_m": rms(away),
        "99.9_m": percentile(away, 0.999),
        "max_m": percentile(away, 1.0),
        "scale_ppm": 1e6 * float(np.median(ratio)) if len(ratio) else 0.0,
        "height_max_m": 0.0,
    }
    return Record(label, figures)


Placing = Callable[[Float], Float]


def _space(frame: Frame) -> Placing:
    """From scene points (n, 3) to geocentric coordinates; heights are above the ellipsoid."""
    geocentric = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)

    def place(points: Float) -> Float:
        lon, lat = frame.to_geographic(points[:, 0], points[:, 1])
        return np.column_stack(geocentric.transform(lon, lat, points[:, 2]))

    return place


def _move(frame: Frame, other: Frame) -> Placing:
    """From points of a frame to those of another; heights stay."""

    def place(points: Float) -> Float:
        x, y = other.from_geographic(*frame.to_geographic(points[:, 0], points[:, 1]))
        return np.column_stack([x, y, points[:, 2]])

    return place


def _tangent(frame: Frame, *, at: tuple[float, float]) -> Placing:
    """From scene points to metres east, north and up of the tangent plane of the ellipsoid at a point."""
    space = _space(frame)
    origin = space(np.array([[*frame.from_geographic(*at), 0.0]], float))
    lon, lat = np.radians(at)
    (s, c), (u, v) = (np.sin(lon), np.cos(lon)), (np.sin(lat), np.cos(lat))
    axes = np.array([[-s, c, 0.0], [-u * c, -u * s, v], [v * c, v * s, u]])
    return lambda points: np.asarray((space(points) - origin) @ axes.T)
