"""What `import geoscene` and `import lidar` give."""

import pytest

import geoscene
import lidar
from lidar.options.data import ApplyOptions
from lidar.signal.registry import read_stages
from lidar.tools.apply import apply_stages


@pytest.mark.parametrize("package", [geoscene, lidar])
def test_every_public_name_is_a_function_or_class_with_a_docstring(package):
    assert {"build", "open_scene"} <= set(geoscene.__all__)
    assert {"drive", "open_dataset"} <= set(lidar.__all__)
    for name in package.__all__:
        value = getattr(package, name)
        assert callable(value), name
        assert value.__doc__, name


@pytest.mark.full
def test_paths_may_be_text(scene, tmp_path):
    osm = geoscene.read_osm(str(geoscene.demo_path()), bounds=(24.9430, 60.1669, 24.9440, 60.1674))
    built = geoscene.build(osm, f"{tmp_path}/scene", options=geoscene.BuildOptions(lod=0))
    assert geoscene.open_scene(str(built.path)).bounds == built.bounds
    geoscene.view_scene(built, f"{tmp_path}/page.html")
    geoscene.export_scene(built, f"{tmp_path}/scene.ply")
    options = lidar.DriveOptions(route="random", rig="vlp16", duration=0.1, formats=("pcd",))
    drive = lidar.drive(scene, f"{tmp_path}/drive", options=options).path
    lidar.aggregate(lidar.open_dataset(str(drive)), f"{tmp_path}/map.laz")
    assert len(lidar.read_cloud(f"{drive}/lidar_top/pcd/000000.pcd")) > 1000
    apply_stages(
        str(drive),
        f"{tmp_path}/lossy",
        options=ApplyOptions(read_stages(["dropped_packets:loss=0.1"]).stages),
    )
