"""Meshes for modellers and printers: OBJ with its MTL, PLY, STL."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import materials
from geoscene.errors import InputError
from geoscene.export.kinds import Summary, size_of
from geoscene.export.objects import attribution, expand, klass_name, parts, pieces, read_features
from geoscene.geometry.mesh import Mesh, concatenate
from geoscene.geometry.watertight import degenerate_faces, validate_mesh
from geoscene.scene import Scene
from geoscene.support.files import append, atomic_file, spool
from geoscene.support.progress import Progress, silent
from geoscene.typing import Float, Ints


def meshes_of(
    scene: Scene, layers: Collection[str] | None, *, stage: str = "", progress: Progress = silent
) -> Iterator[tuple[tuple[int, int], Mesh]]:
    """Index and mesh of each tile in scene metres, its copies expanded."""
    library = list(scene.shapes().values())
    for part in parts(scene, layers, stage=stage, progress=progress):
        copies = [expand(part.instances, library)] if len(part.instances) else []
        yield part.index, concatenate([part.mesh, *copies]).shifted(part.origin)


def _head(scene: Scene) -> list[str]:
    """Comment lines that describe the coordinates."""
    east, north = scene.frame.origin
    wkt = " ".join(scene.frame.wkt.split())
    ascii_only = attribution(scene).replace("©", "(c)").encode("ascii", "replace").decode()
    return [
        "made by geoscene; x east, y north, z up, metres",
        ascii_only,
        f"add {east:z.0f} to x and {north:z.0f} to y for coordinates in {scene.frame.name}",
        f"heights: {scene.frame.vertical}",
        f"crs {wkt}",
    ]


SIZE_LIMIT = 500.0
"""Megabytes of an OBJ file, at most, by default."""


def write_obj(
    scene: Scene,
    path: Path,
    *,
    layers: Collection[str] | None = None,
    size_limit: float = SIZE_LIMIT,
    progress: Progress = silent,
) -> Summary:
    """Write a scene as Wavefront OBJ with an MTL file: one object per feature, z up, scene metres.

    Coordinates are multiples of 0.1 mm, the grid of the solids, and so are exact.

    size_limit : megabytes of the file, at most

    Raises InputError if it would be larger.
    """
    size, copies = estimate_obj(scene, layers, progress=progress)
    if size > size_limit * 1e6:
        raise InputError(
            f"{path}: would have about {size / 1e6:,.0f} MB, more than `size_limit` {size_limit:g}, as OBJ"
            f" repeats the triangles of all {copies:,} trees and other copies; write a .glb file, choose"
            " `layers`, or raise `size_limit`"
        )
    features = read_features(scene)
    objects = solids = faces = first = 0
    looks: dict[tuple[int, ...], str] = {}
    library = path.with_suffix(".mtl")
    with atomic_file(path) as out, atomic_file(library) as colors:  # the file that names the other comes last
        out.write("".join(f"# {line}\n" for line in _head(scene)).encode())
        out.write(f"mtllib {library.name}\n".encode())
        for index, mesh in meshes_of(scene, layers, stage="OBJ", progress=progress):
            out.write(_lines("v %.4f %.4f %.4f\n", mesh.vertices))
            for piece in pieces(mesh):
                name = features.name(piece.feature)
                if not piece.solid or piece.feature < 0:
                    name += f"/{klass_name(piece.klass)}@{index[0]}_{index[1]}"
                out.write(f"o {name.replace(' ', '_')}\n".encode())
                look = np.column_stack([mesh.material[piece.rows], mesh.color[piece.rows]])
                known, which = np.unique(look, axis=0, return_inverse=True)
                for number, key in enumerate(known.tolist()):
                    material = looks.setdefault(tuple(key), _material_name(key))
                    out.write(f"usemtl {material}\n".encode())
                    rows = piece.rows[which.ravel() == number]
                    out.write(_lines("f %d %d %d\n", mesh.faces[rows] + (first + 1)))
                objects += 1
                solids += piece.solid
            first += len(mesh.vertices)
            faces += len(mesh)
        for (_, *rgb), material in looks.items():
            color = " ".join(f"{v / 255:.4f}" for v in rgb)
            colors.write(f"newmtl {material}\nKd {color}\nKa 0 0 0\nKs 0 0 0\nd 1\nillum 1\n\n".encode())
    size = size_of(path)[1] + size_of(library)[1]
    return Summary(path, "obj", 2, size, objects, solids, faces, scene.frame.name)


def estimate_obj(
    scene: Scene, layers: Collection[str] | None, *, progress: Progress = silent
) -> tuple[int, int]:
    """Bytes that `write_obj` would write, to a few percent, and the number of copies of shapes."""
    shapes = list(scene.shapes().values())
    corners = np.array([len(shape.vertices) for shape in shapes], np.int64)
    triangles = np.array([len(shape) for shape in shapes], np.int64)
    size = first = copies = 0
    for part in parts(scene, layers, stage="OBJ: size", progress=progress):
        mesh, shape = part.mesh, part.instances.shape
        places = part.instances.transform[:, :, 3] + part.origin
        size += _vertex_bytes(mesh.vertices + part.origin).sum() + _vertex_bytes(places) @ corners[shape]
        count = len(mesh.vertices) + int(corners[shape].sum())
        faces = len(mesh) + int(triangles[shape].sum())
        size += faces * len("f   \n" + 3 * str(first + count // 2 + 1))
        looks = np.unique(mesh.feature.astype(np.int64) * 256 + mesh.material)
        size += len(looks) * _LOOK_BYTES
        first, copies = first + count, copies + len(shape)
    return int(size), copies


_LOOK_BYTES = 60
"""Bytes of the lines ``o`` and ``usemtl`` of an object, or of a part of it with another material."""


def _vertex_bytes(points: Float) -> Ints:
    """Bytes (n,) of the lines of vertices at points (n, 3)."""
    digits = np.floor(np.log10(np.maximum(np.abs(points), 1.0))) + 1 + (points < 0)
    lengths: Ints = (len("v   \n") + 3 * len(".0000") + digits.sum(axis=1)).astype(np.int64)
    return lengths


def _lines(form: str, values: NDArray[Any]) -> bytes:
    """Rows of values formatted by one printf format in a single call."""
    return ((form * len(values)) % tuple(values.ravel().tolist())).encode()


def _material_name(look: list[int]) -> str:
    names = {material.code: name for name, material in materials().items()}
    code, r, g, b = look
    return f"{names.get(code, 'unknown')}_{r:02x}{g:02x}{b:02x}"


_FACE = np.dtype(
    [
        ("corners", "u1"), ("corner", "<i4", 3), ("feature", "<i4"), ("class", "u1"), ("material", "u1"),
        ("surface", "u1"), ("closed", "u1"), ("red", "u1"), ("green", "u1"), ("blue", "u1"),
    ]
)  # fmt: skip


def write_ply(
    scene: Scene, path: Path, *, layers: Collection[str] | None = None, progress: Progress = silent
) -> Summary:
    """Write a scene as one binary little-endian PLY: double vertices in scene metres, z up.

    Each face has ``feature``, ``class``, ``material``, ``surface`` (0 other, 1 wall, 2 roof, 3 floor),
    ``closed`` (of a solid), ``red``, ``green`` and ``blue``; codes as in the scene's manifest.
    """
    solids: set[int] = set()
    vertices = faces = objects = 0
    with atomic_file(path) as out, spool(path) as rest:
        out.write(_ply_head(scene, 0, faces=0))
        for _, mesh in meshes_of(scene, layers, stage="PLY", progress=progress):
            out.write(mesh.vertices.astype("<f8").tobytes())
            rows = np.zeros(len(mesh), _FACE)
            rows["corners"] = 3
            rows["corner"] = mesh.faces + vertices
            rows["feature"], rows["class"], rows["material"] = mesh.feature, mesh.klass, mesh.material
            rows["surface"], rows["closed"] = mesh.surface, mesh.closed
            for k, name in enumerate(("red", "green", "blue")):
                rows[name] = mesh.color[:, k]
            rest.write(rows.tobytes())
            vertices += len(mesh.vertices)
            faces += len(mesh)
            objects += len(pieces(mesh))
            solids |= set(np.unique(mesh.feature[mesh.closed]).tolist())
        append(out, rest)
        out.seek(0)
        out.write(_ply_head(scene, vertices, faces=faces))
    return Summary.of(path, "ply", objects=objects, solids=len(solids), faces=faces, crs=scene.frame.name)


def _ply_head(scene: Scene, vertices: int, *, faces: int) -> bytes:
    """The header; its length does not depend on the counts, which are known only at the end."""
    kinds = {"i": "int", "u": "uchar"}
    columns = [f"property {kinds[_FACE[name].kind]} {name}" for name in _FACE.names[2:]]  # type: ignore[index]
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {line}" for line in _head(scene)),
        f"element vertex {vertices:<12d}",
        *(f"property double {axis}" for axis in "xyz"),
        f"element face {faces:<12d}",
        "property list uchar int vertex_indices",
        *columns,
        "end_header",
    ]
    return ("\n".join(lines) + "\n").encode()


def write_stl(
    scene: Scene, path: Path, *, layers: Collection[str] | None = None, progress: Progress = silent
) -> Summary:
    """Write the solids of a scene as one binary STL, z up, metres from the middle of the scene.

    STL has no objects, no colours and float32 coordinates. Faces that rounding makes degenerate are left out,
    as are solids that would no longer be closed; the notes count these.

    Raises InputError if there is no solid.
    """
    xmin, ymin, xmax, ymax = scene.bounds
    middle = np.array([np.round((xmin + xmax) / 2), np.round((ymin + ymax) / 2), 0.0])
    east, north = scene.frame.origin
    facets = solids = broken = 0
    row = np.dtype([("normal", "<f4", 3), ("corner", "<f4", (3, 3)), ("attribute", "<u2")])
    head = f"geoscene; add {middle[0] + east:z.0f} {middle[1] + north:z.0f} 0; {scene.frame.name}"
    with atomic_file(path) as out:
        out.write(head.encode("ascii", "replace")[:80].ljust(80, b" ") + bytes(4))
        for _, mesh in meshes_of(scene, layers, stage="STL", progress=progress):
            mesh, lost = _in_single_precision(mesh.take(mesh.closed).shifted(-middle))  # noqa: PLW2901
            rows = np.zeros(len(mesh), row)
            rows["normal"] = mesh.normals()
            rows["corner"] = mesh.vertices[mesh.faces]
            out.write(rows.tobytes())
            facets += len(mesh)
            solids += len(np.unique(mesh.feature))
            broken += lost
        if not facets:
            chosen = "the scene" if layers is None else f"`layers` {', '.join(layers)}"
            raise InputError(f"{path}: {chosen} has no solids, and STL has nothing else")
        out.seek(80)
        out.write(np.array(facets, "<u4").tobytes())
    notes = (f"{broken} solids left out: float32 coordinates would not leave them closed",) if broken else ()
    return Summary.of(
        path, "stl", objects=solids, solids=solids, faces=facets, crs=scene.frame.name, notes=notes
    )


def _in_single_precision(mesh: Mesh) -> tuple[Mesh, int]:
    """Solids rounded to float32 that are still closed, and the number of the others."""
    points = mesh.vertices.astype(np.float32).astype(np.float64)
    rounded = replace(mesh, vertices=points)
    rounded = rounded.take(~degenerate_faces(points, mesh.faces))
    verdict = validate_mesh(rounded)
    bad = verdict.feature[~verdict.closed_solid]
    return rounded.take(~np.isin(rounded.feature, bad)), len(bad)
