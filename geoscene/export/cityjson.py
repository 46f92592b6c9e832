"""CityJSON 2.0: semantic city objects, solids as Solid, trees as instances of templates."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from geoscene.classes import Class, materials
from geoscene.errors import InputError
from geoscene.export.kinds import Summary, compact_json
from geoscene.export.objects import (
    FeatureAttributes,
    Part,
    Piece,
    attribution,
    klass_name,
    parts,
    pieces,
    read_features,
)
from geoscene.export.shells import Vertices, bodies, manifold_patches, shell_numbers
from geoscene.export.vector import target_crs
from geoscene.geometry.frames import Frame, utm_crs
from geoscene.geometry.mesh import DOOR, FLOOR, OTHER, ROOF, WALL, WINDOW, Mesh, ShapeInstances
from geoscene.scene import Scene
from geoscene.support.files import append, atomic_file, spool
from geoscene.support.progress import Progress, silent
from geoscene.typing import Float, Ints

STEP = 1e-5
"""Metres per unit of the file's integers: a tenth of the grid of buildings, so that they are exact, and thin
triangles of the ground, or of solids in a CRS other than the scene's, do not collapse."""

LOD = {0: "1.1", 1: "1.3", 2: "2.1"}
"""The scene's level of detail in the terms of Biljecki, Ledoux and Stoter, "An improved LOD specification
for 3D building models" (2016): blocks; parts of several heights; roofs over indented outlines."""

LOD_OPENINGS = "3.2"
"""The same for buildings with windows and doors."""

_STREET_FURNITURE = (Class.POLE, Class.TRAFFIC_SIGN, Class.TRAFFIC_LIGHT, Class.BOLLARD, Class.BENCH)
_TYPES: dict[int, str] = {
    klass: name
    for name, classes in {
        "Road": (Class.ROAD, Class.LANE_MARKING, Class.CROSSING, Class.SIDEWALK, Class.KERB, Class.PARKING),
        "Railway": (Class.RAIL,),
        "TINRelief": (Class.TERRAIN,),
        "LandUse": (Class.GRASS, Class.FOREST_FLOOR, Class.SAND, Class.BUILDING_PAD, Class.PAVED),
        "WaterBody": (Class.WATER,),
        "Building": (Class.BUILDING,),
        "Bridge": (Class.BRIDGE,),
        "Tunnel": (Class.TUNNEL,),
        "CityFurniture": (Class.WALL, Class.FENCE, *_STREET_FURNITURE),
        "PlantCover": (Class.HEDGE,),
        "SolitaryVegetationObject": (Class.TREE_CROWN, Class.TRUNK),
        "OtherConstruction": (Class.OTHER_STRUCTURE,),
    }.items()
    for klass in classes
}
_CONSTRUCTIONS = frozenset({"Building", "Bridge", "Tunnel", "OtherConstruction"})
_WITH_PARTS = frozenset({"Building", "Bridge", "Tunnel"})
_INSTALLATION = "BuildingInstallation"
_INSTANCED = frozenset({"CityFurniture", "SolitaryVegetationObject", "OtherConstruction"}) | {
    f"{kind}Installation" for kind in _WITH_PARTS
}
"""Types that the schema lets have instances of templates."""
_AUXILIARY = frozenset({Class.KERB, Class.LANE_MARKING})
_PARTS = {"Railway": "TrafficArea", "WaterBody": "WaterSurface"}


class _Palette:
    """Numbers of the file's materials, in order of first use."""

    def __init__(self) -> None:
        self._numbers: dict[tuple[int, ...], int] = {}

    def values(self, mesh: Mesh, rows: Ints) -> Ints:
        """Number of the material (m,) of each face."""
        looks = np.column_stack([mesh.material[rows], mesh.color[rows]])
        known, which = np.unique(looks, axis=0, return_inverse=True)
        numbers = [self._numbers.setdefault(tuple(look), len(self._numbers)) for look in known.tolist()]
        return np.array(numbers, np.int64)[which.ravel()]

    def to_json(self) -> dict[str, Any]:
        """CityJSON's ``appearance``."""
        names = {material.code: name for name, material in materials().items()}
        return {
            "materials": [
                {"name": names.get(code, "unknown"), "diffuseColor": [round(v / 255, 4) for v in rgb]}
                for code, *rgb in self._numbers
            ]
        }


@dataclass(frozen=True, slots=True)
class _Target:
    """Quantisation of a file's coordinates: CRS and translation."""

    frame: Frame
    crs: CRS
    same: bool
    zero: Float

    def whole(self, points: Float) -> Ints:
        """Quantised coordinates (n, 3) of points in scene metres."""
        x, y = (
            self.frame.to_projected(points[:, 0], points[:, 1])
            if self.same
            else self.frame.to_crs(points[:, 0], points[:, 1], crs=self.crs)
        )
        moved = np.column_stack([x, y, points[:, 2]]) - self.zero
        return np.rint(moved * (1.0 / STEP)).astype(np.int64)


def _target(scene: Scene, crs: str | None) -> tuple[_Target, tuple[str, ...]]:
    """The given CRS; by default the scene's if it has an EPSG code, else UTM."""
    notes: tuple[str, ...] = ()
    xmin, ymin, xmax, ymax = scene.bounds
    middle = ((xmin + xmax) / 2, (ymin + ymax) / 2)
    if crs is None and not scene.frame.name.startswith("EPSG:"):
        crs = utm_crs(*(float(v) for v in scene.frame.to_geographic(*middle)))
        notes = (f"CityJSON names a CRS by its code and the scene's has none: coordinates are in {crs}",)
    parsed = target_crs(scene, crs)
    if not parsed.is_projected or parsed.to_epsg() is None:
        raise InputError(f"`crs` {crs}: CityJSON needs a projected CRS with an EPSG code")
    same = parsed == scene.frame.crs
    x, y = scene.frame.to_crs(middle[0], middle[1], crs=parsed)
    zero = np.array([np.floor(x), np.floor(y), 0.0])
    return _Target(scene.frame, parsed, same, zero), notes


def write_cityjson(
    scene: Scene,
    path: Path,
    *,
    crs: str | None = None,
    layers: Collection[str] | None = None,
    progress: Progress = silent,
) -> Summary:
    """Write a scene as CityJSON 2.0, tile by tile.

    Buildings are Solids (of several bodies: a BuildingPart for each; cavities are inner shells) with
    RoofSurface, WallSurface, GroundSurface and, under overhangs, OuterCeilingSurface; roads, water, land
    cover and the bare terrain are surfaces, cut at the tiles' edges; trees and street furniture are geometry
    instances. Attributes are those of the scene's layers, including the sources of assumed values.

    crs : projected, with an EPSG code; by default the scene's if it has one, else UTM

    Raises InputError for a CRS that CityJSON cannot name.
    """
    target, notes = _target(scene, crs)
    features = read_features(scene)
    library = list(scene.shapes().values())
    palette = _Palette()
    lod = LOD[int(scene.manifest.get("options", {}).get("lod", 2))]
    objects = solids = faces = 0
    numbers = Vertices(scene.tile_size)
    with atomic_file(path) as out, spool(path) as vertices:
        out.write(b'{"type":"CityJSON","version":"2.0","CityObjects":{')
        for part in parts(scene, layers, stage="CityJSON", progress=progress):
            before = numbers.count
            fresh, entries, closed = _tile_objects(
                part, features, library=library, target=target, palette=palette, lod=lod, numbers=numbers
            )
            for name, entry in entries:
                out.write(b",\n" if objects else b"\n")
                out.write(compact_json(name) + b":" + compact_json(entry))
                objects += 1
            if len(fresh):
                vertices.write(b",\n" if before else b"\n")
                vertices.write(compact_json(fresh.tolist())[1:-1])
            solids += closed
            faces += len(part.mesh)
        out.write(b'},\n"vertices":[')
        append(out, vertices)
        out.write(b"],\n")
        if library:
            out.write(b'"geometry-templates":' + compact_json(_templates(library, palette)) + b",\n")
        out.write(b'"appearance":' + compact_json(palette.to_json()) + b",\n")
        extent = np.concatenate([numbers.low, numbers.high]) * STEP + np.tile(target.zero, 2)
        transform = {"scale": [STEP] * 3, "translate": target.zero.tolist()}
        out.write(b'"transform":' + compact_json(transform))
        metadata = _metadata(scene, target, extent=extent if numbers.count else None)
        out.write(b',\n"metadata":' + compact_json(metadata) + b"}\n")
    name = f"EPSG:{target.crs.to_epsg()}"
    return Summary.of(path, "cityjson", objects=objects, solids=solids, faces=faces, crs=name, notes=notes)


def _metadata(scene: Scene, target: _Target, *, extent: Float | None) -> dict[str, Any]:
    title = [str(scene.manifest.get("name", "")), attribution(scene)]
    out: dict[str, Any] = {"title": " - ".join(filter(None, title))}
    if "fingerprint" in scene.manifest:
        out["identifier"] = str(scene.manifest["fingerprint"])
    if extent is not None:
        out["geographicalExtent"] = np.round(extent, 5).tolist()
    out["referenceSystem"] = f"https://www.opengis.net/def/crs/EPSG/0/{target.crs.to_epsg()}"
    return out


def _tile_objects(
    part: Part,
    features: FeatureAttributes,
    *,
    library: Sequence[Mesh],
    target: _Target,
    palette: _Palette,
    lod: str,
    numbers: Vertices,
) -> tuple[Ints, list[tuple[str, dict[str, Any]]], int]:
    """The tile's new quantised vertices, its city objects by name, and the number of solids among them."""
    mesh = part.mesh
    anchors = part.instances.transform[:, :, 3]
    points = np.concatenate([mesh.vertices, anchors]) + part.origin
    whole, ids = np.unique(target.whole(points), axis=0, return_inverse=True)
    ids = ids.ravel()
    corners = ids[mesh.faces].astype(np.int64)
    number, fresh = numbers.add(whole, column=part.index[0], span=part.span)
    found = pieces(mesh)
    owner = np.zeros(len(mesh), np.int64)
    for k, piece in enumerate(found):
        owner[piece.rows] = k
    closed = np.flatnonzero(mesh.closed)
    shell = np.full(len(mesh), -1, np.int64)
    shell[closed] = shell_numbers(corners[closed], owner[closed])
    entries = []
    solids = 0
    for piece in found:
        kind = _TYPES.get(piece.klass, "OtherConstruction" if piece.solid else "LandUse")
        look = palette.values(mesh, piece.rows)
        name = _name(features, piece, index=part.index)
        attributes = {"class": klass_name(piece.klass), **features.attributes(piece.feature)}
        if piece.solid:
            made = _solids(
                mesh,
                piece,
                whole=whole,
                triangles=corners[piece.rows],
                shell=shell[piece.rows],
                look=look,
                number=number,
                kind=kind,
            )
            opened = np.isin(mesh.surface[piece.rows], (WINDOW, DOOR)).any()
            own = LOD_OPENINGS if opened else lod
            entries += _solid_entries(
                name, kind, attributes=attributes, solids=[{"lod": own, **solid} for solid in made]
            )
            solids += 1
        else:
            triangles = number[corners[piece.rows]]
            made = [
                {"lod": "1", **_surface(piece, triangles[rows], look=look[rows], kind=kind)}
                for rows in _surfaces(triangles, kind=kind)
            ]
            entries.append((name, {"type": kind, "attributes": attributes, "geometry": made}))
    entries += _copies(
        part.instances,
        features,
        library=library,
        index=part.index,
        anchors=number[ids[len(mesh.vertices) :]],
        owners=dict(entries),
    )
    return fresh, entries, solids


def _name(features: FeatureAttributes, piece: Piece, *, index: tuple[int, int]) -> str:
    name = features.name(piece.feature)
    if piece.solid and piece.feature >= 0:
        return name
    return f"{name}/{klass_name(piece.klass)}@{index[0]}_{index[1]}"


def _solid_entries(
    name: str, kind: str, *, attributes: dict[str, Any], solids: list[dict[str, Any]]
) -> list[tuple[str, dict[str, Any]]]:
    """The city objects of a feature with one or more bodies, in geometry types that the schema permits.

    Buildings, bridges and tunnels of several bodies have a part for each; plant cover is always a MultiSolid.
    What stands out of a building's walls is its installation.
    """
    attached = [solid for solid in solids if solid["type"] == _INSTALLATION]
    if attached:
        solids = [solid for solid in solids if solid["type"] != _INSTALLATION]
        (own, *rest) = _solid_entries(name, kind, attributes=attributes, solids=solids)
        part = f"{name}-installation"
        whole = own[1] | {"children": [*own[1].get("children", ()), part]}
        installation = {"type": _INSTALLATION, "parents": [name], "geometry": [_multi_solid(attached)]}
        return [(name, whole), *rest, (part, installation)]
    if kind in _WITH_PARTS and len(solids) > 1:
        names = [f"{name}-{k + 1}" for k in range(len(solids))]
        parts_of = [
            (own, {"type": f"{kind}Part", "parents": [name], "geometry": [solid]})
            for own, solid in zip(names, solids, strict=True)
        ]
        whole = {"type": kind, "attributes": attributes, "children": names, "geometry": []}
        return [(name, whole), *parts_of]
    if kind not in _CONSTRUCTIONS and (len(solids) > 1 or kind == "PlantCover"):
        solids = [_multi_solid(solids)]
    return [(name, {"type": kind, "attributes": attributes, "geometry": solids})]


def _multi_solid(solids: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Solids without semantics as one geometry."""
    return {
        "lod": solids[0]["lod"],
        "type": "MultiSolid",
        "boundaries": [solid["boundaries"] for solid in solids],
        "material": {"visual": {"values": [solid["material"]["visual"]["values"] for solid in solids]}},
    }


def _solids(
    mesh: Mesh,
    piece: Piece,
    *,
    whole: Ints,
    triangles: Ints,
    shell: Ints,
    look: Ints,
    number: Ints,
    kind: str,
) -> list[dict[str, Any]]:
    """A Solid for each body."""
    names, values = np.unique(
        _surface_kinds(mesh, piece, whole=whole, triangles=triangles), return_inverse=True
    )
    surfaces: list[dict[str, Any]] = [{"type": str(n)} for n in names]
    openings = [k for k, name in enumerate(names) if name in ("Window", "Door")]
    if openings:
        wall = names.tolist().index("WallSurface")
        surfaces[wall]["children"] = openings
        for k in openings:
            surfaces[k]["parent"] = wall
    out = []
    for body in bodies(whole.astype(float), triangles, shell=shell):
        solid: dict[str, Any] = {
            "type": "Solid",
            "boundaries": [number[triangles[rows]][:, None].tolist() for rows in body],
            "material": {"visual": {"values": [look[rows].tolist() for rows in body]}},
        }
        if kind == "Building" and (mesh.surface[piece.rows[np.concatenate(body)]] == OTHER).all():
            solid["type"] = _INSTALLATION
        elif kind in _CONSTRUCTIONS:
            marks = [values[rows].tolist() for rows in body]
            solid["semantics"] = {"surfaces": surfaces, "values": marks}
        out.append(solid)
    return out


def _surface_kinds(mesh: Mesh, piece: Piece, *, whole: Ints, triangles: Ints) -> NDArray[np.str_]:
    """Semantic type (m,) of each face: the lowest floor is a GroundSurface, other floors are ceilings."""
    code = mesh.surface[piece.rows]
    height = whole[triangles, 2].max(axis=1)
    ground = height - whole[triangles, 2].min() <= 1
    return np.select(
        [code == ROOF, code == WALL, code == WINDOW, code == DOOR, (code == FLOOR) & ground, code == FLOOR],
        ["RoofSurface", "WallSurface", "Window", "Door", "GroundSurface", "OuterCeilingSurface"],
        "ClosureSurface",
    )


def _surfaces(triangles: Ints, *, kind: str) -> list[Ints]:
    """Rows of the faces of each surface: terrain is composite surfaces, each of which is one 2-manifold."""
    if kind != "TINRelief":
        return [np.arange(len(triangles))]
    patch = manifold_patches(triangles)
    order = np.argsort(patch, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(patch[order])) + 1)


def _surface(piece: Piece, triangles: Ints, *, look: Ints, kind: str) -> dict[str, Any]:
    out: dict[str, Any] = {
        "type": "CompositeSurface" if kind == "TINRelief" else "MultiSurface",
        "boundaries": triangles[:, None].tolist(),
        "material": {"visual": {"values": look.tolist()}},
    }
    part = _PARTS.get(kind, "")
    if kind == "Road":
        part = "AuxiliaryTrafficArea" if piece.klass in _AUXILIARY else "TrafficArea"
    if part:
        out["semantics"] = {"surfaces": [{"type": part}], "values": [0] * len(triangles)}
    return out


def _copies(
    instances: ShapeInstances,
    features: FeatureAttributes,
    *,
    library: Sequence[Mesh],
    index: tuple[int, int],
    anchors: Ints,
    owners: dict[str, dict[str, Any]],
) -> Iterator[tuple[str, dict[str, Any]]]:
    """One city object per feature with all its instances; one for each instance without a feature.

    Buildings cannot have instances: what stands on their roofs is an installation, and their child.

    owners : city objects of the tile's faces by name
    """
    key = np.where(instances.feature >= 0, instances.feature, -1 - np.arange(len(instances)))
    _, first, owner = np.unique(key, return_index=True, return_inverse=True)
    rows_of: list[list[int]] = [[] for _ in first]
    for row, number in enumerate(owner.tolist()):
        rows_of[number].append(row)
    for number in np.argsort(first, kind="stable").tolist():
        rows = rows_of[number]
        feature = int(instances.feature[rows[0]])
        klass = int(library[int(instances.shape[rows[-1]])].klass[0])
        name = features.name(feature) if feature >= 0 else f"copy/{rows[0]}"
        matrix = np.tile(np.eye(4), (len(rows), 1, 1))
        matrix[:, :3, :3] = instances.transform[rows][:, :, :3]
        attributes: dict[str, Any] = {"class": klass_name(klass)}
        kind, parents = _TYPES.get(klass, "CityFurniture"), {}
        if name in owners and owners[name]["type"] in _WITH_PARTS:
            kind, parents = f"{owners[name]['type']}Installation", {"parents": [name]}
            owners[name].setdefault("children", []).append(f"{name}@{index[0]}_{index[1]}")
        else:
            attributes |= features.attributes(feature)
        entry = {
            "type": kind if kind in _INSTANCED else "OtherConstruction",
            "attributes": attributes,
            **parents,
            "geometry": [
                {
                    "type": "GeometryInstance",
                    "template": int(instances.shape[row]),
                    "boundaries": [int(anchors[row])],
                    "transformationMatrix": np.round(matrix[k], 9).ravel().tolist(),
                }
                for k, row in enumerate(rows)
            ],
        }
        yield f"{name}@{index[0]}_{index[1]}", entry


def _templates(library: Sequence[Mesh], palette: _Palette) -> dict[str, Any]:
    templates, vertices = [], []
    first = 0
    for mesh in library:
        look = palette.values(mesh, np.arange(len(mesh)))
        templates.append(
            {
                "type": "MultiSurface",
                "lod": "2",
                "boundaries": (mesh.faces[:, None] + first).tolist(),
                "material": {"visual": {"values": look.tolist()}},
            }
        )
        vertices += np.round(mesh.vertices, 9).tolist()
        first += len(mesh.vertices)
    return {"templates": templates, "vertices-templates": vertices}
