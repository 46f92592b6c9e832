"""Roofs whose shape the map does not give: guessed by region, use, size and neighbours, always marked."""

import numpy as np
import pytest
import shapely
from shapely.affinity import rotate

from geoscene.buildings import BuildingOptions, build_solids, read_buildings
from geoscene.buildings.roof_guesses import without_guess
from geoscene.errors import InputError
from geoscene.export.kinds import export_scene
from geoscene.geometry.frames import Frame
from geoscene.geometry.mesh import ROOF
from geoscene.geometry.watertight import validate_mesh
from geoscene.options import BuildOptions, ExportOptions
from geoscene.pipeline.build import build
from geoscene.sources.data import Area, OsmData

GERMANY, EMIRATES = (8.7, 49.4), (55.3, 25.2)
GUESS = BuildingOptions(guess_roofs=True)


def town(place, shapes, **tags):
    """A map of buildings, scene metres, all with the same tags; ``__`` in a key stands for a colon."""
    frame, (lon, lat) = Frame.at(*place), place
    tags = {"building": "house"} | {key.replace("__", ":"): value for key, value in tags.items()}
    areas = [
        Area(
            f"way/{k + 1}",
            tags,
            shapely.transform(shape, lambda xy: np.column_stack(frame.to_geographic(*xy.T))),
            np.empty(0, np.int64),
        )
        for k, shape in enumerate(shapes)
    ]
    return OsmData((lon - 0.02, lat - 0.02, lon + 0.02, lat + 0.02), [], areas, [], [])


def guessed(shapes, place=GERMANY, extra=(), **tags):
    """The table of the buildings of a map, and of other maps' areas, with guessed roofs; closed solids."""
    osm = town(place, shapes, **tags)
    for k, other in enumerate(extra):
        osm.areas.extend(
            Area(f"relation/{1000 * k + int(a.osm_id[4:])}", a.tags, a.geometry, a.nodes) for a in other.areas
        )
    table, _ = read_buildings(osm, Frame.at(*place), options=GUESS)
    mesh, _ = build_solids(table, base=np.zeros(table.count))
    verdict = validate_mesh(mesh)
    assert verdict.ok.all()
    assert len(verdict) == table.count
    return table


def scattered(count, width=12.0, depth=9.0):
    return [
        rotate(shapely.box(x, y, x + width, y + depth), 7 * k, origin=(x, y))
        for k, (x, y) in enumerate((40.0 * (k % 12), 40.0 * (k // 12)) for k in range(count))
    ]


def pitched(table):
    return table.roof_height > 0


def test_most_houses_of_central_europe_have_pitched_roofs_and_few_in_arid_places():
    here, there = guessed(scattered(120)), guessed(scattered(120), EMIRATES)
    assert pitched(here).mean() > 0.8
    assert pitched(there).mean() < 0.25
    assert set(here.roof_shape) == {"gabled", "hipped", "flat"}
    assert (here.roof_shape == "gabled").sum() > (here.roof_shape == "hipped").sum()
    for table in (here, there):
        assert set(table.roof_source) == {"assumed"}
        assert ((table.roof_shape == "flat") == ~pitched(table)).all()


def test_guessed_roofs_have_the_pitch_of_their_region():
    table = guessed(scattered(60), height="9")
    rise = table.roof_height[pitched(table)]
    degrees = np.degrees(np.arctan2(rise, 4.5))
    assert ((degrees > 36) & (degrees < 44)).all()


@pytest.mark.parametrize(
    ("tags", "size"),
    [
        ({"building": "industrial"}, (30, 20)), ({"building": "retail"}, (60, 50)),
        ({"building": "office"}, (20, 15)), ({"building": "yes"}, (60, 40)),
        ({"building": "apartments", "building__levels": "14"}, (20, 15)),
        ({"building": "apartments", "height": "40"}, (20, 15)), ({"building": "roof"}, (12, 9)),
        ({"building": "carport"}, (6, 3)), ({"building": "greenhouse"}, (12, 9)),
        ({"building": "house", "roof__shape": "flat"}, (12, 9)),
        ({"building": "house", "roof__height": "0"}, (12, 9)),
        ({"building": "house", "roof__material": "tar_paper"}, (12, 9)),
        ({"building": "house", "roof__shape": "nonsense"}, (12, 9)),
        ({"building": "house", "min_height": "4", "height": "9"}, (12, 9)),
    ],
)  # fmt: skip
def test_large_commercial_high_and_flat_buildings_stay_flat(tags, size):
    assert not pitched(guessed(scattered(24, *size), **tags)).any()


@pytest.mark.parametrize(
    "tags",
    [{"roof__material": "roof_tiles"}, {"roof__height": "2.5"}, {"roof__levels": "1"}, {"roof__angle": "25"}],
)
def test_tags_beside_the_shape_tell_of_a_pitched_roof(tags):
    table = guessed(scattered(24), EMIRATES, height="9", **tags)
    assert pitched(table).all()
    if "roof__height" in tags:
        np.testing.assert_allclose(table.roof_height, 2.5)
    if "roof__angle" in tags:
        np.testing.assert_allclose(table.roof_height, 4.5 * np.tan(np.radians(25)), rtol=0.02)


def test_a_tagged_height_is_that_of_the_ridge_and_storeys_are_below_the_roof():
    table = guessed(scattered(24), height="8")
    np.testing.assert_allclose(table.height, 8)
    assert (table.height - table.roof_height >= 4.0 - 1e-9).all()
    by_storeys = guessed(scattered(24), building__levels="2")
    np.testing.assert_allclose(by_storeys.height - by_storeys.roof_height, 6.0)
    low = guessed(scattered(24), height="2.5")
    assert not pitched(low).any()  # too little would be left of the walls


def test_the_ridge_of_a_row_of_houses_runs_across_their_party_walls():
    """Units of 5 m by 10 m, side by side along x: the ridge of all runs along x, though they are deeper."""
    rows = [[shapely.box(5 * k, y, 5 * k + 5, y + 10) for k in range(7)] for y in (0, 30, 60, 90, 120)]
    table = guessed([unit for row in rows for unit in row], building="terrace", height="8")
    mesh, _ = build_solids(table, base=np.zeros(table.count))
    top = mesh.take(mesh.surface == ROOF)
    pitches = top.normals()[pitched(table)[top.feature]]
    assert len(pitches)
    assert np.abs(pitches[:, 0]).max() < 1e-6  # slopes face north and south
    for row in range(5):
        units = slice(7 * row, 7 * row + 7)
        assert len(set(table.roof_shape[units])) == 1
        assert np.ptp(table.roof_height[units]) < 1e-6


def test_neighbours_with_tags_outweigh_the_region():
    flat = town(EMIRATES, [shapely.box(x, -40, x + 12, -31) for x in range(0, 480, 20)], roof__shape="gabled")
    near, alone = (guessed(scattered(24), EMIRATES, extra=extra) for extra in ((flat,), ()))
    assert pitched(near)[near.roof_source == "assumed"].mean() > 0.5 > pitched(alone).mean()


def test_guesses_do_not_depend_on_the_order_of_the_map():
    shapes = scattered(40)
    osm = town(GERMANY, shapes)
    turned = OsmData(osm.bounds, [], osm.areas[::-1], [], [])
    first, second = (read_buildings(o, Frame.at(*GERMANY), options=GUESS)[0] for o in (osm, turned))
    for name in ("osm_id", "roof_shape", "roof_height", "roof_across"):
        assert (getattr(first, name) == getattr(second, name)).all()


def test_courtyards_odd_outlines_and_parts():
    yard = shapely.box(0, 0, 25, 25).difference(shapely.box(8, 8, 17, 17))
    corner = shapely.box(60, 0, 80, 8).union(shapely.box(60, 0, 68, 20))
    star = shapely.Point(120, 10).buffer(9, quad_segs=8)
    table = guessed([yard, corner, star], building="house", roof__material="roof_tiles")
    assert table.roof_shape[0] == "hipped"
    assert table.roof_shape[1] in {"gabled", "hipped"}
    assert table.roof_shape[2] == "flat" or pitched(table)[2]
    parts = town(GERMANY, [shapely.box(0, 0, 6, 9)], building="no", building__part="yes", height="5")
    divided = guessed([shapely.box(0, 0, 12, 9)], extra=(parts,))
    assert not pitched(divided).any()


def test_gables_are_guessed_only_where_they_can_be_built():
    """No roof on outlines of all kinds has to be replaced by another shape: tables tell what is built."""
    rng = np.random.default_rng(3)
    angle = np.sort(rng.uniform(0, 2 * np.pi, (60, 7)), axis=1)
    radius = rng.uniform(5, 10, angle.shape)
    outlines = [
        shapely.Polygon(np.stack([40 * (k % 8) + r * np.cos(a), 40 * (k // 8) + r * np.sin(a)], axis=1))
        for k, (a, r) in enumerate(zip(angle, radius, strict=True))
    ]
    frame = Frame.at(*GERMANY)
    osm = town(GERMANY, [o for o in outlines if o.is_valid], roof__material="roof_tiles", height="9")
    table, _ = read_buildings(osm, frame, options=GUESS)
    assert {"gabled", "hipped"} <= set(table.roof_shape)
    _, problems = build_solids(table, base=np.zeros(table.count))
    assert [p.detail for p in problems if p.reason == "roof-fallback"] == []


def test_without_guess_storeys_keep_the_height_of_the_walls():
    table = guessed(scattered(12), building__levels="2")
    level = without_guess(table, np.arange(len(table)) % 2 == 0)
    assert not pitched(level)[::2].any()
    assert (pitched(level) == pitched(table))[1::2].all()
    np.testing.assert_allclose(level.height[::2], 6.0)


@pytest.fixture(scope="module")
def village(tmp_path_factory):
    """A scene of houses with guessed roofs, in two tiles."""
    osm = town(GERMANY, scattered(30), height="8")
    return build(osm, tmp_path_factory.mktemp("village") / "scene", options=BuildOptions(relief="full"))


@pytest.mark.full
def test_exports_to_be_measured_in_have_no_guessed_roofs_unless_asked(village, tmp_path):
    table = village.features("buildings")
    guessed_roofs = table.columns["feature"][table.columns["roof_height"] > 0]
    assert len(guessed_roofs) > 20
    level = village.with_level_roofs()
    slopes = solids = 0
    for i, j in village.tile_indices:
        tile = level.tile(i, j)
        verdict = validate_mesh(tile.mesh.take(tile.mesh.closed))
        assert verdict.ok.all()
        solids += len(verdict)
        top = tile.mesh.take(np.isin(tile.mesh.feature, guessed_roofs) & (tile.mesh.surface == ROOF))
        slopes += int((top.normals()[:, 2] < 0.99).sum())
        assert len(tile.relief.wall) == len(tile.mesh) == len(tile.full_parts.faces)
        assert len(tile.full_parts.instances) == len(tile.instances)
    assert solids == 30
    assert slopes == 0
    columns = level.features("buildings").columns
    assert set(columns["roof_shape"]) == {"flat"}
    np.testing.assert_allclose(columns["height"], 8.0)

    def ridges(name, **options):
        done = export_scene(village, tmp_path / name, options=ExportOptions(**options), overwrite=True)
        return any("guessed are flat" in note for note in done.notes)

    assert ridges("a.city.json")
    assert ridges("a.gpkg")
    assert ridges("a.geojson")
    assert not ridges("a.city.json", roofs="guess")
    assert not ridges("a.stl")
    assert ridges("a.stl", roofs="flat")


def test_scenes_with_flat_roofs_on_request(tmp_path):
    osm = town(GERMANY, scattered(6), height="8")
    scene = build(osm, tmp_path / "scene", options=BuildOptions(roofs="flat"))
    assert set(scene.features("buildings").columns["roof_shape"]) == {"flat"}
    with pytest.raises(InputError, match="known are guess, flat"):
        BuildOptions(roofs="thatched")
    with pytest.raises(InputError, match="known are guess, flat"):
        ExportOptions(roofs="thatched")
