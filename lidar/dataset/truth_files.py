"""Truth files of stages, as later stages, filters and scores read them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from geoscene.support.untrusted import read_arrays
from lidar.dataset.layout import reading_file


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
