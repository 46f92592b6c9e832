"""Random descriptions of facades, their walls as planes, and the same facades as triangles."""

import itertools

import numpy as np

from geoscene.buildings.facades import FacadeTable, Openings, WallRelief
from geoscene.classes import Class, materials
from geoscene.geometry.mesh import WALL, Mesh

NORMALS = {"front": (0, 0, -1), "left": (1, 0, 0), "right": (-1, 0, 0), "low": (0, 1, 0), "high": (0, -1, 0)}


def random_openings(rng, count, size, *, infill=("glass", "wood")):
    """Kinds of openings for cells of a size: some without sill, without panel, without frame or bars."""
    known = {name: m.code for name, m in materials().items()}
    rows = []
    for _ in range(count):
        w, h = size
        panel = np.array([*(rng.uniform(0.0, 0.15, 2) * size), *((1 - rng.uniform(0.0, 0.15, 2)) * size)])
        wide, tall = panel[2] - panel[0], panel[3] - panel[1]
        low = panel[1] + rng.uniform(0.15, 0.4) * tall
        opening = [
            panel[0] + rng.uniform(0.0, 0.3) * wide,
            low,
            panel[2] - rng.uniform(0.0, 0.3) * wide,
            panel[3] - rng.uniform(0.0, 0.3) * tall,
        ]
        sill = [opening[0] - 0.02 * w, low - rng.uniform(0.02, 0.1) * h, opening[2] + 0.02 * w, low]
        sill = [max(sill[0], panel[0]), max(sill[1], panel[1]), min(sill[2], panel[2]), sill[3]]
        if rng.random() < 0.3:
            sill = [0.0] * 4
        depth = np.cumsum([rng.choice([0.0, rng.uniform(0.01, 0.1)]), *rng.uniform(0.02, 0.3, 2)])
        clear = min(opening[2] - opening[0], opening[3] - opening[1])
        rows.append(
            {
                "panel": panel,
                "sill": sill,
                "opening": opening,
                "panel_depth": depth[0],
                "reveal_depth": depth[1],
                "pane_depth": depth[2],
                "frame": rng.choice([0.0, 0.08 * clear]),
                "bars": rng.integers(0, 4, 2).astype(np.int32),
                "bar": 0.05 * clear,
                "room": depth[2] + rng.uniform(2, 6),
                "door": False,
                "trim": np.uint8(known["stone"]),
                "frame_material": np.uint8(known["wood"]),
                "infill": np.uint8(known[str(rng.choice(infill))]),
                **{
                    f"{part}_color": rng.integers(0, 256, 3).astype(np.uint8)
                    for part in ("trim", "frame", "infill", "room")
                },
            }
        )
    return Openings(**{name: np.array([row[name] for row in rows]) for name in rows[0]})


def random_relief(rng, *, columns=3, rows=3, kinds=4, angle=None, foot=None, feature=7):
    """A wall of two triangles with a margin around its grid of cells; and its description."""
    angle = rng.uniform(0, 2 * np.pi) if angle is None else angle
    foot = rng.uniform(-20, 20, 3) if foot is None else np.asarray(foot, float)
    cell, ground = rng.uniform(2, 4, 2), rng.uniform(3.0, 5.0)
    start = rng.uniform(0.1, 1.0, 2)
    size = 2 * start + [columns * cell[0], ground + (rows - 1) * cell[1]]
    facades = FacadeTable(
        feature=np.array([feature], np.int32),
        foot=foot[None],
        tangent=np.array([[np.cos(angle), np.sin(angle)]]),
        size=size[None],
        start=start[None],
        cell=cell[None],
        ground=np.array([ground]),
        grid=np.array([[columns, rows]], np.int32),
        first=np.zeros(1, np.int32),
    )
    openings = random_openings(rng, kinds, np.minimum(cell, [np.inf, ground]))
    cells = rng.integers(-1, kinds, columns * rows).astype(np.int16)
    return WallRelief(facades, cells, openings, np.zeros(2, np.int32))


def plane_mesh(relief):
    """The wall as a plane."""
    width, height = relief.facades.size[0]
    return _placed(relief, [_quad((0, 0, width, height), 0.0)])


def relief_mesh(relief):
    """The wall with its openings as triangles; the surfaces of each part in `Mesh.surface` (0 wall .. 3)."""
    facades, openings = relief.facades, relief.openings
    width, height = facades.size[0]
    quads, panels = [], []
    columns, rows = facades.grid[0]
    for row, column in itertools.product(range(rows), range(columns)):
        k = relief.cells[row * columns + column]
        if k < 0:
            continue
        x = facades.start[0, 0] + column * facades.cell[0, 0]
        y = facades.start[0, 1] + (facades.ground[0] + (row - 1) * facades.cell[0, 1] if row else 0.0)
        at = np.array([x, y, x, y])
        panel, sill, opening = at + openings.panel[k], at + openings.sill[k], at + openings.opening[k]
        front, reveal, pane = openings.panel_depth[k], openings.reveal_depth[k], openings.pane_depth[k]
        panels.append(panel)
        has_sill = openings.sill[k, 2] > openings.sill[k, 0]
        quads += _plate(panel, [opening, *([sill] if has_sill else [])], front)
        quads += _tube(panel, 0.0, front)
        if has_sill:
            quads.append(_quad(sill, 0.0, part=1))
            quads += [(corners[::-1], 1) for corners, _ in _tube(sill, 0.0, front)]
        quads += _tube(opening, front, reveal)
        f = openings.frame[k]
        xs = _panes(opening[0] + f, opening[2] - f, openings.bars[k, 0], openings.bar[k])
        ys = _panes(opening[1] + f, opening[3] - f, openings.bars[k, 1], openings.bar[k])
        panes = [(a, c, b, d) for (a, b), (c, d) in itertools.product(xs, ys)]
        quads += [(corners, 2) for corners, _ in _plate(opening, panes, reveal)]
        for one in panes:
            quads += [(corners, 2) for corners, _ in _tube(one, reveal, pane)]
            quads.append(_quad(one, pane, part=3))
    return _placed(relief, quads + _plate((0, 0, width, height), panels, 0.0))


def _panes(low, high, bars, bar):
    middles = low + (high - low) * np.arange(1, bars + 1) / (bars + 1)
    return list(zip([low, *(middles + bar / 2)], [*(middles - bar / 2), high], strict=True))


def _quad(box, z, part=0):
    a, b, c, d = box
    return np.array([[a, b, z], [c, b, z], [c, d, z], [a, d, z]]), part


def _plate(box, holes, z):
    """Rectangles at a depth that fill a box less some holes."""
    xs = np.unique([box[0], box[2], *(v for h in holes for v in (h[0], h[2]))])
    ys = np.unique([box[1], box[3], *(v for h in holes for v in (h[1], h[3]))])
    out = []
    for (a, c), (b, d) in itertools.product(itertools.pairwise(xs), itertools.pairwise(ys)):
        x, y = (a + c) / 2, (b + d) / 2
        if not any(h[0] < x < h[2] and h[1] < y < h[3] for h in holes):
            out.append(_quad((a, b, c, d), z))
    return out


def _tube(box, near, far):
    """The sides of a box of air, seen from inside it."""
    a, b, c, d = box
    if far <= near:
        return []
    return [
        (np.array([[a, b, near], [a, b, far], [a, d, far], [a, d, near]]), 0),
        (np.array([[c, b, near], [c, d, near], [c, d, far], [c, b, far]]), 0),
        (np.array([[a, b, near], [c, b, near], [c, b, far], [a, b, far]]), 0),
        (np.array([[a, d, near], [a, d, far], [c, d, far], [c, d, near]]), 0),
    ]


def _placed(relief, quads):
    """Quads in wall coordinates as a mesh in those of the tile."""
    facades = relief.facades
    tangent = np.array([*facades.tangent[0], 0.0])
    inwards = np.array([-tangent[1], tangent[0], 0.0])
    corners = np.concatenate([q for q, _ in quads])
    vertices = facades.foot[0] + corners @ np.array([tangent, [0, 0, 1.0], inwards])
    first = 4 * np.arange(len(quads))[:, None, None]
    faces = (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    parts = np.repeat([part for _, part in quads], 2)
    return Mesh.of(
        vertices, faces, feature=int(facades.feature[0]), klass=Class.BUILDING, surface=WALL, material=parts
    )


def window():
    """One kind of opening, for cells of at least 2.5 x 3 m: a window of 1.2 x 1.5 m with a sill."""
    known = {name: np.array([m.code], np.uint8) for name, m in materials().items()}
    grey = np.array([[200, 200, 195]], np.uint8)
    one = np.ones(1)
    return Openings(
        panel=np.array([[0.5, 0.6, 2.0, 2.6]]),
        sill=np.array([[0.55, 0.8, 1.95, 0.9]]),
        opening=np.array([[0.65, 0.9, 1.85, 2.4]]),
        panel_depth=0.03 * one,
        reveal_depth=0.15 * one,
        pane_depth=0.2 * one,
        frame=0.06 * one,
        bars=np.array([[1, 1]], np.int32),
        bar=0.04 * one,
        room=4.0 * one,
        door=one < 1,
        trim=known["stone"],
        frame_material=known["wood"],
        infill=known["glass"],
        trim_color=grey,
        frame_color=grey + 20,
        infill_color=grey // 2,
        room_color=grey // 2,
    )


def with_windows(mesh):
    """Windows on all upright walls of a mesh of boxes along the axes."""
    normal, rows, wall = mesh.normals(), [], np.full(len(mesh), -1, np.int32)
    for feature in np.unique(mesh.feature[mesh.surface == WALL]):
        for way in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            mine = (mesh.feature == feature) & (normal[:, :2] @ way > 0.9)
            corners = mesh.vertices[mesh.faces[mine]].reshape(-1, 3)
            tangent = np.array([-way[1], way[0]], float)
            along = corners[:, :2] @ tangent
            low, high = corners[:, 2].min(), corners[:, 2].max()
            foot = np.array([*corners[np.argmin(along), :2], low])
            grid = [int((np.ptp(along) - 0.4) // 2.5), int((high - low - 0.4) // 3.0)]
            wall[mine] = len(rows)
            rows.append((feature, foot, tangent, (np.ptp(along), high - low), grid))
    feature, foot, tangent, size, grid = (np.array(column) for column in zip(*rows, strict=True))
    k, cells = len(rows), grid.prod(axis=1)
    facades = FacadeTable(
        feature.astype(np.int32),
        foot,
        tangent,
        size,
        start=np.full((k, 2), 0.2),
        cell=np.tile([2.5, 3.0], (k, 1)),
        ground=np.full(k, 3.0),
        grid=grid.astype(np.int32),
        first=(np.cumsum(cells) - cells).astype(np.int32),
    )
    return WallRelief(facades, np.zeros(cells.sum(), np.int32), window(), wall)
