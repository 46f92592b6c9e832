"""Images that a device shades are those of the CPU."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from helpers.facades import random_relief
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.classes import Class, materials
from geoscene.pipeline.build import build
from geoscene.sources import read_osm
from lidar.geometry.attitude import OPTICAL, Mount
from lidar.geometry.poses import Poses
from lidar.raycast.relief import pairs_of, tables_of
from lidar.sensors.camera import shade
from lidar.sensors.camera.facades import RenderedFacades
from lidar.sensors.camera.light import daylight, sun_direction
from lidar.sensors.camera.render import render
from lidar.sensors.camera.settings import CameraSettings
from lidar.sensors.rig.specs import CameraSpec
from lidar.world.settings import WorldSettings
from lidar.world.world import World

wp = pytest.importorskip("warp", reason="the extra gpu is not installed")

DEVICE = "warp-cpu"
CAMERA = CameraSpec("c", Mount(), 480, 270, 260.0, 260.0, 239.5, 134.5)


@pytest.fixture(autouse=True, scope="module")
def _kernels(tmp_path_factory):
    """Compiled code of the kernels goes to a folder of the test run."""
    wp.config.kernel_cache_dir = str(tmp_path_factory.getbasetemp() / "warp")


def turned(rng, n):
    rows = rng.normal(size=(n, 3))
    return rows / np.linalg.norm(rows, axis=1)[:, None]


def facades(rng, *, deep):
    """A wall with random openings, and its tables."""
    relief = random_relief(rng, columns=4, rows=3)
    tables = tables_of(relief, pairs_of(relief), origin=np.zeros(3), bits=np.zeros(256, np.uint32))
    glass, wood = (materials()[name].code for name in ("glass", "wood"))
    m = len(tables.wall)
    color = rng.integers(0, 256, (m, 3)).astype(np.uint8)
    return RenderedFacades(tables, deep, color, rng.choice([glass, wood], m).astype(np.uint8), glass)


def pixels(rng, walls, *, n=3000):
    """Columns of `shade.shade`: surfaces of all classes and materials, near, far and none."""
    frame = walls.tables.frame[0]
    wall = np.where(rng.random(n) < 0.4, 0, -1).astype(np.int32)
    outwards = np.array([frame[4], -frame[3], 0.0])
    origin = frame[:3] + outwards * rng.uniform(1, 40) + rng.uniform(0, 3, (4, 3))
    row = rng.integers(0, 4, n).astype(np.int32)
    along = np.array([frame[3], frame[4], 0.0])
    spot = frame[:3] + rng.uniform(0, 16, n)[:, None] * along + rng.uniform(0, 14, n)[:, None] * [0, 0, 1]
    direction = np.where(wall[:, None] >= 0, spot - origin[row], turned(rng, n))
    scale = np.where(rng.random(n) < 0.5, 1.0, np.linalg.norm(direction, axis=1))
    direction /= scale[:, None]
    distance = np.where(wall >= 0, scale, rng.choice([0.5, 4.0, 60.0, 900.0, np.inf], n))
    level = rng.random(n) < 0.5
    normal = np.where(level[:, None], [0.0, 0.0, 1.0], turned(rng, n))
    classes = [int(k) for k in Class]
    codes = [m.code for m in materials().values()]
    material = rng.choice(codes, n).astype(np.uint8)
    plain = shade.material_tables()[3][material]
    own = rng.random(n) < 0.5
    color = np.where(own[:, None], plain, rng.integers(0, 256, (n, 3))).astype(np.uint8)
    material |= np.where(rng.random(n) < 0.5, 128, 0).astype(np.uint8)
    klass = rng.choice(classes, n).astype(np.uint8)
    klass[level & (rng.random(n) < 0.7)] = int(Class.ROAD)
    feature = rng.integers(-1, 10_000, n).astype(np.int32)
    columns = origin, row, direction, distance, normal, klass, material, color, feature, wall
    return (*columns, walls, rng.random(n) < 0.5)


WEATHER = st.sampled_from([(0.0, 0.0), (1.0, 0.0), (0.7, 0.0), (0.0, 0.5), (0.0, 1.0), (0.6, 0.4)])


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    weather=WEATHER,
    detailed=st.booleans(),
    deep=st.booleans(),
    blur=st.sampled_from([0.0, 0.05]),
)
def test_the_radiance_of_any_surface_is_that_of_the_cpu(seed, weather, detailed, deep, blur):
    from lidar.sensors.camera.warp_shade import shader  # noqa: PLC0415

    rng = np.random.default_rng(seed)
    given_columns = pixels(rng, facades(rng, deep=deep))
    n = len(given_columns[1])
    light = daylight(turned(rng, 1)[0] * [1, 1, 0.5] + [0, 0, 0.5], cloud=rng.random())
    results = []
    for fill in (shade.shade, shader(DEVICE).shade):
        out, wet = np.full((n, 3), np.nan, np.float32), n if weather[0] else 0
        gloss, facet = np.zeros(wet, np.float32), np.zeros((wet, 3), np.float32)
        fill(
            *given_columns,
            light.columns,
            (*shade.material_tables(), shade.linear_table()),
            (blur, 0.002, 3.912 / 20_000.0, detailed),
            shade.covers(*weather),
            out,
            gloss,
            facet,
        )
        results.append(np.concatenate([out.ravel(), gloss, facet.ravel()]))
    expected, found = results
    assert np.isfinite(expected).all()
    differ = np.abs(found - expected) > 1e-4 * np.abs(expected) + 1e-5
    assert differ.mean() <= 1e-4  # of points on an edge of a pattern


@pytest.fixture(scope="module")
def street(shared_osm, tmp_path_factory):
    """A street of Berlin with openings in its facades."""
    return build(
        read_osm(shared_osm("berlin_siegessaeule.osm.gz")), tmp_path_factory.mktemp("street") / "scene"
    )


@pytest.mark.shared
@pytest.mark.parametrize(
    ("weather", "chosen"),
    [
        ({}, {}),
        ({"wetness": 0.8}, {"supersample": 2, "haze": 800.0}),
        ({"snow": 0.6}, {"cloud": 0.7}),
        ({"relief": "off"}, {"detail": False, "shadows": False}),
    ],
)
def test_images_of_a_real_place_have_the_colours_of_the_cpu_with_the_same_hits(street, weather, chosen):
    sun = sun_direction(street.frame, datetime(2026, 6, 21, 9, tzinfo=UTC))
    x0, y0, x1, y1 = World.load(street).region
    poses = Poses(np.array([[(x0 + x1) / 2, (y0 + y1) / 2, 6.0]]), OPTICAL[None], np.ones((1, 3)))
    images = [
        render(
            CAMERA,
            poses,
            world=World.load(street, settings=WorldSettings(device=name, **weather), **casting),
            sun=sun,
            settings=replace(CameraSettings(), **chosen),
        ).rgb.astype(int)
        for name, casting in (("cpu", {"backend": "float64"}), (DEVICE, {}))
    ]
    apart = np.abs(images[0] - images[1]).max(axis=2)
    assert images[0].std() > 10
    assert (apart > 1).mean() <= 1e-4
