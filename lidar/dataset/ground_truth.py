"""Ground truth of a dataset: bounding boxes of road users (3D, and 2D in images), and changes by stages."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.support.untrusted import read_arrays
from lidar.dataset.layout import read_rows, reading_file

COLUMNS = (
    *("frame", "time_ns", "id", "instance", "class", "kind", "x", "y", "z", "yaw", "qx", "qy", "qz", "qw"),
    *("length", "width", "height", "vx", "vy", "vz", "ego_x", "ego_y", "ego_z", "ego_yaw"),
    *("ego_vx", "ego_vy", "ego_vz", "moving"),
)
"""Columns of `box_rows`, in order."""

_TEXT = ("class", "kind")
_WHOLE = ("frame", "time_ns", "id", "instance", "points", "pixels")


def read_boxes(path: Path, columns: Collection[str]) -> list[dict[str, Any]]:
    """The rows of a file of boxes: texts, whole numbers, ``moving`` as a boolean, and floats.

    columns : that the file must have

    Raises DatasetError for a missing or damaged file.
    """
    rows = read_rows(path)
    with reading_file(path):
        boxes = [{name: _value(name, text) for name, text in row.items()} for row in rows]
        for box in boxes:
            _ = Class[str(box["class"]).upper()], [box[name] for name in columns]
            if not all(np.isfinite(box[name]) for name in columns if name not in _TEXT):
                raise ValueError(f"road user {box['id']} of frame {box['frame']} has no finite box")
    return boxes


def boxes_by_frame(
    path: Path, columns: Collection[str], *, key: str = "id"
) -> dict[int, dict[int, dict[str, Any]]]:
    """The rows of a file of boxes by frame and road user (``id`` or ``instance``); none without the file.

    Raises DatasetError for a damaged file.
    """
    found: dict[int, dict[int, dict[str, Any]]] = defaultdict(dict)
    for box in read_boxes(path, columns) if path.exists() else ():
        found[box["frame"]][box[key]] = box
    return found


def _value(name: str, text: str) -> str | int | float | bool:
    if name in _TEXT:
        return text
    if name == "moving":
        return {"True": True, "False": False}[text]
    return int(text) if name in _WHOLE else float(text)


def read_truth(path: Path, *, count: int | None = None) -> dict[str, NDArray[Any]] | None:
    """The columns of a truth file of a cloud or an image; None if there is none.

    count : returns of the cloud

    Raises DatasetError for a file that is damaged or of another cloud.
    """
    if not path.exists():
        return None
    with reading_file(path):
        truth = read_arrays(path)
        if count is not None and len(truth["origin"]) != count:
            raise ValueError(f"is of {len(truth['origin'])} returns, the cloud has {count}")
    return truth
