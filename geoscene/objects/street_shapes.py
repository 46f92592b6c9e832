"""Shapes of street furniture in scenes with relief: bins, stands and bicycles, shelters, boxes, tables."""

from __future__ import annotations

import functools

import numpy as np

from geoscene.classes import Class
from geoscene.geometry.mesh import Mesh, concatenate
from geoscene.objects.solids import Body, box, circle, lathe, prism, rectangle, solid
from geoscene.typing import Float

_OTHER = Class.OTHER_STRUCTURE
_UNDER = -0.1
"""Metres below the ground to which things reach, so that no gap opens on a slope."""


@functools.cache
def street_shapes() -> dict[str, Mesh]:
    """Street furniture with relief by name; metres, x in the direction it faces, z up from the ground.

    Sizes are usual ones, assumed.
    """
    bicycles = [_bicycle(side) for side in (0.29, -0.29)]
    parts = {
        "waste_basket": [
            _metal(prism(circle(0.42), 0.12, top=0.9)),
            _metal(prism(circle(0.2), _UNDER, top=0.12)),
            _metal(prism(circle(0.48), 0.9, top=0.96, taper=0.8)),
        ],
        "recycling_container": [
            _metal(box((1.3, 1.2), (_UNDER, 1.25))),
            _metal(prism(rectangle(1.29, 1.19), 1.23, top=1.65, taper=0.6)),
        ],
        "waste_container": [
            _plastic(box((0.95, 1.25), (0.14, 1.05))),
            _plastic(box((1.05, 1.35), (1.05, 1.18))),
            *(
                _metal(box((0.16, 0.08), (-0.02, 0.14), at=(x, y)))
                for x in (-0.35, 0.35)
                for y in (-0.5, 0.5)
            ),
        ],
        "bicycle_stand": [_stand()],
        "bicycle_stand_1": [_stand(), bicycles[0]],
        "bicycle_stand_2": [_stand(), *bicycles],
        "bus_shelter": [_bus_shelter()],
        "bus_stop": [
            _metal(prism(circle(0.07), -0.3, top=2.9), klass=Class.POLE),
            _sheet((0.03, 0.45), (2.35, 2.85), y=0.2),
        ],
        "bench_plain": [
            _wood(box((0.45, 1.8), (0.41, 0.46))),
            *(_metal(box((0.4, 0.08), (_UNDER, 0.41), at=(0.0, y)), klass=Class.BENCH) for y in (-0.7, 0.7)),
        ],
        "post_box": [
            _metal(box((0.06, 0.06), (_UNDER, 0.6))),
            _metal(box((0.35, 0.45), (0.6, 1.2))),
            _metal(prism(rectangle(0.34, 0.44), 1.18, top=1.3, taper=0.75)),
        ],
        "vending_machine": [
            _metal(box((0.75, 0.95), (_UNDER, 1.83))),
            _glass(box((0.03, 0.6), (0.75, 1.65), at=(0.39, -0.1))),
        ],
        "parking_meter": [
            _metal(prism(circle(0.07), -0.3, top=1.1), klass=Class.POLE),
            _metal(box((0.16, 0.22), (1.1, 1.5)), klass=Class.POLE),
        ],
        "street_cabinet": [
            _plastic(box((0.35, 0.95), (_UNDER, 1.15))),
            _plastic(box((0.4, 1.0), (1.15, 1.2))),
        ],
        "planter": [
            solid(box((0.5, 1.1), (_UNDER, 0.5)), klass=_OTHER, material="concrete"),
            *(
                solid(
                    _lump((0.45, 0.45, 0.6), at=(0.0, y, 0.45 - 0.05 * k)),
                    klass=Class.HEDGE,
                    material="foliage",
                )
                for k, y in enumerate((-0.32, 0.0, 0.32))
            ),
        ],
        "telephone": [
            _metal(box((0.9, 0.9), (2.2, 2.4))),
            _metal(box((0.9, 0.9), (_UNDER, 0.12))),
            *(
                _metal(box((0.06, 0.06), (0.12, 2.2), at=(x, y)))
                for x in (-0.42, 0.42)
                for y in (-0.42, 0.42)
            ),
            _glass(box((0.02, 0.78), (0.2, 2.15), at=(-0.42, 0.0))),
            *(_glass(box((0.78, 0.02), (0.2, 2.15), at=(0.0, y))) for y in (-0.42, 0.42)),
            _metal(box((0.2, 0.4), (1.0, 1.6), at=(-0.28, 0.0))),
        ],
        "drinking_fountain": [
            solid(prism(circle(0.3), _UNDER, top=0.85), klass=_OTHER, material="stone"),
            solid(prism(circle(0.5), 0.85, top=0.95), klass=_OTHER, material="stone"),
        ],
        "information_board": [
            *(_metal(prism(circle(0.08), -0.3, top=2.0), y=y, klass=Class.POLE) for y in (-0.75, 0.75)),
            _sheet((0.06, 1.42), (0.9, 1.9)),
        ],
        "advertising_column": [
            solid(prism(circle(1.25, 12), _UNDER, top=2.9), klass=_OTHER, material="concrete"),
            _metal(prism(circle(1.5, 12), 2.9, top=3.3, taper=0.3)),
        ],
        "poster_box": [
            _metal(box((0.2, 0.5), (_UNDER, 0.55))),
            _metal(box((0.2, 1.35), (0.55, 2.5))),
            *(_glass(box((0.02, 1.2), (0.65, 2.4), at=(x, 0.0))) for x in (-0.11, 0.11)),
        ],
        "charging_station": [
            _plastic(box((0.3, 0.45), (_UNDER, 1.6))),
            _glass(box((0.02, 0.3), (1.15, 1.4), at=(0.16, 0.0))),
        ],
        "block": [
            solid(
                prism(rectangle(0.6, 0.6), _UNDER, top=0.55, taper=0.9),
                klass=Class.BOLLARD,
                material="concrete",
            )
        ],
        "clock": [
            _metal(prism(circle(0.14), -0.3, top=3.2, taper=0.8), klass=Class.POLE),
            _metal(_upright_disc(0.8, 0.25, z=3.55), klass=Class.POLE),
        ],
        "hydrant_pillar": [
            _metal(prism(circle(0.3), _UNDER, top=0.08), klass=Class.BOLLARD),
            _metal(prism(circle(0.2), 0.08, top=0.62), klass=Class.BOLLARD),
            _metal(lathe(((0, 0.6), (0.27, 0.6), (0.25, 0.7), (0.1, 0.8), (0, 0.82))), klass=Class.BOLLARD),
            _metal(box((0.12, 0.42), (0.42, 0.54)), klass=Class.BOLLARD),
            _metal(box((0.3, 0.14), (0.38, 0.52), at=(0.06, 0.0)), klass=Class.BOLLARD),
        ],
        "table": [_table()],
        "table_parasol": [_table(), *_parasol()],
        "wire": [_wire()],
    }
    return {name: concatenate(some) for name, some in parts.items()}


def _metal(body: Body, *, y: float = 0.0, klass: Class = _OTHER) -> Mesh:
    return solid((body[0] + [0.0, y, 0.0], body[1]), klass=klass, material="metal")


def _plastic(body: Body) -> Mesh:
    """A painted or plastic body, in a dull green grey."""
    return solid(body, klass=_OTHER, material="car_paint", color=(92, 104, 98))


def _glass(body: Body) -> Mesh:
    return solid(body, klass=_OTHER, material="glass")


def _wood(body: Body) -> Mesh:
    return solid(body, klass=Class.BENCH, material="wood")


def _sheet(size: tuple[float, float], z: tuple[float, float], *, y: float = 0.0) -> Mesh:
    """An upright board."""
    return solid(box(size, z, at=(0.0, y)), klass=Class.TRAFFIC_SIGN, material="metal")


def _lump(size: tuple[float, float, float], *, at: tuple[float, float, float]) -> Body:
    """A rounded body of some width, depth and height over a point."""
    points, faces = lathe(((0, 0), (0.8, 0.15), (1.0, 0.5), (0.6, 0.85), (0, 1)), sides=6)
    return points * size + at, faces


def _upright_disc(diameter: float, thickness: float, *, z: float) -> Body:
    """A disc that faces x."""
    points, faces = prism(circle(diameter, 10), -thickness / 2, top=thickness / 2)
    return np.column_stack([points[:, 2], points[:, 0], points[:, 1] + z]), faces


def _bar(start: tuple[float, float, float], end: tuple[float, float, float], *, width: float) -> Body:
    """A bar of three sides between two points."""
    a, b = np.array(start), np.array(end)
    along = (b - a) / np.linalg.norm(b - a)
    aside = np.cross(along, (0.0, 1.0, 0.0) if abs(along[1]) < 0.9 else (1.0, 0.0, 0.0))
    aside /= np.linalg.norm(aside)
    other = np.cross(along, aside)
    points, faces = prism(circle(width, 3), 0.0, top=1.0)
    frame: Float = np.stack([aside, other, b - a])
    return a + points @ frame, faces


def _stand() -> Mesh:
    """A bent tube, 0.8 m wide and high, in the direction x."""
    low, high, half = -0.2, 0.8, 0.38
    tubes = [
        _bar((-half, 0.0, low), (-half, 0.0, high), width=0.05),
        _bar((half, 0.0, low), (half, 0.0, high), width=0.05),
        _bar((-half - 0.02, 0.0, high), (half + 0.02, 0.0, high), width=0.05),
    ]
    return concatenate([_metal(tube, klass=Class.POLE) for tube in tubes])


def _bicycle(y: float) -> Mesh:
    """A bicycle 1.75 m long in direction x, leaning on a stand."""
    rear, front, crank = (-0.52, y, 0.34), (0.53, y, 0.34), (-0.08, y, 0.3)
    saddle, head = (-0.25, y, 0.9), (0.36, y, 0.9)
    tubes = [(rear, crank), (rear, saddle), (crank, saddle), (crank, head), (saddle, head), (head, front)]
    bodies = [_bar(a, b, width=0.045) for a, b in tubes]
    bodies.append(box((0.26, 0.14), (0.92, 0.98), at=(-0.27, y)))
    bodies.append(_bar((0.34, y - 0.28, 1.02), (0.34, y + 0.28, 1.02), width=0.045))
    bodies.append(_bar(head, (0.34, y, 1.02), width=0.045))
    bodies += [_wheel(x, y) for x in (rear[0], front[0])]
    return concatenate([solid(body, klass=Class.BICYCLE, material="metal") for body in bodies])


def _wheel(x: float, y: float) -> Body:
    """A tyre of 0.68 m on the ground in the plane xz: a ring of ten wedges of three sides."""
    n = 10
    turn = 2 * np.pi * np.arange(n) / n
    ring = np.arange(n)
    ahead = (ring + 1) % n
    rows = [
        np.column_stack([x + r * np.cos(turn), np.full(n, y + aside), 0.34 + r * np.sin(turn)])
        for r, aside in ((0.34, 0.0), (0.27, -0.03), (0.27, 0.03))
    ]
    faces = []
    for k in range(3):
        low, high = k * n, (k + 1) % 3 * n
        faces += [
            np.column_stack([low + ring, low + ahead, high + ahead]),
            np.column_stack([low + ring, high + ahead, high + ring]),
        ]
    return np.vstack(rows), np.vstack(faces).astype(np.int32)


def _bus_shelter() -> Mesh:
    """A shelter of 4.2 m by 1.5 m, open towards x: roof, posts, glass behind and at one side, a bench."""
    posts = [(x, y) for x in (-0.65,) for y in (-2.0, -0.7, 0.7, 2.0)] + [(0.45, -2.0), (0.45, 2.0)]
    return concatenate(
        [
            *(_metal(box((0.08, 0.08), (_UNDER, 2.45), at=at), klass=Class.POLE) for at in posts),
            _metal(box((1.5, 4.3), (2.45, 2.6), at=(0.0, 0.0))),
            *(_glass(box((0.02, 1.2), (0.2, 2.2), at=(-0.65, y))) for y in (-1.35, 0.0, 1.35)),
            _glass(box((1.0, 0.02), (0.2, 2.2), at=(-0.1, -2.0))),
            _wood(box((0.35, 2.2), (0.43, 0.48), at=(-0.35, 0.0))),
            *(
                _metal(box((0.3, 0.06), (_UNDER, 0.43), at=(-0.35, y)), klass=Class.BENCH)
                for y in (-0.9, 0.9)
            ),
        ]
    )


def _table() -> Mesh:
    """A table of 0.7 m with two chairs that face each other along y."""
    parts = [
        _metal(prism(circle(0.72), 0.71, top=0.74)),
        _metal(prism(circle(0.07, 5), 0.04, top=0.71)),
        _metal(prism(circle(0.45), -0.02, top=0.04)),
    ]
    for side in (-1.0, 1.0):
        seat, back = 0.62 * side, 0.82 * side
        parts += [
            _wood(box((0.42, 0.42), (0.44, 0.48), at=(0.0, seat))),
            _wood(box((0.42, 0.04), (0.48, 0.88), at=(0.0, back))),
            *(
                _metal(box((0.04, 0.4), (-0.02, 0.46), at=(x, seat)), klass=Class.BENCH)
                for x in (-0.19, 0.19)
            ),
        ]
    return concatenate(parts)


def _parasol() -> list[Mesh]:
    """A parasol of 2.4 m over the table."""
    canopy = lathe(((0, 2.2), (2.4, 2.15), (2.4, 2.2), (0, 2.65)), sides=8)
    return [
        _metal(prism(circle(0.05, 5), 0.74, top=2.5)),
        solid(canopy, klass=_OTHER, material="clothing", color=(196, 186, 160)),
    ]


def _wire() -> Mesh:
    """A wire of unit length along x, of unit width: a prism of three sides."""
    points, faces = prism(circle(1.0, 3), 0.0, top=1.0)
    return solid((points[:, [2, 0, 1]], faces), klass=Class.WIRE, material="metal")
