"""Reads OpenStreetMap extracts from files."""

from __future__ import annotations

import datetime as dt
import json
import os
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.errors import InputError, SourceNotFoundError, reason_of
from geoscene.sources.assemble import features
from geoscene.sources.data import Bounds, OsmData, Progress, Tags
from geoscene.sources.elements import LONGEST_TAG, Collector, collect_answer, collect_xml
from geoscene.sources.extent import checked_bounds
from geoscene.sources.pbf import rewrite_texts
from geoscene.support.untrusted import TooLargeError, open_unpacked

_AS_THEY_ARE: Mapping[str, str] = MappingProxyType({})

_HELP = "give an OpenStreetMap extract (.osm, .osm.gz, .osm.bz2, .osm.pbf) or Overpass JSON"


def _format_of(path: Path) -> str:
    """The format of a file by its first bytes, not by its name.

    Raises InputError for a file that is not an OpenStreetMap file.
    """
    with path.open("rb") as file:
        head = file.read(64)
    if not head:
        raise InputError(f"{path}: the file is empty; {_HELP}")
    packed = ""
    for magic, suffix in ((b"\x1f\x8b", ".gz"), (b"BZh", ".bz2")):
        if head.startswith(magic):
            packed = suffix
            with open_unpacked(path, suffix) as content:
                head = content.read(64)
    if head[4:6] == b"\x0a\x09" and head[6:15] == b"OSMHeader":
        return "pbf"
    if head[:7] == b"\xff\xe0\x04o5m2":
        return "o5m"
    text = head.lstrip(b"\xef\xbb\xbf \t\r\n")
    if text[:1] == b"<":
        return f"osm{packed}"
    if text[:1] == b"{":
        return f"json{packed}"
    raise InputError(f"{path}: not an OpenStreetMap file; {_HELP}")


def _node_places(file: Any) -> NDArray[Any] | None:
    """Columns ``id``, ``x``, ``y`` of all nodes of a file; None if their ids are not positive and ascending.

    libosmium writes them into a file, in a tenth of the time that reading the nodes one by one takes.
    """
    import osmium  # noqa: PLC0415 - heavy

    record = [("id", "<u8"), ("x", "<i4"), ("y", "<i4")]
    with TemporaryDirectory() as folder:
        index = osmium.index.create_map(f"sparse_file_array,{folder}/nodes")
        osmium.apply(osmium.io.Reader(file, osmium.osm.NODE), osmium.NodeLocationsForWays(index))
        nodes = np.fromfile(f"{folder}/nodes", np.dtype(record))
    nodes = nodes[: np.count_nonzero(nodes["id"])]  # what follows is empty
    return nodes if (np.diff(nodes["id"], prepend=np.uint64(0)).astype(np.int64) > 0).all() else None


def _stream(
    file: Any,
    collector: Collector,
    *,
    nodes: NDArray[Any] | None,
    progress: Progress,
    texts: Mapping[str, str] = _AS_THEY_ARE,
) -> None:
    """Add the objects that libosmium reads to ``collector``; of ``nodes`` with known places only the tags.

    texts : keys, values and roles by what the file has instead of them
    """
    import osmium  # noqa: PLC0415 - heavy

    stream = osmium.FileProcessor(file)
    if nodes is not None:
        collector.nodes(nodes["id"].astype(np.int64), x=nodes["x"], y=nodes["y"])
        tagged = osmium.filter.EmptyTagFilter()
        tagged.enable_for(osmium.osm.NODE)
        stream = stream.with_filter(tagged)
    stated = stream.header.get("osmosis_replication_timestamp") or stream.header.get("timestamp")
    newest = dt.datetime.fromtimestamp(0, dt.UTC)
    kinds = {"n": "node", "w": "way", "r": "relation"}
    for item in progress(stream):
        if item.deleted:
            collector.delete(kinds[item.type_str()], item.id)
            continue
        if item.is_node():
            tags = _tags(item, texts) if item.tags else None
            if nodes is None:
                place = item.location
                collector.node(item.id, place.x, y=place.y, tags=tags)
            elif tags:
                collector.node_tags(item.id, tags)
            if tags is None:
                continue
        elif item.is_way():
            collector.way(item.id, [node.ref for node in item.nodes], tags=_tags(item, texts))
        elif item.is_relation():
            members = tuple((kinds[m.type], m.ref, texts.get(m.role, m.role)) for m in item.members)
            collector.relation(item.id, _tags(item, texts), members=members)
        else:
            continue
        if not stated:
            newest = max(newest, item.timestamp)
    collector.timestamp = stated or (newest.strftime("%Y-%m-%dT%H:%M:%SZ") if newest.timestamp() > 0 else "")


def _tags(item: Any, texts: Mapping[str, str]) -> Tags:
    """The tags of an object; equal texts are one object, as most tags of a map are the same few."""
    if texts:
        return {texts.get(tag.k, tag.k): texts.get(tag.v, tag.v) for tag in item.tags}
    return {sys.intern(tag.k): sys.intern(tag.v) for tag in item.tags}


def _collect(path: Path, progress: Progress) -> Collector:
    """The objects of a file. Raises the errors of its reader."""
    import osmium  # noqa: PLC0415 - heavy

    file_format = _format_of(path)
    collector = Collector()
    if file_format.startswith("json"):
        with open_unpacked(path, file_format.removeprefix("json")) as content:
            collect_answer(json.load(content), collector)
        return collector
    file = osmium.io.File(str(path), file_format)
    box = osmium.FileProcessor(file).header.box()
    if box.valid() and box.size() > 0:
        low, high = box.bottom_left, box.top_right
        collector.bounds = (low.lon, low.lat, high.lon, high.lat)
    if file_format.startswith("osm") and _has_deletions(path, file_format):
        return _collected_without_libosmium(path, file_format, bounds=collector.bounds, progress=progress)
    try:
        return _collected(file, bounds=collector.bounds, by_places=file_format == "pbf", progress=progress)
    except (osmium.InvalidLocationError, RuntimeError, ValueError) as error:
        if file_format == "pbf" and "overlong" in str(error):
            return _collected_without_long_texts(path, bounds=collector.bounds, progress=progress)
        # the position of a node is not a number, or a tag is too long for libosmium
        unread = isinstance(error, osmium.InvalidLocationError) or "too long" in str(error)
        if not (unread and file_format.startswith("osm")):
            raise
        return _collected_without_libosmium(path, file_format, bounds=collector.bounds, progress=progress)


def _collected(
    file: Any,
    *,
    bounds: Bounds | None,
    by_places: bool,
    progress: Progress,
    texts: Mapping[str, str] = _AS_THEY_ARE,
) -> Collector:
    """The objects of a file as libosmium reads it; ``texts`` as for `_stream`.

    by_places : read the places of nodes at once, if their ids are positive and ascending
    """
    nodes = _node_places(file) if by_places else None
    collector = Collector(bounds=bounds)
    _stream(file, collector, nodes=nodes, progress=progress, texts=texts)
    if nodes is not None and collector.has_drawn_nodes():  # which libosmium's index leaves out
        return _collected(file, bounds=bounds, by_places=False, progress=progress, texts=texts)
    return collector


def _collected_without_long_texts(path: Path, *, bounds: Bounds | None, progress: Progress) -> Collector:
    """The objects of a PBF file with texts that libosmium refuses, of a copy with short ones instead."""
    import osmium  # noqa: PLC0415 - heavy

    texts: dict[str, str] = {}

    def shortened(text: bytes) -> bytes:
        if len(text) <= LONGEST_TAG:
            return text
        short = f"\x01{len(texts)}"  # a character that texts of maps do not have
        texts[short] = text.decode()
        return short.encode()

    with TemporaryDirectory() as folder:
        copy = Path(folder) / "short.osm.pbf"
        rewrite_texts(path, copy, changed=shortened)
        file = osmium.io.File(str(copy), "pbf")
        return _collected(file, bounds=bounds, by_places=True, progress=progress, texts=texts)


def _has_deletions(path: Path, file_format: str) -> bool:
    """Whether objects of an XML file are marked by an editor as deleted, which libosmium does not tell."""
    mark, tail = re.compile(rb"""\baction\s*=\s*["']delete["']"""), b""
    with open_unpacked(path, file_format.removeprefix("osm")) as content:
        while block := content.read(1 << 20):
            if mark.search(tail + block):
                return True
            tail = block[-32:]
    return False


def _collected_without_libosmium(
    path: Path, file_format: str, *, bounds: Bounds | None, progress: Progress
) -> Collector:
    collector = Collector(bounds=bounds)
    collect_xml(path, file_format, collector=collector, progress=progress)
    return collector


def _read(path: Path, progress: Progress) -> Collector:
    """The objects of a file. Raises SourceNotFoundError or InputError, which name it."""
    if not path.exists():
        raise SourceNotFoundError(f"{path}: no such file; {_HELP}")
    if path.is_dir():
        raise InputError(f"{path}: a directory; {_HELP}")
    try:
        collector = _collect(path, progress)
    except InputError as error:
        raise error if str(path) in str(error) else InputError(f"{path}: {error}; {_HELP}") from None
    except TooLargeError as error:
        raise InputError(f"{path}: {error}") from None
    except PermissionError as error:
        raise InputError(f"{path}: may not be read; give its permissions to this user") from error
    except MemoryError:
        raise
    except Exception as error:
        cause = reason_of(error)
        raise InputError(f"{path}: damaged, cut short or no OpenStreetMap file ({cause}); {_HELP}") from error
    if len(collector) == 0:
        raise SourceNotFoundError(f"{path}: holds no map objects; {_HELP}")
    return collector


def read_osm(
    path: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    bounds: Bounds | None = None,
    progress: Progress = iter,
) -> OsmData:
    """The features of OpenStreetMap extracts: XML or Overpass JSON (plain, gzip, bzip2), PBF, or o5m.

    The first bytes tell the format, not the name. Ids may be negative and in any order, and relations may
    come before ways: the result does not depend on the order in the file. Defects are repaired or dropped by
    the rules of docs/reference/sources.md and listed in ``problems``.

    Parameters
    ----------
    path
        The file, or several, such as tiles of a map, or its buildings and its roads. Of objects with the
        same id, that of the last file counts. The bounds are those of all files that state theirs.
    bounds
        Keep the features that intersect this box (west, south, east, north in degrees), whole; all if None.
    progress
        Wraps the stream of map objects.

    Raises
    ------
    SourceNotFoundError
        A file is missing, or there are no features (within the bounds).
    InputError
        A file is not an OpenStreetMap file, is truncated or damaged, the bounds are invalid, or different
        objects of two files have the same negative id.
    """
    paths = [Path(path)] if isinstance(path, str | os.PathLike) else [Path(p) for p in path]
    if bounds is not None:
        bounds = checked_bounds(bounds)
    collector = Collector()
    for number, one in enumerate(paths):
        read = _read(one, progress)
        if clash := collector.clashing(read):
            raise InputError(f"{one}: its {clash} is another in a file before; negative ids must be unique")
        collector = collector.joined(read) if number else read
    return features(collector.finish(), bounds=bounds, source=", ".join(p.name for p in paths))


def demo_path() -> Path:
    """Path of the demo map in the package.

    Raises SourceNotFoundError if it is missing.
    """
    path = Path(__file__).resolve().parents[1] / "demo" / "helsinki.osm.pbf"
    if not path.is_file():
        raise SourceNotFoundError(f"the demo map {path} is missing: install the package again")
    return path
