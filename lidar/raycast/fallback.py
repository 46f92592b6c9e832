"""Ray casting through embreex's Python interface: the same results, slower, without Embree.

embreex casts single float32 rays at triangles without masks and instances. Static instances are expanded into
triangles, each mask gets a scene without its hidden faces, and moving instances are tested in their frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.columns import Columns
from geoscene.typing import Float
from lidar.errors import BackendError
from lidar.raycast.columns import Rays
from lidar.raycast.exact import STARTS, circles
from lidar.raycast.geometry import ALL, Geometry, Instances
from lidar.raycast.hits import Hits
from lidar.raycast.lanes import START
from lidar.raycast.planes import EXACT
from lidar.raycast.rays import in_scene

_NUDGE = 3e-7
_GRAZING = 1e-3


@dataclass(frozen=True, slots=True)
class _Soup(Columns):
    """Triangles relative to an origin: corners and hull (m, 3, 3), and their face, instance and mask (m,)."""

    corners: Float
    hull: Float
    face: NDArray[np.int32]
    instance: NDArray[np.int32]
    mask: NDArray[np.uint32]


def _joined(soups: Sequence[_Soup]) -> _Soup:
    empty, number = np.empty((0, 3, 3)), np.empty(0, np.int32)
    none = _Soup(empty, empty, number, number, np.empty(0, np.uint32))
    return _Soup.concatenate([none, *soups])


def _mesh(parts: dict[int, Geometry]) -> _Soup:
    soups = []
    for number in sorted(parts):
        part = parts[number]
        m = len(part)
        numbers = part.numbers if len(part.numbers) else np.arange(m, dtype=np.int32)
        face, none = (numbers + part.first).astype(np.int32), np.full(m, -1, np.int32)
        corners, hull = part.vertices[part.faces], part.hull[part.faces].astype(np.float64)
        soups.append(_Soup(corners, hull, face, none, np.full(m, part.mask, np.uint32)))
    return _joined(soups)


class _Body:
    """Static triangles in one frame, castable with embreex."""

    def __init__(self, soup: _Soup) -> None:
        from embreex.mesh_construction import TriangleMesh  # noqa: PLC0415
        from embreex.rtcore_scene import EmbreeScene  # noqa: PLC0415

        self.soup = soup
        self._by_mask: dict[int, _Body] = {}
        a, b, c = (soup.corners[:, k] for k in range(3))
        self.normal = np.cross(b - a, c - a)
        self._scene: Any = None
        if len(soup.face):
            self._scene = EmbreeScene()
            TriangleMesh(self._scene, soup.hull.astype(np.float32))

    def visible(self, mask: int) -> _Body:
        """The body without the faces that a mask hides."""
        shown = (self.soup.mask & np.uint32(mask)) != 0
        if shown.all():
            return self
        if mask not in self._by_mask:
            self._by_mask[mask] = _Body(self.soup.take(shown))
        return self._by_mask[mask]

    def first_hits(
        self, o: Float, d: Float, *, near: float | Float, far: Float, turned: bool
    ) -> NDArray[np.int64]:
        """Rows (n,) of the triangles that rays hit first; -1 for a miss."""
        if self._scene is None:
            return np.full(len(d), -1)
        length = np.linalg.norm(d, axis=1)
        unit = d / length[:, None]
        if turned:
            unit[np.arange(len(d)), np.argmin(np.abs(unit), axis=1)] += _NUDGE
        # embreex overwrites the bounds with ranges, so they must be a copy; 1e37 is unbounded.
        reach = np.minimum((far - near) * length * (1 + 2.0**-23), 1e37).astype(np.float32)
        start = (o + np.reshape(near, (-1, 1)) * d).astype(np.float32)
        found = self._scene.run(start, unit.astype(np.float32), dists=reach, query="INTERSECT", output=1)
        return np.asarray(found["primID"], np.int64)

    def outside(self, rows: NDArray[np.int64], o: Float, *, d: Float) -> Float:
        """Metres (n,) by which rays pass outside triangles; see `lidar.raycast.planes.outside`."""
        corners = self.soup.corners[rows] - o[:, None]
        edges = np.roll(corners, -1, axis=1) - corners
        length = np.linalg.norm(edges, axis=2)
        moment = np.einsum("ij,ikj->ik", d, np.cross(edges, corners))
        size = length * np.linalg.norm(d, axis=1)[:, None]
        passed = np.divide(moment, size, out=np.zeros_like(moment), where=size > 0)
        rounding = EXACT * (np.abs(o).sum(axis=1)[:, None] + np.abs(corners).sum(axis=2) + length)
        passed[np.abs(passed) <= rounding] = 0.0
        beside: Float = np.maximum(0.0, np.minimum(-passed.min(axis=1), passed.max(axis=1)))
        return beside

    def decided(
        self, rows: NDArray[np.int64], o: Float, *, d: Float, near: float, far: Float, margin: float
    ) -> NDArray[np.int64]:
        """The rows of first hits, decided in float64 where rays pass beside the triangle or start on it."""
        out, hit = rows.copy(), np.flatnonzero(rows >= 0)
        t, cosine, _ = self.at(rows[hit], o[hit], d=d[hit])
        starts = ~((t - near) * np.abs(cosine) * np.linalg.norm(d[hit], axis=1) > START)
        todo = hit[starts | (self.outside(rows[hit], o[hit], d=d[hit]) > 0)]
        if not len(todo):
            return out
        o, d, far = o[todo], d[todo], far[todo]
        length = np.linalg.norm(d, axis=1)
        best, closest, range_ = np.full(len(todo), -1), np.full(len(todo), np.inf), np.full(len(todo), np.inf)
        missed = np.zeros(len(todo), np.bool_)
        for shift in circles(d / length[:, None], margin):
            ahead, live = np.full(len(todo), near), np.arange(len(todo))
            for _ in range(STARTS):
                found = self.first_hits(
                    (o + shift)[live], d[live], near=ahead[live], far=far[live], turned=False
                )
                missed[live[found < 0]] = True
                live, found = live[found >= 0], found[found >= 0]
                t, cosine, _ = self.at(found, o[live], d=d[live])
                starts = ~((t - near) * np.abs(cosine) * length[live] > START)
                passed = self.outside(found, o[live], d=d[live])
                before = (passed < closest[live]) | ((passed == closest[live]) & (t < range_[live]))
                won = ~starts & (t <= far[live]) & before
                missed[live[~starts & (t > far[live])]] = True
                best[live[won]], closest[live[won]], range_[live[won]] = found[won], passed[won], t[won]
                ahead[live] += margin / (np.maximum(np.abs(cosine), 1e-6) * length[live])
                live = live[starts]
        out[todo] = np.where(missed & (closest > 0), -1, best)
        return out

    def at(self, rows: NDArray[np.int64], o: Float, *, d: Float) -> tuple[Float, Float, Float]:
        """Range, cosine and normal (not unit) where rays hit triangles; inf, 0 and 0 for row -1."""
        t, cosine = np.full(len(d), np.inf), np.zeros(len(d))
        normal = np.zeros((len(d), 3))
        hit = np.flatnonzero(rows >= 0)
        n, corners = self.normal[rows[hit]], self.soup.corners[rows[hit]]
        along = np.einsum("ij,ij->i", n, d[hit])
        size = np.linalg.norm(n, axis=1) * np.linalg.norm(d[hit], axis=1)
        cosine[hit] = -np.divide(along, size, out=np.zeros_like(along), where=size > 0)
        steep = np.abs(cosine[hit]) > 0
        gap = np.einsum("ij,ij->i", n, corners[:, 0] - o[hit])
        t[hit] = np.divide(gap, along, out=np.zeros_like(along), where=steep)
        # At grazing incidence the range is clipped to the face's extent along the ray.
        extent = (
            np.einsum("ikj,ij->ik", corners - o[hit, None], d[hit])
            / np.einsum("ij,ij->i", d[hit], d[hit])[:, None]
        )
        held = np.clip(t[hit], extent.min(axis=1), extent.max(axis=1))
        t[hit] = np.where(np.abs(cosine[hit]) < _GRAZING, held, t[hit])
        normal[hit] = n
        return t, cosine, normal


@dataclass(frozen=True, slots=True)
class _Mover:
    """A moving instance: its number, mask, body and transforms (s, 3, 4) over ray times 0 to 1."""

    instance: int
    mask: int
    body: _Body
    steps: Float

    def frames(self, time: NDArray[np.float32], n: int) -> Float:
        """Transforms (n, 3, 4) at ray times."""
        moment = np.zeros(n) if len(time) == 0 else time.astype(float)
        place = moment * (len(self.steps) - 1)
        step = np.minimum(place.astype(int), len(self.steps) - 2)
        w = (place - step)[:, None, None]
        between: Float = self.steps[step] + w * (self.steps[step + 1] - self.steps[step])
        return between


class EmbreexScene:
    """Same interface as `lidar.raycast.embree.EmbreeScene`, through embreex."""

    def __init__(self, origin: Float, *, dynamic: bool = False) -> None:  # noqa: ARG002
        self.origin = origin
        self.parts: dict[int, Geometry] = {}
        self._groups: list[tuple[Instances, Sequence[EmbreexScene]]] = []
        self._rest = _Body(_joined([]))
        self._movers: list[_Mover] = []
        self._margin = 0.0

    def attach(self, number: int, part: Geometry) -> None:
        """Add a geometry under a free number."""
        self.parts[number] = part

    def detach(self, number: int) -> None:
        """Remove the geometry of a number."""
        del self.parts[number]

    def place(self, groups: Sequence[Instances], scenes: Sequence[Sequence[Any]]) -> None:
        """Replace all instances; ``scenes`` holds the shapes of each group."""
        self._groups = list(zip(groups, scenes, strict=True))

    def commit(self) -> None:
        """Expand the static instances into triangles and collect the moving ones."""
        soups, self._movers, start = [_mesh(self.parts)], [], 0
        for group, shapes in self._groups:
            if any(not isinstance(shape, EmbreexScene) for shape in shapes):
                raise BackendError("instances and their shapes need the same backend")
            masks = np.full(len(group), ALL, np.uint32) if group.mask is None else group.mask
            meshes = [_mesh(shape.parts) for shape in shapes]
            for k, (which, matrix, bits) in enumerate(zip(group.shape, group.transform, masks, strict=True)):
                placed = np.array(matrix)
                placed[..., 3] += placed[..., :3] @ shapes[which].origin - self.origin
                mesh = meshes[which]
                number = np.full(len(mesh.face), start + k, np.int32)
                if placed.ndim == 2:
                    corners, hull = (
                        points @ placed[:, :3].T + placed[:, 3] for points in (mesh.corners, mesh.hull)
                    )
                    soups.append(_Soup(corners, hull, mesh.face, number, mesh.mask & bits))
                else:
                    soup = _Soup(mesh.corners, mesh.hull, mesh.face, number, mesh.mask)
                    self._movers.append(_Mover(start + k, int(bits), _Body(soup), placed))
            start += len(group)
        self._rest = _Body(_joined(soups))
        parts = [
            *self.parts.values(),
            *(p for _, shapes in self._groups for one in shapes for p in one.parts.values()),
        ]
        self._margin = max((part.margin for part in parts), default=0.0)

    def _views(self, rays: Rays, o: Float, *, d: Float) -> list[tuple[_Body, Float, Float, Float]]:
        """Bodies visible to rays, each with the rays' origins, directions and normal matrices."""
        views = [(self._rest.visible(rays.mask), o, d, np.broadcast_to(np.eye(3), (len(d), 3, 3)))]
        for mover in self._movers:
            if mover.mask & rays.mask:
                body = mover.body.visible(rays.mask)
                M = mover.frames(rays.time, len(d))
                back = np.linalg.inv(M[:, :, :3])
                local = np.einsum("nij,nj->ni", back, o - M[:, :, 3])
                cofactor = np.linalg.det(M[:, :, :3])[:, None, None] * np.swapaxes(back, 1, 2)
                views.append((body, local, np.einsum("nij,nj->ni", back, d), cofactor))
        return views

    def cast(self, rays: Rays, *, normals: bool, threads: int) -> Hits:  # noqa: ARG002
        """The first hit of each ray."""
        start, d = in_scene(rays)
        n, o = len(d), start - self.origin
        far = np.broadcast_to(rays.far, (n,))
        best, cosine, normal = np.full(n, np.inf), np.zeros(n), np.zeros((n, 3))
        face, instance = np.full(n, -1, np.int32), np.full(n, -1, np.int32)
        views = self._views(rays, o, d=d)
        for turned in (False, True):
            todo = np.flatnonzero((face < 0) | (cosine < 0)) if turned else np.arange(n)
            for body, local, way, axes in views:
                rows = body.first_hits(local[todo], way[todo], near=rays.near, far=far[todo], turned=turned)
                rows = body.decided(
                    rows, local[todo], d=way[todo], near=rays.near, far=far[todo], margin=self._margin
                )
                t, c, m = body.at(rows, local[todo], d=way[todo])
                m = np.einsum("nij,nj->ni", axes[todo], m)
                length = np.linalg.norm(m, axis=1) * np.linalg.norm(d[todo], axis=1)
                c = -np.divide(
                    np.einsum("ij,ij->i", m, d[todo]), length, out=np.zeros_like(c), where=length > 0
                )
                better = (t < best[todo]) & (t <= far[todo])
                if turned:
                    better &= (face[todo] < 0) | (c > 0)
                won, of = todo[better], rows[better]
                best[won], cosine[won], normal[won] = t[better], c[better], m[better]
                face[won], instance[won] = body.soup.face[of], body.soup.instance[of]
        if not normals:
            return Hits(best, face, instance, cosine.astype(np.float32), np.empty((0, 3)))
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        unit = np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)
        return Hits(best, face, instance, cosine.astype(np.float32), unit)

    def occluded(self, rays: Rays, *, threads: int) -> NDArray[np.bool_]:
        """Whether each ray hits anything."""
        return self.cast(rays, normals=False, threads=threads).face >= 0
