"""A scene as notebooks show it: a map of buildings, roads and land cover, and its figures."""

from __future__ import annotations

from collections.abc import Iterator

from geoscene.drawing.previews import PAPER, Color, PreviewPlan, card
from geoscene.scene.layout import Scene

_LAYERS: dict[str, tuple[Color, Color | None]] = {
    "landcover": ((226, 230, 216), None),
    "road_surfaces": ((196, 196, 200), None),
    "structures": ((170, 160, 160), None),
    "buildings": ((214, 150, 84), (150, 98, 48)),
}
"""Fill and outline of the layers, in the order in which they are drawn."""

_COLORS = {"water": (150, 190, 220), "grass": (200, 222, 180), "forest_floor": (160, 196, 150)}
"""Fill of land cover of some classes."""

_BLOCK, _MOST = 20_000, 200_000
"""Features that are read at once, and that a picture shows of a layer."""


def png(scene: Scene) -> bytes:
    """A PNG picture of a scene from above; of layers with very many features the first ones only."""
    plan = PreviewPlan(scene.bounds, PAPER)
    for name, (fill, edge) in _LAYERS.items():
        count = min(scene.table_length(name), _MOST)
        for first in range(0, count, _BLOCK):
            layer = scene.features(name, rows=range(first, min(first + _BLOCK, count)))
            classes = layer.columns.get("class")
            if name == "landcover" and classes is not None:
                for klass in dict.fromkeys(classes):
                    plan.polygons(layer.geometry[classes == klass], _COLORS.get(klass, fill))
            else:
                plan.polygons(layer.geometry, fill, edge=edge)
    return plan.png()


def html(scene: Scene) -> str:
    """The picture and a table of figures."""
    title = scene.manifest.get("name") or scene.path.name
    return card(f"Scene {title}", _figures(scene), picture=png(scene))


def _figures(scene: Scene) -> Iterator[tuple[str, str]]:
    """Names and values."""
    manifest = scene.manifest
    xmin, ymin, xmax, ymax = scene.bounds
    counts = manifest["counts"]
    yield "extent", f"{xmax - xmin:,.0f} m x {ymax - ymin:,.0f} m"
    west, south, east, north = manifest["geographic_bounds"]
    yield "degrees", f"{west:.5f}, {south:.5f} to {east:.5f}, {north:.5f}"
    yield "frame", f"{scene.frame.name}, heights {scene.frame.vertical}"
    yield "buildings", f"{counts['solids']:,}"
    yield "roads", f"{counts['road_km']:,.1f} km"
    yield "built for", scene.use
    yield "credit", manifest.get("attribution", "")
