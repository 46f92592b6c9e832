"""Colours and materials of walls and roofs."""

from __future__ import annotations

from dataclasses import dataclass

from geoscene.classes import Material, materials
from geoscene.sources.data import Tags
from geoscene.tags import parse_color

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
"""Values of building:material and roof:material, to names of `geoscene.classes.materials`."""


@dataclass(frozen=True, slots=True)
class Look:
    """Colour and material of a wall or a roof as tagged, None where the map does not say."""

    color: tuple[int, int, int] | None
    material: Material | None

    @property
    def tagged(self) -> bool:
        """The map gives either."""
        return self.color is not None or self.material is not None


def _first(tags: Tags, *keys: str) -> str | None:
    return next((tags[key] for key in keys if key in tags), None)


def _material(value: str | None) -> Material | None:
    name = _MATERIALS.get((value or "").split(";")[0].strip().lower().replace(" ", "_").replace("-", "_"))
    return materials()[name] if name else None


def read_walls(tags: Tags) -> Look:
    """What tags say of the walls."""
    return Look(
        parse_color(_first(tags, "building:colour", "building:color", "colour", "color")),
        _material(_first(tags, "building:material", "building:facade:material", "material")),
    )


def read_roof(tags: Tags) -> Look:
    """What tags say of the roof."""
    return Look(
        parse_color(_first(tags, "roof:colour", "roof:color", "building:roof:colour")),
        _material(_first(tags, "roof:material", "building:roof:material")),
    )


@dataclass(frozen=True, slots=True)
class Settled:
    """Colour, material code and where they come from: tag, outline or default."""

    color: tuple[int, int, int]
    material: int
    source: str


def settle_look(own: Look, outline: Look | None, *, default: str) -> Settled:
    """The look of a wall or roof; a part without its own takes its outline's, else the default material."""
    for look, source in ((own, "tag"), (outline, "outline")):
        if look is not None and look.tagged:
            material = look.material or materials()[default]
            return Settled(look.color or material.color, material.code, source)
    return Settled(materials()[default].color, materials()[default].code, "default")
