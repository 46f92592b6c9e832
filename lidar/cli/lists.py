"""Commands that list the choices, and the check of this machine."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from operator import add
from typing import Annotated, Any

from geoscene.support.console import FAILURE, WORDS
from geoscene.support.progress import progress_bar
from lidar.cli.program import JsonFlag, QuietFlag, show


def stages(*, json: JsonFlag = False) -> int:
    """List the stages that change measurements, with weather and attacks: parameters and meaning.

    Parameters
    ----------
    json
        Print them as JSON.
    """
    from lidar.signal.registry import stage_rows  # noqa: PLC0415

    rows = stage_rows()
    table = _parameter_table(rows, [f" Acts on: {', '.join(row['acts_on'])}." for row in rows])
    note = (
        "Every stage also takes seed (of its random numbers; the drive's by default) and sensor (the only"
        "\none that it acts on): lidar drive SCENE --stage NAME:KEY=VALUE,KEY=VALUE"
        "\n(docs/reference/stages.md). Attacks, from inject to patch, are also values of --attack"
        "\n(docs/reference/attacks.md); weather has shorter texts for --weather (docs/reference/weather.md)."
    )
    return show({"stages": rows}, f"{table}\n\n{note}", json=json)


def defences(*, json: JsonFlag = False) -> int:
    """List the defences against spoofing, with their parameters.

    Parameters
    ----------
    json
        Print them as JSON.
    """
    from lidar.tools.defences.registry import defence_rows  # noqa: PLC0415

    rows = defence_rows()
    needs = [f" Needs: {', '.join(row['needs'])}." if row["needs"] else "" for row in rows]
    past = [f" Earlier frames: {row['history']}." if row["history"] else "" for row in rows]
    note = (
        "lidar defend DATASET --defence NAME,NAME:KEY=VALUE,KEY=VALUE judges recorded data"
        "\n(docs/reference/defences.md)."
    )
    table = _parameter_table(rows, list(map(add, needs, past)))
    return show({"defences": rows}, f"{table}\n\n{note}", json=json)


def _parameter_table(rows: Sequence[Mapping[str, Any]], notes: Iterable[str]) -> str:
    """A table of things with parameters; notes follow the meanings."""
    from geoscene.drawing.report import align_columns  # noqa: PLC0415
    from lidar.parameters import COLUMNS, parameter_cells  # noqa: PLC0415

    cells = []
    for row, note in zip(rows, notes, strict=True):
        cells.append([row["name"], *[""] * len(COLUMNS), f"{row['meaning']}{note}"])
        cells += [["", *line] for line in parameter_cells(row["parameters"])]
    return align_columns([["name", "parameter", *COLUMNS], *cells])


def rigs(*, json: JsonFlag = False) -> int:
    """List the built-in rigs.

    Parameters
    ----------
    json
        Print them as JSON, with all their values.
    """
    from geoscene.drawing.report import align_columns  # noqa: PLC0415
    from lidar.sensors.rig.devices import rig_rows  # noqa: PLC0415

    rows = rig_rows()
    cells = [["name", "vehicle", "scanners", "cameras", "source"]]
    for row in rows:
        scanners = " ".join(row["lidars"].values())
        cells.append([row["name"], row["vehicle"], scanners, str(len(row["cameras"])), row["source"]])
    note = "A rig of your own is a TOML file: lidar drive SCENE --rig FILE.toml (docs/reference/sensors.md)."
    return show({"rigs": rows}, f"{align_columns(cells)}\n\n{note}", json=json)


def sensors(*, json: JsonFlag = False) -> int:
    """List the built-in laser scanners.

    Parameters
    ----------
    json
        Print them as JSON, with the source of every number.
    """
    from geoscene.drawing.report import align_columns  # noqa: PLC0415
    from lidar.sensors.rig.devices import sensor_rows  # noqa: PLC0415

    rows = sensor_rows()
    cells = [["name", "maker and model", "kind", "channels", "pulses/s", "Hz", "range m", "nm"]]
    for row in rows:
        reach = f"{row['min_range_m']:g}-{row['max_range_m']:g}"
        figures = [str(row["channels"]), f"{row['pulses_per_s']:,}", f"{row['rate_hz']:g}", reach]
        model = f"{row['maker']} {row['model']}"
        cells.append([row["name"], model, row["kind"], *figures, f"{row['wavelength_nm']:g}"])
    note = (
        "--json adds the source of every number; a sensor of your own is a TOML file"
        "\n(docs/reference/sensors.md)."
    )
    return show({"sensors": rows}, f"{align_columns(cells)}\n\n{note}", json=json)


def classes(*, json: JsonFlag = False) -> int:
    """List the classes of points and pixels with their codes, also in other datasets, and materials.

    Parameters
    ----------
    json
        Print them as JSON.
    """
    from geoscene.classes import class_rows, materials  # noqa: PLC0415
    from geoscene.drawing.report import align_columns  # noqa: PLC0415

    rows, surfaces = class_rows(), {m.name: m.code for m in materials().values()}
    table = align_columns([list(rows[0]), *([str(value) for value in row.values()] for row in rows)])
    note = "Materials: " + ", ".join(f"{code} {name}" for name, code in surfaces.items())
    return show({"classes": rows, "materials": surfaces}, f"{table}\n\n{note}", json=json)


def settings(*, json: JsonFlag = False) -> int:
    """List the fidelity settings: values at each level, and meaning.

    Parameters
    ----------
    json
        Print them as JSON.
    """
    from geoscene.drawing.report import align_columns  # noqa: PLC0415
    from lidar.parameters import COLUMNS, parameter_cells, parameter_rows  # noqa: PLC0415
    from lidar.settings import setting_rows  # noqa: PLC0415
    from lidar.tools.odometry.settings import OdometrySettings  # noqa: PLC0415

    rows, of_odometry = setting_rows(), parameter_rows(OdometrySettings)
    note = (
        "--fidelity takes a level, --set NAME=VALUE changes one setting. Separate options: --exact"
        "\n(the full projection for every point), --deskew, --crs; of scenes: geoscene build --lod, --dem,"
        "\n--along.\n\nSettings of lidar odometry, by its own --set:"
    )
    tables = [
        [list(rows[0]), *map(list, map(dict.values, rows))],
        [["name", *COLUMNS], *parameter_cells(of_odometry)],
    ]
    text = f"\n\n{note}\n\n".join(map(align_columns, tables))
    return show({"settings": rows, "odometry": of_odometry}, text, json=json)


def selftest(
    *,
    only: Annotated[tuple[str, ...], WORDS] = (),
    full: bool = False,
    json: JsonFlag = False,
    markdown: bool = False,
    quiet: QuietFlag = False,
) -> int:
    """Check on this machine that errors stay within documented bounds in extreme cases.

    Such as grazing rays, ranges of 100 km, wires and fences within a footprint, places near the poles and
    zone borders, long drives and large scenes; docs/measurements/extremes.md lists them. Takes about 20 s.
    Exits with 1 if a bound does not hold.

    For example:

    lidar selftest --only places

    Parameters
    ----------
    only
        Groups of cases: rays, pulses, places, footprints, time, statistics, scale. All by default.
    full
        Measure as many samples as in the documentation, up to 100 million a case; takes tens of minutes.
    json
        Print the table and the machine as JSON.
    markdown
        Print the table as in docs/measurements/extremes.md.
    quiet
        Show no progress bars.
    """
    from lidar.tools.selftest import run as extremes  # noqa: PLC0415

    with progress_bar(quiet=quiet) as progress:
        done = list(extremes.outcomes(only, full=full, progress=progress))
    broken = sum(not one.ok for one in done)
    show(extremes.document(done), extremes.markdown(done) if markdown else extremes.to_text(done), json=json)
    if broken:
        print(f"lidar: {broken} of {len(done)} bounds do not hold on this machine", file=sys.stderr)
    return FAILURE if broken else 0
