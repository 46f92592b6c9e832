"""Scenes with relief hold their facades, count what is guessed, and export them as valid geometry."""

import json

import numpy as np
import pytest
from helpers.scenes import same_files

import geoscene.pipeline.tiles
from geoscene.buildings.facades.walls import find_walls
from geoscene.classes import Class
from geoscene.errors import InputError, SceneFormatError
from geoscene.export import export_scene
from geoscene.geometry.mesh import DOOR, WINDOW
from geoscene.geometry.watertight import validate_mesh
from geoscene.options import BuildOptions, ExportOptions
from geoscene.pipeline.build import build
from geoscene.scene.tile_files import pack, read_tile, write_tile
from geoscene.scene.validate import check_scene
from geoscene.sources import demo_path, read_osm
from geoscene.support.untrusted import read_arrays

BOX = (24.9405, 60.1655, 24.9440, 60.1675)
FULL = BuildOptions(relief="full", tile_size=100)


@pytest.fixture(scope="module")
def osm():
    return read_osm(demo_path(), bounds=BOX)


@pytest.fixture(scope="module")
def relief(osm, tmp_path_factory):
    return build(osm, tmp_path_factory.mktemp("relief") / "scene", options=FULL)


def test_scenes_without_relief_have_no_facades(osm, tmp_path):
    options = BuildOptions(relief="off", lod=1, tile_size=100, use="lidar")
    scene = build(osm, tmp_path / "scene", options=options)
    assert all(tile.relief is None and tile.full_parts is None for tile in scene.tiles())
    with pytest.raises(InputError, match="has no relief"):
        scene.with_relief_mesh()


def test_facades_are_counted_with_their_sources(relief):
    counts = relief.manifest["relief"]
    openings = sum(int((tile.relief.cells >= 0).sum()) for tile in relief.tiles())
    named = counts["facades"]
    assert openings == sum(named[name] for name in ("windows", "shop_fronts", "doors", "gates")) > 500
    table = relief.features("buildings", geometry="none").columns
    assert set(table["facade_source"].tolist()) == {"tag", "guess"}
    assert counts["facade_source"]["tag"] == (table["facade_source"] == "tag").sum()
    assert named["entrances_mapped"] > 0


def test_parts_that_stand_out_leave_solids_closed(relief):
    report = check_scene(relief)
    assert report["broken"] == []
    assert relief.manifest["relief"]["facades"]["balconies"] > 0


@pytest.mark.full
def test_the_bytes_of_relief_do_not_depend_on_workers(osm, relief, tmp_path):
    build(osm, tmp_path / "two", options=FULL, workers=2)
    same_files(relief.path, tmp_path / "two")


def test_a_tile_file_returns_its_relief_and_a_damaged_one_is_named(relief, tmp_path):
    index = next(k for k in relief.tile_indices if len(relief.tile(*k).relief.facades))
    tile = relief.tile(*index, forests=False)
    write_tile(tmp_path / "tile.npz", tile)
    again = read_tile(tmp_path / "tile.npz").relief
    assert again.cells.dtype == np.int32
    for name, column in tile.relief.openings.columns().items():
        assert np.array_equal(column, getattr(again.openings, name)), name
    arrays = dict(read_arrays(tmp_path / "tile.npz"))
    for damage in (
        {"relief_cells": arrays["relief_cells"] + np.int32(10**6)},
        {"facade_first": arrays["facade_first"] - np.int32(5)},
        {"opening_bar": arrays["opening_bar"][:-1]},
        {"relief_wall": arrays["relief_wall"][:-1]},
        {"extra_faces": arrays["extra_faces"][:-1]},
        {"extra_instances": np.zeros(len(arrays["extra_instances"]) + 1, np.bool_)},
    ):
        (tmp_path / "bad.npz").write_bytes(pack(arrays | damage))
        with pytest.raises(SceneFormatError, match=r"bad\.npz"):
            read_tile(tmp_path / "bad.npz")


def test_a_building_whose_facade_fails_is_reported_and_keeps_plane_walls(osm, relief, tmp_path, monkeypatch):
    inner = geoscene.pipeline.tiles.wall_relief
    index = next(k for k in relief.tile_indices if len(relief.tile(*k).relief.facades))
    victim = int(relief.tile(*index).relief.facades.feature[0])

    def failing(mesh, *args, **options):
        if victim in mesh.feature:
            raise ValueError("odd wall")
        return inner(mesh, *args, **options)

    monkeypatch.setattr(geoscene.pipeline.tiles, "wall_relief", failing)
    made = build(osm, tmp_path / "scene", options=FULL)
    before, after = (s.tile(*index).relief.facades.feature for s in (relief, made))
    assert set(before.tolist()) - set(after.tolist()) == {victim}
    assert "odd wall" in (made.path / "problems.csv").read_text()


@pytest.mark.full
def test_modelled_tiles_are_watertight(relief):
    tiles = list(relief.with_relief_mesh().tiles())
    smallest = min((t for t in tiles if (t.mesh.surface == WINDOW).any()), key=lambda t: len(t.mesh))
    assert validate_mesh(smallest.mesh).ok.all()
    assert any((t.mesh.surface == DOOR).any() for t in tiles)


@pytest.mark.full
def test_cityjson_has_windows_and_doors_in_closed_solids(relief, tmp_path):
    out = tmp_path / "city.city.json"
    export_scene(relief, out, options=ExportOptions(layers=("buildings",), relief="mesh"))
    city = json.loads(out.read_text())
    seen = set()
    for name, thing in city["CityObjects"].items():
        for geometry in (g for g in thing["geometry"] if g["type"] == "Solid"):
            shells = geometry["boundaries"]
            kinds = geometry["semantics"]["surfaces"]
            values = [kinds[k]["type"] for shell in geometry["semantics"]["values"] for k in shell]
            seen |= set(values)
            assert not ("Window" in values or "Door" in values) or geometry["lod"] == "3.2", name
            for k, kind in enumerate(kinds):
                if kind["type"] in ("Window", "Door"):
                    assert kinds[kind["parent"]]["type"] == "WallSurface"
                    assert k in kinds[kind["parent"]]["children"]
            for shell in shells:
                edges = {}
                for ((a, b, c),) in shell:
                    for edge in ((a, b), (b, c), (c, a)):
                        edges[edge] = edges.get(edge, 0) + 1
                assert all(count == 1 and edges.get(edge[::-1]) == 1 for edge, count in edges.items()), name
    types = {thing["type"] for thing in city["CityObjects"].values()}
    assert {"Building", "BuildingInstallation"} <= types
    assert {"Window", "Door", "WallSurface", "RoofSurface", "GroundSurface"} <= seen


# Types of CityJSON 2.0 that may have instances of templates, and those that need a parent.
INSTANCED = {"CityFurniture", "SolitaryVegetationObject", "OtherConstruction", "BuildingInstallation"}


def test_what_stands_on_roofs_is_an_installation_of_its_building_in_cityjson(relief, tmp_path):
    out = tmp_path / "city.city.json"
    export_scene(relief, out)
    things = json.loads(out.read_text())["CityObjects"]
    copies = {
        name: thing
        for name, thing in things.items()
        if any(g["type"] == "GeometryInstance" for g in thing["geometry"])
    }
    assert {thing["type"] for thing in copies.values()} <= INSTANCED
    on_roofs = {n: thing for n, thing in copies.items() if thing["type"] == "BuildingInstallation"}
    assert on_roofs
    for name, thing in on_roofs.items():
        (owner,) = thing["parents"]
        assert things[owner]["type"] == "Building"
        assert name in things[owner]["children"]


def test_every_wall_of_a_building_has_openings_or_a_cause_for_being_a_plane(relief, tmp_path):
    walls = 0
    for tile in relief.tiles():  # barriers are closed and have upright faces, too
        solids = tile.mesh.take(tile.mesh.closed & (tile.mesh.klass == Class.BUILDING))
        walls += len(find_walls(solids)[0])
    counts = relief.manifest["relief"]["facades"]
    told = [counts[name] for name in ("walls", "walls_small", "walls_blank", "walls_touching")]
    assert min(told[:3]) > 0
    assert sum(told) == walls
    summary = export_scene(relief, tmp_path / "walls.stl", options=ExportOptions(relief="mesh"))
    assert f"openings of {counts['walls']} walls are geometry" in summary.notes[-1]


def test_relief_of_an_export_is_mesh_or_left_out():
    with pytest.raises(InputError, match="relief"):
        ExportOptions(relief="bumps")
