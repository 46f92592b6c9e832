"""Images of a world by ray casting: colour, depth, classes, instances and optical flow."""

from __future__ import annotations

import functools
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.classes import Class
from geoscene.typing import Float
from lidar.errors import InputError
from lidar.geometry.poses import Poses
from lidar.raycast import Hits
from lidar.raycast.device import CPU
from lidar.raycast.hits import own_faces
from lidar.sensors.camera import appearance, shade
from lidar.sensors.camera.edges import edge_pixels
from lidar.sensors.camera.facades import RenderedFacades, facades_of, flatten, walls_of
from lidar.sensors.camera.light import Light, daylight
from lidar.sensors.camera.signal_lamps import Lamps, emit
from lidar.sensors.physics.fresnel import reflect
from lidar.sensors.rig.camera_model import project, unproject
from lidar.sensors.rig.specs import CameraSpec
from lidar.world.surfaces import Surfaces, label_hits
from lidar.world.world import World

if TYPE_CHECKING:
    from lidar.sensors.camera.warp_shade import WarpShader

_BAND = 1 << 16
"""Rays per batch: small enough for their columns to stay in the processor's cache."""

_EDGES = 1 << 14
"""Pixels at edges per batch."""

_Pixels = slice | NDArray[np.int64]
"""Numbers of pixels; a slice has a start and a stop."""

_SHARED = 1 << 21
"""Rays of a lens with distortion, supersampling included, up to which frames share them; they take 24 bytes
each. Of larger images, rays are computed for each frame."""

_ROLLS = 5
"""Fixed-point iterations for the row in which a rolling shutter sees a point; each gains some digits."""

_GLOSS = 0.002
"""Share of light below which what a wet surface mirrors is left out."""

_LIFT = 1e-3
"""Offset in metres of a shadow ray from its surface; it grows with distance."""


@dataclass(frozen=True)
class RenderOptions:
    """Settings of the renderer.

    precision   : of depths, see `lidar.raycast.Caster.cast`
    retrace     : whether rays that miss are traced a second time
    shadows     : cast shadows
    detail      : draw windows, joints and grain on surfaces of uniform colour
    supersample : rays along each side of a pixel, for colour only; labels and depth are those of its centre
    edge_rays   : the same at edges, as `edges` finds them, where it is more than ``supersample``
    visibility  : metres at which haze has taken 98 % of a contrast (Koschmieder); inf for clear air
    cloud       : share of the sky that clouds cover
    exposure    : stops added to the automatic exposure
    full_well   : electrons at full scale, which set the shot noise; inf for none
    read_noise  : electrons (standard deviation), with a finite ``full_well``
    threads     : threads to use; the images do not depend on it
    """

    precision: str = "exact"
    retrace: bool = True
    shadows: bool = True
    detail: bool = True
    supersample: int = 1
    edge_rays: int = 2
    visibility: float = 20_000.0
    cloud: float = 0.0
    exposure: float = 0.0
    full_well: float = float("inf")
    read_noise: float = 4.0
    threads: int = 1

    def __post_init__(self) -> None:
        """Raise InputError for values out of range."""
        sound = 1 <= self.supersample <= 16 and 1 <= self.edge_rays <= 16
        sound = sound and self.visibility > 0 and 0 <= self.cloud <= 1
        if not (sound and self.full_well > 0 and self.threads):
            raise InputError(f"camera options out of range: {self}")


@dataclass(frozen=True, slots=True)
class CameraImage:
    """One frame of a camera, row by row from the top.

    rgb     : (h, w, 3) uint8, sRGB, or None if not asked for
    depth   : (h, w) metres, float64 as rendered, float32 as read from a file: along the optical axis (z) for
              a pinhole, along the ray for a fisheye; inf for sky and beyond the camera's ``far``
    klass   : (h, w) uint8, `geoscene.classes.Class`; SKY where nothing is hit, UNLABELED without a ray
    feature : (h, w) int32, feature number in the scene, -1 for none
    """

    rgb: NDArray[np.uint8] | None
    depth: NDArray[np.floating]
    klass: NDArray[np.uint8]
    feature: NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class _Traced:
    """Rays in the scene and their hits.

    origin    : (k, 3) scene metres
    row       : (n,) int32, each ray's row of ``origin``
    direction : (n, 3) in the scene's axes
    seen      : (n,) False for a pixel outside the lens's field of view
    time      : (n,) ray times, or None
    hits      : what the rays hit
    """

    origin: Float
    row: NDArray[np.int32]
    direction: Float
    seen: NDArray[np.bool_]
    time: Float | None
    hits: Hits

    def view(self, world: World) -> TracedView:
        """These, and the surfaces that are hit."""
        found = world.lookup(self.hits)
        return TracedView(self.origin, self.row, self.direction, self.seen, self.time, self.hits, found)


@dataclass(frozen=True, slots=True)
class TracedView(_Traced):
    """Rays in the scene and their hits, as in `_Traced`.

    surfaces : surfaces at the hits
    """

    surfaces: Surfaces


def render(
    camera: CameraSpec,
    poses: Poses,
    *,
    world: World,
    sun: ArrayLike,
    times: Float | None = None,
    lamps: Lamps | None = None,
    random: np.random.Generator | None = None,
    options: RenderOptions | None = None,
) -> CameraImage:
    """One frame of a camera.

    poses   : of the camera (z forward, x right, y down), one for each of `exposure_times`: a single one, one
              a row for a rolling shutter, and that many again for every sample of the exposure; colour is
              their mean, depth and labels are the middle sample's
    sun     : (3,) direction towards the sun, scene axes, from `lidar.sensors.camera.sun.sun_direction`
    times   : ray times 0 to 1 of the poses, for actors that move
    lamps   : signal heads that are lit; none by default
    random  : source of the noise of a finite ``options.full_well``

    Raises InputError for a number of poses that does not fit the camera.
    """
    options = options or RenderOptions()
    rows = camera.height if camera.row_ns else 1
    samples, rest = divmod(len(poses), rows)
    if rest or not samples:
        raise InputError(f"camera {camera.name}: {len(poses)} poses for {rows} moments; see exposure_times")
    if np.isfinite(options.full_well) and random is None:
        raise InputError(f"camera {camera.name}: `full_well` adds noise and needs `random`")
    h, w = camera.height, camera.width
    coloured = "rgb" in camera.images
    light = replace(light_of(sun, cloud=options.cloud, snow=world.settings.snow), lamps=lamps)
    exposure = light.exposure * 2.0**options.exposure
    walls = facades_of(world)
    k = options.supersample
    trace = functools.partial(_trace, poses=poses, world=world, times=times, options=options)
    colour = functools.partial(radiance, world, light=light, walls=walls, blur=0.0, options=options)

    def band(edges: tuple[int, int], image: _Image, *, sample: int) -> None:
        """Labels, depth and colour of the rows of an image."""
        first, last = edges
        here = slice(first * w, last * w)
        if not coloured:
            traced = trace(camera, here, sample=sample, normals=False)
            hits, klass, feature = traced.hits, image.klass[here], image.feature[here]
            label_hits(world.faces, hits.face, hits.instance, klass, feature)
            image.label(here, hits=hits, seen=traced.seen, klass=klass, feature=feature)
            return
        view = trace(camera, here, sample=sample).view(world)
        found = view.surfaces
        image.label(here, hits=view.hits, seen=view.seen, klass=found.klass, feature=found.feature)
        if k == 1:
            image.light[here] = colour(view, angle=1 / camera.fx)
        else:
            fine = _finer(camera, k)
            sharp = trace(fine, slice(first * k * w * k, last * k * w * k), sample=sample, rows=h)
            image.light[here] = _bin_values(colour(sharp.view(world), angle=1 / fine.fx), k, width=w)

    def refine(pixels: NDArray[np.int64], image: _Image, *, sample: int) -> None:
        """Colour of single pixels of an image, from more rays."""
        n = options.edge_rays
        fine = _finer(camera, n)
        sharp = trace(fine, _finer_pixels(pixels, n, width=w), sample=sample, rows=h)
        part = colour(sharp.view(world), angle=1 / fine.fx).reshape(len(pixels), n * n, 3)
        # The same as their mean, of which NumPy adds three numbers at a time.
        image.light[pixels] = sum(part[:, i] for i in range(n * n)) / np.float32(n * n)

    step = max(1, _BAND // (w * k * k))
    bands = [(a, min(a + step, h)) for a in range(0, h, step)]
    total = None
    with ThreadPoolExecutor(options.threads) as pool:
        run = map if options.threads == 1 else pool.map
        for sample in range(samples) if coloured else [samples // 2]:
            image = _Image.of(h * w, coloured=coloured)
            list(run(functools.partial(band, image=image, sample=sample), bands))
            if coloured:
                rgb = shade.develop_tone(image.light, exposure).reshape(h, w, 3)
            if coloured and options.edge_rays > k:
                edge = edge_pixels(rgb, image.feature.reshape(h, w), klass=image.klass.reshape(h, w))
                parts = np.split(edge, range(_EDGES, len(edge), _EDGES))
                list(run(functools.partial(refine, image=image, sample=sample), parts))
                rgb.reshape(-1, 3)[edge] = shade.develop_tone(image.light[edge], exposure)
            total = image.light if total is None else total + image.light
            if sample == samples // 2:
                middle = image
    noise = random if np.isfinite(options.full_well) else None
    if coloured and total is not None and (samples > 1 or noise is not None):
        exposure /= samples
        if noise is not None:
            electrons = noise.standard_normal((h, w, 3), np.float32).reshape(-1, 3)
            total = _noisy(total, exposure, normal=electrons, options=options)
        rgb = shade.develop_tone(total, exposure).reshape(h, w, 3)
    depth = np.where(middle.range <= camera.far, middle.range, np.inf)
    return CameraImage(
        rgb if coloured else None,
        depth.reshape(h, w),
        middle.klass.reshape(h, w),
        middle.feature.reshape(h, w),
    )


@dataclass(frozen=True, slots=True)
class _Image:
    """Pixels (n,) of one sample of an exposure, filled in parts.

    light   : (n, 3) float32, linear; (0, 3) without colour
    range   : (n,) float64, ray parameter of the hit
    klass, feature : as in `CameraImage`
    """

    light: NDArray[np.float32]
    range: Float
    klass: NDArray[np.uint8]
    feature: NDArray[np.int32]

    @classmethod
    def of(cls, n: int, *, coloured: bool) -> _Image:
        """An image of n pixels."""
        light = np.empty((n if coloured else 0, 3), np.float32)
        return cls(light, np.empty(n), np.empty(n, np.uint8), np.empty(n, np.int32))

    def label(
        self,
        here: slice,
        *,
        hits: Hits,
        seen: NDArray[np.bool_],
        klass: NDArray[np.uint8],
        feature: NDArray[np.int32],
    ) -> None:
        """Set depth, class and feature of some pixels."""
        self.range[here], self.klass[here], self.feature[here] = hits.range, klass, feature
        klass = self.klass[here]
        klass[hits.face < 0] = Class.SKY
        klass[~seen] = Class.UNLABELED


def light_of(sun: ArrayLike, *, cloud: float, snow: float) -> Light:
    """The light of `render` with the sun towards ``sun`` (3,), as `light.daylight` describes."""
    x, y, z = np.asarray(sun, float).tolist()
    return _light((x, y, z), cloud, snow=snow)


@functools.lru_cache(maxsize=8)
def _light(sun: tuple[float, float, float], cloud: float, *, snow: float) -> Light:
    return daylight(sun, cloud=cloud, snow=snow)


def _finer(camera: CameraSpec, k: int) -> CameraSpec:
    """The same camera with k by k pixels for each one."""
    return replace(
        camera,
        width=camera.width * k,
        height=camera.height * k,
        fx=camera.fx * k,
        fy=camera.fy * k,
        cx=(camera.cx + 0.5) * k - 0.5,
        cy=(camera.cy + 0.5) * k - 0.5,
    )


def _bin_values(fine: NDArray[np.float32], k: int, *, width: int) -> NDArray[np.float32]:
    """Means (n, 3) over blocks of k by k pixels; ``width`` is that of the coarse image."""
    mean: NDArray[np.float32] = fine.reshape(-1, k, width, k, 3).mean(axis=(1, 3), dtype=np.float32)
    return mean.reshape(-1, 3)


def _finer_pixels(pixels: NDArray[np.int64], k: int, *, width: int) -> NDArray[np.int64]:
    """The k by k pixels (n * k * k,) of `_finer` of each of some pixels (n,), one after the other."""
    row, column = np.divmod(pixels, width)
    part = np.arange(k)
    rows = (row * k)[:, None, None] + part[:, None]
    columns = (column * k)[:, None, None] + part
    return (rows * (width * k) + columns).reshape(-1)


def _trace(
    camera: CameraSpec,
    pixels: _Pixels,
    *,
    poses: Poses,
    world: World,
    sample: int,
    times: Float | None,
    options: RenderOptions,
    rows: int | None = None,
    normals: bool = True,
) -> _Traced:
    """Rays and hits of pixels of a camera in one sample of the exposure.

    pixels  : numbers of pixels, row by row from the top
    rows    : rows of the shutter, where the camera is a finer one
    normals : whether the hits have normals
    """
    rays = _scaled_rays(camera, pixels)
    moments = (rows or camera.height) if camera.row_ns else 1
    if moments == 1:
        row = np.full(len(rays), sample, np.int32)
    else:
        number = np.arange(pixels.start, pixels.stop) if isinstance(pixels, slice) else pixels
        line = number // camera.width * moments // camera.height
        row = (sample * moments + line).astype(np.int32)
    direction, seen = np.empty_like(rays), np.empty(len(rays), np.bool_)
    shade.aim(rays, row, poses.rotation, poses.scale, direction, seen)
    time = None if times is None else np.asarray(times, float)[row]
    origin = poses.position[sample] if moments == 1 else poses.position[row]
    hits = world.caster.cast(
        origin,
        direction,
        near=camera.near,
        far=world.reach,
        time=time,
        normals=normals,
        precision=options.precision,
        retrace=options.retrace,
        footprint=(0.0, 1.0 / camera.fx),
        scattered=True,
    )
    if not seen.all():
        hits = _with_misses(hits, ~seen)
    return _Traced(poses.position, row, direction, seen, time, hits)


def _scaled_rays(camera: CameraSpec, pixels: _Pixels) -> Float:
    """Directions of pixels whose ray parameter is the depth as defined in `CameraImage`."""
    bent = camera.model == "fisheye" or any(camera.distortion)
    if bent and camera.width * camera.height <= _SHARED:
        return _shared_rays(camera)[pixels]
    number = np.arange(pixels.start, pixels.stop) if isinstance(pixels, slice) else pixels
    if bent:
        return _bent_rays(camera, number)
    rays = np.empty((len(number), 3))
    shade.straight_rays(number, camera.width, (camera.fx, camera.fy, camera.cx, camera.cy), rays)
    return rays


@functools.lru_cache(maxsize=16)
def _shared_rays(camera: CameraSpec) -> Float:
    """Rays of all pixels, kept for the cameras of a rig, each with its finer one."""
    return _bent_rays(camera, np.arange(camera.width * camera.height))


def _bent_rays(camera: CameraSpec, number: NDArray[np.int64]) -> Float:
    """Rays of pixels of a lens with distortion."""
    rays = unproject(camera, np.stack([number % camera.width, number // camera.width], axis=-1))
    return rays if camera.model == "fisheye" else rays / rays[:, 2:]


def _with_misses(hits: Hits, missed: NDArray[np.bool_]) -> Hits:
    """The hits with some rays turned into misses."""
    return Hits(
        np.where(missed, np.inf, hits.range),
        np.where(missed, np.int32(-1), hits.face),
        np.where(missed, np.int32(-1), hits.instance),
        np.where(missed, np.float32(0), hits.cosine),
        hits.normal,
    )


def radiance(
    world: World,
    view: TracedView,
    *,
    light: Light,
    walls: RenderedFacades,
    blur: float,
    angle: float,
    options: RenderOptions,
) -> NDArray[np.float32]:
    """Linear light (n, 3) along the rays of a view, in units of `Light`.

    blur, angle : a pixel is blur + angle * distance metres wide
    """
    wet = world.settings.wetness > 0
    out, gloss, facet = _shade(
        world, view, light=light, walls=walls, size=(blur, angle), options=options, wet=wet
    )
    row = np.flatnonzero(gloss > _GLOSS)
    if len(row):
        mirror = _mirrored_view(world, view, row=row, facet=facet[row], options=options)
        size = float(angle * np.median(view.hits.range[row])), angle
        seen, _, _ = _shade(world, mirror, light=light, walls=walls, size=size, options=options, wet=False)
        out[row] += gloss[row, None] * seen
    return out


def _mirrored_view(
    world: World,
    view: TracedView,
    *,
    row: NDArray[np.intp],
    facet: NDArray[np.float32],
    options: RenderOptions,
) -> TracedView:
    """Hits of rays (k,) of a view after reflection at films of water with normals (k, 3)."""
    direction, normal = view.direction[row], view.hits.normal[row]
    place = view.origin[view.row[row]] + view.hits.range[row, None] * direction
    facets = facet / np.linalg.norm(facet, axis=1, keepdims=True)
    towards = reflect(direction / np.linalg.norm(direction, axis=1, keepdims=True), facets.astype(np.float64))
    # A rough film also sends light below its horizon, from where it is mirrored once more.
    below = np.minimum(np.einsum("ij,ij->i", towards, normal), 0.0)
    towards -= 2 * below[:, None] * normal
    start = place + (_LIFT + 1e-6 * view.hits.range[row, None]) * normal
    time = None if view.time is None else view.time[row]
    hits = world.caster.cast(
        start, towards, far=world.reach, time=time, normals=True, retrace=options.retrace
    )
    each = np.arange(len(row), dtype=np.int32)
    return TracedView(start, each, towards, np.ones(len(row), np.bool_), time, hits, world.lookup(hits))


def _shade(
    world: World,
    view: TracedView,
    *,
    light: Light,
    walls: RenderedFacades,
    size: tuple[float, float],
    options: RenderOptions,
    wet: bool,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Linear light (n, 3) along the rays of a view, and gloss (n,) and normals (n, 3) of wet surfaces.

    size : width of a pixel at distance 0 in metres, and its growth with distance
    wet  : whether films of water mirror, as `lidar.sensors.camera.shade.shade` describes
    """
    hits = view.hits
    n = len(hits)
    surfaces, wall = walls_of(walls, view.surfaces, hits=hits)
    view = replace(view, surfaces=surfaces)
    distance, normal = hits.range, hits.normal
    if walls.deep and (wall >= 0).any():
        distance = distance.copy()
        flatten(walls, wall, (view.origin, view.row, view.direction), size, distance, normal)
    start, which = np.empty((n, 3)), np.empty(n, np.int64)
    k = shade.shadow_rays(
        view.origin, view.row, view.direction, distance, normal, light.direction, _LIFT, start, which
    )
    lit = np.zeros(n, np.bool_)
    if k and light.beam.any():
        which = which[:k]
        if options.shadows:
            towards = np.broadcast_to(light.direction, (k, 3))
            time = None if view.time is None else view.time[which]
            on = own_faces(hits)[which]
            # The sun is half a degree wide: what the second trace finds, 3e-7 rad beside a ray, is as right.
            lit[which] = ~world.caster.occluded(start[:k], towards, time=time, on=on, retrace=False)
        else:
            lit[which] = True
    out = np.empty((n, 3), np.float32)
    gloss, facet = np.zeros(n if wet else 0, np.float32), np.empty((n if wet else 0, 3), np.float32)
    fill = shade.shade if world.settings.device == CPU else _shader(world.settings.device).shade
    fill(
        view.origin,
        view.row,
        view.direction,
        distance,
        normal,
        surfaces.klass,
        surfaces.material,
        _drawn(world, view, size=size) if options.detail else surfaces.color,
        surfaces.feature,
        wall,
        walls,
        lit,
        (light.direction, light.beam, light.ambient, light.sky, light.horizon),
        (*shade.material_tables(), shade.linear_table()),
        (*size, 3.912 / options.visibility, options.detail),
        shade.covers(world.settings.wetness, world.settings.snow),
        out,
        gloss,
        facet,
    )
    if light.lamps is not None:
        rows, state = light.lamps.lit(surfaces.feature, surfaces.klass, material=surfaces.material)
        standing = hits.instance[rows] >= 0
        rows, state = rows[standing], state[standing]
        away = hits.range[rows] * np.linalg.norm(view.direction[rows], axis=1)
        seen = emit(
            state,
            place=_on_shapes(world, view, rows=rows),
            width=size[0] + size[1] * away,
            exposure=light.exposure,
        )
        out[rows] += seen * np.exp(-3.912 / options.visibility * away)[:, None].astype(np.float32)
    if not view.seen.all():
        out[~view.seen] = 0.0
    return out, gloss, facet


def _shader(device: str) -> WarpShader:
    """Shading function of a device."""
    from lidar.sensors.camera.warp_shade import shader  # noqa: PLC0415  (Warp, which is optional)

    return shader(device)


def _on_shapes(world: World, view: TracedView, *, rows: NDArray[np.intp]) -> Float:
    """Places (k, 3) of some hits on instances, in the instances' own frames."""
    point = view.origin[view.row[rows]] + view.hits.range[rows, None] * view.direction[rows]
    time = np.zeros(len(rows)) if view.time is None else view.time[rows]
    transform = _transforms(world, view.hits.instance[rows], time=time)
    offset = (point - transform[:, :, 3])[..., None]
    return np.linalg.solve(transform[:, :, :3], offset)[..., 0].astype(np.float64)


def _drawn(world: World, view: TracedView, *, size: tuple[float, float]) -> NDArray[np.uint8]:
    """Colours (n, 3) of the visible surfaces, with signs, plates and clothes drawn on instances."""
    hits, found = view.hits, view.surfaces
    on = np.flatnonzero(hits.instance >= 0)
    if not len(on):
        return found.color
    distance = hits.range[on] * np.linalg.norm(view.direction[on], axis=1)
    color = found.color.copy()
    color[on] = appearance.colors(
        world,
        instance=hits.instance[on],
        face=hits.face[on],
        klass=found.klass[on],
        material=found.material[on],
        feature=found.feature[on],
        color=color[on],
        place=lambda rows: _on_shapes(world, view, rows=on[rows]),
        width=size[0] + size[1] * distance,
    )
    return color


def _noisy(
    light: NDArray[np.float32], exposure: float, *, normal: NDArray[np.float32], options: RenderOptions
) -> NDArray[np.float32]:
    """Light with shot noise and read noise."""
    electrons = np.minimum(light * exposure, 1.0) * options.full_well
    spread = np.sqrt(electrons + options.read_noise**2) / options.full_well
    noisy: NDArray[np.float32] = (light + spread * normal / exposure).astype(np.float32)
    return noisy


def optical_flow(
    camera: CameraSpec,
    poses: Poses,
    *,
    later: Poses,
    world: World,
    times: Float | None = None,
    later_times: Float | None = None,
) -> NDArray[np.float32]:
    """Optical flow (h, w, 2) from one frame to a later one, pixels right and down.

    NaN where a point leaves the camera's field of view (not merely the image). Sky moves with rotation only.
    Of a rolling shutter, the later row is the one that is exposed when the point is on it.

    poses, later       : the camera's pose in either frame, or one a row for a rolling shutter
    times, later_times : ray times 0 to 1 of these poses, for actors that move; 0 and 1 by default

    Raises InputError for other numbers of poses.
    """
    rows = camera.height if camera.row_ns else 1
    if len(poses) != rows or len(later) != rows:
        raise InputError(f"camera {camera.name}: optical flow needs {rows} poses of each frame")
    start = np.zeros(rows) if times is None else np.asarray(times, float)
    end = np.ones(rows) if later_times is None else np.asarray(later_times, float)
    view = _trace(
        camera,
        slice(0, camera.width * camera.height),
        poses=poses,
        world=world,
        sample=0,
        times=start,
        options=RenderOptions(),
        normals=False,
    )
    hit = np.isfinite(view.hits.range)
    point = view.origin[view.row] + np.where(hit, view.hits.range, 1.0)[:, None] * view.direction
    body = _on_bodies(point, view.hits, world=world, time=start[view.row])
    row = view.row
    for _ in range(_ROLLS if rows > 1 else 1):
        there = later.take(row if rows > 1 else [0])
        moved = _off_bodies(point, body, hits=view.hits, world=world, time=end[row])
        away = np.where(hit[:, None], moved - there.position, view.direction)
        seen = np.einsum("ni,nij->nj", away / there.scale, np.broadcast_to(there.rotation, (len(away), 3, 3)))
        pixel, _ = project(camera, np.where(view.seen[:, None], seen, np.nan))
        row = np.clip(np.rint(np.nan_to_num(pixel[:, 1])), 0, rows - 1).astype(np.int64)
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    flow: NDArray[np.float32] = (pixel - np.stack([u.ravel(), v.ravel()], axis=1)).astype(np.float32)
    return flow.reshape(camera.height, camera.width, 2)


def _on_bodies(point: Float, hits: Hits, *, world: World, time: Float) -> Float:
    """Points (k, 3) on instances, in the instances' own frames, at ray times (n,)."""
    on = np.flatnonzero(hits.instance >= 0)
    place = _transforms(world, hits.instance[on], time=time[on])
    offset = (point[on] - place[:, :, 3])[..., None]
    return np.linalg.solve(place[:, :, :3], offset)[..., 0].astype(np.float64)


def _off_bodies(point: Float, body: Float, *, hits: Hits, world: World, time: Float) -> Float:
    """Points (n, 3) at ray times (n,): those on instances (k, 3) moved along with them."""
    on = np.flatnonzero(hits.instance >= 0)
    place = _transforms(world, hits.instance[on], time=time[on])
    moved = point.copy()
    moved[on] = np.einsum("nij,nj->ni", place[:, :, :3], body) + place[:, :, 3]
    return moved


def _transforms(world: World, instance: NDArray[np.int32], *, time: Float) -> Float:
    """Transforms (k, 3, 4) of instances at ray times (k,), linearly interpolated."""
    out = np.empty((len(instance), 3, 4))
    start = 0
    for group in world.caster.instances:
        rows = np.flatnonzero((instance >= start) & (instance < start + len(group)))
        moments = group.transform if group.transform.ndim == 4 else group.transform[:, None]
        own, last = instance[rows] - start, moments.shape[1] - 1
        place = time[rows] * last
        step = np.minimum(place.astype(np.int64), max(last - 1, 0))
        w = (place - step)[:, None, None]
        out[rows] = moments[own, step] * (1 - w) + moments[own, np.minimum(step + 1, last)] * w
        start += len(group)
    return out
