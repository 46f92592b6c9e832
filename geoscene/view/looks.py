"""Inferred appearance of buildings in the page: colours of faces, and windows drawn on walls."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.buildings.guesses import WINDOWS, AppearanceGuesses, guess_looks, region_at
from geoscene.classes import Class
from geoscene.export.objects import FeatureAttributes
from geoscene.geometry.mesh import ROOF, WALL, Mesh
from geoscene.scene import Scene
from geoscene.scene.tile_files import Tile
from geoscene.support.columns import Columns
from geoscene.typing import Bools, Float, Ints

GUESSED = 4
"""Bit of the column ``surface`` in a page: the face's colour is a guess."""

STEP = 0.05
"""Metres of a step of the heights of storeys and of the distances of windows."""

_COLUMNS = (
    *("feature", "osm_id", "use", "base", "height", "roof_height", "levels"),
    *("wall_source", "roof_look_source"),
)


@dataclass(frozen=True, slots=True)
class FacadeLooks(Columns):
    """Drawn windows of the walls of buildings, one row each.

    feature : (b,) int32, feature numbers
    base    : (b,) float32, z in scene metres from which storeys count
    codes   : (b, 4) uint8: index into `WINDOWS`, storeys, height of a storey and distance of windows
              in `STEP`
    """

    feature: NDArray[np.int32]
    base: NDArray[np.float32]
    codes: NDArray[np.uint8]

    @classmethod
    def none(cls) -> FacadeLooks:
        """Facades of no building."""
        return cls(np.empty(0, np.int32), np.empty(0, np.float32), np.empty((0, 4), np.uint8))


@dataclass(frozen=True, slots=True)
class Looks:
    """Appearance of a scene's buildings.

    facades : (n rows), by ascending feature number
    guesses : (n rows)
    other_roofs : (n, 3) uint8 sRGB, guessed colours of flat roofs of parts where that of the building is
                  pitched, or the other way round
    walls, roofs, storeys : (n,) bool, these of the guesses stand for what the map does not give
    region  : whose usual looks the guesses are
    """

    facades: FacadeLooks
    guesses: AppearanceGuesses
    other_roofs: NDArray[np.uint8]
    walls: Bools
    roofs: Bools
    storeys: Bools
    region: str

    def dressed(self, tile: Tile) -> Tile:
        """The tile with the faces of guessed colours marked as `GUESSED`."""
        mesh = tile.mesh
        if not len(self.facades):
            return tile
        row = np.searchsorted(self.facades.feature, mesh.feature).clip(max=len(self.facades) - 1)
        own = (self.facades.feature[row] == mesh.feature) & (mesh.klass == Class.BUILDING)
        surface = mesh.surface.copy()
        for side, guessed, colors in (
            (WALL, self.walls, (self.guesses.wall_color,)),
            (ROOF, self.roofs, (self.guesses.roof_color, self.other_roofs)),
        ):
            faces = np.flatnonzero(own & (mesh.surface == side) & guessed[row])
            alike = [(mesh.color[faces] == color[row[faces]]).all(axis=1) for color in colors]
            surface[faces[np.any(alike, axis=0)]] |= GUESSED  # parts may have mapped colours
        return replace(tile, mesh=replace(mesh, surface=surface))

    def facades_of(self, mesh: Mesh) -> FacadeLooks:
        """The facades of the buildings in a mesh."""
        return self.facades.take(np.isin(self.facades.feature, mesh.feature[mesh.klass == Class.BUILDING]))

    def told(self, features: FeatureAttributes) -> FeatureAttributes:
        """The attributes with columns of inferred values of each building; null for mapped ones."""
        if "buildings" not in features.layers:
            return features
        number = features.layers.index("buildings")
        columns = list(features.columns)
        columns[number] = {**columns[number], **self._columns()}
        return replace(features, columns=tuple(columns))

    def _columns(self) -> dict[str, NDArray[Any]]:
        guesses, drawn = self.guesses, self.guesses.windows > 0
        values = {
            "wall_look": _where(self.walls, guesses.wall),
            "roofing": _where(self.roofs, guesses.roof),
            "storeys": np.where(self.storeys, guesses.storeys, np.nan),
            "windows": _where(drawn, np.array(WINDOWS, object)[guesses.windows]),
        }
        guessed = {"wall_look": self.walls, "roofing": self.roofs, "storeys": self.storeys, "windows": drawn}
        return values | {
            f"{name}_source": _where(own, np.full(len(own), "guess", object)) for name, own in guessed.items()
        }


def read_looks(scene: Scene) -> Looks:
    """Appearance of a scene's buildings."""
    xmin, ymin, xmax, ymax = scene.bounds
    lon, lat = scene.frame.to_geographic((xmin + xmax) / 2, (ymin + ymax) / 2)
    columns: dict[str, NDArray[Any]] = dict.fromkeys(_COLUMNS, np.empty(0, object))
    footprint = np.empty(0, object)
    if scene.table_length("buildings"):
        layer = scene.features("buildings")
        order = np.argsort(layer.columns["feature"], kind="stable")
        columns, footprint = {k: layer.columns[k][order] for k in _COLUMNS}, layer.geometry[order]
    roof, levels, height = (columns[name].astype(float) for name in ("roof_height", "levels", "height"))
    walls = np.maximum(height - roof, 0.0)
    region = region_at(float(lon), float(lat))
    guesses, others = (
        guess_looks(
            columns["osm_id"],
            columns["use"],
            area=np.asarray(shapely.area(footprint), float),
            walls=walls,
            levels=levels,
            roof_height=rise,
            region=region,
        )
        for rise in (roof, np.where(roof > 0, 0.0, 1.0))
    )
    storey = np.clip(walls / guesses.storeys, 2.0, 12.0)
    codes = np.column_stack([guesses.windows, guesses.storeys, _steps(storey), _steps(guesses.bay)])
    feature, base = columns["feature"].astype(np.int32), columns["base"].astype(np.float32)
    facades = FacadeLooks(feature, base, codes.astype(np.uint8))
    walls_guessed, roofs_guessed = (
        columns[name] == "assumed" for name in ("wall_source", "roof_look_source")
    )
    return Looks(
        facades,
        guesses,
        others.roof_color,
        walls=walls_guessed,
        roofs=roofs_guessed,
        storeys=~(levels >= 0.5),
        region=region,
    )


def _where(keep: Bools, values: NDArray[np.object_]) -> NDArray[np.object_]:
    """The values (n,) where a mask is true, else None."""
    out = values.copy()
    out[~keep] = None
    return out


def _steps(metres: Float) -> Ints:
    steps: Ints = np.clip(np.rint(metres / STEP), 0, 255).astype(np.int64)
    return steps
