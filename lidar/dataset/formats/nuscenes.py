"""nuScenes' clouds and its point labels (lidarseg), as its development kit reads them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import class_codes
from geoscene.files import write_atomically
from lidar.dataset.formats.table import Table


def write_nuscenes(path: Path, table: Table) -> None:
    """Write x, y, z (metres, sensor frame), intensity (0 to 255) and ring as little-endian float32."""
    columns = [table[name].astype("<f4") for name in ("x", "y", "z", "intensity", "ring")]
    write_atomically(path, np.stack(columns, axis=1).tobytes())


def write_lidarseg(path: Path, klass: NDArray[np.integer]) -> None:
    """Write a lidarseg class a point as uint8; ``klass`` (n,) is `geoscene.classes.Class`."""
    write_atomically(path, class_codes().nuscenes[klass].astype(np.uint8).tobytes())
