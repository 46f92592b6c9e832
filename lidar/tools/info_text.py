"""Descriptions of recorded data as text for a terminal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import fields
from typing import Any

from geoscene.drawing.report import align_columns
from lidar.errors import InputError
from lidar.signal.registry import STAGES

_TOLD = ("kind", "amount", "shape")
"""Parameters of stages that are stated also if they have their default."""


def info_text(document: Mapping[str, Any]) -> str:
    """The document of `lidar.tools.info.describe` as lines."""
    rows = _dataset_rows(document) if document["kind"] == "dataset" else _folder_rows(document)
    lines = [str(document["path"]), *(f"  {title:<12} {text}" for title, text in rows if text)]
    if "sensors" in document:
        lines += ["", align_columns(_sensor_table(document["sensors"])), *_sensor_notes(document["sensors"])]
    if classes := document.get("classes"):
        lines += ["", align_columns(_class_table(classes))]
    return "\n".join([*lines, "", align_columns(_size_table(document["size"]))])


def _dataset_rows(d: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    recipe, crs, scene = d["recipe"], d["crs"], d["scene"]
    state = "" if d["finished"] else "; not finished: the same lidar drive command resumes it"
    yield (
        "drive",
        f"{d['start_time']}, {d['duration_s']:.1f} s, {d['length_m']:,.1f} m, rig {d['rig']}{state}",
    )
    traffic = ", ".join(f"{k} {_short(v)}" for k, v in d["traffic"].items() if v not in (None, ""))
    route, fidelity = str(recipe.get("route", ""))[:60], recipe.get("fidelity", "")
    changed = "".join(f", {name}={value}" for name, value in d["settings"].items())
    yield "options", f"route {route}, seed {d['seed']}, fidelity {fidelity}{changed}"
    yield "traffic", traffic or "none"
    for stage in d["stages"]:
        yield stage["group"], _stage_text(stage)
    yield "denoised", d["denoised"]
    if place := d["extent"]:
        lon = f"lon {place['west']:.6f} to {place['east']:.6f}"
        lat = f"lat {place['south']:.6f} to {place['north']:.6f}"
        low, high = (round(place[name], 1) + 0.0 for name in ("low_m", "high_m"))  # without -0.0
        yield "extent", f"{lon}, {lat}, h {low:.1f} to {high:.1f} m"
    yield "CRS", f"scene {crs['scene']}, heights {crs['vertical']}; LAS and maps {crs['export']}"
    digest = f", digest {scene['digest']}" if scene.get("digest") else ""
    relief = f", relief {scene['relief']}" if scene.get("relief") else ""
    yield "scene", f"{scene.get('name') or scene.get('path', '')}{relief}{digest}"
    for source in d["sources"]:
        words = (source.get(key, "") for key in ("kind", "from", "timestamp", "licence"))
        yield "source", " ".join(str(word) for word in words if word)
    yield "attribution", d["attribution"]
    yield "made by", ", ".join([d["generator"], *(f"{k} {v}" for k, v in d["versions"].items())])
    yield from _state_rows(d, d["derived_from"])
    if d.get("road_users"):
        yield "road users", ", ".join(f"{count} {name}" for name, count in d["road_users"].items())


def _folder_rows(d: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    known = d["provenance"]
    yield "kind", d["kind"]
    for place, row in d["clouds"].items():
        broken = (
            f"; size is no whole number of points: {', '.join(row['damaged'][:3])}" if row["damaged"] else ""
        )
        yield "clouds", f"{place}: {row['frames']:,} {row['format']} clouds, {row['points']:,} points{broken}"
    for stage in d["stages"]:
        yield stage["group"], _stage_text(stage)
    yield "attribution", str(known.get("attribution", ""))
    yield "made by", str(known.get("generator", ""))
    yield from _state_rows(d, known.get("derived_from", ()))


def _state_rows(d: Mapping[str, Any], parents: Any) -> Iterator[tuple[str, str]]:
    """Parents, checksums and signatures."""
    for step in parents:
        yield "made from", f"{step.get('from', '')[:16]} by {step.get('by', '')}"
    sums = d["checksums"]
    yield (
        "checksums",
        f"of {sums['files']:,} files, digest {sums['digest'][:16]} (lidar verify compares them)"
        if sums
        else "none",
    )
    marked = d.get("watermark_step_m")
    signed = ["a signed hash chain"] if d["signed"] else []
    signed += [f"a watermark with steps of {marked} m"] if marked else []
    yield "signed", " and ".join(signed)


def _stage_text(stage: Mapping[str, Any]) -> str:
    """Name of a stage, with its sensor and its parameters that differ from the default."""
    usual: dict[str, Any] = {"seed": None, "sensor": ""}
    with suppress(InputError):  # a stage of another version
        usual |= {f.name: f.default for f in fields(STAGES.find(stage["name"])) if f.name not in _TOLD}
    own = {k: v for k, v in stage.items() if k not in ("group", "name") and v != usual.get(k)}
    return ": ".join(filter(None, (stage["name"], ", ".join(f"{k}={_short(v)}" for k, v in own.items()))))


def _short(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _sensor_table(sensors: Mapping[str, Any]) -> list[list[str]]:
    names = [
        "Hz",
        "frames, samples",
        "missing",
        "gaps",
        "points",
        "per frame",
        "x y z m",
        "roll pitch yaw deg",
    ]
    out = [["sensor", "kind", "model", *names]]
    for name, row in sensors.items():
        count = row.get("frames", row.get("samples"))
        per_frame = row.get("points_per_frame")
        cells = [
            f"{row.get('measured_hz', row['rate_hz']):g}",
            "" if count is None else f"{count:,}",
            f"{row['missing']['count']:,}" if "missing" in row else "",
            f"{row['gaps']['count']:,}" if "gaps" in row else "",
            f"{row['points']:,}" if row.get("points") is not None else "",
            f"{per_frame['fewest']:,} to {per_frame['most']:,}" if per_frame else "",
            " ".join(f"{v:g}" for v in row["mount"]["xyz_m"]),
            " ".join(f"{v:g}" for v in row["mount"]["roll_pitch_yaw_deg"]),
        ]
        out.append([name, row["kind"], row["model"], *cells])
    return out


def _sensor_notes(sensors: Mapping[str, Any]) -> Iterator[str]:
    """Missing frames and gaps, a line for each sensor that has some."""
    for name, row in sensors.items():
        if (lost := row.get("missing")) and lost["count"]:
            more = " ..." if lost["count"] > len(lost["first"]) else ""
            yield f"{name}: frames without all their files: {' '.join(map(str, lost['first']))}{more}"
        if (gaps := row.get("gaps")) and gaps["count"]:
            more = " ..." if gaps["count"] > len(gaps["first"]) else ""
            spans = ", ".join(f"{a:g} to {b:g} s" for a, b in gaps["first"])
            yield f"{name}: gaps, the longest of {gaps['longest_s']:g} s: {spans}{more}"


def _class_table(classes: Mapping[str, Mapping[str, int]]) -> list[list[str]]:
    names = list(dict.fromkeys(name for counts in classes.values() for name in counts))
    rows = [[name, *(f"{counts.get(name, 0):,}" for counts in classes.values())] for name in names]
    return [["class", *(f"points of {sensor}" for sensor in classes)], *rows]


def _size_table(size: Mapping[str, Any]) -> list[list[str]]:
    rows = [[kind, f"{row['files']:,}", f"{row['bytes'] / 1e6:,.2f}"] for kind, row in size["kinds"].items()]
    return [["files", "number", "MB"], *rows, ["all", f"{size['files']:,}", f"{size['bytes'] / 1e6:,.2f}"]]
