"""The drivable road graph: built from a map, written and read as GraphML, with heights and surfaces."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geoscene.support.registry import lazily

if TYPE_CHECKING:
    from geoscene.roadgraph.build import RoadOptions as RoadOptions
    from geoscene.roadgraph.build import build_road_graph as build_road_graph
    from geoscene.roadgraph.grading import find_obstacles as find_obstacles
    from geoscene.roadgraph.grading import graded_ground as graded_ground
    from geoscene.roadgraph.graph import RoadGraph as RoadGraph
    from geoscene.roadgraph.graph import find_components as find_components
    from geoscene.roadgraph.graph import main_network as main_network
    from geoscene.roadgraph.graphml import read_graphml as read_graphml
    from geoscene.roadgraph.graphml import write_graphml as write_graphml
    from geoscene.roadgraph.longitudinal_profile import ProfileOptions as ProfileOptions
    from geoscene.roadgraph.longitudinal_profile import profile as profile
    from geoscene.roadgraph.longitudinal_profile import take_heights as take_heights

__getattr__ = lazily(
    __name__,
    {
        "ProfileOptions": "longitudinal_profile",
        "RoadGraph": "graph",
        "RoadOptions": "build",
        "build_road_graph": "build",
        "find_components": "graph",
        "find_obstacles": "grading",
        "graded_ground": "grading",
        "main_network": "graph",
        "profile": "longitudinal_profile",
        "read_graphml": "graphml",
        "take_heights": "longitudinal_profile",
        "write_graphml": "graphml",
    },
)
