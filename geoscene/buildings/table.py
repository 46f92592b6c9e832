"""The table of buildings and their parts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.support.columns import Columns
from geoscene.typing import Bools, Float

Texts = NDArray[np.object_]

GRID = 1e-4
"""Grid of all vertices, metres; solids stay closed in file formats that round to 0.1 mm."""

SHAPES = (
    "flat", "gabled", "hipped", "half-hipped", "pyramidal", "skillion", "gambrel", "mansard", "round", "dome",
    "onion", "saltbox", "cone",
)  # fmt: skip
"""Supported roof shapes; others become flat and are reported."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BuildingOptions:
    """Options of reading buildings from tags.

    level_height  : metres per storey where only storeys are tagged
    min_area      : square metres; smaller buildings are dropped (parts: a hundredth of it)
    strip         : metres; uncovered pieces of an outline with parts are left out where they are narrower
    reach         : metres within which known heights are used to infer a missing one
    canopy        : metres, thickness of roofs without walls (``building=roof``)
    guess_roofs   : whether roofs without a tagged shape are guessed (`geoscene.buildings.roof_guesses`)
    """

    level_height: float = 3.0
    min_area: float = 0.5
    strip: float = 1.0
    reach: float = 400.0
    canopy: float = 0.4
    guess_roofs: bool = False


@dataclass(frozen=True, slots=True)
class Buildings(Columns):
    """One row per building, then one per part; a building's row is its feature number in the layer.

    osm_id           : (n,) str
    footprint        : (n,) valid shapely Polygon or MultiPolygon on the 0.1 mm grid, scene metres, exteriors
                       counter-clockwise, overlaps with other buildings removed
    passages         : (n,) tuple of pairs: a polygon, and the metres above the building's base up to which
                       it is cut out of the body with all its parts; empty for parts
    is_part          : (n,) bool
    outline          : (n,) int32, row of the building that a part belongs to; a building's own row
    min_height       : (n,) metres from the building's base to the underside
    height           : (n,) metres from the building's base to the top of the roof
    roof_height      : (n,) metres, the part of height that is roof; 0 if flat
    roof_shape       : (n,) str, one of SHAPES
    roof_direction   : (n,) downslope direction of the roof's face, radians counter-clockwise from x, NaN if
                       not tagged
    roof_across      : (n,) bool, whether the ridge runs across the longer side
    top              : (n,) z in metres of the top where a point cloud gave it, NaN elsewhere; ``height`` is
                       then the top less the base (`geoscene.buildings.resolve`)
    height_source    : (n,) str: cloud, tag, est_height, levels, parts, outline, or inferred-<rule>
    height_sigma     : (n,) metres, one standard deviation of height
    min_height_source: (n,) str: tag, levels, canopy, or default (0)
    roof_source      : (n,) str, source of roof_height: cloud, tag, levels, angle, default; assumed if the
                       shape is not known, guessed or flat
    levels           : (n,) storeys above ground as tagged, NaN if not
    use              : (n,) str, the value of building or building:part
    name             : (n,) str
    wall_color       : (n, 3) uint8 sRGB
    roof_color       : (n, 3) uint8 sRGB
    wall_material    : (n,) uint8, codes of `geoscene.classes.materials`
    roof_material    : (n,) uint8
    wall_source      : (n,) str: tag, outline, assumed (guessed) or default
    roof_look_source : (n,) str: tag, outline, assumed (guessed) or default
    """

    osm_id: Texts
    footprint: NDArray[Any]
    passages: NDArray[Any]
    is_part: Bools
    outline: NDArray[np.int32]
    min_height: Float
    height: Float
    roof_height: Float
    roof_shape: Texts
    roof_direction: Float
    roof_across: Bools
    top: Float
    height_source: Texts
    height_sigma: Float
    min_height_source: Texts
    roof_source: Texts
    levels: Float
    use: Texts
    name: Texts
    wall_color: NDArray[np.uint8]
    roof_color: NDArray[np.uint8]
    wall_material: NDArray[np.uint8]
    roof_material: NDArray[np.uint8]
    wall_source: Texts
    roof_look_source: Texts

    @property
    def count(self) -> int:
        """Number of buildings; parts are the rows from there on."""
        return int(np.count_nonzero(~self.is_part))

    @property
    def drawn(self) -> Bools:
        """(n,) bool, whether the row is built as a solid; false for an outline that its parts replace."""
        replaced = np.zeros(len(self), np.bool_)
        replaced[self.outline[self.is_part]] = True
        return ~replaced
