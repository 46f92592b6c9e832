"""Objects that an attacker puts into the scene."""

import numpy as np
import pytest
import trimesh

from geoscene.classes import Class
from lidar.dataset.layout import open_dataset, read_rows
from lidar.dataset.recorded import cloud_points
from lidar.errors import InputError
from lidar.geometry.poses import Trajectory
from lidar.options.drive import DriveOptions
from lidar.signal.attacks.placed_object import PlacedObject, with_objects
from lidar.signal.registry import read_attacks, read_stage, stages_of
from lidar.simulation.drive import drive

RIG = """
name = "one"
[[lidar]]
name = "top"
preset = "vlp16"
translation = [1.2, 0.0, 1.9]
"""


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    path = tmp_path_factory.mktemp("mesh") / "ball.ply"
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
    mesh.apply_translation([3.0, 1.0, 0.5])
    mesh.export(path)
    return path


@pytest.fixture(scope="module")
def dataset(scene, ball, tmp_path_factory):
    folder = tmp_path_factory.mktemp("objects")
    (folder / "one.toml").write_text(RIG, "utf-8")
    attacks = read_attacks([f"placed_object:mesh={ball},ahead=8,left=1,lift=0.5,klass=traffic_sign"])
    options = DriveOptions(
        rig=str(folder / "one.toml"), duration=0.6, seed=2, formats=("pcd",), attacks=attacks
    )
    drive(scene, folder / "drive", options=options)
    return open_dataset(folder / "drive")


def test_sensors_see_an_object_that_moves_along(dataset):
    (path, *_) = sorted((dataset.path / "top" / "pcd").glob("*.pcd"))
    points = cloud_points(path)
    (row,) = read_rows(min((dataset.path / "top" / "boxes").glob("*")))
    hit = points["instance"] == int(row["instance"])
    assert hit.sum() == int(row["points"]) > 20
    assert (row["kind"], row["class"]) == ("placed_object", "traffic_sign")
    x, y, z = (points[axis][hit] for axis in "xyz")
    assert np.median(x) == pytest.approx(8.0 - 1.2 - 0.4, abs=0.3)  # its near side
    assert np.median(y) == pytest.approx(1.0, abs=0.3)
    assert z.min() > 0.5 - 1.9 - 0.1
    assert z.max() < 1.5 - 1.9 + 0.1
    assert not (dataset.path / "top" / "truth").exists()  # boxes and instances are its truth


def test_an_object_stands_at_a_place(scene):
    x, y = (scene.bounds[0] + scene.bounds[2]) / 2, (scene.bounds[1] + scene.bounds[3]) / 2
    lon, lat = scene.frame.to_geographic(x, y)
    still = Trajectory(
        np.array([0, 10**9]), np.zeros((2, 3)), np.tile([0.0, 0, 0, 1], (2, 1)), np.zeros((2, 3)), np.ones(2)
    )
    cube = read_stage({"name": "placed_object", "place": f"{lat} {lon}", "size": 2.0}).stage
    placed = cube.scene(scene, still)
    assert placed.position[0, :2] == pytest.approx([x, y], abs=1e-3)
    assert placed.size[0].tolist() == [2.0, 2.0, 2.0]
    assert placed.parked.all()
    both = stages_of([{"name": "placed_object"}, {"name": "placed_object", "ahead": 20.0}])
    actors = with_objects(None, both, scene=scene, trajectory=still)
    assert len(actors) == 2
    assert np.diff(actors.feature).tolist() == [1]
    assert actors.klass.tolist() == [Class.OTHER_STRUCTURE] * 2
    assert with_objects(None, stages_of([]), scene=scene, trajectory=still) is None
    with pytest.raises(InputError, match="place = '10 10' has no ground in the scene"):
        PlacedObject(place="10 10").scene(scene, still)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"mesh": "missing.obj"}, "missing.obj: cannot be read as a mesh"),
        ({"mesh": "ball.png"}, "mesh = 'ball.png' is no .obj, .stl or .ply file"),
        ({"place": "47"}, "place = '47' is not LAT,LON"),
        ({"place": "97 9"}, "place = '97 9' is not LAT,LON in degrees"),
        ({"material": "cheese"}, "material = 'cheese' is none of"),
        ({"klass": "road"}, "klass = 'road' is none of other_structure, car"),
    ],
)
def test_faulty_objects_are_refused_in_one_line(table, message):
    with pytest.raises(InputError, match=message) as error:
        read_stage({"name": "placed_object", **table})
    assert "\n" not in str(error.value)


def test_an_object_cannot_be_put_into_recorded_data():
    with pytest.raises(InputError, match="stage placed_object acts on a scene, and there is none"):
        stages_of([{"name": "placed_object"}]).check({"top": "lidar"})


def test_a_drive_notices_that_a_mesh_has_changed(scene, tmp_path):
    mesh, other = tmp_path / "a.stl", trimesh.creation.box((1.0, 1.0, 2.0))
    trimesh.creation.box((1.0, 1.0, 1.0)).export(mesh)
    (tmp_path / "one.toml").write_text(RIG, "utf-8")

    def driven():
        attacks = read_attacks([f"placed_object:mesh={mesh}"])
        return DriveOptions(
            rig=str(tmp_path / "one.toml"), duration=0.2, seed=2, formats=("pcd",), attacks=attacks
        )

    drive(scene, tmp_path / "drive", options=driven())
    table = open_dataset(tmp_path / "drive").manifest["recipe"]["stages"][0]
    assert read_stage(table).to_json() == table
    drive(scene, tmp_path / "drive", options=driven())  # the same mesh
    other.export(mesh)
    with pytest.raises(InputError):
        drive(scene, tmp_path / "drive", options=driven())
    with pytest.raises(InputError, match=r"a\.stl: has changed since the drive"):
        read_stage(table)
