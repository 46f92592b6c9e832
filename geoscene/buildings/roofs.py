"""Roof shapes on any footprint, as closed shells from the floor to the ridge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import shapely

from geoscene.buildings.cells import (
    RoofCells,
    cut,
    fill,
    merge,
    outlines,
    raise_gables,
    skeleton_cells,
    sloped_cells,
)
from geoscene.buildings.footprints import Polygons, to_grid
from geoscene.buildings.shells import ShellTriangles, close, distinct_corners, lift, prisms
from geoscene.buildings.skeleton import straight_skeleton
from geoscene.geometry.mesh import FLOOR, ROOF
from geoscene.geometry.polylines import cross
from geoscene.typing import Float

Profile = tuple[tuple[float, float], ...]

RECTANGULAR = 0.85
"""Share of the smallest enclosing rectangle from which a footprint takes its ridge from the rectangle."""

_ARC = tuple(
    (float(1 - np.cos(a)), float(np.sin(a))) for a in np.linspace(0, np.pi / 2, 7)
)  # a quarter circle, by (distance, height)

SECTIONS: dict[str, Profile] = {
    # (share of the way from the low eave to the other, share of the roof's height), along the cross-section
    "gabled": ((0, 0), (0.5, 1), (1, 0)),
    "half-hipped": ((0, 0), (0.5, 1), (1, 0)),
    "gambrel": ((0, 0), (0.2, 0.6), (0.5, 1), (0.8, 0.6), (1, 0)),
    "round": tuple((d / 2, h) for d, h in _ARC) + tuple((1 - d / 2, h) for d, h in _ARC[-2::-1]),
    "saltbox": ((0, 0), (2 / 3, 1), (1, 0.5)),
}

INWARD: dict[str, Profile] = {
    # (share of the way from the eaves to the innermost point, share of the roof's height)
    "hipped": ((0, 0), (1, 1)),
    "gabled": ((0, 0), (1, 1)),
    "half-hipped": ((0, 0), (1, 1)),
    "saltbox": ((0, 0), (1, 1)),
    "gambrel": ((0, 0), (0.4, 0.6), (1, 1)),
    "mansard": ((0, 0), (0.3, 0.7), (1, 1)),
    "round": _ARC,
    "dome": _ARC,
    "onion": _ARC,
    "pyramidal": ((0, 0), (1, 1)),
    "cone": ((0, 0), (1, 1)),
}

GABLE_SHARE = {"gabled": 1.0, "gambrel": 1.0, "round": 1.0, "saltbox": 1.0, "half-hipped": 0.5}
"""Share by which the hip ends of a skeleton are raised to gables."""

_FALLBACK = {"onion": "dome", "saltbox": "gabled", "pyramidal": "hipped", "cone": "hipped"}
"""Shape that replaces another one on the skeleton."""

RADIAL: dict[str, Profile] = {
    # (share of the height, scale of the footprint) of the rings about the centroid; the scale never exceeds
    # 1, so that an onion does not reach into its neighbour
    "dome": tuple((h, 1 - d) for d, h in _ARC),
    "onion": (
        (0, 1), (0, 0.82), (0.08, 0.95), (0.18, 1), (0.3, 0.95), (0.42, 0.79), (0.55, 0.54), (0.68, 0.32),
        (0.82, 0.13), (1, 0),
    ),
    "pyramidal": ((0, 1), (1, 0)),
    "cone": ((0, 1), (1, 0)),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class RoofSpec:
    """Parameters of a roof.

    shape     : one of `geoscene.buildings.table.SHAPES`
    low, high : z of the underside of the body and of the top of the roof, metres
    height    : of the roof alone, metres, at most high - low
    direction : radians counter-clockwise from x, downslope direction of the (low) face, NaN if not known
    across    : the ridge runs across the longer side
    """

    shape: str
    low: float
    high: float
    height: float
    direction: float = np.nan
    across: bool = False


def roof_shell(polygon: Any, spec: RoofSpec) -> tuple[ShellTriangles, str]:
    """The closed shell of a body with its roof (piece 0), and a note if the shape had to be replaced.

    For the arguments see `roof_shells`.
    """
    shells, notes = roof_shells(np.array([polygon], dtype=object), [spec])
    return shells, notes[0]


def roof_shells(polygons: Polygons, specs: Sequence[RoofSpec]) -> tuple[ShellTriangles, list[str]]:
    """The closed shells of bodies (n,) with their roofs, and a note on each whose shape had to be replaced.

    Pyramids, cones, domes and onions are built of rings about the centroid if all corners are visible from
    it. Ridged shapes take their ridge from the smallest enclosing rectangle if the footprint nearly fills it
    or a direction is tagged. All others are built on the straight skeleton.

    polygons : valid, on the grid, exteriors counter-clockwise
    """
    notes = [""] * len(specs)
    radial, ridged, fields = list[int](), list[int](), dict[int, RoofCells]()
    for k, (polygon, spec) in enumerate(zip(polygons, specs, strict=True)):
        if spec.shape in RADIAL and _is_star_shaped(polygon):
            radial.append(k)
        elif spec.shape == "skillion":
            fields[k] = _skillion(polygon, spec)
        elif spec.shape in SECTIONS and (
            _nearly_rectangular(polygon) or np.isfinite(spec.direction) or spec.across
        ):
            ridged.append(k)
        else:
            cells, raised = _inward(polygon, spec)
            if cells is None:
                notes[k] = f"{spec.shape} roof made flat"
                continue
            fields[k] = cells
            fallback = _FALLBACK.get(spec.shape, "")
            if spec.shape in GABLE_SHARE and not raised:
                fallback = "hipped"
            notes[k] = f"{spec.shape} roof made {fallback}" if fallback else ""
    for shape in sorted({specs[k].shape for k in ridged}):
        own = [k for k in ridged if specs[k].shape == shape]
        fields |= zip(own, _extrude_ridges(polygons[own], [specs[k] for k in own]), strict=True)
    tops = {k: _rings(polygons[k], specs[k]) for k in radial} | {
        k: _raise_roof(cells, specs[k]) for k, cells in fields.items()
    }
    flat = np.array([k for k in range(len(specs)) if k not in tops], np.int64)
    low, high = (np.array([(s.low, s.high) for s in specs]).reshape(-1, 2)[flat]).T
    made = [
        prisms(polygons[flat], flat, low=low, high=high),
        _close(polygons, tops, fields=fields, specs=specs),
    ]
    shells = ShellTriangles.concatenate(made)
    return shells.take(np.argsort(shells.piece, kind="stable")), notes


def _is_star_shaped(polygon: Any) -> bool:
    """Whether the footprint has no holes and all its corners are visible from the centroid (star-shaped)."""
    if shapely.get_num_interior_rings(polygon):
        return False
    ring = shapely.get_coordinates(polygon)
    a, b = ring[:-1] - _centroid(polygon), ring[1:] - _centroid(polygon)
    return bool((cross(a, b) > 1e-3).all())


def _centroid(polygon: Any) -> Float:
    return to_grid(shapely.get_coordinates(shapely.centroid(polygon))[0])


def _axes(polygon: Any) -> tuple[Float, Float, float]:
    """Unit vectors along the longer and shorter side of the smallest rectangle, and the rectangle's area."""
    ring = shapely.get_coordinates(shapely.minimum_rotated_rectangle(polygon))
    first, second = ring[1] - ring[0], ring[2] - ring[1]
    lengths = float(np.hypot(*first)), float(np.hypot(*second))
    along = first / lengths[0] if lengths[0] >= lengths[1] else second / lengths[1]
    return along, np.array([-along[1], along[0]]), lengths[0] * lengths[1]


def _nearly_rectangular(polygon: Any) -> bool:
    if shapely.get_num_interior_rings(polygon):
        return False  # a ridge would run across the courtyard
    return bool(shapely.area(polygon) > RECTANGULAR * _axes(polygon)[2])


def _slope(polygon: Any, spec: RoofSpec) -> Float:
    """Unit vector up the slope, opposite to the tagged direction.

    A direction within 22.5 degrees (half a step of the eight-point compass that mappers use) of a side of the
    smallest rectangle is taken to mean that side. Without a direction the slope is perpendicular to the
    longer side, or parallel to it if the ridge runs across.
    """
    along, aside, _ = _axes(polygon)
    if not np.isfinite(spec.direction):
        return along if spec.across else aside
    wanted = -np.array([np.cos(spec.direction), np.sin(spec.direction)])
    sides = np.array([along, aside, -along, -aside])
    nearest = sides[np.argmax(sides @ wanted)]
    return nearest if nearest @ wanted > np.cos(np.radians(22.5)) else wanted


def _profile(field: Float, span: float | Float, *, profile: Profile) -> Float:
    share, height = np.array(profile, float).T
    return np.asarray(np.interp(field / span, share, height), float)


def _skillion(polygon: Any, spec: RoofSpec) -> RoofCells:
    """One plane; the field is the share of the roof's height."""
    cells = sloped_cells(np.array([polygon], dtype=object), _slope(polygon, spec)[None])
    low, high = cells.field.min(), cells.field.max()
    return replace(cells, field=(cells.field - low) / (high - low))


def _extrude_ridges(polygons: Polygons, specs: Sequence[RoofSpec]) -> list[RoofCells]:
    """Cross-sections of one shape extruded along ridges; the fields are shares of the roofs' heights."""
    up = np.array([_slope(polygon, spec) for polygon, spec in zip(polygons, specs, strict=True)])
    shape, count = specs[0].shape, len(specs)
    profile = SECTIONS[shape]
    cells = sloped_cells(polygons, up)
    low, high = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(low, cells.face, cells.field.min(axis=1))
    np.maximum.at(high, cells.face, cells.field.max(axis=1))
    span = high - low
    cells = replace(cells, field=cells.field - low[cells.face, None])
    cuts = 0  # each doubles the numbers of faces
    for share, _ in profile[1:-1]:
        cells = cut(cells, share * span[cells.face >> cuts])
        cuts += 1
    if shape == "half-hipped":
        parts = [cells.take(cells.face >> cuts == k) for k in range(count)]
        hipped = [
            _hipped_ends(part, up[k], low=float(low[k]), span=float(span[k])) for k, part in enumerate(parts)
        ]
        return [merge(part, np.zeros(len(part), np.int64), count=1)[0] for part in hipped]
    cells = cells.take(np.argsort(cells.face >> cuts, kind="stable"))
    body = cells.face >> cuts
    raised = replace(cells, field=_profile(cells.field, span[body, None], profile=profile))
    return merge(raised, body, count=count)


def _hipped_ends(cells: RoofCells, up: Float, *, low: float, span: float) -> RoofCells:
    """A gabled cross-section whose ends are hipped above half the height, with the pitch of the sides."""
    ridge = np.array([-up[1], up[0]])
    hips = [(along, float((cells.xy @ along).min())) for along in (ridge, -ridge)]

    def height(xy: Float, count: int) -> Float:
        planes = [0.5 + 2 * (xy @ along - start) / span for along, start in hips[:count]]
        return np.asarray(
            np.minimum.reduce([_profile(xy @ up - low, span, profile=SECTIONS["gabled"]), *planes]), float
        )

    for k, (along, start) in enumerate(hips):
        above = 0.5 + 2 * (cells.xy @ along - start) / span - height(cells.xy, k)
        cells = cut(replace(cells, field=above * span), 0.0)
    return replace(cells, field=height(cells.xy, len(hips)))


def _inward(polygon: Any, spec: RoofSpec) -> tuple[RoofCells | None, bool]:
    """A profile from the eaves inwards on the straight skeleton; the field is the share of the roof's height.

    None if there is no skeleton with a height. The flag tells whether a hip end was raised to a gable.
    """
    skeleton = straight_skeleton(polygon)
    if skeleton is None:
        return None, False
    corners = len(skeleton.xy)
    if spec.shape in GABLE_SHARE:
        skeleton = raise_gables(skeleton, GABLE_SHARE[spec.shape])
    cells = skeleton_cells(skeleton)
    span = float(cells.field.max())
    if span == 0:  # a footprint so narrow that the ridge merges with its corners
        return None, False
    profile = INWARD[spec.shape]
    for share, _ in profile[1:-1]:
        cells = cut(cells, share * span)
    if len(profile) > 2:
        (cells,) = merge(cells, np.zeros(len(cells), np.int64), count=1)
    return replace(cells, field=_profile(cells.field, span, profile=profile)), len(skeleton.xy) > corners


def takes_gables(footprint: Any) -> bool:
    """Whether a gabled roof on the straight skeleton of each part of a footprint has a gable."""
    spec = RoofSpec("gabled", 0.0, 1.0, 1.0)
    return all(_inward(polygon, spec)[1] for polygon in shapely.get_parts(footprint))


def _raise_roof(cells: RoofCells, spec: RoofSpec) -> Float:
    """Triangles (m, 3, 3) of a roof above cells whose field is the share of its height."""
    # the highest point has the tagged height even if the footprint excludes the ridge
    share = cells.field / cells.field.max()
    return np.concatenate(
        [cells.xy, to_grid(spec.high - spec.height + share * spec.height)[..., None]], axis=2
    )


def _close(
    polygons: Polygons, tops: dict[int, Float], *, fields: dict[int, RoofCells], specs: Sequence[RoofSpec]
) -> ShellTriangles:
    """The shells of roof triangles (m, 3, 3) by piece.

    Floors are polygons, or of pieces with cells the outlines of these, whose edges have the roof's vertices.
    """
    pieces = sorted(tops)
    size = np.array([len(tops[k]) for k in pieces], np.int64)
    owner = np.repeat(np.arange(len(pieces)), size)
    corners = np.concatenate([np.empty((0, 3, 3)), *(tops[k] for k in pieces)])
    on_cells = np.array([k in fields for k in pieces], np.bool_)[owner]
    rims = outlines(corners[on_cells, :, :2], owner[on_cells], body=owner[on_cells], count=len(pieces))
    found: list[Polygons | None] = [
        rim if k in fields else polygons[[k]] for k, rim in zip(pieces, rims, strict=True)
    ]
    floors = [fields[k].xy if made is None else made[0] for k, made in zip(pieces, fill(found), strict=True)]
    bottom = to_grid(np.array([specs[k].low for k in pieces], float))
    of = np.repeat(np.arange(len(pieces)), [len(floor) for floor in floors])
    xy = np.concatenate([np.empty((0, 3, 2)), *floors])
    top = ShellTriangles(corners, owner, np.full(len(corners), ROOF, np.uint8))
    floor = ShellTriangles(lift(xy, bottom[of]), of, np.full(len(xy), FLOOR, np.uint8))
    shells = close(top, floor, underside=bottom)
    return replace(shells, piece=np.array(pieces, np.int64)[shells.piece])


def _rings(polygon: Any, spec: RoofSpec) -> Float:
    """Triangles (m, 3, 3) between rings: the footprint scaled about its centroid, at rising heights."""
    ring = shapely.get_coordinates(polygon)[:-1]
    centroid = _centroid(polygon)
    eaves = spec.high - spec.height
    rings = [
        np.column_stack(
            (centroid + (ring - centroid) * size, np.full(len(ring), eaves + share * spec.height))
        )
        for share, size in RADIAL[spec.shape]
    ]
    rings = [to_grid(r) for r in rings]
    triangles = []
    for lower, upper in pairwise(rings):
        a, b, c, d = lower, np.roll(lower, -1, axis=0), np.roll(upper, -1, axis=0), upper
        triangles += [np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]
    corners = np.concatenate(triangles)
    return np.asarray(corners[distinct_corners(corners)], float)
