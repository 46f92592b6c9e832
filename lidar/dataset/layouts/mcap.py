"""A recorded drive as one MCAP file of ROS 2 messages, and a layout by which Foxglove shows it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from geoscene.support.files import write_json
from geoscene.support.progress import Progress
from lidar.dataset.layout import Dataset
from lidar.dataset.layouts.ros2 import message_counts, write_recording
from lidar.dataset.layouts.ros_drive import BASE, MAP, Topic
from lidar.dataset.layouts.ros_topics import ODOMETRY


def export(dataset: Dataset, folder: Path, *, progress: Progress) -> dict[str, int]:
    """Write ``drive.mcap`` and ``foxglove.json``; return the numbers of messages by type.

    Raises DatasetError for damaged files, and MissingExtraError without rosbags.
    """
    topics = write_recording(dataset, folder, progress=progress)
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
