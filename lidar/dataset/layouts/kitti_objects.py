"""Labels of KITTI's object benchmark: road users in a camera's image, a line each (Geiger et al. 2012).

``type truncated occluded alpha left top right bottom height width length x y z rotation_y``: the 2D box in
pixels, the 3D box in true metres and the frame of the reference camera (x right, y down, z forward), its
position being the middle of its lower face; angles in radians.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from geoscene.classes import Class
from geoscene.typing import Float
from lidar.dataset.layouts.kitti_drive import KittiDrive
from lidar.geometry.attitude import matrix_from_quat

TYPES = {
    Class.CAR: "Car",
    Class.VAN: "Van",
    Class.TRUCK: "Truck",
    Class.CYCLIST: "Cyclist",
    Class.PEDESTRIAN: "Pedestrian",
}
"""KITTI's types; other road users are ``Misc``."""

_VISIBLE = (0.4, 0.8)
"""Shares of visible pixels below which an object is largely (2) and partly (1) occluded: assumed."""
_NEAR = 0.1
"""Metres before the camera at which boxes are cut off."""

CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)])
_EDGES = np.array([[a, b] for a in range(8) for b in (a ^ 1, a ^ 2, a ^ 4) if b > a])


def object_lines(
    drive: KittiDrive, *, number: int, row: int, image_boxes: Mapping[int, Mapping[str, Any]]
) -> dict[int, str]:
    """The line of each road user of which pixels are visible in a frame's image, by its number, in order.

    number      : of the camera
    image_boxes : 2D boxes in the image, by road user
    """
    boxes = drive.boxes.get(int(drive.clouds.frames[row]), {})
    seen = [key for key in sorted(boxes.keys() & image_boxes.keys()) if image_boxes[key]["pixels"]]
    sensor = drive.cameras[number].sensor
    pose = drive.trajectory.at([int(drive.clouds.time_ns[row])])
    camera = pose.mounted(drive.reference.translation, drive.reference.rotation)
    lines = {}
    for key in seen:
        box, flat = boxes[key], image_boxes[key]
        turn = camera.rotation[0].T @ matrix_from_quat([box[k] for k in ("qx", "qy", "qz", "qw")])
        middle = (
            (np.array([box[k] for k in "xyz"]) - camera.position[0]) / camera.scale[0] @ camera.rotation[0]
        )
        size = np.array([box[k] for k in ("length", "width", "height")])
        bottom = middle - turn[:, 2] * size[2] / 2
        yaw = np.arctan2(-turn[2, 0], turn[0, 0])
        corners = bottom + (CORNERS * size) @ turn.T
        side = np.array([sensor["width"], sensor["height"]] * 2) - 1
        values = [
            truncation(corners, drive.projections[number], sides=side[:2]),
            len(_VISIBLE) - int(np.searchsorted(_VISIBLE, flat["visibility"], side="right")),
            _wrap(yaw - np.arctan2(bottom[0], bottom[2])),
            *np.clip([flat[k] for k in ("left", "top", "right", "bottom")], 0, side),
            *size[[2, 1, 0]],
            *bottom,
            yaw,
        ]
        kind = TYPES.get(Class[box["class"].upper()], "Misc")
        lines[key] = " ".join([kind, *(str(v) if isinstance(v, int) else f"{v:.4f}" for v in values)])
    return lines


def truncation(corners: Float, projection: Float, *, sides: Float) -> float:
    """Share of the rectangle around a box's projection that is outside the image; 1 behind the camera.

    corners : (8, 3), the reference camera's frame; bits of their numbers tell the sides x, y and z
    sides   : (2,) greatest pixel coordinates of the image
    """
    if (found := outline(corners, projection)) is None:
        return 1.0
    low, high = found
    inside = np.clip(np.minimum(high, sides) - np.maximum(low, 0), 0, None)
    return float(1 - inside.prod() / (high - low).prod())


def outline(corners: Float, projection: Float) -> tuple[Float, Float] | None:
    """Least and greatest pixels (2,) of the projection of a box's corners (8, 3); None behind the camera."""
    points = np.column_stack([corners, np.ones(8)]) @ projection.T
    ends = points[_EDGES]
    depth = ends[..., 2]
    before = (depth > _NEAR).any(axis=1)
    if not before.any():
        return None
    ends, depth = ends[before], depth[before]
    across = np.clip((_NEAR - depth) / np.where(depth[:, ::-1] == depth, 1.0, depth[:, ::-1] - depth), 0, 1)
    ends = ends + (ends[:, ::-1] - ends) * across[..., None]
    pixels = (ends[..., :2] / ends[..., 2:]).reshape(-1, 2)
    return pixels.min(axis=0), pixels.max(axis=0)


def _wrap(angle: float) -> float:
    """An angle within -pi and pi."""
    return float(np.remainder(angle + np.pi, 2 * np.pi) - np.pi)
