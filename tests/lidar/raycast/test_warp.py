"""Hits of rays that Warp's kernels cast are those of float64 on the CPU, byte for byte."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lidar.errors import BackendError, InputError
from lidar.geometry.poses import Poses
from lidar.raycast import ALL, Caster, MeshInstances
from lidar.world.settings import WorldSettings
from lidar.world.world import World

pytest.importorskip("warp", reason="the extra gpu is not installed")

DEVICE = "warp-cpu"
FAR_AWAY = st.sampled_from([(0.0, 0.0, 0.0), (500_000.37, 4_080_000.61, 0.0), (-3e6, 9.9e6, 2500.25)])


@pytest.fixture(autouse=True, scope="module")
def _kernels(tmp_path_factory):
    """Compiled code of the kernels goes to a folder of the test run."""
    import warp  # noqa: PLC0415

    warp.config.kernel_cache_dir = str(tmp_path_factory.getbasetemp() / "warp")


def same(one, two):
    for name, column in one.columns().items():
        assert column.tobytes() == getattr(two, name).tobytes(), name


def crowd(rng, offset, **chosen):
    """Triangles, some degenerate, and instances of a box: still and moving, mirrored, with masks."""
    triangles = rng.normal(size=(300, 1, 3)) * 10 + rng.normal(size=(300, 3, 3)) * rng.choice(
        [0.0, 1e-4, 2], (300, 1, 1)
    )
    box = trimesh.creation.box([2, 3, 4])
    shape = Caster(box.vertices, box.faces, mask=np.arange(12) % 2 + 1, **chosen)
    turned = Rotation.from_rotvec(rng.normal(size=(10, 3))).as_matrix() * rng.uniform(0.5, 2, (10, 1, 1))
    turned[5] *= -1
    moves = np.concatenate(
        [np.repeat(turned[:, None], 3, axis=1), rng.normal(size=(10, 3, 3, 1)) * 15], axis=3
    )
    moves[..., 3] += offset
    groups = [
        MeshInstances((shape,), np.zeros(6, np.int32), moves[:6, 0]),
        MeshInstances((shape,), np.zeros(4, np.int32), moves[6:], mask=np.array([1, 2, 3, 1], np.uint32)),
    ]
    return Caster(
        triangles.reshape(-1, 3) + offset,
        np.arange(900).reshape(-1, 3),
        mask=rng.integers(1, 4, 300),
        instances=groups,
        **chosen,
    )


@settings(max_examples=15, deadline=None)
@given(
    FAR_AWAY, st.integers(0, 1000), st.sampled_from([ALL, 1, 2]), st.sampled_from([(0.0, np.inf), (0.5, 9.0)])
)
def test_hits_have_the_bytes_of_float64(offset, seed, mask, limits):
    rng = np.random.default_rng(seed)
    origins, way = rng.normal(size=(2, 3000, 3)) * [[[20.0]], [[1.0]]]
    way[:20] = np.eye(3)[rng.integers(0, 3, 20)]
    order = rng.permutation(3000)
    slow, warp = (
        crowd(np.random.default_rng(seed), np.array(offset), **chosen).cast(
            origins + offset,
            way,
            near=limits[0],
            far=limits[1],
            mask=mask,
            time=np.linspace(0, 1, 3000),
            order=order,
            normals=True,
        )
        for chosen in ({"backend": "float64"}, {"device": DEVICE})
    )
    assert (slow.face >= 0).any()
    same(slow, warp)


def test_rays_aimed_at_edges_and_vertices_and_along_faces_have_the_bytes_of_float64():
    solid = trimesh.creation.icosphere(subdivisions=2, radius=3.0)
    slow, warp = (
        Caster(solid.vertices, solid.faces, **chosen)
        for chosen in ({"backend": "float64"}, {"device": DEVICE})
    )
    corners = solid.vertices[solid.faces]
    targets = np.concatenate([solid.vertices, corners.mean(axis=1), (corners[:, 0] + corners[:, 1]) / 2])
    eye = np.array([0.1, -0.2, 0.3])
    inside = warp.cast(eye, targets - eye)
    assert (inside.face >= 0).all()
    same(slow.cast(eye, targets - eye), inside)
    along = np.repeat(corners[:, 0], 2, axis=0) - np.concatenate([corners[:, 1:]]).reshape(-1, 3)
    start = corners[:, 1:].reshape(-1, 3) - along
    same(slow.cast(start, along), warp.cast(start, along))


def test_rays_of_poses_of_a_real_scene_have_the_bytes_of_float64(scene):
    rng = np.random.default_rng(5)
    n, region = 100_000, (150, 50, 160, 60)
    poses = Poses(
        rng.uniform([150, 50, 2], [160, 60, 12], (50, 3)),
        Rotation.random(50, random_state=1).as_matrix(),
        rng.uniform(0.9, 1.1, (50, 3)),
    )
    way = rng.normal(size=(n, 3))
    way /= np.linalg.norm(way, axis=1)[:, None]
    offsets = rng.normal(size=(n, 3)) * 0.1
    row = np.sort(rng.integers(0, 50, n))
    slow, warp, embree = (
        World.load(scene, region=region, margin=100, **chosen)
        for chosen in ({"backend": "float64"}, {"settings": WorldSettings(device=DEVICE)}, {})
    )
    hits = [
        world.caster.cast_posed(poses, row, directions=way, offsets=offsets, normals=True)
        for world in (slow, warp, embree)
    ]
    assert (hits[1].face >= 0).mean() > 0.5
    assert (hits[1].instance >= 0).any()
    same(hits[0], hits[1])
    # Embree's surfaces enclose the true ones: either of two that lie within its margins may be hit.
    there = (hits[1].face == hits[2].face) & (hits[1].instance == hits[2].instance)
    assert (~there).mean() < 5e-4
    np.testing.assert_allclose(hits[1].range[there], hits[2].range[there], atol=1e-6)
    np.testing.assert_array_equal(
        warp.caster.occluded([155, 55, 8], way, far=40.0), slow.caster.occluded([155, 55, 8], way, far=40.0)
    )


def test_hits_depend_on_the_present_parts_alone_when_a_world_moves(scene):
    rng = np.random.default_rng(2)
    way = rng.normal(size=(5000, 3))
    chosen = WorldSettings(device=DEVICE)
    moved = World.load(scene, region=(50, 50, 60, 60), margin=60, settings=chosen)
    moved.follow((150, 50, 160, 60))
    there = World.load(scene, region=(150, 50, 160, 60), margin=60, settings=chosen)
    same(moved.caster.cast([155, 55, 5], way), there.caster.cast([155, 55, 5], way))


def test_threads_that_cast_at_the_same_time_get_their_own_hits():
    from concurrent.futures import ThreadPoolExecutor  # noqa: PLC0415

    cast = crowd(np.random.default_rng(3), np.zeros(3), device=DEVICE)
    way = np.random.default_rng(4).normal(size=(8, 2000, 3))
    alone = [cast.cast([0, 0, 30], w) for w in way]
    with ThreadPoolExecutor(4) as pool:
        for one, two in zip(alone, pool.map(lambda w: cast.cast([0, 0, 30], w), way), strict=True):
            same(one, two)


def test_an_empty_mesh_and_no_rays_are_no_error():
    assert Caster(device=DEVICE).cast([0, 0, 0], [[0, 0, 1]]).face.tolist() == [-1]
    assert len(crowd(np.random.default_rng(0), 0.0, device=DEVICE).cast([0, 0, 0], np.empty((0, 3)))) == 0


@pytest.mark.parametrize("way", [[0, 0, 0], [np.nan, 0, 1], [np.inf, 0, 1]])
def test_a_ray_that_cannot_be_cast_is_named(way):
    rays = np.ones((10, 3))
    rays[7] = way
    with pytest.raises(InputError, match="ray 7 of 10"):
        crowd(np.random.default_rng(0), 0.0, device=DEVICE).cast([0, 0, 0], rays)


def test_shapes_and_backends_of_other_devices_are_refused():
    box = trimesh.creation.box([1, 1, 1])
    shape = Caster(box.vertices, box.faces, backend="float64")
    with pytest.raises(BackendError, match="same backend"):
        Caster(instances=[MeshInstances((shape,), np.zeros(1, np.int32), np.eye(3, 4)[None])], device=DEVICE)
    with pytest.raises(InputError, match="embree"):
        Caster(box.vertices, box.faces, backend="embree", device=DEVICE)
