"""Results of a matrix as JSON, CSV tables and a page with plots."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from geoscene import __version__
from geoscene.drawing.charts import Axes, Span, curves, spans
from geoscene.drawing.report import Column, Page, ReportTable, share, table_of
from geoscene.support.columns import write_columns
from geoscene.support.files import write_atomically, write_json
from lidar.tools.redteam.matrix import (
    AttackDetection,
    DefenceCost,
    DetectorAccuracy,
    Matrix,
    Rate,
    Success,
    document_of,
    rate,
)
from lidar.tools.redteam.measure import FEWEST
from lidar.tools.redteam.plan import (
    PUBLISHED_ATTACKS,
    PUBLISHED_DEFENCES,
    Attack,
    PublishedResult,
    RedteamPlan,
)

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
    page = Page(f"Attacks and defences: {source}")
    _fill(page, matrix, plan=plan, failed=failed, absent=absent)
    write_atomically(folder / "redteam.html", page.encoded())
    write_json(folder / REPORT, document | tables)


_CURVES = ("genuine", "attacked", "fpr", "tpr")
"""Parts of a score that are no columns of a table."""


def _flat(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row of one level; the ROC is left out."""
    flat: dict[str, Any] = {}
    for name, value in row.items():
        if isinstance(value, dict):
            prefix = "" if name == "setting" else f"{name}_"
            flat |= {f"{prefix}{key}": part for key, part in _flat(value).items() if key not in _CURVES}
        elif name == "auc":
            flat |= dict(zip(("auc", "auc_low", "auc_high"), value, strict=True))
        elif name != "roc":
            flat[name] = "" if value is None else value
    return flat


def words_of(setting: Mapping[str, str]) -> str:
    """Description of a setting."""
    return ", ".join(f"{name} {_value(name, text)}" for name, text in setting.items()) or "one setting"


def _value(name: str, text: str) -> str:
    """A value of an option in words."""
    if not text:
        return "clear" if name == "weather" else f"no {name}"
    return Path(text).stem if text.endswith(".toml") else text


def short_names(settings: Sequence[Mapping[str, str]]) -> list[str]:
    """Settings by the values of the options in which they differ; files without their folders and endings."""
    varied = [name for name in settings[0] if len({setting.get(name) for setting in settings}) > 1] or list(
        settings[0]
    )
    return [
        " ".join(_value(name, setting.get(name, "")) for name in varied) or "plain" for setting in settings
    ]


def _settings(rows: Iterable[Success | AttackDetection]) -> list[dict[str, str]]:
    """The different settings of rows."""
    return list({str(row.setting): row.setting for row in rows}.values())


def _fill(
    page: Page, matrix: Matrix, *, plan: RedteamPlan, failed: Mapping[str, str], absent: Sequence[str]
) -> None:
    """Write the page of a matrix."""
    pooled, measure = matrix.of_all_scenes, plan.measure
    frames, objects = share(measure.false_alarms), share(measure.false_objects)
    page.paragraph(_METHOD.format(m=measure, frames=frames, objects=objects))
    for name, reason in failed.items():
        page.paragraph(f"Not measured: {name}: {reason}")
    page.paragraph(f"Some drives lack the data of defences: {', '.join(absent)}." if absent else "")
    page.heading("Success of attacks")
    page.table(success_table(matrix, published=plan.attacks))
    page.picture(_success_picture(pooled.success, plan.attacks), alt="Success of attacks")
    settings = _settings(pooled.success)
    if len(settings) > 1:
        page.heading("Settings side by side")
        for table in setting_tables(matrix):
            page.table(table)
    for setting in settings:
        page.heading(f"Detection: {words_of(setting)}")
        mine = [row for row in pooled.detection if row.setting == setting]
        for level, what in (("frames", "attacked frames"), ("objects", "forged objects")):
            if some := [row for row in mine if row.level == level]:
                page.table(alarm_table(some, title=f"Share of {what} with an alarm"))
                page.table(_area_table(some, title=f"Area under the ROC, {what}"))
        of_frames = [row for row in mine if row.level == "frames"]
        page.table(_residual_table(of_frames))
        _draw_curves(page, of_frames, allowed=measure.false_alarms)
    page.heading("Latency and cost of defences")
    page.table(_cost_table(pooled))
    page.heading("Published figures of defences")
    page.table(table_of(_PUBLISHED, PUBLISHED_DEFENCES.items()))
    page.heading("The detector without attacks")
    page.paragraph(f"Road users with {FEWEST} returns or more, by distance.")
    page.table(_accuracy_table(pooled.accuracy))


_PUBLISHED: tuple[Column[tuple[str, PublishedResult]], ...] = (
    Column("defence", lambda row: row[0]),
    Column("published", lambda row: row[1].text),
    Column("source", lambda row: row[1].source),
)


def _published(attack: str, attacks: Sequence[Attack]) -> PublishedResult | None:
    """The published success of an attack."""
    return PUBLISHED_ATTACKS.get(next((one.published for one in attacks if one.name == attack), ""))


def success_table(matrix: Matrix, *, published: Sequence[Attack] = ()) -> ReportTable:
    """Success over all scenes, beside published figures if attacks are given."""
    columns: list[Column[Success]] = [
        Column("attack", lambda row: row.attack),
        Column("setting", lambda row: words_of(row.setting)),
        Column("goal", lambda row: row.goal),
        Column("frames attacked", lambda row: f"{row.attacked} of {row.frames}"),
        Column("success", lambda row: row.success.to_text()),
        Column("added", lambda row: _number(row.added)),
        Column("lost", lambda row: _number(row.lost)),
    ]

    def source(row: Success) -> str:
        band = _published(row.attack, published)
        return f"{band.text} [{band.source}]" if band else ""

    columns += [Column("published", source)] if published else []
    return table_of(columns, matrix.of_all_scenes.success)


def _number(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.0f}"


def _success_picture(rows: Sequence[Success], attacks: Sequence[Attack]) -> bytes:
    settings = _settings(rows)
    short = dict(zip(map(str, settings), short_names(settings), strict=True)) if settings else {}
    marks = []
    for row in rows:
        band = _published(row.attack, attacks)
        bounds = None
        if band is not None and band.low is not None:
            bounds = band.low, 1.0 if band.high is None else band.high
        name = f"{row.attack}, {short[str(row.setting)]}" if len(settings) > 1 else row.attack
        marks.append(Span(name, row.success.share, (row.success.low, row.success.high), bounds))
    return spans(marks, title="Success with 95 % intervals")


Cell = tuple[str, float]
"""Text and shade of a cell."""


def _shaded(
    what: str, names: Sequence[str], *, lines: Mapping[str, Sequence[Cell]], title: str
) -> ReportTable:
    """A table with a line for each row and a shaded column for each name; ``what`` is the first heading."""
    texts = [(row, *(text for text, _ in cells)) for row, cells in lines.items()]
    shades = [(math.nan, *(shade for _, shade in cells)) for cells in lines.values()]
    return ReportTable(title, (what, *names), tuple(texts), tuple(shades))


def _cell(one: Rate) -> Cell:
    return one.to_text(), one.share


def setting_tables(matrix: Matrix) -> list[ReportTable]:
    """Tables with a column for each setting, over all scenes.

    One has the success of each attack; the others have the frames with an alarm of each defence, without
    attack and with each attack.
    """
    success = matrix.of_all_scenes.success
    detection = [row for row in matrix.of_all_scenes.detection if row.level == "frames"]
    settings = _settings(success)
    names = short_names(settings)
    attacks = list(dict.fromkeys(row.attack for row in success))
    defences = list(dict.fromkeys(row.defence for row in detection))

    def line(rates: Mapping[tuple[str, str], Rate], row: str) -> list[Cell]:
        return [_cell(rates.get((row, str(setting)), rate(0, 0, blocks=0))) for setting in settings]

    succeeded = {(row.attack, str(row.setting)): row.success for row in success}
    genuine = {(row.defence, str(row.setting)): row.genuine for row in detection}
    by_attack = {attack: line(succeeded, attack) for attack in attacks}
    by_defence = {defence: line(genuine, defence) for defence in defences}
    found = [
        _shaded("attack", names, lines=by_attack, title="Success by setting"),
        _shaded("defence", names, lines=by_defence, title="Frames with an alarm without attack"),
    ]
    for attack in attacks:
        alarmed = {(row.defence, str(row.setting)): row.attacked for row in detection if row.attack == attack}
        by_defence = {defence: line(alarmed, defence) for defence in defences}
        title = f"Attacked frames with an alarm: {attack}"
        found.append(_shaded("defence", names, lines=by_defence, title=title))
    return found


def detection_tables(matrix: Matrix) -> list[ReportTable]:
    """Alarmed frames over all scenes, a table for each setting."""
    rows = [row for row in matrix.of_all_scenes.detection if row.level == "frames"]
    found = []
    for setting in _settings(rows):
        mine = [row for row in rows if row.setting == setting]
        found.append(alarm_table(mine, title=f"Frames with an alarm: {words_of(setting)}"))
    return found


def _by_attack(
    rows: Sequence[AttackDetection], cell: Callable[[AttackDetection], Cell]
) -> tuple[list[str], dict[str, list[Cell]]]:
    """The defences, and their cells by attack."""
    defences = list(dict.fromkeys(row.defence for row in rows))
    attacks = list(dict.fromkeys(row.attack for row in rows))
    by_pair = {(row.attack, row.defence): cell(row) for row in rows}
    return defences, {attack: [by_pair[attack, defence] for defence in defences] for attack in attacks}


def alarm_table(rows: Sequence[AttackDetection], *, title: str) -> ReportTable:
    """Shares with an alarm by attack and defence; the first line is without attack."""
    defences, lines = _by_attack(rows, lambda row: _cell(row.attacked))
    plain = {row.defence: _cell(row.genuine) for row in reversed(rows)}
    lines = {"without attack": [plain[defence] for defence in defences], **lines}
    return _shaded("attack", defences, lines=lines, title=title)


def _residual_table(rows: Sequence[AttackDetection]) -> ReportTable:
    """The success of attacks that is left: the less, the darker."""
    defences, lines = _by_attack(rows, lambda row: (row.residual.to_text(), 1 - row.residual.share))
    return _shaded("attack", defences, lines=lines, title="Success of the attack without an alarm")


def _area_table(rows: Sequence[AttackDetection], *, title: str) -> ReportTable:
    defences, lines = _by_attack(rows, lambda row: (_area(row.score.auc), 2 * row.score.auc[0] - 1))
    return _shaded("attack", defences, lines=lines, title=title)


def _area(area: tuple[float, float, float]) -> str:
    value, low, high = area
    if math.isnan(value):
        return "–"
    return f"{value:.2f}" if math.isnan(low) else f"{value:.2f} ({low:.2f} to {high:.2f})"


def _draw_curves(page: Page, rows: Sequence[AttackDetection], *, allowed: float) -> None:
    """Add the ROC of frames for each attack, with the areas and the allowed false alarms."""
    for attack in dict.fromkeys(row.attack for row in rows):
        mine = [row for row in rows if row.attack == attack and row.score.roc]
        lines = {f"{row.defence} {row.score.auc[0]:.2f}": row.score.roc for row in mine}
        title = f"ROC of frames with areas: {attack}; threshold at {share(allowed)} false alarms"
        axes = Axes(title, "false alarms", "detected")
        page.picture(curves(lines, axes, mark=allowed), alt=f"ROC of {attack}")


def _cost_table(matrix: Matrix) -> ReportTable:
    """Time of each defence for a frame, and until its first alarm."""

    def attacked(cost: DefenceCost) -> list[AttackDetection]:
        return [
            row
            for row in matrix.detection
            if row.level == "frames" and row.defence == cost.defence and row.setting == cost.setting
        ]

    def latency(cost: DefenceCost) -> str:
        known = sorted(row.latency for row in attacked(cost) if math.isfinite(row.latency))
        return f"{known[len(known) // 2]:.1f} s" if known else "–"

    def alarmed(cost: DefenceCost) -> str:
        rows = attacked(cost)
        return f"{sum(row.alarmed for row in rows)} of {sum(row.drives for row in rows)}"

    columns: tuple[Column[DefenceCost], ...] = (
        Column("defence", lambda cost: cost.defence),
        Column("setting", lambda cost: words_of(cost.setting)),
        Column("per frame", lambda cost: f"{1000 * cost.seconds:.1f} ms"),
        Column("first alarm after", latency),
        Column("attacked drives with an alarm", alarmed),
    )
    return table_of(columns, matrix.cost)


_ACCURACY: tuple[Column[DetectorAccuracy], ...] = (
    Column("kind", lambda row: row.kind),
    Column("setting", lambda row: words_of(row.setting)),
    Column("distance", lambda row: f"{row.near} to {row.far} m"),
    Column("road users", lambda row: str(row.recall.count)),
    Column("recall", lambda row: row.recall.to_text()),
    Column("precision", lambda row: row.precision.to_text()),
    Column("false per frame", lambda row: f"{row.false_per_frame:.2f}"),
)


def _accuracy_table(rows: Iterable[DetectorAccuracy]) -> ReportTable:
    """The detector's table; lines without road users and detections are left out."""
    return table_of(_ACCURACY, (row for row in rows if row.recall.count or row.precision.count))
