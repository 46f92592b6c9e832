"""Openings of walls follow tags and types, lie within their walls, and face free space."""

from dataclasses import fields, replace

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import affinity

from geoscene.buildings import build_solids, read_buildings
from geoscene.buildings.facades import read_setting, wall_relief
from geoscene.buildings.facades.solids import are_simple, outlines, relief_mesh
from geoscene.buildings.facades.styles import PARAPET
from geoscene.buildings.facades.walls import find_walls
from geoscene.classes import materials
from geoscene.geometry.frames import Frame
from geoscene.geometry.mesh import DOOR, WALL, WINDOW, Mesh, concatenate
from geoscene.geometry.watertight import validate_mesh
from geoscene.sources.data import Area, OsmData, TaggedNode, Way

FRAME = Frame.at(8.7, 49.4)
GLASS = materials()["glass"].code


def lonlat(xy):
    return np.column_stack(FRAME.to_geographic(*np.asarray(xy, float).T))


def house(number, shape, **tags):
    """A building with the scene coordinates of a shape; ``__`` in a key stands for a colon."""
    tags = {key.replace("__", ":"): value for key, value in ({"building": "yes"} | tags).items()}
    return Area(f"way/{number}", tags, shapely.transform(shape, lonlat), np.empty(0, np.int64))


def node(xy, number=1, **tags):
    lon, lat = lonlat([xy])[0]
    return TaggedNode(
        f"node/{number}", {key.replace("__", ":"): value for key, value in tags.items()}, lon, lat
    )


def entrance(xy, kind="yes"):
    return node(xy, entrance=kind)


def facades_of(*areas, points=(), ways=(), street=None, height=None, guess=False, passages=()):
    """Table, mesh and layout of a map, whose only street is a line of scene coordinates.

    passages : polygons in plan with their heights, through the first building
    """
    osm = OsmData((8.6, 49.3, 8.8, 49.5), list(ways), list(areas), list(points), [])
    table, _ = read_buildings(osm, FRAME)
    table.passages[0] = tuple(passages)
    mesh, _ = build_solids(table, base=np.zeros(table.count))
    lines = np.array([] if street is None else [shapely.LineString(street)], object)
    setting = read_setting(osm, FRAME, buildings=table, streets=lines)
    layout = wall_relief(mesh, setting, base=np.zeros(table.count), height=height, guess=guess)
    return table, mesh, layout


def panels_of(relief, *, part="panel"):
    """Wall, row, column and corners (n, 4) in wall coordinates of all openings, and their kind."""
    f = relief.facades
    out = []
    for w in range(len(f)):
        columns, rows = f.grid[w]
        index = relief.cells[f.first[w] : f.first[w] + columns * rows].reshape(rows, columns)
        for r, c in np.argwhere(index >= 0):
            floor = f.start[w, 1] + (f.ground[w] + (r - 1) * f.cell[w, 1] if r else 0.0)
            corner = np.tile([f.start[w, 0] + c * f.cell[w, 0], floor], 2)
            kind = index[r, c]
            out.append((w, r, c, corner + getattr(relief.openings, part)[kind], kind))
    return out


def outside(relief, wall, box):
    """Two points in plan, 1 m in front of the ends of a panel."""
    f = relief.facades
    out = np.array([f.tangent[wall, 1], -f.tangent[wall, 0]])
    return [f.foot[wall, :2] + u * f.tangent[wall] + out for u in box[[0, 2]]]


@st.composite
def blocks(draw):
    """Rotated unions of boxes, often with courtyards."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    corner, size = rng.uniform(-20, 20, (4, 2)), rng.uniform(1, 25, (4, 2))
    shape = shapely.union_all([shapely.box(*c, *(c + s)) for c, s in zip(corner, size, strict=True)])
    return affinity.rotate(shape, float(rng.uniform(0, 90)))


@pytest.mark.full
@given(
    blocks(),
    st.floats(3, 80),
    st.sampled_from(["yes", "house", "office", "retail", "church", "industrial", "parking", "garage"]),
    st.sampled_from(["flat", "gabled", "hipped", "skillion"]),
    st.integers(1, 10**9),
)
@settings(max_examples=30, deadline=None)
def test_panels_lie_within_their_walls_and_apart(shape, height, use, roof, number):
    table, mesh, layout = facades_of(
        house(number, shape, building=use, height=f"{height:.1f}", roof__shape=roof),
        street=[(-60, -40), (60, -40)],
    )
    relief = layout.relief
    f = relief.facades
    of_wall = {}
    for w, _, _, box, _ in panels_of(relief):
        of_wall.setdefault(w, []).append(shapely.box(*box))
    corners = mesh.vertices[mesh.faces]
    for w, boxes in of_wall.items():
        faces = corners[relief.wall == w]
        u = (faces[:, :, :2] - f.foot[w, :2]) @ f.tangent[w]
        off = (faces[:, :, :2] - f.foot[w, :2]) @ np.array([f.tangent[w, 1], -f.tangent[w, 0]])
        assert np.abs(off).max() < 2e-3
        uv = np.stack([u, faces[:, :, 2] - f.foot[w, 2]], axis=2)
        wall = shapely.union_all(shapely.polygons(uv), grid_size=1e-4)
        assert shapely.buffer(wall, -0.049, join_style="mitre").covers(shapely.union_all(boxes))
        assert not shapely.STRtree(boxes).query(boxes, predicate="intersects").shape[1] > len(boxes)
    assert set(mesh.surface[relief.wall >= 0].tolist()) <= {WALL}
    assert set(table.outline[mesh.feature[relief.wall >= 0]].tolist()) <= {0}


@pytest.mark.full
@given(st.integers(1, 10**9), st.integers(1, 12))
@settings(max_examples=25, deadline=None)
def test_a_building_has_as_many_rows_of_windows_as_storeys_are_tagged(number, levels):
    shape = shapely.box(0, 0, 24, 12)
    tags = {"building__levels": str(levels), "roof__shape": "flat"}
    _, _, layout = facades_of(house(number, shape, building="apartments", **tags))
    rows = {r for _, r, _, _, _ in panels_of(layout.relief)}
    assert rows == set(range(levels))
    assert set(layout.relief.facades.grid[:, 1].tolist()) == {levels}


@pytest.mark.parametrize(("height", "levels", "parapet"), [(13.0, 4, PARAPET), (3.2, 1, 0.1)])
def test_the_storeys_of_the_map_share_the_height_of_a_wall_below_its_parapet(height, levels, parapet):
    tags = {"height": str(height), "building__levels": str(levels), "roof__shape": "flat"}
    _, _, layout = facades_of(house(1, shapely.box(0, 0, 24, 12), building="apartments", **tags))
    facades = layout.relief.facades
    assert len(facades) == 4
    ceiling = facades.ground + (levels - 1) * facades.cell[:, 1]
    assert ceiling == pytest.approx(height - parapet)


def test_walls_closer_than_a_metre_to_another_building_are_blank_up_to_its_roof():
    _, _, layout = facades_of(
        house(1, shapely.box(0, 0, 12, 12), building="apartments", height="21"),
        house(2, shapely.box(12.6, 0, 24, 12), building="apartments", height="9"),
    )
    f = layout.relief.facades
    tall = [
        (w, box)
        for w, _, _, box, _ in panels_of(layout.relief)
        if f.feature[w] == 0 and abs(f.tangent[w, 1] - 1) < 1e-6
    ]
    assert len(tall) >= 6
    assert all(box[1] > 9.0 for _, box in tall)
    low = [w for w, *_ in panels_of(layout.relief) if f.feature[w] == 1]
    assert not any(abs(f.tangent[w, 1] + 1) < 1e-6 for w in low)


def test_a_door_is_at_each_mapped_entrance_and_nowhere_else():
    shape = shapely.box(0, 0, 20, 10)
    _, _, layout = facades_of(
        house(1, shape, building="apartments", height="13"),
        points=[entrance((6.3, 0.0))],
        street=[(-10, 20), (40, 20)],
    )
    assert layout.counts["entrances_mapped"] == layout.counts["doors"] == 1
    openings = layout.relief.openings
    (door,) = [
        (w, box)
        for w, r, _, box, kind in panels_of(layout.relief, part="opening")
        if r == 0 and box[1] < 0.3 and openings.infill[kind] != GLASS
    ]
    foot, tangent = layout.relief.facades.foot[door[0]], layout.relief.facades.tangent[door[0]]
    place = foot[:2] + door[1][[0, 2]].mean() * tangent
    assert np.abs(place - [6.3, 0.0]).max() < 0.35


def openings_from(layout, low, high):
    """Middles in plan, sizes and kinds of openings whose lower edge is between two heights."""
    f = layout.relief.facades
    return [
        (f.foot[w, :2] + box[[0, 2]].mean() * f.tangent[w], box[2:] - box[:2], kind)
        for w, _, _, box, kind in panels_of(layout.relief, part="opening")
        if low <= f.foot[w, 2] + box[1] <= high
    ]


def test_doors_have_their_mapped_size_and_wide_ones_are_gates():
    shape = shapely.box(0, 0, 24, 10)
    street = [(-10, -8), (40, -8)]
    block = house(1, shape, building="retail", height="6", shop="no")
    points = [
        node((4.0, 0.0), 1, door="yes", width="0.9", height="1.9"),
        node((20.0, 0.0), 2, entrance="yes", width="2.4", height="2.2"),
        node((12.0, 10.0), 3, door="yes", width="80"),  # no door is so wide
        node((8.0, 0.0), 4, door="yes", indoor="room"),
    ]
    _, _, layout = facades_of(block, points=points, street=street)
    found = {kind: layout.counts[kind] for kind in ("entrances_mapped", "doors", "gates")}
    assert found == {"entrances_mapped": 3, "doors": 2, "gates": 1}
    doors = [
        (middle, size) for middle, size, k in openings_from(layout, 0, 0.2) if layout.relief.openings.door[k]
    ]
    sizes = {tuple(np.round(middle / 4).astype(int) * 4): size for middle, size in doors}
    assert sizes[4, 0] == pytest.approx([0.9, 1.9])
    assert sizes[20, 0] == pytest.approx([2.4, 2.2])
    assert sizes[12, 8][0] < 2.0


def test_shop_fronts_are_where_shops_are_mapped():
    shape = shapely.box(0, 0, 60, 12)
    block = house(5, shape, building="apartments", height="16")
    street = [(-10, -9), (70, -9)]
    shop = node((50.0, 4.0), shop="bakery")
    _, _, layout = facades_of(block, points=[shop], street=street)
    fronts = [middle for middle, _, _ in openings_from(layout, 0.3, 0.4)]
    assert fronts
    assert all(abs(x - 50) <= 6 and abs(y) < 0.01 for x, y in fronts)
    assert layout.counts["shops_mapped"] == 1
    upstairs = node((50.0, 4.0), shop="tailor", level="1")
    assert facades_of(block, points=[upstairs], street=street)[2].counts["shops_mapped"] == 0
    away = facades_of(block, points=[shop], street=[(-10, 90), (70, 90)])[2].counts
    assert (away["shop_fronts"], away["shops_left_out"]) == (0, 1)


def test_shop_fronts_face_pedestrian_streets_and_stand_above_ground_that_rises():
    street = Way("way/9", {"highway": "pedestrian"}, np.arange(2), lonlat([(-10, -9), (70, -9)]))
    block = house(5, shapely.box(0, 0, 60, 12), building="apartments", height="16")
    shop = node((50.0, 4.0), shop="bakery")
    _, _, layout = facades_of(block, points=[shop], ways=[street], height=lambda x, y: 0.6 + 0 * x * y)
    fronts = openings_from(layout, 0.6 + 0.35 - 0.01, 0.6 + 0.35 + 0.11)
    assert layout.counts["shops_mapped"] == 1
    assert layout.counts["shop_fronts"] == len(fronts) > 0


@pytest.mark.parametrize("tags", [{"shop": "books"}, {"building__use": "residential; commercial"}])
def test_the_ground_floor_of_a_shop_has_shop_fronts_on_its_street(tags):
    block = house(5, shapely.box(0, 0, 20, 12), height="16", **tags)
    counts = facades_of(block, street=[(-10, -9), (30, -9)])[2].counts
    assert counts["shop_fronts"] >= 3


def test_facades_with_a_shop_or_door_of_the_map_are_tagged():
    blocks_ = [house(k, shapely.box(40 * k, 0, 40 * k + 20, 12), height="16") for k in (1, 2, 3)]
    points = [node((50, 5), 1, amenity="cafe"), node((90, 0), 2, door="hinged")]
    osm = OsmData((8.6, 49.3, 8.8, 49.5), [], blocks_, points, [])
    table, _ = read_buildings(osm, FRAME)
    setting = read_setting(osm, FRAME, buildings=table, streets=np.array([], object))
    assert setting.source.tolist() == ["tag", "tag", "guess"]


@pytest.mark.parametrize(
    ("tags", "windows"), [({"building__levels": "13", "tourism": "hotel"}, True), ({}, False)]
)
def test_a_tower_has_windows_if_it_has_storeys(tags, windows):
    _, _, layout = facades_of(house(1, shapely.box(0, 0, 20, 18), building="tower", height="70", **tags))
    assert (layout.counts["windows"] > 50) == windows


def test_doors_are_guessed_where_a_street_is():
    shape = shapely.box(0, 0, 14, 10)
    _, _, layout = facades_of(house(1, shape, building="house", height="6"), street=[(-30, -8), (40, -8)])
    assert layout.counts["doors"] == 1
    (wall,) = {w for w, r, _, box, _ in panels_of(layout.relief, part="opening") if box[1] < 0.2}
    assert layout.relief.facades.tangent[wall] == pytest.approx([1, 0], abs=1e-6)


def test_openings_are_above_the_ground_in_front_of_them():
    def height(x, y):
        return 0.35 * np.maximum(x, 0.0) + 0.0 * y

    shape = shapely.box(0, 0, 20, 10)
    _, _, layout = facades_of(house(1, shape, building="apartments", height="16"), height=height)
    for w, _, _, box, _ in panels_of(layout.relief):
        for x, y in outside(layout.relief, w, box):
            ground = height(np.array([x]), np.array([y]))[0] - 0.35 * (abs(x) > 20) * 0.7
            assert layout.relief.facades.foot[w, 2] + box[1] > ground


def test_what_is_guessed_depends_on_the_building_alone():
    first = house(7, shapely.box(0, 0, 20, 10), building="apartments", height="16")
    second = house(3, shapely.box(40, 0, 60, 10), building="apartments", height="19")
    alone = facades_of(first)[2].relief
    table, _, both = facades_of(second, first)
    row = table.osm_id.tolist().index("way/7")
    kept = [
        (w, r, c, box) for w, r, c, box, _ in panels_of(both.relief) if both.relief.facades.feature[w] == row
    ]
    for (_, r, c, box), (_, r2, c2, box2, _) in zip(kept, panels_of(alone), strict=True):
        assert (r, c) == (r2, c2)
        assert box == pytest.approx(box2)


def test_each_face_of_a_straight_wall_is_in_it():
    _, mesh, _ = facades_of(house(1, affinity.rotate(shapely.box(0, 0, 20, 10), 33), height="10"))
    walls, of_face = find_walls(mesh)
    assert len(walls) == 4
    assert (of_face[mesh.surface == WALL] >= 0).all()
    assert np.sort(walls.size[:, 0]) == pytest.approx([10, 10, 20, 20], abs=1e-3)
    moved = replace(mesh, vertices=mesh.vertices + np.array([5000.0, -3000.0, 100.0]))
    assert len(find_walls(moved)[0]) == 4


def test_an_outline_that_touches_itself_has_no_rings():
    squares = [(0, 0), (1, 0), (2, 0), (2, 1), (2, 2), (1, 2), (0, 1)]  # the last two meet in one point
    corners = [(x + dx, 0.0, z + dz) for x, z in squares for dx, dz in ((0, 0), (1, 0), (1, 1), (0, 1))]
    points, number = np.unique(np.array(corners), axis=0, return_inverse=True)
    quads = number.reshape(-1, 4)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    mesh = Mesh.of(points, faces, feature=0, surface=WALL)
    assert outlines(mesh, np.zeros(len(mesh), np.int32), count=1) == [None]
    assert not are_simple(mesh, np.zeros(len(mesh), np.int32), count=1).any()
    apart = np.tile([0, 0, 0, 0, 0, 0, 1], 2).astype(np.int32)
    assert [len(rings) for rings in outlines(mesh, apart, count=2)] == [1, 1]
    assert are_simple(mesh, apart, count=2).all()


def recesses(relief):
    """Volume behind the planes of the walls and its tolerance, by the areas of the parts of each opening."""
    o = relief.openings

    def area(box):
        return (box[:, 2] - box[:, 0]) * (box[:, 3] - box[:, 1])

    inner = np.stack([o.opening[:, k] + sign * o.frame for k, sign in enumerate((1, 1, -1, -1))], axis=1)
    wide, tall = inner[:, 2] - inner[:, 0], inner[:, 3] - inner[:, 1]
    across, up = (o.bars[:, k] * o.bar for k in (0, 1))
    panes = (wide - across) * (tall - up)
    volume = (area(o.panel) - area(o.sill)) * o.panel_depth
    volume += area(o.opening) * (o.reveal_depth - o.panel_depth) + panes * (o.pane_depth - o.reveal_depth)
    cells = relief.cells[relief.cells >= 0]
    return volume[cells].sum(), 1e-4 * relief.facades.size.prod(axis=1).sum()  # vertices are on a 0.1 mm grid


@pytest.mark.full
@given(
    blocks(),
    st.floats(4, 14),
    st.sampled_from(["yes", "house", "apartments", "office", "retail", "church", "parking", "garage"]),
    st.sampled_from(["flat", "gabled", "hipped", "skillion", "mansard"]),
    st.sampled_from(["brick", "glass", "stone", "wood"]),
    st.integers(1, 10**9),
)
@settings(max_examples=15, deadline=None)
def test_modelled_facades_are_closed_solids_less_their_recesses(shape, height, use, roof, material, number):
    tags = {"height": f"{height:.1f}", "roof__shape": roof, "building__material": material}
    _, mesh, layout = facades_of(house(number, shape, building=use, **tags), street=[(-60, -40), (60, -40)])
    modelled = relief_mesh(mesh, layout.relief)
    before, after = validate_mesh(mesh), validate_mesh(modelled)
    assert after.feature.tolist() == before.feature.tolist()
    assert [after.fault(k) for k in range(len(after))] == [""] * len(before)
    lost, (volume, tolerance) = before.volume.sum() - after.volume.sum(), recesses(layout.relief)
    assert lost == pytest.approx(volume, abs=tolerance + 1e-6)


@pytest.mark.full
@given(
    st.floats(-0.2, 0.2),
    st.floats(0.02, 0.5),
    st.floats(5, 25),
    st.floats(3, 7.5),
    st.sampled_from(["house", "office", "retail", "parking"]),
    st.integers(1, 10**9),
)
@settings(max_examples=25, deadline=None)
def test_openings_keep_clear_of_passages_behind_their_walls(turn, gap, x, top, use, number):
    passage = affinity.rotate(shapely.box(x - 3, 0, x + 3, 20), turn, use_radians=True)
    passage = affinity.translate(passage, 0, gap - passage.bounds[1])
    shape = shapely.box(0, 0, 30, 12)
    _, mesh, layout = facades_of(
        house(number, shape, building=use, height="9"),
        street=[(-60, -8), (60, -8)],
        passages=[(passage, top)],
    )
    before, after = (validate_mesh(m) for m in (mesh, relief_mesh(mesh, layout.relief)))
    assert [after.fault(k) for k in range(len(after))] == [before.fault(k) for k in range(len(before))]


def test_windows_stay_out_of_a_passage_that_runs_close_behind_their_wall():
    shape, street = shapely.box(0, 0, 30, 12), [(-60, -8), (60, -8)]
    houses = [house(7, shape, building="house", height="15")]
    passage = shapely.box(-1, 0.1, 31, 5)
    whole, cut = (facades_of(*houses, street=street, passages=p)[2].relief for p in ((), [(passage, 7.0)]))
    lowest = [
        min(box[1] for w, _, _, box, _ in panels_of(relief) if relief.facades.tangent[w, 0] > 0.99)
        for relief in (whole, cut)
    ]
    assert lowest[0] < 3.0
    assert lowest[1] > 7.0


def test_walls_of_a_passage_have_no_openings_and_facades_none_over_it():
    shape, street = shapely.box(0, 0, 30, 12), [(-60, -8), (60, -8)]
    passage = shapely.box(10, -0.1, 20, 12.1)
    _, _, layout = facades_of(house(7, shape, building="apartments", height="15"), street=street,
                              passages=[(passage, 4.5)])  # fmt: skip
    relief = layout.relief
    foot, tangent = relief.facades.foot, relief.facades.tangent
    inner = (foot[:, 0] > 9) & (foot[:, 0] < 21) & (np.abs(tangent[:, 0]) < 0.01)
    assert not inner.any()
    over = 0
    for wall, _, _, box, _ in panels_of(relief):
        if abs(tangent[wall, 0]) < 0.99:
            continue
        x = foot[wall, 0] + box[[0, 2]] * tangent[wall, 0]
        if x.max() > 10 and x.min() < 20:
            over += 1
            assert foot[wall, 2] + box[1] > 4.5
    assert over


def test_windows_and_doors_of_a_modelled_facade_are_marked():
    shape = shapely.box(0, 0, 20, 10)
    _, mesh, layout = facades_of(house(1, shape, building="house", height="6"), street=[(-30, -8), (40, -8)])
    modelled = relief_mesh(mesh, layout.relief)
    area = {code: (modelled.surface == code).sum() for code in (WALL, WINDOW, DOOR)}
    assert all(area.values())
    assert set(modelled.material[modelled.surface == WINDOW].tolist()) > {GLASS}
    door = modelled.vertices[modelled.faces[modelled.surface == DOOR]]
    assert door[:, :, 2].min() < 0.3
    assert np.abs(door[:, :, 1]).max() < 1.0  # at the wall to the street


def test_a_mesh_without_openings_is_unchanged():
    _, mesh, layout = facades_of(house(1, shapely.box(0, 0, 20, 10), building="shed", height="3"))
    assert not len(layout.relief.facades)
    assert relief_mesh(mesh, layout.relief) is mesh


@pytest.mark.full
@given(
    blocks(),
    st.sampled_from(["apartments", "retail", "hotel", "yes"]),
    st.integers(10, 25),
    st.integers(1, 10**9),
)
@settings(max_examples=20, deadline=None)
def test_what_stands_out_of_facades_is_closed_and_clear_of_its_walls_and_of_neighbours(
    shape, use, height, number
):
    beside = shapely.box(40.0, -30.0, 42.0, 30.0)
    table, mesh, layout = facades_of(
        house(number, shape, building=use, height=str(height)),
        house(number + 1, beside, building="shed", height="30"),
        street=[(-60, -40), (60, -40)],
        guess=True,
    )
    parts = layout.parts.mesh
    verdict = validate_mesh(concatenate([mesh, parts]))
    assert verdict.ok.all()
    assert layout.parts.guessed.all()
    corners = shapely.points(parts.vertices[:, :2])
    assert shapely.distance(table.footprint[1], corners).min(initial=9.0) > 0.5
    assert (parts.vertices[:, 2] > 0).all()


def test_balconies_stand_where_they_are_mapped_and_windows_behind_them_reach_the_floor():
    shape = shapely.box(0, 0, 30, 12)
    tags = {"building": "apartments", "building__levels": "5"}
    none = facades_of(house(1, shape, **tags))[2]
    assert not len(none.parts.mesh)
    _, _, layout = facades_of(house(1, shape, balcony="yes", **tags))
    assert layout.counts["balconies"] >= 4
    assert len(layout.parts.mesh)
    floors = [box[1] for _, r, _, box, _ in panels_of(layout.relief, part="opening") if r > 0]
    storey = layout.relief.facades.cell[0, 1]
    ground = layout.relief.facades.ground[0]
    low = [y for y in floors if (y - ground) % storey < 0.3]
    assert len(low) == layout.counts["balconies"]
    assert facades_of(house(1, shape, balcony="no", **tags), guess=True)[2].counts["balconies"] == 0


def test_of_what_stands_out_of_facades_mapped_balconies_alone_are_not_guessed():
    shape = shapely.box(0, 0, 30, 12)
    given = {"building": "apartments", "building__levels": "5", "balcony": "yes"}
    mapped = facades_of(house(1, shape, **given))[2].parts
    parts = facades_of(house(1, shape, **given), street=[(-30, -8), (60, -8)], guess=True)[2].parts
    assert parts.counts["cornices"] + parts.counts["downpipes"] > 0
    assert not mapped.guessed.any()
    left = parts.mesh.take(~parts.guessed)
    np.testing.assert_array_equal(left.vertices[left.faces], mapped.mesh.vertices[mapped.mesh.faces])


def test_a_mesh_without_faces_has_the_columns_of_a_building_without_openings():
    shed = house(1, shapely.box(0, 0, 2, 2), building="garage", height="1")
    table, mesh, layout = facades_of(shed)
    assert not len(layout.relief.facades)
    osm = OsmData((8.6, 49.3, 8.8, 49.5), [], [shed], [], [])
    setting = read_setting(osm, FRAME, buildings=table, streets=np.array([], object))
    empty = wall_relief(mesh.take(np.arange(0)), setting, base=np.zeros(table.count), height=None)
    for group in ("facades", "openings"):
        ours, theirs = getattr(empty.relief, group), getattr(layout.relief, group)
        for field in fields(ours):
            one, other = getattr(ours, field.name), getattr(theirs, field.name)
            assert (one.dtype, one.shape) == (other.dtype, other.shape), field.name
    assert empty.relief.cells.dtype == layout.relief.cells.dtype
    assert empty.relief.wall.dtype == layout.relief.wall.dtype
    assert not len(empty.parts.mesh)
    assert not any(empty.counts.values())
