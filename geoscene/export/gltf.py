"""glTF 2.0 binary files, written incrementally: lists and buffers are spooled to disk and then joined."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import materials
from geoscene.errors import InputError
from geoscene.export.kinds import compact_json
from geoscene.export.objects import FeatureAttributes, table_columns
from geoscene.geometry.mesh import Mesh, ShapeInstances
from geoscene.support.files import append, spool
from geoscene.typing import Float

_COMPONENTS = {"u2": 5123, "u4": 5125, "f4": 5126}
_SHAPES = {0: "SCALAR", 3: "VEC3", 4: "VEC4"}
_ARRAY, _ELEMENTS = 34962, 34963
_LARGEST = 2**32 - 1

# The views of the buffer, in order: name, target, bytes from one vertex to the next.
_VIEWS: tuple[tuple[str, int, int], ...] = (
    ("positions", _ARRAY, 12),
    ("ids", _ARRAY, 4),
    ("short indices", _ELEMENTS, 0),
    ("indices", _ELEMENTS, 0),
    ("copies", 0, 0),
)


def y_up(points: Float) -> Float:
    """Points (..., 3) of x east, y north, z up in glTF's axes: x east, y up, z south."""
    return np.stack([points[..., 0], points[..., 2], -points[..., 1]], axis=-1)


class _Spooled:
    """A JSON list on disk."""

    def __init__(self, file: IO[bytes]) -> None:
        self.file = file
        self.count = 0

    def add(self, value: Any) -> int:
        """Append a value; returns its number."""
        self.file.write((b"," if self.count else b"") + compact_json(value))
        self.count += 1
        return self.count - 1


class GlbWriter:
    """Writer of one .glb file.

    near : a path on the disk for temporary files
    """

    def __init__(self, near: Path) -> None:
        self._stack = ExitStack()
        self._lists = {
            name: _Spooled(self._stack.enter_context(spool(near)))
            for name in ("nodes", "meshes", "accessors")
        }
        self._views = {name: self._stack.enter_context(spool(near)) for name, _, _ in _VIEWS}
        self._materials: dict[tuple[int, ...], int] = {}
        self._tables: list[dict[str, Any]] = []
        self._classes: dict[str, dict[str, Any]] = {}
        self._columns: list[bytes] = []
        self._extensions: set[str] = set()

    def __enter__(self) -> Self:
        return self

    def __exit__(  # noqa: PLR0917 - the protocol of context managers
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    @property
    def nodes(self) -> int:
        """Number of nodes so far, which is the index of the next."""
        return self._lists["nodes"].count

    def node(self, **members: Any) -> int:
        """Add a node; returns its number."""
        return self._lists["nodes"].add({k: v for k, v in members.items() if v is not None})

    def accessor(self, view: str, values: NDArray[Any], *, bounds: bool = False) -> int:
        """Add values (n,) or (n, k) to a view of the buffer; returns the accessor's number."""
        file = self._views[view]
        description: dict[str, Any] = {
            "bufferView": [name for name, _, _ in _VIEWS].index(view),
            "byteOffset": file.tell(),
            "componentType": _COMPONENTS[values.dtype.str[1:]],
            "count": len(values),
            "type": _SHAPES[values.shape[1] if values.ndim > 1 else 0],
        }
        if bounds:
            description |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        file.write(np.ascontiguousarray(values).tobytes())
        file.write(b"\0" * (-file.tell() % 4))
        return self._lists["accessors"].add(description)

    def material(self, code: int, color: Sequence[int]) -> int:
        """Number of the material of a code and an sRGB colour, added if new."""
        return self._materials.setdefault((code, *color), len(self._materials))

    def mesh(
        self,
        mesh: Mesh,
        points: NDArray[np.float32],
        *,
        name: str | None = None,
        table: int | None = None,
        rows: NDArray[np.integer] | None = None,
        count: int = 1,
    ) -> int:
        """Add a mesh whose primitives, one per material and colour, share their vertices; returns its number.

        points : (n, 3) float32, the mesh's vertices in glTF's axes
        table  : the features' property table
        rows   : (n,) row of each vertex's feature
        count  : number of features among them
        """
        attributes = {"POSITION": self.accessor("positions", points, bounds=True)}
        extensions: dict[str, Any] = {}
        if table is not None and rows is not None:
            attributes["_FEATURE_ID_0"] = self.accessor("ids", rows.astype("<f4"))
            ids = {"featureCount": count, "attribute": 0, "propertyTable": table}
            extensions = {"extensions": {"EXT_mesh_features": {"featureIds": [ids]}}}
            self._extensions.add("EXT_mesh_features")
        looks = np.column_stack([mesh.material, mesh.color])
        known, which = np.unique(looks, axis=0, return_inverse=True)
        which = which.ravel()
        primitives = []
        for number, (code, *color) in enumerate(known.tolist()):
            faces = mesh.faces[which == number].ravel()
            short = len(points) < 2**16
            indices = self.accessor(
                "short indices" if short else "indices", faces.astype("<u2" if short else "<u4")
            )
            primitives.append(
                {
                    "attributes": attributes,
                    "indices": indices,
                    "material": self.material(code, color),
                    **extensions,
                }
            )
        return self._lists["meshes"].add({"primitives": primitives, **({"name": name} if name else {})})

    def copies(
        self,
        mesh: int,
        transform: Float,
        *,
        name: str,
        origin: Float,
        table: int | None = None,
        rows: NDArray[np.integer] | None = None,
        count: int = 1,
    ) -> int:
        """Add a node with many instances of a mesh (EXT_mesh_gpu_instancing); returns its number.

        transform : (k, 3, 4), rotation and scale, then translation, x east, y north, z up
        origin    : (3,) position of the node, to which translations are relative
        rows      : (k,) row of each instance's feature in the property table
        """
        shift, turn, size = _decompose(transform)
        attributes = {
            "TRANSLATION": self.accessor("copies", y_up(shift - origin).astype("<f4"), bounds=True),
            "ROTATION": self.accessor("copies", turn.astype("<f4")),
            "SCALE": self.accessor("copies", size.astype("<f4")),
        }
        extensions: dict[str, Any] = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
        self._extensions.add("EXT_mesh_gpu_instancing")
        if table is not None and rows is not None:
            attributes["_FEATURE_ID_0"] = self.accessor("copies", rows.astype("<f4"))
            ids = {"featureCount": count, "attribute": 0, "propertyTable": table}
            extensions["EXT_instance_features"] = {"featureIds": [ids]}
            self._extensions.add("EXT_instance_features")
        place = y_up(origin).tolist()
        return self.node(name=name, mesh=mesh, translation=place, extensions=extensions)

    def property_table(self, name: str, columns: Mapping[str, NDArray[Any]], *, count: int) -> int:
        """Add a table of attributes, one row per feature (EXT_structural_metadata); returns its number."""
        properties, described = {}, {}
        for column, values in columns.items():
            description, arrays = _encode(np.asarray(values))
            described[column] = description
            if arrays["values"]:  # a column without any text is left out: no view may be empty
                properties[column] = {role: self._column(data) for role, data in arrays.items()}
        self._classes[name] = {"name": name, "properties": described}
        self._tables.append({"name": name, "class": name, "count": count, "properties": properties})
        self._extensions.add("EXT_structural_metadata")
        return len(self._tables) - 1

    def _column(self, data: bytes) -> int:
        self._columns.append(data)
        return len(_VIEWS) + len(self._columns) - 1

    def finish(self, out: IO[bytes], *, scene_nodes: Sequence[int], asset: Mapping[str, Any]) -> None:
        """Write the file.

        Raises InputError if it would exceed the format's limit of 4 GiB.
        """
        for view in self._views.values():
            if not view.tell():
                view.write(b"\0" * 16)  # no view may be empty, and their numbers stand
        # a view is as long as what is in it, and begins at a multiple of eight bytes
        sizes = [*(view.tell() for view in self._views.values()), *map(len, self._columns)]
        starts = np.cumsum([0, *(size + -size % 8 for size in sizes)]).tolist()
        if starts[-1] > _LARGEST - 2**28:
            raise InputError(
                f"{starts[-1] / 2**30:.1f} GiB are more than one .glb holds; take 3D Tiles or fewer layers"
            )
        out.write(struct.pack("<4sIII4s", b"glTF", 2, 0, 0, b"JSON"))
        self._json(out, starts, sizes=sizes, scene_nodes=scene_nodes, asset=asset)
        out.write(b" " * (-out.tell() % 4))
        length = out.tell() - 20
        out.write(struct.pack("<I4s", starts[-1], b"BIN\0"))
        for view in self._views.values():
            append(out, view)
            out.write(b"\0" * (-view.tell() % 8))
        for data in self._columns:
            out.write(data + b"\0" * (-len(data) % 8))
        total = out.tell()
        if total > _LARGEST:
            raise InputError("more than 4 GiB are more than one .glb holds; take 3D Tiles or fewer layers")
        out.seek(8)
        out.write(struct.pack("<II", total, length))
        out.seek(total)

    def _json(
        self,
        out: IO[bytes],
        starts: Sequence[int],
        *,
        sizes: Sequence[int],
        scene_nodes: Sequence[int],
        asset: Mapping[str, Any],
    ) -> None:
        head: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "geoscene", **asset},
            "scene": 0,
            "scenes": [{"nodes": list(scene_nodes)}],
        }
        if self._extensions:
            head["extensionsUsed"] = sorted(self._extensions)
        if "EXT_mesh_gpu_instancing" in self._extensions:
            head["extensionsRequired"] = ["EXT_mesh_gpu_instancing"]
        if self._tables:
            schema = {"id": "geoscene", "classes": self._classes}
            description = {"schema": schema, "propertyTables": self._tables}
            head["extensions"] = {"EXT_structural_metadata": description}
        if self._materials:
            head["materials"] = [_material(code, color) for code, *color in self._materials]
        head["buffers"] = [{"byteLength": starts[-1]}]
        head["bufferViews"] = [_view(k, starts[k], size=sizes[k]) for k in range(len(sizes))]
        text = compact_json({k: v for k, v in head.items() if v})
        out.write(text[:-1])
        for name, values in self._lists.items():
            if values.count:
                out.write(f',"{name}":['.encode())
                append(out, values.file)
                out.write(b"]")
        out.write(b"}")


class PropertyTables:
    """Rows of the property tables: a table for each layer, a row for each feature and class in it."""

    def __init__(self, features: FeatureAttributes) -> None:
        self.features = features
        self._tables: dict[int, tuple[int, dict[tuple[int, int], int]]] = {}

    def metadata(self, layer: int, pairs: NDArray[np.integer]) -> dict[str, Any]:
        """Number of a layer's table, the rows (n,) of pairs (n, 2) of feature and class, and their number."""
        number, known = self._tables.setdefault(layer, (len(self._tables), {}))
        rows = np.array([known.setdefault((f, k), len(known)) for f, k in pairs.tolist()], np.int64)
        return {"table": number, "rows": rows, "count": len(np.unique(rows))}

    def write(self, writer: GlbWriter) -> None:
        """Add the tables to a file, in the order of their numbers."""
        for layer, (_, known) in self._tables.items():
            columns = table_columns(self.features, layer=layer, pairs=np.array([*known]))
            writer.property_table(self.features.layers[layer], columns, count=len(known))


def add_instances(
    writer: GlbWriter,
    instances: ShapeInstances,
    *,
    features: FeatureAttributes,
    library: Mapping[str, Mesh],
    meshes: dict[int, int],
    metadata: Callable[[int, NDArray[np.integer]], dict[str, Any]],
) -> list[int]:
    """Add a node for every shape and layer of instances; returns the nodes' numbers.

    meshes   : numbers of the meshes of shapes that the file has already; new ones are added
    metadata : the arguments ``table``, ``rows`` and ``count`` of `GlbWriter.copies` for a layer's number and
               the feature and class (k, 2) of its instances, see `PropertyTables.metadata`
    """
    layer = np.searchsorted(features.starts, instances.feature, side="right") - 1
    keys = np.column_stack([instances.shape, layer])
    names, nodes = list(library), []
    for number, of_layer in np.unique(keys, axis=0).tolist():
        chosen = (keys == (number, of_layer)).all(axis=1)
        name = names[number]
        shape = library[name]
        if number not in meshes:
            meshes[number] = writer.mesh(shape, y_up(shape.vertices).astype("<f4"), name=name)
        feature = instances.feature[chosen]
        klass = np.full(len(feature), np.bincount(shape.klass).argmax())  # that of most faces
        ids = metadata(of_layer, np.column_stack([feature, klass])) if of_layer >= 0 else {}
        transform = instances.transform[chosen]
        origin = np.round(transform[:, :, 3].mean(axis=0))
        nodes.append(writer.copies(meshes[number], transform, name=name, origin=origin, **ids))
    return nodes


def _view(number: int, start: int, *, size: int) -> dict[str, Any]:
    view: dict[str, Any] = {"buffer": 0, "byteOffset": start, "byteLength": size}
    if number < len(_VIEWS):
        _, target, stride = _VIEWS[number]
        view |= {k: v for k, v in (("target", target), ("byteStride", stride)) if v}
    return view


def _material(code: int, color: Sequence[int]) -> dict[str, Any]:
    """A matt material of an sRGB colour, converted to linear values (IEC 61966-2-1)."""
    table = {m.code: m for m in materials().values()}
    srgb = np.asarray(color) / 255.0
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    specular = table[code].specular if code in table else 0.0
    return {
        "name": table[code].name if code in table else "unknown",
        "pbrMetallicRoughness": {
            "baseColorFactor": [*np.round(linear, 5).tolist(), 1.0],
            "metallicFactor": 0.0,
            "roughnessFactor": round(1.0 - 0.9 * specular, 3),
        },
    }


def _decompose(transform: Float) -> tuple[Float, Float, Float]:
    """Translation (k, 3), and rotation (k, 4: x, y, z, w) and scale (k, 3) in glTF's axes."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415  (slow to import)

    linear = transform[:, :, :3]
    size = np.linalg.norm(linear, axis=1)
    axes = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    turn = axes @ (linear / size[:, None, :]) @ axes.T
    quaternion = Rotation.from_matrix(turn).as_quat(canonical=True)
    return transform[:, :, 3], quaternion, size[:, [0, 2, 1]]


_NUMBERS = {"f8": "FLOAT64", "f4": "FLOAT32", "i8": "INT64", "i4": "INT32", "i2": "INT16", "u1": "UINT8"}
_NO_NUMBER = -9999.0


def _encode(values: NDArray[Any]) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Description of a column for EXT_structural_metadata, and its buffers."""
    if values.dtype == np.bool_:
        return {"type": "BOOLEAN"}, {"values": np.packbits(values, bitorder="little").tobytes()}
    kind = values.dtype.str[1:]
    if kind in _NUMBERS:
        description: dict[str, Any] = {"type": "SCALAR", "componentType": _NUMBERS[kind]}
        if values.dtype.kind == "f":
            values = np.where(np.isfinite(values), values, _NO_NUMBER)
            description["noData"] = _NO_NUMBER
        return description, {"values": values.tobytes()}
    texts = ["" if v is None else str(v) for v in values.tolist()]
    data = [text.encode() for text in texts]
    offsets = np.cumsum([0, *(len(d) for d in data)]).astype("<u4")
    return {"type": "STRING"}, {"values": b"".join(data), "stringOffsets": offsets.tobytes()}
