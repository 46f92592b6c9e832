"""Bridges and tunnels read from a map."""

from __future__ import annotations

from typing import Any

from geoscene.geometry.frames import Frame
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.surface_rows import in_reach
from geoscene.roadgraph.surfaces import RoadSurfaces
from geoscene.sources.data import OsmData
from geoscene.structures.ground_contact import find_low_decks
from geoscene.structures.members import Members, road_members
from geoscene.structures.paths import path_members
from geoscene.structures.pieces import NEAR, cut_pieces
from geoscene.structures.piers import place_piers
from geoscene.structures.table import StructureOptions, Structures
from geoscene.support.problems import Problem
from geoscene.typing import Height


def read_structures(
    surfaces: RoadSurfaces,
    graph: RoadGraph,
    *,
    osm: OsmData,
    frame: Frame,
    height: Height | None = None,
    options: StructureOptions | None = None,
    area: Any | None = None,
) -> tuple[Structures, list[Problem]]:
    """The bridges and tunnels of a map, and the problems repaired or dropped.

    graph  : with heights, from `geoscene.roadgraph.profile`
    height : height of the graded ground (`geoscene.roadgraph.graded_ground`); level at 0 by default
    area   : shapely geometry, scene metres: pieces far from it have no piers, no low ground and no area
             within their parapets; all have by default
    """
    options = options or StructureOptions()
    raised = surfaces.raised
    paths, problems = path_members(raised, osm, frame=frame, graph=graph, height=height, options=options)
    members = Members.concatenate([road_members(graph, raised), paths])
    table = cut_pieces(members, raised, options=options, area=area)
    near = in_reach(table.polygon, area, metres=NEAR)
    table = place_piers(table, surfaces, height=height, near=near, options=options)
    return find_low_decks(table, height, near=near), problems
