"""Rough ground: the stated spectra, and rays that end on the surface, however flat they come."""

import importlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.classes import Class, materials
from geoscene.geometry.mesh import Mesh
from lidar.errors import InputError
from lidar.raycast import Caster
from lidar.raycast.relief import GroundRefiner, ground_tables
from lidar.raycast.relief.crossing import heights
from lidar.raycast.relief.roughness import BLOCK, KINDS, LEVELS, N0, NODES, REACH, STEP, roughness

SIDE = 200.0
KIND_OF = {"asphalt": ("asphalt", Class.ROAD), "paving": ("paving", Class.SIDEWALK)}
KIND_OF |= {
    "sett": ("stone", Class.ROAD),
    "ballast": ("ballast", Class.RAIL),
    "grass": ("grass", Class.GRASS),
}
SLOPE = np.array([0.08, -0.05])


def ground(kind, slope=SLOPE, *, side=SIDE, **chosen):
    """A sloping square of a kind of ground about the origin, and its plane's height function."""
    material, klass = KIND_OF[kind]
    xy = side / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]])
    mesh = Mesh.of(
        np.column_stack([xy, xy @ slope]),
        [[0, 1, 2], [0, 2, 3]],
        klass=klass,
        material=materials()[material].code,
    )
    caster = Caster(mesh.vertices, mesh.faces, origin=np.zeros(3), **chosen)
    caster.refiners = [GroundRefiner(ground_tables(mesh, origin=np.zeros(3)))]
    return caster


def above(kind, points, slope=SLOPE):
    """Metres (n,) of points above the rough surface, vertically."""
    return points[:, 2] - points[:, :2] @ slope - heights(kind, points[:, :2])


def looks(rng, count, *, lowest_deg, highest_deg):
    """Unit rays from 2 m above the ground near the origin, this much below the horizon."""
    start = np.column_stack([rng.uniform(-5, 5, (count, 2)), np.zeros(count)])
    start[:, 2] = start[:, :2] @ SLOPE + 2.0
    turn, down = rng.uniform(0, 2 * np.pi, count), np.radians(rng.uniform(lowest_deg, highest_deg, count))
    way = np.column_stack([np.cos(down) * np.cos(turn), np.cos(down) * np.sin(turn), -np.sin(down)])
    way[:, 2] += way[:, :2] @ SLOPE
    return start, way / np.linalg.norm(way, axis=1, keepdims=True)


def density_along_lines(kind, *, lines=400, step=0.02, count=1024):
    """One-sided power spectral density of heights along random straight lines (Welch 1967)."""
    rng = np.random.default_rng(3)
    total = np.zeros(count // 2 + 1)
    window = np.hanning(count)
    for _ in range(lines):
        start, turn = rng.uniform(0, 500, 2), rng.uniform(0, 2 * np.pi)
        xy = start + np.arange(count)[:, None] * step * np.array([np.cos(turn), np.sin(turn)])
        z = heights(kind, xy)
        total += np.abs(np.fft.rfft((z - z.mean()) * window)) ** 2
    return np.fft.rfftfreq(count, step), 2 * step * total / lines / (window**2).sum()


@pytest.mark.full
@pytest.mark.parametrize(("kind", "stated"), [("asphalt", 16e-6), ("concrete", 16e-6)])
def test_roads_have_the_spectrum_of_iso_8608(kind, stated):
    n, density = density_along_lines(kind)
    for low, high in ((0.3, 0.6), (0.6, 1.5), (1.5, 4.0)):
        band = (n >= low) & (n < high)
        measured = np.exp(np.mean(np.log(density[band] * (n[band] / N0) ** 2)))
        assert measured == pytest.approx(stated, rel=0.25)  # a class spans a factor of 4


@pytest.mark.parametrize("kind", KINDS)
def test_rough_ground_lies_at_or_below_its_plane_within_its_depth_and_slope(kind):
    rng = np.random.default_rng(1)
    xy = rng.uniform(-1e4, 1e4, (100_000, 2))
    z = heights(kind, xy)
    depth, slope = roughness().kinds[list(KINDS).index(kind)][[5, 6]]
    assert (z <= 0).all()
    assert (z >= -depth).all()
    moved = xy + 1e-4 * rng.normal(size=xy.shape)
    change = np.abs(heights(kind, moved) - z) / np.linalg.norm(moved - xy, axis=1)
    assert change.max() <= slope * (1 + 1e-6)
    assert z.std() > 5e-4


@pytest.mark.parametrize("kind", ["asphalt", "soil", "grass", "ballast"])
@pytest.mark.parametrize("towards", range(4))
@pytest.mark.parametrize("reach", [0.01, 0.1, 1.0, 6.0])
@pytest.mark.parametrize("level", [0, 1, LEVELS - 1])
def test_no_place_ahead_rises_faster_than_the_steepness_of_a_block(kind, towards, reach, level):
    rough, k = roughness(), list(KINDS).index(kind)
    rng = np.random.default_rng(4)
    start = rng.uniform(0, 30, (30_000, 2))
    sign = np.array([-1 if towards & 2 else 1, -1 if towards & 1 else 1])
    ahead = reach * rng.uniform(0, 1, start.shape) ** rng.integers(1, 4, (len(start), 1))
    rise = heights(kind, start + sign * ahead, level=level) - heights(kind, start, level=level)
    nodes, side, f = NODES >> level, STEP * 2**level, rough.number[k]
    i, j = (np.floor(start / side).astype(int) % nodes // BLOCK).T
    first = rough.first[f, level] // BLOCK**2
    steep = rough.unit[f, level] * rough.steep[towards, first + i * (nodes // BLOCK) + j]
    bound = rough.kinds[k, 0] * steep * ahead.max(axis=1) / side
    assert (rise <= bound + 1e-9).all()


@pytest.mark.parametrize("kind", ["asphalt", "ballast"])
@pytest.mark.parametrize("towards", range(4))
@pytest.mark.parametrize("level", range(LEVELS))
def test_no_place_near_ahead_is_higher_than_the_top_of_a_block(kind, towards, level):
    rough, k = roughness(), list(KINDS).index(kind)
    rng = np.random.default_rng(4)
    nodes, side, f = NODES >> level, STEP * 2**level, rough.number[k]
    start = rng.uniform(0, nodes * side, (100_000, 2))
    sign = np.array([-1 if towards & 2 else 1, -1 if towards & 1 else 1])
    ahead = start + sign * side * REACH * rng.uniform(0, 1, start.shape)
    i, j = (np.floor(start / side).astype(int) // REACH).T
    first = rough.first[f, level] // REACH**2
    top = rough.top[towards, first + i * (nodes // REACH) + j] * rough.kinds[k, 0]
    higher = heights(kind, ahead, level=level) - (rough.kinds[k, 8] if level else 0.0) - top
    assert (higher <= 1e-9).all()
    assert higher.max() > -0.1 * heights(kind, ahead, level=level).std()


@pytest.mark.parametrize("kind", KIND_OF)
@pytest.mark.parametrize("level", range(1, LEVELS))
def test_levels_have_the_mean_height_of_the_surface(kind, level):
    xy = np.random.default_rng(6).uniform(0, 12.8 * 25, (200_000, 2))
    exact = heights(kind, xy)
    assert heights(kind, xy, level=level).mean() == pytest.approx(exact.mean(), abs=0.01 * exact.std())


@pytest.mark.parametrize("kind", ["asphalt", "ballast", "grass"])
@pytest.mark.parametrize("level", range(1, LEVELS))
def test_levels_are_means_of_the_surface(kind, level):
    rng = np.random.default_rng(5)
    side = STEP * 2**level
    nodes = side * rng.integers(0, NODES >> level, (60, 2))
    # Nodes are means weighted by a triangle that ends two cells away, but for how nodes between are taken.
    offset = side * (np.arange(-64, 65) + 0.37) / 64
    weight = np.maximum(1.0 - np.abs(offset) / side, 0.0)
    around = np.stack(np.meshgrid(offset, offset, indexing="ij"), axis=-1).reshape(-1, 2)
    z = heights(kind, (nodes[:, None] + around).reshape(-1, 2)).reshape(len(nodes), -1)
    mean = z @ np.outer(weight, weight).ravel() / weight.sum() ** 2
    found = heights(kind, nodes, level=level)
    spread = z.std(axis=1).mean()
    assert np.abs(found - mean).mean() < 0.15 * spread
    assert abs((found - mean).mean()) < 0.05 * spread
    assert (found <= 0).all()


@pytest.mark.parametrize("kind", KIND_OF)
@pytest.mark.parametrize("footprint", [(0.0, 0.003), (0.01, 0.0), (0.02, 0.03)])
@pytest.mark.parametrize("scattered", [True, False])
def test_rays_with_a_footprint_end_on_the_mean_and_pass_nothing_of_it_before(kind, footprint, scattered):
    start, way = looks(np.random.default_rng(8), 3000, lowest_deg=1.2, highest_deg=60)
    way *= np.random.default_rng(1).uniform(0.5, 2, (len(way), 1))
    hits = ground(kind).cast(
        start, way, footprint=footprint, scattered=scattered, normals=not scattered, threads=2
    )
    plane = bare(kind).cast(start, way)
    far = plane.range * np.linalg.norm(way, axis=1)
    octaves = np.log2((footprint[0] + footprint[1] * far) / plane.cosine / 2 / STEP)
    nearest = np.clip(np.rint(octaves), 0, LEVELS - 1).astype(int)
    other = np.clip(np.where(octaves > nearest, nearest + 1, nearest - 1), 0, LEVELS - 1)

    def over(share, level):
        points = start + (plane.range + share * (hits.range - plane.range))[:, None] * way
        z = np.empty(len(points))
        for one in np.unique(level):
            z[level == one] = heights(kind, points[level == one, :2], level=int(one))
        return points[:, 2] - points[:, :2] @ SLOPE - z

    on_nearest = np.abs(over(1.0, nearest)) < 1e-6
    level = np.where(on_nearest, nearest, other)
    assert np.abs(over(1.0, level)).max() < 1e-6
    assert len(np.unique(level)) > 2
    between = (np.abs(octaves - nearest) > 0.24) & (nearest != other)
    assert on_nearest[~between].all()
    if scattered:
        assert 0.05 < 1.0 - on_nearest[between].mean() < 0.4
    else:
        assert on_nearest.all()
        np.testing.assert_allclose(np.linalg.norm(hits.normal, axis=1), 1.0)
    for share in (0.0, 0.3, 0.7, 0.95, 0.999):
        assert (over(share, level) > -1e-4).all()
    assert (hits.range >= plane.range).all()


def test_far_rays_with_a_footprint_see_calmer_ground():
    start, way = looks(np.random.default_rng(8), 5000, lowest_deg=2, highest_deg=3)
    caster = ground("grass")
    exact, mean = (caster.cast(start, way, footprint=(0.0, w), normals=True) for w in (0.0, 0.003))
    tilt = [np.linalg.norm(hits.normal[:, :2] + SLOPE, axis=1).mean() for hits in (exact, mean)]
    assert tilt[1] < 0.3 * tilt[0]
    # Flat rays meet the crests of what they resolve, so the mean lies deeper and its ranges are longer.
    assert mean.range.mean() > exact.range.mean()


@pytest.mark.parametrize("footprint", [(-0.1, 0.0), (0.0, np.nan), (np.inf, 0.0)])
def test_a_footprint_that_is_no_width_is_refused(footprint):
    with pytest.raises(InputError, match="footprint"):
        ground("grass").cast([0, 0, 2.0], [[0, 0, -1.0]], footprint=footprint)


@pytest.mark.parametrize("kind", KIND_OF)
@pytest.mark.parametrize(("lowest", "highest"), [(20.0, 89.0), (2.0, 5.0), (1.2, 1.5)])
@pytest.mark.parametrize("normals", [True, False])
def test_rays_end_on_the_surface_and_pass_nothing_of_it_before(kind, lowest, highest, normals):
    start, way = looks(np.random.default_rng(7), 3000, lowest_deg=lowest, highest_deg=highest)
    hits = ground(kind).cast(start, way, normals=normals)
    there = np.isfinite(hits.range)
    assert there.all()
    points = start + hits.range[:, None] * way
    assert np.abs(above(kind, points)).max() < 1e-6
    # On the way down through the roughness, rays are above the surface but for dips of half a millimetre.
    plane = Caster.cast(bare(kind), start, way).range
    for share in np.linspace(0.0, 0.999, 60):
        before = start + (plane + share * (hits.range - plane))[:, None] * way
        assert (above(kind, before) > -1e-4).all()
    if normals:
        np.testing.assert_allclose(np.linalg.norm(hits.normal, axis=1), 1.0)
        assert (hits.normal[:, 2] > 0).all()


def bare(kind):
    caster = ground(kind)
    caster.refiners = []
    return caster


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(sorted(KIND_OF)), st.sampled_from([0.0, 0.003]))
def test_hits_do_not_depend_on_other_rays_or_threads(seed, kind, width):
    start, way = looks(np.random.default_rng(seed), 5, lowest_deg=1.5, highest_deg=60)
    caster, footprint = ground(kind), (0.0, width)
    together = caster.cast(start, way, footprint=footprint, threads=2)
    alone = [caster.cast(start[[k]], way[[k]], footprint=footprint).range[0] for k in range(5)]
    np.testing.assert_array_equal(together.range, alone)


def test_a_hit_beyond_the_end_of_the_ray_is_a_miss():
    start, way = looks(np.random.default_rng(2), 500, lowest_deg=5, highest_deg=30)
    plane, rough = bare("grass").cast(start, way).range, ground("grass").cast(start, way).range
    end = float(np.median((plane + rough) / 2))
    cut = ground("grass").cast(start, way, far=end).range
    np.testing.assert_array_equal(cut, np.where(rough <= end, rough, np.inf))


@pytest.mark.parametrize("kind", KIND_OF)
def test_light_leaves_a_point_on_rough_ground_upwards_and_hits_the_surface_sideways(kind):
    start, way = looks(np.random.default_rng(9), 2000, lowest_deg=30, highest_deg=80)
    caster = ground(kind)
    hits = caster.cast(start, way, normals=True)
    place = start + hits.range[:, None] * way + 1e-3 * hits.normal
    up = np.tile([0.0, 0.0, 1.0], (len(place), 1))
    assert not caster.occluded(place, up, on=hits.face).any()
    down = caster.cast(place, -up, on=hits.face)
    assert (down.face >= 0).all()
    assert np.abs(above(kind, place - down.range[:, None] * up)).max() < 1e-6


@pytest.mark.parametrize("backend", ["float64", "embree"])
def test_a_slope_throws_no_shadow_on_the_foot_below_its_plane(backend):
    """Two planes of grass meet in a hollow: the ray to the sun leaves one plane behind the other."""
    corner = np.array([[-9, -9, 0], [0, -9, 0], [0, 9, 0], [-9, 9, 0], [9, -9, 2.7], [9, 9, 2.7]], float)
    mesh = Mesh.of(
        corner,
        [[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]],
        klass=Class.GRASS,
        material=materials()["grass"].code,
    )
    caster = Caster(mesh.vertices, mesh.faces, origin=np.zeros(3), backend=backend)
    caster.refiners = [GroundRefiner(ground_tables(mesh, origin=np.zeros(3)))]
    rng = np.random.default_rng(4)
    start = np.column_stack([rng.uniform(-0.2, 0.0, 2000), rng.uniform(-5, 5, 2000), np.full(2000, 2.0)])
    hits = caster.cast(start, np.tile([0.0, 0.0, -1.0], (2000, 1)), normals=True)
    place = start - np.outer(hits.range, [0, 0, 1]) + 1e-3 * hits.normal
    sun = np.tile([0.7, 0.1, 0.7], (2000, 1))
    assert caster.occluded(place, sun, on=hits.face).mean() < 0.02


@pytest.mark.parametrize("kind", ["asphalt", "paving", "sett"])
def test_the_plane_throws_no_shadow_on_peaks_that_nearly_reach_it_far_from_the_origin(kind):
    start, way = looks(np.random.default_rng(9), 50_000, lowest_deg=30, highest_deg=80)
    start += [3000.0, -1800.0, 3000.0 * SLOPE[0] - 1800.0 * SLOPE[1]]
    exact, fast = (ground(kind, side=8000.0, backend=name) for name in ("float64", "embree"))
    hits = exact.cast(start, way, normals=True)
    place = start + hits.range[:, None] * way + 1e-3 * hits.normal
    height = place[:, 2] - place[:, :2] @ SLOPE
    assert (height > 0).sum() > 100
    sun = np.tile([0.5, -0.6, 0.7], (len(place), 1))
    shadow = exact.occluded(place, sun, on=hits.face)
    np.testing.assert_array_equal(fast.occluded(place, sun, on=hits.face), shadow)


@pytest.mark.parametrize("kind", KIND_OF)
@pytest.mark.parametrize("up_deg", [80.0, 50.0, 20.0, 3.0])
def test_light_leaves_the_mean_over_a_footprint_as_it_leaves_the_surface_there(kind, up_deg):
    start, way = looks(np.random.default_rng(9), 2000, lowest_deg=2, highest_deg=10)
    caster = ground(kind)
    hits = caster.cast(start, way, footprint=(0.0, 0.003), scattered=True, normals=True)
    place = start + hits.range[:, None] * way + 1e-3 * hits.normal
    raised = place.copy()
    under = above(kind, place) < 0
    assert under.any()
    raised[under, 2] += 1e-3 - above(kind, place)[under]
    turn = np.random.default_rng(3).uniform(0, 2 * np.pi, len(place))
    rise = np.tan(np.radians(up_deg))
    sun = np.column_stack([np.cos(turn), np.sin(turn), np.full(len(turn), rise)])
    sun[:, 2] += sun[:, :2] @ SLOPE
    seen, there = (caster.cast(p, sun, on=hits.face, far=50.0).face >= 0 for p in (place, raised))
    assert (seen != there).mean() < 0.005
    if up_deg > 60:
        assert seen.mean() < 0.05


def test_kerbs_walls_and_water_have_no_roughness():
    codes = materials()
    xyz = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0], [0, 0, 1]])
    mesh = Mesh.of(
        xyz,
        [[0, 1, 2], [0, 1, 3], [0, 1, 2], [0, 1, 2]],
        klass=np.array([Class.KERB, Class.ROAD, Class.WATER, Class.ROAD]),
        material=np.array([codes[name].code for name in ("concrete", "asphalt", "water", "asphalt")]),
    )
    assert (ground_tables(mesh, origin=np.zeros(3)).kind >= 0).tolist() == [False, False, False, True]


@pytest.mark.parametrize("left", [1000, 0, None])
def test_tables_are_kept_and_made_again_where_they_are_damaged_or_of_other_sources(home, monkeypatch, left):
    module = importlib.import_module("lidar.raycast.relief.roughness")
    path = home / ".cache" / "geoscene" / "roughness.npz"
    tables, calls = roughness(), []
    path.unlink(missing_ok=True)
    monkeypatch.setattr(module, "_made", lambda: calls.append(1) or tables)

    def again():
        found = roughness.__wrapped__()
        assert all(np.array_equal(one, other) for one, other in zip(found, tables, strict=True))
        return len(calls)

    assert (again(), again()) == (1, 1)
    if left is None:
        monkeypatch.setattr(module, "_made_by", lambda: bytes(32))
    else:
        path.write_bytes(path.read_bytes()[:left])
    assert (again(), again()) == (2, 2)
