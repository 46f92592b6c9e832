"""Commands that judge, sign and verify recorded data."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from geoscene.support.console import (
    FAILURE,
    Report,
    command_line,
    note_new_folder,
    number,
    whole,
)
from geoscene.support.progress import progress_bar
from lidar.cli.program import JsonFlag, Out, QuietFlag, Reporting, show
from lidar.errors import InputError
from lidar.options.security import DefendOptions, SignOptions
from lidar.options.shared import OUTPUT


def defend(
    *datasets: Path,
    options: DefendOptions,
    out: Annotated[Path | None, Parameter(name=["--out", "-o"], group=OUTPUT)] = None,
    report: Reporting = Report(),
) -> int:
    """Judge recorded frames by defences against spoofing, and score the verdicts against ground truth.

    Defences see what the sensors measured, never labels or truth files. Thresholds are those that a stated
    share of genuine returns, objects and frames passes.

    For example:

    lidar defend drive --defence occlusion,shadow -o verdicts

    lidar defend drive --defence all --fuse max --json

    lidar defend drive --defence shadow --detector learned --calibrate -o learned.toml

    lidar defend drive --defence all --calibrate -o calibration.toml

    Parameters
    ----------
    datasets
        Directories or URLs of datasets, which are judged together.
    out
        Directory to write the verdicts to: defend.json, frames.csv, objects.csv and an archive of suspicions
        of returns per frame; with --calibrate the TOML file.
    """
    from geoscene.scene import open_scene  # noqa: PLC0415
    from lidar.dataset.layout import open_dataset  # noqa: PLC0415
    from lidar.tools.defences.calibration import read_calibration  # noqa: PLC0415
    from lidar.tools.defences.defend import calibrate, score_table  # noqa: PLC0415
    from lidar.tools.defences.defend import defend as judged  # noqa: PLC0415
    from lidar.tools.defences.registry import read_defences  # noqa: PLC0415
    from lidar.tools.detection.learned import read_detector  # noqa: PLC0415

    if not datasets:
        raise InputError("`datasets`: give one or more")
    if options.calibrate and out is None:
        raise InputError("`calibrate`: give `out`, the file to write")
    if out is not None:
        note_new_folder(out)
    if options.calibrate and out is not None and (out.is_dir() or (out.exists() and not report.overwrite)):
        what = (
            "is a directory; give a file" if out.is_dir() else "exists already; set `overwrite` to replace it"
        )
        raise InputError(f"{out}: {what}")
    chosen, detector = read_defences(options.defences), read_detector(options.detector)
    opened = [open_dataset(path) for path in datasets]
    scene = None if options.scene is None else open_scene(options.scene)
    if options.calibrate and out is not None:
        with progress_bar(quiet=report.quiet) as progress:
            made = calibrate(
                opened,
                chosen,
                detector=detector,
                scene=scene,
                out=out,
                seed=options.seed,
                progress=progress,
            )
        return show({"path": str(out), "note": made.note}, f"{out}: {made.note}", json=report.json)
    calibration = read_calibration(options.calibration, detector=detector)
    with progress_bar(quiet=report.quiet) as progress:
        found = judged(
            opened,
            chosen,
            calibration=calibration,
            detector=detector,
            rule="" if options.fuse == "none" else options.fuse,
            scene=scene,
            out=out,
            overwrite=report.overwrite,
            seed=options.seed,
            progress=progress,
        )
    return show(found.document(), score_table(found).to_text(), json=report.json)


def train(
    *datasets: Path,
    out: Out,
    seed: Annotated[int, Parameter(converter=whole)] = 0,
    trees: Annotated[int, Parameter(converter=whole)] = 60,
    every: Annotated[int, Parameter(converter=whole)] = 1,
    workers: Annotated[int, Parameter(group=OUTPUT, converter=whole)] = 2,
    report: Reporting = Report(),
) -> int:
    """Train a detector of road users on the labelled clouds of drives.

    Needs scikit-learn (pip install 'geoscene[learn]'); what uses the model does not.

    For example:

    lidar train drive1 drive2 drive3 -o model.npz

    Parameters
    ----------
    datasets
        Directories of datasets with traffic, recorded without attacks.
    out
        File to write the model to, for --detector of lidar defend and detector of lidar redteam.
    seed
        Seed of the forest. The same data, options and seed give the same file.
    trees
        Trees of the forest.
    every
        Use each frame of that number: those that follow each other are nearly the same.
    workers
        Processes that read the clouds. The model does not depend on it.
    """
    from geoscene.drawing.report import align_columns  # noqa: PLC0415
    from lidar.tools.train import train as trained  # noqa: PLC0415

    if not datasets:
        raise InputError("`datasets`: give one or more")
    if out.is_dir() or (out.exists() and not report.overwrite):
        raise InputError(f"{out}: exists already; set `overwrite` to replace it, or give another file")
    with progress_bar(quiet=report.quiet) as progress:
        made = trained(datasets, out, seed=seed, trees=trees, every=every, workers=workers, progress=progress)
    words = command_line("lidar", "defend", datasets[0], "--detector", out)
    text = f"{align_columns(made.table())}\n{out}: {made.frames} frames; next: {words} ..."
    return show(made.to_json(), text, json=report.json)


def sign(
    dataset: Path,
    /,
    *,
    options: SignOptions = SignOptions(),
    out: Annotated[Path | None, Parameter(name=["--out", "-o"], group=OUTPUT)] = None,
    report: Reporting = Report(),
) -> int:
    """Sign recorded data: a watermark in point clouds, a signed hash chain over files, or both.

    For example:

    lidar sign drive --watermark secret.key --chain secret.key -o signed

    lidar sign drive --chain private.pem

    Parameters
    ----------
    dataset
        Directory of the dataset.
    out
        Directory to write to; without it, the hash chain is added to the dataset itself.
    """
    from lidar.tools.integrity.keys import read_secret, read_signer  # noqa: PLC0415
    from lidar.tools.integrity.watermark import WatermarkKey  # noqa: PLC0415
    from lidar.tools.sign import sign_dataset  # noqa: PLC0415

    if out is not None:
        note_new_folder(out)
    mark = None if options.watermark is None else WatermarkKey(read_secret(options.watermark), options.step)
    signer = None if options.chain is None else read_signer(options.chain)
    with progress_bar(quiet=report.quiet) as progress:
        summary = sign_dataset(
            dataset, out, watermark=mark, signer=signer, overwrite=report.overwrite, progress=progress
        )
    parts = [f"watermark in {summary.marked} clouds, points moved by {summary.rms * 1000:.1f} mm rms"]
    chained = f"{summary.frames} frames and {summary.files} files in a signed hash chain"
    parts = (parts if mark else []) + ([chained] if signer else [])
    document = {**asdict(summary), "path": str(summary.path)}
    return show(document, f"{summary.path}: {'; '.join(parts)}", json=report.json)


def verify(
    dataset: Path,
    /,
    *,
    options: SignOptions = SignOptions(),
    noise: Annotated[float, Parameter(converter=number)] = 0.001,
    false_alarms: Annotated[float, Parameter(converter=number)] = 0.01,
    json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> int:
    """Find changed, lost or added files, and with keys the manipulation of signed data.

    Without keys all files are compared with checksums.sha256. With keys the watermark, the signed hash chain
    or both are verified: files, frames, blocks of a ring by 10 degrees, points. Exits with 1 if anything is
    found.

    For example:

    lidar verify drive

    lidar verify signed --watermark secret.key --chain secret.key

    Parameters
    ----------
    dataset
        Directory of the dataset or export; without keys also a URL.
    noise
        Standard deviation in metres that coordinates got since the watermark, such as by another format.
    false_alarms
        Blocks a cloud that the watermark's test may report without tampering, on average.
    json
        Print all findings as JSON.
    quiet
        Show no progress bars.
    """
    from lidar.tools.integrity.keys import read_secret, read_signer  # noqa: PLC0415
    from lidar.tools.integrity.watermark import WatermarkKey  # noqa: PLC0415
    from lidar.tools.verify import verify_dataset  # noqa: PLC0415

    mark = None if options.watermark is None else WatermarkKey(read_secret(options.watermark), options.step)
    signer = None if options.chain is None else read_signer(options.chain)
    with progress_bar(quiet=quiet) as progress:
        found = verify_dataset(
            dataset,
            watermark=mark,
            signer=signer,
            noise=noise,
            false_alarms=false_alarms,
            progress=progress,
        )
    show(found.to_json(), "\n".join(found.to_text(str(dataset))), json=json)
    return 0 if found.intact else FAILURE
