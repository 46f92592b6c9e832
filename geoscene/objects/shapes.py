"""Small closed solids that a scene stores once and instances: crowns, trunks, poles, signs, benches."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.classes import Class, materials
from geoscene.geometry.mesh import Mesh, ShapeInstances, concatenate
from geoscene.objects.crowns import leaf_area_densities, tree_shapes
from geoscene.objects.solids import Body, box, circle, lathe, prism, rectangle, solid
from geoscene.objects.street_shapes import street_shapes
from geoscene.typing import Float

LEAF_AREA_DENSITY: dict[str, float] = {
    "crown_broadleaved": 1.1,
    "crown_needleleaved": 1.5,
    "crown_palm": 0.8,
    "hedge": 2.0,
}
"""One-sided leaf area per volume, m2/m3, of the shapes that let light through, and of faces of class HEDGE.

A default tree's leaf area index over the mean depth of its crown: 5.1 (temperate broadleaved forest) over
two thirds of a crown of 7 m, 5.5 (temperate needle-leaved forest) over a third of one of 11 m; indices
from Asner, Scurlock and Hicke, "Global synthesis of leaf area index observations" (2003). Palms and
clipped hedges: assumed.
"""

_BALL = ((0, 0), (0.65, 0.13), (0.97, 0.38), (0.97, 0.62), (0.65, 0.87), (0, 1))
"""Profile of a spherical crown: (diameter, z); 64 faces."""

_CONE = ((0, 0), (1, 0.05), (0, 1))

DORMER_DEPTH = 1.3
"""Depth of a dormer over its width; its height follows from the pitch of the roof."""


def leaf_area_density(*, with_relief: bool = False) -> dict[str, float]:
    """`LEAF_AREA_DENSITY`, with relief also of the clusters of leaves in crowns with relief."""
    if not with_relief:
        return LEAF_AREA_DENSITY
    forms = ("broadleaved", "needleleaved", "palm")
    return LEAF_AREA_DENSITY | leaf_area_densities(
        tuple((form, LEAF_AREA_DENSITY[f"crown_{form}"]) for form in forms)
    )


@functools.cache
def shapes(*, with_relief: bool = False) -> dict[str, Mesh]:
    """All shapes by name, in the order of their numbers in `ShapeInstances.shape`.

    Crowns and trunks are of unit size (x and y from -0.5 to 0.5, z from 0 to 1), to be scaled; the rest is in
    metres at its usual size, x in the direction it faces, z up from the ground. All are closed.

    with_relief : also those of scenes with relief, after the others
    """
    if with_relief:
        return shapes() | tree_shapes() | street_shapes() | roof_shapes()
    return {
        "trunk": solid(prism(circle(1.0, 6), 0.0, top=1.0, taper=0.7), klass=Class.TRUNK, material="bark"),
        "crown_broadleaved": solid(lathe(_BALL), klass=Class.TREE_CROWN, material="foliage"),
        "crown_needleleaved": solid(lathe(_CONE), klass=Class.TREE_CROWN, material="conifer"),
        "crown_palm": solid(lathe(_BALL), klass=Class.TREE_CROWN, material="foliage"),
        "street_lamp": _street_lamp(),
        "traffic_signals": _traffic_signals(),
        "sign_round": _sign(circle(0.6, 12), 2.5),
        "sign_triangle": _sign(circle(0.9, 3) @ _QUARTER, 2.5),
        "sign_give_way": _sign(circle(0.9, 3) @ -_QUARTER, 2.5),
        "sign_stop": _sign(circle(0.75, 8) @ _SIXTEENTH, 2.5),
        "sign_rectangle": _sign(rectangle(0.6, 0.6), 2.5),
        "bollard": solid(prism(circle(0.12), -0.2, top=0.9), klass=Class.BOLLARD, material="metal"),
        "bench": _bench(),
        "utility_pole": solid(
            prism(circle(0.28), -0.3, top=9.0, taper=0.7), klass=Class.POLE, material="wood"
        ),
        "flagpole": solid(prism(circle(0.12), -0.2, top=8.0, taper=0.6), klass=Class.POLE, material="metal"),
        "hydrant": solid(prism(circle(0.25), -0.2, top=0.8), klass=Class.BOLLARD, material="metal"),
    }


_QUARTER = np.array([[0.0, 1.0], [-1.0, 0.0]])
"""Rotates row vectors by 90 degrees, counter-clockwise: a triangle's corner from the right to the top."""

_COS, _SIN = np.cos(np.pi / 8), np.sin(np.pi / 8)
_SIXTEENTH = np.array([[_COS, _SIN], [-_SIN, _COS]])
"""Rotates row vectors by 22.5 degrees, so that an octagon stands on an edge."""


def _street_lamp() -> Mesh:
    """A mast of 8 m, an arm of 1.5 m in the direction it faces, and a head at its end."""
    pole = solid(prism(circle(0.16), -0.3, top=8.0, taper=0.6), klass=Class.POLE, material="metal")
    arm = solid(prism(rectangle(1.5, 0.06, x=0.75), 7.9, top=7.98), klass=Class.POLE, material="metal")
    head = solid(prism(rectangle(0.7, 0.25, x=1.6), 7.82, top=7.95), klass=Class.POLE, material="metal")
    return concatenate([pole, arm, head])


def _traffic_signals() -> Mesh:
    """A mast of 3.4 m and a head of three lamps that faces x."""
    pole = solid(prism(circle(0.11), -0.3, top=3.4), klass=Class.POLE, material="metal")
    head = solid(
        prism(rectangle(0.2, 0.3, x=0.16), 2.4, top=3.35), klass=Class.TRAFFIC_LIGHT, material="metal"
    )
    visor = solid(
        prism(rectangle(0.12, 0.26, x=0.32), 2.45, top=3.3), klass=Class.TRAFFIC_LIGHT, material="glass"
    )
    return concatenate([pole, head, visor])


def _sign(outline: Float, height: float) -> Mesh:
    """A plate of 4 mm with its centre at ``height``, on a pole; the side towards x is retro-reflecting."""
    pole = solid(prism(circle(0.06), -0.3, top=height + 0.4), klass=Class.POLE, material="metal")
    points, faces = prism(outline, 0.0, top=0.004)
    # The plate is upright: x of its plane becomes y, y becomes z, and its upper side becomes the front.
    points = np.column_stack([points[:, 2] + 0.035, points[:, 0], points[:, 1] + height])
    plate = solid((points, faces), klass=Class.TRAFFIC_SIGN, material="metal")
    front = plate.normals()[:, 0] > 0.5
    sheet = materials()["retroreflector"]
    return concatenate(
        [
            pole,
            replace(
                plate,
                material=np.where(front, sheet.code, plate.material).astype(np.uint8),
                color=np.where(front[:, None], sheet.color, plate.color).astype(np.uint8),
            ),
        ]
    )


def _bench() -> Mesh:
    """A bench of 1.8 m that faces x: seat, back, two legs."""
    boxes = [
        (rectangle(0.45, 1.8), 0.41, 0.46, "wood"),
        (rectangle(0.05, 1.8, x=-0.26), 0.5, 0.85, "wood"),
        (rectangle(0.4, 0.08, y=-0.7), -0.1, 0.4, "metal"),
        (rectangle(0.4, 0.08, y=0.7), -0.1, 0.4, "metal"),
        (rectangle(0.04, 0.06, x=-0.31, y=-0.7), -0.1, 0.8, "metal"),
        (rectangle(0.04, 0.06, x=-0.31, y=0.7), -0.1, 0.8, "metal"),
    ]
    return concatenate(
        [solid(prism(o, low, top=high), klass=Class.BENCH, material=m) for o, low, high, m in boxes]
    )


def place(
    name: str | Sequence[str] | NDArray[np.str_],
    position: Float,
    *,
    size: ArrayLike = (1.0, 1.0, 1.0),
    heading: ArrayLike = 0.0,
    feature: ArrayLike = -1,
) -> ShapeInstances:
    """Copies of shapes at positions (k, 3), scene metres.

    name    : one name, or one a copy
    size    : factor along the shape's x, y and z, (3,) or (k, 3)
    heading : radians counter-clockwise from east to the shape's x axis, one or (k,)
    """
    k = len(position)
    size = np.broadcast_to(np.asarray(size, float), (k, 3))
    heading = np.broadcast_to(np.asarray(heading, float), (k,))
    c, s, o = np.cos(heading), np.sin(heading), np.zeros(k)
    turn = np.stack([c, -s, o, s, c, o, o, o, o + 1.0], axis=1).reshape(k, 3, 3)
    transform = np.concatenate([turn * size[:, None, :], np.reshape(position, (k, 3, 1))], axis=2)
    names = np.broadcast_to(np.asarray(name, np.str_), (k,))
    known, which = np.unique(names, return_inverse=True)
    library = list(shapes(with_relief=True))
    number = np.array([library.index(str(n)) for n in known], np.int32)[which.reshape(-1)]
    return ShapeInstances(
        number.astype(np.int32), transform, np.broadcast_to(np.asarray(feature, np.int32), (k,)).copy()
    )


@functools.cache
def roof_shapes() -> dict[str, Mesh]:
    """Shapes of rooftop objects by name; metres, x in the direction of the front, z up from the roof.

    Chimneys and dormers have unit height, to be scaled: a dormer's underside rises from its front at x = 0
    to its back at x = `DORMER_DEPTH` and z = 1, as the roof does. Sizes are usual ones, assumed.
    """
    parts = {
        "chimney": [
            _of(prism(rectangle(0.6, 0.6), 0.0, top=0.93), material="brick"),
            _of(prism(rectangle(0.7, 0.7), 0.93, top=0.97), material="concrete"),
            *(
                _of(_shift(prism(circle(0.2, 6), 0.97, top=1.0), y=y), material="brick")
                for y in (-0.14, 0.14)
            ),
        ],
        "dormer": [_dormer()],
        "roof_stairs": [
            _of(box((3.4, 2.6), (-0.05, 2.5)), material="plaster"),
            _of(box((3.6, 2.8), (2.5, 2.62)), material="tar_roof"),
            _of(box((0.04, 0.9), (0.05, 2.1), at=(1.71, 0.3)), material="metal"),
        ],
        "lift_housing": [
            _of(box((3.0, 3.0), (-0.05, 3.2)), material="plaster"),
            _of(box((3.2, 3.2), (3.2, 3.35)), material="concrete"),
        ],
        "air_conditioner": [
            *(_of(box((0.1, 1.1), (-0.05, 0.25), at=(x, 0.0)), material="metal") for x in (-0.6, 0.6)),
            _of(box((1.7, 1.2), (0.25, 1.25)), material="metal"),
            *(_of(_shift(prism(circle(0.75), 1.25, top=1.36), x=x), material="metal") for x in (-0.42, 0.42)),
        ],
        "air_handler": [
            *(_of(box((0.15, 2.0), (-0.05, 0.35), at=(x, 0.0)), material="metal") for x in (-2.1, -0.6, 1.0)),
            _of(box((4.0, 2.2), (0.35, 2.0), at=(-0.55, 0.0)), material="metal"),
            _of(box((1.1, 1.0), (0.5, 1.5), at=(2.0, 0.0)), material="metal"),
            *(_of(_shift(prism(circle(1.1), 2.0, top=2.2), x=x), material="metal") for x in (-1.7, -0.1)),
        ],
        "vent": [
            _of(prism(circle(0.18, 6), -0.05, top=0.75), material="metal"),
            _of(prism(circle(0.34, 6), 0.75, top=0.92, taper=0.6), material="metal"),
        ],
        "skylight": [
            _of(box((1.4, 1.4), (-0.05, 0.3)), material="metal"),
            _of(prism(rectangle(1.2, 1.2), 0.3, top=0.55, taper=0.4), material="glass"),
        ],
        "antenna": [
            _of(prism(circle(0.06, 5), -0.05, top=3.2), material="metal", klass=Class.POLE),
            *(
                _of(box((0.9 - 0.12 * k, 0.03), (z, z + 0.03)), material="metal", klass=Class.POLE)
                for k, z in enumerate((2.5, 2.8, 3.1))
            ),
        ],
        "water_tank": [
            *(
                _of(box((0.16, 0.16), (-0.05, 3.1), at=(x, y)), material="metal")
                for x in (-1.1, 1.1)
                for y in (-1.1, 1.1)
            ),
            _of(box((2.7, 2.7), (3.0, 3.15)), material="wood"),
            _of(prism(circle(3.2, 12), 3.15, top=6.3, taper=0.94), material="wood"),
            _of(lathe(((0, 6.3), (3.3, 6.3), (0.3, 7.2), (0, 7.25)), sides=12), material="tar_roof"),
        ],
    }
    return {name: concatenate(some) for name, some in parts.items()}


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
