"""A small scene with every kind of object that exports must contain."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import shapely

from geoscene.classes import Class
from geoscene.geometry.frames import Frame
from geoscene.geometry.mesh import FLOOR, ROOF, WALL, Mesh, ShapeInstances, concatenate
from geoscene.objects.shapes import place, shapes
from geoscene.objects.solids import prism, rectangle
from geoscene.scene import open_scene
from geoscene.scene.geopackage import Layer
from geoscene.scene.tile_files import Tile, write_tile
from geoscene.scene.writer import SceneWriter
from helpers.roadgrids import road_graph

NAMES = ("way/1", "way/2", "way/3", "relation/4")
SOLID_VOLUMES = (10 * 20 * 30.0, 2 * 8 * 8 * 10.0, 20**3 - 10**3)
"""Volumes of the first three buildings: a box, two boxes, a box with a cavity."""

TREES = ((30.25, -40.5, 12.0), (-60.0, 33.0, 8.0), (-61.5, 30.0, 20.0))
SLOPE = 0.02


def _solid(points, faces, feature, wall=16, roof=21):
    mesh = Mesh.of(np.round(points, 4), faces, feature=feature, klass=Class.BUILDING, closed=True)
    up = mesh.normals()[:, 2]
    surface = np.select([up > 0.1, up < -0.1], [ROOF, FLOOR], WALL)
    material = np.where(surface == ROOF, roof, wall)
    color = np.where((surface == ROOF)[:, None], (165, 84, 60), (222, 214, 196))
    return Mesh.of(
        mesh.vertices, faces, feature=feature, klass=Class.BUILDING, closed=True,
        surface=surface, material=material, color=color,
    )  # fmt: skip


def buildings():
    """One mesh of four buildings; the last is rotated, tapered and 100 m above the ground."""
    box = _solid(*prism(rectangle(10, 20, x=12.5, y=-20.25), 0.0, top=30.0), 0)
    west = _solid(*prism(rectangle(8, 8, x=-80, y=60), 1.0, top=11.0), 1)
    east = _solid(*prism(rectangle(8, 8, x=-60, y=60), 1.0, top=11.0), 1)
    outer = _solid(*prism(rectangle(20, 20, x=60, y=60), 0.0, top=20.0), 2)
    points, faces = prism(rectangle(10, 10, x=60, y=60), 5.0, top=15.0)
    cavity = _solid(points, faces[:, ::-1], 2)
    turn = np.array([[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]])
    tower = _solid(*prism(rectangle(11.3, 7.7) @ turn, 2.0, top=140.0, taper=0.4), 3)
    return concatenate([box, west, east, outer, cavity, tower.shifted([-30.5, -60.25, 0])])


def hedge(feature):
    """A hedge of two bodies."""
    made = [prism(rectangle(6, 1, x=x, y=-80), -1.0, top=2.0) for x in (60, 70)]
    return concatenate(
        [
            Mesh.of(*solid, feature=feature, klass=Class.HEDGE, material=12, color=(66, 112, 48), closed=True)
            for solid in made
        ]
    )


def _ground(i, j, size, first):
    """A tile of sloping ground: a road along y = 0, bare ground elsewhere."""
    x0, y0 = i * size, j * size
    edges = [y0, y0 + 5, y0 + size] if j == 0 else [y0, y0 + size - 5, y0 + size]
    parts = []
    for low, high in pairwise(edges):
        xy = np.array([[x0, low], [x0 + size, low], [x0 + size, high], [x0, high]])
        road = abs(low + high) < 10
        parts.append(
            Mesh.of(
                np.column_stack([xy, SLOPE * xy[:, 0]]),
                np.array([[0, 1, 2], [0, 2, 3]]),
                feature=first if road else -1,
                klass=Class.ROAD if road else Class.TERRAIN,
                material=1 if road else 9,
                color=(70, 72, 76) if road else (120, 96, 70),
            )
        )
    return concatenate(parts)


def roads():
    """A junction of four arms, one bent and one one-way, with a signal and a forbidden left turn."""
    nodes = [(0, 0, 0), (-100, 0, -2), (100, 0, 2), (0, -100, 0), (0, 100, 0)]
    bends = {(0, 4): [(0, 0, 0), (5, 40, 0.5), (0, 100, 0)]}
    graph = road_graph(nodes, [(1, 0), (0, 2), (3, 0), (0, 4)], twoway=[True, True, True, False], bends=bends)
    return replace(
        graph,
        turn_from=np.array([0], np.int32),
        turn_via=np.array([0], np.int32),
        turn_to=np.array([6], np.int32),
        turn_kind=np.array(["no_left_turn"]),
        control_edge=np.array([0, 3], np.int32),
        control_offset=np.array([95.0, 96.0]),
        control_kind=np.array(["traffic_signals", "stop"]),
    )


def write_world(path, crs="utm", *, at=(13.35, 52.51)):
    """The scene, written to a folder and opened."""
    frame = Frame.at(*at, crs=crs, vertical="orthometric")
    solids, size = buildings(), 100.0
    first, tree = len(NAMES), len(NAMES) + 1
    graph = roads()
    lines = np.empty(len(graph), object)
    lines[:] = [shapely.linestrings(line) for line in graph.geometry]
    prints = shapely.box(
        *np.array([[0, -30, 20, 0], [-84, 56, -56, 64], [50, 50, 70, 70], [-40, -70, -20, -50]]).T
    )
    layers = [
        Layer(
            "buildings",
            prints,
            {
                "osm_id": np.array(NAMES),
                "name": np.array(["Rathaus «Süd»", "", "", "Turm"]),
                "height": np.array([30.0, 11.0, 20.0, 140.0]),
                "height_source": np.array(["tag", "default", "levels", "tag"]),
                "levels": np.array([np.nan, 3, np.nan, 40]),
            },
        ),
        Layer(
            "road_surfaces",
            np.array([shapely.box(-100, -5, 100, 5)]),
            {"osm_id": np.array(["way/9"]), "class": np.array(["road"]), "priority": np.array([140.0])},
        ),
        Layer(
            "trees",
            shapely.points(np.array(TREES)[:, :2]),
            {"osm_id": np.array([f"node/{k}" for k in range(3)]), "height": np.array(TREES)[:, 2]},
        ),
        Layer(
            "barriers",
            shapely.box([57], [-80.5], [73], [-79.5]),
            {"osm_id": np.array(["way/77"]), "kind": np.array(["hedge"])},
        ),
        Layer("roads", lines, {"osm_id": graph.osm_id, "lanes": graph.lanes, "bridge": graph.bridge}),
    ]
    x, y, height = np.array(TREES).T
    base = np.column_stack([x, y, SLOPE * x])
    feature = tree + np.arange(3)
    copies = ShapeInstances.concatenate(
        [
            place(
                "trunk", base, size=np.column_stack([0.03 * height, 0.03 * height, 0.6 * height]),
                feature=feature,
            ),
            place(
                "crown_broadleaved", base + np.column_stack([0 * x, 0 * x, 0.3 * height]),
                size=np.column_stack([0.6 * height, 0.5 * height, 0.7 * height]), heading=[0.4, 2.0, -1.0],
                feature=feature,
            ),
        ]
    )  # fmt: skip
    middle = np.array(
        [solids.vertices[solids.faces[solids.feature == k]].mean(axis=(0, 1)) for k in range(4)]
    )
    manifest = {
        "name": "world", "attribution": "(c) OpenStreetMap contributors", "fingerprint": "0f" * 10,
        "options": {"lod": 2}, "roads": {"driving_side": "right"},
        "sources": [{"timestamp": "2024-05-06T07:08:09Z"}],
        "bounds": [-100, -100, 100, 100], "tile_size": size,
        "tiles": [[-1, -1, 1], [-1, 0, 1], [0, -1, 1], [0, 0, 1]],
    }  # fmt: skip
    rows = []
    with SceneWriter(path) as writer:
        writer.files.tiles.mkdir()
        for i, j, _ in manifest["tiles"]:
            own = [k for k in range(4) if tuple(np.floor(middle[k, :2] / size)) == (i, j)]
            standing = [solids.take(np.isin(solids.feature, own))]
            standing += [hedge(tree + len(TREES))] if (i, j) == (0, -1) else []
            mesh = concatenate([*standing, _ground(i, j, size, first)])
            here = (np.floor(copies.transform[:, :2, 3] / size) == (i, j)).all(axis=1)
            some = copies.take(here)
            origin = np.array([i * size, j * size, np.floor(mesh.vertices[:, 2].min())])
            some.transform[:, :, 3] -= origin
            tile = Tile(origin, mesh.shifted(-origin), some)
            rows.append({"i": i, "j": j, "digest": write_tile(writer.files.tile(i, j), tile)})
        writer.finish(
            frame=frame, layers=layers, graph=graph, shapes=shapes(), problems=[], tiles={"tiles": rows},
            manifest=manifest,
        )  # fmt: skip
    return open_scene(path)
