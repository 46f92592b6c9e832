"""Colours and materials of walls and roofs, from tags or by default."""

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
"""Name in `geoscene.classes.materials` of each value of building:material and roof:material."""

_FACES = ("building:facade:{}", "building:cladding:{}", "building:{}", "{}")
"""Keys of what walls show, from that of the face to that of the whole building."""


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
        parse_color(_first(tags, *colors)),
        _material(_first(tags, "building:cladding", *substances)),
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
