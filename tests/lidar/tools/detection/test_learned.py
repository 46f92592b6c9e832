"""The learned detector: its forest, its file, its training, and what it finds on drives it has not seen."""

from __future__ import annotations

import io
import pickle
import zipfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.programs import run_program
from hypothesis import given
from hypothesis import strategies as st
from sklearn.ensemble import RandomForestClassifier

import geoscene.errors
from geoscene.scene import Scene
from lidar.errors import DatasetError, FormatError, InputError
from lidar.options.drive import DriveOptions
from lidar.simulation.drive import drive
from lidar.tools.detection.forest import forest_of, read_forest
from lidar.tools.detection.learned import (
    CLASSES,
    FEATURES,
    MODEL,
    Learned,
    read_detector,
    read_model,
    scores_of,
)
from lidar.tools.redteam.evaluate import accuracies
from lidar.tools.redteam.measure import AttackCase, measure_drive
from lidar.tools.redteam.plan import Measure
from lidar.tools.train import examples_of, train
from lidar.traffic.options import TrafficOptions

TRAFFIC = TrafficOptions(vehicles=60.0, parked=1.0, pedestrians=40.0, cyclists=20.0)


@pytest.fixture(scope="module")
def recorded(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Records a short drive."""

    def record(
        name: str, *, seed: int, traffic: TrafficOptions | None = TRAFFIC, formats: tuple[str, ...] = ("pcd",)
    ) -> Path:
        out = tmp_path_factory.mktemp(name) / name
        options = DriveOptions(
            rig="vlp16",
            route="random",
            duration=1.0,
            seed=seed,
            formats=formats,
            traffic=traffic,
            workers=1,
        )
        return drive(scene, out, options=options).path

    return record


@pytest.fixture(scope="module")
def street(recorded: Any) -> Path:
    return recorded("street", seed=41)


@pytest.fixture(scope="module")
def empty(recorded: Any) -> Path:
    return recorded("empty", seed=1, traffic=None)


def _sklearn(seed: int, *, classes: list[int]) -> tuple[Any, np.ndarray]:
    rng = np.random.default_rng(seed)
    samples = rng.normal(size=(300, 5)).astype(np.float32)
    samples[:, 2] = np.round(samples[:, 2], 1)  # thresholds halfway between equal steps
    kind = np.array(classes)[(samples[:, 0] + samples[:, 2] > 0).astype(int) + (samples[:, 1] > 1)]
    forest = RandomForestClassifier(n_estimators=7, max_leaf_nodes=20, random_state=seed)
    return forest.fit(samples, kind), rng.normal(size=(500, 5)).astype(np.float32).round(2)


@given(seed=st.integers(0, 10**6), classes=st.sampled_from([[0, 1, 2], [0, 1, 3], [0, 2, 2]]))
def test_probabilities_are_those_of_scikit_learn(seed: int, classes: list[int]) -> None:
    forest, samples = _sklearn(seed, classes=classes)
    mine = forest_of([tree.tree_ for tree in forest.estimators_], forest.classes_, classes=4)
    expected = np.zeros((len(samples), 4))
    expected[:, forest.classes_] = forest.predict_proba(samples)
    np.testing.assert_allclose(mine.probability(samples), expected, atol=1e-6)
    mine.check(columns=5, classes=4)


def test_a_score_is_as_high_at_the_threshold_of_each_kind() -> None:
    probability = np.array([[0.2, 0.6, 0.9], [0.1, 0.3, 0.95], [1.0, 1.0, 0.0]])
    found = scores_of(probability, [0.2, 0.6, 0.9])
    np.testing.assert_allclose(found, [[0.3, 0.3, 0.3], [0.15, 0.15, 0.65], [1.0, 1.0, 0.0]])


def test_a_model_is_read_as_it_was_written(tmp_path: Path) -> None:
    model = read_model(MODEL)
    model.write(tmp_path / "again.npz")
    again = read_model(tmp_path / "again.npz")
    assert again.threshold == model.threshold
    assert again.training == model.training
    samples = np.random.default_rng(0).normal(size=(200, len(FEATURES))).astype(np.float32)
    np.testing.assert_array_equal(again.forest.probability(samples), model.forest.probability(samples))
    model.write(tmp_path / "third.npz")
    assert (tmp_path / "third.npz").read_bytes() == (tmp_path / "again.npz").read_bytes()


def test_the_model_of_the_program_is_small_and_says_what_it_was_trained_on() -> None:
    assert MODEL.stat().st_size < 500_000
    drives = read_model(MODEL).training["drives"]
    assert len(drives) >= 8
    assert all("OpenStreetMap contributors" in row["attribution"] for row in drives)
    assert not any(str(value).startswith("/") for row in drives for value in row.values())


class _Trap:
    """What runs code when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


def _altered(**columns: Any) -> bytes:
    with np.load(MODEL) as file:
        arrays = {name: file[name] for name in file.files} | columns
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def _foreign(folder: Path) -> dict[str, bytes]:
    whole = MODEL.read_bytes()
    forest, _, _ = read_forest(MODEL)
    zipped = io.BytesIO()
    with zipfile.ZipFile(zipped, "w") as archive:
        archive.writestr("header.npy", b"no array")
    other = io.BytesIO()
    np.savez(other, points=np.zeros(3))
    pickled = _altered(root=np.array([_Trap(folder / "ran")], object))
    middle = len(whole) // 2
    return {
        "empty": b"",
        "text": b"a model",
        "cut": whole[:middle],
        "flipped": whole[:middle] + bytes([whole[middle] ^ 255]) + whole[middle + 1 :],
        "zip": zipped.getvalue(),
        "other": other.getvalue(),
        "pickled": pickled,
        "bare pickle": pickle.dumps(_Trap(folder / "ran")),
        "circle": _altered(left=np.zeros_like(forest.left)),
        "far": _altered(right=forest.right + np.int32(10**6)),
        "feature": _altered(feature=np.where(forest.feature >= 0, 99, -1).astype(np.int16)),
        "shape": _altered(share=forest.share[:, :2]),
        "nan": _altered(threshold=np.full_like(forest.threshold, np.nan)),
        "header": _altered(header=np.frombuffer(b'{"kind": "x", "version": 1}', np.uint8)),
    }


def test_other_files_are_no_models_and_run_nothing(tmp_path: Path) -> None:
    for name, data in _foreign(tmp_path).items():
        path = tmp_path / "file.npz"
        path.write_bytes(data)
        with pytest.raises(FormatError) as caught:
            read_model(path)
        assert str(path) in str(caught.value), name
        assert "\n" not in str(caught.value), name
    assert not (tmp_path / "ran").exists()


def test_a_detector_that_there_is_not_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="give rules, learned"):
        read_detector(str(tmp_path / "none.npz"))
    (tmp_path / "text.npz").write_text("no model")
    words = ("--defence", "shadow", "--detector", tmp_path / "text.npz")
    result = run_program("lidar", "defend", tmp_path, *words)
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1
    assert "is no model" in result.stderr


def test_measures_do_not_depend_on_the_order_of_points_or_on_the_direction() -> None:
    rng = np.random.default_rng(3)
    ground = np.column_stack([rng.uniform(-30, 30, (4000, 2)), np.full(4000, -1.8)])
    box = np.column_stack([rng.uniform(8, 12, 400), rng.uniform(2, 3.8, 400), rng.uniform(-1.4, -0.4, 400)])
    xyz = np.vstack([ground, box])
    model = read_model(MODEL)
    turned = xyz @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    clouds = [xyz, rng.permutation(xyz), turned]
    found = [model.detect(SimpleNamespace(xyz=cloud)) for cloud in clouds]
    assert len(found[0])
    for other in found[1:]:
        np.testing.assert_allclose(found[0].score, other.score, atol=0.1)


def test_an_empty_cloud_has_no_road_users() -> None:
    found = read_model(MODEL).detect(SimpleNamespace(xyz=np.empty((0, 3))))
    assert len(found) == 0


def _f1(folder: Path, out: Path, detector: str) -> float:
    """Of road users within 40 m that have ten returns or more."""
    measure = Measure()
    case = AttackCase(folder, None, out / f"{detector}.json", (), measure.score, detector)
    frames = [frame | {"block": k} for k, frame in enumerate(measure_drive(case)["frames"])]
    rows = [
        row
        for row in accuracies(frames, measure=measure, known={"setting": {}, "scene": ""})
        if row.kind == "vehicle"
    ]
    hits, users = (sum(getattr(row.recall, name) for row in rows) for name in ("hits", "count"))
    right, boxes = (sum(getattr(row.precision, name) for row in rows) for name in ("hits", "count"))
    assert users > 20
    return 2 * (hits / users) * (right / boxes) / (hits / users + right / boxes)


@pytest.mark.full
def test_it_finds_more_vehicles_than_the_rules_on_a_drive_it_was_not_trained_on(
    street: Path, tmp_path: Path
) -> None:
    assert _f1(street, tmp_path, "learned") > _f1(street, tmp_path, "rules") + 0.03


@pytest.mark.full
def test_training_gives_the_same_bytes_for_any_number_of_workers(street: Path, tmp_path: Path) -> None:
    made = [
        train([street], tmp_path / f"{k}.npz", trees=5, seed=seed, workers=workers)
        for k, (seed, workers) in enumerate([(1, 1), (1, 2), (2, 1)])
    ]
    first, same, other = (one.path.read_bytes() for one in made)
    assert first == same
    assert first != other
    assert made[0].frames == 10
    assert made[0].recall["vehicle"] > 0.5
    model = read_model(made[0].path)
    assert model.training["drives"][0]["name"] == "street"
    assert model.training["clusters"]["vehicle"] == made[0].examples["vehicle"] >= 20


def test_a_road_user_is_one_cluster() -> None:
    """Two parts of one car, a wall, and a pedestrian with a pole's points."""
    from geoscene.classes import Class  # noqa: PLC0415

    rng = np.random.default_rng(0)

    def block(x: float, y: float, size: tuple[float, float, float], count: int) -> np.ndarray:
        return rng.uniform([x, y, -1.4], [x + size[0], y + size[1], -1.4 + size[2]], (count, 3))

    parts = [
        (block(10, 5, (2, 1.8, 1), 200), Class.CAR, 7),
        (block(13, 5, (1, 1.8, 1), 50), Class.CAR, 7),
        (block(-10, 5, (4, 0.3, 2), 200), Class.WALL, 3),
        (block(5, -8, (0.5, 0.5, 1.6), 60), Class.PEDESTRIAN, 9),
        (np.column_stack([rng.uniform(-30, 30, (4000, 2)), np.full(4000, -1.8)]), Class.ROAD, 1),
    ]
    table = {axis: np.concatenate([xyz[:, k] for xyz, _, _ in parts]) for k, axis in enumerate("xyz")}
    for name, column in (("label", 1), ("instance", 2)):
        table[name] = np.concatenate([np.full(len(part[0]), part[column]) for part in parts])
    measures, kind = examples_of(table)
    assert sorted(kind.tolist()) == [0, 0, CLASSES.index("vehicle"), CLASSES.index("person")]
    assert np.isfinite(measures).all()
    vehicle = measures[kind == CLASSES.index("vehicle")][0]
    assert vehicle[FEATURES.index("points")] == pytest.approx(np.log(200), abs=0.1)


@pytest.mark.full
def test_data_that_cannot_be_learned_from_are_refused(empty: Path, recorded: Any, tmp_path: Path) -> None:
    out = tmp_path / "model.npz"
    with pytest.raises(InputError, match="no road users in the clouds; drive with `traffic`"):
        train([empty], out)
    with pytest.raises(DatasetError):
        train([tmp_path], out)
    few = recorded(
        "few", seed=1, traffic=TrafficOptions(vehicles=0.0, parked=0.0, pedestrians=60.0, cyclists=0.0)
    )
    with pytest.raises(InputError, match="only 0 clusters of vehicles, and 20 are needed"):
        train([few], out)
    bare = recorded("bare", seed=1, formats=("kitti",))
    with pytest.raises(DatasetError, match="no clouds with labels and instances"):
        train([bare], out)
    assert not out.exists()


def test_without_the_library_the_extra_is_named(
    street: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lacking(name: str) -> Any:
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    monkeypatch.setattr(geoscene.errors.importlib, "import_module", lacking)
    with pytest.raises(geoscene.errors.MissingExtraError, match=r"pip install 'geoscene\[learn\]'"):
        train([street], tmp_path / "model.npz")


def test_a_model_is_not_replaced_unasked(street: Path, tmp_path: Path) -> None:
    out = tmp_path / "model.npz"
    out.write_text("mine")
    result = run_program("lidar", "train", street, "-o", out)
    assert result.returncode == 2
    assert out.read_text() == "mine"
    assert isinstance(read_detector("learned"), Learned)
