"""What pixels see of openings of walls is what rays through them hit."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.facades import plane_mesh, random_relief
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.classes import materials
from lidar.raycast import Caster
from lidar.raycast.relief import INFILL, PARTS, WallRefiner, pairs_of, tables_of
from lidar.sensors.camera import facades as seen
from lidar.sensors.camera.shade import linear_table

GLASS = materials()["glass"].code
RAYS = 48  # across a pixel


def painted(relief):
    """A wall's facade with the colours and materials of its parts, and a caster of it."""
    pairs = pairs_of(relief)
    tables = tables_of(relief, pairs, origin=np.zeros(3), bits=np.ones(256, np.uint32))
    kinds = relief.openings.take(pairs.kind)
    parts = [kinds.trim_color, kinds.frame_color, kinds.infill_color, kinds.room_color]
    color = np.concatenate([np.full((2, 3), 200, np.uint8), np.stack(parts, axis=1).reshape(-1, 3)])
    material = np.zeros(len(color), np.uint8)
    material[2 + INFILL - 1 :: PARTS] = kinds.infill
    mesh = plane_mesh(relief)
    caster = Caster(mesh.vertices, mesh.faces, backend="float64")
    caster.refiners = [WallRefiner(tables)]
    return seen.RenderedFacades(tables, True, color, material, GLASS), caster


@pytest.mark.full
@settings(max_examples=16, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.01, 0.1, 0.5, 2.0]), st.booleans())
def test_shares_of_a_pixel_are_those_of_rays_through_it(seed, size, sills):
    rng = np.random.default_rng(seed)
    relief = random_relief(rng, columns=5, rows=5)
    if not sills:
        relief = replace(relief, openings=replace(relief.openings, sill=np.zeros_like(relief.openings.sill)))
    facade, caster = painted(relief)
    f = relief.facades
    tangent = np.array([*f.tangent[0], 0.0])
    inwards = np.array([-tangent[1], tangent[0], 0.0])
    up = np.array([0, 0, 1.0])
    a, b = rng.uniform(-3, 3, 2) * (0.3 if sills else 1.0)
    direction = (a * tangent + b * up + inwards) / np.sqrt(1 + a * a + b * b)
    middle = f.size[0] * rng.uniform(0.3, 0.7, 2)
    across = min(size * np.hypot(1, a), 2 * f.cell[0, 0])
    upright = min(size * np.hypot(1, b), 2 * f.cell[0, 1])
    step = (np.arange(RAYS) + 0.5) / RAYS - 0.5
    x, y = (grid.ravel() for grid in np.meshgrid(middle[0] + step * across, middle[1] + step * upright))
    place = f.foot[0] + x[:, None] * tangent + y[:, None] * up
    hits = caster.cast(place - 3.0 * direction, np.broadcast_to(direction, place.shape), normals=True)
    part = np.where(hits.face < 2, 0, 1 + (hits.face - 2) % PARTS)
    glass = (part == INFILL) & (facade.material[hits.face] == GLASS)
    paint = (part > 0) & ~glass
    bare = part == 0
    aside, upright = np.abs(hits.normal @ tangent) > 0.5, np.abs(hits.normal[:, 2]) > 0.5
    wanted = {
        (seen.GLASS,): glass,
        (seen.PAINTED,): paint,
        (seen.ASIDE, seen.UPRIGHT): bare & (aside | upright),
    }
    # The ends of sills are left out; edges of rectangles fall between two of the rays.
    within = 0.3 if sills and size < 0.5 else 0.05
    out = np.empty(seen.SEEN)
    aim = f.foot[0] + middle[0] * tangent + middle[1] * up
    hit = caster.cast((aim - 3.0 * direction)[None], direction[None])
    on = aim + (hit.range[0] - 3.0) * direction
    linear = linear_table()
    seen.facade(facade, 0, tuple(on), tuple(direction), size, linear, out)
    for columns, rays in wanted.items():
        assert abs(out[list(columns)].sum() - rays.mean()) < within, columns
    light = linear[facade.color[hits.face]] * paint[:, None]
    np.testing.assert_allclose(out[seen.LIGHT : seen.LIGHT + 3], light.mean(axis=0), atol=within)
