"""Ray casting: exact far from the origin, no leaks, the same hits with both backends."""

import logging
import multiprocessing
import subprocess
import sys

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lidar.errors import BackendError, InputError
from lidar.geometry.poses import Poses
from lidar.raycast import ALL, Caster, MeshInstances, caster, library
from lidar.raycast.columns import CHUNK
from lidar.raycast.geometry import check_mesh, planes, split
from lidar.raycast.hull import displacements
from lidar.raycast.rays import free_rays, share

FAR_AWAY = st.sampled_from([(0.0, 0.0, 0.0), (500_000.37, 4_080_000.61, 0.0), (-3e6, 9.9e6, 2500.25)])
BACKENDS = pytest.mark.parametrize("backend", ["embree", "float64"])


def sheet(normal, point, size=1e5):
    """A square of four triangles through a point, its front on the side of the normal."""
    n = np.asarray(normal) / np.linalg.norm(normal)
    u = np.cross(n, np.eye(3)[np.argmin(np.abs(n))])
    u /= np.linalg.norm(u)
    v = np.cross(n, u)
    ring = [u, v, -u, -v]
    vertices = np.array([np.zeros(3), *(size * w for w in ring)]) + point
    return vertices, np.array([[0, k + 1, (k + 1) % 4 + 1] for k in range(4)])


def soup(rng, count, spread=10.0):
    """Random triangles: vertices (3 count, 3) and faces."""
    middle = rng.normal(size=(count, 1, 3)) * spread
    return (middle + rng.normal(size=(count, 3, 3)) * 2).reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)


def turns(rng, count):
    return Rotation.from_rotvec(rng.normal(size=(count, 3))).as_matrix()


def placed(rng, count, steps=None, spread=15.0):
    """Random transforms (count, 3, 4), or (count, steps, 3, 4) that drift without turning."""
    out = np.empty((count, steps or 1, 3, 4))
    out[..., :3] = turns(rng, count)[:, None] * rng.uniform(0.5, 2, (count, 1, 1, 1))
    out[..., 3] = rng.normal(size=(count, steps or 1, 3)) * spread
    return out if steps else out[:, 0]


def directions(rng, count):
    return rng.normal(size=(count, 3)) * rng.uniform(0.1, 3, (count, 1))


@settings(max_examples=30, deadline=None)
@given(
    FAR_AWAY,
    st.integers(0, 2**32 - 1),
    st.sampled_from([(1.0, 1e-9), (30.0, 1e-9), (1e3, 1e-8), (1e4, 1e-6)]),
)
def test_ranges_are_exact_at_every_distance_and_wherever_the_scene_lies(place, seed, reach):
    rng = np.random.default_rng(seed)
    distance, tolerance = reach
    origin = np.array(place)
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    vertices, faces = sheet(normal, origin - distance * normal)
    way = -normal + rng.uniform(-0.9, 0.9, (50, 3)) * 0.5
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    hits = Caster(vertices, faces, origin=np.round(origin)).cast(origin, way)
    # The plane the mesh really has, given vertices rounded to float64 so far from zero.
    corners = vertices[faces][hits.face] - origin
    true = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    expected = np.einsum("ij,ij->i", true, corners[:, 0]) / np.einsum("ij,ij->i", true, way)
    np.testing.assert_allclose(hits.range, expected, rtol=0, atol=tolerance)
    np.testing.assert_allclose(hits.cosine, -way @ normal, atol=1e-6)


def first_hits(corners, origins, way):
    """Ray parameters and faces (n,) of the first hits (Moeller-Trumbore, float64); inf and -1 for misses."""
    a, e, f = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p, s = np.cross(way[:, None], f), origins[:, None] - a
    q, det = np.cross(s, e), np.einsum("nmi,mi->nm", p, e)
    u, v = np.einsum("nmi,nmi->nm", s, p) / det, np.einsum("ni,nmi->nm", way, q) / det
    t = np.einsum("nmi,mi->nm", q, f) / det
    t = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0), t, np.inf)
    face, nearest = t.argmin(axis=1), t.min(axis=1)
    return nearest, np.where(np.isfinite(nearest), face, -1)


@pytest.mark.full
@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1), FAR_AWAY)
def test_first_hits_are_those_of_a_float64_intersection_of_all_faces(seed, place):
    rng = np.random.default_rng(seed)
    vertices, faces = soup(rng, 400)
    origins, way = rng.normal(size=(1000, 3)) * 20, directions(rng, 1000)
    hits = Caster(vertices + place, faces).cast(origins + place, way)
    shift = np.round(place)
    ranges, found = first_hits((vertices + place)[faces] - shift, origins + place - shift, way)
    # A ray within float32 rounding of a triangle's edge may hit or miss.
    agree = hits.face == found
    assert agree.mean() > 0.999
    met = agree & (hits.face >= 0)
    assert met.sum() > 100
    np.testing.assert_allclose(hits.range[met], ranges[met], rtol=0, atol=1e-8)


@BACKENDS
@pytest.mark.parametrize("solid", ["box", "turned box", "ball"])
def test_no_ray_leaves_a_closed_solid_through_its_edges_and_vertices(solid, backend):
    rng = np.random.default_rng(3)
    box = trimesh.creation.box([20, 30, 10])
    mesh = {
        "box": box,
        "turned box": box.copy().apply_transform(trimesh.transformations.euler_matrix(0.3, 0.6, 0.2)),
        "ball": trimesh.creation.icosphere(subdivisions=4, radius=10.0),
    }[solid]
    n = 200_000 if backend == "embree" else 50_000
    ends = mesh.vertices[mesh.edges_unique][rng.integers(0, len(mesh.edges_unique), n)]
    along = rng.random((n, 1)) * (np.arange(n) % 2)[:, None]  # every other ray exactly at a vertex
    aim = ends[:, 0] + along * (ends[:, 1] - ends[:, 0])
    inside = Caster(mesh.vertices, mesh.faces, backend=backend)
    origins = rng.uniform(-2, 2, (n, 3))
    out = inside.cast(origins, aim - origins)
    assert np.isfinite(out.range).all()
    np.testing.assert_allclose(out.range, 1.0, atol=2e-5)
    assert inside.occluded(origins, aim - origins).all()
    once = inside.occluded(origins, aim - origins, retrace=False)
    assert once[1::2].all()
    assert once.mean() > 0.9999  # of rays exactly at vertices, a single trace may let a few pass


def test_no_ray_from_outside_passes_through_the_near_side_of_a_solid():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=10.0)
    rng = np.random.default_rng(4)
    eye = np.array([100.0, 3.0, 2.0])
    near = ball.vertices[(ball.vertices @ eye) > 15 * np.linalg.norm(eye) / 2]
    aim = near[rng.integers(0, len(near), 100_000)]
    hits = Caster(ball.vertices, ball.faces).cast(eye + rng.normal(size=(len(aim), 3)) * 1e-3, aim - eye)
    assert (hits.range < 1.001).all()
    assert (hits.cosine > 0).all()


def nested_balls():
    """Vertices and faces of a ball within a ball: what a ray hits that leaks through the outer one."""
    outer, inner = (trimesh.creation.icosphere(subdivisions=4, radius=radius) for radius in (10.0, 9.5))
    faces = np.concatenate([outer.faces, inner.faces + len(outer.vertices)])
    return np.concatenate([outer.vertices, inner.vertices]), faces, len(outer.vertices)


@pytest.mark.full
@BACKENDS
@pytest.mark.parametrize("jitter", [0.0, 1e-5])
def test_no_ray_passes_through_a_vertex_to_a_front_face_behind_it(backend, jitter):
    vertices, faces, outer = nested_balls()
    rng = np.random.default_rng(12)
    n = 200_000 if backend == "embree" else 20_000
    aim = vertices[rng.integers(0, outer, n)]
    origins = aim * rng.uniform(1.2, 6, (n, 1)) + rng.uniform(-0.5, 0.5, (n, 3))
    way = aim + rng.uniform(-jitter, jitter, (n, 3)) - origins
    hits = Caster(vertices, faces, backend=backend).cast(origins, way)
    assert (hits.range < 1.0001).all()
    assert (hits.cosine > 0).all()


def fan(rng):
    """Faces around a point, each with vertices of its own, as those of tiles have; and a floor."""
    azimuth = (np.arange(6) + rng.uniform(-0.3, 0.3, 6)) * np.pi / 3
    ring = np.column_stack([np.cos(azimuth), np.sin(azimuth), rng.uniform(-0.01, 0.01, 6)])
    ring *= rng.uniform(1, 9, (6, 1))
    vertices = np.concatenate([[np.zeros(3), ring[k], ring[(k + 1) % 6]] for k in range(6)])
    return vertices, np.arange(18).reshape(-1, 3), vertices - [0, 0, 1.5]


def narrow(rng):
    """A vertex less than 3 mm from the line between two of its neighbours; and a floor."""
    a, b, c, d = rng.uniform(0.3, 2, 4)
    vertices = np.array([[0, rng.uniform(1e-4, 3e-3), 0], [-a, 0, 0], [0, -b, 0], [c, 0, 0], [0, d, 0]])
    vertices = vertices @ Rotation.from_euler("z", rng.uniform(0, 6)).as_matrix().T
    return vertices, np.array([[1, 3, 0], [3, 4, 0], [4, 1, 0], [1, 2, 3]]), vertices - [0, 0, 1.5]


@pytest.mark.full
@pytest.mark.parametrize("body", [fan, narrow])
def test_no_ray_passes_through_the_first_vertex_of_a_body_to_a_face_behind(body):
    rng = np.random.default_rng(17)
    vertices, faces, targets, count = [], [], [], 0
    for k in range(400):
        corners, number, behind = body(rng)
        place = np.array([k % 20 * 30.0 - 300, k // 20 * 30.0 - 300, 0]) + rng.uniform(-5, 5, 3)
        vertices += [corners + place, behind + place]
        faces += [number + count, number + count + len(corners)]
        targets.append(corners[0] + place)
        count += 2 * len(corners)
    n = 400_000
    aim = np.array(targets)[rng.integers(0, 400, n)]
    towards = rng.uniform([-1, -1, 0.4], [1, 1, 1], (n, 3))
    origins = aim + towards * rng.uniform(1, 60, (n, 1))
    hits = Caster(np.concatenate(vertices), np.concatenate(faces)).cast(origins, aim - origins)
    assert (hits.range < 1.0001).all()
    assert (hits.cosine > 0).all()


def pyramid(rng):
    """Vertices and faces of the sides of a pyramid, apex first, and of a floor."""
    sides = int(rng.integers(3, 9))
    angle = np.sort(rng.uniform(0, 2 * np.pi, sides))
    ring = np.column_stack([np.cos(angle), np.sin(angle), -rng.uniform(0.1, 0.6, sides)])
    floor = np.array([[-50, -50, -8], [50, -50, -8], [0, 50, -8]])
    vertices = np.concatenate([np.zeros((1, 3)), ring * rng.uniform(1, 5), floor])
    side = np.arange(sides)
    faces = np.column_stack([0 * side, 1 + side, 1 + (side + 1) % sides])
    return vertices, np.concatenate([faces, [sides + 1 + np.arange(3)]]).astype(np.int32)


def test_no_ray_passes_through_a_vertex_along_its_displacement():
    rng = np.random.default_rng(19)
    for _ in range(50):
        vertices, faces = pyramid(rng)
        vertices += rng.uniform(-100, 100, 3)
        moved = displacements(vertices, faces, planes(vertices, faces))[0]
        towards = moved / np.linalg.norm(moved) + rng.normal(size=(2000, 3)) * 1e-9
        far = rng.uniform(1, 60, 2000)
        hits = Caster(vertices, faces).cast(vertices[0] + far[:, None] * towards, -towards)
        assert (hits.range < far + 1e-6).all()


def test_a_sharp_vertex_hides_no_surface_in_front_of_it():
    wedge = [[0, 0, 0], [0, 5, 0], [0, 5, -0.5], [5, 0, 0], [5, 0, -0.5]]
    screen = [[-5e-4, -9, -9], [-5e-4, 0, 9], [-5e-4, 9, -9]]
    faces = [[0, 3, 1], [0, 2, 4], [0, 1, 2], [0, 4, 3], [1, 3, 4], [1, 4, 2], [5, 6, 7]]
    y = np.random.default_rng(20).uniform(0.01, 1, 1000)
    origins = np.column_stack([y * 0 - 5, y, -0.05 * y])
    hits = Caster(wedge + screen, faces).cast(origins, np.tile([1.0, 0, 0], (1000, 1)))
    assert (hits.face == 6).all()


@pytest.mark.full
@pytest.mark.parametrize("distance", [0.0, 1024.0])
def test_rays_beside_edges_hit_what_they_hit_in_float64(distance):
    rng = np.random.default_rng(13)
    box = trimesh.creation.box([3, 4, 5])
    solids = [box.vertices @ turn.T + rng.uniform(-20, 20, 3) for turn in turns(rng, 30)]
    vertices = np.concatenate(solids)
    faces = np.concatenate([box.faces + 8 * k for k in range(30)])
    corners = vertices[faces]
    n = 10_000
    face, k = rng.integers(0, len(faces), n), rng.integers(0, 3, n)
    start, end = corners[face, k], corners[face, (k + 1) % 3]
    aim = start + rng.random((n, 1)) * (end - start) + rng.uniform(-1e-4, 1e-4, (n, 3))
    origins = rng.uniform(-40, 40, (n, 3))
    way = (aim - origins) / np.linalg.norm(aim - origins, axis=1, keepdims=True)
    hits = Caster(vertices, faces, origin=[distance, -distance, 0]).cast(origins, way)
    ranges, _ = first_hits(corners, origins, way)
    with np.errstate(invalid="ignore"):
        wrong = ~(np.abs(hits.range - ranges) < 1e-9) & (hits.range != ranges)
    assert wrong.sum() <= n // 10_000  # where the ray passes an edge within float64 rounding


@BACKENDS
def test_a_ray_that_starts_on_a_face_does_not_hit_it(backend):
    vertices, faces = sheet([0.3, 0.5, 0.8], np.array([3.0, 4.0, 100.0]))
    ceiling, roof = sheet([-0.3, -0.5, -0.8], np.array([6.0, 9.0, 108.0]))
    cast = Caster(np.concatenate([vertices, ceiling]), np.concatenate([faces, roof + 5]), backend=backend)
    rng = np.random.default_rng(14)
    down = rng.uniform(-0.2, 0.2, (5000, 3)) - [0.3, 0.5, 0.8]
    above = rng.uniform([-30, -30, 150], [30, 30, 190], (5000, 3))
    start = above + cast.cast(above, down).range[:, None] * down
    again = cast.cast(start, rng.normal(size=(5000, 3)))
    assert not (again.range < 1e-6).any()
    through = cast.cast(start, down)
    assert (through.range > 0.1).all()


@pytest.mark.full
@pytest.mark.parametrize("origin", [0.0, 2000.0, 10_000.0])
def test_cheap_ranges_are_as_near_to_exact_ones_as_stated(origin):
    rng = np.random.default_rng(7)
    vertices, faces = soup(rng, 2000, spread=30.0)
    shift = np.array([origin, 0, 0])
    scene = Caster(vertices + shift, faces, origin=np.zeros(3))
    start, way = rng.normal(size=(40_000, 3)) * 30 + shift, directions(rng, 40_000)
    unit = way / np.linalg.norm(way, axis=1)[:, None]
    exact = scene.cast(start, unit)
    for precision in ("refined", "float32"):
        hits = scene.cast(start, unit, precision=precision)
        same = (hits.face == exact.face) & (exact.face >= 0)
        assert (hits.face != exact.face).mean() < 2e-3  # beside edges
        off = np.abs(hits.range[same] - exact.range[same])
        if precision == "refined":
            assert not off.any()
        else:
            margin = 6e-5 * max(1.0, (origin + 200) / 256)
            bound = 4 * margin / np.abs(exact.cosine[same]) + 1e-6 * exact.range[same]
            assert 0 < (off / bound).max() < 1
        np.testing.assert_array_equal(
            hits.range, scene.cast(start, unit, precision=precision, threads=2).range
        )


@pytest.mark.parametrize("precision", ["exact", "refined", "float32"])
def test_the_float64_backend_is_exact_whatever_the_precision(precision):
    rng = np.random.default_rng(8)
    scene = Caster(*soup(rng, 50), backend="float64")
    start, way = rng.normal(size=(500, 3)), directions(rng, 500)
    exact, hits = scene.cast(start, way), scene.cast(start, way, precision=precision, retrace=False)
    for name in ("range", "face", "cosine"):
        np.testing.assert_array_equal(getattr(hits, name), getattr(exact, name))


def test_without_a_second_trace_hits_stay_and_few_rays_leak():
    rng = np.random.default_rng(9)
    solid = trimesh.creation.icosphere(subdivisions=3, radius=5.0)
    scene = Caster(solid.vertices[:, :], solid.faces[:, ::-1])
    aimed = np.concatenate([solid.vertices, solid.vertices[solid.edges_unique].mean(axis=1)])
    start = rng.uniform(-1, 1, (len(aimed), 3))
    twice, once = (scene.cast(start, aimed - start, retrace=again) for again in (True, False))
    hit = once.face >= 0
    assert (twice.face >= 0).all()
    assert (~hit).mean() < 0.01
    np.testing.assert_array_equal(once.range[hit], twice.range[hit])


def test_an_unknown_precision_is_refused():
    with pytest.raises(InputError, match=r"precision 'half' is unknown \(known are exact, refined, float32"):
        Caster(*sheet([0, 0, 1.0], [0, 0, 0])).cast([0, 0, 1], [[0, 0, -1.0]], precision="half")


@pytest.mark.full
def test_hits_do_not_depend_on_the_number_of_threads():
    rng = np.random.default_rng(5)
    vertices, faces = soup(rng, 3000)
    way = directions(rng, 50_000)
    way = way[np.argsort(np.arctan2(way[:, 1], way[:, 0]))]
    cast = Caster(vertices, faces)
    order = rng.permutation(len(way))
    one, two = (cast.cast([0, 0, 0], way, normals=True, threads=threads) for threads in (1, 2))
    for name in one.__slots__:
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    np.testing.assert_array_equal(
        cast.occluded([0, 0, 0], way, far=9.0), cast.occluded([0, 0, 0], way, far=9.0, threads=2)
    )
    shuffled = cast.cast([0, 0, 0], way, order=order, threads=2)
    np.testing.assert_allclose(shuffled.range, cast.cast([0, 0, 0], way).range, atol=1e-6)


@settings(max_examples=50, deadline=None)
@given(st.integers(CHUNK + 1, 50 * CHUNK), st.integers(2, 8))
def test_threads_share_rays_in_whole_packets_and_each_ray_once(n, threads):
    rays = free_rays([0, 0, 0], np.broadcast_to([0.0, 0.0, 1.0], (n, 3)))
    parts = []

    def work(lo, hi):
        parts.append((lo, hi))
        return -1

    share(work, rays, threads=threads)
    starts, stops = zip(*sorted(parts), strict=True)
    assert (0, *stops) == (*starts, n)
    assert not any(start % CHUNK for start in starts)


def test_coherent_packets_and_single_rays_agree():
    rng = np.random.default_rng(6)
    vertices, faces = soup(rng, 3000)
    azimuth = np.linspace(0, 2 * np.pi, 20_000)
    way = np.stack([np.cos(azimuth), np.sin(azimuth), np.full(len(azimuth), 0.1)], axis=1)
    cast = Caster(vertices, faces)
    scan, shuffled = cast.cast([0, 0, 0], way), cast.cast([0, 0, 0], way, order=rng.permutation(len(way)))
    assert (scan.face == shuffled.face).mean() > 0.9999
    np.testing.assert_allclose(scan.range, shuffled.range, atol=1e-6)


def crowd(rng, backend, steps=None):
    """Random triangles with masks, and instances of a box, static and moving, hidden from some masks."""
    vertices, faces = soup(rng, 500)
    box = trimesh.creation.box([2, 3, 4])
    shape = Caster(box.vertices + 1000.0, box.faces, mask=np.arange(12) % 2 + 1, backend=backend)
    far_box = np.eye(3, 4)
    far_box[:, 3] = -1000.0

    def near(transforms):
        out = transforms.copy()
        out[..., 3] += transforms[..., :3] @ far_box[:, 3]
        return out

    groups = [MeshInstances((shape,), np.zeros(6, np.int32), near(placed(rng, 6)))]
    bits = np.array([1, 2, 3, 1], np.uint32)
    if steps:
        groups.append(MeshInstances((shape,), np.zeros(4, np.int32), near(placed(rng, 4, steps)), mask=bits))
    return Caster(vertices, faces, mask=rng.integers(1, 4, 500), instances=groups, backend=backend)


@pytest.mark.parametrize("mask", [ALL, 1, 2])
@pytest.mark.parametrize(("near", "far"), [(0.0, np.inf), (0.5, 7.0)])
def test_float64_gives_the_same_hits(mask, near, far):
    origins, way = np.random.default_rng(8).normal(size=(2, 5000, 3)) * [[[20]], [[1]]]
    time = np.linspace(0, 1, 5000)
    steps = None if mask == 2 else 3
    fast, slow = (
        crowd(np.random.default_rng(7), backend, steps).cast(
            origins, way, mask=mask, near=near, far=far, time=time, normals=True
        )
        for backend in ("embree", "float64")
    )
    assert (fast.instance >= 0).any()
    assert (fast.face >= 0).sum() > 200
    np.testing.assert_array_equal(fast.face, slow.face)
    np.testing.assert_array_equal(fast.instance, slow.instance)
    np.testing.assert_allclose(fast.range, slow.range, atol=1e-9)
    np.testing.assert_allclose(fast.normal, slow.normal, atol=1e-9)
    np.testing.assert_allclose(fast.cosine, slow.cosine, atol=1e-6)


@BACKENDS
def test_each_ray_intersects_a_moving_instance_at_its_own_time(backend):
    wall = Caster(*sheet([-1, 0, 0], np.zeros(3), size=5.0), backend=backend)
    path = np.tile(np.eye(3, 4), (1, 3, 1, 1))
    path[0, :, 0, 3] = [10, 20, 20]
    cast = Caster(instances=[MeshInstances((wall,), np.zeros(1, np.int32), path)], backend=backend)
    time = np.linspace(0, 1, 101)
    hits = cast.cast([0, 0.1, 0.2], np.tile([1.0, 0, 0], (101, 1)), time=time)
    np.testing.assert_allclose(hits.range, np.minimum(10 + 20 * time, 20), atol=1e-5)  # times are float32
    assert (hits.cosine == 1).all()


@BACKENDS
def test_a_mirrored_instance_still_faces_outwards(backend):
    box = trimesh.creation.box([2, 2, 2])
    shape = Caster(box.vertices, box.faces, backend=backend)
    mirror = np.array([[[-1.0, 0, 0, 10], [0, 3, 0, 0], [0, 0, 1, 0]]])
    hits = Caster(instances=[MeshInstances((shape,), np.zeros(1, np.int32), mirror)], backend=backend).cast(
        [0, 2.5, 0.3], [[1.0, 0, 0]], normals=True
    )
    np.testing.assert_allclose(hits.range, 9)
    # The mirrored faces are inside out, and so is the sign of the cosine.
    np.testing.assert_allclose(hits.normal, [[1, 0, 0]], atol=1e-12)
    assert hits.cosine == pytest.approx(-1)


@settings(max_examples=20, deadline=None)
@given(st.floats(0.9, 1.1), st.integers(0, 2**32 - 1))
def test_ranges_of_posed_rays_are_true_distances_on_a_stretched_map(k, seed):
    """A sensor in a room of known size on a map of point scale k measures true metres."""
    rng = np.random.default_rng(seed)
    room = trimesh.creation.box([20, 14, 6])
    drawn = room.vertices * [k, k, 1] + [500_000.0, 4e6, 100.0]
    where = rng.uniform(-2, 2, (3, 3))
    scale = np.tile([k, k, 1.0], (3, 1))
    poses = Poses(where * scale + [500_000.0, 4e6, 100.0], turns(rng, 3), scale)
    index = np.arange(600) % 3
    way = rng.normal(size=(600, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    offsets = rng.uniform(-0.1, 0.1, (600, 3))
    hits = Caster(drawn, room.faces).cast_posed(poses, index, directions=way, offsets=offsets)
    true_way = np.einsum("nij,nj->ni", poses.rotation[index], way)
    start = where[index] + np.einsum("nij,nj->ni", poses.rotation[index], offsets)
    with np.errstate(divide="ignore"):
        walls = (np.array([10, 7, 3]) * np.sign(true_way) - start) / true_way
    np.testing.assert_allclose(hits.range, walls.min(axis=1), atol=1e-8)


def test_one_posed_ray_starts_at_its_offset():
    poses = Poses(np.zeros((1, 3)), np.eye(3)[None], np.ones((1, 3)))
    cast = Caster(*sheet([0, 0, 1], np.array([0, 0, -5.0])))
    way = np.array([[0.0, 0, -1]])
    assert cast.cast_posed(poses, np.zeros(1, int), directions=way).range == pytest.approx(5)
    assert cast.cast_posed(
        poses, np.zeros(1, int), directions=way, offsets=np.array([[0, 0, -2.0]])
    ).range == pytest.approx(3)


@BACKENDS
def test_hits_lie_between_near_and_far(backend):
    cast = Caster(*sheet([0, 0, 1], np.zeros(3)), backend=backend)
    down = [[0, 0, -2.0]]
    assert cast.cast([0.3, 0.2, 10], down).range == pytest.approx(5)
    assert np.isinf(cast.cast([0.3, 0.2, 10], down, far=4.999).range)
    assert np.isinf(cast.cast([0.3, 0.2, 10], down, near=5.001).range)
    assert cast.cast([0.3, 0.2, 10], down, near=4.9, far=5.0).range == pytest.approx(5)
    assert cast.occluded([0.3, 0.2, 10], down, far=5.1)
    assert not cast.occluded([0.3, 0.2, 10], down, far=4.9)


@BACKENDS
def test_invalid_rays_are_refused_with_their_number(backend):
    cast = Caster(*sheet([0, 0, 1], np.zeros(3)), backend=backend)
    good = np.tile([0.0, 0, -1], (30, 1))
    for bad in ([np.nan, 0, 1], [0, 0, 0], [np.inf, 0, 0]):
        way = good.copy()
        way[17] = bad
        with pytest.raises(InputError, match="ray 17 of 30"):
            cast.cast([0, 0, 1], way)
        with pytest.raises(InputError, match="ray 17 of 30"):
            cast.occluded([0, 0, 1], way)
    with pytest.raises(InputError, match="cannot be cast"):
        cast.cast([0, 0, np.nan], good)
    with pytest.raises(InputError, match="permutation"):
        cast.cast([0, 0, 1], good, order=np.zeros(30, int))
    with pytest.raises(InputError, match="near"):
        cast.cast([0, 0, 1], good, near=np.nan)
    with pytest.raises(InputError, match="times"):
        cast.cast([0, 0, 1], good, time=np.full(30, 2.0))


def test_invalid_meshes_are_refused():
    with pytest.raises(InputError, match="vertex 1 of 3"):
        Caster([[0, 0, 0], [np.nan, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    with pytest.raises(InputError, match="face 0 names"):
        Caster(np.zeros((3, 3)), [[0, 1, 3]])
    shape = Caster(*sheet([0, 0, 1], np.zeros(3)))
    with pytest.raises(InputError, match="beyond the 1"):
        MeshInstances((shape,), np.ones(1, np.int32), np.eye(3, 4)[None])


@BACKENDS
def test_rays_miss_an_empty_mesh(backend):
    hits = Caster(backend=backend).cast([0, 0, 0], np.eye(3))
    assert np.isinf(hits.range).all()
    assert (hits.face == -1).all()
    assert len(Caster(backend=backend).cast([0, 0, 0], np.empty((0, 3)))) == 0


def test_hits_do_not_depend_on_earlier_updates():
    """Parts attached and detached step by step give the same hits as the final set at once."""
    rng = np.random.default_rng(11)
    parts = {k: split(*check_mesh(*soup(rng, 50)))[0] for k in range(8)}
    way = directions(rng, 20_000)
    moved = Caster(origin=np.zeros(3), dynamic=True)
    moved.update(attach={k: parts[k] for k in (0, 3, 5, 6)})
    moved.update(detach=[3, 0], attach={7: parts[7]})
    moved.update(attach={1: parts[1]}, detach=[6])
    fresh = Caster(origin=np.zeros(3), dynamic=True)
    fresh.update(attach={k: parts[k] for k in (7, 5, 1)})
    for a, b in zip(
        (moved.cast([0, 0, 0], way, normals=True),), (fresh.cast([0, 0, 0], way, normals=True),), strict=True
    ):
        for name in a.__slots__:
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
        assert (a.face >= 0).mean() > 0.05


def test_without_the_library_float64_casts_the_rays_with_one_warning(monkeypatch, caplog):
    def missing():
        raise BackendError("no Embree 4 library")

    monkeypatch.setattr(caster, "library", missing)
    caster._uses_embree.cache_clear()
    try:
        with caplog.at_level(logging.WARNING):
            hits = [
                Caster(*sheet([0, 0, 1], np.zeros(3))).cast([0, 0.1, 3], [[0, 0.1, -1.0]]) for _ in range(3)
            ]
        assert [record.levelname for record in caplog.records] == ["WARNING"]
        assert hits[2].range == pytest.approx(3)
        with pytest.raises(BackendError, match="no Embree 4"):
            Caster(backend="embree")
    finally:
        caster._uses_embree.cache_clear()


def test_an_unsuitable_library_is_refused(monkeypatch, tmp_path):
    fake = tmp_path / "libembree4.so"
    fake.write_bytes(b"not a library")
    monkeypatch.setattr(library, "_path", lambda: fake)
    library.library.cache_clear()
    try:
        with pytest.raises(BackendError, match="not a usable Embree 4"):
            library.library()
    finally:
        library.library.cache_clear()


def test_a_caster_works_in_a_forked_process():
    code = """
import os, numpy as np
from lidar.raycast import Caster
c = Caster([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
assert c.cast([0.2, 0.2, 1], [[0, 0, -1.0]]).range[0] == 1
child = os.fork()
if child == 0:
    again = Caster(np.eye(3) * 9, [[0, 1, 2]])
    ok = c.cast([0.2, 0.2, 2], [[0, 0, -1.0]]).range[0] == 2
    ok &= again.cast([1, 1, 1], [[1, 1, 1.0]]).face[0] == 0
    os._exit(0 if ok else 1)
raise SystemExit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_a_single_instance_has_its_own_shape():
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]])
    shapes = [Caster(corners + np.array([0.0, 0.0, height]), [[0, 1, 2]]) for height in (1.0, 2.0, 3.0)]
    stay = np.eye(3, 4)[None]
    caster = Caster(instances=[MeshInstances(shapes, np.array([2], np.int32), stay)])
    hits = caster.cast([[0.0, 0.0, 10.0]], [[0.0, 0.0, -1.0]])
    assert hits.range[0] == 7.0


def _cast_in_child(solid, start, way, out):
    out.put(solid.cast(start, way, threads=2).range)


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no fork here")
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_a_forked_process_casts_with_its_own_threads():
    rng = np.random.default_rng(0)
    solid = Caster(*soup(rng, 200))
    way, start = directions(rng, 20_000), np.zeros((20_000, 3))
    before = solid.cast(start, way, threads=2).range
    context = multiprocessing.get_context("fork")
    out = context.Queue()
    child = context.Process(target=_cast_in_child, args=(solid, start, way, out))
    child.start()
    np.testing.assert_array_equal(out.get(timeout=120), before)
    child.join(30)
    assert child.exitcode == 0
