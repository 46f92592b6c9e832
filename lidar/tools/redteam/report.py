"""Results of a matrix as JSON, CSV tables and a page with plots."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from geoscene import __version__
from geoscene.drawing.charts import (
    Axes,
    Span,
    curves,
    html_matrix,
    html_page,
    html_picture,
    html_table,
    spans,
)
from geoscene.drawing.figures import share
from geoscene.support.csv_tables import write_columns
from geoscene.support.files import write_atomically, write_json
from lidar.tools.redteam.evaluate import AttackDetection, DetectorAccuracy, Matrix, Success, document_of
from lidar.tools.redteam.measure import FEWEST
from lidar.tools.redteam.plan import Attack, RedteamPlan
from lidar.tools.redteam.published import ATTACKS, DEFENCES, PublishedResult
from lidar.tools.redteam.statistics import Rate, rate

REPORT = "redteam.json"

_METHOD = (
    "Intervals are 95 %: Wilson's with as many trials as blocks of {m.block:g} s; of areas under the ROC, the"
    " percentiles of a bootstrap of these blocks. A detection counts from score {m.score:g} on. Thresholds"
    " are those that {frames} of the frames and {objects} of the objects of the same sensor pass without"
    " attack and weather. Published figures are of other detectors, sensors and data."
)


def write_report(
    matrix: Matrix,
    folder: Path,
    *,
    plan: RedteamPlan,
    failed: Mapping[str, str],
    absent: Sequence[str],
    source: str,
) -> None:
    """Write ``redteam.json``, a CSV file of each table, and ``redteam.html``.

    failed : reason by name of drives that are not in the matrix
    absent : defences whose needs the data of some drive lack
    source : name of the file that describes the matrix
    """
    document: dict[str, Any] = {
        "schema": 1,
        "generator": f"geoscene lidar {__version__}",
        "file": source,
        "attacks": [{"name": a.name, "attack": a.option, "goal": a.goal} for a in plan.attacks],
        "defences": [named.to_json() for named in plan.defences],
        "measure": {name: getattr(plan.measure, name) for name in plan.measure.__dataclass_fields__},
        "failed": dict(failed),
        "absent": list(absent),
    }
    tables = {
        name: document_of(getattr(matrix, name)) for name in ("success", "detection", "accuracy", "cost")
    }
    for name, rows in tables.items():
        flat = [_flat(row) for row in rows]
        columns = list(dict.fromkeys(key for row in flat for key in row))
        if flat:
            write_columns(
                folder / f"{name}.csv", {key: [row.get(key, "") for row in flat] for key in columns}
            )
    page = html_page(f"Attacks and defences: {source}", _body(matrix, plan, failed=failed, absent=absent))
    write_atomically(folder / "redteam.html", page)
    write_json(folder / REPORT, document | tables)


def _flat(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row of one level; the ROC is left out."""
    flat: dict[str, Any] = {}
    for name, value in row.items():
        if isinstance(value, dict):
            own = {} if name == "setting" else {"": name}
            prefix = f"{own['']}_" if own else ""
            flat |= {
                f"{prefix}{key}": part
                for key, part in _flat(value).items()
                if key not in ("genuine", "attacked", "fpr", "tpr")
            }
        elif name == "auc":
            flat |= dict(zip(("auc", "auc_low", "auc_high"), value, strict=True))
        elif name != "roc":
            flat[name] = "" if value is None else value
    return flat


def words_of(setting: Mapping[str, str]) -> str:
    """A setting in words."""
    return ", ".join(f"{name} {_value(name, text)}" for name, text in setting.items()) or "one setting"


def _body(matrix: Matrix, plan: RedteamPlan, *, failed: Mapping[str, str], absent: Sequence[str]) -> str:
    pooled = matrix.of_all_scenes
    settings = list({str(row.setting): row.setting for row in pooled.success}.values())
    measure = plan.measure
    frames, objects = share(measure.false_alarms), share(measure.false_objects)
    parts = [
        f"<p>{_METHOD.format(m=measure, frames=frames, objects=objects)}</p>",
        *(f"<p>Not measured: {name}: {reason}</p>" for name, reason in failed.items()),
        *([f"<p>Some drives lack the data of defences: {', '.join(absent)}.</p>"] if absent else []),
        "<h2>Success of attacks</h2>",
        _success_table(pooled, plan.attacks),
        html_picture(_success_picture(pooled.success, plan.attacks), alt="Success of attacks"),
    ]
    if len(settings) > 1:
        parts += ["<h2>Settings side by side</h2>"]
        for title, table, shades in setting_tables(pooled):
            parts += [f"<h3>{title}</h3>", html_matrix(table[0], table[1:], shades=shades)]
    for setting in settings:
        parts += [f"<h2>Detection: {words_of(setting)}</h2>"]
        mine = [row for row in pooled.detection if row.setting == setting]
        for level, what in (("frames", "attacked frames"), ("objects", "forged objects")):
            some = [row for row in mine if row.level == level]
            if some:
                parts += [f"<h3>Share of {what} with an alarm</h3>", _detection_matrix(some)]
                parts += [f"<h3>Area under the ROC, {what}</h3>", _area_matrix(some)]
        of_frames = [row for row in mine if row.level == "frames"]
        parts += ["<h3>Success of the attack without an alarm</h3>", _residual_matrix(of_frames)]
        parts += [_curves(of_frames, allowed=measure.false_alarms)]
    parts += [
        "<h2>Latency and cost of defences</h2>",
        _cost_table(pooled),
        "<h2>Published figures of defences</h2>",
        html_table(
            ("defence", "published", "source"),
            [(name, band.text, band.source) for name, band in DEFENCES.items()],
        ),
        "<h2>The detector without attacks</h2>",
        f"<p>Road users with {FEWEST} returns or more, by distance.</p>",
        _accuracy_table(pooled.accuracy),
    ]
    return "".join(parts)


def _band(attack: str, attacks: Sequence[Attack]) -> PublishedResult | None:
    return next((ATTACKS[one.published] for one in attacks if one.name == attack and one.published), None)


def success_rows(matrix: Matrix) -> list[list[str]]:
    """Texts of the table of success over all scenes, with a head."""
    found = [["attack", "setting", "goal", "frames attacked", "success", "added", "lost"]]
    found += [
        [
            *(row.attack, words_of(row.setting), row.goal, f"{row.attacked} of {row.frames}"),
            *(row.success.to_text(), _number(row.added), _number(row.lost)),
        ]
        for row in matrix.of_all_scenes.success
    ]
    return found


def setting_tables(matrix: Matrix) -> list[tuple[str, list[list[str]], list[list[float]]]]:
    """Titles, texts and shares of tables that have a column for each setting, over all scenes.

    One has the success of each attack; the others have the frames with an alarm of each defence, without
    attack and with each attack. The tables of texts have heads.
    """
    success = matrix.of_all_scenes.success
    detection = [row for row in matrix.of_all_scenes.detection if row.level == "frames"]
    settings = list({str(row.setting): row.setting for row in success}.values())
    names = short_names(settings)
    none = rate(0, 0, blocks=0)
    attacks, defences = (
        list(dict.fromkeys(values))
        for values in ((row.attack for row in success), (row.defence for row in detection))
    )
    succeeded = {(row.attack, str(row.setting)): row.success for row in success}
    genuine = {(row.defence, str(row.setting)): row.genuine for row in detection}
    lines = {
        "Success by setting": ("attack", attacks, succeeded),
        "Frames with an alarm without attack": ("defence", defences, genuine),
    }
    for attack in attacks:
        alarmed = {(row.defence, str(row.setting)): row.attacked for row in detection if row.attack == attack}
        lines[f"Attacked frames with an alarm: {attack}"] = ("defence", defences, alarmed)
    found = []
    for title, (what, rows, rates) in lines.items():
        cells = [[rates.get((row, str(setting)), none) for setting in settings] for row in rows]
        texts = [[row, *(one.to_text() for one in line)] for row, line in zip(rows, cells, strict=True)]
        found.append((title, [[what, *names], *texts], [[one.share for one in line] for line in cells]))
    return found


def short_names(settings: Sequence[Mapping[str, str]]) -> list[str]:
    """Settings by the values of the options in which they differ; files without their folders and endings."""
    varied = [name for name in settings[0] if len({setting.get(name) for setting in settings}) > 1] or list(
        settings[0]
    )
    return [
        " ".join(_value(name, setting.get(name, "")) for name in varied) or "plain" for setting in settings
    ]


def _value(name: str, text: str) -> str:
    """A value of an option in words."""
    if not text:
        return "clear" if name == "weather" else f"no {name}"
    return Path(text).stem if text.endswith(".toml") else text


def detection_tables(matrix: Matrix) -> list[tuple[str, list[list[str]]]]:
    """Titles and texts of tables of alarmed frames over all scenes, one for each setting, with heads."""
    rows = [row for row in matrix.of_all_scenes.detection if row.level == "frames"]
    tables = []
    for setting in {str(row.setting): row.setting for row in rows}.values():
        defences, lines, names = detection_rows([row for row in rows if row.setting == setting])
        texts = [[name, *(one.to_text() for one in line)] for name, line in zip(names, lines, strict=True)]
        tables.append((f"Frames with an alarm: {words_of(setting)}", [["attack", *defences], *texts]))
    return tables


def _number(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.0f}"


def _success_table(matrix: Matrix, attacks: Sequence[Attack]) -> str:
    head, *lines = success_rows(matrix)
    bands = [_band(line[0], attacks) for line in lines]
    texts = [f"{band.text} [{band.source}]" if band else "" for band in bands]
    return html_table([*head, "published"], [[*line, text] for line, text in zip(lines, texts, strict=True)])


def _success_picture(rows: Sequence[Success], attacks: Sequence[Attack]) -> bytes:
    settings = list({str(row.setting): row.setting for row in rows}.values())
    short = dict(zip(map(str, settings), short_names(settings), strict=True)) if settings else {}
    marks = []
    for row in rows:
        band = _band(row.attack, attacks)
        bounds = None
        if band is not None and band.low is not None:
            bounds = band.low, 1.0 if band.high is None else band.high
        name = f"{row.attack}, {short[str(row.setting)]}" if len(settings) > 1 else row.attack
        marks.append(Span(name, row.success.share, (row.success.low, row.success.high), bounds))
    return spans(marks, title="Success with 95 % intervals")


def detection_rows(rows: Sequence[AttackDetection]) -> tuple[list[str], list[list[Rate]], list[str]]:
    """Defences, shares with an alarm by attack and defence, and the attacks; the first is no attack."""
    defences = list(dict.fromkeys(row.defence for row in rows))
    attacks = list(dict.fromkeys(row.attack for row in rows))
    by_pair = {(row.attack, row.defence): row for row in rows}
    plain = [next(row.genuine for row in rows if row.defence == defence) for defence in defences]
    lines = [[by_pair[attack, defence].attacked for defence in defences] for attack in attacks]
    return defences, [plain, *lines], ["without attack", *attacks]


def _detection_matrix(rows: Sequence[AttackDetection]) -> str:
    defences, lines, names = detection_rows(rows)
    texts = [[name, *(one.to_text() for one in line)] for name, line in zip(names, lines, strict=True)]
    return html_matrix(["attack", *defences], texts, shades=[[one.share for one in line] for line in lines])


def _residual_matrix(rows: Sequence[AttackDetection]) -> str:
    """What is left of the success of attacks: the less, the darker."""
    defences, _, (_, *attacks) = detection_rows(rows)
    by_pair = {(row.attack, row.defence): row.residual for row in rows}
    lines = [[by_pair[attack, defence] for defence in defences] for attack in attacks]
    texts = [[name, *(one.to_text() for one in line)] for name, line in zip(attacks, lines, strict=True)]
    return html_matrix(
        ["attack", *defences], texts, shades=[[1 - one.share for one in line] for line in lines]
    )


def _area_matrix(rows: Sequence[AttackDetection]) -> str:
    defences = list(dict.fromkeys(row.defence for row in rows))
    attacks = list(dict.fromkeys(row.attack for row in rows))
    by_pair = {(row.attack, row.defence): row.score.auc for row in rows}
    lines = [[by_pair[attack, defence] for defence in defences] for attack in attacks]
    texts = [[name, *map(_area, line)] for name, line in zip(attacks, lines, strict=True)]
    return html_matrix(
        ["attack", *defences], texts, shades=[[2 * area[0] - 1 for area in line] for line in lines]
    )


def _area(area: tuple[float, float, float]) -> str:
    value, low, high = area
    if math.isnan(value):
        return "–"
    return f"{value:.2f}" if math.isnan(low) else f"{value:.2f} ({low:.2f} to {high:.2f})"


def _curves(rows: Sequence[AttackDetection], *, allowed: float) -> str:
    """A picture of the ROC of frames for each attack, with the areas and the allowed false alarms."""
    pictures = []
    for attack in dict.fromkeys(row.attack for row in rows):
        mine = [row for row in rows if row.attack == attack and row.level == "frames" and row.score.roc]
        lines = {f"{row.defence} {row.score.auc[0]:.2f}": row.score.roc for row in mine}
        title = f"ROC of frames with areas: {attack}; threshold at {share(allowed)} false alarms"
        axes = Axes(title, "false alarms", "detected", lambda value: f"{value:g}")
        pictures.append(html_picture(curves(lines, axes, mark=allowed), alt=f"ROC of {attack}"))
    return "".join(pictures)


def _cost_table(matrix: Matrix) -> str:
    rows = []
    for cost in matrix.cost:
        mine = [
            row
            for row in matrix.detection
            if row.level == "frames" and row.defence == cost.defence and row.setting == cost.setting
        ]
        known = sorted(row.latency for row in mine if math.isfinite(row.latency))
        alarmed, drives = (sum(getattr(row, name) for row in mine) for name in ("alarmed", "drives"))
        latency = f"{known[len(known) // 2]:.1f} s" if known else "–"
        ms = f"{1000 * cost.seconds:.1f} ms"
        rows.append((cost.defence, words_of(cost.setting), ms, latency, f"{alarmed} of {drives}"))
    return html_table(
        ("defence", "setting", "per frame", "first alarm after", "attacked drives with an alarm"), rows
    )


def accuracy_rows(rows: Iterable[DetectorAccuracy]) -> list[list[str]]:
    """Texts of the detector's table, with a head; lines without road users and detections are left out."""
    found = [["kind", "setting", "distance", "road users", "recall", "precision", "false per frame"]]
    found += [
        [
            *(row.kind, words_of(row.setting), f"{row.near} to {row.far} m", str(row.recall.count)),
            *(row.recall.to_text(), row.precision.to_text(), f"{row.false_per_frame:.2f}"),
        ]
        for row in rows
        if row.recall.count or row.precision.count
    ]
    return found


def _accuracy_table(rows: Iterable[DetectorAccuracy]) -> str:
    head, *lines = accuracy_rows(rows)
    return html_table(head, lines)
