"""Write measurements from a point cloud into a map as tags, and compare them with existing tags."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import shapely

from geoscene.buildings.appearance import read_roof_tags
from geoscene.buildings.heights import CLOUD_ROOF, CLOUD_SIGMA, CLOUD_TOP, THINNEST, read_heights
from geoscene.buildings.table import BuildingOptions
from geoscene.clouds.levels import Body
from geoscene.clouds.measure import CloudMeasurements
from geoscene.clouds.roofs import Roof
from geoscene.errors import InputError
from geoscene.geometry.frames import Frame
from geoscene.objects.vegetation import CLOUD_TREE
from geoscene.sources.data import Area, OsmData, TaggedNode, Tags
from geoscene.support.problems import Problem
from geoscene.typing import Float, Ints

_DISAGREES = 2.0  # metres between a tagged and a measured height that are reported
_FOREST = ("forest", "wood")
_ROW = 4.0  # metres from a mapped tree row within which trees are its own
_MATCH = 2.0  # metres between a mapped and a found tree that are one, or half the crown
_FEET = (2.9, 3.6)  # ratio of measured to tagged heights if feet were taken for metres
_LEAST_COMPARED = 10  # buildings with tagged heights by which the unit is judged

_NO_NODES: Ints = np.empty(0, np.int64)
_HEIGHT_TAGS = ("building:height", "est_height")
_ROOF_TAGS = (
    "building:roof:shape", "building:roof:height", "roof:direction", "roof:slope:direction",
    "roof:orientation", "roof:angle",
)  # fmt: skip


def with_measurements(
    osm: OsmData, measured: CloudMeasurements, *, prefer_tags: bool
) -> tuple[OsmData, dict[str, Any]]:
    """The map with measured heights, roofs and trees, and counts and residuals for the report.

    prefer_tags : keep tagged heights and roof shapes; the cloud only fills gaps

    Raises InputError if the unit of the cloud's heights contradicts the tagged heights.
    """
    osm, buildings, problems = _with_buildings(osm, measured, prefer_tags=prefer_tags)
    osm, trees = _with_trees(osm, measured, prefer_tags=prefer_tags)
    return replace(osm, problems=osm.problems + problems), {"buildings": buildings, "trees": trees}


def _with_buildings(
    osm: OsmData, measured: CloudMeasurements, *, prefer_tags: bool
) -> tuple[OsmData, dict[str, Any], list[Problem]]:
    """The map with measured buildings, counts, and disagreements."""
    names = measured.buildings.osm_id[measured.rows].tolist()
    found: dict[str, tuple[tuple[Body, ...], float]] = {}
    for name, bodies, base in zip(names, measured.bodies, measured.base.tolist(), strict=True):
        high = tuple(body for body in bodies if body.roof.top - base > THINNEST)
        if len(high) == len(bodies) > 0 and np.isfinite(base):
            found.setdefault(name, (bodies, base))
    areas, added = list(osm.areas), []  # type: list[Area], list[Area]
    problems, differences, ratios = [], [], []
    west, south, east, north = osm.bounds
    turn = float(measured.frame.convergence((west + east) / 2, (south + north) / 2))
    counts: Counter[str] = Counter(sought=len(names))
    for k, area in enumerate(areas):
        if area.osm_id not in found or not ({"building", "building:part"} & area.tags.keys()):
            continue
        (first, *others), base = found[area.osm_id]
        roof, height = first.roof, first.roof.top - base
        tagged = read_heights(area.tags, options=BuildingOptions())
        shape = read_roof_tags(area.tags)
        keeps_height = (prefer_tags or not roof.shape) and tagged.source in ("tag", "est_height")
        keeps_roof = not roof.shape or (prefer_tags and not shape.assumed)
        if tagged.source == "tag":
            differences.append(height - tagged.height)
            ratios.append(height / tagged.height)
            if abs(differences[-1]) > _DISAGREES:
                used = "tag" if keeps_height else "cloud"
                detail = f"height {tagged.height:.1f} m tagged, {height:.1f} m measured; {used} used"
                problems.append(Problem(area.osm_id, "building", "repaired", "cloud-height-differs", detail))
        if roof.shape and not shape.assumed and shape.shape != roof.shape:
            counts["other_shape_than_tagged"] += 1
        if roof.levels and roof.shape == "flat" and not others:
            levels = ", ".join(f"{z - base:.1f}" for z in roof.levels)
            detail = f"flat at {height:.1f} m, also at {levels} m; kept one body"
            problems.append(Problem(area.osm_id, "building", "repaired", "several-levels", detail))
        if not roof.shape:
            counts["without_shape"] += 1
            made = "tagged height kept" if keeps_height else f"height {height:.1f} m"
            detail = f"no roof shape explains the points; {made}"
            problems.append(Problem(area.osm_id, "building", "repaired", "no-roof-shape", detail))
        if others and not keeps_height:
            counts["split"] += 1
            added += _parts(area.osm_id, others, base=base, frame=measured.frame, turn=turn)
        counts["heights"] += not keeps_height
        counts["roofs"] += not keeps_roof
        tags = area.tags
        if not keeps_height:
            tags = _with_height(tags, height, roof=roof)
        if not keeps_roof or (others and not keeps_height):
            tags = _with_roof(tags, roof, turn=turn)
        areas[k] = replace(area, tags=tags)
    counts["parts_added"] = len(added)
    walls = zip(names, measured.walls.tolist(), measured.base.tolist(), strict=True)
    for name, top, base in walls:
        if top - base > THINNEST and name not in found:
            counts["walls_only"] += 1
            detail = f"walls seen up to {top - base:.1f} m, no roof; height by the map's rules"
            problems.append(Problem(name, "building", "repaired", "walls-only", detail))
    check_unit(ratios)
    counts["not_measured"] = len(names) - len(found)
    roofs = [body.roof for bodies, _ in found.values() for body in bodies]
    sigma = [roof.sigma for roof in roofs if roof.shape]
    about = {
        **dict(sorted(counts.items())),
        "shapes": dict(sorted(Counter(roof.shape for roof in roofs if roof.shape).items())),
        "sigma_m_median": _round_size(sigma, 50),
        "sigma_m_95": _round_size(sigma, 95),
        "tagged_compared": len(differences),
        "cloud_minus_tag_m_median": _round_size(differences, 50),
        "cloud_minus_tag_m_abs_95": _round_size(np.abs(differences).tolist(), 95),
    }
    return replace(osm, areas=areas + added), about, problems


def _parts(name: str, bodies: Sequence[Body], *, base: float, frame: Frame, turn: float) -> list[Area]:
    """Areas of a building's bodies except the highest, as building parts."""
    areas = []
    for k, (polygon, roof) in enumerate(bodies, 1):
        tags = _with_height({"building:part": "yes"}, roof.top - base, roof=roof)
        shape = shapely.transform(polygon, lambda xy: np.column_stack(frame.to_geographic(*xy.T)))
        areas.append(Area(f"cloud:{name}_{k}", _with_roof(tags, roof, turn=turn), shape, _NO_NODES))
    return areas


def check_unit(ratios: list[float]) -> None:
    """Raise InputError if ratios of measured to tagged heights suggest feet instead of metres."""
    if len(ratios) < _LEAST_COMPARED:
        return
    middle = float(np.median(ratios))
    low, high = _FEET
    if low < middle < high or low < 1 / middle < high:
        hint = "ft or us-ft" if middle > 1 else "m"
        raise InputError(
            f"the cloud's buildings are {middle:.2f} times as high as tagged; is the unit of its heights"
            f" {hint}? say so with `cloud_unit`"
        )


def _with_height(tags: Tags, height: float, *, roof: Roof) -> Tags:
    kept = {key: value for key, value in tags.items() if key not in _HEIGHT_TAGS}
    return kept | {
        "height": f"{height:.3f}",
        CLOUD_SIGMA: f"{max(roof.sigma, 0.001):.3f}",
        CLOUD_TOP: f"{roof.top:.3f}",
    }


def _with_roof(tags: Tags, roof: Roof, *, turn: float) -> Tags:
    """Tags with a measured roof.

    turn : angle from true north to grid north, radians clockwise
    """
    kept = {key: value for key, value in tags.items() if key not in _ROOF_TAGS}
    kept |= {"roof:shape": roof.shape, "roof:height": f"{roof.height:.3f}", CLOUD_ROOF: "yes"}
    if np.isfinite(roof.direction):
        azimuth = np.degrees(np.pi / 2 - roof.direction + turn) % 360.0
        kept["roof:direction"] = f"{azimuth:.2f}"
    if roof.across:
        kept["roof:orientation"] = "across"
    return kept


def _with_trees(
    osm: OsmData, measured: CloudMeasurements, *, prefer_tags: bool
) -> tuple[OsmData, dict[str, int]]:
    """The map with measured sizes of its trees and with detected trees that it lacks; counts."""
    frame, found = measured.frame, measured.trees
    mapped = [k for k, point in enumerate(osm.points) if point.tags.get("natural") == "tree"]
    lonlat = np.array([(osm.points[k].lon, osm.points[k].lat) for k in mapped]).reshape(-1, 2)
    xy = np.column_stack(frame.from_geographic(*lonlat.T)).reshape(-1, 2)
    of_found = _match(xy, found.xy, crown=found.crown)
    points = list(osm.points)
    for k, row in zip(mapped, of_found.tolist(), strict=True):
        if row >= 0:
            tags = points[k].tags
            if not (prefer_tags and "height" in tags):
                points[k] = replace(points[k], tags=tags | _sizes(found.height[row], found.crown[row]))
    taken = np.zeros(len(found), np.bool_)
    taken[of_found[of_found >= 0]] = True
    forest, row = _within_forests(osm, frame, xy=found.xy), _in_rows(osm, frame, xy=found.xy)
    new = ~taken & ~forest & ~row
    lon, lat = frame.to_geographic(*found.xy[new].T)
    sizes = zip(found.height[new].tolist(), found.crown[new].tolist(), strict=True)
    places = np.rint(10 * found.xy[new]).astype(np.int64).tolist()
    added = [
        TaggedNode(f"cloud/{x}_{y}", {"natural": "tree"} | _sizes(*size), float(a), float(b))
        for (x, y), size, a, b in zip(places, sizes, lon, lat, strict=True)
    ]
    return replace(osm, points=points + sorted(added, key=lambda p: (p.lon, p.lat))), {
        "found": len(found),
        "mapped": len(mapped),
        "mapped_measured": int(taken.sum()),
        "added": len(added),
        "left_to_forests": int((forest & ~taken).sum()),
        "left_to_tree_rows": int((row & ~forest & ~taken).sum()),
    }


def _sizes(height: float, crown: float) -> Tags:
    return {"height": f"{height:.2f}", "diameter_crown": f"{crown:.2f}", CLOUD_TREE: "yes"}


def _match(xy: Float, found: Float, *, crown: Float) -> Ints:
    """The found tree (n,) of each mapped one, -1 for none: pairs one to one, the nearest first."""
    from scipy.spatial import cKDTree  # noqa: PLC0415 - slow to import

    out: Ints = np.full(len(xy), -1)
    if not len(xy) or not len(found):
        return out
    distance, near = cKDTree(found).query(xy, k=min(4, len(found)))
    distance, near = distance.reshape(len(xy), -1), near.reshape(len(xy), -1)
    close = distance <= np.maximum(_MATCH, crown[near] / 2)
    one, rank = np.nonzero(close)
    order = np.argsort(distance[one, rank], kind="stable")
    used = np.zeros(len(found), np.bool_)
    for k in order.tolist():
        tree, row = one[k], near[one[k], rank[k]]
        if out[tree] < 0 and not used[row]:
            out[tree], used[row] = row, True
    return out


def _within_forests(osm: OsmData, frame: Frame, *, xy: Float) -> Any:
    """Mask (n,) of places in mapped forests, whose trees are generated."""
    shapes = [
        a.geometry for a in osm.areas if a.tags.get("landuse") in _FOREST or a.tags.get("natural") in _FOREST
    ]
    inside = np.zeros(len(xy), np.bool_)
    if shapes and len(xy):
        tree = shapely.STRtree(np.array(shapes, object))
        lon, lat = frame.to_geographic(*xy.T)
        inside[tree.query(shapely.points(lon, lat), predicate="intersects")[0]] = True
    return inside


def _in_rows(osm: OsmData, frame: Frame, *, xy: Float) -> Any:
    """Mask (n,) of places along mapped tree rows, whose trees are generated."""
    lines = [
        shapely.LineString(np.column_stack(frame.from_geographic(*way.lonlat.T)))
        for way in osm.ways
        if way.tags.get("natural") == "tree_row" and len(way.lonlat) > 1
    ]
    inside = np.zeros(len(xy), np.bool_)
    if lines and len(xy):
        tree = shapely.STRtree(np.array(lines, object))
        inside[tree.query(shapely.points(xy), predicate="dwithin", distance=_ROW)[0]] = True
    return inside


def _round_size(values: list[float], percent: float) -> float | None:
    return round(float(np.percentile(values, percent)), 3) if len(values) else None
