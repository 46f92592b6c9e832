"""Guessed looks in the page: only what is not mapped is guessed, and every guess is marked."""

from dataclasses import replace

import numpy as np
import pytest

from geoscene.buildings.guesses import WINDOWS
from geoscene.classes import Class
from geoscene.export.objects import read_features
from geoscene.geometry.mesh import ROOF, WALL
from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.sources import demo_path, read_osm
from geoscene.view.looks import GUESSED, STEP, read_looks

MAPPED = ({}, {"building:colour": "#dcd6c4"}, {"roof:colour": "black", "building:material": "brick"})
BOX = (24.9405, 60.1655, 24.9475, 60.1690)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    osm = read_osm(demo_path(), bounds=BOX)
    areas = [replace(a, tags=a.tags | MAPPED[k % 3]) for k, a in enumerate(osm.areas)]
    return build(
        replace(osm, areas=areas),
        tmp_path_factory.mktemp("looks") / "demo",
        options=BuildOptions(tile_size=200.0),
    )


@pytest.fixture(scope="module")
def looks(scene):
    return read_looks(scene)


def test_guesses_are_marked_on_unmapped_walls_and_roofs_alone(scene, looks):
    buildings = scene.features("buildings").columns
    default = {
        side: buildings["feature"][buildings[column] == "assumed"]
        for side, column in ((WALL, "wall_source"), (ROOF, "roof_look_source"))
    }
    assert 0 < len(default[WALL]) < len(buildings["feature"])
    changed = 0
    for tile in scene.tiles():
        mesh, dressed = tile.mesh, looks.dressed(tile).mesh
        for name in ("vertices", "faces", "feature", "klass", "material", "color", "closed"):
            assert getattr(mesh, name) is getattr(dressed, name)
        assert np.array_equal(mesh.surface, dressed.surface & ~np.uint8(GUESSED))
        guessed = (dressed.surface & GUESSED) != 0
        assert (mesh.klass[guessed] == Class.BUILDING).all()
        for side in (WALL, ROOF):
            faces = guessed & (mesh.surface == side)
            assert np.isin(mesh.feature[faces], default[side]).all()
            changed += int(faces.sum())
        assert np.isin(mesh.surface[guessed], (WALL, ROOF)).all()
    assert changed > 1000


def test_colours_of_a_building_are_the_guessed_ones_in_all_tiles(scene, looks):
    for tile in scene.tiles():
        mesh = looks.dressed(tile).mesh
        walls = ((mesh.surface & GUESSED) != 0) & ((mesh.surface & ~np.uint8(GUESSED)) == WALL)
        row = np.searchsorted(looks.facades.feature, mesh.feature[walls])
        assert np.array_equal(mesh.color[walls], looks.guesses.wall_color[row])


def test_the_table_marks_every_guess_and_nothing_that_is_mapped(scene, looks):
    features = read_features(scene)
    number = features.layers.index("buildings")
    told = looks.told(features).columns[number]
    for look, source in (("wall_look", "wall_source"), ("roofing", "roof_look_source")):
        unmapped = told[source] == "assumed"
        assert [value is not None for value in told[look]] == unmapped.tolist()
        assert [value == "guess" for value in told[f"{look}_source"]] == unmapped.tolist()
    assert np.array_equal(np.isfinite(told["storeys"]), ~(told["levels"] >= 0.5))
    drawn = looks.guesses.windows > 0
    assert [value is not None for value in told["windows"]] == drawn.tolist()
    assert [value == "guess" for value in told["windows_source"]] == drawn.tolist()
    assert set(told) - set(features.columns[number]) == {
        f"{name}{end}" for name in ("wall_look", "roofing", "storeys", "windows") for end in ("", "_source")
    }


def test_storeys_fill_the_walls_from_the_base_to_the_eaves(scene, looks):
    buildings = scene.features("buildings").columns
    codes = looks.facades.codes.astype(float)
    walls = buildings["height"] - buildings["roof_height"]
    usual = (codes[:, 2] * STEP > 2.05) & (codes[:, 2] * STEP < 11.9)
    assert usual.mean() > 0.9
    reached = codes[:, 1] * codes[:, 2] * STEP
    assert np.abs(reached - walls)[usual].max() <= 0.5 * STEP * codes[:, 1].max()
    assert np.allclose(looks.facades.base, buildings["base"], atol=1e-4)
    assert (codes[:, 0] < len(WINDOWS)).all()


def test_a_tile_has_the_facades_of_its_buildings(scene, looks):
    tile = scene.tile(0, 0)
    inside = np.unique(tile.mesh.feature[tile.mesh.klass == Class.BUILDING])
    assert looks.facades_of(tile.mesh).feature.tolist() == inside.tolist()


def test_a_scene_without_buildings_has_no_looks(tmp_path):
    osm = read_osm(demo_path(), bounds=BOX)
    scene = build(osm, tmp_path / "bare", options=BuildOptions(only=("roads",)))
    looks = read_looks(scene)
    assert len(looks.facades) == 0
    tile = scene.tile(*scene.tile_indices[0])
    assert looks.dressed(tile) is tile
    features = read_features(scene)
    assert looks.told(features) is features
