"""PNG images: colour, depth, classes and instances; the same pixels give the same bytes."""

from __future__ import annotations

import struct
from io import BytesIO
from pathlib import Path

import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray
from PIL import Image

from geoscene.errors import reason_of
from geoscene.support.files import write_atomically
from lidar.errors import FormatError

DEPTH_SCALE = 256.0
"""Counts per metre of a depth image, as in KITTI's depth benchmark: 0 is no data, 65535 is 255.996 m."""


def encode_png(image: NDArray[np.uint8] | NDArray[np.uint16]) -> bytes:
    """The PNG file of an image (h, w, 3) in colour or (h, w) in grey, uint8 or uint16.

    Every row uses the "up" filter and light compression (PNG, W3C 2003), twice as fast as trying all filters.
    ISA-L, which compresses, gives the same bytes on all x86-64 processors with SSE 4.2.
    Raises FormatError for another array.
    """
    kinds = {("uint8", 3): (8, 2), ("uint8", 2): (8, 0), ("uint16", 2): (16, 0), ("uint16", 3): (16, 2)}
    kind = kinds.get((image.dtype.name, image.ndim))
    if kind is None or image.size == 0 or image.shape[2:] not in ((), (3,)):
        raise FormatError(
            f"an array {image.shape} of {image.dtype} is not an image of 8 or 16 bits, in grey or colour"
        )
    height, width = image.shape[:2]
    big_endian = np.ascontiguousarray(image, image.dtype.newbyteorder(">"))
    rows = big_endian.view(np.uint8).reshape(height, -1)
    filtered = np.empty((height, rows.shape[1] + 1), np.uint8)
    filtered[:, 0] = 2
    filtered[0, 1:] = rows[0]
    np.subtract(rows[1:], rows[:-1], out=filtered[1:, 1:])
    packed = isal_zlib.compress(filtered.data, 1)
    header = struct.pack(">IIBBBBB", width, height, *kind, 0, 0, 0)
    chunks = [_chunk(b"IHDR", header), _chunk(b"IDAT", packed), _chunk(b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def _chunk(name: bytes, data: bytes) -> bytes:
    checksum = isal_zlib.crc32(data, isal_zlib.crc32(name))
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", checksum)


def write_png(path: Path, image: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    """Write an image as `encode_png` encodes it."""
    write_atomically(path, encode_png(image))


def read_png(path: Path) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """The array that `write_png` wrote, bit for bit; not 16-bit colour, which Pillow does not read.

    Raises FormatError if the file cannot be read as such an image.
    """
    try:
        data = path.read_bytes()
        with Image.open(BytesIO(data)) as image:
            deep_colour = data[24:26] == b"\x10\x02"  # bit depth and colour type in the header
            if image.mode not in ("RGB", "L", "I;16") or deep_colour:
                raise FormatError(f"{path}: neither 8-bit colour nor 8- or 16-bit grey")
            return np.array(image)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise FormatError(f"{path}: not a readable image ({reason_of(error)})") from error


def depth_to_counts(depth: NDArray[np.floating]) -> NDArray[np.uint16]:
    """Depth in metres as counts of 1 / `DEPTH_SCALE` m, rounded; 0 where it is not finite or too far to hold.

    A surface nearer than half a count is stored as 1, as 0 means no data.
    """
    finite = np.isfinite(depth) & (depth >= 0)
    counts = np.rint(np.where(finite, depth, 0.0) * DEPTH_SCALE)
    held = finite & (counts <= 65535)
    return np.where(held, np.maximum(counts, 1), 0).astype(np.uint16)


def counts_to_depth(counts: NDArray[np.uint16]) -> NDArray[np.float32]:
    """Depth in metres, inf without data: the inverse of `depth_to_counts` within half a count (2 mm)."""
    return np.where(counts > 0, counts / np.float32(DEPTH_SCALE), np.inf).astype(np.float32)


def feature_to_image(feature: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Feature numbers (h, w) as a colour image (h, w, 3): number + 1 = R + 256 G + 65536 B, 0 for none.

    The encoding of COCO's panoptic format, for up to 16.7 million features.
    """
    n = (feature + 1).astype(np.uint32)
    return np.stack([n & 255, n >> 8 & 255, n >> 16 & 255], axis=-1).astype(np.uint8)


def image_to_feature(image: NDArray[np.uint8]) -> NDArray[np.int32]:
    """The feature numbers of an image of `feature_to_image`, -1 for none."""
    return (image.astype(np.int32) @ np.array([1, 256, 65536], np.int32) - 1).astype(np.int32)


FLOW_SCALE = 64.0
"""Counts per pixel of a flow image, as in KITTI's flow benchmark, about 32768."""


def flow_to_image(flow: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Optical flow (h, w, 2) in pixels as a 16-bit colour image (h, w, 3), as in KITTI's flow benchmark.

    R is 64 times the flow to the right + 32768, G the same downwards, B is 1; all are 0 where the flow is
    unknown or exceeds 511 pixels.
    """
    held = np.isfinite(flow).all(axis=2) & (np.abs(flow) < 511.5).all(axis=2)
    image = np.zeros((*held.shape, 3), np.uint16)
    image[held, :2] = np.rint(flow[held] * FLOW_SCALE + 32768)
    image[held, 2] = 1
    return image


def image_to_flow(image: NDArray[np.uint16]) -> NDArray[np.float32]:
    """The flow of an image of `flow_to_image`, to 1/128 of a pixel; NaN where it is unknown."""
    flow = ((image[..., :2].astype(np.float64) - 32768) / FLOW_SCALE).astype(np.float32)
    flow[image[..., 2] == 0] = np.nan
    return flow
