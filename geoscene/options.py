"""Options of the commands of `geoscene`, with their defaults and help texts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from cyclopts import Parameter

from geoscene.errors import InputError
from geoscene.support.console import SEVERAL, WORDS, degrees, whole
from geoscene.support.option_values import check_words, take_values
from geoscene.uses import MESH, RELIEFS, USES

KINDS = ("buildings", "roads", "landcover", "trees", "furniture", "barriers")
"""Kinds of features that a scene can have besides its ground."""

_ROOFS = ("guess", "flat")
"""What roofs of unknown shape are."""

Degrees = tuple[float, float, float, float]


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class BuildOptions:
    """Options that determine the bytes of a scene; recorded in ``scene.json``."""

    crs: str = "local"
    """CRS of the scene: local (transverse Mercator with scale 1 at the centre), utm, or an EPSG code such as
    EPSG:32618."""

    lod: Annotated[int, Parameter(converter=whole)] = 2
    """Level of detail of buildings: 0 blocks, 1 parts with flat roofs, 2 roofs."""

    roofs: str = "guess"
    """Roofs of buildings whose roof shape the map does not give: guess (gabled, hipped or flat, by
    region, use, size and neighbours; marked as assumed), or flat."""

    relief: str = "plain"
    """Relief of surfaces: off (walls, roads and tunnels are smooth); plain (windows and doors are set back,
    kerbs drop at crossings, tunnels are lined, surfaces are rough); full (also small parts: balconies,
    cornices, chimneys, dormers, branches, bins). What the map does not hold is guessed and marked so."""

    dem: Annotated[tuple[str, ...], SEVERAL] = ()
    """Elevation files (GeoTIFF, .hgt or .hgt.zip) in any CRS; or the word tiles: public elevation tiles with
    5 to 10 m between heights (needs a network; tiles are cached). By default the ground is level."""

    dem_gaps: str = "error"
    """If elevation files do not cover the scene: error, or nearest (use the nearest height and report it)."""

    dem_tolerance: float | None = None
    """Metres by which bare ground (no building, road or land cover on it) may differ from the elevation grid;
    more gives fewer triangles. By default 1 % of the grid's spacing; 0 keeps all heights. With --dem."""

    only: Annotated[tuple[str, ...], WORDS] = KINDS
    """Kinds of features to build besides the ground, separated by commas."""

    use: Annotated[str, Parameter(name="--for")] = "all"
    """What the scene is for: all; lidar or camera (to be driven in by such sensors, not shown or
    exported); gis (all tables and the road graph, no meshes), or map (the same in plan, without building
    parts and bridges)."""

    along: Annotated[tuple[str, ...], SEVERAL] = ()
    """Build only the tiles within sensor range of a route: LAT,LON LAT,LON ... or a GPX, GeoJSON or CSV file
    (such as the poses.csv of a dataset)."""

    reach: float = 120.0
    """Maximum range of the sensors in metres, with --along."""

    driving_side: str = ""
    """Side of the road that traffic drives on: left or right. By default from the map's tags, else from the
    country."""

    tile_size: float = 250.0
    """Side of a tile in metres."""

    name: str = ""
    """Title of the scene."""

    @property
    def elevation_tiles(self) -> bool:
        """Whether heights are those of public tiles, which are fetched first."""
        return self.dem == ("tiles",)

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)
        if self.lod not in (0, 1, 2):
            raise InputError(f"`lod` {self.lod}: give 0 (blocks), 1 (parts, flat roofs) or 2 (roofs)")
        check_words(
            self,
            error=InputError,
            relief=RELIEFS,
            roofs=_ROOFS,
            dem_gaps=("error", "nearest"),
            only=KINDS,
            use=USES,
            driving_side=("", "left", "right"),
        )
        if self.dem_tolerance is not None and not 0 <= self.dem_tolerance <= 1000:
            raise InputError(f"`dem_tolerance` {self.dem_tolerance:g}: give metres from 0 to 1000")
        if self.dem_tolerance is not None and not self.dem:
            raise InputError("`dem_tolerance`: has no effect without `dem`; leave it out")
        if not 0 < self.reach < 1e6:
            raise InputError(f"`reach` {self.reach:g}: give metres, more than 0 and less than a million")
        if not 50 <= self.tile_size <= 2000 or self.tile_size != int(self.tile_size):
            raise InputError(f"`tile_size` {self.tile_size}: give whole metres from 50 to 2000")


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class CloudOptions:
    """Point clouds in which the ground, buildings and trees of a map are measured."""

    cloud: Annotated[tuple[str, ...], SEVERAL] = ()
    """Point clouds (.las, .laz, .copc.laz, .ply), airborne or mobile: heights of the ground, heights and
    roofs of buildings, and trees are measured in them. --dem fills the ground beyond."""

    cloud_crs: str = ""
    """CRS of the point clouds, such as EPSG:32618; by default the one that the files state."""

    cloud_unit: str = ""
    """Unit of the point clouds' heights: m, ft or us-ft; by default that of their vertical CRS, or metres
    where the horizontal CRS is in metres."""

    cloud_align: bool = False
    """Move the point clouds by the horizontal shift between their buildings and those of the map; it is
    reported in any case."""

    prefer: str = "cloud"
    """Which heights and roofs of buildings are used where both are known: cloud, or tags."""

    cloud_licence: str = ""
    """Licence of the point clouds, for the scene's list of sources; unknown by default."""

    cloud_attribution: str = ""
    """Attribution of the point clouds, which the scene, its pages and exports show."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)
        check_words(self, error=InputError, prefer=("cloud", "tags"))
        given = [name for name in _OF_CLOUDS if getattr(self, name)]
        if given and not self.cloud:
            raise InputError(f"`{given[0]}`: has no effect without `cloud`; leave it out")


_OF_CLOUDS = ("cloud_crs", "cloud_unit", "cloud_align", "cloud_licence", "cloud_attribution")


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class BuildTradeoffOptions:
    """Options of a comparison of builds."""

    settings: Annotated[tuple[str, ...], WORDS] = ()
    """Settings to compare, separated by commas: lod, relief, only, terrain (with --dem), for; all by
    default."""

    resolution: float = 1.0
    """Cell size in metres of the surface models that are compared; enlarged where there would be more than 16
    million cells."""

    repetitions: Annotated[int, Parameter(converter=whole)] = 1
    """Builds of each setting, in turn: 1 to 20."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)
        if not 0.1 <= self.resolution <= 100:
            raise InputError(f"`resolution` {self.resolution:g}: give 0.1 to 100 metres")
        if not 1 <= self.repetitions <= 20:
            raise InputError(f"`repetitions` {self.repetitions}: give 1 to 20")


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class ViewOptions:
    """Options of the web page of a scene."""

    bounds_deg: Annotated[Degrees | None, Parameter(name="--bbox"), degrees("W,S,E,N")] = None
    """W,S,E,N in degrees: only tiles that intersect this box, uncut."""

    layers: Annotated[tuple[str, ...], WORDS] = ()
    """Layers to show, separated by commas, such as ground,buildings,trees; all by default."""

    max_mb: Annotated[float, Parameter(name="--max-size")] = 40.0
    """Maximum size in megabytes of a page in a file; for a larger one, the error gives a --bbox that fits."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)
        if not self.max_mb > 0:
            raise InputError(f"`max_mb` {self.max_mb:g}: give megabytes above 0")


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class ExportOptions:
    """Options of an export; each format takes some of them, see `geoscene.export.KINDS`."""

    kind: Annotated[str | None, Parameter(name="--to")] = None
    """Format: cityjson, glb, 3dtiles, obj, ply, stl, gpkg, geojson, geoparquet, geotiff, opendrive or sumo;
    by default from the suffix of the file."""

    crs: str | None = None
    """CRS of CityJSON, GeoPackage and GeoParquet: an EPSG code; by default that of the scene (CityJSON: the
    UTM zone, if the CRS of the scene has no EPSG code)."""

    layers: Annotated[tuple[str, ...] | None, WORDS] = None
    """Layers to write, separated by commas; all by default. terrain is the bare ground; building_solids, in
    GeoPackage, the table of the volumes of buildings."""

    model: str | None = None
    """GeoTIFF: surface (the default), terrain or classes."""

    resolution: float | None = None
    """GeoTIFF: cell size in metres, 0.5 by default."""

    relief: str | None = None
    """mesh: model windows, doors and other openings of walls as geometry, for a scene built with relief;
    by default walls are planes."""

    roofs: str | None = None
    """Roofs of buildings whose shape the build guessed: guess, or flat (blocks of the mapped height with
    plane walls); by default flat for CityJSON, GeoPackage, GeoJSON, GeoParquet and GeoTIFF, else guess."""

    height_offset: float | None = None
    """3D Tiles: metres added to all heights, such as the geoid height to make them ellipsoidal."""

    size_limit: float | None = None
    """OBJ: largest file in MB, 500 by default; a larger one is refused before it is written."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)
        if self.size_limit is not None and not self.size_limit > 0:
            raise InputError(f"`size_limit` {self.size_limit:g}: give megabytes above 0")
        check_words(self, error=InputError, roofs=_ROOFS, relief=(MESH,))
