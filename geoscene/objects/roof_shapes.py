"""Shapes of rooftop objects in scenes with relief: chimneys, dormers, plant, tanks, antennas."""

from __future__ import annotations

import functools

import numpy as np

from geoscene.classes import Class
from geoscene.geometry.mesh import Mesh, concatenate
from geoscene.objects.solids import Body, box, circle, lathe, prism, rectangle, solid
from geoscene.typing import Float

DORMER_DEPTH = 1.3
"""Depth of a dormer over its width; its height follows from the pitch of the roof."""


@functools.cache
def roof_shapes() -> dict[str, Mesh]:
    """Shapes of rooftop objects by name; metres, x in the direction of the front, z up from the roof.

    Chimneys and dormers have unit height, to be scaled: a dormer's underside rises from its front at x = 0
    to its back at x = `DORMER_DEPTH` and z = 1, as the roof does. Sizes are usual ones, assumed.
    """
    return {
        "chimney": concatenate(
            [
                _of(prism(rectangle(0.6, 0.6), 0.0, top=0.93), material="brick"),
                _of(prism(rectangle(0.7, 0.7), 0.93, top=0.97), material="concrete"),
                *(
                    _of(_shift(prism(circle(0.2, 6), 0.97, top=1.0), y=y), material="brick")
                    for y in (-0.14, 0.14)
                ),
            ]
        ),
        "dormer": _dormer(),
        "roof_stairs": concatenate(
            [
                _of(box((3.4, 2.6), (-0.05, 2.5)), material="plaster"),
                _of(box((3.6, 2.8), (2.5, 2.62)), material="tar_roof"),
                _of(box((0.04, 0.9), (0.05, 2.1), at=(1.71, 0.3)), material="metal"),
            ]
        ),
        "lift_housing": concatenate(
            [
                _of(box((3.0, 3.0), (-0.05, 3.2)), material="plaster"),
                _of(box((3.2, 3.2), (3.2, 3.35)), material="concrete"),
            ]
        ),
        "air_conditioner": concatenate(
            [
                *(_of(box((0.1, 1.1), (-0.05, 0.25), at=(x, 0.0)), material="metal") for x in (-0.6, 0.6)),
                _of(box((1.7, 1.2), (0.25, 1.25)), material="metal"),
                *(
                    _of(_shift(prism(circle(0.75), 1.25, top=1.36), x=x), material="metal")
                    for x in (-0.42, 0.42)
                ),
            ]
        ),
        "air_handler": concatenate(
            [
                *(
                    _of(box((0.15, 2.0), (-0.05, 0.35), at=(x, 0.0)), material="metal")
                    for x in (-2.1, -0.6, 1.0)
                ),
                _of(box((4.0, 2.2), (0.35, 2.0), at=(-0.55, 0.0)), material="metal"),
                _of(box((1.1, 1.0), (0.5, 1.5), at=(2.0, 0.0)), material="metal"),
                *(_of(_shift(prism(circle(1.1), 2.0, top=2.2), x=x), material="metal") for x in (-1.7, -0.1)),
            ]
        ),
        "vent": concatenate(
            [
                _of(prism(circle(0.18, 6), -0.05, top=0.75), material="metal"),
                _of(prism(circle(0.34, 6), 0.75, top=0.92, taper=0.6), material="metal"),
            ]
        ),
        "skylight": concatenate(
            [
                _of(box((1.4, 1.4), (-0.05, 0.3)), material="metal"),
                _of(prism(rectangle(1.2, 1.2), 0.3, top=0.55, taper=0.4), material="glass"),
            ]
        ),
        "antenna": concatenate(
            [
                _of(prism(circle(0.06, 5), -0.05, top=3.2), material="metal", klass=Class.POLE),
                *(
                    _of(box((0.9 - 0.12 * k, 0.03), (z, z + 0.03)), material="metal", klass=Class.POLE)
                    for k, z in enumerate((2.5, 2.8, 3.1))
                ),
            ]
        ),
        "water_tank": concatenate(
            [
                *(
                    _of(box((0.16, 0.16), (-0.05, 3.1), at=(x, y)), material="metal")
                    for x in (-1.1, 1.1)
                    for y in (-1.1, 1.1)
                ),
                _of(box((2.7, 2.7), (3.0, 3.15)), material="wood"),
                _of(prism(circle(3.2, 12), 3.15, top=6.3, taper=0.94), material="wood"),
                _of(lathe(((0, 6.3), (3.3, 6.3), (0.3, 7.2), (0, 7.25)), sides=12), material="tar_roof"),
            ]
        ),
    }


def _of(body: Body, *, material: str, klass: Class = Class.BUILDING) -> Mesh:
    return solid(body, klass=klass, material=material)


def _shift(body: Body, *, x: float = 0.0, y: float = 0.0) -> Body:
    return body[0] + np.array([x, y, 0.0]), body[1]


def _dormer() -> Mesh:
    """A dormer with a gable, of unit width and height: walls, window, roof."""
    depth, eaves = DORMER_DEPTH, 0.66
    half = 0.5
    points: Float = np.array(
        [
            [0.0, -half, 0.0], [0.0, half, 0.0], [0.0, half, eaves], [0.0, 0.0, 1.0], [0.0, -half, eaves],
            [depth * eaves, half, eaves], [depth, 0.0, 1.0], [depth * eaves, -half, eaves],
        ]
    )  # fmt: skip
    walls = [[1, 0, 4], [1, 4, 2], [2, 4, 3], [1, 2, 5], [0, 7, 4]]
    under = [[0, 1, 5], [0, 5, 6], [0, 6, 7]]
    roof = [[2, 3, 6], [2, 6, 5], [3, 4, 7], [3, 7, 6]]
    body = points, np.array(walls + under + roof, np.int32)
    mesh = _of(body, material="plaster")
    tiles = _of(body, material="roof_tile")
    mesh.material[-len(roof) :] = tiles.material[-len(roof) :]
    mesh.color[-len(roof) :] = tiles.color[-len(roof) :]
    window = _of(box((0.04, 0.56), (0.14, 0.6)), material="glass")
    return concatenate([mesh, window])
