"""Styles of layers for QGIS, in the colours of classes: the table ``layer_styles`` of GeoPackages.

QGIS opens a layer with the row of the table that is its default. A row has the style as QML.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from xml.etree import ElementTree as ET

import numpy as np

from geoscene.classes import Class, class_codes
from geoscene.scene.geopackage import Layer

TABLE = "layer_styles"
"""Name of the table, by which QGIS finds it."""

_GEOMETRY_COLUMN = "geom"
_NAME = "classes"
_CHANGED = np.datetime64("2000-01-01T00:00:00", "ms")  # constant, so that the same scene gives the same bytes


@dataclass(frozen=True, slots=True)
class _Look:
    """How a layer is drawn.

    symbol : ``fill``, ``line`` or ``marker``
    klass  : whose colour it has
    column : whose values are names of classes that have their own colours instead
    order  : column by which features are drawn, the lowest first
    """

    symbol: str
    klass: Class
    column: str = ""
    order: str = ""


_LOOKS: Mapping[str, _Look] = {
    "buildings": _Look("fill", Class.BUILDING),
    "building_parts": _Look("fill", Class.BUILDING),
    "landcover": _Look("fill", Class.TERRAIN, column="class", order="priority"),
    "road_surfaces": _Look("fill", Class.ROAD, column="class", order="priority"),
    "roads": _Look("line", Class.ROAD),
    "trees": _Look("marker", Class.TREE_CROWN),
    "furniture": _Look("marker", Class.POLE),
    "barriers": _Look("fill", Class.WALL, column="class"),
    "structures": _Look("fill", Class.BRIDGE, column="kind"),
    "wires": _Look("line", Class.WIRE),
    "passages": _Look("fill", Class.OTHER_STRUCTURE),
}

_GEOMETRIES = {"marker": "0", "line": "1", "fill": "2"}
"""Codes of geometries in QML."""


def column_of(layer: str) -> str:
    """The column of a layer by whose classes it is drawn; empty for none."""
    return _LOOKS[layer].column if layer in _LOOKS else ""


def layer_styles(values: Mapping[str, Iterable[str]]) -> Layer:
    """The rows of the table for layers.

    values : by layer, the names of classes in its column; layers without any are of one colour
    """
    names = [name for name in values if name in _LOOKS]
    texts = {
        "f_table_catalog": "",
        "f_table_schema": "",
        "f_table_name": names,
        "f_geometry_column": _GEOMETRY_COLUMN,
        "styleName": _NAME,
        "styleQML": [_qml(_LOOKS[name], values[name]) for name in names],
        "styleSLD": "",
        "description": "colours of the classes",
        "owner": "",
        "ui": "",
    }
    n = len(names)
    columns = {key: np.array(v if isinstance(v, list) else [v] * n, object) for key, v in texts.items()}
    default = {"useAsDefault": np.ones(n, bool), "update_time": np.full(n, _CHANGED)}
    return Layer(TABLE, np.full(n, None), columns | default)


def _qml(look: _Look, values: Iterable[str]) -> str:
    """The style of a layer."""
    root = ET.Element("qgis", version="3.28", styleCategories="Symbology")
    classes = sorted({Class[value.upper()] for value in values if value.upper() in Class.__members__})
    renderer = ET.SubElement(root, "renderer-v2", symbollevels="0", enableorderby=str(int(bool(look.order))))
    if classes:
        renderer.set("type", "categorizedSymbol")
        renderer.set("attr", look.column)
        categories = ET.SubElement(renderer, "categories")
        for k, klass in enumerate(classes):
            name = klass.name.lower()
            ET.SubElement(categories, "category", symbol=str(k), value=name, label=name, render="true")
    else:
        renderer.set("type", "singleSymbol")
        classes = [look.klass]
    symbols = ET.SubElement(renderer, "symbols")
    for k, klass in enumerate(classes):
        symbols.append(_symbol(look.symbol, klass, name=str(k)))
    if look.order:
        order = ET.SubElement(renderer, "orderby")
        ET.SubElement(order, "orderByClause", asc="1", nullsFirst="0").text = f'"{look.order}"'
    ET.SubElement(root, "layerGeometryType").text = _GEOMETRIES[look.symbol]
    return ET.tostring(root, encoding="unicode")


def _symbol(kind: str, klass: Class, *, name: str) -> ET.Element:
    """A symbol in the colour of a class."""
    color = ",".join(map(str, [*class_codes().color[klass].tolist(), 255]))
    drawn, settings = {
        "fill": ("SimpleFill", {"color": color, "style": "solid", "outline_style": "no"}),
        "line": ("SimpleLine", {"line_color": color, "line_width": "0.4", "line_width_unit": "MM"}),
        "marker": (
            "SimpleMarker",
            {"name": "circle", "color": color, "size": "1.6", "size_unit": "MM", "outline_style": "no"},
        ),
    }[kind]
    symbol = ET.Element("symbol", type=kind, name=name, alpha="1", clip_to_extent="1", force_rhr="0")
    layer = ET.SubElement(symbol, "layer", {"class": drawn, "enabled": "1", "locked": "0", "pass": "0"})
    options = ET.SubElement(layer, "Option", type="Map")
    for key, value in settings.items():
        ET.SubElement(options, "Option", type="QString", name=key, value=value)
    return symbol
