"""Matrix of attacks and defences: its file, its figures against known ones, and a small one from drives."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.programs import run_program

from geoscene.classes import Class
from geoscene.scene import Scene
from lidar.errors import InputError
from lidar.tools.redteam import redteam
from lidar.tools.redteam.evaluate import Figures, evaluate
from lidar.tools.redteam.matrix import rate
from lidar.tools.redteam.measure import KIND_OF
from lidar.tools.redteam.plan import Attack, Measure, Run, read_plan
from lidar.tools.redteam.report import setting_tables
from lidar.tools.sweep.grid import read_grid

PHANTOM = '[[attack]]\nname = "phantom"\nattack = "inject:shape=object"\ngoal = "forge"\npublished = "pla"\n'
DAZZLE = '[[attack]]\nname = "dazzle"\nattack = "remove:method=saturation,width=40"\ngoal = "hide"\n'


@pytest.fixture
def written(scene: Scene, tmp_path: Path) -> Callable[..., Path]:
    """Writes a file of a matrix of short drives."""

    def write(rest: str = PHANTOM, *, drive: str = "", grid: str = "seed = [1]") -> Path:
        path = tmp_path / "matrix.toml"
        head = f'[drive]\nrig = "vlp16"\nduration = 0.3\nroute = "random"\n{drive}\n'
        path.write_text(f'{head}[grid]\nscene = ["{scene.path}"]\n{grid}\n{rest}', "utf-8")
        return path

    return write


@pytest.mark.parametrize(
    ("hits", "count", "low", "high"), [(8, 10, 0.4902, 0.9433), (0, 20, 0.0, 0.1611), (20, 20, 0.8389, 1.0)]
)
def test_intervals_are_those_of_wilson(hits: int, count: int, low: float, high: float) -> None:
    found = rate(hits, count, blocks=count)
    assert (found.low, found.high) == pytest.approx((low, high), abs=1e-4)


def test_frames_of_one_block_are_one_trial() -> None:
    many, few = rate(50, 100, blocks=100), rate(50, 100, blocks=10)
    assert few.high - few.low > 2 * (many.high - many.low)
    assert math.isnan(rate(0, 0, blocks=0).share)


@pytest.mark.full
def test_each_drive_has_one_without_attack(written: Callable[..., Path]) -> None:
    plan = read_plan(written(PHANTOM + DAZZLE, grid='seed = [1, 2]\nweather = ["", "fog=50m"]'))
    assert len(plan.runs) == 12
    for run in plan.runs:
        twin = next(other for other in plan.runs if other.drive.name == run.twin)
        assert twin.attack is None
        assert {k: v for k, v in run.drive.values.items() if k != "attack"} == {
            k: v for k, v in twin.drive.values.items() if k != "attack"
        }
    assert {run.attack.name for run in plan.runs if run.attack} == {"phantom", "dazzle"}


@pytest.mark.parametrize(
    ("rest", "message"),
    [
        ("", "no attacks"),
        (PHANTOM + PHANTOM, "two attacks are named phantom"),
        (PHANTOM.replace("forge", "scare"), "goal 'scare' is unknown"),
        (PHANTOM.replace("pla", "plaa"), "is pla meant"),
        (PHANTOM.replace("goal", "gaol"), "is goal meant"),
        (PHANTOM.replace("inject:", "inyect:"), "inyect"),
        (PHANTOM.replace("shape=object", "shape=ghost"), "ghost"),
        (PHANTOM + '[defences]\nuse = ["ocklusion"]', "ocklusion"),
        (PHANTOM + "[measure]\nscore = 2", "score = 2"),
        (PHANTOM + "[measure]\nrate = 2", "parameter 'rate' is unknown"),
        (PHANTOM + "[more]\na = 1", "table 'more' is unknown"),
        (PHANTOM + '[measure]\ndetector = "rulez"', "give rules, learned, or the file of a model"),
        (PHANTOM + '[measure]\ndetector = ["rules", "rules"]', "give one or more that differ"),
        (PHANTOM + "[measure]\ndetector = 3", "give a name or a list of names"),
    ],
)
def test_a_file_with_an_error_is_refused(written: Callable[..., Path], rest: str, message: str) -> None:
    path = written(rest)
    with pytest.raises(InputError, match=message) as caught:
        read_plan(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_attacks_and_defences_may_be_tables(written: Callable[..., Path]) -> None:
    texts = read_plan(written(PHANTOM + '[defences]\nuse = ["occlusion:core=0.7", "shadow"]'))
    phantom = PHANTOM.replace('"inject:shape=object"', '{name = "inject", shape = "object"}')
    tables = read_plan(written(phantom + '[defences]\nuse = [{name = "occlusion", core = 0.7}, "shadow"]'))
    assert (tables.attacks, tables.defences) == (texts.attacks, texts.defences)


def test_attacks_are_no_options_of_drives(written: Callable[..., Path]) -> None:
    with pytest.raises(InputError, match="attack is an option of the tables"):
        read_plan(written(drive='attack = "inject"'))


def _frame(second: float, *, suspicion: float, forged: int = 0, targets: int = 0, hidden: int = 0) -> Any:
    """A frame with one genuine and some forged objects, all of which the detector reports."""
    n = 1 + forged
    return {
        "sensor": "lidar",
        "frame": round(10 * second),
        "seconds": second,
        "added": 30 * forged,
        "lost": 0,
        "objects": {
            "score": [0.9] * n,
            "distance": [10.0] * n,
            "kind": ["vehicle"] * n,
            "forged": [False] + [True] * forged,
            "user": [1] + [-1] * forged,
        },
        "suspicion": {"guard": suspicion},
        "object_suspicion": {"guard": [0.1] + [suspicion] * forged},
        "cost": {"guard": 0.02},
        "targets": targets,
        "hidden": hidden,
        "images": 0,
        "fix_error": 0.0,
        "users": [{"id": 1, "kind": "vehicle", "distance": 10.0, "points": 50}],
    }


@pytest.mark.full
def test_known_figures_give_known_rates(written: Callable[..., Path]) -> None:
    drives = read_grid(written("", grid="seed = [1, 2]"))
    attack = Attack("phantom", "inject", "forge")
    plain = [_frame(k / 10, suspicion=k / 100) for k in range(100)]
    changed = [_frame(k / 10, suspicion=0.99 if k >= 40 else 0.5, forged=1) for k in range(80)]
    untouched = [_frame(8 + k / 10, suspicion=0.1) for k in range(20)]
    conditions = {"scene": "city"}
    found = evaluate(
        [
            Figures(Run(drives[0], None, conditions, drives[0].name), plain, []),
            Figures(Run(drives[1], attack, conditions, drives[0].name), changed + untouched, []),
        ],
        [attack],
        measure=Measure(),
    )
    (success,) = found.success
    assert (success.frames, success.attacked) == (100, 80)
    assert (success.success.share, success.success.blocks, success.added) == (1.0, 8, 30)
    frames, objects = found.detection
    assert (frames.level, objects.level) == ("frames", "objects")
    assert frames.genuine.share == pytest.approx(0.05)
    assert frames.attacked.share == 0.5
    assert objects.attacked.share == 1.0
    assert objects.genuine.share == 0.0
    assert objects.residual.share == 0.0
    assert frames.latency == pytest.approx(4.0)
    assert frames.score.auc[0] == pytest.approx((40 * 99.5 + 40 * 50.5) / 80 / 100, abs=0.01)
    (near, *_) = [row for row in found.accuracy if row.recall.count]
    assert (near.kind, near.near, near.far) == ("vehicle", 10, 20)
    assert (near.recall.share, near.precision.share, near.false_per_frame) == (1.0, 1.0, 0.0)
    assert found.cost[0].seconds == pytest.approx(0.02)


def test_a_hidden_road_user_counts_while_no_alarm_is_raised(written: Callable[..., Path]) -> None:
    drives = read_grid(written("", grid="seed = [1, 2]"))
    attack = Attack("dazzle", "remove", "hide")
    plain = [_frame(k / 10, suspicion=0.1) for k in range(40)]
    changed = [_frame(k / 10, suspicion=0.9 * (k % 2), targets=2, hidden=1) | {"lost": 50} for k in range(40)]
    found = evaluate(
        [
            Figures(Run(drives[0], None, {}, drives[0].name), plain, []),
            Figures(Run(drives[1], attack, {}, drives[0].name), changed, []),
        ],
        [attack],
        measure=Measure(),
    )
    assert found.success[0].success.share == 0.5
    assert {row.level for row in found.detection} == {"frames"}
    assert found.detection[0].attacked.share == 0.5
    assert found.detection[0].residual.share == 0.25


def test_defences_together_notice_what_each_notices(written: Callable[..., Path]) -> None:
    drives = read_grid(written("", grid="seed = [1, 2]"))
    attack = Attack("phantom", "inject", "forge")
    rng = np.random.default_rng(0)

    def frames(*, attacked: bool) -> list[Any]:
        found = []
        for k in range(400):
            frame = _frame(k / 10, suspicion=0.0, forged=int(attacked))
            values = dict(zip(("a", "b", "c"), rng.uniform(0, 0.9, 3), strict=True))
            if attacked:
                values["abc"[k % 3]] = 1.0
            found.append(frame | {"suspicion": values, "object_suspicion": {}})
        return found

    found = evaluate(
        [
            Figures(Run(drives[0], None, {}, drives[0].name), frames(attacked=False), []),
            Figures(Run(drives[1], attack, {}, drives[0].name), frames(attacked=True), []),
        ],
        [attack],
        measure=Measure(),
    )
    shares = {row.defence: row.attacked.share for row in found.detection if row.level == "frames"}
    assert max(shares[name] for name in "abc") < 0.5
    assert shares["fused"] > 0.99
    assert next(row for row in found.detection if row.defence == "fused").genuine.share <= 0.05


def test_a_fix_that_is_off_misleads(written: Callable[..., Path]) -> None:
    drives = read_grid(written("", grid="seed = [1, 2]"))
    attack = Attack("drift", "gnss_spoof", "mislead")
    plain = [_frame(k / 10, suspicion=0.1) for k in range(40)]
    changed = [_frame(k / 10, suspicion=0.9 * (k >= 30)) | {"fix_error": k / 20} for k in range(40)]
    found = evaluate(
        [
            Figures(Run(drives[0], None, {}, drives[0].name), plain, []),
            Figures(Run(drives[1], attack, {}, drives[0].name), changed, []),
        ],
        [attack],
        measure=Measure(deviation=1.0),
    )
    (success,) = found.success
    assert (success.attacked, success.success.hits) == (39, 20)  # the first frame is as without attack
    assert found.detection[0].residual.hits == 10
    assert found.detection[0].latency == pytest.approx(2.9)


def test_settings_stand_side_by_side_and_attacks_are_ordered(written: Callable[..., Path]) -> None:
    drives = read_grid(written("", grid="seed = [1, 2]"))
    weak, strong = Attack("weak", "inject", "forge"), Attack("strong", "remove", "forge")
    figures = []
    for k, weather in enumerate(("", "fog=100m")):
        conditions = {"rig": "rigs/mine.toml", "weather": weather}
        plain = [_frame(j / 10, suspicion=0.1 + 0.5 * k) for j in range(40)]
        figures.append(Figures(Run(drives[0], None, conditions, "plain"), plain, []))
        for attack, forged in ((weak, k), (strong, 1)):
            changed = [_frame(j / 10, suspicion=0.9, forged=forged) | {"lost": 50} for j in range(40)]
            figures.append(Figures(Run(drives[1], attack, conditions, "plain"), changed, []))
    found = evaluate(figures, [weak, strong], measure=Measure())
    assert list(dict.fromkeys(row.attack for row in found.success)) == ["strong", "weak"]
    tables = {table.title: table for table in setting_tables(found)}
    success = tables["Success by setting"]
    assert success.head == ("attack", "clear", "fog=100m")
    assert [line[0] for line in success.rows] == ["strong", "weak"]
    shares = {title: [line[1:] for line in table.shades] for title, table in tables.items()}
    assert shares["Success by setting"] == [(1.0, 1.0), (0.0, 1.0)]
    assert shares["Frames with an alarm without attack"] == [(0.0, 1.0)]
    assert shares["Attacked frames with an alarm: weak"] == [(1.0, 1.0)]


def test_areas_of_one_block_have_no_interval(written: Callable[..., Path]) -> None:
    drives = read_grid(written("", grid="seed = [1, 2]"))
    attack = Attack("phantom", "inject", "forge")
    found = {}
    for seconds in (1, 3):
        plain = [_frame(k / 10, suspicion=k / 100) for k in range(10 * seconds)]
        changed = [_frame(k / 10, suspicion=0.05 + k / 100, forged=1) for k in range(10 * seconds)]
        figures = [
            Figures(Run(drives[0], None, {}, drives[0].name), plain, []),
            Figures(Run(drives[1], attack, {}, drives[0].name), changed, []),
        ]
        found[seconds] = evaluate(figures, [attack], measure=Measure()).detection[0].score.auc
    assert np.isfinite(found[1][0])
    assert np.isnan(found[1][1:]).all()
    assert np.isfinite(found[3]).all()


SPOOFED = """
[[attack]]
name = "cube"
attack = "placed_object:ahead=8"
goal = "forge"

[[attack]]
name = "spoofed fixes"
attack = "gnss_spoof:kind=step,left=5,start=0"
goal = "mislead"

[defences]
use = ["shadow"]
"""


@pytest.mark.full
def test_attacks_without_truth_files_of_clouds_are_told_from_the_drive_without_attack(
    written: Callable[..., Path], tmp_path: Path
) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text(
        'name = "mine"\n[[lidar]]\nname = "top"\npreset = "vlp16"\ntranslation = [1.2, 0.0, 1.9]\n'
        '[[gnss]]\nname = "gnss"\ntranslation = [0.6, 0.0, 1.6]\n[[imu]]\nname = "imu"\n',
        "utf-8",
    )
    file = written(SPOOFED)
    file.write_text(file.read_text("utf-8").replace('rig = "vlp16"', f'rig = "{rig}"'), "utf-8")
    found = redteam(file, tmp_path / "out")
    assert found.failed == {}
    cube, spoofed = found.matrix.success
    assert cube.attacked == cube.frames
    assert cube.added > 50
    assert spoofed.success.share == 1.0


@pytest.mark.full
def test_a_matrix_of_drives(written: Callable[..., Path], tmp_path: Path) -> None:
    file = written(PHANTOM + DAZZLE + '[defences]\nuse = ["occlusion", "shadow"]')
    first = redteam(file, tmp_path / "out")
    assert first.failed == {}
    assert len(first.drives) == 3
    phantom, dazzle = first.matrix.success
    assert phantom.attacked == phantom.frames == 3
    assert phantom.success.share > 0.6
    assert phantom.added > 50
    assert dazzle.added == 0
    assert dazzle.lost > 100
    assert {row.defence for row in first.matrix.detection} == {"occlusion", "shadow", "fused"}
    assert {row.defence for row in first.matrix.cost} == {"detector", "occlusion", "shadow"}
    document = json.loads((tmp_path / "out" / "redteam.json").read_text())
    assert [attack["name"] for attack in document["attacks"]] == ["phantom", "dazzle"]
    page = (tmp_path / "out" / "redteam.html").read_text()
    assert "phantom" in page
    assert "Jin et al. 2023" in page
    figures = sorted((tmp_path / "out" / "figures").iterdir())
    times = [path.stat().st_mtime_ns for path in figures]
    again = redteam(file, tmp_path / "out", workers=2)
    assert [path.stat().st_mtime_ns for path in figures] == times
    np.testing.assert_equal(again.matrix.success, first.matrix.success)


@pytest.mark.full
def test_detectors_stand_side_by_side_on_the_same_drives(
    written: Callable[..., Path], tmp_path: Path
) -> None:
    use = '[defences]\nuse = ["shadow"]\n[measure]\ndetector = ["rules", "learned"]\n'
    found = redteam(written(PHANTOM + use), tmp_path / "out")
    assert found.failed == {}
    assert len(found.drives) == 2
    assert len(list((tmp_path / "out" / "figures").iterdir())) == 4
    assert [row.setting["detector"] for row in found.matrix.success] == ["rules", "learned"]
    alone = redteam(written(PHANTOM + '[defences]\nuse = ["shadow"]'), tmp_path / "out")
    assert alone.matrix.success[0].success == found.matrix.success[0].success
    assert "detector" not in alone.matrix.success[0].setting


def test_riders_are_road_users_that_a_detector_can_find() -> None:
    assert KIND_OF["cyclist"] == KIND_OF["motorcyclist"] == KIND_OF["bicycle"] == "cycle"
    assert all(name.upper() in Class.__members__ for name in KIND_OF)


def test_the_program_names_what_it_cannot_measure(written: Callable[..., Path], tmp_path: Path) -> None:
    file = (
        written(grid='seed = [1]\nroute = [["0,0", "0,0.001"]]').read_text().replace('route = "random"\n', "")
    )
    (tmp_path / "matrix.toml").write_text(file)
    result = run_program("lidar", "redteam", str(tmp_path / "matrix.toml"), "-o", str(tmp_path / "out"))
    assert result.returncode == 1
    assert "Traceback" not in result.stderr
    assert "attack-none and 1 more" in result.stderr


def test_the_program_writes_nothing_for_a_file_with_an_error(
    written: Callable[..., Path], tmp_path: Path
) -> None:
    file = written(PHANTOM.replace("shape=object", "power=-1"))
    result = run_program("lidar", "redteam", str(file), "-o", str(tmp_path / "out"))
    assert result.returncode == 2
    assert "power" in result.stderr
    assert result.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()
