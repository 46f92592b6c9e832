"""Runs the benchmark: building, reading, casting, driving, writing, mapping and growth.

    make bench [ARGS="--only casting writing --repetitions 9"]     whole run, over half an hour
    make bench-quick                                               the demo, a few minutes
    PYTHONPATH=benchmarks python -m bench compare A.json B.json    two runs on one machine

Each case is the same work by several sides that take turns in one process: ours and a reference. Writes
bench.json, bench.md and bench.html after each subject. HELIOS++ joins by --helios PROGRAM.

Growth is measured to 10^4 buildings, 4 million triangles (4 GiB of memory) and 500 frames (0.5 GB of disk) in
about five minutes. With --full it goes to 10^5 buildings, 12 million triangles (10 GiB), 10^4 road users and
2,000 frames (2 GB), in about seven minutes more, and casting to 5 million triangles. A size that takes ten
seconds is measured once.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in both programs: its threads wait busily for work

from bench import casting, helios, machine
from bench.compare import compared
from bench.curves import growth
from bench.measure import BenchError, apart
from bench.report import Run, document, machine_text, print_table, tables, write_report
from bench.scenes import Setup
from bench.subjects import SUBJECTS, results
from geoscene.errors import GeosceneError
from lidar.errors import LidarError

_QUICK, _WHOLE = 2, 5
"""Repetitions of a quick and of a whole run."""


def main() -> int:
    """Run or compare; returns 2 for what cannot be measured or compared."""
    given = _arguments()
    try:
        if given.command == "compare":
            table, differences = compared(given.first, given.second)
            print_table(table)
            print("\n".join([table.text, *differences]))
        else:
            _run(given)
    except (GeosceneError, LidarError) as error:
        print(f"bench: {error}", file=sys.stderr)
        return 2
    return 0


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="bench", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="the demo and small sizes")
    parser.add_argument(
        "--full",
        action="store_true",
        help="the greatest sizes of growth",
    )
    parser.add_argument("--only", nargs="+", choices=SUBJECTS, default=[], help="subjects to measure")
    parser.add_argument("--repetitions", type=int, help=f"of each measurement ({_WHOLE}; quick {_QUICK})")
    parser.add_argument("--helios", type=Path, metavar="PROGRAM", help="HELIOS++ to compare with")
    parser.add_argument("--buildings", type=int, nargs="+", default=[], help="sizes of the growth curve")
    parser.add_argument("--out", type=Path, default=Path("bench"), help="folder of the report (bench)")
    parser.add_argument("--json", action="store_true", help="print bench.json instead of tables")
    kinds = parser.add_subparsers(dest="command")
    two = kinds.add_parser("compare", help="ratios of two runs on one machine")
    two.add_argument("first", type=Path)
    two.add_argument("second", type=Path)
    return parser.parse_args()


def _run(given: argparse.Namespace) -> None:
    repetitions = given.repetitions or (_QUICK if given.quick else _WHOLE)
    if repetitions < 1:
        raise BenchError(f"--repetitions {repetitions}: give 1 or more")
    if given.quick and given.full:
        raise BenchError("--quick --full: give one of them")
    if given.helios and not given.helios.exists():
        raise BenchError(f"--helios {given.helios}: no such program")
    subjects = given.only or [name for name in SUBJECTS if name != "helios" or given.helios]
    options = {"quick": given.quick, "repetitions": repetitions, "subjects": subjects}
    run = Run(machine.described(), options)
    run.notes += machine.warnings_about(run.machine)
    run.notes += casting.missing() if "casting" in subjects else []
    if given.helios:
        run.notes.append(f"HELIOS++ is {helios.version(given.helios)}")
    else:
        run.notes.append("HELIOS++ was not measured: give its program by --helios")
    for note in run.notes:
        print(f"note: {note}", file=sys.stderr)
    with tempfile.TemporaryDirectory() as folder:
        setup = Setup(
            given.quick, repetitions, Path(folder), given.helios, tuple(given.buildings), given.full
        )
        for subject in subjects:
            print(f"measuring {subject}", file=sys.stderr, flush=True)
            began = time.perf_counter()
            if subject == "growth":
                run.curves += growth(setup)
            else:
                run.results += apart(results, subject, setup)
            run.seconds[subject] = time.perf_counter() - began
            write_report(run, given.out)
    late = machine.warnings_about(run.machine, machine.load())
    run.notes += [note for note in late if note not in run.notes]
    write_report(run, given.out)
    if given.json:
        print(json.dumps(document(run), indent=1))
        return
    print(machine_text(run.machine))
    for table in tables(run):
        print_table(table)
    print("\n".join([*run.notes, f"took {run.took}", f"report: {given.out / 'bench.html'}"]))


if __name__ == "__main__":
    sys.exit(main())
