"""Settings of cameras: how their images are rendered."""

from __future__ import annotations

from dataclasses import dataclass

from lidar.parameters import check_parameters, parameter
from lidar.raycast import PRECISIONS
from lidar.sensors.rig.specs import CameraSpec


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """Settings of images. The defaults are a camera without noise, and one ray per pixel but four at edges.

    Raises InputError for values that are out of bounds.
    """

    precision: str = parameter("exact", "precision of the depths of pixels", among=PRECISIONS)
    retrace: bool = parameter(
        default=True,
        meaning="trace pixels that miss a second time, as rays towards a vertex may pass between faces",
    )
    shadows: bool = parameter(default=True, meaning="the sun casts shadows")
    detail: bool = parameter(
        default=True, meaning="windows, joints and grain are drawn on surfaces of uniform colour"
    )
    supersample: int = parameter(1, "rays along each side of a pixel, for colour", low=1, high=16)
    edge_rays: int = parameter(
        2, "the same for pixels at edges, where it is more than supersample", low=1, high=16
    )
    blur: int = parameter(
        5,
        "samples of the exposure (the camera's exposure_ns) that are averaged: motion blur",
        low=1,
        high=64,
    )
    haze: float = parameter(
        20_000.0,
        "distance at which haze removes 98 % of contrast; unlimited: clear air",
        unit="m",
        low=1e-3,
        endless="unlimited",
    )
    cloud: float = parameter(
        0.3, "share of the sky that clouds cover; overcast light casts no shadows", low=0, high=1
    )
    camera_noise: bool = parameter(
        default=False, meaning="shot noise and read noise (the camera's full_well, read_noise)"
    )

    def __post_init__(self) -> None:
        """Validate the settings; one InputError names all faults."""
        check_parameters(self)

    def moments(self, camera: CameraSpec) -> int:
        """Number of samples of an exposure that are rendered."""
        return self.blur if camera.exposure_ns else 1


PLAIN = CameraSettings()
"""A sharp, clean image."""

LEVELS: dict[str, CameraSettings] = {
    "standard": PLAIN,
    "survey": CameraSettings(supersample=2, blur=9, camera_noise=True),
}
"""Settings by fidelity level."""
