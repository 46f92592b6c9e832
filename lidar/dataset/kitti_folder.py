"""Folders in KITTI's layouts that other programs wrote: camera 2 of a cloud, in which objects are labelled.

Calibrations are those of the object benchmark (``calib/000000.txt``), of tracking (``calib/0000.txt``), of
odometry (``calib.txt``) or of raw recordings (``calib_velo_to_cam.txt`` and ``calib_cam_to_cam.txt``).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from geoscene.errors import reading, reason_of
from geoscene.typing import Float
from lidar.errors import FormatError

_RAW = "calib_velo_to_cam.txt"
_LEVELS = 4
"""Folders above a cloud in which the calibration of a raw recording is looked for."""
_RIGID = 1e-3
"""Largest error of a rotation's product with its transpose; files have six digits and more."""


@dataclass(frozen=True, slots=True)
class CameraView:
    """Camera 2 as seen from a scanner.

    camera_from_lidar : (4, 4) from the scanner's frame to the rectified one of the reference camera
    projection        : (3, 4) from that frame to pixels
    size              : (2,) width and height of the image in pixels; None without an image
    """

    camera_from_lidar: Float
    projection: Float
    size: Float | None


@dataclass(frozen=True, slots=True)
class _Calibration:
    """The rows of a calibration file by name."""

    path: Path
    rows: dict[str, str]

    def matrix(self, *names: str, shape: tuple[int, int], turns: bool = False) -> Float:
        """The first of some rows as a matrix.

        turns : whether its first three columns are a rotation

        Raises FormatError for a row that is missing or no such matrix.
        """
        name = next((name for name in names if name in self.rows), "")
        if not name:
            raise FormatError(f"{self.path}: has no row {' or '.join(names)}; give KITTI's calibration")
        try:
            values = np.array([float(word) for word in self.rows[name].split()])
        except ValueError as error:
            raise FormatError(f"{self.path}: {name}: {reason_of(error)}") from None
        if len(values) != shape[0] * shape[1]:
            raise FormatError(f"{self.path}: {name} has {len(values)} numbers, not {shape[0] * shape[1]}")
        if not np.isfinite(values).all():
            raise FormatError(f"{self.path}: {name} has a number that is not finite")
        matrix: Float = values.reshape(shape)
        if turns:
            turn = matrix[:, :3]
            if not np.allclose(turn @ turn.T, np.eye(3), atol=_RIGID):
                raise FormatError(f"{self.path}: {name} holds no rotation")
            if np.linalg.det(turn) < 0:
                raise FormatError(f"{self.path}: {name} mirrors: the determinant of its rotation is -1")
        return matrix


def camera_view(cloud: Path) -> CameraView | None:
    """Camera 2 of a cloud; None without a calibration.

    Raises FormatError for a damaged calibration or image.
    """
    folder = _velodyne_folder(cloud.absolute())
    place, root = cloud.absolute().parent.relative_to(folder), folder.parent
    found = (root / "calib" / f"{cloud.stem}.txt", root / "calib" / f"{place.name}.txt", root / "calib.txt")
    if (path := next(filter(Path.is_file, found), None)) is not None:
        calibration = _read(path)
        placed = calibration.matrix("Tr_velo_to_cam", "Tr_velo_cam", "Tr", shape=(3, 4), turns=True)
        projection = calibration.matrix("P2", shape=(3, 4))
        # Of odometry, Tr is to the rectified frame.
        needed = "R0_rect", "R_rect"
        rectified = "Tr" not in calibration.rows or any(name in calibration.rows for name in needed)
        turn = calibration.matrix(*needed, shape=(3, 3), turns=True) if rectified else np.eye(3)
    else:
        above = next((f for f in cloud.absolute().parents[:_LEVELS] if (f / _RAW).is_file()), None)
        if above is None:
            return None
        calibration, cameras = _read(above / _RAW), _read(above / "calib_cam_to_cam.txt")
        turned = calibration.matrix("R", shape=(3, 3), turns=True)
        placed = np.column_stack([turned, calibration.matrix("T", shape=(3, 1))])
        projection = cameras.matrix("P_rect_02", shape=(3, 4))
        turn = cameras.matrix("R_rect_00", shape=(3, 3), turns=True)
    if not (projection[0, 0] > 0 and projection[1, 1] > 0):
        raise FormatError(f"{path or above}: the focal length of camera 2 is not positive")
    camera_from_lidar = np.vstack([turn @ placed, [0, 0, 0, 1]])
    return CameraView(camera_from_lidar, projection, _image_size(root, place, stem=cloud.stem))


def _velodyne_folder(cloud: Path) -> Path:
    """The folder of a scanner above a cloud, else that of the cloud."""
    named = (folder for folder in cloud.parents if folder.name.startswith("velodyne"))
    return next(named, cloud.parent)


def _read(path: Path) -> _Calibration:
    """The rows of a calibration: ``name: values`` or ``name values``."""
    with reading(path, FormatError, remedy="give KITTI's calibration", known=FormatError):
        words = (line.split(maxsplit=1) for line in path.read_text("utf-8-sig").splitlines())
        rows = {row[0].rstrip(":"): row[1] for row in words if len(row) == 2}
    return _Calibration(path, rows)


def _image_size(root: Path, place: Path, *, stem: str) -> Float | None:
    """Width and height (2,) in pixels of the image of camera 2, if there is one."""
    named = (
        root / name / place / f"{stem}{end}" for name in ("image_2", "image_02") for end in (".png", ".jpg")
    )
    if (path := next(filter(Path.is_file, named), None)) is None:
        return None
    with (
        reading(path, FormatError, remedy="give a PNG or JPEG image", known=FormatError),
        Image.open(path) as image,
    ):
        return np.array(image.size, float)
