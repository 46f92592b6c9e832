"""The GeoPackage has the features of the scene and depends on nothing else."""

import geopandas
import numpy as np
import shapely

from geoscene.geometry.frames import Frame
from geoscene.scene.geopackage import Layer, read_layer, write_geopackage


def layers():
    box = shapely.box(0, 0, 10, 20)
    return [
        Layer(
            "buildings",
            np.array([box, shapely.MultiPolygon([box, shapely.box(30, 0, 40, 5)])]),
            {
                "feature": np.array([0, 1], np.int32),
                "osm_id": np.array(["way/1", "relation/-2"]),
                "height": np.array([3.5, np.nan]),
                "name": np.array(["Ærø", ""]),
                "layer": np.array([-1, 2], np.int8),
            },
        ),
        Layer("empty", np.empty(0, object), {"osm_id": np.empty(0, str)}),
        Layer("trees", shapely.points([[1.0, 2.0, 3.0]]), {"feature": np.array([7])}),
    ]


def test_geopandas_reads_features_at_their_positions(tmp_path):
    frame = Frame.at(-76.3059, 36.8853, crs="utm")
    path = tmp_path / "features.gpkg"
    write_geopackage(path, layers(), frame=frame)
    found = geopandas.read_file(path, layer="buildings")
    assert found.crs.to_epsg() == 32618
    assert found.osm_id.tolist() == ["way/1", "relation/-2"]
    assert found.name.tolist() == ["Ærø", ""]
    assert found.height[0] == 3.5
    assert np.isnan(found.height[1])
    assert found.geometry[0].bounds == (383629.0, 4082945.0, 383639.0, 4082965.0)
    trees = geopandas.read_file(path, layer="trees")
    assert trees.geometry[0].z == 3.0


def test_reading_back_gives_scene_coordinates(tmp_path):
    frame = Frame.at(13.4, 52.5)
    write_geopackage(tmp_path / "a.gpkg", layers(), frame=frame)
    back = read_layer(tmp_path / "a.gpkg", "buildings", frame=frame)
    assert shapely.equals(back.geometry, layers()[0].geometry).all()
    assert back.columns["feature"].tolist() == [0, 1]


def test_geopackage_is_reproducible(tmp_path):
    frame = Frame.at(13.4, 52.5)
    for name in ("a.gpkg", "b.gpkg"):
        write_geopackage(tmp_path / name, layers(), frame=frame)
    assert (tmp_path / "a.gpkg").read_bytes() == (tmp_path / "b.gpkg").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.gpkg", "b.gpkg"]
