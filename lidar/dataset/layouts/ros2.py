"""A recorded drive as an MCAP file of ROS 2 messages: a recording of ROS 2, or with a layout for Foxglove."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any

from geoscene.errors import need
from geoscene.support.files import write_json
from geoscene.support.progress import Progress
from lidar.dataset.layout import Dataset, reading_file
from lidar.dataset.layouts.ros_messages import encode, typestore
from lidar.dataset.layouts.ros_topics import BASE, MAP, ODOMETRY, RosDrive, RosOptions, Topic, topics_of

NAME = "drive"
"""Name of the file of messages."""

_VERSION = 8
"""Of the metadata: the newest that writes qualities of service as ROS 2 Humble reads them."""


def export(dataset: Dataset, folder: Path, *, progress: Progress, options: RosOptions) -> dict[str, int]:
    """Write ``metadata.yaml`` and ``drive.mcap``; return the numbers of messages by type.

    Raises DatasetError for damaged files, and MissingExtraError without rosbags.
    """
    return message_counts(write_recording(dataset, folder, progress=progress, options=options))


def write_recording(
    dataset: Dataset, folder: Path, *, progress: Progress, options: RosOptions
) -> list[Topic]:
    """Write the topics of a dataset, ordered by time, into an empty folder; return the topics.

    The file of messages is MCAP with chunks compressed by zstd.
    """
    rosbag2 = need("rosbags.rosbag2", "ros")
    drive = RosDrive(dataset, options)
    topics = topics_of(drive)
    bag = rosbag2.Writer(folder / NAME, version=_VERSION, storage_plugin=rosbag2.StoragePlugin.MCAP)
    bag.set_compression(rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD)
    for key, text in _about(drive).items():
        bag.set_custom_data(key, text)
    total = sum(len(topic.time_ns) for topic in topics)
    with bag:
        connections = [_connection(bag, topic) for topic in topics]
        for done, (time_ns, k, make) in enumerate(merge_messages(topics)):
            bag.write(connections[k], drive.stamp(time_ns), encode(make()))
            progress("ROS 2", done + 1, total=total)
    for path in list((folder / NAME).iterdir()):
        path.rename(folder / path.name)
    (folder / NAME).rmdir()
    return topics


def merge_messages(topics: list[Topic]) -> Iterator[tuple[int, int, Callable[[], Any]]]:
    """Messages in order of time, of equal times in the order of the topics."""

    def numbered(k: int, topic: Topic) -> Iterator[tuple[int, int, Callable[[], Any]]]:
        for row, time_ns in enumerate(topic.time_ns.tolist()):
            yield time_ns, k, partial(topic.make, row)

    return heapq.merge(*(numbered(k, topic) for k, topic in enumerate(topics)), key=itemgetter(0, 1))


def _connection(bag: Any, topic: Topic) -> Any:
    """Register a topic; subscribers of a latched one get its last message whenever they come."""
    qos = need("rosbags.interfaces", "ros")
    never = qos.QosTime(2147483647, 4294967295)
    durability = qos.QosDurability.TRANSIENT_LOCAL if topic.latched else qos.QosDurability.VOLATILE
    offered = qos.Qos(
        history=qos.QosHistory.KEEP_LAST,
        depth=1 if topic.latched else 10,
        reliability=qos.QosReliability.RELIABLE,
        durability=durability,
        deadline=never,
        lifespan=never,
        liveliness=qos.QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=never,
        avoid_ros_namespace_conventions=False,
    )
    return bag.add_connection(topic.name, topic.kind, typestore=typestore(), offered_qos_profiles=[offered])


def _about(drive: RosDrive) -> dict[str, str]:
    """Custom metadata of the recording: CRS, origin and scale of its map frame, and attribution."""
    dataset = drive.dataset
    with reading_file(dataset.paths.manifest):
        attribution = str(dataset.manifest["attribution"])
    east, north = dataset.frame.origin
    return {
        "attribution": attribution,
        f"{MAP}_crs": dataset.frame.wkt,
        f"{MAP}_origin": f"{east} {north}",
        f"{MAP}_scale": repr(float(drive.scale[0])),
    }


def message_counts(topics: list[Topic]) -> dict[str, int]:
    """Numbers of messages by type, for the summary."""
    counts: Counter[str] = Counter()
    for topic in topics:
        if topic.counted:
            counts[topic.counted] += len(topic.time_ns)
    return {"topics": len(topics), **counts}


def export_for_foxglove(
    dataset: Dataset, folder: Path, *, progress: Progress, options: RosOptions
) -> dict[str, int]:
    """Write ``drive.mcap`` and ``foxglove.json``; return the numbers of messages by type.

    Raises DatasetError for damaged files, and MissingExtraError without rosbags.
    """
    topics = write_recording(dataset, folder, progress=progress, options=options)
    (folder / "metadata.yaml").unlink()
    write_json(folder / "foxglove.json", layout(topics))
    return message_counts(topics)


def layout(topics: list[Topic]) -> dict[str, Any]:
    """A layout of Foxglove: the scene around the vehicle, images, its speed and, with fixes, a map."""
    panels: dict[str, dict[str, Any]] = {"3D!scene": _scene(topics)}
    for topic in topics:
        if topic.name.endswith("/image_raw/compressed"):
            camera = topic.name.split("/")[1]
            panels[f"Image!{camera}"] = {
                "imageMode": {"imageTopic": topic.name, "calibrationTopic": f"/{camera}/camera_info"}
            }
    if any(topic.name.endswith("/fix") for topic in topics):
        panels["map!fixes"] = {"layer": "map", "followTopic": ""}
    speed = {"value": f"{ODOMETRY}.twist.twist.linear.x", "enabled": True, "timestampMethod": "headerStamp"}
    panels["Plot!speed"] = {"title": "speed, m/s", "paths": [speed], "xAxisVal": "timestamp"}
    first, *others = panels
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {
            "direction": "row",
            "first": first,
            "second": _stack(others),
            "splitPercentage": 65,
        },
    }


def _scene(topics: list[Topic]) -> dict[str, Any]:
    """The panel of clouds, coloured by intensity, scans, and boxes of the first scanner with some."""
    shown: dict[str, dict[str, Any]] = {}
    colors = {"colorField": "intensity", "colorMode": "colormap", "colorMap": "turbo"}
    for topic in topics:
        if topic.name.endswith("/points"):
            shown[topic.name] = {"visible": True, "pointSize": 2, "minValue": 0, "maxValue": 100, **colors}
        elif topic.name.endswith("/scan"):
            shown[topic.name] = {"visible": True, "pointSize": 3}
        elif topic.name.endswith("/boxes"):
            first = not any(name.endswith("/boxes") for name in shown)
            shown[topic.name] = {"visible": first}
    return {
        "followMode": "follow-pose",
        "followTf": BASE,
        "fixedFrame": MAP,
        "cameraState": {"distance": 40, "phi": 60, "thetaOffset": 90, "perspective": True, "fovy": 45},
        "topics": shown,
    }


def _stack(panels: list[str]) -> Any:
    """Panels one above the other, of equal height."""
    first, *others = panels
    if not others:
        return first
    share = 100 / len(panels)
    return {
        "direction": "column", "first": first, "second": _stack(others), "splitPercentage": share
    }  # fmt: skip
