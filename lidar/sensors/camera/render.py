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
from lidar.sensors.camera.light import Lamps, Light, daylight, emit
from lidar.sensors.camera.settings import PLAIN, CameraSettings
from lidar.sensors.camera.sky import cloud_pattern
from lidar.sensors.physics.reflect import reflect
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
class TracedView:
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


def render(
    camera: CameraSpec,
    poses: Poses,
    *,
    world: World,
    sun: ArrayLike,
    times: Float | None = None,
    lamps: Lamps | None = None,
    clouds: tuple[float, float] = (0.0, 0.0),
    random: np.random.Generator | None = None,
    settings: CameraSettings = PLAIN,
    threads: int = 1,
) -> CameraImage:
    """One frame of a camera.

    poses   : of the camera (z forward, x right, y down), one for each of `exposure_times`: a single one, one
              a row for a rolling shutter, and that many again for every sample of the exposure; colour is
              their mean, depth and labels are the middle sample's
    sun     : (3,) direction towards the sun, scene axes, from `lidar.sensors.camera.light.sun_direction`
    times   : ray times 0 to 1 of the poses, for actors that move
    lamps   : signal heads that are lit; none by default
    clouds  : where the pattern of clouds begins, metres east and north of the scene's origin
    random  : source of the noise of ``settings.camera_noise``
    threads : threads to use; the image does not depend on it

    Raises InputError for a number of poses that does not fit the camera.
    """
    rows = camera.height if camera.row_ns else 1
    samples, rest = divmod(len(poses), rows)
    if rest or not samples:
        raise InputError(f"camera {camera.name}: {len(poses)} poses for {rows} moments; see exposure_times")
    noise = random if settings.camera_noise else None
    if settings.camera_noise and noise is None:
        raise InputError(f"camera {camera.name}: `camera_noise` needs `random`")
    h, w = camera.height, camera.width
    coloured = "rgb" in camera.images
    light = replace(
        light_of(sun, cloud=settings.cloud, snow=world.settings.snow),
        lamps=lamps,
        clouds=cloud_pattern(settings.cloud, clouds),
    )
    exposure = light.exposure * 2.0**camera.exposure_ev
    walls = facades_of(world)
    k = settings.supersample
    trace = functools.partial(_trace, poses=poses, world=world, times=times, settings=settings)
    colour = functools.partial(radiance, world, light=light, walls=walls, blur=0.0, settings=settings)

    def band(edges: tuple[int, int], image: _Image, *, sample: int) -> None:
        """Labels, depth and colour of the rows of an image."""
        first, last = edges
        here = slice(first * w, last * w)
        view = trace(camera, here, sample=sample, normals=coloured)
        if not coloured:
            klass, feature = image.klass[here], image.feature[here]
            label_hits(world.faces, view.hits.face, view.hits.instance, klass, feature)
            image.label(here, hits=view.hits, seen=view.seen, klass=klass, feature=feature)
            return
        found = world.lookup(view.hits)
        image.label(here, hits=view.hits, seen=view.seen, klass=found.klass, feature=found.feature)
        if k == 1:
            image.light[here] = colour(view, surfaces=found, angle=1 / camera.fx)
        else:
            fine = _finer(camera, k)
            sharp = trace(fine, slice(first * k * w * k, last * k * w * k), sample=sample, rows=h)
            linear = colour(sharp, surfaces=world.lookup(sharp.hits), angle=1 / fine.fx)
            image.light[here] = _bin_values(linear, k, width=w)

    def refine(pixels: NDArray[np.int64], image: _Image, *, sample: int) -> None:
        """Colour of single pixels of an image, from more rays."""
        n = settings.edge_rays
        fine = _finer(camera, n)
        sharp = trace(fine, _finer_pixels(pixels, n, width=w), sample=sample, rows=h)
        linear = colour(sharp, surfaces=world.lookup(sharp.hits), angle=1 / fine.fx)
        part = linear.reshape(len(pixels), n * n, 3)
        # The same as their mean, of which NumPy adds three numbers at a time.
        image.light[pixels] = sum(part[:, i] for i in range(n * n)) / np.float32(n * n)

    step = max(1, _BAND // (w * k * k))
    bands = [(a, min(a + step, h)) for a in range(0, h, step)]
    total = None
    with ThreadPoolExecutor(threads) as pool:
        run = map if threads == 1 else pool.map
        for sample in range(samples) if coloured else [samples // 2]:
            image = _Image.of(h * w, coloured=coloured)
            list(run(functools.partial(band, image=image, sample=sample), bands))
            if coloured:
                rgb = shade.develop_tone(image.light, exposure).reshape(h, w, 3)
            if coloured and settings.edge_rays > k:
                edge = edge_pixels(rgb, image.feature.reshape(h, w), klass=image.klass.reshape(h, w))
                parts = np.split(edge, range(_EDGES, len(edge), _EDGES))
                list(run(functools.partial(refine, image=image, sample=sample), parts))
                rgb.reshape(-1, 3)[edge] = shade.develop_tone(image.light[edge], exposure)
            total = image.light if total is None else total + image.light
            if sample == samples // 2:
                middle = image
    if coloured and total is not None and (samples > 1 or noise is not None):
        exposure /= samples
        if noise is not None:
            electrons = noise.standard_normal((h, w, 3), np.float32).reshape(-1, 3)
            total = _noisy(total, exposure, normal=electrons, camera=camera)
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
    settings: CameraSettings,
    rows: int | None = None,
    normals: bool = True,
) -> TracedView:
    """Rays and hits of pixels of a camera in one sample of the exposure.

    pixels  : numbers of pixels, row by row from the top
    rows    : rows of the image, where the camera is a finer one
    normals : whether the hits have normals
    """
    rays = _scaled_rays(camera, pixels, parts=camera.height // (rows or camera.height))
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
        precision=settings.precision,
        retrace=settings.retrace,
        footprint=(0.0, 1.0 / camera.fx),
        scattered=True,
    )
    if not seen.all():
        hits.range[~seen], hits.face[~seen], hits.instance[~seen], hits.cosine[~seen] = np.inf, -1, -1, 0
    return TracedView(poses.position, row, direction, seen, time, hits)


def _scaled_rays(camera: CameraSpec, pixels: _Pixels, *, parts: int) -> Float:
    """Directions of pixels whose ray parameter is the depth as defined in `CameraImage`.

    parts : pixels along each side of one of the image, as of `shade.places_in_pixels`
    """
    bent = camera.model == "fisheye" or any(camera.distortion)
    if bent and camera.width * camera.height <= _SHARED:
        return _shared_rays(camera, parts)[pixels]
    number = np.arange(pixels.start, pixels.stop) if isinstance(pixels, slice) else pixels
    if bent:
        return _bent_rays(camera, number, parts=parts)
    rays = np.empty((len(number), 3))
    shade.straight_rays(number, camera.width, parts, (camera.fx, camera.fy, camera.cx, camera.cy), rays)
    return rays


@functools.lru_cache(maxsize=16)
def _shared_rays(camera: CameraSpec, parts: int) -> Float:
    """Rays of all pixels, kept for the cameras of a rig, each with its finer one."""
    return _bent_rays(camera, np.arange(camera.width * camera.height), parts=parts)


def _bent_rays(camera: CameraSpec, number: NDArray[np.int64], *, parts: int) -> Float:
    """Rays of pixels of a lens with distortion."""
    rays = unproject(camera, shade.places_in_pixels(number, camera.width, parts=parts))
    return rays if camera.model == "fisheye" else rays / rays[:, 2:]


def radiance(
    world: World,
    view: TracedView,
    *,
    surfaces: Surfaces,
    light: Light,
    walls: RenderedFacades,
    blur: float,
    angle: float,
    settings: CameraSettings,
) -> NDArray[np.float32]:
    """Linear light (n, 3) along the rays of a view, in units of `Light`.

    surfaces    : what the rays hit
    blur, angle : a pixel is blur + angle * distance metres wide
    """
    wet = world.settings.wetness > 0
    fill = functools.partial(_shade, world, light=light, walls=walls, settings=settings)
    out, gloss, facet = fill(view, surfaces=surfaces, size=(blur, angle), wet=wet)
    row = np.flatnonzero(gloss > _GLOSS)
    if len(row):
        mirror = _mirrored_view(world, view, row=row, facet=facet[row], settings=settings)
        size = float(angle * np.median(view.hits.range[row])), angle
        seen, _, _ = fill(mirror, surfaces=world.lookup(mirror.hits), size=size, wet=False)
        out[row] += gloss[row, None] * seen
    return out


def _mirrored_view(
    world: World,
    view: TracedView,
    *,
    row: NDArray[np.intp],
    facet: NDArray[np.float32],
    settings: CameraSettings,
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
        start, towards, far=world.reach, time=time, normals=True, retrace=settings.retrace
    )
    each = np.arange(len(row), dtype=np.int32)
    return TracedView(start, each, towards, np.ones(len(row), np.bool_), time, hits)


def _shade(
    world: World,
    view: TracedView,
    *,
    surfaces: Surfaces,
    light: Light,
    walls: RenderedFacades,
    size: tuple[float, float],
    settings: CameraSettings,
    wet: bool,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Linear light (n, 3) along the rays of a view, and gloss (n,) and normals (n, 3) of wet surfaces.

    size : width of a pixel at distance 0 in metres, and its growth with distance
    wet  : whether films of water mirror, as `lidar.sensors.camera.shade.shade` describes
    """
    hits = view.hits
    n = len(hits)
    surfaces, wall = walls_of(walls, surfaces, hits=hits)
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
        if settings.shadows:
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
        _drawn(world, view, found=surfaces, size=size) if settings.detail else surfaces.color,
        surfaces.feature,
        wall,
        walls,
        lit,
        light.columns,
        (*shade.material_tables(), shade.linear_table()),
        (*size, 3.912 / settings.haze, settings.detail),
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
        out[rows] += seen * np.exp(-3.912 / settings.haze * away)[:, None].astype(np.float32)
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
    return _on_bodies(point, view.hits.instance[rows], world=world, time=time)


def _drawn(
    world: World, view: TracedView, *, found: Surfaces, size: tuple[float, float]
) -> NDArray[np.uint8]:
    """Colours (n, 3) of the visible surfaces, with signs, plates and clothes drawn on instances."""
    hits = view.hits
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
    light: NDArray[np.float32], exposure: float, *, normal: NDArray[np.float32], camera: CameraSpec
) -> NDArray[np.float32]:
    """Light with shot noise and read noise."""
    electrons = np.minimum(light * exposure, 1.0) * camera.full_well
    spread = np.sqrt(electrons + camera.read_noise**2) / camera.full_well
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
        settings=PLAIN,
        normals=False,
    )
    hit = np.isfinite(view.hits.range)
    point = view.origin[view.row] + np.where(hit, view.hits.range, 1.0)[:, None] * view.direction
    on = np.flatnonzero(view.hits.instance >= 0)
    instance = view.hits.instance[on]
    body = _on_bodies(point[on], instance, world=world, time=start[view.row[on]])
    row = view.row
    for _ in range(_ROLLS if rows > 1 else 1):
        there = later.take(row if rows > 1 else [0])
        place = _transforms(world, instance, time=end[row[on]])
        moved = point.copy()
        moved[on] = np.einsum("nij,nj->ni", place[:, :, :3], body) + place[:, :, 3]
        away = np.where(hit[:, None], moved - there.position, view.direction)
        seen = np.einsum("ni,nij->nj", away / there.scale, np.broadcast_to(there.rotation, (len(away), 3, 3)))
        pixel, _ = project(camera, np.where(view.seen[:, None], seen, np.nan))
        row = np.clip(np.rint(np.nan_to_num(pixel[:, 1])), 0, rows - 1).astype(np.int64)
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    flow: NDArray[np.float32] = (pixel - np.stack([u.ravel(), v.ravel()], axis=1)).astype(np.float32)
    return flow.reshape(camera.height, camera.width, 2)


def _on_bodies(point: Float, instance: NDArray[np.int32], *, world: World, time: Float) -> Float:
    """Points (k, 3) at ray times (k,), in the own frames of instances (k,)."""
    place = _transforms(world, instance, time=time)
    offset = (point - place[:, :, 3])[..., None]
    return np.linalg.solve(place[:, :, :3], offset)[..., 0].astype(np.float64)


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
