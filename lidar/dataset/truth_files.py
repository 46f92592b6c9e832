"""Truth files of stages, as later stages, filters and scores read them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from geoscene.support.untrusted import read_arrays
from lidar.dataset.layout import reading_file
from lidar.sensors.cloud import Cloud
from lidar.signal.past import Past, past_of


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


def read_past(path: Path, cloud: Cloud) -> Past:
    """A recorded cloud with what its truth file, if there is one, tells; see `lidar.signal.past.past_of`.

    Raises DatasetError for a file that is damaged or of another cloud.
    """
    truth = read_truth(path, count=len(cloud))
    with reading_file(path):
        return past_of(cloud, truth)
