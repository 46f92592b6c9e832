"""Verification of checksums, watermark and signed hash chain of datasets."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from geoscene.scene.layout import SceneFiles
from geoscene.support.digests import digest, file_sha256
from geoscene.support.progress import Progress, silent
from geoscene.support.storage import StoredFolder, cache_folder, shown, url_of
from geoscene.typing import Ints
from lidar.dataset.checksums import CHECKSUMS, differences, read_checksums
from lidar.dataset.layout import Dataset, Paths, open_dataset, reading_file
from lidar.dataset.signable import is_truth, signed_files
from lidar.errors import DatasetError, InputError, LidarError
from lidar.tools.integrity.blocks import SECTORS
from lidar.tools.integrity.digest_files import FrameDigests, Link, frame_file, read_digests, read_links
from lidar.tools.integrity.keys import Signer
from lidar.tools.integrity.marked_clouds import MarkedCloud, cloud_files
from lidar.tools.integrity.merkle import START, link, signed_message
from lidar.tools.integrity.tampering import NOISE, FrameVerdict, Place, frame_verdict
from lidar.tools.integrity.watermark import SPREAD, WatermarkKey
from lidar.tools.sign import SCHEMA, blocks_in, frame_rate


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


@dataclass(frozen=True)
class MarkedFrame:
    """Broken places of the watermark of a cloud.

    blocks : (k,) tampered ones: ring times 36 plus sector
    forged : number of returns that do not bear the watermark
    absent : whether the cloud has no watermark at all, such as one of another frame or key
    """

    file: str
    sensor: str
    frame: int
    blocks: tuple[int, ...]
    forged: int
    places: tuple[Place, ...]
    absent: bool

    def to_text(self) -> list[str]:
        """One line for the cloud and one for each place."""
        if self.absent:
            return [f"{self.file}: no watermark of this key and frame"]
        text = block_text(np.array(self.blocks), world=False)
        lines = [f"{self.file}: watermark broken in {len(self.blocks)} blocks ({text})"]
        for place in self.places:
            low, high = (", ".join(f"{v:.2f}" for v in corner) for corner in (place.low, place.high))
            lines.append(f"  {place.kind}: {place.returns} returns in the box ({low}) to ({high}) m")
        return lines


@dataclass
class WatermarkReport:
    """Results of the watermark's test over all clouds.

    noise         : standard deviation in metres that the tests allow for
    expected_rate : share of wrong bits by that noise
    blocks        : that were tested
    chance        : blocks of them that noise alone makes alarm, on average
    """

    noise: float
    expected_rate: float
    clouds: int = 0
    bits: int = 0
    wrong: int = 0
    blocks: int = 0
    chance: float = 0.0
    tampered: int = 0
    frames: list[MarkedFrame] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)

    @property
    def error_rate(self) -> float:
        """Share of wrong bits."""
        return self.wrong / max(self.bits, 1)

    def add(self, verdict: FrameVerdict) -> None:
        """Count a cloud."""
        self.clouds += 1
        self.bits += verdict.bits
        self.wrong += verdict.wrong
        self.blocks += len(verdict.blocks.block)
        self.chance += float(verdict.blocks.chance.sum())
        self.tampered += len(verdict.blocks.tampered)


@dataclass(frozen=True)
class ChecksumReport:
    """Comparison with the checksums of a folder.

    files  : that have checksums
    digest : of the folder, hexadecimal; empty if it has no checksums
    """

    files: int
    digest: str
    findings: tuple[Finding, ...]


@dataclass(frozen=True)
class VerifyReport:
    """Results of watermark, hash chain and checksums; None for tests that were not run."""

    watermark: WatermarkReport | None = None
    chain: ChainReport | None = None
    checksums: ChecksumReport | None = None

    @property
    def intact(self) -> bool:
        """Whether nothing was found."""
        marks = self.watermark is None or not (self.watermark.frames or self.watermark.findings)
        lists = [one for one in (self.chain, self.checksums) if one is not None]
        return marks and not any(one.findings for one in lists)

    def to_json(self) -> dict[str, Any]:
        """The report as a document."""
        document: dict[str, Any] = {"intact": self.intact}
        if self.watermark is not None:
            rates = {"error_rate": self.watermark.error_rate}
            document["watermark"] = asdict(self.watermark) | rates
        if self.chain is not None:
            document["chain"] = asdict(self.chain)
        if self.checksums is not None:
            document["checksums"] = asdict(self.checksums)
        return document

    def to_text(self, name: str) -> list[str]:
        """Lines: what was found, and a summary of the dataset called ``name``."""
        lines = []
        if (sums := self.checksums) is not None:
            lines += [finding.to_text() for finding in sums.findings]
            found = _findings(sums.findings) or "all as written"
            lines.append(f"{name}: checksums of {sums.files:,} files: {found}")
        if (chain := self.chain) is not None:
            lines += [finding.to_text() for finding in chain.findings]
            counts = f"{chain.frames} frames, {chain.files} files"
            state = _findings(chain.findings) or "all as signed"
            lines.append(f"{name}: hash chain ({chain.algorithm}) of {counts}: {state}")
        if (marks := self.watermark) is not None:
            lines += [finding.to_text() for finding in marks.findings]
            lines += [line for frame in marks.frames for line in frame.to_text()]
            lines.append(
                f"{name}: watermark of {marks.clouds} clouds: {marks.wrong:,} of {marks.bits:,} bits wrong"
                f" ({marks.error_rate:.3g}; by {marks.noise:g} m of noise {marks.expected_rate:.3g});"
                f" {marks.tampered} of {marks.blocks:,} blocks tampered with"
                f" (by chance {marks.chance:.2g})"
            )
        return lines


def _findings(found: tuple[Finding, ...]) -> str:
    """The number of findings in words; empty without any."""
    return f"{len(found):,} finding{'s' * (len(found) > 1)}" if found else ""


def verify_dataset(
    path: str | Path,
    *,
    watermark: WatermarkKey | None = None,
    signer: Signer | None = None,
    noise: float = NOISE,
    false_alarms: float = 0.01,
    progress: Progress = silent,
) -> VerifyReport:
    """Find changes since a folder was written or, with keys, tampering since `sign_dataset`.

    Without ``watermark`` and ``signer`` the checksums of the folder, which may be at a URL, are compared:
    they find damage, but whoever changes files can also change them.

    noise        : standard deviation in metres that coordinates got since, such as by another format
    false_alarms : blocks of a cloud that the watermark's test may report wrongly

    Raises InputError and DatasetError for a dataset without a watermark or signature that is asked for, and
    for a folder that never had checksums.
    """
    if watermark is None and signer is None:
        return VerifyReport(checksums=_checksum_report(path, progress=progress))
    dataset = open_dataset(path)
    if not 0 <= noise <= 1:
        raise InputError(f"`noise` {noise:g}: give 0 to 1 metre")
    if not 0 < false_alarms <= 100:
        raise InputError(f"`false_alarms` {false_alarms:g}: give more than 0 and at most 100 blocks a cloud")
    chain = None if signer is None else _chain_report(dataset, signer, progress=progress)
    marks = None
    if watermark is not None:
        marks = _watermark_report(
            dataset, watermark, noise=noise, false_alarms=false_alarms, progress=progress
        )
    return VerifyReport(marks, chain)


def _checksum_report(path: str | Path, *, progress: Progress) -> ChecksumReport:
    folder = Path(path)
    if url := url_of(path):
        folder = cache_folder() / "datasets" / digest(url.encode())
        StoredFolder(url).mirror(folder, progress=progress)
    place = Paths(folder).checksums
    if not place.is_file():
        _check_lost(folder, shown(Path(path)))
        how = "files cannot be compared; the command that made the folder writes it again"
        return ChecksumReport(0, "", (Finding("missing", place.name, how),))
    stated = read_checksums(place)
    found = (
        Finding(one.what, one.name, one.detail) for one in differences(folder, stated, progress=progress)
    )
    return ChecksumReport(len(stated.sha256), stated.digest, tuple(found))


def _check_lost(folder: Path, name: str) -> None:
    """Check that a folder without checksums has lost them.

    Raises DatasetError for one that cannot have had them.
    """
    if not folder.is_dir():
        raise DatasetError(
            f"{name}: {'is a file; give its directory' if folder.exists() else 'is not there'}"
        )
    if Paths(folder).manifest.exists():
        dataset = open_dataset(folder)
        if dataset.manifest["frames_done"] != dataset.frames:
            raise DatasetError(f"{name}: the drive was not finished; the same lidar drive command resumes it")
    elif SceneFiles(folder).manifest.is_file():
        raise DatasetError(f"{name}: is a scene; geoscene validate checks it")
    else:
        raise DatasetError(
            f"{name}: has no {CHECKSUMS}, which folders written by lidar have; `watermark` and `chain`"
            " verify signed ones"
        )


def block_text(blocks: Ints, *, world: bool, most: int = 4) -> str:
    """Rings and directions of blocks in words.

    world : of a cloud in the world frame, whose sectors are parts of a turn in time
    """
    ring, sector = np.divmod(blocks, SECTORS)
    step = 360 // SECTORS
    words = []
    for r, s in zip(ring.tolist(), sector.tolist(), strict=True):
        turn = f"part {s + 1} of {SECTORS}" if world else f"{s * step - 180} to {(s + 1) * step - 180} deg"
        words.append(f"ring {r} {turn}")
    more = f" and {len(words) - most} more" if len(words) > most else ""
    return "; ".join(words[:most]) + more


def _watermark_report(
    dataset: Dataset, watermark: WatermarkKey, *, noise: float, false_alarms: float, progress: Progress
) -> WatermarkReport:
    found = WatermarkReport(noise, watermark.error_rate(noise))
    jobs = list(cloud_files(dataset))
    for done, file in enumerate(jobs):
        progress("watermark", done, total=len(jobs))
        where: dict[str, Any] = {"sensor": file.sensor, "frame": file.frame}
        try:
            cloud = file.read()
            verdict = frame_verdict(
                watermark, cloud.xyz, cells=cloud.cells, noise=noise, false_alarms=false_alarms
            )
        except LidarError as error:
            what = "cannot be read" if file.path.exists() else "missing"
            detail = "" if what == "missing" else str(error).removeprefix(f"{file.path}: ")
            found.findings.append(Finding(what, file.place, detail, **where))
            continue
        _check_coarseness(cloud, watermark)
        found.add(verdict)
        if len(verdict.blocks.tampered):
            blocks = tuple(verdict.blocks.tampered.tolist())
            forged = int(verdict.forged.sum())
            found.frames.append(
                MarkedFrame(
                    file.place,
                    **where,
                    blocks=blocks,
                    forged=forged,
                    places=verdict.places,
                    absent=verdict.absent,
                )
            )
    progress("watermark", len(jobs), total=len(jobs))
    return found


def _check_coarseness(cloud: MarkedCloud, watermark: WatermarkKey) -> None:
    """Raise InputError for coordinates that are rounded so much that no bit can be read."""
    least = (1 - SPREAD) * watermark.step / 2
    if cloud.step >= least:
        raise InputError(
            f"{cloud.place}: coordinates are multiples of {cloud.step:g} m; a watermark with a step of"
            f" {watermark.step:g} m needs less than {least:g} m"
        )


def _chain_report(dataset: Dataset, signer: Signer, *, progress: Progress) -> ChainReport:
    path = Paths(dataset.path).chain
    if not path.is_file():
        raise DatasetError(f"{dataset.path}: is not signed; lidar sign --chain signs it")
    with reading_file(path):
        text = path.read_text("utf-8")
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
        if path is None or not path.is_file():
            found.append(Finding("missing", name))
        elif file_sha256(path) != sha256:
            found.append(Finding("changed", name))
    return found


def _inside(dataset: Dataset, name: str) -> Path | None:
    """A file of the dataset; None for a path that leads out of it."""
    path = Path(name)
    return None if path.is_absolute() or ".." in path.parts else dataset.path / path


def _frames_found(
    dataset: Dataset,
    sensor: str,
    *,
    head: tuple[int, bytes],
    files: dict[int, list[str]],
    progress: Progress,
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
            if name not in own and not is_truth(Path(name)):
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
