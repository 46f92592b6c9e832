"""LAS and LAZ files that may be damaged: what they state is checked before a decompressor trusts it.

The compiled decompressor reserves what a chunk table and the sizes of layers state, and ends the process
where that is more than the memory. Byte offsets are those of LAS 1.4 R15 (ASPRS 2019), table 3, and of LAZ.
"""

from __future__ import annotations

import io
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np

from geoscene.errors import DamagedFileError

_RATIO = 10**4
"""Greatest compression of LAZ that is read: clouds are compressed to a tenth, equal points by a thousand."""

_CHUNK_POINTS = 10**6
"""Points per chunk of LAZ that are read even if the file holds fewer; writers state 50,000."""

_LONGEST = 4096
"""Bytes of a point record in LAZ, at most: memory is reserved for 50,000 of them."""

_LAYERS = {6: 9, 7: 10, 8: 11, 9: 10, 10: 12}
"""Layers of a chunk by point format: nine of the point, one each of colour, infrared and wave packets."""

_SPARE, _SPARE_BYTES = 64, 16
"""Points, and bytes' worth of points, that a chunk seems to hold beyond its own, at most."""


@contextmanager
def open_las(path: Path, *, parallel: bool = False) -> Iterator[Any]:
    """Yield laspy's reader of a LAS, LAZ or COPC file, after a check of all sizes that the file states.

    parallel : whether the chunks of LAZ that are read at once are decompressed by several threads

    Raises DamagedFileError, also for what goes wrong while the block reads points.
    """
    import laspy  # noqa: PLC0415  (0.4 s)
    import lazrs  # noqa: PLC0415

    try:
        if path.is_file():
            _check_sizes(path)
        backend = laspy.LazBackend.LazrsParallel if parallel else laspy.LazBackend.Lazrs
        with laspy.open(path, laz_backend=backend) as reader:
            _check_points(path, reader.header)
            yield reader
    except DamagedFileError:
        raise
    except (FileNotFoundError, PermissionError, IsADirectoryError):
        raise
    except (laspy.errors.LaspyException, lazrs.LazrsError, OSError, ValueError, ArithmeticError) as error:
        raise _damaged(path, str(error)) from error
    except (LookupError, AttributeError, TypeError, struct.error) as error:  # of records that laspy parses
        raise _damaged(path, f"{type(error).__name__}: {error}") from error
    except BaseException as error:
        if not _is_panic(error):
            raise
        raise _damaged(path, "the decompressor failed") from error


def _is_panic(error: BaseException) -> bool:
    """Whether the decompressor panicked: its error is no Exception, and cannot be imported."""
    return type(error).__name__ == "PanicException"


def point_count(path: Path) -> int:
    """Number of points of a file: an entry of the header, at byte 247 of LAS 1.4."""
    with path.open("rb") as file:
        head = file.read(255)
    at, end = (247, 255) if head[25] >= 4 else (107, 111)
    return int.from_bytes(head[at:end], "little")


def _damaged(path: Path, fault: str) -> DamagedFileError:
    text = " ".join(fault.split())[:200]
    return DamagedFileError(f"{path}: damaged LAS or LAZ file ({text}); take a complete copy of it")


def _check_sizes(path: Path) -> None:
    """Raise DamagedFileError for a file whose header states more, or fewer points, than the file holds."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(375).ljust(375, b"\0")
        if head[:4] != b"LASF":
            raise _damaged(path, "no LAS header")
        header, start, records = struct.unpack_from("<HII", head, 94)
        kind, length, points = struct.unpack_from("<BHI", head, 104)
        by_return = struct.unpack_from("<5I", head, 111)
        more, extended = 0, 0
        if head[25] >= 4:
            more, extended, points = struct.unpack_from("<QIQ", head, 235)
            by_return = struct.unpack_from("<15Q", head, 255)
        if not header + 54 * records <= start <= size or (extended and more + 60 * extended > size):
            raise _damaged(path, "its header states more records than the file holds")
        end = more if extended else size
        for _ in range(extended):  # records with a length each
            file.seek(more + 20)
            more += 60 + int.from_bytes(file.read(8), "little")
            if more > size:
                raise _damaged(path, "a record is longer than the file")
        if sum(by_return) > points:
            raise _damaged(path, f"its header states {points} points, and {sum(by_return)} by return")
        if kind < 128:
            held = max(end - start, 0) // max(length, 1)
            waves = int.from_bytes(head[227:235], "little") if head[25] >= 3 else 0
            if held < points or (held > points and not waves):
                raise _damaged(path, f"its header states {points} points, and it holds {held}")
        elif points and not (_chunks_fit(file, start=start, size=size) and length * points <= _RATIO * size):
            raise _damaged(path, "its header or chunk table states more than the file holds")


def _chunks_fit(file: IO[bytes], *, start: int, size: int) -> bool:
    """Whether the chunk table of a LAZ file lies within it, and its chunks before it."""
    file.seek(start)
    table = int.from_bytes(file.read(8), "little", signed=True)
    if table == -1:  # written without going back: stated at the end
        file.seek(-8, os.SEEK_END)
        table = int.from_bytes(file.read(8), "little", signed=True)
    if not start <= table <= size - 8:
        return False
    file.seek(table + 4)
    return int.from_bytes(file.read(4), "little") <= table - start


def _check_points(path: Path, header: Any) -> None:
    """Raise DamagedFileError for sizes of chunks and of their layers that cannot be.

    A chunk of point formats 6 to 10 holds its first point as it is, the number of its points, the sizes of
    its layers, and the layers. Other formats have chunks without sizes inside.
    """
    import lazrs  # noqa: PLC0415

    compressed, point = header.vlrs.get("LasZipVlr"), header.point_format
    if not compressed or not header.point_count:
        return
    laz = lazrs.LazVlr(compressed[0].record_data)
    packed = laz.item_size()
    if packed != point.size or packed > _LONGEST:
        raise _damaged(path, f"records of {point.size} bytes, of which {packed} are compressed")
    most = max(header.point_count, _CHUNK_POINTS)
    if not laz.uses_variable_size_chunks() and laz.chunk_size() > most:
        raise _damaged(path, f"chunks of {laz.chunk_size()} points")
    with path.open("rb") as file:
        file.seek(header.offset_to_point_data)
        table = np.array(lazrs.read_chunk_table(file, laz), np.int64).reshape(-1, 2)
        start, size = file.tell(), path.stat().st_size
        if (table < 0).any() or (table[:, 0] > most).any() or (table[:, 1] > size).any():
            raise _damaged(path, "a chunk larger than the file")
        if point.id in _LAYERS:
            layers = _LAYERS[point.id] + point.num_extra_bytes
            counts = [
                _chunk_points(path, file, at=start + int(at), size=int(length), point=point, layers=layers)
                for at, length in zip(np.cumsum(table[:, 1]) - table[:, 1], table[:, 1], strict=True)
            ]
            low = high = sum(counts)
        elif laz.uses_variable_size_chunks():
            low = high = int(table[:, 0].sum())
        else:
            high = len(table) * laz.chunk_size()
            low = high - laz.chunk_size() + 1
        if not low <= header.point_count <= high:
            held = f"{high}" if low == high else f"{low} to {high}"
            raise _damaged(path, f"its header states {header.point_count} points, and its chunks hold {held}")
        if low < high:
            last = int(table[-1, 1])
            file.seek(start + int(table[:-1, 1].sum()))
            stated = header.point_count - low + 1
            if _holds_more(file.read(last), laz, record=compressed[0].record_data, points=stated):
                raise _damaged(path, f"its header states {header.point_count} points, and it holds more")


def _holds_more(chunk: bytes, laz: Any, *, record: bytes, points: int) -> bool:
    """Whether a chunk without its number of points holds far more than stated.

    Its bytes last for the points that it holds, and for few more if these need parts of a bit each.
    """
    import lazrs  # noqa: PLC0415

    few = _SPARE + _SPARE_BYTES * points // len(chunk)
    file = io.BytesIO()
    file.write((8 + len(chunk)).to_bytes(8, "little") + chunk)
    lazrs.write_chunk_table(file, [(points, len(chunk))], laz)
    file.seek(0)
    reader = lazrs.LasZipDecompressor(file, record)
    file.truncate(8 + len(chunk))
    try:
        reader.decompress_many(np.empty((points + few) * laz.item_size(), np.uint8))
    except BaseException as error:
        if isinstance(error, lazrs.LazrsError) or _is_panic(error):
            return False
        raise
    return True


def _chunk_points(path: Path, file: IO[bytes], *, at: int, size: int, point: Any, layers: int) -> int:
    """Number of points of a chunk with layers, which must be as long as the chunk."""
    file.seek(at + point.size)
    head = file.read(4 + 4 * layers)
    if not size:
        return 0
    if len(head) < 4 + 4 * layers:
        raise _damaged(path, "it ends within a chunk")
    count, *sizes = struct.unpack(f"<{1 + layers}I", head)
    if point.size + len(head) + sum(sizes) != size:
        raise _damaged(path, "layers of another length than their chunk")
    return int(count)
