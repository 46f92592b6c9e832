"""PCD 0.7, binary: what PCL, Open3D and ROS tools read."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geoscene.files import write_atomically
from lidar.dataset.formats.table import Table, records
from lidar.errors import FormatError

_KIND = {"f": "F", "i": "I", "u": "U"}
_NAMES = {"time_ns": "t"}  # the field name that odometry programs look for; nanoseconds, unsigned


def encode_pcd(table: Table, *, viewpoint: str = "0 0 0 1 0 0 0", comment: str = "") -> bytes:
    """A whole PCD file of a table.

    viewpoint : sensor position and quaternion, w first, that the points are seen from
    comment   : one line for people, after the format's own comment line
    """
    data = records(table)
    fields = [data.dtype[name] for name in table]
    header = [
        "# .PCD v0.7 - Point Cloud Data file format",
        *([f"# {comment}"] if comment else []),
        "VERSION 0.7",
        "FIELDS " + " ".join(_NAMES.get(name, name) for name in table),
        "SIZE " + " ".join(str(f.itemsize) for f in fields),
        "TYPE " + " ".join(_KIND[f.kind] for f in fields),
        "COUNT " + " ".join("1" for _ in fields),
        f"WIDTH {len(data)}",
        "HEIGHT 1",
        f"VIEWPOINT {viewpoint}",
        f"POINTS {len(data)}",
        "DATA binary\n",
    ]
    return "\n".join(header).encode("ascii") + data.tobytes()


def write_pcd(path: Path, table: Table, *, viewpoint: str = "0 0 0 1 0 0 0", comment: str = "") -> None:
    """Write a table as binary PCD; see `encode_pcd`."""
    write_atomically(path, encode_pcd(table, viewpoint=viewpoint, comment=comment))


def read_pcd(path: Path) -> Table:
    """The table of a binary PCD file; ``t`` comes back as ``time_ns``.

    Raises FormatError for anything that is not uncompressed binary PCD with one value a field.
    """
    raw = path.read_bytes()
    head, marker, body = raw.partition(b"DATA binary\n")
    if not marker or b"FIELDS" not in head:
        raise FormatError(f"{path}: not a binary PCD file (no 'DATA binary' line)")
    lines = (line.split(maxsplit=1) for line in head.decode("ascii", "replace").splitlines())
    entries = {line[0]: line[1].split() for line in lines if len(line) == 2 and line[0] != "#"}
    try:
        names = [{v: k for k, v in _NAMES.items()}.get(name, name) for name in entries["FIELDS"]]
        kinds = [f"<{t.lower()}{s}" for t, s in zip(entries["TYPE"], entries["SIZE"], strict=True)]
        count = int(entries["POINTS"][0])
        data = np.frombuffer(body, np.dtype(list(zip(names, kinds, strict=True))), count)
    except (KeyError, ValueError, TypeError) as error:
        raise FormatError(f"{path}: damaged PCD header or data ({error})") from error
    return {name: data[name] for name in names}
