"""Point clouds of nuScenes and its point labels (lidarseg), as its development kit reads them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geoscene.classes import class_codes
from geoscene.support.files import write_atomically
from lidar.dataset.formats.table import PointLabels, Table, check_column, columns_as_rows, read_rows
from lidar.errors import FormatError

_COLUMNS = ("x", "y", "z", "intensity", "ring")


def write(path: Path, table: Table) -> None:
    """Write x, y, z (metres, sensor frame), intensity (0 to 255) and ring as little-endian float32."""
    write_atomically(path, columns_as_rows(table, _COLUMNS))


def read(path: Path) -> Table:
    """The table x, y, z, intensity (float32) and ring (uint16) of a file.

    Raises FormatError for a file whose length is not a multiple of 20 bytes, intensities outside of 0 to 255,
    and rings that are no numbers of rings.
    """
    table = dict(zip(_COLUMNS, read_rows(path, len(_COLUMNS)).T, strict=True))
    ring = table["ring"]
    check_column(path, table["intensity"], name="intensity", highest=255)
    if len(bad := np.flatnonzero((ring < 0) | (ring > 65535) | (ring != np.rint(ring)))):
        raise FormatError(
            f"{path}: row {bad[0]} has ring {ring[bad[0]]:g}, as have {len(bad)} a wrong one in all"
        )
    return table | {"ring": table["ring"].astype(np.uint16)}


def count(path: Path) -> int:
    """Number of points of a file."""
    return path.stat().st_size // (4 * len(_COLUMNS))


def write_labels(path: Path, labels: PointLabels) -> None:
    """Write the lidarseg class of each point as uint8."""
    write_atomically(path, class_codes().nuscenes[labels.klass].astype(np.uint8))
