"""Bridges and tunnels as closed solids."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class, materials
from geoscene.geometry import polylines
from geoscene.geometry.mesh import FLOOR, OTHER, ROOF, WALL, Mesh, concatenate
from geoscene.structures.contact import LIP, VERGE, tunnel_roof
from geoscene.structures.fittings import Built, tunnel_fittings
from geoscene.structures.layered import SIDE, LayerTriangulation, Shell, cut_plan, raise_shell
from geoscene.structures.lining import NICHE, WALKWAY, Lining, read_lining
from geoscene.structures.table import StructureOptions, Structures, slopes_across, surface_heights
from geoscene.typing import Bools, Float, Height, Ints

_STANDING = 0.5
"""Metres that piers and abutments reach under the ground."""


def structure_meshes(
    table: Structures,
    rows: Sequence[int] | NDArray[np.integer] | None = None,
    *,
    height: Height | None = None,
    openings: NDArray[np.object_] | None = None,
    options: StructureOptions | None = None,
) -> list[Mesh]:
    """The meshes of `built_structures`."""
    solids = built_structures(table, rows, height=height, openings=openings, options=options)
    return [built.mesh for built in solids]


def built_structures(
    table: Structures,
    rows: Sequence[int] | NDArray[np.integer] | None = None,
    *,
    height: Height | None = None,
    openings: NDArray[np.object_] | None = None,
    options: StructureOptions | None = None,
) -> list[Built]:
    """One closed solid for each of the chosen rows (all by default), in scene coordinates.

    With a lining, tunnels also have closed bodies that stand or hang within them.

    Upward faces of a carriageway have the class and material of its surfaces, all others class BRIDGE or
    TUNNEL.

    height   : height of the ground under piers and over tunnels
    openings : areas without ground over tunnels, from `find_openings`
    """
    chosen = range(len(table)) if rows is None else [int(k) for k in rows]
    return [
        _solid(table, k, height=height, openings=openings, options=options or StructureOptions())
        for k in chosen
    ]


def _solid(
    table: Structures,
    k: int,
    *,
    height: Height | None,
    openings: NDArray[np.object_] | None,
    options: StructureOptions,
) -> Built:
    lining = read_lining(table, k) if options.lining and table.tunnel[k] else None
    plan = cut_plan(table.polygon[k], _linework(table, k, openings=openings, lining=lining))
    if not len(plan.faces):
        return Built(Mesh.empty(), np.empty(0, np.bool_), {})
    z = surface_heights(table, k, xy=plan.xy)
    ground = np.zeros(len(z)) if height is None else np.asarray(height(*plan.xy.T), float)
    middle = plan.middle
    rim = ~shapely.contains_xy(table.inner[k], *middle.T)
    if table.tunnel[k]:
        levels, solid = _tunnel(
            table,
            k,
            plan=plan,
            z=z,
            ground=ground,
            rim=rim,
            openings=openings,
            options=options,
            lining=lining,
        )
        floor = 1
    else:
        levels, solid = _bridge(table, k, plan=plan, z=z, ground=ground, rim=rim)
        floor = 2
    shell = raise_shell(plan, levels, solid=solid)
    body = _with_surfaces(table, k, plan=plan, shell=shell, floor=floor, rim=rim)
    plain = np.zeros(len(body), np.bool_)
    if lining is None:
        return Built(body, plain, {})
    fittings = tunnel_fittings(table, k, tube=body, driven=lining.driven, equipment=options.equipment)
    areas = {"walkways": lining.walkway, "niches": lining.niches}
    parts = {name: 0 if area.is_empty else len(shapely.get_parts(area)) for name, area in areas.items()}
    guessed = {name: count for name, count in (parts | fittings.guessed).items() if count}
    mesh = concatenate([body, fittings.mesh])
    return Built(mesh, np.concatenate([plain, fittings.equipment]), guessed)


def _bridge(
    table: Structures, k: int, *, plan: LayerTriangulation, z: Float, ground: Float, rim: Bools
) -> tuple[Float, Bools]:
    """Bridge with the levels below ground, soffit, deck, parapet; piers reach down, parapets up."""
    soffit = z - table.body[k]
    levels = np.column_stack([np.minimum(ground - _STANDING, soffit - 0.1), soffit, z, z + table.rise[k]])
    pier = shapely.contains_xy(table.pier[k], *plan.middle.T)
    return levels, np.column_stack([pier, np.ones(len(rim), np.bool_), rim])


def _tunnel(
    table: Structures,
    k: int,
    *,
    plan: LayerTriangulation,
    z: Float,
    ground: Float,
    rim: Bools,
    openings: NDArray[np.object_] | None,
    options: StructureOptions,
    lining: Lining | None,
) -> tuple[Float, Bools]:
    """Tunnel with the levels underside, floor, ceiling, roof; walls between floor and ceiling.

    With a lining the levels of walkways and of the ceilings of niches are between floor and ceiling.
    """
    ceiling = z + table.rise[k]
    opening = None if openings is None else openings[k]
    roof = tunnel_roof(plan.xy, ceiling, ground=ground, opening=opening, options=options)
    full = np.ones(len(rim), np.bool_)
    levels, solid = [z - table.body[k], z, ceiling, roof], [full, rim, full]
    if lining is not None and not shapely.is_empty(lining.niches):
        niche = shapely.contains_xy(lining.niches, *plan.middle.T)
        levels.insert(2, z + NICHE)
        solid.insert(1, rim & ~niche)
    if lining is not None and not shapely.is_empty(lining.walkway):
        walkway = shapely.contains_xy(lining.walkway, *plan.middle.T)
        levels.insert(2, z + WALKWAY)
        solid.insert(1, rim | walkway)
    return np.column_stack(levels), np.column_stack(solid)


def _linework(
    table: Structures, k: int, *, openings: NDArray[np.object_] | None, lining: Lining | None
) -> NDArray[np.object_]:
    """Lines along which the piece is triangulated: outlines of its surfaces, parapets, breaks in height."""
    lines = [
        *shapely.boundary(table.surfaces.polygon[table.tops[k]]),
        shapely.boundary(table.inner[k]),
        shapely.boundary(table.pier[k]),
    ]
    if lining is not None:
        lines += [shapely.boundary(lining.walkway), shapely.boundary(lining.niches)]
    if openings is not None and openings[k] is not None:
        lines.append(shapely.boundary(openings[k]))
        # The roof falls from its height at openings to below the ground within the verge of a road over it.
        lines.append(shapely.boundary(shapely.buffer(openings[k], VERGE - LIP, join_style="mitre")))
    sloped = slopes_across(table, k)
    for piece in (k, *table.near[k].tolist()):
        line = table.around[piece]
        flat = polylines.flat(line)
        lines.append(flat)
        if sloped:  # level up to the middle of lanes, sloping from there to the next carriageway
            lines.append(flat.buffer(float(table.half[piece]) / 2, cap_style="flat").boundary)
        lines += list(_ribs(line, float(table.half[piece]) + 1.0))
    return np.fromiter(lines, object)


def _ribs(line: Float, reach: float) -> NDArray[np.object_]:
    """Straight lines across a centre line at vertices where it bends or changes its gradient."""
    way = polylines.unit(np.diff(line[:, :2], axis=0))
    at = polylines.unit(way[:-1] + way[1:])
    across = np.column_stack([-at[:, 1], at[:, 0]]) * reach
    ribs: NDArray[np.object_] = shapely.linestrings(
        np.stack([line[1:-1, :2] - across, line[1:-1, :2] + across], axis=1)
    )
    return np.atleast_1d(ribs)


def _with_surfaces(
    table: Structures, k: int, *, plan: LayerTriangulation, shell: Shell, floor: int, rim: Bools
) -> Mesh:
    """The shell as a mesh with the classes of its surfaces."""
    concrete = materials()["concrete"]
    body = Class.TUNNEL if table.tunnel[k] else Class.BRIDGE
    klass = np.full(len(shell.faces), body, np.uint8)
    material = np.full(len(shell.faces), concrete.code, np.uint8)
    on_top = shell.up & (shell.level == floor)
    row = _top_rows(table, k, xy=plan.middle)[shell.triangle]
    dressed = on_top & (row >= 0) & ~rim[shell.triangle]
    klass[dressed] = table.surfaces.klass[row[dressed]]
    material[dressed] = table.surfaces.material[row[dressed]]
    color = np.zeros((256, 3), np.uint8)
    for entry in materials().values():
        color[entry.code] = entry.color
    surface = np.where(shell.level == SIDE, WALL, np.where(shell.up, np.where(on_top, OTHER, ROOF), FLOOR))
    mesh = Mesh.of(
        shell.vertices,
        shell.faces,
        feature=int(table.feature[k]),
        klass=klass,
        material=material,
        surface=surface,
        color=color[material],
        closed=True,
    )
    return mesh.take(np.ones(len(mesh), np.bool_))


def _top_rows(table: Structures, k: int, *, xy: Float) -> Ints:
    """Row (n,) of the topmost surface at points (n, 2), -1 without any."""
    tops = table.tops[k]
    tops = tops[np.lexsort([-tops, table.surfaces.priority[tops]])]
    row = np.full(len(xy), -1, np.int64)
    for top in tops.tolist():
        row[shapely.contains_xy(table.surfaces.polygon[top], *xy.T)] = top
    return row
