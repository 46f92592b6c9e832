"""Rays that hit a wall hit its openings as if they were built of triangles."""

import numpy as np
import pytest
from helpers.facades import plane_mesh, random_relief, relief_mesh
from hypothesis import given, settings
from hypothesis import strategies as st

from lidar.geometry.poses import Poses
from lidar.raycast import ALL, Caster
from lidar.raycast.relief import FRAME, INFILL, PARTS, ROOM, SILL, WallRefiner
from lidar.raycast.relief.walls import pairs_of, tables_of

FEW = settings(max_examples=15, deadline=None)
SEEDS = st.integers(0, 2**32 - 1)
GLASS = 2
WALL_FACES = 2


def refined(relief, backend="float64"):
    """A caster of the wall's plane with the openings behind it."""
    mesh = plane_mesh(relief)
    caster = Caster(mesh.vertices, mesh.faces, backend=backend)
    pairs = pairs_of(relief)
    tables = tables_of(relief, pairs, origin=np.zeros(3), bits=np.full(256, GLASS, np.uint32))
    caster.refiners = (WallRefiner(tables),)
    return caster


def triangles(relief):
    mesh = relief_mesh(relief)
    return Caster(mesh.vertices, mesh.faces, backend="float64"), mesh.material


def on_wall(relief, points):
    """Scene coordinates of points (n, 3) given by their place to the right, up, and outwards."""
    f = relief.facades
    tangent = np.array([*f.tangent[0], 0.0])
    outwards = np.array([tangent[1], -tangent[0], 0.0])
    return f.foot[0] + points @ np.array([tangent, [0, 0, 1.0], outwards])


def rays_at(relief, rng, count, *, close):
    """Rays that start in front of the wall and are aimed at its plane; some graze it."""
    width, height = relief.facades.size[0]
    away = rng.uniform(0.01, 0.5, count) if close else rng.uniform(0.5, 60, count)
    away[::3] *= 0.1 if close else 1e-3
    aim = on_wall(
        relief, np.column_stack([rng.uniform(0, width, count), rng.uniform(0, height, count), 0 * away])
    )
    aside = rng.uniform(-1, 1, (count, 2)) * (3 if close else 60)
    start = np.column_stack([aside + relief.facades.size[0] / 2, away])
    start = on_wall(relief, start)
    way = aim - start
    return start, way / np.linalg.norm(way, axis=1, keepdims=True)


def part_of(hits):
    """Surface of each hit: 0 wall, 1 sill, 2 frame, 3 infill, 4 room."""
    return np.where(hits.face < WALL_FACES, 0, 1 + (hits.face - WALL_FACES) % PARTS)


def beside_edges(caster, start, way, hits):
    """Rays whose hit does not depend on rounding: neighbours within a micrometre hit the same plane."""
    same = np.ones(len(way), bool)
    for shift in np.random.default_rng(0).normal(0, 1e-7, (4, 3)):
        other = caster.cast(start + shift, way, normals=True)
        same &= (other.face >= 0) == (hits.face >= 0)
        same &= np.abs(other.normal - hits.normal).max(axis=1) < 1e-9
        with np.errstate(invalid="ignore"):
            same &= ~(np.abs(other.range - hits.range) * np.maximum(np.abs(hits.cosine), 1e-9) > 1e-5)
    return same


def assert_alike(found, wanted, material, sure):
    assert sure.mean() > 0.9
    assert np.array_equal(found.face[sure] >= 0, wanted.face[sure] >= 0)
    hit = sure & (wanted.face >= 0)
    np.testing.assert_allclose(found.range[hit], wanted.range[hit], rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.normal[hit], wanted.normal[hit], rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.cosine[hit], wanted.cosine[hit], rtol=0, atol=1e-6)
    assert np.array_equal(part_of(found)[hit], material[wanted.face[hit]])


@pytest.mark.full
@FEW
@given(SEEDS, st.booleans())
def test_a_ray_hits_an_opening_as_if_it_were_built_of_triangles(seed, close):
    rng = np.random.default_rng(seed)
    relief = random_relief(rng)
    caster, (reference, material) = refined(relief), triangles(relief)
    start, way = rays_at(relief, rng, 3000, close=close)
    found, wanted = caster.cast(start, way, normals=True), reference.cast(start, way, normals=True)
    assert_alike(found, wanted, material, beside_edges(reference, start, way, wanted))


@pytest.mark.full
@FEW
@given(SEEDS)
def test_a_ray_that_starts_in_an_opening_leaves_it_or_hits_its_sides(seed):
    rng = np.random.default_rng(seed)
    relief = random_relief(rng)
    caster, (reference, material) = refined(relief), triangles(relief)
    start, way = rays_at(relief, rng, 2000, close=False)
    first = caster.cast(start, way, normals=True)
    hit = first.face >= 0
    place = (start + first.range[:, None] * way)[hit] + 1e-3 * first.normal[hit]
    away = rng.normal(size=place.shape)
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    found = caster.cast(place, away, on=first.face[hit], normals=True)
    wanted = reference.cast(place, away, normals=True)
    assert_alike(found, wanted, material, beside_edges(reference, place, away, wanted))


@pytest.mark.full
@FEW
@given(SEEDS, st.sampled_from([np.inf, 25.0]))
def test_shadow_rays_agree_with_triangles(seed, far):
    rng = np.random.default_rng(seed)
    relief = random_relief(rng)
    screen = on_wall(relief, np.array([[-5, -5, 4.0], [9, -5, 4.0], [9, 20, 4.0]]))
    lone, (reference, _) = plane_mesh(relief), triangles(relief)
    caster = Caster(np.concatenate([lone.vertices, screen]), [*lone.faces, [4, 5, 6]], backend="float64")
    caster.refiners = refined(relief).refiners
    # The tables know two faces; the screen has the number of the first additional one.
    tables = caster.refiners[0].tables
    shifted = tables._replace(
        wall=np.concatenate([tables.wall[:2], [-1], tables.wall[2:]]).astype(np.int32),
        faces=tables.faces + np.int32(1),
    )
    caster.refiners = (WallRefiner(shifted),)
    mesh = relief_mesh(relief)
    n = len(mesh.vertices)
    reference = Caster(
        np.concatenate([mesh.vertices, screen]), [*mesh.faces, [n, n + 1, n + 2]], backend="float64"
    )
    start, way = rays_at(relief, rng, 1500, close=False)
    first = caster.cast(start, way, normals=True)
    hit = (first.face >= 0) & (first.face != WALL_FACES)
    place = (start + first.range[:, None] * way)[hit] + 1e-3 * first.normal[hit]
    light = rng.normal(size=3)
    light /= np.linalg.norm(light)
    ways = np.broadcast_to(light, place.shape)
    for begin, towards, on in ((place, ways, first.face[hit]), (start, way, None)):
        wanted = reference.cast(begin, towards, normals=True)
        sure = beside_edges(reference, begin, towards, wanted)
        sure &= ~(np.isfinite(wanted.range) & np.isclose(wanted.range, far, atol=1e-3))
        dark = caster.occluded(begin, towards, far=far, on=on)
        assert np.array_equal(dark[sure], reference.occluded(begin, towards, far=far)[sure])


@pytest.mark.parametrize("backend", ["embree", "float64"])
def test_the_wall_itself_does_not_shade_its_openings_from_light_in_front(backend):
    rng = np.random.default_rng(1)
    relief = random_relief(rng)
    caster = refined(relief, backend=backend)
    start, way = rays_at(relief, rng, 5000, close=False)
    hits = caster.cast(start, way, normals=True)
    light = (on_wall(relief, np.array([[0, 0, 1.0]])) - relief.facades.foot)[0]
    row = np.flatnonzero(hits.normal @ light > 0.5)
    place = start[row] + hits.range[row, None] * way[row] + 1e-3 * light
    deep = (place - relief.facades.foot[0]) @ light < 0
    dark = caster.occluded(place, np.broadcast_to(light, place.shape), on=hits.face[row])
    assert deep.sum() > 300
    assert not dark.any()


@FEW
@given(SEEDS)
def test_no_ray_passes_through_a_facade(seed):
    rng = np.random.default_rng(seed)
    relief = random_relief(rng)
    start, way = rays_at(relief, rng, 3000, close=False)
    flat = Caster(plane_mesh(relief).vertices, plane_mesh(relief).faces, backend="float64").cast(start, way)
    found = refined(relief).cast(start, way)
    assert np.array_equal(found.face >= 0, flat.face >= 0)
    assert (found.range >= flat.range - 1e-9).all()


def test_a_window_has_a_sill_a_frame_bars_and_panes():
    rng = np.random.default_rng(3)
    relief = random_relief(rng)
    start, way = rays_at(relief, rng, 20000, close=False)
    parts = part_of(refined(relief).cast(start, way))
    assert {0, SILL, FRAME, INFILL} == set(parts.tolist())


def test_a_cast_without_glass_sees_the_room_behind_the_pane():
    rng = np.random.default_rng(3)
    relief = random_relief(rng)
    caster = refined(relief)
    start, way = rays_at(relief, rng, 20000, close=False)
    seen, through = caster.cast(start, way), caster.cast(start, way, mask=ALL & ~GLASS)
    pane = part_of(seen) == INFILL
    assert pane.any()
    assert np.array_equal(part_of(through) == ROOM, pane)
    assert (through.range[pane] > seen.range[pane]).all()
    place = start[pane] + seen.range[pane, None] * way[pane]
    rooms = caster.refiners[0].rooms(seen.face[pane], place, way[pane])
    np.testing.assert_allclose(seen.range[pane] + rooms.range, through.range[pane], atol=1e-9)
    assert np.array_equal(rooms.face, through.face[pane])
    assert np.array_equal(rooms.cosine, through.cosine[pane])


def test_rays_hit_nothing_beyond_their_maximum_range():
    rng = np.random.default_rng(5)
    relief = random_relief(rng)
    caster = refined(relief)
    start, way = rays_at(relief, rng, 5000, close=False)
    hits, near = caster.cast(start, way), caster.cast(start, way, far=30.0, normals=True)
    beyond = hits.range > 30.0
    assert beyond.any()
    assert np.array_equal(near.face, np.where(beyond, -1, hits.face))
    assert (near.range[beyond] == np.inf).all()
    assert not near.normal[beyond].any()


@pytest.mark.parametrize("precision", ["exact", "refined", "float32"])
def test_backends_poses_order_and_threads_give_the_same_hits(precision):
    rng = np.random.default_rng(8)
    relief = random_relief(rng)
    start, way = rays_at(relief, rng, 20000, close=False)
    start -= 0.5 * way
    caster = refined(relief, backend="embree")
    wanted = caster.cast(start, way, normals=True, precision=precision)
    order = rng.permutation(len(way))
    found = caster.cast(start, way, normals=True, precision=precision, order=order, threads=2)
    for name, column in wanted.columns().items():
        assert np.array_equal(column, getattr(found, name)), name
    # Embree's hull lies up to a tenth of a millimetre in front of the plane.
    within = 1e-9 if precision == "exact" else 1e-2
    slow = refined(relief).cast(start, way, normals=True)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    poses = Poses(start, np.broadcast_to(turn, (len(way), 3, 3)), np.ones((len(way), 3)))
    index = np.arange(len(way))
    posed = caster.cast_posed(poses, index, directions=way @ turn, normals=True, precision=precision)
    outwards = (on_wall(relief, np.array([[0, 0, 1.0]])) - relief.facades.foot)[0]
    steep = np.abs(way @ outwards) > 0.1
    for other in (slow, posed):
        assert np.isclose(other.range, wanted.range, rtol=0, atol=within)[steep].mean() > 0.999


def test_hits_on_the_back_of_a_wall_stay():
    rng = np.random.default_rng(2)
    relief = random_relief(rng)
    start, way = rays_at(relief, rng, 2000, close=False)
    flat = Caster(plane_mesh(relief).vertices, plane_mesh(relief).faces, backend="float64")
    hits = flat.cast(start, way)
    behind = start + (hits.range[:, None] + 5.0 / hits.cosine[:, None].astype(float)) * way
    found, wanted = refined(relief).cast(behind, -way, normals=True), flat.cast(behind, -way, normals=True)
    for name, column in wanted.columns().items():
        assert np.array_equal(column, getattr(found, name)), name
