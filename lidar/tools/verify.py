"""Verification of checksums, watermark and signed hash chain of datasets."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from geoscene.scene.layout import SceneFiles
from geoscene.support.digests import digest
from geoscene.support.progress import Progress, displayed, shows_progress
from geoscene.support.storage import StoredFolder, cache_folder, shown, url_of
from lidar.dataset.checksums import CHECKSUMS, differences, read_checksums
from lidar.dataset.layout import Dataset, DatasetLike, Paths, open_dataset
from lidar.errors import DatasetError, InputError, LidarError
from lidar.tools.integrity.chain import ChainReport, Finding, block_text, verify_chain
from lidar.tools.integrity.keys import Signer
from lidar.tools.integrity.marked_clouds import cloud_files
from lidar.tools.integrity.tampering import NOISE, FrameVerdict, Place, frame_verdict
from lidar.tools.integrity.watermark import SPREAD, WatermarkKey


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


@shows_progress
def verify_dataset(
    path: DatasetLike,
    *,
    watermark: WatermarkKey | None = None,
    signer: Signer | None = None,
    noise: float = NOISE,
    false_alarms: float = 0.01,
    progress: Progress = displayed,
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
    chain = None if signer is None else verify_chain(dataset, signer, progress=progress)
    marks = None
    if watermark is not None:
        marks = _watermark_report(
            dataset, watermark, noise=noise, false_alarms=false_alarms, progress=progress
        )
    return VerifyReport(marks, chain)


def _checksum_report(path: DatasetLike, *, progress: Progress) -> ChecksumReport:
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
        if cloud.step >= (least := (1 - SPREAD) * watermark.step / 2):  # no bit can be read
            raise InputError(
                f"{file.place}: coordinates are multiples of {cloud.step:g} m; a watermark with a step of"
                f" {watermark.step:g} m needs less than {least:g} m"
            )
        found.add(verdict)
        if len(verdict.blocks.tampered):
            blocks, forged = tuple(verdict.blocks.tampered.tolist()), int(verdict.forged.sum())
            marks = file.place, file.sensor, file.frame, blocks, forged, verdict.places, verdict.absent
            found.frames.append(MarkedFrame(*marks))
    progress("watermark", len(jobs), total=len(jobs))
    return found
