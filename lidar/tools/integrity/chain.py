"""Signed hash chain over the files of a dataset: written, and compared with the files."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geoscene.support.digests import file_sha256
from geoscene.support.files import json_bytes, write_atomically
from geoscene.support.progress import Progress
from geoscene.typing import Ints
from lidar.dataset.formats import format_of
from lidar.dataset.layout import Dataset, Paths, reading_file
from lidar.dataset.signable import SignedFiles, signed_files
from lidar.errors import DatasetError, InputError, LidarError
from lidar.tools.integrity.digests import (
    SECTORS,
    START,
    BlockDigests,
    FrameDigests,
    Link,
    block_digests,
    frame_file,
    link,
    links_bytes,
    read_digests,
    read_links,
    signed_message,
)
from lidar.tools.integrity.keys import Signer

SCHEMA = 1
"""Version of the files in the folder ``integrity``."""

_TOLD = 4
"""Blocks that are named; all are counted."""


@dataclass(frozen=True)
class Finding:
    """Something that is not as it was signed.

    what   : happened, such as ``changed``, ``missing``, ``added``
    place  : path of the file, or name of the sensor
    detail : more about it, one line
    blocks : (k,) of a cloud that differ: ring times 36 plus sector
    sensor, frame : of the file; empty and None for one of no frame
    """

    what: str
    place: str
    detail: str = ""
    blocks: tuple[int, ...] = ()
    sensor: str = ""
    frame: int | None = None

    def to_text(self) -> str:
        """One line."""
        return f"{self.place}: {self.what}" + (f" ({self.detail})" if self.detail else "")


@dataclass(frozen=True)
class ChainReport:
    """Comparison with the signed hash chain.

    frames, files : that were compared
    """

    algorithm: str
    frames: int
    files: int
    findings: tuple[Finding, ...]


def write_chain(dataset: Dataset, signer: Signer, *, progress: Progress) -> tuple[int, int, bytes]:
    """Write the hash chain over the files of a dataset; frames, files, and the bytes of the signature."""
    signer.sign(b"")  # a key that cannot sign is refused before anything is written
    files, folder = signed_files(dataset), Paths(dataset.path).integrity
    if files.links:
        raise DatasetError(f"{dataset.path / files.links[0]}: is a link; signed data hold copies, replace it")
    folder.mkdir(exist_ok=True)
    Paths(dataset.path).chain.unlink(missing_ok=True)
    heads: dict[str, tuple[int, bytes]] = {}
    total, done = sum(map(len, files.frames.values())), 0
    for sensor, frames in files.frames.items():
        rate_hz, head, links = frame_rate(dataset, sensor), START, list[Link]()
        times = dataset.sample_times(sensor).tolist()
        for frame in sorted(frames):
            progress("sign", done, total=total)
            time_ns = times[frame] if frame < len(times) else -1
            digests = frame_digests(dataset.path, frames[frame], rate_hz=rate_hz)
            write_atomically(frame_file(folder, sensor, frame=frame), digests.to_bytes())
            head = link(head, sensor=sensor, frame=frame, time_ns=time_ns, root=digests.root)
            links.append(Link(frame, time_ns, digests.root, head))
            done += 1
        write_atomically(folder / f"{sensor}.csv", links_bytes(links))
        heads[sensor] = len(links), head
    tables = {name: _sha256(dataset.path, name) for name in files.others}
    document = {
        "schema": SCHEMA,
        "algorithm": signer.algorithm,
        "sensors": {name: {"frames": frames, "head": head.hex()} for name, (frames, head) in heads.items()},
        "files": {name: sha256.hex() for name, sha256 in tables.items()},
        "signature": signer.sign(signed_message(heads, tables)).hex(),
    }
    progress("sign", total, total=total)
    return total, files.count, json_bytes(document)


def blocks_in(path: Path, *, rate_hz: float) -> BlockDigests | None:
    """Digests of the blocks of a cloud; None for another file, or one that cannot be read."""
    if path.parent.name in ("boxes", "signals"):
        return None
    try:
        table = format_of(path).read(path)
    except (LidarError, OSError, ValueError):
        return None
    return block_digests(table, rate_hz=rate_hz)


def frame_rate(dataset: Dataset, sensor: str) -> float:
    """Frames of a sensor a second, by which clouds in the world frame are cut; 0 if unknown."""
    return float(dataset.sensors().get(sensor, {}).get("rate_hz", 0.0))


def frame_digests(folder: Path, names: list[str], *, rate_hz: float) -> FrameDigests:
    """Digests of the files of a frame."""
    sha256 = {name: file_sha256(folder / name) for name in names}
    found = {name: blocks_in(folder / name, rate_hz=rate_hz) for name in names}
    return FrameDigests(sha256, {name: blocks for name, blocks in found.items() if blocks is not None})


def verify_chain(dataset: Dataset, signer: Signer, *, progress: Progress) -> ChainReport:
    """Compare the files of a dataset with its signed hash chain.

    Raises DatasetError for a dataset that is not signed, and InputError for a key of another kind.
    """
    path = Paths(dataset.path).chain
    if not path.is_file():
        raise DatasetError(f"{dataset.path}: is not signed; lidar sign --chain signs it")
    with reading_file(path):
        text = path.read_text("utf-8-sig")
        document = json.loads(text)
        if document["schema"] != SCHEMA:
            raise DatasetError(f"{path}: schema version {document['schema']}, this program reads {SCHEMA}")
        heads = {
            name: (int(entry["frames"]), bytes.fromhex(entry["head"]))
            for name, entry in document["sensors"].items()
        }
        tables = {name: bytes.fromhex(sha256) for name, sha256 in document["files"].items()}
        signature, algorithm = bytes.fromhex(document["signature"]), str(document["algorithm"])
    if algorithm != signer.algorithm:
        raise InputError(f"{dataset.path}: is signed with {algorithm}; the key is for {signer.algorithm}")
    findings: list[Finding] = []
    written = json.dumps(document, indent=2, ensure_ascii=False) + "\n"
    if text != written or not signer.verifies(signed_message(heads, tables), signature):
        detail = "signed with another key, or the list of signed files was changed"
        findings.append(Finding("signature is not valid", path.relative_to(dataset.path).as_posix(), detail))
    files = signed_files(dataset)
    findings += _tables_found(dataset, tables, present=files.others)
    findings += _not_signed(dataset, files, sensors=heads)
    frames = 0
    for sensor, head in heads.items():
        found, count = _frames_found(
            dataset, sensor, head=head, files=files.frames.get(sensor, {}), progress=progress
        )
        findings, frames = findings + found, frames + count
    return ChainReport(algorithm, frames, files.count, tuple(findings))


def _tables_found(dataset: Dataset, signed: dict[str, bytes], *, present: list[str]) -> list[Finding]:
    """Differences of files of no frame."""
    found = [Finding("added", name) for name in present if name not in signed]
    for name, sha256 in signed.items():
        path = _inside(dataset, name)
        if path is None or not (path.is_dir() if name.endswith("/") else path.is_file()):
            found.append(Finding("missing", name))
        elif _sha256(dataset.path, name) != sha256:
            found.append(Finding("changed", name))
    return found


def _sha256(folder: Path, name: str) -> bytes:
    """SHA-256 of a file; of an empty folder, whose name ends with a slash, that of no bytes."""
    return hashlib.sha256(b"").digest() if name.endswith("/") else file_sha256(folder / name)


def _not_signed(dataset: Dataset, files: SignedFiles, *, sensors: Collection[str]) -> list[Finding]:
    """Links, files of other sensors than the signed ones, and files in the folder of signatures."""
    found = [Finding("link", name, f"leads to {(dataset.path / name).readlink()}") for name in files.links]
    added = [
        name
        for sensor, frames in files.frames.items()
        if sensor not in sensors
        for names in frames.values()
        for name in names
    ]
    paths, own = dataset.paths, set[Path]()
    for sensor in sensors:
        own.add(paths.integrity / f"{sensor}.csv")
        with suppress(LidarError):  # a list that cannot be read is a finding of its own
            links = read_links(paths.integrity / f"{sensor}.csv")
            own |= {frame_file(paths.integrity, sensor, frame=one.frame) for one in links}
    added += [n for n in files.lists if dataset.path / n not in own | {paths.chain}]
    return found + [Finding("added", name) for name in added]


def _inside(dataset: Dataset, name: str) -> Path | None:
    """A file of the dataset; None for a path that leads out of it."""
    path = Path(name)
    return None if path.is_absolute() or ".." in path.parts else dataset.path / path


def _frames_found(
    dataset: Dataset, sensor: str, *, head: tuple[int, bytes], files: dict[int, list[str]], progress: Progress
) -> tuple[list[Finding], int]:
    """Differences of the frames of a sensor, and the number of frames that were compared."""
    place, integrity = f"integrity/{sensor}.csv", Paths(dataset.path).integrity
    try:
        links = read_links(integrity / f"{sensor}.csv")
    except LidarError as error:
        return [Finding("signed list cannot be read", place, str(error), sensor=sensor)], 0
    found, signed = list[Finding](), dict[int, FrameDigests]()
    if broken := _broken_link(links, sensor, head=head):
        found.append(Finding("signed list was changed", place, broken, sensor=sensor))
    for entry in links:
        path = frame_file(integrity, sensor, frame=entry.frame)
        where: dict[str, Any] = {"sensor": sensor, "frame": entry.frame}
        name = path.relative_to(dataset.path).as_posix()
        try:
            digests = signed[entry.frame] = read_digests(path)
        except LidarError as error:
            found.append(Finding("signed digests cannot be read", name, str(error), **where))
            continue
        if digests.root != entry.root:
            found.append(Finding("signed digests were changed", name, **where))
    rate_hz = frame_rate(dataset, sensor)
    differing = _files_found(dataset, sensor, signed=signed, files=files, rate_hz=rate_hz, progress=progress)
    return [*found, *differing], len(links)


def _broken_link(links: list[Link], sensor: str, *, head: tuple[int, bytes]) -> str:
    """Description of the place where a chain is broken; empty if it leads to the signed last link."""
    former = START
    for entry in links:
        former = link(former, sensor=sensor, frame=entry.frame, time_ns=entry.time_ns, root=entry.root)
        if former != entry.link:
            return f"from frame {entry.frame} on"
    if (len(links), former) != head:
        return f"{len(links)} of {head[0]} frames, or another last link"
    return ""


def _files_found(
    dataset: Dataset,
    sensor: str,
    *,
    signed: dict[int, FrameDigests],
    files: dict[int, list[str]],
    rate_hz: float,
    progress: Progress,
) -> Iterator[Finding]:
    """Files of a sensor's frames that are missing, were added, changed, or hold another frame."""
    frame_of = {
        (Path(name).parent.as_posix(), sha256): frame
        for frame, digests in signed.items()
        for name, sha256 in digests.sha256.items()
    }
    known = Counter(sha256 for digests in signed.values() for sha256 in digests.sha256.values())
    for frame, names in files.items():
        own = signed[frame].sha256 if frame in signed else {}
        for name in names:
            if name not in own:
                yield Finding("added", name, sensor=sensor, frame=frame)
    for done, (frame, digests) in enumerate(signed.items()):
        progress(f"verify {sensor}", done, total=len(signed))
        for name, sha256 in digests.sha256.items():
            where: dict[str, Any] = {"sensor": sensor, "frame": frame}
            path = _inside(dataset, name)
            if path is None or not path.is_file():
                yield Finding("missing", name, **where)
                continue
            got = file_sha256(path)
            if got == sha256:
                continue
            other = frame_of.get((Path(name).parent.as_posix(), got))
            if other is not None and known[got] == 1:
                yield Finding("replaced", name, f"holds frame {other}", **where)
                continue
            yield _change(path, name, digests=digests, rate_hz=rate_hz, where=where)
    progress(f"verify {sensor}", len(signed), total=len(signed))


def _change(
    path: Path, name: str, *, digests: FrameDigests, rate_hz: float, where: dict[str, Any]
) -> Finding:
    """Describe the differences in a file of a frame."""
    before = digests.blocks.get(name)
    if before is None:
        return Finding("changed", name, **where)
    after = blocks_in(path, rate_hz=rate_hz)
    if after is None:
        return Finding("changed", name, "cannot be read as a cloud any more", **where)
    blocks = before.changed(after)
    if not len(blocks):
        detail = "no block of points differs: the header, or the order of points"
        return Finding("changed", name, detail, **where)
    text = block_text(blocks, world=path.suffix in (".laz", ".las"))
    return Finding("changed", name, text, tuple(blocks.tolist()), **where)


def block_text(blocks: Ints, *, world: bool) -> str:
    """Rings and directions of blocks in words.

    world : of a cloud in the world frame, whose sectors are parts of a turn in time
    """
    ring, sector = np.divmod(blocks, SECTORS)
    step = 360 // SECTORS
    words = []
    for r, s in zip(ring.tolist(), sector.tolist(), strict=True):
        turn = f"part {s + 1} of {SECTORS}" if world else f"{s * step - 180} to {(s + 1) * step - 180} deg"
        words.append(f"ring {r} {turn}")
    more = f" and {len(words) - _TOLD} more" if len(words) > _TOLD else ""
    return "; ".join(words[:_TOLD]) + more
