"""Records the drives of a matrix, measures them, and writes the results."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from geoscene.errors import need
from geoscene.support.files import exclusive
from geoscene.support.processes import run_tasks
from geoscene.support.progress import Progress, displayed, shows_progress
from lidar.tools.detection import RULES
from lidar.tools.detection.learned import read_detector
from lidar.tools.redteam.evaluate import Figures, evaluate
from lidar.tools.redteam.matrix import Matrix
from lidar.tools.redteam.measure import AttackCase, measure_drive
from lidar.tools.redteam.plan import RedteamPlan, Run, read_plan
from lidar.tools.redteam.report import write_report
from lidar.tools.sweep.run import check_folder, failure_text, record_drives


@dataclass(frozen=True, slots=True)
class RedTeamSummary:
    """A matrix that was measured.

    drives : names of the drives that were measured
    failed : reason by name of those that could not be recorded or measured
    """

    path: Path
    drives: tuple[str, ...]
    failed: dict[str, str]
    matrix: Matrix


@shows_progress
def redteam(
    file: str | Path,
    out: str | Path,
    *,
    workers: int = 1,
    overwrite: bool = False,
    progress: Progress = displayed,
) -> RedTeamSummary:
    """Record the drives of a matrix with and without attacks, judge them by defences, and write the results.

    Folder ``out`` gets ``drives`` (a sweep), ``figures`` (of each drive), ``redteam.json``, CSV tables and
    ``redteam.html``. What is there of the same drives and options is kept. A drive that fails is named in the
    results, and the others count. The bytes do not depend on ``workers``, but for times that were measured.

    Raises InputError for a file with an error, and MissingExtraError without matplotlib, before the first
    drive starts.
    """
    need("matplotlib", "plots")
    plan, folder = read_plan(Path(file)), Path(out)
    check_folder(folder, mark="drives/sweep.json", what="matrix")
    with exclusive(folder):
        folder.mkdir(parents=True, exist_ok=True)
        swept = record_drives(
            [run.drive for run in plan.runs],
            folder / "drives",
            source=Path(file).name,
            workers=workers,
            overwrite=overwrite,
            progress=progress,
        )
        failed = {row.name: row.error for row in swept.failed}
        figures = []
        for run, result in _results(plan, folder, failed=failed, workers=workers, progress=progress):
            if isinstance(result, str):
                failed[run.drive.name] = result
            else:
                figures.append(result)
        matrix = evaluate(figures, plan.attacks, measure=plan.measure)
        summary = RedTeamSummary(
            folder, tuple(dict.fromkeys(one.run.drive.name for one in figures)), failed, matrix
        )
        absent = sorted({name for one in figures for name in one.absent})
        write_report(summary.matrix, folder, plan=plan, failed=failed, absent=absent, source=Path(file).name)
    return summary


def _results(
    plan: RedteamPlan, folder: Path, *, failed: dict[str, str], workers: int, progress: Progress
) -> Iterator[tuple[Run, Figures | str]]:
    """Figures of the drives by each detector, in the order of the plan, or why there are none."""
    ready = [run for run in plan.runs if run.drive.name not in failed]
    for run in [run for run in ready if run.twin in failed]:
        yield run, f"the drive without attack failed: {failed[run.twin]}"
    ready = [run for run in ready if run.twin not in failed]
    both = [(run, name) for name in plan.measure.detector for run in ready]
    tasks = [(row, _case(run, name, plan=plan, folder=folder)) for row, (run, name) in enumerate(both)]
    several = len(plan.measure.detector) > 1
    found: dict[int, Figures | str] = {}
    progress("defences", 0, total=len(tasks))
    for row, result in run_tasks(_measure, tasks, workers=workers):
        run, name = both[row]
        if isinstance(result, str):
            found[row] = result
        else:
            found[row] = Figures(run, result["frames"], result["absent"], name if several else "")
        progress("defences", len(found), total=len(tasks))
    for row, (run, _) in enumerate(both):
        yield run, found[row]


def _case(run: Run, detector: str, *, plan: RedteamPlan, folder: Path) -> AttackCase:
    drives = folder.absolute() / "drives"
    identity = read_detector(detector).identity
    own = "" if identity == RULES.identity else f".{identity.rpartition(' ')[2]}"
    return AttackCase(
        drives / run.drive.name,
        drives / run.twin if run.attack is not None else None,
        folder.absolute() / "figures" / f"{run.drive.name}{own}.json",
        plan.defences,
        plan.measure.score,
        detector,
    )


def _measure(task: tuple[int, AttackCase]) -> tuple[int, dict[str, Any] | str]:
    """Number of a drive, and its figures or why there are none. Run by workers."""
    row, case = task
    try:
        return row, measure_drive(case)
    except Exception as error:  # noqa: BLE001 - one drive's defect must not end the others
        return row, failure_text(f"drive {case.path.name}", error)


def failed_drives(failed: dict[str, str]) -> Sequence[str]:
    """A line for each reason, with the drives that it concerns."""
    lines = []
    for error in dict.fromkeys(failed.values()):
        names = [name for name, reason in failed.items() if reason == error]
        more = f" and {len(names) - 1} more" if len(names) > 1 else ""
        lines.append(f"{names[0]}{more}: {error}")
    return lines
