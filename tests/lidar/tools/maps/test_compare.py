"""Maps against true surfaces: distances are those to the nearest triangle, of whatever tile."""

import csv
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from geoscene.classes import Class
from geoscene.geometry.frames import Frame
from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.sources import demo_path, read_osm
from lidar.dataset.layout import open_dataset
from lidar.errors import InputError
from lidar.geometry.box_tree import lower_to_nearest, tree_of
from lidar.geometry.georeference import Georeference, export_crs
from lidar.tools.maps.compare import LIMIT, SurfaceComparison, SurfaceDistances, TrueSurfaces, far_reasons
from lidar.world.world import World

BOX = (24.9405, 60.1660, 24.9425, 60.1670)


@pytest.fixture(scope="module", params=["off", "plain"])
def places(request, tmp_path_factory):
    """A block of the demo map with plane walls, and with openings in them."""
    options = BuildOptions(relief=request.param, tile_size=100, use="lidar")
    return build(read_osm(demo_path(), bounds=BOX), tmp_path_factory.mktemp("scene") / "s", options=options)


def brute_force(points, corners):
    """Least distances (n,) from points to triangles by trimesh, of all pairs."""
    near = (trimesh.triangles.closest_point(corners, np.broadcast_to(p, (len(corners), 3))) for p in points)
    return [np.linalg.norm(n - p, axis=1).min() for n, p in zip(near, points, strict=True)]


@pytest.mark.full
@settings(deadline=None, max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 90), flat=st.booleans())
def test_distances_to_triangles_are_those_of_all_pairs(seed, count, flat):
    rng = np.random.default_rng(seed)
    centre = rng.uniform(-20, 20, (count, 1, 3))
    corners = centre + rng.normal(0, 3, (count, 3, 3)) * ([1, 1, 0] if flat else [1, 1, 1])
    points = np.concatenate([rng.uniform(-30, 30, (40, 3)), corners[:5, 0], corners[:5].mean(axis=1)])
    squared = np.full(len(points), np.inf)
    lower_to_nearest(points, corners, *tree_of(corners.min(axis=1), corners.max(axis=1)), squared)
    np.testing.assert_allclose(np.sqrt(squared), brute_force(points, corners), rtol=1e-9, atol=1e-9)


@pytest.mark.full
def test_a_nearer_distance_that_is_known_is_kept():
    corners = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])
    squared = np.array([0.25, 0.25])
    lower_to_nearest(
        np.array([[0.2, 0.2, 3.0], [0.2, 0.2, 0.1]]),
        corners,
        *tree_of(corners.min(axis=1), corners.max(axis=1)),
        squared,
    )
    np.testing.assert_allclose(squared, [0.25, 0.01])


def on_surfaces(scene, count, *, seed=0):
    """Points (count, 3) on triangles of all tiles and copies of shapes of a scene."""
    if scene.relief != "off":
        scene = scene.with_relief_mesh()
    corners = []
    shapes = [mesh.vertices[mesh.faces] for mesh in scene.shapes().values()]
    for tile in scene.tiles():
        corners.append(tile.mesh.vertices[tile.mesh.faces] + tile.origin)
        for shape, transform in zip(tile.instances.shape, tile.instances.transform, strict=True):
            placed = shapes[shape] @ transform[:, :3].T + transform[:, 3]
            corners.append(placed + tile.origin)
    corners = np.concatenate(corners)
    rng = np.random.default_rng(seed)
    share = rng.dirichlet(np.ones(3), count)
    return np.einsum("nc,ncd->nd", share, corners[rng.integers(len(corners), size=count)]), corners


@pytest.mark.full
def test_points_on_the_surfaces_of_a_scene_are_at_distance_zero(places):
    points, corners = on_surfaces(places, 3000)
    surfaces = TrueSurfaces(places, limit=LIMIT)
    assert surfaces.distances(points).max() < 1e-7  # slivers
    above = points[:200] + np.random.default_rng(1).normal(0, 1.5, (200, 3))
    low, high = above[:8].min(axis=0) - LIMIT, above[:8].max(axis=0) + LIMIT
    near = corners[((corners.max(axis=1) > low) & (corners.min(axis=1) < high)).all(axis=1)]
    found = surfaces.distances(above[:8])
    np.testing.assert_allclose(found, brute_force(above[:8], near), atol=1e-7)
    far = points[:5] + np.array([0.0, 0.0, 500.0])
    assert np.isinf(surfaces.distances(far)).all()


@pytest.mark.full
def test_what_rays_hit_of_buildings_is_on_the_surfaces(places):
    """Also in windows, whose panes lie behind the plane of the wall."""
    world = World.load(places)
    xmin, ymin, xmax, ymax = places.bounds
    rng = np.random.default_rng(3)
    start = np.column_stack([rng.uniform(xmin, xmax, 400), rng.uniform(ymin, ymax, 400), np.full(400, 40.0)])
    way = rng.normal(size=(400, 3)) * [1, 1, 0.4] - [0, 0, 0.8]
    way /= np.linalg.norm(way, axis=1)[:, None]
    hits = world.caster.cast(start, way)
    on = world.lookup(hits).klass == Class.BUILDING
    points = start[on] + hits.range[on, None] * way[on]
    behind = world.walls.panes(hits)[on] >= 0
    assert behind.any() == (places.relief != "off")
    assert on.sum() > 100
    # Faces of a wall may differ by a milliradian in bearing; panes lie 5 cm or more behind it.
    assert TrueSurfaces(places, limit=LIMIT).distances(points).max() < 0.01


def test_rows_and_files_of_a_comparison_hold_the_distances(places, tmp_path):
    crs = export_crs(places.frame)
    geo = Georeference(places.frame, crs, exact=True)
    points, _ = on_surfaces(places, 4000)
    points[1000:1010, 2] += 400.0
    label = np.full(4000, Class.BUILDING, np.uint8)
    label[:500] = Class.CAR
    east, north, up = geo.points(points).T
    table = {"x": east, "y": north, "z": up, "label": label}
    comparison = SurfaceComparison(places, places.frame, crs=crs)
    halves = [{k: v[:2000] for k, v in table.items()}, {k: v[2000:] for k, v in table.items()}]
    assert sum(len(t["x"]) for t in comparison.measured(iter(halves))) == 4000
    rows = {row.name: row for row in comparison.rows()}
    assert set(rows) == {"all", "all but road users", "building", "car"}
    assert (rows["all"].points, rows["car"].points, rows["all but road users"].points) == (4000, 500, 3500)
    assert rows["building"].beyond == 10
    assert rows["building"].largest_m == LIMIT
    assert rows["building"].mean_m == pytest.approx(10 * LIMIT / 3500, abs=1e-6)
    assert rows["all"].median_m < 1e-4
    table_path, picture = comparison.write(tmp_path / "m.laz")
    read = list(csv.DictReader(table_path.read_text().splitlines()))
    assert [row["name"] for row in read] == list(rows)
    assert float(read[0]["mean_m"]) == pytest.approx(rows["all"].mean_m, rel=1e-5)
    pixels = np.asarray(Image.open(picture))
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 5


def test_percentiles_are_those_of_all_distances(places):
    crs = export_crs(places.frame)
    points, _ = on_surfaces(places, 3000)
    points[:, 2] += np.linspace(0, 3, 3000)
    true = TrueSurfaces(places, limit=LIMIT).distances(points)
    east, north, up = Georeference(places.frame, crs, exact=True).points(points).T
    comparison = SurfaceComparison(places, places.frame, crs=crs)
    label = np.full(3000, Class.ROAD, np.uint8)
    list(comparison.measured(iter([{"x": east, "y": north, "z": up, "label": label}])))
    row = comparison.rows()[0]
    middle = np.percentile(true, 50, method="inverted_cdf")
    assert row.median_m == pytest.approx(middle, abs=1e-4)
    assert row.p95_m == pytest.approx(np.percentile(true, 95), abs=3e-3)
    assert row.mean_m == pytest.approx(true.mean(), abs=1e-6)


def test_a_scene_with_other_heights_is_refused(scene):
    frame = Frame(scene.frame.wkt, scene.frame.origin, "ellipsoidal")
    with pytest.raises(InputError, match="ellipsoidal"):
        SurfaceComparison(scene, frame, crs=export_crs(scene.frame))


def test_large_distances_are_explained_by_what_the_drive_is(scene, plain_drive):
    data = open_dataset(plain_drive)
    near, far = (
        SurfaceDistances(name, 100, p95 / 3, p95 / 3, p95_m=p95, rms_m=p95 / 2, largest_m=p95, beyond=0)
        for name, p95 in (("road", 0.02), ("building", 0.6))
    )

    def reasons(rows, scene=scene, **changes):
        recipe = data.manifest["recipe"] | changes
        changed = replace(data, manifest=data.manifest | {"recipe": recipe})
        return " ".join(far_reasons(changed, scene, rows=rows))

    assert reasons([near], fidelity="survey") == ""
    beams = reasons([near, far], fidelity="survey")
    assert beams.startswith("5 % or more of building lie farther than 0.1 m")
    assert "echoes merge to a point between them" in beams
    assert "another scene" not in beams
    assert "rays" not in reasons([far])
    assert "another scene" in reasons([far], scene=replace(scene, manifest={"fingerprint": "x"}))
    assert "stages added or moved" in reasons([far], stages=[{"name": "remove"}])
