"""Time and size of ROS 2 recordings (MCAP), against rosbags alone with the same messages in memory.

    python benchmarks/ros_export.py DRIVE --repetitions 5

Both sides write every message of the drive, by turns: once uncounted, then in each repetition beginning with
the other side. The export reads the drive's files and makes the messages one after the other; for rosbags
they are made before, and it encodes and writes them with the same compression.

MB/s     encoded messages, 10^6 bytes, over CPU time
points/s points of clouds over CPU time
B/point  size of the file over points of clouds
"""

from __future__ import annotations

import argparse
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from geoscene.support.progress import silent
from lidar.dataset.layout import Dataset, open_dataset
from lidar.dataset.layouts import ros2
from lidar.dataset.layouts.ros_messages import encode, typestore
from lidar.dataset.layouts.ros_topics import RosDrive, Topic, topics_of

Messages = list[tuple[int, int, Any]]


def in_memory(dataset: Dataset) -> tuple[list[Topic], Messages]:
    """The topics of a drive, and its messages: time in nanoseconds since 1970, row of the topic, message."""
    drive = RosDrive(dataset)
    topics = topics_of(drive)
    return topics, [(drive.stamp(time_ns), k, make()) for time_ns, k, make in ros2.merge_messages(topics)]


def write_alone(folder: Path, topics: list[Topic], *, messages: Messages) -> None:
    """Write messages by rosbags alone."""
    bag = Writer(folder / "drive", version=8, storage_plugin=StoragePlugin.MCAP)
    bag.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    store = typestore()
    with bag:
        connections = [bag.add_connection(t.name, t.kind, typestore=store) for t in topics]
        for log_ns, k, message in messages:
            bag.write(connections[k], log_ns, store.serialize_cdr(message, topics[k].kind))


def measured(side: Callable[[Path], object]) -> tuple[float, int]:
    """Seconds of CPU time that a side needs, and the size of the file of messages."""
    folder = Path(tempfile.mkdtemp(prefix="ros_export"))
    began = time.process_time()
    side(folder)
    seconds = time.process_time() - began
    size = max(path.stat().st_size for path in folder.rglob("drive.*"))
    shutil.rmtree(folder)
    return seconds, size


def main(arguments: list[str] | None = None) -> None:
    """Print a row for each storage and side."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("drive", type=Path)
    parser.add_argument("--repetitions", type=int, default=5)
    given = parser.parse_args(arguments)
    dataset = open_dataset(given.drive)
    topics, messages = in_memory(dataset)
    volume = sum(len(encode(message)) for _, _, message in messages)
    points = sum(message.width for _, k, message in messages if topics[k].kind.endswith("PointCloud2"))
    print(f"{len(messages):,} messages, {volume / 1e6:.1f} MB, {points:,} points")
    sides: dict[str, Callable[[Path], object]] = {
        "export": lambda folder: ros2.write_recording(dataset, folder, progress=silent),
        "rosbags": lambda folder: write_alone(folder, topics, messages=messages),
    }
    seconds: dict[str, list[float]] = {name: [] for name in sides}
    sizes = {name: measured(side)[1] for name, side in sides.items()}
    for repetition in range(given.repetitions):
        for name in list(sides)[:: -1 if repetition % 2 == 0 else 1]:
            seconds[name].append(measured(sides[name])[0])
    for name, spent in seconds.items():
        middle = statistics.median(spent)
        print(
            f"{name:9}{middle:7.2f} s ({min(spent):.2f} to {max(spent):.2f})"
            f"{volume / middle / 1e6:8.1f} MB/s{points / middle:12,.0f} points/s"
            f"{sizes[name] / max(points, 1):8.2f} B/point"
        )


if __name__ == "__main__":
    main()
