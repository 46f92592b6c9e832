"""Settings of cameras: how their images are rendered."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING

from lidar.errors import InputError
from lidar.raycast import PRECISIONS
from lidar.sensors.rig.specs import CameraSpec

if TYPE_CHECKING:
    from lidar.sensors.camera.render import RenderOptions


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """Settings of images. The defaults are a camera without noise, and one ray per pixel but four at edges.

    precision    : of the depths of pixels, of `lidar.raycast.PRECISIONS`
    retrace      : trace pixels that miss a second time, as rays towards a vertex may pass between faces
    shadows      : the sun casts shadows
    detail       : windows, joints and grain are drawn on surfaces of uniform colour
    supersample  : rays along each side of a pixel, for colour: 1 to 16
    edge_rays    : the same for pixels at edges (`camera.edges`), where it is more than ``supersample``
    blur         : samples of the exposure (the camera's ``exposure_ns``) that are averaged: motion blur
    haze         : distance in metres at which haze removes 98 % of contrast; inf for clear air
    cloud        : share of the sky that clouds cover, 0 to 1; overcast light casts no shadows
    camera_noise : shot noise and read noise (the camera's ``full_well``, ``read_noise``)
    """

    precision: str = "exact"
    retrace: bool = True
    shadows: bool = True
    detail: bool = True
    supersample: int = 1
    edge_rays: int = 2
    blur: int = 5
    haze: float = 20_000.0
    cloud: float = 0.0
    camera_noise: bool = False

    def __post_init__(self) -> None:
        """Validate the settings; one InputError names all faults."""
        faults = []
        if self.precision not in PRECISIONS:
            faults.append(f"precision={self.precision}: known are {', '.join(PRECISIONS)}")
        if not 1 <= self.supersample <= 16:
            faults.append(f"supersample={self.supersample}: give 1 to 16")
        if not 1 <= self.edge_rays <= 16:
            faults.append(f"edge_rays={self.edge_rays}: give 1 to 16")
        if not 1 <= self.blur <= 64:
            faults.append(f"blur={self.blur}: give 1 to 64")
        if not self.haze > 0:
            faults.append(f"haze={self.haze}: give metres above 0, or inf")
        if not 0 <= self.cloud <= 1:
            faults.append(f"cloud={self.cloud:g}: give 0 to 1")
        if faults:
            raise InputError("; ".join(faults))

    def moments(self, camera: CameraSpec) -> int:
        """Number of samples of an exposure that are rendered."""
        return self.blur if camera.exposure_ns else 1

    def options(self, camera: CameraSpec) -> RenderOptions:
        """The renderer's options for a camera."""
        from lidar.sensors.camera.render import RenderOptions  # noqa: PLC0415  (0.1 s)

        return RenderOptions(
            precision=self.precision,
            retrace=self.retrace,
            shadows=self.shadows,
            detail=self.detail,
            supersample=self.supersample,
            edge_rays=self.edge_rays,
            visibility=self.haze,
            cloud=self.cloud,
            exposure=camera.exposure_ev,
            full_well=camera.full_well if self.camera_noise else inf,
            read_noise=camera.read_noise,
        )


PLAIN = CameraSettings()
"""A sharp, clean image."""

LEVELS: dict[str, CameraSettings] = {
    "standard": PLAIN,
    "survey": CameraSettings(supersample=2, blur=9, camera_noise=True),
}
"""Settings by fidelity level."""
