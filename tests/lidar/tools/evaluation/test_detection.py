"""Scores of detections: KITTI's development kit statement by statement, nuScenes' by hand."""

import json
import math
import shutil

import numpy as np
import pytest
from helpers.programs import run_program
from shapely import affinity, box

from geoscene.classes import Class, class_codes
from lidar.dataset.layout import open_dataset
from lidar.dataset.layouts.kitti import true_lines
from lidar.dataset.layouts.kitti_drive import read_drive
from lidar.dataset.layouts.nuscenes import token_of
from lidar.dataset.nuscenes_folder import key_clouds
from lidar.dataset.recorded import cloud_points, still_points
from lidar.errors import FormatError, InputError
from lidar.tools.convert import convert
from lidar.tools.detection.detector import Detections
from lidar.tools.detection.learned import read_detector
from lidar.tools.evaluation.detect import detect
from lidar.tools.evaluation.kitti_detection import (
    DIFFICULTIES,
    LIKE,
    OVERLAPS,
    Labels,
    area_overlap,
    evaluate_kitti,
    flat_overlap,
    footprints,
    labels_of,
    read_labels,
    volume_overlap,
)
from lidar.tools.evaluation.nuscenes_detection import (
    ERRORS,
    Boxes,
    evaluate_nuscenes,
    read_results,
    samples_of,
    true_boxes,
)
from lidar.tools.evaluation.objects import evaluate_objects, kind_of


def made(seed, frames=12):
    """Random objects of images, and detections near most of them."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(frames):
        n = int(rng.integers(3, 9))
        kinds = rng.choice(["Car", "Car", "Van", "Pedestrian", "Cyclist", "Misc"], n)
        place = np.column_stack([rng.uniform(-20, 20, n), rng.uniform(1, 2, n), rng.uniform(8, 60, n)])
        size = np.column_stack([rng.uniform(1.4, 2, n), rng.uniform(1.5, 2, n), rng.uniform(3, 5, n)])
        tall = 700 * size[:, 0] / place[:, 2]
        left = rng.uniform(0, 1100, n)
        flat = np.column_stack([left, 200 - tall / 2, left + 1.5 * tall, 200 + tall / 2])
        true = Labels(
            kinds, rng.uniform(0, 0.6, n), rng.integers(0, 4, n).astype(float), flat, size, place,
            rng.uniform(-3, 3, n), np.ones(n),
        )  # fmt: skip
        rows = np.flatnonzero(rng.random(n) < 0.8)
        rows = np.concatenate([rows, rng.integers(0, n, 3)])
        k = len(rows)
        near = Labels(
            np.where(rng.random(k) < 0.9, kinds[rows], "Car"),
            np.full(k, -1.0),
            np.full(k, -1.0),
            flat[rows] + rng.normal(0, 3, (k, 4)),
            size[rows] * rng.uniform(0.95, 1.05, (k, 3)),
            place[rows] + rng.normal(0, 0.15, (k, 3)),
            true.yaw[rows] + rng.normal(0, 0.05, k),
            np.round(rng.random(k), 3),
        )
        out.append((true, near))
    return out


def footprint(labels, k):
    _, w, length = labels.size[k]
    flat = affinity.rotate(
        box(-length / 2, -w / 2, length / 2, w / 2), -labels.yaw[k], (0, 0), use_radians=True
    )
    return affinity.translate(flat, labels.place[k, 0], labels.place[k, 2])


def overlap(measure, found, j, true, i):
    if measure == "2d":
        a, b = box(*found.box[j]), box(*true.box[i])
    else:
        a, b = footprint(found, j), footprint(true, i)
    shared, whole = a.intersection(b).area, a.union(b).area
    if measure == "3d":
        top = max(found.place[j, 1] - found.size[j, 0], true.place[i, 1] - true.size[i, 0])
        tall = max(min(found.place[j, 1], true.place[i, 1]) - top, 0.0)
        shared *= tall
        whole = a.area * found.size[j, 0] + b.area * true.size[i, 0] - shared
    return shared / whole


NO_DETECTION = -1e9


def statistics(overlaps, found, ignored_true, ignored_found, *, limit, least=None):
    """computeStatistics of evaluate_object.cpp."""
    counting = least is not None
    assigned = [False] * len(found)
    low = [counting and s < least for s in found.score]
    tp = fp = fn = 0
    scores = []
    for i, role in enumerate(ignored_true):
        if role == -1:
            continue
        row, valid, most, assigned_ignored = -1, NO_DETECTION, 0.0, False
        for j in range(len(found)):
            if ignored_found[j] == -1 or assigned[j] or low[j]:
                continue
            here = overlaps[j][i]
            if not counting and here > limit and found.score[j] > valid:
                row, valid = j, found.score[j]
            elif counting and here > limit and (here > most or assigned_ignored) and ignored_found[j] == 0:
                most, row, valid, assigned_ignored = here, j, 1, False
            elif counting and here > limit and valid == NO_DETECTION and ignored_found[j] == 1:
                row, valid, assigned_ignored = j, 1, True
        if valid == NO_DETECTION and role == 0:
            fn += 1
        elif valid != NO_DETECTION and (role == 1 or ignored_found[row] == 1):
            assigned[row] = True
        elif valid != NO_DETECTION:
            tp += 1
            scores.append(found.score[row])
            assigned[row] = True
    if counting:
        fp = sum(not (assigned[j] or ignored_found[j] in (-1, 1) or low[j]) for j in range(len(found)))
    return tp, fp, fn, scores


def devkit(frames, kind, measure, limit, at):
    """eval_class of evaluate_object.cpp with the mean of 40 recalls."""
    cases, count = [], 0
    for true, found in frames:
        roles = []
        for i in range(len(true)):
            tall = true.box[i, 3] - true.box[i, 1]
            hard = true.occluded[i] > at.occluded or true.truncated[i] > at.truncated or tall <= at.height
            valid = 1 if true.kind[i] == kind else 0 if true.kind[i] == LIKE.get(kind, "") else -1
            roles.append(0 if valid == 1 and not hard else 1 if valid == 0 or (valid == 1 and hard) else -1)
        count += roles.count(0)
        own = []
        for j in range(len(found)):
            low = int(abs(found.box[j, 3] - found.box[j, 1])) < at.height
            own.append(1 if low else 0 if found.kind[j] == kind else -1)
        table = [[overlap(measure, found, j, true, i) for i in range(len(true))] for j in range(len(found))]
        cases.append((table, found, roles, own))
    scores = []
    for case in cases:
        scores += statistics(*case, limit=limit)[3]
    scores.sort(reverse=True)
    thresholds, recall = [], 0.0
    for k, score in enumerate(scores):
        here = (k + 1) / count
        after = (k + 2) / count if k < len(scores) - 1 else here
        if after - recall < recall - here and k < len(scores) - 1:
            continue
        thresholds.append(score)
        recall += 1 / 40
    precision = [0.0] * 41
    for k, least in enumerate(thresholds):
        sums = np.sum([statistics(*case, limit=limit, least=least)[:3] for case in cases], axis=0)
        precision[k] = sums[0] / (sums[0] + sums[1])
    best = [max(precision[k:]) for k in range(41)]
    return 100 * sum(best[1:]) / 40, count


@pytest.mark.full
def test_average_precisions_are_those_of_kitti_s_development_kit():
    frames = made(3)
    for one in evaluate_kitti(frames):
        at = next(d for d in DIFFICULTIES if d.name == one.difficulty)
        value, count = devkit(frames, one.kind, one.measure, one.overlap, at)
        assert one.objects == count
        assert one.value == (pytest.approx(value, abs=1e-9) if count else None), one


def test_detections_that_are_the_objects_are_as_precise_as_recalls_allow():
    frames = [(true, true) for true, _ in made(5, frames=80)]
    for one in evaluate_kitti(frames):
        recalls = min(max(one.objects - 1, 0), 40)  # with few objects, the development kit has few thresholds
        if one.objects:
            assert one.value == pytest.approx(100 * recalls / 40, abs=2.6), one


def test_without_detections_nothing_is_precise():
    for one in evaluate_kitti([(true, found.take(slice(0))) for true, found in made(6)]):
        assert one.value == (0.0 if one.objects else None)


def test_overlaps_of_boxes_are_those_of_polygons():
    (true, found), *_ = made(9)
    for measure in ("2d", "bev", "3d"):
        plans = [footprints(o.place[:, [0, 2]], o.size[:, [2, 1]], yaw=-o.yaw) for o in (found, true)]
        common, above = area_overlap(*plans)
        ends = [(o.place[:, 1] - o.size[:, 0], o.place[:, 1], o.size.prod(axis=1)) for o in (found, true)]
        volume = volume_overlap(common, one=ends[0], other=ends[1])
        ours = {"2d": flat_overlap(found.box, true.box), "bev": above, "3d": volume}[measure]
        for j in range(len(found)):
            for i in range(len(true)):
                assert ours[j, i] == pytest.approx(overlap(measure, found, j, true, i), abs=1e-12)


def boxes(*rows, score=1.0):
    """Boxes (sample, kind, x, y), 2 m wide, 4 m long."""
    n = len(rows)
    return Boxes(
        np.array([row[0] for row in rows], np.int64),
        np.array([row[1] for row in rows], np.str_),
        np.array([[row[2], row[3], 0.0] for row in rows]).reshape(-1, 3),
        np.tile([2.0, 4.0, 1.5], (n, 1)),
        np.zeros(n),
        np.zeros((n, 2)),
        np.array(["vehicle.parked"] * n),
        np.broadcast_to(np.asarray(score, float), n).copy(),
    )


def of_class(score, kind):
    return next(one for one in score.classes if one.kind == kind)


CARS = [(0, "car", 10.0, 0.0), (0, "car", 20.0, 5.0), (1, "car", 10.0, 0.0), (1, "car", 20.0, 5.0)]
STILL = np.zeros((2, 3))


def test_true_boxes_as_detections_have_the_greatest_score():
    found = evaluate_nuscenes(boxes(*CARS), boxes(*CARS), vehicle=STILL)
    assert found.mean_ap_present == pytest.approx(1.0)
    assert found.nds_present == pytest.approx(1.0)
    assert found.mean_ap == pytest.approx(0.1)
    assert set(of_class(found, "car").errors.values()) == {0.0}


def test_boxes_are_right_within_the_distance_of_their_centres():
    off = [(sample, kind, x + 1.5, y) for sample, kind, x, y in CARS]
    car = of_class(evaluate_nuscenes(boxes(*CARS), boxes(*off), vehicle=STILL), "car")
    assert car.precision == {"0.5": 0.0, "1": 0.0, "2": pytest.approx(1.0), "4": pytest.approx(1.0)}
    assert car.errors["translation"] == pytest.approx(1.5)


def test_half_of_the_objects_are_four_ninths_of_the_precision():
    """Of recalls from 11 to 100 %, those from 11 to 50 % have full precision: 40 of 90."""
    car = of_class(evaluate_nuscenes(boxes(*CARS), boxes(*CARS[:2]), vehicle=STILL), "car")
    assert car.mean == pytest.approx(40 / 90)


def test_a_second_box_on_an_object_is_wrong():
    twice = boxes(*CARS, *CARS, score=[0.9] * 4 + [0.95] * 4)
    car = of_class(evaluate_nuscenes(boxes(*CARS), twice, vehicle=STILL), "car")
    assert car.mean == pytest.approx((89 + 0.4 / 0.9) / 90)  # half of the boxes at full recall are wrong
    first = boxes(*CARS[:1], *CARS, score=[1.0, 0.9, 0.8, 0.7, 0.6])
    assert of_class(evaluate_nuscenes(boxes(*CARS), first, vehicle=STILL), "car").mean < 1.0


def test_objects_beyond_the_range_of_their_class_do_not_count():
    far = [(0, "pedestrian", 41.0, 0.0), (0, "pedestrian", 39.0, 0.0)]
    score = of_class(evaluate_nuscenes(boxes(*far), boxes(*far[1:]), vehicle=STILL), "pedestrian")
    assert score.objects == 1
    assert score.mean == pytest.approx(1.0)


def test_errors_of_size_direction_speed_and_attribute_are_those_of_the_boxes():
    true = boxes(*CARS)
    wrong = Boxes(
        true.sample, true.kind, true.place, true.size * [1, 2, 1], true.yaw + 2 * math.pi - 0.3,
        true.velocity + np.array([3.0, 4.0]), np.array(["vehicle.moving"] * 4), true.score,
    )  # fmt: skip
    errors = of_class(evaluate_nuscenes(true, wrong, vehicle=STILL), "car").errors
    assert errors == {
        "translation": pytest.approx(0.0),
        "scale": pytest.approx(0.5),
        "orientation": pytest.approx(0.3),
        "velocity": pytest.approx(5.0),
        "attribute": pytest.approx(1.0),
    }


@pytest.fixture(scope="module")
def drive(scene, tmp_path_factory):
    """A short drive of the rig kitti in traffic."""
    out = tmp_path_factory.mktemp("drive") / "drive"
    run = run_program(
        "lidar", "drive", scene.path, "--route", "random", "--duration", 0.6, "--seed", 3, "--rig",
        "kitti", "--format", "pcd", "--traffic", "vehicles=60,parked=0.8,pedestrians=30,cyclists=5", "-o",
        out, "-q", "--set", "shadows=off", "--set", "detail=off",
        "--set", "supersample=1",
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    return out


def test_labels_of_the_truth_score_as_the_truth(drive, tmp_path):
    folder = tmp_path / "labels"
    folder.mkdir()
    for row, lines in enumerate(true_lines(read_drive(open_dataset(drive)))):
        (folder / f"{row:06d}.txt").write_text("".join(f"{line} 0.9\n" for line in lines.values()))
    found = evaluate_objects(folder, drive)
    assert found.kind == "kitti detections"
    assert found.frames == 6
    counted = [one for one in found.scores if one.objects]
    assert counted
    for one in counted:  # with fewer objects than recalls, the last ones are not reached
        assert one.value == pytest.approx(100 * min(one.objects - 1, 40) / 40, abs=2.6), one


@pytest.mark.parametrize("layout", ["kitti", "nuscenes"])
def test_what_the_detector_finds_is_read_again(drive, tmp_path, layout):
    counts = detect(open_dataset(drive), tmp_path / "d", layout=layout, detector=read_detector("rules"))
    assert kind_of(tmp_path / "d") == layout
    found = evaluate_objects(tmp_path / "d", drive)
    if layout == "kitti":
        read = [read_labels(path) for path in sorted((tmp_path / "d").iterdir())]
        assert sum(map(len, read)) == counts["boxes"]
        assert counts["frames"] == found.frames == 6
    else:
        assert len(json.loads((tmp_path / "d" / "results.json").read_text())["results"]) == counts["frames"]
        assert found.frames == counts["frames"]
    with pytest.raises(InputError, match="exists"):
        detect(open_dataset(drive), tmp_path / "d", layout=layout, detector=read_detector("rules"))


def test_true_boxes_as_results_have_no_error(drive, tmp_path):
    dataset = open_dataset(drive)
    samples = samples_of(dataset)
    true = true_boxes(dataset, samples)
    assert len(true) > 0
    results = {token: [] for token in samples.token}
    for k, row in enumerate(true.sample.tolist()):
        results[samples.token[row]].append(
            {
                "translation": true.place[k].tolist(),
                "size": true.size[k].tolist(),
                "rotation": [math.cos(true.yaw[k] / 2), 0, 0, math.sin(true.yaw[k] / 2)],
                "velocity": np.nan_to_num(true.velocity[k]).tolist(),
                "detection_name": str(true.kind[k]),
                "detection_score": 1.0,
                "attribute_name": str(true.attribute[k]),
            }
        )
    path = tmp_path / "results.json"
    path.write_text(json.dumps({"results": results}))
    score = evaluate_nuscenes(true, read_results(path, samples), vehicle=samples.vehicle)
    assert score.mean_ap_present == pytest.approx(1.0)
    for one in score.classes:
        if one.objects:
            known = [one.errors[name] for name in ERRORS if name != "velocity"]
            assert max(known) < 1e-9


def test_tokens_are_those_of_the_converted_dataset(drive, tmp_path):
    run = run_program("lidar", "convert", drive, "--to", "nuscenes", "-o", tmp_path / "n", "-q")
    assert run.returncode == 0, run.stderr
    samples = json.loads((tmp_path / "n" / "v1.0-mini" / "sample.json").read_text())
    assert [row["token"] for row in samples] == samples_of(open_dataset(drive)).token
    assert samples[0]["token"] == token_of("drive", "sample", 0)


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("000099.txt", "", "the drive has 6 frames"),
        ("000000.txt", "Car 1 2 3\n", "15 values"),
        ("000000.txt", "Car " + "x " * 15 + "\n", "no labels"),
        ("results.json", "{}", "damaged"),
        ("results.json", '{"results": {}}', "none of the"),
        ("results.json", '{"results": {"x": [{}]}}', "none of the"),
    ],
)
def test_what_are_no_detections_is_told_in_a_line(drive, tmp_path, name, text, told):
    folder = tmp_path / "d"
    folder.mkdir()
    (folder / name).write_text(text)
    run = run_program("lidar", "evaluate", folder, "--against", drive, "-o", tmp_path / "out")
    assert run.returncode == 2
    assert told in run.stderr
    assert run.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_labels_with_other_numbers_are_refused():
    assert len(labels_of([], name="x")) == 0
    with pytest.raises(FormatError, match="not finite"):
        labels_of(["Car " + "nan " * 15], name="x")
    assert set(OVERLAPS) == {"Car", "Pedestrian", "Cyclist"}


class FarthestPoints:
    """A detector that puts a box at each of the farthest points, whatever their order in the cloud."""

    name = identity = "farthest"

    def detect(self, cloud):
        far = cloud.xyz[np.lexsort((*cloud.xyz.T, -np.linalg.norm(cloud.xyz, axis=1).round(3)))[:40]]
        n = len(far)
        size, kind = np.tile([4.0, 1.8, 1.5], (n, 1)), np.array(["vehicle", "person", "cycle"] * n)[:n]
        return Detections(
            far, size, np.linspace(-1.5, 1.5, n), np.linspace(0.9, 0.1, n), kind, np.ones(n, np.int64)
        )


@pytest.fixture(scope="module")
def converted(drive, tmp_path_factory):
    """The drive in the layouts of KITTI and nuScenes, by name."""
    folder = tmp_path_factory.mktemp("converted")
    names = ("kitti", "kitti-raw", "nuscenes")
    return {name: convert(drive, folder / name, to=name).path for name in names}


@pytest.mark.parametrize("name", ["kitti", "kitti-raw"])
def test_a_folder_of_kitti_has_the_detections_of_the_drive(drive, converted, tmp_path, name):
    made = detect(drive, tmp_path / "drive", layout="kitti", detector=FarthestPoints())
    counts = detect(converted[name], tmp_path / "folder", layout="kitti", detector=FarthestPoints())
    assert counts == made
    assert made["boxes"] > 0
    for own, other in zip(*(sorted((tmp_path / k).iterdir()) for k in ("drive", "folder")), strict=True):
        assert own.read_text() == other.read_text()


def test_a_folder_of_nuscenes_has_the_detections_of_the_drive(drive, converted, tmp_path):
    results = []
    for k, source in enumerate((drive, converted["nuscenes"])):
        detect(source, tmp_path / str(k), layout="nuscenes", detector=FarthestPoints())
        results.append(json.loads((tmp_path / str(k) / "results.json").read_text())["results"])
    assert results[0].keys() == results[1].keys()
    for token, boxes_there in results[0].items():
        for own, other in zip(boxes_there, results[1][token], strict=True):
            for name, value in own.items():
                exact = isinstance(value, str)
                assert other[name] == (value if exact else pytest.approx(value, abs=1e-6)), name


def test_points_of_kitti_follow_its_lasers_from_the_top_and_labels_follow_the_points(drive, converted):
    """Of real recordings, a laser begins where the azimuth passes from negative to positive at the front."""
    sequence = converted["kitti"] / "sequences" / "00"
    xyz = np.fromfile(sequence / "velodyne" / "000000.bin", "<f4").reshape(-1, 4)[:, :3].astype(float)
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    laser = np.cumsum(np.append(False, np.diff(np.remainder(azimuth, 2 * np.pi)) < 0))
    table = cloud_points(drive / "velodyne" / "pcd" / "000000.pcd")
    rings = np.unique(table["ring"])
    assert laser[-1] + 1 == len(rings)
    assert np.bincount(laser).tolist() == np.bincount(table["ring"])[rings][::-1].tolist()
    elevation = np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1]))
    middle = np.array([np.median(elevation[laser == k]) for k in range(laser[-1] + 1)])
    assert (np.diff(middle) < 0).all()
    recorded = still_points(read_drive(open_dataset(drive)).clouds, open_dataset(drive).trajectory(), row=0)
    road = np.column_stack([recorded[axis] for axis in "xyz"])[recorded["label"] == Class.ROAD]
    codes = np.fromfile(sequence / "labels" / "000000.label", "<u4") & 0xFFFF
    code = int(class_codes().semantic_kitti[Class.ROAD])
    ours = np.isin(class_codes().semantic_kitti[recorded["label"]], code).sum()
    assert (codes == code).sum() == ours
    assert {tuple(p) for p in road.tolist()} <= {tuple(p) for p in xyz[codes == code].tolist()}


def damaged_calibration(line, text):
    """Lines of a calibration of which one is another."""
    rows = {
        "P2": "700 0 600 0 0 700 180 0 0 0 1 0",
        "R0_rect": "1 0 0 0 1 0 0 0 1",
        "Tr_velo_to_cam": "0 -1 0 0 0 0 -1 0 1 0 0 0",
    } | {line: text}
    return "".join(f"{name}: {values}\n" for name, values in rows.items() if values)


@pytest.mark.parametrize(
    ("line", "text", "told"),
    [
        ("Tr_velo_to_cam", "0 1 0 0 0 0 -1 0 1 0 0 0", "Tr_velo_to_cam mirrors"),
        ("Tr_velo_to_cam", "0 0 0 0 0 0 0 0 0 0 0 0", "Tr_velo_to_cam holds no rotation"),
        ("R0_rect", "1 0 0 0 1 0 0 0 -1", "R0_rect mirrors"),
        ("R0_rect", "", "has no row R0_rect"),
        ("P2", "", "has no row P2"),
        ("P2", "nan 0 600 0 0 700 180 0 0 0 1 0", "P2 has a number that is not finite"),
        ("P2", "700 0 600 0 0 700", "P2 has 6 numbers, not 12"),
        ("P2", "a 0 600 0 0 700 180 0 0 0 1 0", "'a' is not a number"),
        ("P2", "-700 0 600 0 0 700 180 0 0 0 1 0", "focal length"),
    ],
)
def test_a_damaged_calibration_of_kitti_is_told_in_a_line(tmp_path, line, text, told):
    for folder in ("velodyne", "calib"):
        (tmp_path / "k" / folder).mkdir(parents=True)
    np.ones((8, 4), "<f4").tofile(tmp_path / "k" / "velodyne" / "000000.bin")
    (tmp_path / "k" / "calib" / "000000.txt").write_text(damaged_calibration(line, text))
    run = run_program("lidar", "detect", tmp_path / "k", "--to", "kitti", "-o", tmp_path / "out", "-q")
    assert run.returncode == 2
    assert "000000.txt" in run.stderr
    assert told in run.stderr
    assert run.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("table", "change", "told"),
    [
        ("calibrated_sensor", {"rotation": [0.0, 0.0, 0.0, 0.0]}, "no unit quaternion"),
        ("calibrated_sensor", {"rotation": np.diag([1.0, 1.0, -1.0]).tolist()}, "no unit quaternion"),
        ("calibrated_sensor", {"translation": [0.0, math.nan, 0.0]}, "no place"),
        ("calibrated_sensor", {"camera_intrinsic": [[math.nan] * 3] * 3}, "no finite 3 x 3 matrix"),
        ("ego_pose", {"rotation": [math.nan, 0.0, 0.0, 0.0]}, "no unit quaternion"),
        ("sample", {"timestamp": 0}, "is not later"),
        ("sample_data", {"filename": "samples/none.pcd.bin"}, "is missing"),
        ("sample_data", {"ego_pose_token": "x"}, "'x' is missing"),
    ],
)
def test_damaged_tables_of_nuscenes_are_told_in_a_line(converted, tmp_path, table, change, told):
    (tmp_path / "n").mkdir()
    shutil.copytree(converted["nuscenes"] / "v1.0-mini", tmp_path / "n" / "v1.0-mini")
    (tmp_path / "n" / "samples").symlink_to(converted["nuscenes"] / "samples")
    path = tmp_path / "n" / "v1.0-mini" / f"{table}.json"
    path.write_text(json.dumps([row | change for row in json.loads(path.read_text())]))
    with pytest.raises(FormatError, match=r"\.json|none.pcd.bin") as raised:
        key_clouds(tmp_path / "n")
    assert told in str(raised.value)
    assert "\n" not in str(raised.value)


def test_clouds_without_calibration_or_tables_are_searched_in_their_own_frame(tmp_path):
    cloud = np.zeros((50, 5), "<f4")
    cloud[:, 0], cloud[:, 2] = np.linspace(5, 30, 50), -1.0
    (tmp_path / "k" / "velodyne").mkdir(parents=True)
    cloud[:, :4].tofile(tmp_path / "k" / "velodyne" / "a.bin")
    cloud.tofile(tmp_path / "n.pcd.bin")
    detect(tmp_path / "k", tmp_path / "out_k", layout="kitti", detector=FarthestPoints())
    found = read_labels(tmp_path / "out_k" / "a.txt")
    assert found.place[0] == pytest.approx([0.0, 1.0 + 0.75, 30.0])  # x right, y down, z forward; lower face
    assert (found.box == -1).all()
    detect(tmp_path, tmp_path / "out_n", layout="nuscenes", detector=FarthestPoints())
    results = json.loads((tmp_path / "out_n" / "results.json").read_text())["results"]
    assert results["n"][0]["translation"] == pytest.approx([30.0, 0.0, -1.0])
    with pytest.raises(InputError, match="holds clouds of kitti; give kitti"):
        detect(tmp_path / "k", tmp_path / "no", layout="nuscenes")


def test_what_is_no_place_is_named(tmp_path):
    with pytest.raises(InputError, match="`dataset` 5: give the directory or URL of a dataset"):
        detect(5, tmp_path / "out", layout="kitti")
