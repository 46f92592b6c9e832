"""Rasters of scenes."""

import numpy as np

from geoscene.export.raster import RasterGrid, _cells_on_disk


def test_cells_on_disk_have_their_space_before_they_are_mapped(tmp_path):
    grid = RasterGrid(0.0, 0.0, 1.0, 700, 1300)
    cells = _cells_on_disk(tmp_path / "cells", grid, value=np.float32(np.nan))
    assert cells.shape == (1300, 700)
    assert np.isnan(cells).all()
    stat = (tmp_path / "cells").stat()
    assert stat.st_blocks * 512 >= stat.st_size == 4 * 700 * 1300
