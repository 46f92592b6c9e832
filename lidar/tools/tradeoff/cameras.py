"""Errors and costs of the settings of a camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

from geoscene.support.progress import Progress
from geoscene.typing import Ints
from lidar.options import TradeoffOptions
from lidar.sensors.camera.settings import CameraSettings
from lidar.sensors.rig.devices import Camera
from lidar.tools.tradeoff.comparison import SensorComparison
from lidar.tools.tradeoff.costs import costs
from lidar.tools.tradeoff.errors import IMAGE_STATISTICS, ErrorEstimate, ImageError, estimates
from lidar.tools.tradeoff.images import (
    BLOCK,
    Pixels,
    Shot,
    blocks_of_frame,
    image_cost,
    image_error,
    pixels,
)
from lidar.tools.tradeoff.notes import Notes
from lidar.tools.tradeoff.simulate import EXACT, FAST, Bench
from lidar.tools.tradeoff.variants import (
    CAMERA_VALUES,
    OF_EMBREE,
    SettingVariant,
    camera_basis,
    camera_variants,
    coarser,
    without_each,
)
from lidar.world.settings import PLAIN as WHOLE
from lidar.world.settings import WorldSettings

_PART = slice(None, None, 4)
"""Of the blocks, those on which settings are compared alone: each costs as much as the reference."""


def compared_camera(
    bench: Bench, camera: Camera, *, compared: TradeoffOptions, scenes: Sequence[str], progress: Progress
) -> SensorComparison:
    """The comparison of a camera; ``scenes`` are labels of the scenes after the first."""
    plan, chosen = bench.plan, bench.plan.options.recording_settings
    exposed = camera.spec.exposure_ns > 0
    basis = camera_basis(chosen.camera, exposed=exposed, world=chosen.world, built=plan.scene.relief)
    variants = camera_variants(
        basis, compared=compared.compare, scenes=scenes, traffic=plan.actors is not None
    )
    frames = bench.frames[camera.name]
    per_frame = -(-compared.pixels // (len(frames) * BLOCK**2))
    used: list[list[ImageError]] = [[] for _ in variants]
    alone: list[list[ImageError]] = [[] for _ in variants]
    reduced: list[list[ImageError]] = [[] for _ in variants]
    residual: list[ImageError] = []
    notes = Notes(bench, camera, variants=variants)
    count = 0
    for k, frame in enumerate(frames):
        blocks = blocks_of_frame(camera.spec, per_frame, frame=frame, seed=plan.options.seed)
        count += len(blocks) * BLOCK**2
        look, part = (_Look(bench, bench.shot(camera, frame), of) for of in (blocks, blocks[_PART]))
        truth, less = (
            look.pixels(basis.variant(), settings, world=WHOLE, backend=EXACT)
            for settings in (basis.exact, coarser(basis.exact))
        )
        residual.append(image_error(less, truth))
        for i, variant in enumerate(variants):
            progress(f"comparing {camera.name}", k * len(variants) + i, total=len(frames) * len(variants))
            found, factor = look.used(variant), variant.resolution
            used[i].append(image_error(found.enlarged(factor), truth))
            if factor > 1:
                reduced[i].append(image_error(found, truth.reduced(factor)))
            for change, rest in without_each(basis, variant):
                notes.add(i, change, same=found.equals(look.used(rest)))
            if len(variant.changes) == 1:
                alone[i].append(image_error(part.alone(variant).enlarged(factor), truth.take(_PART)))
    spent = costs(
        bench,
        camera,
        variants=variants,
        frame_cost=lambda frame, world, variant: image_cost(
            bench.shot(camera, frame), world=world, settings=variant.used, resolution=variant.resolution
        ),
        repetitions=compared.repetitions,
        progress=progress,
    )

    figures = partial(estimates, seed=plan.options.seed, statistics=IMAGE_STATISTICS)
    rows = notes.rows(
        basis.described(CAMERA_VALUES),
        used=[figures(errors) for errors in used],
        alone=[figures(errors) for errors in alone],
        spent=spent,
        further=[_against_means(figures(errors)) for errors in reduced],
    )
    moments = basis.exact.moments(camera.spec)
    return SensorComparison(
        f"{camera.name} ({camera.spec.width} x {camera.spec.height} pixels)",
        f"float64 ray casting, {basis.exact.supersample**2 * moments} rays per pixel, shadows and detail;"
        " about half as many rays",
        figures(residual),
        rows,
        count,
        len(frames),
        "camera",
    )


def _against_means(error: dict[str, ErrorEstimate]) -> str:
    """What an image of lower resolution is off as an image of its own."""
    if not error:
        return ""
    rgb, depth, klass = (error[name].value for name in ("rgb_rms", "depth_99.9_m", "class_changes"))
    return (
        f"enlarged; against means of the reference's pixels: {rgb:.2g} levels rms, depth {depth:.2g} m at"
        f" 99.9 %, class {100 * klass:.2g} %"
    )


@dataclass(frozen=True, slots=True)
class _Look:
    """Some blocks of a frame, to be rendered with different settings."""

    bench: Bench
    shot: Shot
    blocks: Ints
    _known: dict[tuple[tuple[str, object], ...], Pixels] = field(default_factory=dict)

    def pixels(
        self,
        variant: SettingVariant[CameraSettings],
        settings: CameraSettings,
        *,
        world: WorldSettings,
        backend: str,
    ) -> Pixels:
        """The pixels of these blocks in the scene, with the traffic and of the size of a variant."""
        around = self.bench.world(
            self.shot.camera,
            self.shot.frame,
            backend=backend,
            scene=variant.scene,
            traffic=variant.traffic,
            settings=world,
        )
        return pixels(self.shot, self.blocks, world=around, settings=settings, resolution=variant.resolution)

    def used(self, variant: SettingVariant[CameraSettings]) -> Pixels:
        """The pixels with the user's settings, changed as in a variant."""
        if variant.changes not in self._known:
            self._known[variant.changes] = self.pixels(
                variant, variant.used, world=variant.world, backend=FAST
            )
        return self._known[variant.changes]

    def alone(self, variant: SettingVariant[CameraSettings]) -> Pixels:
        """The pixels of the reference, changed as in a variant."""
        backend = FAST if variant.names <= OF_EMBREE else EXACT
        return self.pixels(variant, variant.alone, world=variant.alone_world, backend=backend)
