"""Colours, materials and roof shapes of buildings from tags."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from geoscene.buildings.table import SHAPES
from geoscene.classes import Material, materials
from geoscene.sources.data import Tags
from geoscene.tags import Quantities, first_value, parse_color, parse_direction, parse_number

_MATERIALS: dict[str, str] = {
    "brick": "brick", "bricks": "brick", "clinker": "brick", "cement_block": "concrete",
    "plaster": "plaster", "stucco": "plaster", "render": "plaster", "rendered": "plaster", "adobe": "plaster",
    "clay": "plaster", "mud": "plaster", "loam": "plaster", "timber_framing": "plaster", "vinyl": "plaster",
    "concrete": "concrete", "reinforced_concrete": "concrete", "cement": "concrete", "eternit": "concrete",
    "stone": "stone", "sandstone": "stone", "limestone": "stone", "granite": "stone", "marble": "stone",
    "masonry": "stone", "rock": "stone", "gravel": "gravel", "gravestone": "stone",
    "glass": "glass", "mirror": "glass", "acrylic_glass": "glass", "plexiglass": "glass",
    "solar_panels": "glass", "metal": "metal", "metal_plates": "metal", "steel": "metal",
    "corrugated_metal": "metal", "tin": "metal", "sheet_metal": "metal",
    "zinc": "metal", "aluminium": "metal",
    "copper": "copper", "bronze": "copper", "wood": "wood", "timber": "wood", "bamboo": "wood",
    "roof_tiles": "roof_tile", "tile": "roof_tile", "tiles": "roof_tile", "roof_tile": "roof_tile",
    "slate": "slate", "tar_paper": "tar_roof", "tar": "tar_roof", "asphalt": "tar_roof",
    "bitumen": "tar_roof", "asphalt_shingle": "tar_roof", "shingle": "tar_roof", "shingles": "tar_roof",
    "rubber": "tar_roof", "membrane": "tar_roof", "plants": "grass", "grass": "grass", "green": "grass",
    "thatch": "dry_grass", "straw": "dry_grass", "sand": "sand",
}  # fmt: skip
"""Name in `geoscene.classes.materials` of each value of building:material and roof:material."""

_FACES = ("building:facade:{}", "building:cladding:{}", "building:{}", "{}")
"""Keys of what walls show, from that of the face to that of the whole building."""

_OTHER_NAMES = {
    "pitched": "gabled", "gable": "gabled", "hip": "hipped", "half_hipped": "half-hipped",
    "lean_to": "skillion",
    "shed": "skillion", "pyramid": "pyramidal", "conical": "cone", "monopitch": "skillion",
    "spherical": "dome",
    "barrel": "round", "vaulted": "round", "rounded": "round", "no": "flat", "yes": "flat",
}  # fmt: skip

PITCH_DEG = 30.0
"""Assumed pitch of a roof without a tagged height."""

STEEPEST_DEG = 80.0
"""Greater roof angles are treated as typing errors, degrees; assumed, for slender spires."""

_STEEP = ("dome", "onion", "cone", "pyramidal")
"""Shapes that are often as high as the walls below them; others are at most half as high."""


@dataclass(frozen=True, slots=True)
class Appearance:
    """Colour and material of walls or a roof as tagged; None if not tagged."""

    color: tuple[int, int, int] | None
    material: Material | None

    @property
    def tagged(self) -> bool:
        """Whether the colour or the material is tagged."""
        return self.color is not None or self.material is not None


def _first(tags: Tags, *keys: str) -> str | None:
    return next((tags[key] for key in keys if key in tags), None)


def _material(value: str | None) -> Material | None:
    name = _MATERIALS.get((value or "").split(";")[0].strip().lower().replace(" ", "_").replace("-", "_"))
    return materials()[name] if name else None


def read_walls(tags: Tags) -> Appearance:
    """Tagged colour and material of the walls: of the facade, else of the building's material."""
    colors = [key.format(word) for key in _FACES for word in ("colour", "color")]
    substances = [key.format("material") for key in _FACES]
    return Appearance(
        parse_color(_first(tags, *colors)), _material(_first(tags, "building:cladding", *substances))
    )


def read_roof(tags: Tags) -> Appearance:
    """The tagged colour and material of the roof."""
    return Appearance(
        parse_color(_first(tags, "roof:colour", "roof:color", "building:roof:colour")),
        _material(_first(tags, "roof:material", "building:roof:material")),
    )


@dataclass(frozen=True, slots=True)
class ChosenAppearance:
    """Colour, material code and their source: tag, outline or default."""

    color: tuple[int, int, int]
    material: int
    source: str


def choose_appearance(own: Appearance, outline: Appearance | None, *, default: str) -> ChosenAppearance:
    """The appearance of walls or a roof: its own tags, else its outline's, else the default material."""
    for appearance, source in ((own, "tag"), (outline, "outline")):
        if appearance is not None and appearance.tagged:
            material = appearance.material or materials()[default]
            return ChosenAppearance(appearance.color or material.color, material.code, source)
    return ChosenAppearance(materials()[default].color, materials()[default].code, "default")


@dataclass(frozen=True, slots=True)
class RoofTags:
    """Roof tags of a building or part.

    shape         : one of SHAPES
    unknown       : the value of roof:shape if it is not one of them, else ""
    assumed       : the shape is not tagged, or unknown: flat
    direction_deg : downslope azimuth of the face, clockwise from true north; NaN if not tagged
    across        : roof:orientation=across
    angle_deg     : pitch, NaN if not tagged
    ignored       : tags whose values cannot be used, with the reasons
    height        : metres, guessed with the shape; NaN for none
    """

    shape: str
    unknown: str
    assumed: bool
    direction_deg: float
    across: bool
    angle_deg: float
    ignored: tuple[str, ...]
    height: float = np.nan


def read_roof_tags(tags: Tags) -> RoofTags:
    """The tagged roof; flat if nothing is tagged. Of several shapes ("gabled;hipped") the first counts."""
    tagged = tags.get("roof:shape") or tags.get("building:roof:shape", "")
    value = first_value(tagged or "flat")
    shape = _OTHER_NAMES.get(value, value.replace("_", "-"))
    unknown = "" if shape in SHAPES else value or tagged
    read = Quantities(tags)
    return RoofTags(
        "flat" if unknown else shape,
        unknown,
        not tagged or bool(unknown),
        read.first("roof:direction", "roof:slope:direction", parse=parse_direction),
        tags.get("roof:orientation") == "across",
        read.first("roof:angle", parse=_parse_angle, low=0.1, high=STEEPEST_DEG),
        tuple(read.refused),
    )


def _parse_angle(text: str) -> float | None:
    return parse_number(text.rstrip("° "))


def default_roof_height(
    roof: RoofTags, footprint: Any, *, walls: float = np.inf, storey: float = 0.0
) -> tuple[float, str]:
    """Height of a roof in metres from its angle, else a usual pitch; its source, ``angle`` or ``default``.

    The run is the radius of the largest circle in the footprint (its diameter for a skillion roof). A dome or
    onion without height is as high as the run (onion: 1.5 runs), curved and broken shapes have 45
    degrees, others 30, a skillion roof 10. Such a guess is at most 8 m (not domes and onions), and at most
    half as high as the walls (domes, onions, cones and pyramids: as high), but may always have one storey. A
    roof with a tagged angle is at most three times as high as walls of two storeys or more.

    walls  : metres, height of the walls where known by their storeys
    storey : metres, height of one storey
    """
    # GEOS returns the circle as a line from its centre to its rim
    run = float(shapely.length(shapely.maximum_inscribed_circle(footprint, tolerance=0.05)))
    if roof.shape == "skillion":
        run *= 2.0
    if np.isfinite(roof.angle_deg):
        return min(float(run * np.tan(np.radians(roof.angle_deg))), 3.0 * max(walls, 2.0 * storey)), "angle"
    most = max(storey, walls * (1.0 if roof.shape in _STEEP else 0.5))
    if roof.shape in ("dome", "onion"):
        return min(run * (1.5 if roof.shape == "onion" else 1.0), most), "default"
    pitch = 45.0 if roof.shape in ("round", "gambrel", "mansard", "cone", "pyramidal") else PITCH_DEG
    if roof.shape == "skillion":
        pitch = 10.0
    return min(float(run * np.tan(np.radians(pitch))), 8.0, most), "default"
