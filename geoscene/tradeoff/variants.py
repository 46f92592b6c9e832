"""Settings of a build that are compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from geoscene.errors import InputError
from geoscene.options import KINDS, BuildOptions
from geoscene.support.registry import unknown_name
from geoscene.uses import RELIEFS, USES

SETTINGS = ("lod", "relief", "only", "terrain", "for")
"""Names of the settings that are compared."""

FULL = "full scene"
"""Label of the reference."""

_KINDS = {
    "only=buildings": ("buildings",),
    "only=buildings,roads": ("buildings", "roads"),
    "without trees": tuple(kind for kind in KINDS if kind != "trees"),
    "without furniture, barriers": tuple(kind for kind in KINDS if kind not in ("furniture", "barriers")),
    "without landcover": tuple(kind for kind in KINDS if kind != "landcover"),
}
_COARSER = (2, 4, 8)
"""Posts of the elevation model along each side of which one is made."""


@dataclass(frozen=True, slots=True)
class BuildVariant:
    """A build with a setting changed.

    coarser : posts of the elevation files along each side of which one is made; 1 for the files as they are
    """

    label: str
    options: BuildOptions
    coarser: int = 1


def full(options: BuildOptions) -> BuildVariant:
    """The reference: everything, at the highest level of detail, with the relief of the options."""
    return BuildVariant(FULL, replace(options, lod=2, only=KINDS, use="all"))


def variants(options: BuildOptions, settings: Sequence[str]) -> list[BuildVariant]:
    """Builds to compare with the full scene, one setting changed in each, and a combination of cheap ones.

    Raises InputError for unknown settings, ``terrain`` without elevation files, and options that are
    compared.
    """
    if unknown := sorted(set(settings) - set(SETTINGS)):
        raise InputError(unknown_name("`settings`", unknown[0], known=SETTINGS))
    if "terrain" in settings and not options.dem:
        raise InputError("`settings` terrain: needs `dem`")
    if options.lod != 2 or set(options.only) != set(KINDS) or options.use != "all":
        raise InputError("`lod`, `only` and `use` are compared, all values of them; leave them out")
    chosen, base = settings or SETTINGS, full(options).options
    found: list[BuildVariant] = []
    if "lod" in chosen:
        found += [BuildVariant(f"lod={lod}", replace(base, lod=lod)) for lod in (1, 0)]
    if "relief" in chosen:
        others = (relief for relief in RELIEFS if relief != base.relief)
        found += [BuildVariant(f"relief={relief}", replace(base, relief=relief)) for relief in others]
    if "only" in chosen:
        found += [BuildVariant(label, replace(base, only=kinds)) for label, kinds in _KINDS.items()]
    if "terrain" in chosen and base.dem:
        found += [BuildVariant(f"terrain={n} x {n} posts", base, coarser=n) for n in _COARSER]
        found.append(BuildVariant("terrain=level", replace(base, dem=(), dem_tolerance=None)))
    if "for" in chosen:
        found += [BuildVariant(f"for={use}", replace(base, use=use)) for use in USES if use != "all"]
    if {"lod", "only"} <= set(chosen):
        cheap = replace(base, lod=0, only=("buildings",))
        found.append(BuildVariant("lod=0 only=buildings", cheap))
    return found


def coarse_elevation(path: Path, out: Path, *, factor: int) -> Path:
    """An elevation file of which each post is the mean of ``factor`` by ``factor`` posts of another."""
    import rasterio  # noqa: PLC0415 - slow to import
    from rasterio.enums import Resampling  # noqa: PLC0415

    from geoscene.ground.terrain import gdal_name  # noqa: PLC0415

    with rasterio.open(gdal_name(path)) as source:
        rows, columns = (max(side // factor, 2) for side in source.shape)
        values = source.read(1, out_shape=(rows, columns), resampling=Resampling.average, masked=True)
        a, across, down = source.transform, source.width / columns, source.height / rows
        profile = {
            **{name: source.profile[name] for name in ("dtype", "crs", "nodata")},
            "driver": "GTiff",
            "count": 1,
            "width": columns,
            "height": rows,
            "transform": rasterio.Affine(a.a * across, a.b * down, a.c, a.d * across, a.e * down, a.f),
        }
        with rasterio.open(out, "w", **profile) as target:
            target.write(values.filled(source.nodata if source.nodata is not None else 0), 1)
            target.units, target.scales, target.offsets = source.units, source.scales, source.offsets
            tags = source.tags()
            tags.pop("AREA_OR_POINT", None)  # the transform is that of areas
            target.update_tags(**tags)
    return out
