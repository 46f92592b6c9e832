"""Radiance of each pixel: materials under sun and sky, windows, haze. Compiled, per pixel."""

# mypy: disallow-untyped-decorators=False
from __future__ import annotations

import functools
import math
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class, materials
from geoscene.support.compiled import njit
from geoscene.typing import Float
from lidar.sensors.camera import ground_texture, texture
from lidar.sensors.camera.facades import ASIDE, BEHIND, GLASS, LIGHT, SEEN, RenderedFacades, facade
from lidar.sensors.camera.facades import PAINTED as PAINTED_PARTS
from lidar.sensors.camera.facades import UPRIGHT as UPRIGHT_SIDES
from lidar.sensors.camera.ground_texture import HIGHEST, LOWEST, PAVED, ground
from lidar.sensors.camera.sky import background, sky_radiance
from lidar.sensors.camera.texture import compiled, detail, grain, hash_place, inlined, noise
from lidar.sensors.camera.texture_blocks import BLOCK, DETAIL, PAINTED, PLACES, UPRIGHT, factors
from lidar.sensors.camera.texture_blocks import scratch as block_scratch

Single = NDArray[np.float32]

_BUILDING, _MARKING = int(Class.BUILDING), int(Class.LANE_MARKING)
_ASPHALT = ground_texture.ASPHALT

_KINDS = {
    texture.SPECKLED: ("asphalt", "asphalt_fresh", "gravel", "soil", "dirt", "sand", "ballast", "tar_roof"),
    texture.SLABS: ("paving", "concrete"),
    texture.BRICK: ("brick",),
    texture.WEATHERED: ("plaster", "stone", "copper", "bark", "wood"),
    texture.LEAFY: ("grass", "dry_grass", "foliage", "conifer"),
    texture.LIQUID: ("water",),
    texture.SHINGLED: ("roof_tile", "slate"),
}
# Specular reflectance at normal incidence: Fresnel for n = 1.33 and 1.5 (two panes for a window), aluminium.
_MIRROR = {"water": 0.02, "glass": 0.08, "car_paint": 0.04, "metal": 0.15, "rail_steel": 0.3}


@functools.cache
def material_tables() -> tuple[NDArray[np.uint8], NDArray[np.uint8], Float, NDArray[np.uint8], Float]:
    """Kind of detail, kind of ground, specular reflectance at normal incidence, colour, factor when soaked.

    All are by material code, (256,) or (256, 3); the last is a factor of the albedo.
    """
    kind, mirror, plain = np.zeros(256, np.uint8), np.zeros(256), np.zeros((256, 3), np.uint8)
    soaked, floor = np.ones(256), np.zeros(256, np.uint8)
    kinds = {name: kind for kind, names in _KINDS.items() for name in names}
    floors = {name: kind for kind, names in ground_texture.MATERIALS.items() for name in names}
    for name, material in materials().items():
        kind[material.code] = kinds.get(name, texture.PLAIN)
        floor[material.code] = floors.get(name, ground_texture.BARE)
        mirror[material.code] = _MIRROR.get(name, 0.0)
        plain[material.code] = material.color
        soaked[material.code] = material.wet
    return kind, floor, mirror, plain, soaked


@functools.cache
def linear_table() -> Float:
    """Linear light 0..1 of sRGB bytes (256,); IEC 61966-2-1."""
    s = np.arange(256) / 255
    return np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)


def srgb_bytes(light: Float) -> NDArray[np.uint8]:
    """Bytes of sRGB of linear light 0..1, of any shape; other values are clipped."""
    c = np.clip(light, 0, 1)
    coded = np.where(c <= 0.0031308, 12.92 * c, 1.055 * c ** (1 / 2.4) - 0.055)
    rounded: NDArray[np.uint8] = np.rint(255 * coded).astype(np.uint8)
    return rounded


_LEVEL = 0.7
"""Least vertical part of the normal of ground that is textured as such; steeper ground has other detail."""

TOWN = 0.6
"""Radiance of what mirrors show below the sky, the lit surroundings, as a share of that of the horizon."""

_SNOW = np.array([0.80, 0.83, 0.87])
"""Albedo of snow, red, green and blue; 0.75 to 0.9 when fresh, typical value."""

_PUDDLES = 0.35
"""Share of level ground under puddles where wetness is 1, typical; none up to a wetness of 0.5."""

_DEVIATION = 0.32
"""Standard deviation of the bumps and hollows of the ground, whose heights are about normal."""


def covers(wetness: float, snow: float) -> tuple[float, float, float, float]:
    """Wetness, height of hollows that are not under puddles, snow, height of bumps that are under snow.

    wetness, snow : as in `lidar.world.settings.WorldSettings`
    """
    return wetness, _level(_PUDDLES * (2 * wetness - 1)), snow, _level(snow)


def _level(share: float) -> float:
    """Height that a share of bumps exceeds."""
    return _DEVIATION * NormalDist().inv_cdf(min(max(1 - share, 1e-9), 1 - 1e-9))


_STEPS = 8192
FULL = 4.0
"""Greatest exposed light that `transfer_table` distinguishes."""


@functools.cache
def transfer_table() -> NDArray[np.uint8]:
    """Bytes of sRGB for exposed linear light: entry i is for ``FULL`` * (i / (steps - 1))^2.

    IEC 61966-2-1 up to 0.8 of full scale; above, highlights roll off towards white instead of clipping.
    """
    x = FULL * (np.arange(_STEPS) / (_STEPS - 1)) ** 2
    x = np.where(x > 0.8, 1.0 - 0.2 * np.exp(-(x - 0.8) / 0.2), x)
    s = np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    table: NDArray[np.uint8] = np.rint(255 * s).astype(np.uint8)
    return table


@compiled
def develop(radiance: Single, exposure: float, table: NDArray[np.uint8], out: NDArray[np.uint8]) -> None:
    """Fill ``out`` (n, 3) with the sRGB bytes of radiances (n, 3) times the exposure."""
    scale = exposure / FULL
    for i in range(len(radiance)):
        for c in range(3):
            x = min(max(radiance[i, c] * scale, 0.0), 1.0)
            out[i, c] = table[int(math.sqrt(x) * (_STEPS - 1) + 0.5)]


def develop_tone(radiance: Single, exposure: float) -> NDArray[np.uint8]:
    """The sRGB bytes (n, 3) of radiances (n, 3) times the exposure."""
    out = np.empty(radiance.shape, np.uint8)
    develop(radiance, exposure, transfer_table(), out)
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def straight_rays(
    pixels: NDArray[np.int64],
    width: int,
    parts: int,
    lens: tuple[float, float, float, float],
    out: Float,
) -> None:
    """Fill ``out`` (n, 3) with the directions of pixels of a pinhole without distortion, of z = 1.

    They are those of `lidar.sensors.rig.camera_model.unproject` divided by their z, without its rounding.

    pixels : (n,) numbers, row by row
    parts  : as of `places_in_pixels`
    lens   : fx, fy, cx, cy
    """
    fx, fy, cx, cy = lens
    for i in range(len(pixels)):
        row = np.floor(float(pixels[i]) / width)  # exact, and faster than a quotient of whole numbers
        column = pixels[i] - row * width
        u, v = column, row
        if parts > 1:
            u += (row % parts + 0.5) / parts - 0.5
            v += 0.5 - (column % parts + 0.5) / parts
        out[i, 0], out[i, 1], out[i, 2] = (u - cx) / fx, (v - cy) / fy, 1.0


def places_in_pixels(pixels: NDArray[np.int64], width: int, *, parts: int) -> Float:
    """Columns and rows (n, 2) at which rays pass pixels (n,) of ``parts`` by ``parts`` for each of an image.

    No two rays of a pixel of the image are in one column or row, where upright and level edges, the most
    common ones, would hide or show them together (multi-jittered sampling, Chiu, Shirley and Wang 1994).
    """
    row, column = np.divmod(pixels, width)
    u, v = (row % parts + 0.5) / parts - 0.5, 0.5 - (column % parts + 0.5) / parts
    return np.stack([column + u, row + v], axis=-1)


@compiled
def aim(
    rays: Float, row: NDArray[np.int32], rotation: Float, scale: Float, out: Float, seen: NDArray[np.bool_]
) -> None:
    """Fill ``out`` (n, 3) with scene directions of camera rays (n, 3), ``seen`` (n,) with which are valid.

    The direction of a pixel outside the field of view (NaN) is the optical axis.
    """
    for i in range(len(rays)):
        a, b, c = rays[i, 0], rays[i, 1], rays[i, 2]
        seen[i] = not math.isnan(a)
        if not seen[i]:
            a, b, c = 0.0, 0.0, 1.0
        o = row[i]
        for k in range(3):
            out[i, k] = scale[o, k] * (rotation[o, k, 0] * a + rotation[o, k, 1] * b + rotation[o, k, 2] * c)


@compiled
def shadow_rays(
    origin: Float,
    row: NDArray[np.int32],
    direction: Float,
    range_: Float,
    normal: Float,
    sun: Float,
    lift: float,
    start: Float,
    which: NDArray[np.int64],
) -> int:
    """Number k of hits that face the sun; fills ``start`` (k, 3) of shadow rays and ``which`` (k,) rows.

    Normals (n, 3) are turned in place to face the viewer.
    """
    k = 0
    for i in range(len(range_)):
        t = range_[i]
        if not t < np.inf:
            continue
        nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
        if nx * direction[i, 0] + ny * direction[i, 1] + nz * direction[i, 2] > 0.0:
            nx, ny, nz = -nx, -ny, -nz
            normal[i, 0], normal[i, 1], normal[i, 2] = nx, ny, nz
        if nx * sun[0] + ny * sun[1] + nz * sun[2] > 0.0:
            o = row[i]
            off = lift + 1e-6 * t
            start[k, 0] = origin[o, 0] + t * direction[i, 0] + off * nx
            start[k, 1] = origin[o, 1] + t * direction[i, 1] + off * ny
            start[k, 2] = origin[o, 2] + t * direction[i, 2] + off * nz
            which[k] = i
            k += 1
    return k


@inlined
def _mirror(
    sky: Float, sun: Float, d: Float, nx: float, ny: float, nz: float, town: Float, out: Float
) -> None:
    """Radiance that a mirror reflects: the sky where the ray rises, else ``town``, the lit surroundings."""
    along = 2.0 * (nx * d[0] + ny * d[1] + nz * d[2])
    x, y, z = d[0] - along * nx, d[1] - along * ny, d[2] - along * nz
    sky_radiance(sky, x, y, max(z, 0.0), sun, out)
    s = min(max((z - 0.03) / 0.4, 0.0), 1.0)
    for c in range(3):
        out[c] = town[c] + s * (out[c] - town[c])


@compiled
def _step(value: float, level: float, edge: float) -> float:
    """0 below a level, 1 above, with an edge of some width."""
    return min(max((value - level) / edge + 0.5, 0.0), 1.0)


@inlined
def _paint(feature: int, wall: int, albedo: Float) -> None:
    """Replace a building's default colour by one derived from its number."""
    shade = hash_place(feature, 7, 20)
    shade = 0.5 + 0.6 * shade if wall else 0.7 + 0.6 * shade
    warm = 0.24 * (hash_place(feature, 8, 20) - 0.35)
    albedo[0] *= shade * (1.0 + 0.6 * warm)
    albedo[1] *= shade
    albedo[2] *= shade * (1.0 - 1.6 * warm)


@compiled
def _fresnel(straight: float, cosine: float) -> float:
    """Schlick's approximation (Computer Graphics Forum 13, 1994)."""
    k = 1.0 - min(max(cosine, 0.0), 1.0)
    return straight + (1.0 - straight) * k * k * k * k * k


@inlined
def _irradiance(
    ambient: Float,
    beam: Float,
    sun: Float,
    nx: float,
    ny: float,
    nz: float,
    lit: bool,  # noqa: FBT001 - compiled
    open_sky: float,
    out: Float,
) -> None:
    """Fill ``out`` (3,) with the irradiance of a surface with this normal: by the sky, if lit by the sun."""
    b4, b5, b6 = 1.092548 * nx * ny, 1.092548 * ny * nz, 0.315392 * (3.0 * nz * nz - 1.0)
    b7, b8 = 1.092548 * nx * nz, 0.546274 * (nx * nx - ny * ny)
    facing = max(nx * sun[0] + ny * sun[1] + nz * sun[2], 0.0) if lit else 0.0
    for c in range(3):
        e = 0.282095 * ambient[0, c] + 0.488603 * (
            ny * ambient[1, c] + nz * ambient[2, c] + nx * ambient[3, c]
        )
        e += b4 * ambient[4, c] + b5 * ambient[5, c] + b6 * ambient[6, c]
        e += b7 * ambient[7, c] + b8 * ambient[8, c]
        out[c] = max(e, 0.0) * open_sky + beam[c] * facing


@inlined
def _facing(i: int, normal: Any, wall: Any, frame: Any) -> Any:
    """The normal of a hit; on a wall that of its plane."""
    w = wall[i]
    if w >= 0:
        return frame[w, 4], -frame[w, 3], 0.0
    return normal[i, 0], normal[i, 1], normal[i, 2]


_PLACED = 10
"""Numbers that `_place` returns."""


@inlined
def _place(i: int, view: Any, wall: Any, frame: Any, settings: Any) -> Any:
    """Direction (a unit vector), place, distance, cosine of incidence and widths of a pixel's hit.

    The first width is across the ray, the second one on the surface.
    """
    origin, row, direction, range_, normal = view
    blur, angle, _, _ = settings
    dx, dy, dz = direction[i, 0], direction[i, 1], direction[i, 2]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    t, o = range_[i], row[i]
    x, y, z = origin[o, 0] + t * dx, origin[o, 1] + t * dy, origin[o, 2] + t * dz
    dx, dy, dz = dx / length, dy / length, dz / length
    nx, ny, nz = _facing(i, normal, wall, frame)
    cosine = max(-(nx * dx + ny * dy + nz * dz), 0.0)
    distance = t * length
    size = blur + distance * angle
    return dx, dy, dz, x, y, z, distance, cosine, size, size / math.sqrt(max(cosine, 0.02))


@inlined
def _texture(i: int, at: Any, view: Any, found: Any, frame: Any, tables: Any) -> Any:
    """Kind of texture of a hit, as of `lidar.sensors.camera.texture_blocks`, and what its factor depends on.

    These are u, hx, hy, across and along, of which each kind uses some.
    """
    _, _, _, _, normal = view
    dx, dy, _, x, y, _, _, cosine, size, _ = at
    klass, material, _, _, wall = found
    kinds, floors, _, _, _, _ = tables
    m = material[i] & 127
    nx, ny, nz = _facing(i, normal, wall, frame)
    on_ground = LOWEST <= klass[i] <= HIGHEST or klass[i] == PAVED
    if nz > _LEVEL and on_ground and kinds[m] != texture.LIQUID:
        flat = math.sqrt(dx * dx + dy * dy)
        hx, hy = (dx / flat, dy / flat) if flat > 1e-9 else (1.0, 0.0)
        painted = klass[i] == _MARKING
        kind = (_ASPHALT if painted else int(floors[m])) + (PAINTED if painted else 0)
        return kind, 0.0, hx, hy, size, size / max(cosine, 0.02)
    u = 0.0
    upright = abs(nz) < 0.3
    if wall[i] >= 0:
        u = x * -ny + y * nx
    elif upright:
        u = (y * nx - x * ny) / math.sqrt(nx * nx + ny * ny)
    return DETAIL + 2 * int(kinds[m]) + (UPRIGHT if upright else 0), u, 0.0, 0.0, 0.0, 0.0


@inlined
def _factor(texture_: Any, at: Any) -> float:
    """Factor of a texture on the albedo."""
    kind, u, hx, hy, across, along = texture_
    _, _, _, x, y, z, _, _, _, footprint = at
    if kind >= DETAIL:
        return detail((kind - DETAIL) // 2, kind & UPRIGHT, x, y, z, u, footprint)
    return ground(kind & (PAINTED - 1), kind >= PAINTED, x, y, hx, hy, across, along)


@inlined
def pixel(
    i: int,
    view: Any,
    found: Any,
    walls: Any,
    lit: Any,
    light: Any,
    tables: Any,
    settings: Any,
    covers: Any,
    scratch: Any,
    out: Any,
    gloss: Any,
    facet: Any,
) -> None:
    """Fill row ``i`` of what `shade` fills; ``scratch`` is overwritten. For devices."""
    _, _, _, range_, _ = view
    _, _, _, _, wall = found
    _, angle, _, detailed = settings
    colors, _, _ = scratch
    if not range_[i] < np.inf:
        background(i, view, light, angle, colors, out)
        return
    at = _place(i, view, wall, walls.tables.frame, settings)
    factor = 1.0
    if detailed:
        factor = _factor(_texture(i, at, view, found, walls.tables.frame, tables), at)
    _surface(
        i, at, factor, view, found, walls, lit, light, tables, settings, covers, scratch, out, gloss, facet
    )


@inlined
def _surface(
    i: int,
    at: Any,
    factor: float,
    view: Any,
    found: Any,
    walls: Any,
    lit: Any,
    light: Any,
    tables: Any,
    settings: Any,
    covers: Any,
    scratch: Any,
    out: Any,
    gloss: Any,
    facet: Any,
) -> None:
    """Fill row ``i`` where a surface is hit, whose texture has this factor."""
    _, _, _, _, normal = view
    klass, material, color, feature, wall = found
    frame = walls.tables.frame
    sun, beam, ambient, sky, horizon, _, _, _ = light
    kinds, _, mirrors, plain, soaked, linear = tables
    _, _, extinction, detailed = settings
    wetness, pools, snow, patches = covers
    colors, seen, town = scratch
    d, glow, albedo, sides, aslant, irradiance = (
        colors[0],
        colors[1],
        colors[2],
        colors[3],
        colors[4],
        colors[5],
    )
    dx, dy, dz, x, y, z, distance, cosine, size, footprint = at
    d[0], d[1], d[2] = dx, dy, dz
    w = wall[i]
    nx, ny, nz = _facing(i, normal, wall, frame)
    m = material[i] & 127
    is_open = material[i] > 127
    kind = kinds[m]
    mirror = mirrors[m]
    for c in range(3):
        albedo[c] = linear[color[i, c]] * factor
    if detailed and klass[i] == _BUILDING:
        r, g, b = color[i, 0], color[i, 1], color[i, 2]
        if r == plain[m, 0] and g == plain[m, 1] and b == plain[m, 2]:
            _paint(feature[i], w >= 0, albedo)
    glass = aside = upwards = 0.0
    open_sky = 1.0
    if w >= 0:
        open_sky = 0.6 + 0.4 * min(max((z - frame[w, 2]) / 9.0, 0.0), 1.0)
        if detailed:
            facade(walls, w, (x, y, z), (d[0], d[1], d[2]), size, linear, seen)
            glass, aside, upwards = seen[GLASS], seen[ASIDE], seen[UPRIGHT_SIDES]
            front = 1.0 - glass - aside - upwards - seen[PAINTED_PARTS]
            for c in range(3):
                sides[c] = albedo[c]
                albedo[c] = front * albedo[c] + seen[LIGHT + c] + seen[BEHIND + c]

    film = pool = 0.0
    if is_open and max(wetness, snow) > 0.0:
        edge = 0.1 + 0.5 * min(footprint, 1.0)
        bumps, hollows = 0.0, 0.0
        if 0.0 < snow < 1.0:
            bumps = 0.6 * noise(x / 2.3, y / 2.3, 34) + 0.4 * noise(x / 0.6, y / 0.6, 35)
        white = _step(bumps, patches, edge)
        if wetness > 0.0 and nz > 0.97:
            hollows = 0.7 * noise(x / 3.1, y / 3.1, 36) + 0.3 * noise(x / 0.8, y / 0.8, 37)
            pool = _step(hollows, pools, edge)
        damp = max(wetness, pool) * (1.0 - white)
        bright = 1.0
        if detailed and white > 0.0:
            bright += 0.05 * grain(x, y, 1 / 1.3, footprint, 38) + 0.04 * grain(x, y, 1 / 0.16, footprint, 39)
        for c in range(3):
            albedo[c] *= 1.0 - damp * (1.0 - soaked[m])
            albedo[c] += white * (_SNOW[c] * bright - albedo[c])
        film = (0.25 * damp + 0.75 * min(pool, damp)) * _fresnel(0.02, cosine)

    rx, ry, rz = nx, ny, nz
    if kind == texture.LIQUID and detailed:
        ripple = 0.02 / (1.0 + footprint)
        rx += ripple * noise(x / 0.7, y / 0.7, 30)
        ry += ripple * noise(x / 0.7 + 40.0, y / 0.7, 31)
    shine = glass * _fresnel(0.08, cosine)
    if mirror > 0.0:
        shine = max(shine, _fresnel(mirror, cosine))

    _irradiance(ambient, beam, sun, nx, ny, nz, lit[i], open_sky, irradiance)
    if shine > 0.0:
        _mirror(sky, sun, d, rx, ry, rz, town, glow)
    for c in range(3):
        irradiance[c] *= albedo[c]
    if aside > 0.0:
        along = 1.0 if d[0] * frame[w, 3] + d[1] * frame[w, 4] < 0.0 else -1.0
        _irradiance(
            ambient, beam, sun, along * frame[w, 3], along * frame[w, 4], 0.0, lit[i], open_sky, aslant
        )
        for c in range(3):
            irradiance[c] += aside * sides[c] * aslant[c]
    if upwards > 0.0:
        up = 1.0 if d[2] < 0.0 else -1.0
        _irradiance(ambient, beam, sun, 0.0, 0.0, up, lit[i], open_sky, aslant)
        for c in range(3):
            irradiance[c] += upwards * sides[c] * aslant[c]
    clear = math.exp(-extinction * distance)
    for c in range(3):
        leaving = (1.0 - shine) * (1.0 - film) * irradiance[c] / math.pi
        if shine > 0.0:
            leaving += shine * glow[c]
        out[i, c] = leaving * clear + horizon[c] * (1.0 - clear)
    if len(gloss):
        # The texture of the surface shows through a thin film, puddles are smooth but for ripples.
        rough = (0.12 * (1.0 - pool) + 0.006) / (1.0 + 8.0 * footprint) if film > 0.0 else 0.0
        gloss[i] = film * clear
        facet[i, 0] = nx + rough * noise(x / 0.03, y / 0.03, 32)
        facet[i, 1] = ny + rough * noise(x / 0.03 + 40.0, y / 0.03, 33)
        facet[i, 2] = nz


@inlined
def _put(texture_: Any, at: Any, j: int, kind: Any, places: Any) -> None:
    """Write what the factor of a texture depends on into column j of a block."""
    kind[j], places[3, j], places[4, j], places[5, j], places[6, j], places[7, j] = texture_
    places[0, j], places[1, j], places[2, j], places[8, j] = at[3], at[4], at[5], at[9]


@compiled
def shade(
    origin: Float,
    row: NDArray[np.int32],
    direction: Float,
    range_: Float,
    normal: Float,
    klass: NDArray[np.uint8],
    material: NDArray[np.uint8],
    color: NDArray[np.uint8],
    feature: NDArray[np.int32],
    wall: NDArray[np.int32],
    walls: RenderedFacades,
    lit: NDArray[np.bool_],
    light: tuple[Float, Float, Float, Float, Float, Float, Float, Float],
    tables: tuple[NDArray[np.uint8], NDArray[np.uint8], Float, NDArray[np.uint8], Float, Float],
    settings: tuple[float, float, float, bool],
    covers: tuple[float, float, float, float],
    out: Single,
    gloss: Single,
    facet: Single,
) -> None:
    """Fill ``out`` (n, 3) with the radiance along each ray.

    Of wet surfaces also fill ``gloss`` (n,) with the share of what their films of water reflect, which is not
    in ``out``, and ``facet`` (n, 3) with the films' normals; both are empty in a dry world.

    walls    : `facades.RenderedFacades`; ``wall`` (n,) are rows of its tables, -1 for other surfaces
    light    : `lidar.sensors.camera.light.Light.columns`
    tables   : `material_tables` and `linear_table`
    settings : size of a pixel at distance 0 (metres) and its growth with distance (radians), extinction of
               haze (1/m), whether detail is drawn
    covers   : `covers` of the world
    """
    scratch = np.empty((6, 3)), np.zeros(SEEN), TOWN * light[4]
    view = origin, row, direction, range_, normal
    found = klass, material, color, feature, wall
    frame = walls.tables.frame
    work = block_scratch()
    at, places = np.empty((BLOCK, _PLACED)), np.empty((PLACES, BLOCK))
    kind, factor = np.empty(BLOCK, np.int64), np.ones(BLOCK)
    for first in range(0, len(range_), BLOCK):
        n = min(BLOCK, len(range_) - first)
        for j in range(n):
            i, kind[j] = first + j, -1
            if range_[i] < np.inf:
                here = _place(i, view, wall, frame, settings)
                for c in range(_PLACED):
                    at[j, c] = here[c]
                if settings[3]:
                    _put(_texture(i, here, view, found, frame, tables), here, j, kind, places)
        if settings[3]:
            factors(kind[:n], places, work, factor)
        for j in range(n):
            i = first + j
            if not range_[i] < np.inf:
                background(i, view, light, settings[1], scratch[0], out)
                continue
            p = at[j]
            _surface(
                i,
                (p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], p[8], p[9]),
                factor[j],
                view,
                found,
                walls,
                lit,
                light,
                tables,
                settings,
                covers,
                scratch,
                out,
                gloss,
                facet,
            )
