"""A recorded drive as a ROS 2 recording whose messages are in a SQLite database, as older tools read them."""

from __future__ import annotations

from pathlib import Path

from geoscene.support.progress import Progress
from lidar.dataset.layout import Dataset
from lidar.dataset.layouts.ros2 import message_counts, write_recording


def export(dataset: Dataset, folder: Path, *, progress: Progress) -> dict[str, int]:
    """Write ``metadata.yaml`` and ``drive.db3``; return the numbers of messages by what they are.

    Raises DatasetError for damaged files, and MissingExtraError without rosbags.
    """
    return message_counts(write_recording(dataset, folder, storage="SQLITE3", progress=progress))
