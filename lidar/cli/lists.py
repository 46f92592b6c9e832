"""Commands that list the choices, and the check of this machine."""

from __future__ import annotations

import sys
from typing import Annotated

from geoscene.support.console import FAILURE, WORDS, print_json, progress_bar
from lidar.cli.program import JsonFlag, QuietFlag


def stages(*, json: JsonFlag = False) -> int:
    """List the stages that change measurements, with weather and attacks: parameters and meaning.

    Parameters
    ----------
    json
        Print them as JSON.
    """
    from geoscene.drawing.report import align_columns  # noqa: PLC0415
    from lidar.parameters import COLUMNS, parameter_cells  # noqa: PLC0415
    from lidar.signal.registry import stage_rows  # noqa: PLC0415

    rows = stage_rows()
    if json:
        print_json({"stages": rows})
        return 0
    cells = []
    for row in rows:
        meaning = f"{row['meaning']} Acts on: {', '.join(row['acts_on'])}."
        cells.append([row["name"], "", "", "", "", "", meaning])
        cells += [["", *line] for line in parameter_cells(row["parameters"])]
    print(align_columns([["name", "parameter", *COLUMNS], *cells]))
    print(
        "\nEvery stage also takes seed (of its random numbers; the drive's by default) and sensor (the only"
        "\none that it acts on): lidar drive SCENE --stage NAME:KEY=VALUE,KEY=VALUE"
        "\n(docs/reference/stages.md). Attacks, from inject to patch, are also values of --attack"
        "\n(docs/reference/attacks.md); weather has shorter texts for --weather (docs/reference/weather.md)."
    )
    return 0


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
    if json:
        print_json({"rigs": rows})
        return 0
    cells = [["name", "vehicle", "scanners", "cameras", "source"]]
    for row in rows:
        scanners = " ".join(row["lidars"].values())
        cells.append([row["name"], row["vehicle"], scanners, str(len(row["cameras"])), row["source"]])
    print(align_columns(cells))
    print(
        "\nA rig of your own is a TOML file: lidar drive SCENE --rig FILE.toml (docs/reference/sensors.md)."
    )
    return 0


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
    if json:
        print_json({"sensors": rows})
        return 0
    cells = [["name", "maker and model", "kind", "channels", "pulses/s", "Hz", "range m", "nm"]]
    for row in rows:
        reach = f"{row['min_range_m']:g}-{row['max_range_m']:g}"
        figures = [str(row["channels"]), f"{row['pulses_per_s']:,}", f"{row['rate_hz']:g}", reach]
        model = f"{row['maker']} {row['model']}"
        cells.append([row["name"], model, row["kind"], *figures, f"{row['wavelength_nm']:g}"])
    print(align_columns(cells))
    print(
        "\n--json adds the source of every number; a sensor of your own is a TOML file"
        "\n(docs/reference/sensors.md)."
    )
    return 0


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
    if json:
        print_json({"classes": rows, "materials": surfaces})
        return 0
    print(align_columns([list(rows[0]), *([str(value) for value in row.values()] for row in rows)]))
    print("\nMaterials: " + ", ".join(f"{code} {name}" for name, code in surfaces.items()))
    return 0


def settings(*, json: JsonFlag = False) -> int:
    """List the fidelity settings: values at each level, and meaning.

    Parameters
    ----------
    json
        Print them as JSON.
    """
    from geoscene.drawing.report import align_columns  # noqa: PLC0415
    from lidar.parameters import COLUMNS, parameter_cells, parameter_rows  # noqa: PLC0415
    from lidar.settings import levels, list_settings  # noqa: PLC0415
    from lidar.tools.odometry.settings import OdometrySettings  # noqa: PLC0415

    rows, of_odometry = list_settings(), parameter_rows(OdometrySettings)
    if json:
        documents = [
            {
                "name": s.name,
                "of": s.of,
                **dict(zip(levels(), s.values, strict=True)),
                "unit": s.unit,
                "meaning": s.meaning,
            }
            for s in rows
        ]
        print_json({"settings": documents, "odometry": of_odometry})
        return 0
    cells = [[s.name, s.of, *s.values, s.unit, s.meaning] for s in rows]
    print(align_columns([["name", "of", *levels(), "unit", "meaning"], *cells]))
    print(
        "\n--fidelity takes a level, --set NAME=VALUE changes one setting. Separate options: --exact"
        "\n(the full projection for every point), --deskew, --crs; of scenes: geoscene build --lod, --dem,"
        "\n--along.\n\nSettings of lidar odometry, by its own --set:\n"
    )
    print(align_columns([["name", *COLUMNS], *parameter_cells(of_odometry)]))
    return 0


def selftest(
    *,
    only: Annotated[tuple[str, ...], WORDS] = (),
    full: bool = False,
    json: JsonFlag = False,
    markdown: bool = False,
    quiet: QuietFlag = False,
) -> int:
    """Check on this machine that errors stay within documented bounds in extreme cases.

    Such as grazing rays, ranges of 100 km, places near the poles and zone borders, long drives and large
    scenes; docs/measurements/extremes.md lists them. Takes about 10 s. Exits with 1 if a bound does not hold.

    For example:

    lidar selftest --only places

    Parameters
    ----------
    only
        Groups of cases: rays, places, footprints, time, statistics, scale. All by default.
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
    if json:
        print_json(extremes.document(done))
    elif markdown:
        print(extremes.markdown(done))
    else:
        print(extremes.to_text(done))
    if broken:
        print(f"lidar: {broken} of {len(done)} bounds do not hold on this machine", file=sys.stderr)
    return FAILURE if broken else 0
